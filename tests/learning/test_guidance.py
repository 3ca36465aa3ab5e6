"""Guidance: it keeps start and goal, reduces collisions, and its steps agree with formulas in NumPy."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from numpy import ndarray

import robotdiffuse as rd
from helpers.box_arm import box_arm
from robotdiffuse.collision import CollisionChecker
from robotdiffuse.learning.guidance import OFF, CollisionGuidance, GuidanceSettings
from robotdiffuse.problems.compiled_constraints import PathConstraints
from robotdiffuse.problems.constraint_kernel import DISTANCE
from robotdiffuse.problems.constraints import Constraint
from robotdiffuse.problems.projection_kernel import ANGLE_WEIGHT
from robotdiffuse.scenes.shapes import Box, Sphere

WAYPOINTS = 24


def straight(start: ndarray, goal: ndarray, waypoints: int = WAYPOINTS) -> ndarray:
    return (start + np.linspace(0, 1, waypoints)[:, None] * (goal - start)).astype(np.float32)


def swing() -> tuple[CollisionChecker, ndarray]:
    checker = CollisionChecker(box_arm(), rd.Scene([Sphere((1.02, 0.55, 0.0), 0.08)]))
    through = straight(np.array([-0.8, 0.6, 0.6]), np.array([0.8, 0.6, 0.6]))
    return checker, np.stack([through, straight(np.array([1.2, 0.2, 0.1]), np.array([2.0, 0.1, 0.4]))])


def test_steps_take_a_motion_out_of_collision_and_leave_others_and_ends() -> None:
    checker, lines = swing()
    before = lines.copy()
    guidance = CollisionGuidance(checker)
    assert not checker.free(lines[0].astype(float)).all()
    costs = np.array([formulas(guidance, guidance(lines, steps))["collision"] for steps in (0, 4, 39)])
    assert costs[0, 0] > costs[1, 0] > costs[2, 0] and (costs[:, 1] == 0).all()
    np.testing.assert_array_equal(guidance(lines, 0), lines)
    moved = guidance(lines, 40)
    assert checker.free(moved[0].astype(float)).all()
    np.testing.assert_array_equal(lines, before)
    np.testing.assert_array_equal(moved[:, [0, -1]], lines[:, [0, -1]])
    np.testing.assert_array_equal(moved[1], lines[1])


@pytest.mark.parametrize("waypoints", [1, 3])
def test_short_trajectories(waypoints: int) -> None:
    checker, lines = swing()
    moved = CollisionGuidance(checker)(lines[:, WAYPOINTS // 2 - 1 :][:, :waypoints], 3)
    assert moved.shape == (2, waypoints, 3) and np.isfinite(moved).all()


NOTHING = GuidanceSettings(margin=None, self_margin=None, length=0.0, push=0.05)
ALONE = {
    "collision": replace(NOTHING, margin=0.05),
    "self_collision": replace(NOTHING, self_margin=0.05),
    "length": replace(NOTHING, length=1.0),
}
"""Each cost as the only one, in steps of moderate size."""
PANDA = rd.load_robot("panda")
CROWD = Sphere([0.45, 0.1, 0.5], 0.2), Box([0.0, 0.5, 0.4], [0.3, 0.2, 0.3]), Sphere([-0.4, -0.3, 0.4], 0.2)
CROWDED = CollisionChecker(PANDA, rd.Scene(CROWD))


def random_motions(seed: int, count: int = 4, waypoints: int = 32) -> ndarray:
    rng = np.random.default_rng(seed)
    ends = rng.uniform(PANDA.lower, PANDA.upper, (2, count, 1, PANDA.dof))
    t = np.linspace(0.0, 1.0, waypoints)[:, None]
    q = ends[0] + t * (ends[1] - ends[0])
    for harmonic in (1, 2, 5):
        q = q + np.sin(np.pi * harmonic * t) * rng.normal(0.0, 0.5 / harmonic, (count, 1, PANDA.dof))
    return np.clip(q, PANDA.lower, PANDA.upper).astype(np.float32)


def formulas(guidance: CollisionGuidance, q: ndarray) -> dict[str, ndarray]:
    """The enabled costs of trajectories [count, waypoints, dof], [count]: in rad²; costs of collision in m²."""
    found = {"length": 0.5 * (np.diff(q, axis=1) ** 2).sum((1, 2))}
    for name, margin in {"collision": guidance.settings.margin, "self_collision": guidance.settings.self_margin}.items():
        if margin is not None:
            both = (margin, float(OFF)) if name == "collision" else (float(OFF), margin)
            costs, _ = guidance.checker.cost_gradients(q.reshape(-1, q.shape[2]), *both)
            found[name] = costs.reshape(q.shape[:2]).sum(1)
    return found


@pytest.mark.parametrize("name", ALONE)
@settings(max_examples=15)
@given(seed=st.integers(0, 10_000))
def test_steps_descend(name: str, seed: int) -> None:
    guidance = CollisionGuidance(CROWDED, ALONE[name])
    q = random_motions(seed)
    before = formulas(guidance, q)[name]
    for _ in range(4):
        moved = guidance(q, 1)
        after = formulas(guidance, moved)[name]
        assert (after <= before * (1 + 1e-5) + 1e-7).all(), "up to rounding in float32"
        np.testing.assert_array_equal(moved[:, [0, -1]], q[:, [0, -1]])
        assert ((moved >= PANDA.lower.astype(np.float32)) & (moved <= PANDA.upper.astype(np.float32))).all()
        q = moved
        before = after


def test_a_full_step_is_newton_s() -> None:
    """The formula has its minimum at the waypoint that a round moves last."""
    guidance = CollisionGuidance(CROWDED, ALONE["length"])
    middle = (PANDA.lower + PANDA.upper) * 0.35
    q = 0.3 * random_motions(2, count=1, waypoints=7) + middle.astype(np.float32)
    moved = guidance(q, 1)
    shift = np.zeros_like(q, float)
    for joint in range(PANDA.dof):
        shift[:] = 0.0
        shift[0, 4, joint] = 1e-3
        above, below = (formulas(guidance, moved + sign * shift)["length"][0] for sign in (1, -1))
        assert (above - below) / 2e-3 == pytest.approx(0.0, abs=1e-5)


def test_together_they_reach_a_free_and_short_path_that_none_reaches_alone() -> None:
    """A zigzag through a ball: the cost of collision alone leaves the zigzag, that of length alone the path in the ball."""
    checker, (line, _) = swing()
    line[1::2, 0] += 0.05
    line[-1, 0] = 0.8

    def reached(settings: GuidanceSettings) -> tuple[bool, float]:
        moved = CollisionGuidance(checker, settings)(line[None], 60)
        return bool(checker.free(moved[0].astype(float)).all()), float((np.diff(moved[0], 2, axis=0) ** 2).sum())

    free, bent = reached(GuidanceSettings())
    assert free
    for name in ("collision", "length"):
        alone_free, alone_bent = reached(ALONE[name])
        assert not alone_free or alone_bent > 2 * bent, name


HAND = "panda_hand"
TILTED = np.array([-0.6, 0.2, 0.0, -2.0, 0.0, 2.2, 0.2])
REACHED = np.array([0.6, 0.2, 0.0, -2.0, 0.0, 2.2, 0.2])
AT = PANDA.fk(TILTED, HAND)[:3, 3]
EACH: list[Constraint] = [
    rd.AxisCone(HAND, [0, 0, 1], [0, 0, -1], 0.2),
    rd.PositionBox(HAND, [0.2, -0.6, AT[2] - 0.02], [0.8, 0.6, AT[2] + 0.02]),
    rd.OnPlane(HAND, AT, [0, 0, 1], 0.002),
    rd.OnLine(HAND, AT, [0, 1, 0], 0.002),
    rd.CartesianLine(HAND),
]
NO_OTHERS = replace(NOTHING, push=0.3)
NO_OBSTACLES = CollisionChecker(PANDA, rd.Scene())


def ready(*constraints: Constraint) -> PathConstraints:
    return PathConstraints(rd.Problem(PANDA, rd.Scene(), TILTED, REACHED, constraints=constraints))


def waves(seed: int = 0) -> np.ndarray:
    t = np.linspace(0, 1, 24)[:, None]
    bumps = np.sin(np.pi * t) * np.random.default_rng(seed).normal(0.0, 0.4, (4, 1, PANDA.dof))
    return (TILTED + t * (REACHED - TILTED) + bumps).astype(np.float32)


def constraint_cost(constraints: PathConstraints, share: float, q: np.ndarray) -> np.ndarray:
    """The cost of trajectories [count, waypoints, dof], [count]: the sum of h² / 2 over rows and waypoints."""
    unit = np.where(constraints.rows.row_kind == DISTANCE, 1.0, ANGLE_WEIGHT)
    beyond = constraints.values(q.reshape(-1, q.shape[2])) - constraints.limits(share)
    return 0.5 * ((unit * np.maximum(beyond, 0.0)) ** 2).sum(axis=1).reshape(q.shape[:2]).sum(axis=1)


@pytest.mark.parametrize("constraint", EACH, ids=lambda one: one.kind)
def test_steps_go_down_until_all_waypoints_keep_it(constraint: Constraint) -> None:
    constraints = ready(constraint)
    guidance = CollisionGuidance(NO_OBSTACLES, NO_OTHERS, constraints, 0.95)
    q = waves()
    before = constraint_cost(constraints, 0.95, q)
    off = before > 0
    assert off.sum() >= 3
    many = guidance(q, 30)
    assert (constraint_cost(constraints, 0.95, guidance(q, 1)) < before)[off].all()
    np.testing.assert_array_equal(many[:, [0, -1]], q[:, [0, -1]])
    assert constraints.satisfied(many.reshape(-1, PANDA.dof).astype(np.float64)).all()


def test_steps_are_no_longer_than_pushes() -> None:
    moved = CollisionGuidance(NO_OBSTACLES, NO_OTHERS, ready(EACH[2]), 0.95)(waves(), 1)
    assert np.linalg.norm(moved - waves(), axis=2).max() <= NO_OTHERS.push * (1 + 1e-6)
