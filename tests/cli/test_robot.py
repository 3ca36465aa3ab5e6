"""The command `robot`."""

from pathlib import Path

import pytest

from helpers.commands import Said, run
from helpers.made_arms import chain, row, written
from helpers.quick_preparation import QUICK, coarse_grids
from robotdiffuse.robots import load_robot


def test_robot_add_with_srdf_and_robot_list(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], said: Said, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Pairs that an SRDF or the command allows, the comparison with sampling, progress without a terminal."""
    monkeypatch.setenv("ROBOTDIFFUSE_ROBOTS", str(tmp_path / "robots"))
    monkeypatch.setattr("robotdiffuse.robots.fitting.preparation.PreparationSettings", lambda: QUICK)
    file = written(tmp_path, chain("base", row("j", 4), xyz="0 0 0.07", limits='lower="-3" upper="3"'))
    pairs = ("base", "j4_link", "User"), ("base", "j3_link", "Never"), ("base", "j1_link", "Adjacent")
    rows = (f'<disable_collisions link1="{a}" link2="{b}" reason="{why}"/>' for a, b, why in pairs)
    (tmp_path / "made.srdf").write_text(f"<robot name='made'>{''.join(rows)}</robot>")

    with coarse_grids():
        assert run("robot", "add", str(file), "--allow", "j1_link", "j4_link") == 0
    told = capsys.readouterr()
    assert "pairs that differ from made.srdf" in told.out and "User" in told.out and "named 1" in told.out
    assert "5 of 11: spheres of base" in told.err and "11 of 11: done" in told.err
    allowed = load_robot("made").allowed_collisions
    assert frozenset(("j1_link", "j4_link")) in allowed
    assert frozenset(("base", "j4_link")) not in allowed  # found beside: compared, not taken

    given = ("--srdf", str(tmp_path / "made.srdf"), "--name", "by_srdf")
    with coarse_grids():
        assert run("robot", "add", str(file), *given) == 0
    assert frozenset(("base", "j4_link")) in load_robot("by_srdf").allowed_collisions
    assert "unknown link in allow 'moon'" in said(2, "robot", "add", str(file), "--allow", "base", "moon")

    out = said(0, "robot", "list")
    assert all(name in out for name in ("panda", "made", "by_srdf"))
    assert len(str(load_robot("panda")).splitlines()) <= 10


def test_robot_info(said: Said) -> None:
    printed = said(0, "robot", "info", "panda")
    assert "panda_joint7" in printed and "2.8973" in printed and "spheres on" in printed
