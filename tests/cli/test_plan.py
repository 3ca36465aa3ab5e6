"""The commands `plan`, `demo` and `explore`: exit status, one line for bad input, and written files."""

import ctypes
import json
import os
import signal
import time
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

import robotdiffuse as rd
from helpers.commands import GOAL, PROBLEM, START, Said, run, write_problem
from helpers.full_disk import full_disk
from robotdiffuse.cli.explore import shelf_problem
from robotdiffuse.planning import load_planner, planner_settings
from robotdiffuse.problems.files import load_problem, problem_record
from robotdiffuse.visualization.picture import PictureSettings

ROOT = Path(__file__).parents[2]
EXAMPLES = sorted(ROOT.glob("examples/*.yaml")) + sorted(ROOT.glob("src/robotdiffuse/examples/*.yaml"))


def test_plan_writes_files_that_view_and_verify_read(tmp_path: Path, said: Said) -> None:
    asked = ("plan", write_problem(tmp_path), "--planner", "rrt_connect", "--time-limit", 5, "--seed", 1)
    printed = said(0, *asked, "--out", "r.json", "--out", "r.csv")
    assert "solved" in printed and "rrt_connect" in printed
    saved = rd.load_result("r.json")
    assert saved.result.seed == 1 and saved.result.trajectory is not None
    assert np.array_equal(saved.result.trajectory.positions[0], START)
    assert np.allclose(saved.result.trajectory.positions[-1], GOAL)
    assert saved.problem is not None and saved.problem["scene"][0]["sphere"]["radius"] == 0.15
    assert (tmp_path / "r.csv").read_text().startswith("time,panda_joint1_position,")
    assert said(0, "verify", "r.json").count("valid") == 2
    assert run("view", "r.json", "--out", "again.html") == 0
    assert (tmp_path / "again.html").stat().st_size > 10_000


