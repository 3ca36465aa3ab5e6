"""The command line as a whole: bad calls, help, closed output and Ctrl-C."""

import subprocess
import sys
from pathlib import Path

import pytest

from helpers.commands import Said, write_problem

TRAIN = ["train", "planner", "--data", "d", "--encoder", "dgcnn", "--out", "o"]


BAD_CALL = {
    "no command": ([], "COMMAND"),
    "unknown command": (["plann"], "plann"),
    "missing file": (["plan", "missing.yaml"], "missing.yaml"),
    "weights of a planner without": (
        ["plan", "problem.json", "--planner", "rrt_connect", "--weights", "w"],
        "planner rrt_connect has no weights",
    ),
    "weights of a name that no file has": (
        ["plan", "problem.json", "--planner", "diffusion", "--weights", "w" * 5000],
        "wwww... File name too long",
    ),
    "weights that are none": (
        ["plan", "problem.json", "--planner", "diffusion", "--weights", "."],
        "holds no model",
    ),
    "unknown planner": (["plan", "problem.json", "--planner", "rrt"], "known: a_star, aorrtc, control"),
    "no time": (["plan", "problem.json", "--time-limit", "0"], "'0' is not a positive number"),
    "negative clearance": (["plan", "problem.json", "--clearance", "-1"], "'-1' is not a number of at le"),
    "unknown ending": (["plan", "problem.json", "--out", "r.xml"], "unknown ending '.xml'; known: .json"),
    "missing folder": (["plan", "problem.json", "--out", "no/r.json"], "the folder no does not exist"),
    "unknown option": (["plan", "problem.json", "--fast"], "--fast"),
    "unknown robot": (["robot", "info", "pandaa"], "pandaa"),
    "no workers": (["data", "generate", "--out", "d", "--workers", "0"], "'0' is not an integer"),
    "train without out": (["train", "encoder"], "--out"),
    "train twice as long": (
        ["train", "encoder", "--out", "e", "--minutes", "1", "--samples", "9"], "not allowed with"
    ),
    "no data": (["data", "info", "."], "no data set"),
    "no data file": (["data", "import", "x.npz", "--out", "y"], "x.npz does not exist"),
    "ending of a replay": (["explore", "problem.json", "--out", "seen.gif"], ".html, .png"),
    "ending of a recording": (["explore", "problem.json", "--record", "seen.bag"], ".mcap"),
    "unknown policy": (["explore", "problem.json", "--policy", "bold"], "unknown explorer.policy"),
    "policies that exclude each other": (
        ["explore", "problem.json", "--policy", "probabilistic", "--see-goal"], "it needs policy 'strict'"
    ),
    "files of a live page": (["explore", "problem.json", "--live", "--view"], "--live writes no files"),
    "speed of no page": (["explore", "problem.json", "--speed", "2"], "add --live"),
    "two demos": (["demo", "--explore", "--camera"], ""),
    "unknown sampler": ([*TRAIN, "--sampler", "heun"], "known: ddim, ddpm"),
    "too few waypoints": ([*TRAIN, "--waypoints", "2"], "waypoints is 2"),
    "unknown device": ([*TRAIN, "--device", "tpu"], "known: cpu, cuda"),
    "workers for existing data": ([*TRAIN, "--workers", "2"], "--workers is for data to be generated"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD_CALL)
def test_bad_call_is_status_2_in_one_line(case: str, tmp_path: Path, said: Said) -> None:
    write_problem(tmp_path)
    argv, named = BAD_CALL[case]
    error = said(2, *argv)
    assert "error: " in error and named in error and error.count("\n") == 1


def test_help_and_version(said: Said) -> None:
    assert "--time-limit" in said(0, "plan", "--help")
    assert said(0, "--version").startswith("robotdiffuse 0.")


@pytest.mark.parametrize(
    ("command", "status", "said"),
    [
        ("{} > /dev/full", 3, "the output could not be written: No space left on device"),
        ("{} | true; exit ${{PIPESTATUS[0]}}", 3, ""),
        ("{} >&-", 0, ""),
        ("PYTHONIOENCODING=ascii {} > /dev/null", 0, ""),
    ],
)
def test_output_that_leads_nowhere(command: str, status: int, said: str) -> None:
    """No traceback, and not the status of a problem without a plan."""
    line = command.format(f"{sys.executable} -m robotdiffuse robot info panda")
    ended = subprocess.run(["bash", "-c", line], capture_output=True, text=True)
    assert (ended.returncode, ended.stderr.strip()) == (status, f"robotdiffuse: {said}" if said else "")


def test_ctrl_c_while_the_command_line_is_imported_is_one_line() -> None:
    code = """
import sys
class Interrupted:
    def find_spec(self, name, *_):
        if name == "robotdiffuse.cli":
            raise KeyboardInterrupt
sys.meta_path.insert(0, Interrupted())
from robotdiffuse.__main__ import main
sys.exit(main())
"""
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (ended.returncode, ended.stdout, ended.stderr) == (130, "", "robotdiffuse: stopped\n")
