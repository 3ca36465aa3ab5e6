"""Path constraints: errors, files, and proofs against dense sampling and finite differences."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

import robotdiffuse as rd
from helpers.constraint_values import true_values
from helpers.example_robots import example_robot
from helpers.refusals import refuses
from robotdiffuse.core.transforms import rotation_about, transform
from robotdiffuse.problems.compiled_constraints import PathConstraints
from robotdiffuse.problems.constraints import CONSTRAINTS, Constraint
from robotdiffuse.problems.files import problem_from_record, problem_record, save_problem
from robotdiffuse.validation.tolerances import goal_error

PANDA = rd.load_robot("panda")
START = np.array([-0.6, 0.2, 0.0, -2.0, 0.0, 2.2, 0.2])
GOAL = START + np.array([1.2, 0.1, 0.2, -0.2, 0.1, 0.2, 0.3])
HAND = "panda_hand"
AT = PANDA.fk(START, HAND)[:3, 3]
EACH: list[Constraint] = [
    rd.AxisCone(HAND, [0, 0.1, 1], [0, 0, -2], 0.3),
    rd.PositionBox(HAND, [-0.2, -0.2, -0.3], [0.3, 0.2, 0.3], transform(AT, rotation_about(AT / np.linalg.norm(AT), 0.3))),
    rd.OnPlane("panda_link6", [0.1, 0.2, 0.6], [0.1, 0.2, 1.0], 0.05),
    rd.OnLine(HAND, AT, [0.2, 1, 0.1], 0.04),
    rd.CartesianLine("panda_link7", 0.05, 0.2, 0.3),
]


def problem(*constraints: Constraint, robot: rd.Robot = PANDA) -> rd.Problem:
    return rd.Problem(robot, rd.Scene(), START, GOAL, constraints=list(constraints))


@pytest.mark.parametrize("constraint", EACH, ids=lambda one: one.kind)
def test_values_are_those_of_the_book(constraint: Constraint) -> None:
    made = problem(constraint)
    q = np.concatenate([[START, GOAL], np.random.default_rng(0).uniform(PANDA.lower, PANDA.upper, (30, 7))])
    np.testing.assert_allclose(PathConstraints(made).values(q), true_values(made, constraint, q), atol=1e-7)


@pytest.mark.parametrize("constraint", EACH, ids=lambda one: one.kind)
def test_what_is_proved_holds_at_every_sample_and_what_is_not_proved_does_not(constraint: Constraint) -> None:
    """The proof succeeds for a limit slightly above the largest of many sampled values, and fails slightly below."""
    rng = np.random.default_rng(1)
    ready = PathConstraints(problem(constraint))
    for _ in range(20):
        a, b = rng.uniform(PANDA.lower, PANDA.upper, (2, 7))
        q = np.stack([a, a + rng.uniform(0.05, 1) * (b - a)])
        sampled = ready.values(q[0] + np.linspace(0, 1, 4001)[:, None] * (q[1] - q[0]))
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
    assert len(found) >= 20 and ready.satisfied(found, 0.9).all() and ((found >= PANDA.lower) & (found <= PANDA.upper)).all()


def test_speeds_are_finite_differences() -> None:
    ready = PathConstraints(problem(rd.CartesianLine(HAND, 0.05, None, 0.3)))
    rng = np.random.default_rng(3)
    q = rng.uniform(PANDA.lower, PANDA.upper, (10, 7))
    rates = rng.normal(size=(10, 7))
    at = [np.array([PANDA.fk(row, HAND)[:3, 3] for row in q + h * rates]) for h in (-1e-6, 1e-6)]
    np.testing.assert_allclose(ready.speeds(q, rates)[:, 0], np.linalg.norm(at[1] - at[0], axis=1) / 2e-6, atol=1e-7)


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


def test_bad_input_is_refused_by_one_line_that_names_the_field() -> None:
    refuses("axis_cone.axis is 'up'", rd.AxisCone, HAND, "up", [0, 0, 1], 0.1)
    refuses("axis_cone.angle is 0; .* 0.001 to 3.14159", rd.AxisCone, HAND, [0, 0, 1], [0, 0, 1], 0)
    refuses("on_line.tolerance is '1 mm'", rd.OnLine, HAND, [0, 0, 0], [0, 0, 1], "1 mm")
    refuses("position_box.low is .* must be above its low", rd.PositionBox, HAND, [0, 0, 1], [1, 1, 0])
    refuses("cartesian_line.tolerance is 0", rd.CartesianLine, HAND, 0.0)
    refuses(r"link in constraints\[0\].frame: 'hnd'", problem, rd.OnPlane("hnd", [0, 0, 0], [0, 0, 1], 0.1))
    refuses("no planned joint moves", problem, rd.OnPlane("panda_link0", [0, 0, 0], [0, 0, 1], 0.1))
    refuses("constraints is 'upright'", replace, problem(), constraints="upright")
    line = problem(EACH[4])
    refuses("cartesian_line cannot be combined", replace, line, waypoints=(GOAL,))
    refuses("2 goal configurations .* differ", PathConstraints, replace(line, goal=[START, GOAL]))  # type: ignore[arg-type]
    loose = replace(line, goal=rd.PoseGoal(HAND, PANDA.fk(GOAL, HAND), [0.1, 0, 0]))
    refuses("the goal must determine the pose of this link, but the goal has tolerances", PathConstraints, loose)
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
    goal = rd.PoseGoal(HAND, PANDA.fk(q[0], HAND), xyz, rpy)
    ready = PathConstraints(rd.Problem(PANDA, rd.Scene(), START, goal), [goal])
    at_goal = np.array([goal_error(PANDA, goal, row) is None for row in q])
    satisfied = ready.satisfied(q)
    assert satisfied[0] and not (satisfied & ~at_goal).any()
    roomy = rd.PoseGoal(HAND, goal.T_base_frame, 1.01 * xyz + 1e-4, 1.01 * rpy + 1e-4)
    assert not (at_goal & ~PathConstraints(rd.Problem(PANDA, rd.Scene(), START, roomy), [roomy]).satisfied(q)).any()
    for row in ready.projected(q, 0.9):
        assert goal_error(PANDA, goal, row) is None


def test_most_projections_onto_tolerances_of_a_reachable_goal_succeed() -> None:
    """With wrong derivatives of roll, pitch and yaw, hardly any projection succeeded."""
    rng = np.random.default_rng(8)
    share = []
    for there in rng.uniform(0.8 * PANDA.lower, 0.8 * PANDA.upper, (10, 7)):
        goal = rd.PoseGoal(HAND, PANDA.fk(there, HAND), [0.01] * 3, [0.1, 0.2, 0.3])
        ready = PathConstraints(rd.Problem(PANDA, rd.Scene(), START, goal), [goal])
        share.append(len(ready.projected(rng.uniform(PANDA.lower, PANDA.upper, (50, 7)), 0.9)) / 50)
    assert np.mean(share) > 0.3, share
