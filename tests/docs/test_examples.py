"""Each example runs, solves its problem and writes its picture, and the gallery shows it."""

import runpy
from pathlib import Path

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
