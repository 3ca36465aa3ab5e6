"""The command `planners`."""

import subprocess
import sys
from pathlib import Path

import pytest

from helpers.commands import run, write_problem
from robotdiffuse.core import registry
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
        assert run("planners", "--import", "added_planners") == 0
        assert "my own" in capsys.readouterr().out
        assert run("plan", write_problem(tmp_path), "--planner", "mine", "--import", "added_planners") == 0
    finally:
        PLANNERS.pop("mine", None)
    assert run("planners", "--import", "no_such_module") == 2
    assert "module 'no_such_module' cannot be imported: ModuleNotFoundError" in capsys.readouterr().err
