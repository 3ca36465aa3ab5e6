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
from robotdiffuse.core.registry import Entry
from robotdiffuse.learning.costs import COSTS
from robotdiffuse.learning.guidance import CollisionGuidance, GuidanceSettings
from robotdiffuse.learning.guidance_kernel import OFF
from robotdiffuse.robots import load_robot
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.shapes import Box, Sphere

NOTHING = GuidanceSettings(margin=None, self_margin=None, smoothness=0.0, length=0.0, push=0.05)
ALONE = {
    "collision": replace(NOTHING, margin=0.05),
    "self_collision": replace(NOTHING, self_margin=0.05),
    "limits": replace(NOTHING, limit_margin=0.4),
    "smoothness": replace(NOTHING, smoothness=1.0),
    "length": replace(NOTHING, length=1.0),
}
"""Each cost as the only one, in steps of moderate size."""
EVERYTHING = GuidanceSettings(limit_margin=0.2, smoothness=0.5)
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
    lower, upper = checker.robot.lower, checker.robot.upper

    def collision(margin: float, self_margin: float) -> ndarray:
        costs, _ = checker.cost_gradients(q.reshape(-1, q.shape[2]), margin, self_margin)
        return costs.reshape(q.shape[:2]).sum(1)

    found: dict[str, ndarray] = {}
    if given.margin is not None:
        found["collision"] = collision(given.margin, float(OFF))
    if given.self_margin is not None:
        found["self_collision"] = collision(float(OFF), given.self_margin)
    if given.limit_margin is not None:
        hinge = np.minimum(given.limit_margin, (upper - lower) / 2) - np.minimum(q - lower, upper - q)
        found["limits"] = 0.5 * (np.maximum(hinge, 0.0) ** 2).sum((1, 2))
    found["smoothness"] = 0.5 * (np.diff(q, 2, axis=1) ** 2).sum((1, 2))
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
    gentle = {"push": 1e-3, "smoothness": min(ALONE[name].smoothness, 0.01)}
    gentle["length"] = min(ALONE[name].length, 0.01)
    guidance = CollisionGuidance(CROWDED, replace(ALONE[name], **gentle))
    q = random_motions(1, count=8)
    move = guidance(q, 1)[0].astype(float) - q
    moving = np.abs(move).max((1, 2)) > 0
    assert moving.sum() >= 4, "a cost that is met"
    ahead, behind = (formulas(guidance, q + sign * 0.1 * move)[name] for sign in (1, -1))
    assert (ahead < behind)[moving].all()
    np.testing.assert_array_equal(formulas(guidance, q)[name][~moving], 0)


@pytest.mark.parametrize(("name", "last"), [("smoothness", 3), ("length", 4)])
def test_a_full_step_is_newton_s(name: str, last: int) -> None:
    """The formula is smallest in the waypoint that a round moves last."""
    guidance = CollisionGuidance(CROWDED, ALONE[name])
    middle = (PANDA.lower + PANDA.upper) * 0.35
    q = 0.3 * random_motions(2, count=1, waypoints=7) + middle.astype(np.float32)
    moved, _ = guidance(q, 1)
    shift = np.zeros_like(q, float)
    for joint in range(PANDA.dof):
        shift[:] = 0.0
        shift[0, last, joint] = 1e-3
        above, below = (formulas(guidance, moved + sign * shift)[name][0] for sign in (1, -1))
        assert (above - below) / 2e-3 == pytest.approx(0.0, abs=1e-5)


@pytest.mark.parametrize("name", ALONE)
def test_without_cost_nothing_moves(name: str) -> None:
    """A straight line far from everything: it has length, but none shorter."""
    checker = CollisionChecker(box_arm(), Scene([Sphere([5.0, 5.0, 5.0], 0.1)]))
    line = np.linspace([0.3, 0.2, 0.1], [0.9, 0.4, 0.6], 20, dtype=np.float32)[None]
    guidance = CollisionGuidance(
        checker, replace(ALONE[name], limit_margin=ALONE[name].limit_margin and 0.05)
    )
    moved, costs = guidance(line, 5)
    if name != "length":
        assert formulas(guidance, line)[name][0] < 1e-10
    np.testing.assert_allclose(
        moved, line, atol=0 if name in ("collision", "self_collision", "limits") else 1e-6
    )
    assert costs[0] == 0


