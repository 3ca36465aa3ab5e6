"""The cost of path constraints in guidance: its steps against its formula, which is written out here."""

import numpy as np
import pytest

import robotdiffuse as rd
from robotdiffuse.collision import CollisionChecker
from robotdiffuse.learning.guidance import CollisionGuidance, GuidanceSettings
from robotdiffuse.problems.compiled_constraints import PathConstraints
from robotdiffuse.problems.constraint_kernel import DISTANCE
from robotdiffuse.problems.constraints import Constraint
from robotdiffuse.problems.projection_kernel import ANGLE_WEIGHT
from robotdiffuse.robots.kinematics import link_pose

PANDA, HAND = rd.load_robot("panda"), "panda_hand"
START = np.array([-0.6, 0.2, 0.0, -2.0, 0.0, 2.2, 0.2])
GOAL = np.array([0.6, 0.2, 0.0, -2.0, 0.0, 2.2, 0.2])
AT = link_pose(PANDA, START, HAND)[:3, 3]
CONE = rd.AxisCone(HAND, [0, 0, 1], [0, 0, -1], 0.2)
EACH: list[Constraint] = [
    CONE,
    rd.PositionBox(HAND, [0.2, -0.6, AT[2] - 0.02], [0.8, 0.6, AT[2] + 0.02]),
    rd.OnPlane(HAND, AT, [0, 0, 1], 0.002),
    rd.OnLine(HAND, AT, [0, 1, 0], 0.002),
    rd.CartesianLine(HAND),
]
NO_OTHERS = GuidanceSettings(margin=None, self_margin=None, length=0.0, push=0.3)
CHECKER = CollisionChecker(PANDA, rd.Scene())


def ready(*constraints: Constraint) -> PathConstraints:
    return PathConstraints(rd.Problem(PANDA, rd.Scene(), START, GOAL, constraints=constraints))


def waves(seed: int = 0) -> np.ndarray:
    """Motions from start to goal that keep nothing."""
    t = np.linspace(0, 1, 24)[:, None]
    bumps = np.sin(np.pi * t) * np.random.default_rng(seed).normal(0.0, 0.4, (4, 1, PANDA.dof))
    return (START + t * (GOAL - START) + bumps).astype(np.float32)


def formula(constraints: PathConstraints, share: float, q: np.ndarray) -> np.ndarray:
    """The cost of trajectories [count, waypoints, dof], [count]: the sum of h² / 2 over rows and
    waypoints."""
    unit = np.where(constraints.rows.row_kind == DISTANCE, 1.0, ANGLE_WEIGHT)
    beyond = constraints.values(q.reshape(-1, q.shape[2])) - constraints.limits(share)
    return 0.5 * ((unit * np.maximum(beyond, 0.0)) ** 2).sum(axis=1).reshape(q.shape[:2]).sum(axis=1)


def test_formula_by_hand() -> None:
    """The hand is tilted by half a radian; 0.2 are allowed, and guidance keeps to half of these."""
    q = np.repeat(START[None, None], 3, axis=1)
    q[0, 1, 5] += 0.5
    tilt = np.arccos(-link_pose(PANDA, q[0, 1], HAND)[2, 2])
    assert tilt > 0.3
    assert formula(ready(CONE), 0.5, q)[0] == pytest.approx(0.5 * (0.3 * (tilt - 0.1)) ** 2)
    np.testing.assert_array_equal(formula(ready(CONE), 0.5, q[:, ::2]), 0.0)


@pytest.mark.parametrize("constraint", EACH, ids=lambda one: one.kind)
def test_steps_go_down_until_all_waypoints_keep_it(constraint: Constraint) -> None:
    constraints = ready(constraint)
    guidance = CollisionGuidance(CHECKER, NO_OTHERS, constraints, 0.95)
    q = waves()
    before = formula(constraints, 0.95, q)
    off = before > 0
    assert off.sum() >= 3
    once, many = guidance(q, 1)[0], guidance(q, 30)[0]
    assert (formula(constraints, 0.95, once) < before)[off].all()
    np.testing.assert_array_equal(many[:, [0, -1]], q[:, [0, -1]])
    assert constraints.satisfied(many.reshape(-1, PANDA.dof).astype(np.float64)).all()


def test_steps_are_no_longer_than_pushes() -> None:
    guidance = CollisionGuidance(CHECKER, NO_OTHERS, ready(EACH[2]), 0.95)
    moved, _ = guidance(waves(), 1)
    assert np.linalg.norm(moved - waves(), axis=2).max() <= NO_OTHERS.push * (1 + 1e-6)
