"""Runs the whole package under jaxtyping and beartype: a wrong shape annotation fails the suite."""

import ast
import gc
import os
import re
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import jaxtyping
import pytest
from hypothesis import settings

SOURCE = Path(__file__).parents[1] / "src" / "robotdiffuse"
_KERNELS = r"robotdiffuse\.(collision\.kernels\.random|core\.kernels)"
COMPILED = re.compile(rf"^\s*(import numba\b|from numba\b|from {_KERNELS} import)", re.MULTILINE)
"""In modules with compiled functions, which must stay undecorated: they are left out of the hook."""


def checked_modules() -> list[str]:
    """All modules without compiled functions, and no packages, whose names cover all modules below them."""
    return [
        ".".join(file.relative_to(SOURCE.parent).with_suffix("").parts)
        for file in sorted(SOURCE.rglob("*.py"))
        if file.name != "__init__.py" and not COMPILED.search(file.read_text())
    ]


def parse_in_one_thread_at_a_time() -> None:
    """CPython 3.11 counts the depth of the syntax trees of all threads together (gh-106905), so two that parse at once raise a
    SystemError. The hook parses modules as they are imported, NumPy and beartype later: to lock the hook is not enough."""
    parse = ast.parse
    parsing = threading.RLock()

    def alone(*args: Any, **kwargs: Any) -> Any:
        with parsing:
            return parse(*args, **kwargs)

    ast.parse = alone


def keep_dimensions_of_shapes_alone() -> None:
    """jaxtyping binds the arguments of every call, which takes long, so functions without shapes are left to beartype."""
    jaxtyped = jaxtyping.jaxtyped

    def checked(*, typechecker: Callable[[Any], Any]) -> Callable[[Any], Any]:
        def decorator(of: Any) -> Any:
            hints = getattr(of, "__annotations__", {}).values()
            shapes = any(isinstance(hint, str) for hint in hints) or "jaxtyping." in repr(hints)
            return (jaxtyped(typechecker=typechecker) if isinstance(of, type) or shapes else typechecker)(of)

        return decorator

    jaxtyping.jaxtyped = checked


parse_in_one_thread_at_a_time()
keep_dimensions_of_shapes_alone()
jaxtyping.install_import_hook(checked_modules(), "beartype.beartype")

# the same examples at every run: a suite that fails by chance guards nothing
settings.register_profile("suite", deadline=None, max_examples=40, derandomize=True)
settings.load_profile("suite")


def pytest_collection_finish() -> None:
    """What is imported stays, so the garbage collector need not look at it again and again."""
    gc.freeze()


@pytest.fixture(autouse=True, scope="session")
def apart_from_the_users_robots(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Robots that a test prepares are neither found by later tests nor left in the user's folder."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROBOTDIFFUSE_ROBOTS", str(tmp_path_factory.mktemp("robots")))
        yield


@pytest.fixture(autouse=True)
def cpu_clock(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Planners' time limits are CPU time, so that a loaded machine changes no result; pages play motions in real time."""
    if request.path.parent.name != "live":
        monkeypatch.setattr(time, "perf_counter", time.process_time)


@pytest.fixture
def said(capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """What a command prints; see `helpers.commands.Said`."""
    from helpers.commands import run

    def of(status: int, *argv: object) -> str:
        assert run(*argv) == status
        printed = capsys.readouterr()
        return printed.err if status > 1 else printed.out

    return of


@pytest.fixture
def few_lights(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pictures are drawn with few lights, from the best of few directions."""
    from robotdiffuse.visualization import picture

    for number, fewer in (("SKY_LIGHTS", 6), ("KEY_LIGHTS", 4), ("AZIMUTHS", 6)):
        monkeypatch.setattr(picture, number, fewer)


@pytest.fixture
def small_pictures(monkeypatch: pytest.MonkeyPatch, few_lights: None) -> None:
    """Light and ghosts take seconds to draw, and a small picture suffices for a test."""
    import robotdiffuse.visualization.exploration  # noqa: F401  with the settings' class in its annotations
    from robotdiffuse.visualization import picture, replay_page

    small = picture.PictureSettings(width=240, height=150, ghosts=1)
    for module in (picture, replay_page):
        monkeypatch.setattr(module, "PictureSettings", lambda **_: small)
    monkeypatch.setattr(replay_page, "THUMBNAIL", small)
