"""Each example runs, solves its problem and writes its picture, which the gallery shows; public functions document their
parameters in Google's style, and their examples run."""

import doctest
import inspect
import runpy
from collections.abc import Callable, Iterator
from pathlib import Path

import griffe
import numpy as np
import pytest

import robotdiffuse as rd
from helpers.quick_preparation import QUICK, coarse_grids
from robotdiffuse.robots.fitting.preparation import add_robot

ROOT = Path(__file__).parents[2]
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
SLOW = {"01_own_robot", "05_depth_camera", "09_two_arms", "12_train_on_own_data", "13_mujoco"}
"""They prepare a robot, load networks, compile the code for several arms, or train."""


@pytest.mark.usefixtures("small_pictures")
@pytest.mark.parametrize("example", [pytest.param(e, id=e.stem, marks=[pytest.mark.slow] * (e.stem in SLOW)) for e in EXAMPLES])
def test_an_example_runs(
    example: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("ROBOTDIFFUSE_ROBOTS", str(tmp_path / "robots"))
    if example.stem == "01_own_robot":
        with coarse_grids():
            add_robot(str(ROOT / "examples" / "data" / "arm.urdf"), settings=QUICK)
    runpy.run_path(str(example), run_name="__main__")
    assert "solved" in (printed := capsys.readouterr().out) or "valid" in printed, printed
    if example.stem[0].isdigit():
        assert (tmp_path / f"{example.stem}.png").stat().st_size > 1000


def test_the_gallery_has_thirteen_short_examples_with_pictures() -> None:
    numbered = [file for file in EXAMPLES if file.stem[0].isdigit()]
    assert len(numbered) == 13
    for file in numbered:
        assert len(file.read_text(encoding="utf-8").splitlines()) < 40, file.name
        assert (ROOT / "docs" / "images" / "gallery" / f"{file.stem}.png").is_file(), file.name


def test_the_first_motion_of_the_readme_keeps_the_asked_clearance() -> None:
    assert "plan examples/ball.yaml --until first" in (ROOT / "README.md").read_text()
    assert rd.plan(rd.Problem.load(ROOT / "examples" / "ball.yaml"), until="first").scene_clearance >= 0.01


NAMES = sorted(getattr(rd, "__all__"))  # noqa: B009  (the stub does not name it)


def public_functions(name: str) -> Iterator[Callable[..., object]]:
    """The function with a public name, or the public methods that a class defines itself."""
    value = getattr(rd, name)
    if inspect.isfunction(value):
        yield value
    if inspect.isclass(value):
        for own, member in list(vars(value).items()):  # copying adds to it
            function = getattr(member, "__func__", member)
            if inspect.isfunction(function) and not own.startswith("_"):
                yield inspect.unwrap(function)


def parameters(function: Callable[..., object]) -> set[str]:
    return {name for name in inspect.signature(function).parameters if name not in ("self", "cls")}


def documented(function: Callable[..., object]) -> set[str]:
    """Names below `Args:`, as griffe reads them for the reference."""
    sections = griffe.Docstring(inspect.getdoc(function) or "").parse("google", warnings=False)
    return {
        argument.name.lstrip("*")
        for section in sections
        if section.kind is griffe.DocstringSectionKind.parameters
        for argument in section.value
    }


@pytest.mark.parametrize("name", NAMES)
def test_every_parameter_is_documented(name: str) -> None:
    for function in public_functions(name):
        assert inspect.getdoc(function), function.__qualname__
        assert documented(function) == parameters(function), function.__qualname__


@pytest.mark.parametrize("name", NAMES)
def test_examples_run(name: str) -> None:
    finder = doctest.DocTestFinder(recurse=False)
    for function in public_functions(name):
        for example in finder.find(function, function.__qualname__, globs={"rd": rd, "np": np}):
            assert doctest.DocTestRunner(optionflags=doctest.ELLIPSIS).run(example).failed == 0, function.__qualname__
