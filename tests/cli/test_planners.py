"""The command `planners`."""

import subprocess
import sys
from pathlib import Path

import pytest

from helpers.commands import run
from robotdiffuse.planning import PLANNERS


@pytest.fixture(autouse=True)
def in_empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def test_planners_lists_them_all_without_loading_them() -> None:
    code = (
        "import sys; from robotdiffuse.cli import main; main(['planners']); assert 'torch' not in sys.modules"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert all(name in done.stdout for name in PLANNERS)


def test_settings_of_a_planner_are_listed(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("planners", "rrt_connect") == 0
    printed = capsys.readouterr().out
    assert "range" in printed and "0.7" in printed and "Longest extension of a tree" in printed
    assert run("planners", "teleport") == 2
    assert "unknown planner 'teleport'" in capsys.readouterr().err
