"""Planning under path constraints: motions keep them at every millimeter, by kinematics that share no code with the search."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

import robotdiffuse as rd
from helpers.constraint_values import allowed, true_values
from robotdiffuse.core.transforms import rotation_from_rpy, transform
from robotdiffuse.planning.search import rrt
from robotdiffuse.problems.constraints import Constraint

PANDA = rd.load_robot("panda")
START = np.array([-0.6, 0.2, 0.0, -2.0, 0.0, 2.2, 0.2])
GOAL = np.array([0.6, 0.2, 0.0, -2.0, 0.0, 2.2, 0.2])
HAND = "panda_hand"
AT = PANDA.fk(START, HAND)[:3, 3]
WALL = rd.Box([0.5, 0.0, 0.2], [0.3, 0.06, 0.4], name="wall")
UPRIGHT = rd.AxisCone(HAND, [0, 0, 1], [0, 0, -1], np.radians(10))
LINE = rd.CartesianLine(HAND, 1e-3, 0.02, 0.25)
CASES: list[tuple[list[Constraint], rd.Scene]] = [
    ([UPRIGHT], rd.Scene([WALL])),
    ([LINE], rd.Scene()),
    ([rd.OnPlane(HAND, AT, [0, 0, 1], 2e-3)], rd.Scene([rd.Box([0.6, 0.0, 0.25], [0.05, 0.06, 0.3], name="post")])),
    ([rd.OnLine(HAND, AT, [0, 1, 0], 2e-3)], rd.Scene()),
    ([rd.PositionBox(HAND, [0.2, -0.6, 0.1], [0.8, 0.6, 0.7]), UPRIGHT], rd.Scene([WALL])),
]


def problem(constraints: list[Constraint], scene: rd.Scene | None = None) -> rd.Problem:
    return rd.Problem(PANDA, scene or rd.Scene(), START, GOAL, constraints=constraints)


@pytest.mark.parametrize(
    ("name", "stage", "constraints", "scene"),
    [
        pytest.param(
            *(*planner, *case),
            id=f"{case[0][0].kind}-{planner[0]}",
            marks=[pytest.mark.slow] if planner[0] == "diffusion" and i % 2 else [],
        )
        for planner in (("rrt_connect", "constrained_rrt_connect"), ("diffusion", "network"))
        for i, case in enumerate(CASES)
    ],
)
def test_motions_keep_constraints_at_every_millimeter(name, stage, constraints, scene, monkeypatch):
    monkeypatch.setattr(rrt.RRTConnect, "follows_lines", False)
    made = problem(constraints, scene)
    result = rd.load_planner(name).plan(made, time_limit=20.0)
    assert result.solved and result.stage == stage, result.reason
    assert rd.verify(made, result.path).valid and rd.verify(made, result.trajectory).valid
    for rows in (result.path.positions, result.trajectory.positions):
        for a, b in pairwise(rows):
            steps = int(np.abs(b - a).sum() / 1e-3) + 2  # lever arms are below 1 m
            between = a + np.linspace(0, 1, steps)[:, None] * (b - a)
            assert all((true_values(made, one, between) <= np.add(allowed(one), 1e-9)).all() for one in constraints)


def test_speed_of_a_line_is_kept_and_used() -> None:
    result = rd.load_planner("aorrtc").plan(problem([LINE]), time_limit=20.0)
    assert result.trajectory is not None, result.reason
    t = result.trajectory
    speeds = np.linalg.norm(np.diff(PANDA.fk(t.positions, HAND)[:, :3, 3], axis=0), axis=1) / np.diff(t.times)
    assert speeds.max() <= 0.25 * 1.001 and np.median(speeds) >= 0.24
    found = rd.verify(problem([replace(LINE, speed=0.2)]), t).violation
    assert found.kind == "speed" and "allows 0.2 m/s" in found.message


def test_validator_names_constraint_amount_and_place() -> None:
    """The straight line in joint space turns the base joint, so the hand is off by 103 mm in the middle of the line."""
    straight = rd.Path(PANDA.joint_names, np.stack([START, GOAL]))
    found = rd.verify(problem([LINE]), straight).violation
    assert (found.kind, found.subject, found.other) == ("constraint", HAND, LINE.kind)
    assert found.excess == pytest.approx(0.1022, abs=1e-3) and 0 < found.time < 0.01
    assert found.message == "cartesian_line of panda_hand is exceeded: 103.2 mm, of 1 allowed"
    assert rd.verify(problem([UPRIGHT]), straight).valid, "turning the base joint keeps the hand upright"


def test_violations_at_start_and_goal_are_reported() -> None:
    tilted = START + np.array([0, 0, 0, 0, 0, 0.5, 0])
    for change, status in (
        ({"start": tilted}, rd.Status.INVALID_START),
        ({"goal": tilted}, rd.Status.INVALID_GOAL),
        ({"goal": rd.PoseGoal(HAND, PANDA.fk(tilted, HAND))}, rd.Status.INVALID_GOAL),
    ):
        told = rd.load_planner("aorrtc").plan(replace(problem([UPRIGHT]), **change), 60.0)
        assert told.status is status and "axis_cone of panda_hand is exceeded: 28.65 degrees, of 10 allowed" in told.reason


def test_a_goal_pose_with_tolerance_is_turned_until_it_keeps_the_constraint() -> None:
    """The goal pose is tilted by half a radian, and any tilt is allowed; few random draws are upright."""
    T = transform(AT + np.array([0.0, 0.4, 0.1]), rotation_from_rpy(np.pi - 0.5, 0.0, 0.0))
    made = replace(problem([UPRIGHT]), goal=rd.PoseGoal(HAND, T, [0.02] * 3, [0.7, 0.7, np.pi]))
    result = rd.load_planner("aorrtc").plan(made, time_limit=20.0)
    assert result.solved, result.reason
    assert rd.verify(made, result.path).valid


@pytest.mark.parametrize("case", [0, 2])
def test_more_iterations_give_no_slower_motion(case: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Regression: the planner returned the shortest path, whose motion may be slower than one found before."""
    durations = []
    for paths in (1, 2, 4, 8):
        monkeypatch.setattr(rrt, "PATHS_TO_FIND", paths)
        durations.append(rd.plan(problem(*CASES[case]), 60.0, planner="rrt_connect", seed=1).duration)
    assert durations == sorted(durations, reverse=True) and durations[-1] < 0.95 * durations[0]


def test_optimize_time_counts_under_constraints(monkeypatch: pytest.MonkeyPatch) -> None:
    """Regression: RRT-Connect ended under path constraints as soon as it had found PATHS_TO_FIND paths."""
    monkeypatch.setattr(rrt, "PATHS_TO_FIND", 1)
    made = problem(*CASES[0])
    settings = (rrt.RRTConnectSettings(optimize_time=seconds) for seconds in (0.0, 1.0))
    first, more = (rrt.RRTConnect(one).plan(made, 60.0, seed=1, objective="time") for one in settings)
    assert rd.verify(made, more.trajectory).valid and more.duration < 0.95 * first.duration
