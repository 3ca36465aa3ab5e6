"""The command `planner`."""

import subprocess
import sys
from pathlib import Path

import pytest

from helpers.commands import run, write_problem
from robotdiffuse.cli import COMMANDS
from robotdiffuse.core import registry
from robotdiffuse.planning import PLANNERS


def test_planner_list_shows_them_all_without_loading_them() -> None:
    code = "from robotdiffuse.cli import *; main(['planner', 'list']); sys.exit('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert all(name in done.stdout for name in PLANNERS)


def test_settings_of_a_planner_are_listed(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("planner", "info", "rrt_connect") == 0
    printed = capsys.readouterr().out
    assert "range" in printed and "0.7" in printed and "Longest extension of a tree" in printed
    assert run("planner", "info", "teleport") == 2
    assert "unknown planner 'teleport'" in capsys.readouterr().err
    assert run("planner", "info", "aorrt") == 2
    assert capsys.readouterr().err.endswith("did you mean aorrtc?\n")


@pytest.mark.parametrize(
    ("words", "meant"), [(("plna",), "plan"), (("plan", "x.yaml", "--tme-limit=3"), "--time-limit")]
)
def test_misspelled_words_get_a_suggestion(
    words: tuple[str, ...], meant: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(*words) == 2
    assert f"did you mean {meant}?" in capsys.readouterr().err


def test_help_lists_every_command_below_a_topic(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("--help") == 0
    printed = capsys.readouterr().out
    topics = [line for line in printed.splitlines() if line.endswith(":") and not line.startswith(" ")]
    assert topics[1:] == [f"{topic}:" for topic in COMMANDS]
    assert "\n  plan         plan a motion" in printed


def test_a_module_of_the_current_folder_adds_planners(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.setattr(registry, "imported", [])
    (tmp_path / "added_planners.py").write_text(
        "from dataclasses import replace\nfrom robotdiffuse.planning import PLANNERS\n"
        "PLANNERS['mine'] = replace(PLANNERS['aorrtc'], description='my own')\n"
    )
    try:
        assert run("planner", "list", "--import", "added_planners") == 0
        assert "my own" in capsys.readouterr().out
        assert run("plan", write_problem(tmp_path), "--planner", "mine", "--import", "added_planners") == 0
    finally:
        PLANNERS.pop("mine", None)
    assert run("planner", "list", "--import", "no_such_module") == 2
    assert "module 'no_such_module' cannot be imported: ModuleNotFoundError" in capsys.readouterr().err
