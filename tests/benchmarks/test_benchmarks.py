"""Every benchmark runs, at its smallest size. Times are not asserted."""

import runpy
import subprocess
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[2] / "benchmarks"
SCRIPTS = sorted(file.stem for file in FOLDER.glob("*.py") if file.stem != "common")
NEEDS = {script: ("pybullet",) for script in ("constraints", "moving_obstacles", "peers", "robots")}
NEEDS |= {"certificates": ("ompl",), "mujoco_models": ("mujoco",), "planning_requests": ("pybullet", "pinocchio")}
NEEDS |= {"scene_code": ("accelerate", "matplotlib", "zarr"), "server": ("fastapi", "httpx")}
"""Packages of extras that a script needs."""
APART = {"robustness", "scene_code", "server", "startup", "urdf_import"}
"""They start or measure processes, or train on other shapes of inputs. For the others, a process would load all code again."""
REPORTS = FOLDER / "results"


@pytest.mark.slow
@pytest.mark.timeout(1200)
@pytest.mark.parametrize("script", SCRIPTS)
def test_script_runs(script: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    for package in NEEDS.get(script, ()):
        pytest.importorskip(package)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(FOLDER)
    command = [str(FOLDER / f"{script}.py"), "--smoke"]
    if script in APART:
        done = subprocess.run([sys.executable, *command], capture_output=True, text=True)
        assert done.returncode == 0, done.stderr[-3000:]
        printed = done.stdout
    else:
        monkeypatch.setattr(sys, "argv", command)
        runpy.run_path(command[0], run_name="__main__")
        printed = capsys.readouterr().out
    assert "Python 3" in printed, "no head with machine and versions"


def test_usages_and_reports_name_their_scripts_and_the_list_names_all() -> None:
    """The first line of a report names the script that prints it, or says that this is no longer kept."""
    assert not [name for name in SCRIPTS if f"python benchmarks/{name}.py" not in (FOLDER / f"{name}.py").read_text()]
    firsts = {file.name: file.read_text().partition("\n")[0] for file in REPORTS.glob("*.txt")}
    made = (*(f"benchmarks/{name}.py" for name in SCRIPTS), "no longer kept")
    assert not {name: first for name, first in firsts.items() if not any(by in first for by in made)}
    listed = (FOLDER / "README.md").read_text()
    assert not [name for name in SCRIPTS if f"`{name}.py`" not in listed]
    names = [file.name for file in REPORTS.iterdir() if file.suffix in (".csv", ".png", ".txt", ".md")]
    assert not [n for n in names if n not in listed and Path(n).stem not in listed and "baseline_" not in n]
