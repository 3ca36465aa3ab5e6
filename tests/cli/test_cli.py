"""The command line, run as a user would: exit status, one line for bad input, files that come out."""

import json
import runpy
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from helpers.made_arms import chain, row, written
from helpers.quick_preparation import QUICK
from robotdiffuse.cli import main
from robotdiffuse.core.results import PlanResult, load_result
from robotdiffuse.core.types import Status
from robotdiffuse.learning.denoisers.unet import UNetSettings
from robotdiffuse.learning.training.config import PlannerTraining
from robotdiffuse.learning.training.configs import CONFIGS
from robotdiffuse.planning import PLANNERS, planner_settings
from robotdiffuse.robots import load_robot

ROOT = Path(__file__).parents[2]
EXAMPLES = sorted(ROOT.glob("examples/*.yaml")) + sorted(ROOT.glob("src/robotdiffuse/examples/*.yaml"))

TRAIN = ["train", "planner", "--data", "d", "--encoder", "dgcnn", "--out", "o"]
START = [-1.0, 0.3, 0.0, -1.8, 0.0, 2.1, 0.8]
GOAL = [1.0, 0.3, 0.0, -1.8, 0.0, 2.1, 0.8]
BALL = {"sphere": {"center": [0.5, 0.0, 0.5], "radius": 0.15}}
PROBLEM = {"robot": "panda", "scene": [BALL], "start": START, "goal": {"joints": GOAL}}


def run(*argv: object) -> int:
    """Exit status of the command."""
    try:
        return main([str(value) for value in argv])
    except SystemExit as end:
        assert isinstance(end.code, int)
        return end.code


def write(folder: Path, name: str = "problem.json", **changes: object) -> Path:
    file = folder / name
    file.write_text(json.dumps(PROBLEM | changes))
    return file


