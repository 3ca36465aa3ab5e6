"""The compiled steps of guidance against the formulas of their costs, written out here in NumPy."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy import ndarray

from helpers.box_arm import box_arm
from robotdiffuse.collision import CollisionChecker
from robotdiffuse.core.errors import InputError
from robotdiffuse.learning.guidance import CollisionGuidance, GuidanceSettings
from robotdiffuse.learning.guidance_kernel import OFF
from robotdiffuse.robots import load_robot
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.shapes import Box, Sphere

NOTHING = GuidanceSettings(margin=None, self_margin=None, length=0.0, push=0.05)
ALONE = {
    "collision": replace(NOTHING, margin=0.05),
    "self_collision": replace(NOTHING, self_margin=0.05),
    "length": replace(NOTHING, length=1.0),
}
"""Each cost as the only one, in steps of moderate size."""
PANDA = load_robot("panda")
CROWDED = CollisionChecker(
    PANDA,
    Scene(
        [Sphere([0.45, 0.1, 0.5], 0.2), Box([0.0, 0.5, 0.4], [0.3, 0.2, 0.3]), Sphere([-0.4, -0.3, 0.4], 0.2)]
    ),
)


def random_motions(seed: int, count: int = 4, waypoints: int = 32) -> ndarray:
    """Waves between random configurations, within the limits."""
    rng = np.random.default_rng(seed)
    ends = rng.uniform(PANDA.lower, PANDA.upper, (2, count, 1, PANDA.dof))
    t = np.linspace(0.0, 1.0, waypoints)[:, None]
    q = ends[0] + t * (ends[1] - ends[0])
    for harmonic in (1, 2, 5):
        q = q + np.sin(np.pi * harmonic * t) * rng.normal(0.0, 0.5 / harmonic, (count, 1, PANDA.dof))
    return np.clip(q, PANDA.lower, PANDA.upper).astype(np.float32)


def formulas(guidance: CollisionGuidance, q: ndarray) -> dict[str, ndarray]:
    """The enabled costs of trajectories [count, waypoints, dof] as in the docstring of `guidance`, [count].

    In rad², the collision costs in m². All waypoints count.
    """
    checker, given = guidance.checker, guidance.settings

    def collision(margin: float, self_margin: float) -> ndarray:
        costs, _ = checker.cost_gradients(q.reshape(-1, q.shape[2]), margin, self_margin)
        return costs.reshape(q.shape[:2]).sum(1)

    found: dict[str, ndarray] = {}
    if given.margin is not None:
        found["collision"] = collision(given.margin, float(OFF))
    if given.self_margin is not None:
        found["self_collision"] = collision(float(OFF), given.self_margin)
    found["length"] = 0.5 * (np.diff(q, axis=1) ** 2).sum((1, 2))
    return found


@pytest.mark.parametrize("name", ALONE)
@settings(max_examples=15)
@given(seed=st.integers(0, 10_000))
def test_steps_descend(name: str, seed: int) -> None:
    guidance, q = CollisionGuidance(CROWDED, ALONE[name]), random_motions(seed)
    before = formulas(guidance, q)[name]
    for _ in range(4):
        moved, _ = guidance(q, 1)
        after = formulas(guidance, moved)[name]
        assert (after <= before * (1 + 1e-5) + 1e-7).all(), "up to rounding in float32"
        np.testing.assert_array_equal(moved[:, [0, -1]], q[:, [0, -1]])
        assert ((moved >= PANDA.lower.astype(np.float32)) & (moved <= PANDA.upper.astype(np.float32))).all()
        q, before = moved, after


@pytest.mark.parametrize("name", ALONE)
def test_steps_go_down_the_slope(name: str) -> None:
    """The formulas' slopes along the step of the compiled code, by finite differences."""
    gentle = replace(ALONE[name], push=1e-3, length=min(ALONE[name].length, 0.01))
    guidance = CollisionGuidance(CROWDED, gentle)
    q = random_motions(1, count=8)
    move = guidance(q, 1)[0].astype(float) - q
    moving = np.abs(move).max((1, 2)) > 0
    assert moving.sum() >= 4, "a cost that is met"
    ahead, behind = (formulas(guidance, q + sign * 0.1 * move)[name] for sign in (1, -1))
    assert (ahead < behind)[moving].all()
    np.testing.assert_array_equal(formulas(guidance, q)[name][~moving], 0)