def test_formulas_by_hand() -> None:
    checker = CollisionChecker(box_arm(), Scene())
    guidance = CollisionGuidance(checker, replace(NOTHING, limit_margin=0.5))
    upper = checker.robot.upper
    q = np.stack([upper - 1.0, upper - 0.2, upper - 0.6])[None]
    costs = formulas(guidance, q)
    assert costs.keys() == {"limits", "smoothness", "length"}, "no margin, no collision"
    assert costs["limits"][0] == pytest.approx(0.5 * 3 * 0.3**2)
    assert costs["smoothness"][0] == pytest.approx(0.5 * 3 * 1.2**2)
    assert costs["length"][0] == pytest.approx(0.5 * 3 * (0.8**2 + 0.4**2))


def test_collision_costs_add_up_to_the_checker_s() -> None:
    q = random_motions(3)
    costs = formulas(CollisionGuidance(CROWDED, GuidanceSettings(margin=0.05, self_margin=0.03)), q)
    both, _ = CROWDED.cost_gradients(q.reshape(-1, PANDA.dof), 0.05, 0.03)
    assert (costs["collision"] > 0).any() and (costs["self_collision"] > 0).any()
    np.testing.assert_allclose(
        costs["collision"] + costs["self_collision"], both.reshape(4, -1).sum(1), rtol=1e-4
    )


def half_to_zero(_checker: CollisionChecker, q: ndarray, strength: float) -> ndarray:
    """A cost step that draws the first joint to zero."""
    return q * np.where(np.arange(q.shape[2]) == 0, 1 - strength, 1)


def test_an_extra_cost_acts_after_the_compiled_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(COSTS, "drawn", Entry(f"{__name__}:half_to_zero", "for tests"))
    q = random_motions(5)
    guidance = CollisionGuidance(CROWDED, replace(NOTHING, extra_costs={"drawn": 0.5}))
    moved, _ = guidance(q, 3)
    np.testing.assert_allclose(moved[:, 1:-1, 0], q[:, 1:-1, 0] / 8, rtol=1e-5)
    np.testing.assert_array_equal(moved[:, [0, -1]], q[:, [0, -1]])
    with pytest.raises(InputError, match="unknown guidance cost 'lenght'"):
        replace(NOTHING, extra_costs={"lenght": 0.5})


def test_together_they_reach_a_free_and_smooth_path_that_none_reaches_alone() -> None:
    """A line through a ball, with a jerk in it: pushes alone leave the jerk, the others alone the ball."""
    checker = CollisionChecker(box_arm(), Scene([Sphere([1.02, 0.55, 0.0], 0.08)]))
    t = np.linspace(0.0, 1.0, 24, dtype=np.float32)[:, None]
    line = np.array([-0.8, 0.6, 0.6], np.float32) + t * np.array([1.6, 0.0, 0.0], np.float32)
    line[1::2, 0] += 0.05
    line[-1, 0] = 0.8

    def reached(settings: GuidanceSettings) -> tuple[bool, float]:
        moved, _ = CollisionGuidance(checker, settings)(line[None], 60)
        costs = formulas(CollisionGuidance(checker, EVERYTHING), moved)
        return bool(checker.free(moved[0].astype(float)).all()), float(costs["smoothness"][0])

    free, bent = reached(replace(EVERYTHING, limit_margin=None))
    assert free
    for name in ("collision", "smoothness", "length"):
        alone_free, alone_bent = reached(ALONE[name])
        assert not alone_free or alone_bent > 2 * bent, name


def test_waypoints_near_limits_come_back() -> None:
    q = random_motions(4)
    q[..., 5] = PANDA.upper[5]
    q[:, [0, -1], 5] = PANDA.upper[5] - 0.5
    moved, costs = CollisionGuidance(CROWDED, ALONE["limits"])(q, 60)
    assert (moved[:, 1:-1, 5] <= PANDA.upper[5] - 0.4 + 1e-3).all()
    assert (costs < 1e-4).all()


def test_bad_input_is_refused() -> None:
    for name, value in (("limit_margin", -0.1), ("smoothness", 1.5), ("margin", float("nan"))):
        with pytest.raises(InputError, match=f"guidance.{name} is {value}"):
            replace(GuidanceSettings(), **{name: value})