@pytest.fixture(autouse=True)
def in_empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def test_plan_writes_files_that_view_and_verify_read(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    problem = write(tmp_path)
    status = run(
        "plan", problem, "--planner", "rrt_connect", "--time-limit", 5, "--seed", 1,
        "--out", "r.json", "--out", "r.csv", "--out", "replay.html",
    )  # fmt: skip
    printed = capsys.readouterr().out
    assert status == 0 and "solved" in printed and "rrt_connect" in printed
    saved = load_result("r.json")
    assert saved.result.seed == 1 and saved.result.trajectory is not None
    assert np.array_equal(saved.result.trajectory.positions[0], START)
    assert np.allclose(saved.result.trajectory.positions[-1], GOAL)
    assert saved.problem is not None and saved.problem["scene"][0]["sphere"]["radius"] == 0.15
    assert (tmp_path / "r.csv").read_text().startswith("time,panda_joint1_position,")
    assert "<html" in (tmp_path / "replay.html").read_text()[:200]

    assert run("verify", "r.json") == 0
    assert capsys.readouterr().out.count("valid") == 2
    assert run("view", "r.json", "--out", "again.html") == 0
    assert (tmp_path / "again.html").stat().st_size > 10_000


def test_verify_finds_a_motion_that_was_tampered_with(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    problem = write(tmp_path)
    assert run("plan", problem, "--planner", "rrt_connect", "--time-limit", 5, "--out", "r.json") == 0
    record = json.loads(Path("r.json").read_text())
    record["waypoints"] = [START, GOAL]  # straight through the ball
    Path("r.json").write_text(json.dumps(record))
    capsys.readouterr()
    assert run("verify", "r.json") == 1
    printed = capsys.readouterr().out
    assert "path: not valid" in printed and "inside sphere" in printed and "trajectory: valid" in printed


def test_same_seed_same_motion(tmp_path: Path) -> None:
    problem = write(tmp_path)
    for file in ("a.json", "b.json"):
        assert run("plan", problem, "--planner", "rrt_connect", "--time-limit", 5, "--out", file) == 0
    a, b = (load_result(file).result.path for file in ("a.json", "b.json"))
    assert a is not None and b is not None and np.array_equal(a.positions, b.positions)


NO_PLAN = {
    "start in collision": (
        {"scene": [{"sphere": {"center": [0.3, -0.45, 0.5], "radius": 0.2, "name": "melon"}}]},
        "invalid_start",
        "melon",
    ),
    "goal in collision": (
        {"scene": [{"sphere": {"center": [0.3, 0.45, 0.5], "radius": 0.2, "name": "melon"}}]},
        "invalid_goal",
        "melon",
    ),
    "pose out of reach": (
        {"goal": {"pose": {"frame": "panda_hand", "xyz": [2.0, 0.0, 0.5], "wxyz": [1, 0, 0, 0]}}},
        "unreachable_goal",
        "panda_hand",
    ),
}


@pytest.mark.parametrize("case", NO_PLAN)
def test_no_plan_is_status_1_with_the_reason(
    case: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    changes, status, named = NO_PLAN[case]
    assert run("plan", write(tmp_path, **changes), "--planner", "rrt_connect", "--out", "r.json") == 1
    printed = capsys.readouterr().out
    assert status in printed and named in printed
    saved = load_result("r.json")
    assert saved.result.status.value == status and saved.result.path is None
    assert run("view", "r.json") == 2
    assert f"its status is {status}" in capsys.readouterr().err


BAD_PROBLEM = {
    "unknown robot": ({"robot": "pandaa"}, "pandaa"),
    "unknown field": ({"obstacles": []}, "obstacles"),
    "unknown shape": ({"scene": [{"blob": {"center": [0, 0, 0]}}]}, "blob"),
    "wrong length": ({"start": [0.0, 0.0]}, "start has 2 values"),
    "not a number": ({"start": [float("nan")] * 7}, "nan"),
    "out of limits": ({"start": [4.0, *START[1:]]}, "panda_joint1 is 4 rad"),
    "unknown link": ({"goal": {"pose": {"frame": "hand", "xyz": [0, 0, 0], "wxyz": [1, 0, 0, 0]}}}, "hand"),
    "unknown goal": ({"goal": {"place": GOAL}}, "place"),
}


@pytest.mark.parametrize("case", BAD_PROBLEM)
def test_bad_problem_is_status_2_in_one_line(
    case: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    changes, named = BAD_PROBLEM[case]
    assert run("plan", write(tmp_path, **changes), "--planner", "rrt_connect") == 2
    error = capsys.readouterr().err
    assert error.startswith("robotdiffuse: error: ") and named in error and error.count("\n") == 1


BAD_CALL = {
    "no command": ([], "COMMAND"),
    "unknown command": (["plann"], "plann"),
    "missing file": (["plan", "missing.yaml"], "missing.yaml"),
    "weights of a planner without": (
        ["plan", "problem.json", "--planner", "rrt_connect", "--weights", "w"],
        "planner rrt_connect has no weights",
    ),
    "weights that are none": (["plan", "problem.json", "--weights", "."], "holds no model"),
    "unknown planner": (["plan", "problem.json", "--planner", "rrt"], "known: a_star, aorrtc, d_star_lite"),
    "no time": (["plan", "problem.json", "--time-limit", "0"], "'0' is not a positive number"),
    "unknown end": (["plan", "problem.json", "--until", "soon"], "'first', 'short', 'limit'"),
    "negative clearance": (["plan", "problem.json", "--clearance", "-1"], "'-1' is not a number of at le"),
    "scaled too far": (["plan", "problem.json", "--velocity-scaling", "2"], "'2' is not between 0 and 1"),
    "endless time": (["plan", "problem.json", "--time-limit", "inf"], "'inf' is not a positive number"),
    "negative seed": (["plan", "problem.json", "--seed", "-1"], "-1"),
    "unknown ending": (["plan", "problem.json", "--out", "r.xml"], "unknown ending '.xml'; known: .json"),
    "missing folder": (["plan", "problem.json", "--out", "no/r.json"], "the folder no does not exist"),
    "index out of range": (["plan", "problem.json", "--index", "1"], "index is 1"),
    "unknown option": (["plan", "problem.json", "--fast"], "--fast"),
    "not a result": (["view", "problem.json"], "is not a result file"),
    "unknown robot": (["robot", "info", "pandaa"], "pandaa"),
    "missing urdf": (["robot", "add", "missing.urdf"], "missing.urdf"),
    "no workers": (["data", "generate", "--out", "d", "--workers", "0"], "'0' is not an integer"),
    "train without out": (["train", "encoder"], "--out"),
    "train twice as long": (
        ["train", "encoder", "--out", "e", "--minutes", "1", "--samples", "9"], "not allowed with"
    ),
    "unknown sampler": ([*TRAIN, "--sampler", "heun"], "known: ddim, ddpm"),
    "unknown objective": ([*TRAIN, "--objective", "score"], "known: clean, noise"),
    "unknown denoiser": ([*TRAIN, "--denoiser", "net"], "known: decoder_only, encoder_decoder, transformer"),
    "unknown target": ([*TRAIN, "--target", "line"], "known: absolute, limits, residual"),
    "too few waypoints": ([*TRAIN, "--waypoints", "2"], "waypoints is 2"),
    "no condition at all": ([*TRAIN, "--condition-drop", "1"], "condition_drop is 1.0"),
    "unknown device": ([*TRAIN, "--device", "tpu"], "known: cpu, cuda"),
    "no data workers": ([*TRAIN, "--workers", "0"], "'0' is not an integer of at least 1"),
    "workers for existing data": ([*TRAIN, "--workers", "2"], "--workers is for data that are made"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD_CALL)
def test_bad_call_is_status_2_in_one_line(
    case: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write(tmp_path)
    argv, named = BAD_CALL[case]
    assert run(*argv) == 2
    error = capsys.readouterr().err
    assert "error: " in error and named in error and error.count("\n") == 1


def test_unknown_config_lists_them_with_what_they_are(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(*TRAIN, "--config", "papre") == 2
    error = capsys.readouterr().err
    assert error.startswith("robotdiffuse: error: unknown config 'papre'; known:\n")
    for name, config in CONFIGS.items():
        assert f"  {name}: {config.description}\n" in error


def test_parts_replace_those_of_the_config(monkeypatch: pytest.MonkeyPatch) -> None:
    trained: list[PlannerTraining] = []

    def train_planner(settings: PlannerTraining, out: str) -> dict[str, float]:
        trained.append(settings)
        return {}

    monkeypatch.setattr("robotdiffuse.learning.training.planner.train_planner", train_planner)
    parts = ["--objective", "noise", "--sampler", "ddim", "--waypoints", "64", "--condition-drop", "0.2"]
    parts += ["--target", "residual"]
    assert run(*TRAIN, "--config", "paper", "--denoiser", "unet", *parts, "--device", "cpu") == 0
    assert run(*TRAIN, "--config", "paper") == 0
    assert run(*TRAIN, "--config", "table2_unet", "--denoiser", "decoder_only") == 0
    changed, paper, row = trained
    assert changed == replace(
        paper,
        denoiser="unet",
        denoiser_settings=UNetSettings.paper_size(),
        objective="noise",
        sampler="ddim",
        target="residual",
        waypoints=64,
        condition_drop=0.2,
        device="cpu",
    )
    assert row.denoiser == "decoder_only" and row.denoiser_settings is None


def test_problem_of_a_jsonl_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "problems.jsonl"
    blocked = PROBLEM | {"scene": NO_PLAN["start in collision"][0]["scene"]}
    file.write_text(f"{json.dumps(PROBLEM)}\n{json.dumps(blocked)}\n")
    assert run("plan", file, "--planner", "rrt_connect", "--time-limit", 5) == 0
    assert run("plan", file, "--planner", "rrt_connect", "--index", 1) == 1
    assert "invalid_start" in capsys.readouterr().out


def test_ctrl_c(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("robotdiffuse.cli.plan.solve", interrupted)
    assert run("plan", write(tmp_path), "--planner", "rrt_connect") == 130
    assert capsys.readouterr().err == "robotdiffuse: stopped\n"


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


def test_plan_takes_settings_of_the_planner(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    given: list[object] = []

    def solve(_problem: object, planner: str, *rest: object, **_request: object) -> PlanResult:
        given.extend(rest)
        return PlanResult(Status.NO_PATH, "none", planner, "panda", 0.1, 0)

    monkeypatch.setattr("robotdiffuse.cli.plan.solve", solve)
    sets = ("--set", "search.range=0.5", "--set", "samples=4")
    assert run("plan", write(tmp_path), *sets) == 1
    settings = planner_settings("robotdiffuse", ["samples=4", "search.range=0.5"])
    assert settings in given and settings != planner_settings("robotdiffuse", [])


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ("rangee=0.5", "has no setting 'rangee'; it has range=0.7, resolution=0.05, "),
        ("range=0", "rrt_connect.range is 0.0; it must be positive"),
        ("range", "'range' is not NAME=VALUE; rrt_connect has range=0.7, "),
    ],
)
def test_wrong_settings_are_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], value: str, message: str
) -> None:
    assert run("plan", write(tmp_path), "--planner", "rrt_connect", "--set", value) == 2
    assert message in capsys.readouterr().err


def test_help_and_version(capsys: pytest.CaptureFixture[str]) -> None:
    for argv in (["--help"], ["plan", "--help"], ["robot", "add", "--help"], ["train", "planner", "--help"]):
        assert run(*argv) == 0
    assert "--time-limit" in capsys.readouterr().out
    assert run("--version") == 0
    assert capsys.readouterr().out.startswith("robotdiffuse 0.")


def test_robot_add_with_srdf_and_robot_list(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Pairs that an SRDF or the command allows, the comparison with sampling, progress without a terminal."""
    monkeypatch.setenv("ROBOTDIFFUSE_ROBOTS", str(tmp_path / "robots"))
    monkeypatch.setattr("robotdiffuse.robots.fitting.add.PreparationSettings", lambda: QUICK)
    file = written(tmp_path, chain("base", row("j", 4), xyz="0 0 0.07", limits='lower="-3" upper="3"'))
    pairs = ("base", "j4_link", "User"), ("base", "j3_link", "Never"), ("base", "j1_link", "Adjacent")
    rows = (f'<disable_collisions link1="{a}" link2="{b}" reason="{why}"/>' for a, b, why in pairs)
    (tmp_path / "made.srdf").write_text(f"<robot name='made'>{''.join(rows)}</robot>")

    assert run("robot", "add", str(file), "--allow", "j1_link", "j4_link") == 0
    told = capsys.readouterr()
    assert "differences from made.srdf" in told.out and "User" in told.out and "named 1" in told.out
    assert "5 of 11: spheres of base" in told.err and "11 of 11: done" in told.err
    allowed = load_robot("made").allowed_collisions
    assert frozenset(("j1_link", "j4_link")) in allowed
    assert frozenset(("base", "j4_link")) not in allowed  # found beside: compared, not taken

    given = ("--srdf", str(tmp_path / "made.srdf"), "--name", "by_srdf")
    assert run("robot", "add", str(file), *given) == 0
    capsys.readouterr()
    assert frozenset(("base", "j4_link")) in load_robot("by_srdf").allowed_collisions
    assert run("robot", "add", str(file), "--allow", "base", "moon") == 2
    assert "unknown link in allow 'moon'" in capsys.readouterr().err

    assert run("robot", "list") == 0
    out = capsys.readouterr().out
    assert all(name in out for name in ("panda", "made", "by_srdf"))
    assert len(repr(load_robot("panda")).splitlines()) <= 10


def test_robot_info(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("robot", "info", "panda") == 0
    printed = capsys.readouterr().out
    assert "panda_joint7" in printed and "2.8973" in printed and "spheres on" in printed


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


def test_demo(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("demo") == 0
    printed = capsys.readouterr().out
    assert "solved" in printed and "verified" in printed
    assert (tmp_path / "demo.png").read_bytes()[:4] == b"\x89PNG"
    assert "<html" in (tmp_path / "demo.html").read_text()[:200]


@pytest.mark.parametrize("file", EXAMPLES, ids=lambda file: file.name)
def test_examples_are_solved(file: Path) -> None:
    assert run("plan", file, "--planner", "rrt_connect", "--time-limit", 5) == 0


def test_example_in_python(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    runpy.run_path(str(ROOT / "examples" / "plan.py"))
    assert capsys.readouterr().out.startswith("solved")
    assert (tmp_path / "motion.csv").exists()


@pytest.mark.parametrize(
    ("command", "status", "said"),
    [
        ("{} > /dev/full", 3, "the output could not be written: No space left on device"),
        ("{} | true; exit ${{PIPESTATUS[0]}}", 3, "the output could not be written: its reader has gone"),
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
