"""Path constraints: errors, files, and proofs against dense sampling and finite differences."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import robotdiffuse as rd
from helpers.example_robots import example_robot
from helpers.refusals import refuses
from robotdiffuse.core.transforms import inverse, rotation_about, rotation_angle, transform
from robotdiffuse.problems.compiled_constraints import PathConstraints
from robotdiffuse.problems.constraints import CONSTRAINTS, Constraint
from robotdiffuse.problems.files import problem_from_record, problem_record, save_problem
from robotdiffuse.robots.kinematics import link_pose
from robotdiffuse.validation.tolerances import goal_error

PANDA = rd.load_robot("panda")
START = np.array([-0.6, 0.2, 0.0, -2.0, 0.0, 2.2, 0.2])
GOAL = START + np.array([1.2, 0.1, 0.2, -0.2, 0.1, 0.2, 0.3])
HAND = "panda_hand"
AT = link_pose(PANDA, START, HAND)[:3, 3]
EACH: list[Constraint] = [
    rd.AxisCone(HAND, [0, 0.1, 1], [0, 0, -2], 0.3),
    rd.PositionBox(HAND, [-0.2, -0.2, -0.3], [0.3, 0.2, 0.3], transform(AT, rotation_about(AT / np.linalg.norm(AT), 0.3))),
    rd.OnPlane("panda_link6", [0.1, 0.2, 0.6], [0.1, 0.2, 1.0], 0.05),
    rd.OnLine(HAND, AT, [0.2, 1, 0.1], 0.04),
    rd.CartesianLine("panda_link7", 0.05, 0.2, 0.3),
]


def problem(*constraints: Constraint, robot: rd.Robot = PANDA) -> rd.Problem:
    return rd.Problem(robot, rd.Scene(), START, GOAL, constraints=list(constraints))


def true_values(made: rd.Problem, constraint: Constraint, q: np.ndarray) -> list[float]:
    """What `PathConstraints.values` must return, by the definition of the constraint."""
    T = link_pose(made.robot, q, constraint.frame)
    p = T[:3, 3]
    if isinstance(constraint, rd.AxisCone):
        return [float(np.arccos(np.clip(T[:3, :3] @ constraint.axis @ constraint.direction, -1, 1)))]
    if isinstance(constraint, rd.PositionBox):
        assert constraint.T_base_box is not None
        x = (inverse(constraint.T_base_box) @ [*p, 1])[:3]
        beyond = np.maximum(constraint.low - x, x - constraint.high)
        return [float(np.linalg.norm(np.maximum(beyond, 0)) + min(beyond.max(), 0))]
    if isinstance(constraint, rd.OnPlane):
        return [abs(float((p - constraint.point) @ constraint.normal))]
    if isinstance(constraint, rd.OnLine):
        return [float(np.linalg.norm(np.cross(p - constraint.point, constraint.direction)))]
    ends = link_pose(made.robot, START, constraint.frame), link_pose(made.robot, GOAL, constraint.frame)
    way = ends[1][:3, 3] - ends[0][:3, 3]
    share = np.clip((p - ends[0][:3, 3]) @ way / (way @ way), 0, 1)
    turn = ends[1][:3, :3] @ ends[0][:3, :3].T
    angle = rotation_angle(turn)
    skew = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    there = rotation_about(skew / np.linalg.norm(skew), float(share) * angle) @ ends[0][:3, :3]
    off = float(np.linalg.norm(p - ends[0][:3, 3] - share * way))
    return [off, rotation_angle(there.T @ T[:3, :3])]


@pytest.mark.parametrize("constraint", EACH, ids=lambda one: one.kind)
def test_values_are_those_of_the_book(constraint: Constraint) -> None:
    made = problem(constraint)
    q = np.concatenate([[START, GOAL], np.random.default_rng(0).uniform(PANDA.lower, PANDA.upper, (30, 7))])
    right = [true_values(made, constraint, row) for row in q]
    np.testing.assert_allclose(PathConstraints(made).values(q), right, atol=1e-7)


@pytest.mark.parametrize("constraint", EACH, ids=lambda one: one.kind)
def test_what_is_proved_holds_at_every_sample_and_what_is_not_proved_does_not(constraint: Constraint) -> None:
    """The proof succeeds for a limit slightly above the largest of many sampled values, and fails slightly below."""
    made = problem(constraint)
    rng = np.random.default_rng(1)
    ready = PathConstraints(made)
    for _ in range(20):
        a, b = rng.uniform(PANDA.lower, PANDA.upper, (2, 7))
        q = np.stack([a, a + rng.uniform(0.05, 1) * (b - a)])
        between = q[0] + np.linspace(0, 1, 4001)[:, None] * (q[1] - q[0])
        sampled = ready.values(between)
        most = sampled.max(axis=0)
        if (most > 3.1).any():  # a kink, which samples miss
            continue
        ready.rows = ready.rows._replace(limit=most + 2e-5)
        assert ready.first_violation(q) is None
        ready.rows = ready.rows._replace(limit=most - 2e-5)
        found = ready.first_violation(q)
        assert found is not None and found.excess > 0
        over = np.flatnonzero((sampled > ready.rows.limit).any(axis=1))
        assert abs(found.at - over[0] / 4000) < 0.005, "the first place"


def test_proofs_hold_for_sliding_and_endless_joints_on_skew_axes() -> None:
    robot = example_robot("awkward")
    rng = np.random.default_rng(6)
    lower = np.maximum(robot.lower, -6)
    upper = np.minimum(robot.upper, 6)
    frame = robot.tip
    start, goal = rng.uniform(lower, upper, (2, robot.dof))
    kept = [
        rd.AxisCone(frame, [0, 0, 1], [1, 0, 0.5], 1.0),
        rd.OnLine(frame, [0.1, 0, 0.2], [1, 1, 0], 0.1),
        rd.PositionBox(frame, [-1, -0.2, 0], [1, 0.3, 0.4]),
        rd.CartesianLine(frame, 0.1, 1.0),
    ]
    ready = PathConstraints(rd.Problem(robot, rd.Scene(), start, goal, constraints=kept))
    for _ in range(30):
        a, b = rng.uniform(lower, upper, (2, robot.dof))
        q = np.stack([a, a + rng.uniform(0.02, 1) * (b - a)])
        sampled = ready.values(q[0] + np.linspace(0, 1, 8001)[:, None] * (q[1] - q[0]))
        # a proof must fail at limits that samples exceed, and succeed well above all of them
        ready.rows = ready.rows._replace(limit=sampled.max(axis=0) - 1e-9)
        assert ready.first_violation(q) is not None
        ready.rows = ready.rows._replace(limit=sampled.max(axis=0) + 1e-2)
        assert ready.first_violation(q) is None


@pytest.mark.parametrize("constraint", EACH, ids=lambda one: one.kind)
def test_projection_ends_where_the_constraint_is_kept(constraint: Constraint) -> None:
    ready = PathConstraints(problem(constraint))
    found = ready.projected(np.random.default_rng(2).uniform(PANDA.lower, PANDA.upper, (50, 7)), 0.9)
    assert len(found) >= 20 and ready.satisfied(found, 0.9).all()
    assert ((found >= PANDA.lower) & (found <= PANDA.upper)).all()


def test_speeds_are_finite_differences() -> None:
    ready = PathConstraints(problem(rd.CartesianLine(HAND, 0.05, None, 0.3)))
    rng = np.random.default_rng(3)
    q = rng.uniform(PANDA.lower, PANDA.upper, (10, 7))
    rates = rng.normal(size=(10, 7))
    at = [np.array([link_pose(PANDA, row, HAND)[:3, 3] for row in q + h * rates]) for h in (-1e-6, 1e-6)]
    right = np.linalg.norm(at[1] - at[0], axis=1) / 2e-6
    np.testing.assert_allclose(ready.speeds(q, rates)[:, 0], right, atol=1e-7)


@pytest.mark.parametrize("constraint", EACH, ids=lambda one: one.kind)
def test_constraints_move_with_the_world_and_survive_files(constraint: Constraint, tmp_path: Path) -> None:
    T = transform(np.array([0.3, -2.0, 0.7]), rotation_about(np.array([0.6, 0.0, 0.8]), 1.0))
    made = rd.Problem.in_world(T, PANDA, rd.Scene(), START, GOAL, constraints=[constraint.moved(T)])
    q = np.random.default_rng(5).uniform(PANDA.lower, PANDA.upper, (5, 7))
    values = PathConstraints(problem(constraint)).values(q)
    np.testing.assert_allclose(PathConstraints(made).values(q), values, atol=1e-9)
    for one in (made, problem(constraint)):
        save_problem(one, tmp_path / "again.yaml")
        again = rd.load_problem(tmp_path / "again.yaml")
        assert problem_record(again) == problem_record(problem_from_record(problem_record(one)))
        np.testing.assert_allclose(PathConstraints(again).values(q), values, atol=1e-9)


BAD: list[tuple[Callable[[], object], str]] = [
    (lambda: rd.AxisCone(HAND, "up", [0, 0, 1], 0.1), "axis_cone.axis is 'up'"),
    (lambda: rd.AxisCone(HAND, [0, 0, 1], [0, 0, 1], 0), "axis_cone.angle is 0; .* 0.001 to 3.14159"),
    (lambda: rd.OnLine(HAND, [0, 0, 0], [0, 0, 1], "1 mm"), "on_line.tolerance is '1 mm'"),  # type: ignore[arg-type]
    (lambda: rd.PositionBox(HAND, [0, 0, 1], [1, 1, 0]), "position_box.low is .* must be above its low"),
    (lambda: rd.CartesianLine(HAND, 0.0), "cartesian_line.tolerance is 0"),
    (lambda: problem(rd.OnPlane("hnd", [0, 0, 0], [0, 0, 1], 0.1)), r"link in constraints\[0\].frame: 'hnd'"),
    (lambda: problem(rd.OnPlane("panda_link0", [0, 0, 0], [0, 0, 1], 0.1)), "no planned joint moves"),
    (lambda: replace(problem(), constraints="upright"), "constraints is 'upright'"),  # type: ignore[arg-type]
    (lambda: replace(problem(EACH[4]), waypoints=(GOAL,)), "cartesian_line cannot be combined"),  # type: ignore[arg-type]
    (lambda: PathConstraints(replace(problem(EACH[4]), goal=[START, GOAL])), "2 goal configurations .* differ"),  # type: ignore[arg-type]
    (
        lambda: PathConstraints(replace(problem(EACH[4]), goal=rd.PoseGoal(HAND, link_pose(PANDA, GOAL, HAND), [0.1, 0, 0]))),
        "the goal must determine the pose of this link, but the goal has tolerances",
    ),
]


@pytest.mark.parametrize(("make", "message"), BAD)
def test_bad_input_is_refused_by_one_line(make: Callable[[], object], message: str) -> None:
    refuses(message, make)


def test_files_name_the_field() -> None:
    for entry, message in (
        ({"upright": {}}, r"unknown field of constraints\[0\]: 'upright'; known: axis_cone, cartesian"),
        ({"axis_cone": {"frame": HAND}}, r"constraints\[0\].axis_cone has no axis and no direction"),
        ({"axis_cone": {"frame": HAND, "tilt": 1}}, "unknown field of .*axis_cone: 'tilt'"),
    ):
        record: dict[str, Any] = problem_record(problem()) | {"constraints": [entry]}
        refuses(message, problem_from_record, record)


def test_every_kind_is_tested() -> None:
    assert {one.kind for one in EACH} == set(CONSTRAINTS)


@settings(max_examples=12)
@given(st.integers(0, 2**31))
def test_projection_onto_tolerances_of_goals_agrees_with_the_validator(seed: int) -> None:
    """Also for roll, pitch and yaw near half a turn, for tolerances of 0, and for free angles."""
    rng = np.random.default_rng(seed)
    q = rng.uniform(PANDA.lower, PANDA.upper, (40, 7))
    xyz = rng.choice([0.0, 0.02, 0.3], 3)
    rpy = rng.choice([0.0, 0.1, 1.5, 3.0, np.pi], 3)
    goal = rd.PoseGoal(HAND, link_pose(PANDA, q[0], HAND), xyz, rpy)
    ready = PathConstraints(rd.Problem(PANDA, rd.Scene(), START, goal), [goal])
    at_goal = np.array([goal_error(PANDA, goal, row) is None for row in q])
    satisfied = ready.satisfied(q)
    assert satisfied[0] and not (satisfied & ~at_goal).any()
    roomy = rd.PoseGoal(HAND, goal.T_base_frame, 1.01 * xyz + 1e-4, 1.01 * rpy + 1e-4)
    roomy_rows = PathConstraints(rd.Problem(PANDA, rd.Scene(), START, roomy), [roomy])
    assert not (at_goal & ~roomy_rows.satisfied(q)).any()
    for row in ready.projected(q, 0.9):
        assert goal_error(PANDA, goal, row) is None


def test_most_projections_onto_tolerances_of_a_reachable_goal_succeed() -> None:
    """With wrong derivatives of roll, pitch and yaw, hardly any projection succeeded."""
    rng = np.random.default_rng(8)
    share = []
    for there in rng.uniform(0.8 * PANDA.lower, 0.8 * PANDA.upper, (10, 7)):
        goal = rd.PoseGoal(HAND, link_pose(PANDA, there, HAND), [0.01] * 3, [0.1, 0.2, 0.3])
        ready = PathConstraints(rd.Problem(PANDA, rd.Scene(), START, goal), [goal])
        share.append(len(ready.projected(rng.uniform(PANDA.lower, PANDA.upper, (50, 7)), 0.9)) / 50)
    assert np.mean(share) > 0.3, share
