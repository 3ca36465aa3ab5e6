"""Presets of `bench run`: all can be run, and the command takes one in place of planners and limits."""

from pathlib import Path

import pytest

from robotdiffuse.cli import main
from robotdiffuse.core.errors import InputError
from robotdiffuse.evaluation.bench import presets
from robotdiffuse.evaluation.bench.presets import PRESETS, Preset, Stage, preset_settings
from robotdiffuse.evaluation.problem_sets import problem_set_name
from robotdiffuse.evaluation.records import read_records


@pytest.mark.parametrize("name", PRESETS)
def test_planners_and_problems_are_known(name: str, tmp_path: Path) -> None:
    pytest.importorskip("ompl")
    stages = preset_settings(name, tmp_path)
    assert stages
    for settings in stages:
        assert settings.specs and all(problem_set_name(text) for text in settings.problems)


def test_a_smaller_count_and_further_problems(tmp_path: Path) -> None:
    counts = [settings.count for settings in preset_settings("anytime", tmp_path, ("shelf",), count=50)]
    assert counts == [50]
    problems = preset_settings("anytime", tmp_path, ("shelf",))[0].problems
    assert problems == ("rop_nontrivial", "rop_dense_nontrivial", "shelf")


@pytest.mark.slow
def test_the_command_runs_every_stage(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stages = Stage(("rrt_connect",), 0.5, 2), Stage(("aorrtc",), 0.2, 5)
    monkeypatch.setitem(presets.PRESETS, "small", Preset("for tests", ("rop",), stages))
    assert main(["bench", "run", "--preset", "small", "--count", "2", "--out", str(tmp_path)]) == 0
    found = read_records(tmp_path)
    assert {name: len(records) for name, records in found.items()} == {"aorrtc": 2, "rrt_connect": 2}


def test_bad_input(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(InputError, match="unknown preset 'table2'; known: anytime"):
        preset_settings("table2", tmp_path)
    asked = ["bench", "run", "--out", str(tmp_path)]
    assert main([*asked, "--planners", "rrt_connect"]) == 2
    assert "name --planners and --problems, or a --preset" in capfd.readouterr().err
    assert main([*asked, "--preset", "anytime", "--planners", "rrt_connect"]) == 2
    assert "--preset cannot be combined with --planners" in capfd.readouterr().err
