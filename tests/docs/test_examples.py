"""Each example runs and writes its picture; public names are documented in Google's style, and their examples run."""

import dataclasses
import doctest
import inspect
import re
import runpy
import shutil
from collections.abc import Callable, Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import griffe
import numpy as np
import pytest

import robotdiffuse as rd
from helpers.quick_preparation import QUICK, coarse_grids
from robotdiffuse.core.settings import field_docstrings
from robotdiffuse.interop.depth_recording import StampedView, write_depth_views
from robotdiffuse.robots.fitting.preparation import add_robot

ROOT = Path(__file__).parents[2]
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
SLOW = {"01_own_robot", "05_depth_camera", "09_two_arms", "12_train_on_own_data", "13_mujoco"}
"""They prepare a robot, load networks, compile the code for several arms, or train."""
NAMES = sorted(getattr(rd, "__all__"))  # noqa: B009  (the stub does not name it)
MODULES = re.findall(r"^::: robotdiffuse\.(.+)$", (ROOT / "docs" / "reference" / "modules.md").read_text("utf-8"), re.MULTILINE)


@pytest.mark.usefixtures("small_pictures")
@pytest.mark.parametrize("example", [pytest.param(e, id=e.stem, marks=[pytest.mark.slow] * (e.stem in SLOW)) for e in EXAMPLES])
def test_example_runs(example: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("ROBOTDIFFUSE_ROBOTS", str(tmp_path / "robots"))
    if example.stem == "01_own_robot":
        with coarse_grids():
            add_robot(str(ROOT / "examples" / "data" / "arm.urdf"), settings=QUICK)
    runpy.run_path(str(example), run_name="__main__")
    assert "solved" in (printed := capsys.readouterr().out) or "valid" in printed, printed
    if example.stem[0].isdigit():
        assert (tmp_path / f"{example.stem}.png").stat().st_size > 1000


def test_the_gallery_has_thirteen_examples_and_the_first_motion_keeps_its_clearance() -> None:
    numbered = [file for file in EXAMPLES if file.stem[0].isdigit()]
    assert len(numbered) == 13
    for file in numbered:
        assert len(file.read_text(encoding="utf-8").splitlines()) < 40, file.name
        assert (ROOT / "docs" / "images" / "gallery" / f"{file.stem}.png").is_file(), file.name
    assert "plan examples/ball.yaml --until first" in (ROOT / "README.md").read_text()
    assert rd.plan(rd.Problem.load(ROOT / "examples" / "ball.yaml"), until="first").scene_clearance >= 0.01


def public(name: str) -> Any:
    """A name of `rd`, or the object at a dotted place in the package."""
    module, dot, attribute = name.rpartition(".")
    return getattr(import_module(f"robotdiffuse.{module}") if dot else rd, attribute)


def public_functions(value: Any) -> Iterator[Callable[..., Any]]:
    """A function, or the public methods and the constructor that a class defines itself."""
    if inspect.isfunction(value):
        yield value
    if inspect.isclass(value):
        for own, member in list(vars(value).items()):  # copying adds to it
            function = inspect.unwrap(getattr(member, "__func__", member))
            if not inspect.isfunction(function) or (own.startswith("_") and own != "__init__"):
                continue
            if function.__code__.co_filename == inspect.getsourcefile(value):  # dataclasses generate constructors
                yield function


def sections(of: Any) -> dict[str, Any]:
    """Sections of a docstring by kind, as mkdocs.yml makes griffe read them for the reference."""
    docstring = griffe.Docstring(inspect.getdoc(of) or "")
    parsed = docstring.parse("google", warnings=False, returns_multiple_items=False, returns_named_value=False)
    return {section.kind.value: section.value for section in parsed}


def documented(of: Any) -> set[str]:
    """Names below `Args:`."""
    return {argument.name.lstrip("*") for argument in sections(of).get("parameters", ())}


@pytest.mark.parametrize("name", [*NAMES, *MODULES])
def test_parameters_results_and_fields_are_documented(name: str) -> None:
    """Fields of public names by a docstring below each, or below `Args:` of the class."""
    value = public(name)
    for function in public_functions(value):
        assert inspect.getdoc(function), function.__qualname__
        signature = inspect.signature(function)
        assert documented(function) == signature.parameters.keys() - {"self", "cls"}, function.__qualname__
        if signature.return_annotation not in (None, "None"):
            [returned] = sections(function).get("returns", ())
            assert returned.annotation is None, f"{function.__qualname__}: a colon makes {returned.annotation!r} a type"
    if name in NAMES and dataclasses.is_dataclass(value):
        fields = {field.name for field in dataclasses.fields(value) if field.init}
        args = documented(value)
        assert args <= fields and fields <= {*args, *field_docstrings(value)}, name  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where examples run: with the folder `examples`, and a recording of a camera."""
    folder = tmp_path_factory.mktemp("docstrings")
    shutil.copytree(ROOT / "examples", folder / "examples")
    robot = rd.load_robot("panda")
    ready = rd.Problem(robot, rd.Scene(), "ready", "ready").start
    view = rd.DepthView(np.full((48, 64), 1.4), [50, 50, 31.5, 23.5], rd.pose([1.5, 0, 0.5]), ready)
    write_depth_views(robot, {"camera": [StampedView(stamp, view) for stamp in (0.0, 0.5)]}, folder / "recording.mcap")
    return folder


@pytest.mark.parametrize("name", NAMES)
def test_examples_run(name: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    finder = doctest.DocTestFinder(recurse=False)
    value = public(name)
    tried = 0
    for of in dict.fromkeys([value, *public_functions(value)]):
        for example in finder.find(of, getattr(of, "__qualname__", name), globs={"rd": rd, "np": np}):
            tried += len(example.examples)
            assert doctest.DocTestRunner(optionflags=doctest.ELLIPSIS).run(example).failed == 0, example.name
    untried = "Example:\n" in (inspect.getdoc(value) or "")  # needs a notebook, or real images
    assert tried or untried or not inspect.isfunction(value), f"{name} has no example"
