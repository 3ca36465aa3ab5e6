"""The command `planner`."""

import subprocess
import sys
from pathlib import Path

import pytest

from helpers.commands import Said, run, write_problem
from robotdiffuse.cli import COMMANDS
from robotdiffuse.core import registry
from robotdiffuse.planning import PLANNERS


def test_planner_list_shows_them_all_without_loading_them() -> None:
    code = "from robotdiffuse.cli import *; main(['planner', 'list']); sys.exit('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert all(name in done.stdout for name in PLANNERS)


def test_settings_of_a_planner_are_listed(said: Said) -> None:
    printed = said(0, "planner", "info", "rrt_connect")
    assert "range" in printed and "0.7" in printed and "Longest extension of a tree" in printed
    assert "unknown planner 'teleport'" in said(2, "planner", "info", "teleport")
    assert said(2, "planner", "info", "aorrt").endswith("did you mean aorrtc?\n")


@pytest.mark.parametrize(
    ("words", "meant"), [(("plna",), "plan"), (("plan", "x.yaml", "--tme-limit=3"), "--time-limit")]
)
def test_misspelled_words_get_a_suggestion(words: tuple[str, ...], meant: str, said: Said) -> None:
    assert f"did you mean {meant}?" in said(2, *words)


def test_help_lists_every_command_below_a_topic(said: Said) -> None:
    printed = said(0, "--help")
    topics = [line for line in printed.splitlines() if line.endswith(":") and not line.startswith(" ")]
    assert topics[1:] == [f"{topic}:" for topic in COMMANDS]
    assert "\n  plan         plan a motion" in printed


def test_a_module_of_the_current_folder_adds_planners(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, said: Said
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.setattr(registry, "imported", [])
    (tmp_path / "added_planners.py").write_text(
        "from dataclasses import replace\nfrom robotdiffuse.planning import PLANNERS\n"
        "PLANNERS['mine'] = replace(PLANNERS['aorrtc'], description='my own')\n"
    )
    try:
        assert "my own" in said(0, "planner", "list", "--import", "added_planners")
        assert run("plan", write_problem(tmp_path), "--planner", "mine", "--import", "added_planners") == 0
    finally:
        PLANNERS.pop("mine", None)
    assert "module 'no_such_module' cannot be imported: ModuleNotFoundError" in said(
        2, "planner", "list", "--import", "no_such_module"
    )
