"""The commands `explore` and `demo --explore`: exit status, what they print, and the files they write."""

from functools import partial
from pathlib import Path

import pytest

import robotdiffuse as rd
from helpers.commands import START, run, write_problem
from robotdiffuse.visualization.exploration import write_exploration_picture
from robotdiffuse.visualization.picture import PictureSettings

NEAR = {"joints": [-0.95, 0.3, 0.0, -1.8, 0.0, 2.1, 0.8]}


def test_explore_writes_a_replay_a_strip_and_a_recording(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    small = partial(write_exploration_picture, settings=PictureSettings(width=240, height=150, ghosts=1))
    monkeypatch.setattr("robotdiffuse.cli.explore.write_exploration_picture", small)
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    problem = write_problem(tmp_path, goal=NEAR)
    status = run("explore", problem, "--out", "seen.png", "--record", "seen.mcap", "--view")
    printed = capsys.readouterr().out
    assert status in (0, 1) and printed.startswith("1. ") and "of the map" in printed
    assert (status == 0) == ("done: the arm is at the goal" in printed)
    for name in ("seen.png", "seen.mcap", "problem.html"):
        assert f"wrote {name}" in printed and (tmp_path / name).stat().st_size > 10_000
    [first, *_] = rd.read_depth_views("seen.mcap", rd.load_robot("panda"))
    assert first.view.configuration is not None and first.view.configuration.tolist() == START


@pytest.mark.slow
def test_demo_explore_says_what_happened(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    status = run("demo", "--explore")
    printed = capsys.readouterr().out
    assert "look: " in printed and f"The arm is {'' if status == 0 else 'not '}at the goal: " in printed
    assert (tmp_path / "explore.png").is_file() and (tmp_path / "explore.html").is_file()