def test_a_full_step_is_newton_s() -> None:
    """The formula is smallest in the waypoint that a round moves last."""
    guidance = CollisionGuidance(CROWDED, ALONE["length"])
    middle = (PANDA.lower + PANDA.upper) * 0.35
    q = 0.3 * random_motions(2, count=1, waypoints=7) + middle.astype(np.float32)
    moved, _ = guidance(q, 1)
    shift = np.zeros_like(q, float)
    for joint in range(PANDA.dof):
        shift[:] = 0.0
        shift[0, 4, joint] = 1e-3
        above, below = (formulas(guidance, moved + sign * shift)["length"][0] for sign in (1, -1))
        assert (above - below) / 2e-3 == pytest.approx(0.0, abs=1e-5)


@pytest.mark.parametrize("name", ALONE)
def test_without_cost_nothing_moves(name: str) -> None:
    """A straight line far from everything: it has length, but none shorter."""
    checker = CollisionChecker(box_arm(), Scene([Sphere([5.0, 5.0, 5.0], 0.1)]))
    line = np.linspace([0.3, 0.2, 0.1], [0.9, 0.4, 0.6], 20, dtype=np.float32)[None]
    guidance = CollisionGuidance(checker, ALONE[name])
    moved, costs = guidance(line, 5)
    if name != "length":
        assert formulas(guidance, line)[name][0] < 1e-10
    np.testing.assert_allclose(moved, line, atol=1e-6 if name == "length" else 0)
    assert costs[0] == 0


def test_formula_by_hand() -> None:
    upper = PANDA.upper
    costs = formulas(
        CollisionGuidance(CROWDED, NOTHING), np.stack([upper - 1.0, upper - 0.2, upper - 0.6])[None]
    )
    assert costs.keys() == {"length"}, "no margin, no collision"
    assert costs["length"][0] == pytest.approx(0.5 * PANDA.dof * (0.8**2 + 0.4**2))


def test_collision_costs_add_up_to_the_checker_s() -> None:
    q = random_motions(3)
    costs = formulas(CollisionGuidance(CROWDED, GuidanceSettings(margin=0.05, self_margin=0.03)), q)
    both, _ = CROWDED.cost_gradients(q.reshape(-1, PANDA.dof), 0.05, 0.03)
    assert (costs["collision"] > 0).any() and (costs["self_collision"] > 0).any()
    np.testing.assert_allclose(
        costs["collision"] + costs["self_collision"], both.reshape(4, -1).sum(1), rtol=1e-4
    )


def test_together_they_reach_a_free_and_short_path_that_none_reaches_alone() -> None:
    """A zigzag through a ball: pushes alone leave the zigzag, length alone the ball."""
    checker = CollisionChecker(box_arm(), Scene([Sphere([1.02, 0.55, 0.0], 0.08)]))
    t = np.linspace(0.0, 1.0, 24, dtype=np.float32)[:, None]
    line = np.array([-0.8, 0.6, 0.6], np.float32) + t * np.array([1.6, 0.0, 0.0], np.float32)
    line[1::2, 0] += 0.05
    line[-1, 0] = 0.8

    def reached(settings: GuidanceSettings) -> tuple[bool, float]:
        moved, _ = CollisionGuidance(checker, settings)(line[None], 60)
        bends = float((np.diff(moved[0], 2, axis=0) ** 2).sum())
        return bool(checker.free(moved[0].astype(float)).all()), bends

    free, bent = reached(GuidanceSettings())
    assert free
    for name in ("collision", "length"):
        alone_free, alone_bent = reached(ALONE[name])
        assert not alone_free or alone_bent > 2 * bent, name


def test_bad_input_is_refused() -> None:
    for name, value in (("self_margin", -0.1), ("length", 1.5), ("margin", float("nan"))):
        with pytest.raises(InputError, match=f"guidance.{name} is {value}"):
            replace(GuidanceSettings(), **{name: value})