def test_files_are_written_though_nobody_reads_what_is_printed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Regression: `plan problem.yaml --out r.json | head -1` wrote no file."""
    problem = write_problem(tmp_path)
    read, write = os.pipe()
    os.close(read)
    with monkeypatch.context() as patch, os.fdopen(write, "w", buffering=1) as nobody:
        patch.setattr("sys.stdout", nobody)
        run("plan", problem, "--planner", "rrt_connect", "--time-limit", 5, "--out", "r.json")
    assert rd.load_result("r.json").result.solved


def test_the_result_is_printed_though_its_file_cannot_be_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    problem = write_problem(tmp_path)
    with full_disk():
        assert run("plan", problem, "--planner", "rrt_connect", "--time-limit", 5, "--out", "r.json") == 3
    assert "solved" in capsys.readouterr().out


def melon(y: float) -> dict[str, Any]:
    return {"scene": [{"sphere": {"center": [0.3, y, 0.5], "radius": 0.2, "name": "melon"}}]}


FAR = {"frame": "panda_hand", "xyz": [2.0, 0.0, 0.5], "wxyz": [1, 0, 0, 0]}
NO_PLAN: dict[str, tuple[dict[str, Any], str]] = {
    "invalid_start": (melon(-0.45), "melon"),
    "invalid_goal": (melon(0.45), "melon"),
    "unreachable_goal": ({"goal": {"pose": FAR}}, "panda_hand"),
}


@pytest.mark.parametrize("status", NO_PLAN)
def test_no_plan_is_status_1_with_the_reason(status: str, tmp_path: Path, said: Said) -> None:
    changes, named = NO_PLAN[status]
    printed = said(1, "plan", write_problem(tmp_path, **changes), "--planner", "rrt_connect", "--out", "r.json")
    assert status in printed and named in printed
    saved = rd.load_result("r.json")
    assert saved.result.status.value == status and saved.result.path is None
    assert f"its status is {status}" in said(2, "export", "r.json", "--out", "r.csv")


def test_what_has_no_motion_is_drawn(tmp_path: Path, said: Said) -> None:
    """Regression: `view problem.yaml` was refused, and `plan --out bad.html` neither wrote a file nor said so."""
    problem = write_problem(tmp_path, **melon(0.45))
    outs = ("--out", "bad.html", "--out", "bad.json", "--out", "bad.csv")
    assert "not written: bad.csv: there is no motion" in said(1, "plan", problem, "--planner", "rrt_connect", *outs)
    assert not (tmp_path / "bad.csv").exists()
    assert "invalid goal" in (tmp_path / "bad.html").read_text()
    assert run("view", problem, "--out", "again.html") == 0
    assert "inside melon" in (tmp_path / "again.html").read_text()
    assert run("view", "bad.json", problem, "--out", "both.png") == 2


def test_a_result_saved_from_python_holds_its_problem(tmp_path: Path, said: Said) -> None:
    problem = load_problem(write_problem(tmp_path))
    result = load_planner("rrt_connect").plan(problem, 5.0)
    result.save("r.json")
    assert rd.load_result("r.json").problem == problem_record(problem)
    assert run("verify", "r.json") == run("export", "r.json", "--out", "r.csv") == 0
    replace(result, problem=replace(problem, robot=replace(problem.robot, name="mine", source=None))).save("unnamed.json")
    assert "holds no problem (without its problem: robot 'mine' is neither" in said(2, "view", "unnamed.json")


def test_problem_of_a_jsonl_file(tmp_path: Path, said: Said) -> None:
    file = tmp_path / "problems.jsonl"
    file.write_text(f"{json.dumps(PROBLEM)}\n{json.dumps(PROBLEM | melon(-0.45))}\n")
    assert run("plan", file, "--planner", "rrt_connect", "--time-limit", 5, "--until", "first") == 0
    assert "invalid_start" in said(1, "plan", file, "--planner", "rrt_connect", "--index", 1)


def test_ctrl_c_and_sigterm(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, said: Said) -> None:
    """Regressions: Ctrl-C is the cause of a SystemError in compiled code that makes tuples; a callback loses it."""

    def lost(*_: object, **__: object) -> None:
        ctypes.CFUNCTYPE(None)(lambda: signal.raise_signal(signal.SIGTERM))()
        time.sleep(60.0)

    from_compiled_code = SystemError("returned a result with an exception set")
    from_compiled_code.__cause__ = KeyboardInterrupt()
    for error, status in ((KeyboardInterrupt, 130), (from_compiled_code, 130), (lost, 143)):
        monkeypatch.setattr("robotdiffuse.cli.plan.load_and_plan", Mock(side_effect=error))
        assert said(status, "plan", write_problem(tmp_path), "--planner", "rrt_connect") == "robotdiffuse: stopped\n"


def test_plan_takes_settings_of_the_planner(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    solve = Mock(return_value=rd.PlanResult(rd.Status.NO_PATH, "none", "robotdiffuse", "panda", 0.1, 0))
    monkeypatch.setattr("robotdiffuse.cli.plan.load_and_plan", solve)
    assert run("plan", write_problem(tmp_path), "--set", "range=0.5", "--set", "smoothings=4") == 1
    settings = planner_settings("robotdiffuse", ["smoothings=4", "range=0.5"])
    assert settings in solve.call_args.args and settings != planner_settings("robotdiffuse", [])


def test_demo(tmp_path: Path, said: Said) -> None:
    printed = said(0, "demo")
    assert "solved" in printed and "verified" in printed
    assert (tmp_path / "demo.png").read_bytes()[:4] == b"\x89PNG"
    assert "<html" in (tmp_path / "demo.html").read_text()[:200]


@pytest.mark.parametrize("file", EXAMPLES, ids=lambda file: file.name)
def test_examples_are_solved(file: Path) -> None:
    assert run("plan", file, "--planner", "rrt_connect", "--time-limit", 5, "--until", "first") == 0


def test_the_clearance_is_printed_beside_the_requested_one(tmp_path: Path, said: Said) -> None:
    far = write_problem(tmp_path, scene=[{"sphere": {"center": [0, 5, 0], "radius": 0.1}}])
    printed = " ".join(said(0, "plan", far, "--planner", "aorrtc", "--clearance", 0.02).split())
    assert "certified > 1 m to the scene (asked: 20 mm), at least" in printed and "millimeters" in printed
    assert "clearance is 5.0; it must be between 0 and 0.5" in said(2, "plan", far, "--clearance", 5)


def test_wrong_files_are_answered_with_what_is_right(tmp_path: Path, said: Said) -> None:
    problem = write_problem(tmp_path)
    rd.PlanResult(rd.Status.NO_PATH, "none", "aorrtc", "panda", 0.1, 0).save("result.json")
    assert "it is a result, not a problem; `robotdiffuse view` draws it" in said(2, "plan", "result.json")
    for file in (problem, tmp_path / "problem.yaml"):
        assert "it is a problem; `robotdiffuse plan" in said(2, "export", file, "--out", "r.csv")
    assert ". is a folder" in said(2, "plan", ".")
    assert "(angles are in radians)" in said(2, "plan", write_problem(tmp_path, start=[0, -45, 0, -135, 0, 90, 45]))


def test_the_demo_of_another_arm_is_not_solved_by_the_straight_line() -> None:
    problem = shelf_problem("ur5e")
    assert isinstance(problem.goal, rd.JointGoal)
    lines = [rd.Path(problem.robot.joint_names, np.stack([problem.start, q])) for q in problem.goal.positions]
    assert not any(rd.verify(problem, line).valid for line in lines)


def test_plan_ignores_joints_where_it_is_told_to(tmp_path: Path, said: Said) -> None:
    """Regression: `plan --ignore-joints` was accepted, but had no effect."""
    Path("stranger.yaml").write_text("robot_state: {joint_state: {name: [gripper], position: [0.1]}}")
    asked = ("plan", write_problem(tmp_path, scene="stranger.yaml"), "--planner", "rrt_connect")
    assert "has values of gripper, movable joints that panda lacks" in said(2, *asked)
    assert "ignored gripper" in said(0, *asked, "--ignore-joints")


def test_plan_and_verify_name_allowed_contacts(tmp_path: Path, said: Said) -> None:
    problem = write_problem(tmp_path, allowed_contacts={"sphere": ["panda_hand"]})
    note = "contact of sphere with panda_hand is allowed"
    assert note in said(0, "plan", problem, "--planner", "rrt_connect", "--out", "r.json")
    assert note in said(0, "verify", "r.json", "--certificate", "c.json")
    assert note in said(0, "certificate", "check", "c.json")


def test_explore_writes_files(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("robotdiffuse.visualization.exploration.TILE", PictureSettings(width=240, height=150, ghosts=1))
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    near = write_problem(tmp_path, goal={"joints": [-0.95, 0.3, 0.0, -1.8, 0.0, 2.1, 0.8]})
    status = run("explore", near, "--out", "seen.png", "--record", "seen.mcap", "--view")
    printed = capsys.readouterr().out
    assert status in (0, 1) and printed.startswith("1. ") and "of the map" in printed
    assert (status == 0) == ("done: the arm is at the goal" in printed)
    for name in ("seen.png", "seen.mcap", "problem.html"):
        assert f"wrote {name}" in printed and (tmp_path / name).stat().st_size > 10_000
    [first, *_] = rd.read_depth_views("seen.mcap", rd.load_robot("panda"))
    assert first.view.configuration is not None and first.view.configuration.tolist() == START


@pytest.mark.slow
def test_demo_explore_says_what_happened(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    status = run("demo", "--explore")
    printed = capsys.readouterr().out
    assert "look: " in printed and f"The arm is {'' if status == 0 else 'not '}at the goal" in printed
    assert (tmp_path / "explore.png").is_file() and (tmp_path / "explore.html").is_file()
