"""Runs the whole package under jaxtyping and beartype: a wrong shape annotation fails the suite."""

import ast
import os
import re
import threading
import time
from collections.abc import Callable, Collection, Iterator
from contextlib import suppress
from functools import cache, wraps
from inspect import isgeneratorfunction
from pathlib import Path
from types import FunctionType
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import jaxtyping
import numpy as np
import pytest
from hypothesis import settings
from jaxtyping import install_import_hook

SOURCE = Path(__file__).parents[1] / "src" / "robotdiffuse"
_KERNELS = r"robotdiffuse\.(collision\.kernels\.random|core\.kernels)"
COMPILED = re.compile(rf"^\s*(import numba\b|from numba\b|from {_KERNELS} import)", re.MULTILINE)
"""In modules with compiled functions, which must stay undecorated: they are left out of the hook."""


def checked_modules() -> list[str]:
    """All modules without compiled functions. Packages are left out, since the name of a package covers all
    modules below it."""
    return [
        ".".join(file.relative_to(SOURCE.parent).with_suffix("").parts)
        for file in sorted(SOURCE.rglob("*.py"))
        if file.name != "__init__.py" and not COMPILED.search(file.read_text())
    ]


def parse_in_one_thread_at_a_time() -> None:
    """CPython 3.11 counts the depth of the syntax trees of all threads together (gh-106905). If two threads
    parse at once, the error is "SystemError: AST constructor recursion depth mismatch", and a live page has
    no plan. The hook parses each module when it is imported, and NumPy and beartype parse later, so it is
    not enough to lock the hook or to import all modules first."""
    parse = ast.parse
    parsing = threading.RLock()

    def alone(*args: Any, **kwargs: Any) -> Any:
        with parsing:
            return parse(*args, **kwargs)

    ast.parse = alone


class UnknownError(Exception):
    """Whether annotations admit a value may depend on more than its type and shape."""


ARRAYS: set[type] = {np.ndarray}
ALONE: set[type] = {int, float, bool, complex, type(None), np.random.Generator}
"""Types of which annotations admit every instance or none."""


def key_of(value: Any) -> Any:
    """A key that two values share only if the same annotations admit both. Raises UnknownError if there is none."""
    kind = type(value)
    if kind in ARRAYS:
        return kind, value.dtype, value.shape
    if kind in ALONE:
        return kind
    if kind is tuple:
        return kind, *map(key_of, value)
    if kind is str:
        return value
    module = kind.__module__.partition(".")[0]
    if module == "torch" and kind.__name__ in ("Tensor", "Parameter"):
        ARRAYS.add(kind)
    elif (module == SOURCE.name and not issubclass(kind, Collection)) or issubclass(kind, np.generic):
        ALONE.add(kind)
    else:
        raise UnknownError
    return key_of(value)


def once_for_each_shape(function: Callable[..., Any], jaxtyped: Callable[[Any], Any]) -> Callable[..., Any]:
    """`function`, checked by jaxtyping in calls whose types and shapes, of arguments and result, are new."""
    checked = jaxtyped(function)
    passed = set[Any]()
    given = threading.local()

    def give(*_: Any, **__: Any) -> Any:
        return given.returned

    @cache
    def returns() -> Callable[..., Any]:
        # jaxtyping looks for the names of annotations among the globals
        return jaxtyped(wraps(function)(FunctionType(give.__code__, function.__globals__, None, None, give.__closure__)))

    @wraps(function)
    def remembered(*args: Any, **kwargs: Any) -> Any:
        try:
            called = key_of(args), *kwargs, key_of(tuple(kwargs.values()))
        except UnknownError:
            return checked(*args, **kwargs)
        if called not in passed:
            returned = checked(*args, **kwargs)
            passed.add(called)
            return returned
        returned = function(*args, **kwargs)
        with suppress(UnknownError):
            if (both := (called, key_of(returned))) in passed:
                return returned
            given.returned = returned
            returns()(*args, **kwargs)
            passed.add(both)
            return returned
        given.returned = returned
        return returns()(*args, **kwargs)

    return remembered


def check_shapes_once() -> None:
    """jaxtyping binds the arguments of every call, to compare the dimensions of shapes. That took up to two thirds of a
    test's time, so it checks each combination of types and shapes once, and only beartype checks functions without shapes."""
    jaxtyped = jaxtyping.jaxtyped

    def checked(*, typechecker: Callable[[Any], Any]) -> Callable[[Any], Any]:
        def decorator(of: Any) -> Any:
            hints = getattr(of, "__annotations__", {}).values()
            if isinstance(of, type):
                return jaxtyped(typechecker=typechecker)(of)
            if not any(isinstance(hint, str) for hint in hints) and "jaxtyping." not in repr(hints):
                return typechecker(of)
            if not isinstance(of, FunctionType) or isgeneratorfunction(of):
                return jaxtyped(typechecker=typechecker)(of)
            return once_for_each_shape(of, jaxtyped(typechecker=typechecker))

        return decorator

    jaxtyping.jaxtyped = checked


parse_in_one_thread_at_a_time()
check_shapes_once()
install_import_hook(checked_modules(), "beartype.beartype")

# the same examples at every run: a suite that fails by chance guards nothing
settings.register_profile("suite", deadline=None, max_examples=40, derandomize=True)
settings.load_profile("suite")


@pytest.fixture(autouse=True, scope="session")
def apart_from_the_users_robots(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Robots that a test prepares are neither found by later tests nor left in the user's folder."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROBOTDIFFUSE_ROBOTS", str(tmp_path_factory.mktemp("robots")))
        yield


@pytest.fixture(autouse=True)
def cpu_clock(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Planners' time limits are CPU time, so that a loaded machine changes no result; pages play motions in
    real time."""
    if request.path.parent.name != "live":
        monkeypatch.setattr(time, "perf_counter", time.process_time)


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
