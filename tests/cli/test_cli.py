"""The command line as a whole: bad calls, help, closed output and Ctrl-C."""

import subprocess
import sys
from pathlib import Path

import pytest

from helpers.commands import run, write_problem

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
    "motion of a name that no file has": (
        ["verify", "--problem", "problem.json", "w" * 5000], "wwww... File name too long"
    ),
    "option of 5,000 characters": (["plan", "problem.json", "w" * 5000], "unrecognized arguments: wwwwwwww"),
    "weights that are none": (
        ["plan", "problem.json", "--planner", "diffusion", "--weights", "."],
        "holds no model",
    ),
    "unknown planner": (["plan", "problem.json", "--planner", "rrt"], "known: a_star, aorrtc, control"),
    "no time": (["plan", "problem.json", "--time-limit", "0"], "'0' is not a positive number"),
    "unknown end": (["plan", "problem.json", "--until", "soon"], "'first', 'converged', 'time_limit'"),
    "negative clearance": (["plan", "problem.json", "--clearance", "-1"], "'-1' is not a number of at le"),
    "scaled too far": (["plan", "problem.json", "--velocity-scaling", "2"], "'2' is not between 0 and 1"),
    "endless time": (["plan", "problem.json", "--time-limit", "inf"], "'inf' is not a positive number"),
    "negative seed": (["plan", "problem.json", "--seed", "-1"], "-1"),
    "unknown ending": (["plan", "problem.json", "--out", "r.xml"], "unknown ending '.xml'; known: .json"),
    "missing folder": (["plan", "problem.json", "--out", "no/r.json"], "the folder no does not exist"),
    "index out of range": (["plan", "problem.json", "--index", "1"], "index is 1"),
    "unknown option": (["plan", "problem.json", "--fast"], "--fast"),
    "not a result": (["verify", "problem.json"], "is not a result file"),
    "unknown robot": (["robot", "info", "pandaa"], "pandaa"),
    "missing urdf": (["robot", "add", "missing.urdf"], "missing.urdf"),
    "no workers": (["data", "generate", "--out", "d", "--workers", "0"], "'0' is not an integer"),
    "train without out": (["train", "encoder"], "--out"),
    "train twice as long": (
        ["train", "encoder", "--out", "e", "--minutes", "1", "--samples", "9"], "not allowed with"
    ),
    "unknown sampler": ([*TRAIN, "--sampler", "heun"], "known: ddim, ddpm"),
    "unknown objective": ([*TRAIN, "--objective", "score"], "known: clean, noise"),
    "unknown denoiser": ([*TRAIN, "--denoiser", "net"], "known: cross_attention, decoder_only"),
    "unknown target": ([*TRAIN, "--target", "line"], "known: absolute, limits, residual"),
    "too few waypoints": ([*TRAIN, "--waypoints", "2"], "waypoints is 2"),
    "no condition at all": ([*TRAIN, "--condition-drop", "1"], "condition_drop is 1.0"),
    "unknown device": ([*TRAIN, "--device", "tpu"], "known: cpu, cuda"),
    "no data workers": ([*TRAIN, "--workers", "0"], "'0' is not an integer of at least 1"),
    "workers for existing data": ([*TRAIN, "--workers", "2"], "--workers is for data to be generated"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD_CALL)
def test_bad_call_is_status_2_in_one_line(
    case: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_problem(tmp_path)
    argv, named = BAD_CALL[case]
    assert run(*argv) == 2
    error = capsys.readouterr().err
    assert "error: " in error and named in error and error.count("\n") == 1


def test_help_and_version(capsys: pytest.CaptureFixture[str]) -> None:
    for argv in (["--help"], ["plan", "--help"], ["robot", "add", "--help"], ["train", "planner", "--help"]):
        assert run(*argv) == 0
    assert "--time-limit" in capsys.readouterr().out
    assert run("--version") == 0
    assert capsys.readouterr().out.startswith("robotdiffuse 0.")


@pytest.mark.slow
def test_data_generate_is_resumed_and_refuses_other_settings(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ("data", "generate", "--out", "set", "--trajectories", 4, "--shard", 2, "--workers", 1)
    assert run(*command) == 0
    first = capsys.readouterr().out
    assert first == "4 trajectories of 254 waypoints in set\n" and run(*command) == 0
    assert capsys.readouterr().out == first
    assert run(*command, "--seed", 1) == 2
    assert "seed 0, not 1" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("command", "status", "said"),
    [
        ("{} > /dev/full", 3, "the output could not be written: No space left on device"),
        (
            "{} | true; exit ${{PIPESTATUS[0]}}",
            3,
            "",
        ),
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
