"""Noise of depth images: its size as estimated, and what the filter leaves."""

import numpy as np
import pytest

from robotdiffuse import Box, DepthView, Scene, load_robot
from robotdiffuse.perception.depth_filter import depth_spread, filtered, grown_for_noise
from robotdiffuse.perception.depth_view import DepthNoise
from robotdiffuse.perception.observed_volume import observe
from robotdiffuse.perception.ray_caster import looking_at, ray_cast
from robotdiffuse.perception.seen_points import seen_points

PANDA = load_robot("panda")
HOME = np.array([0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785])
FLOOR, CRATE = Box((0, 0, -0.05), (6, 6, 0.1)), Box((0.6, 0.3, 0.2), (0.3, 0.3, 0.4))


def view_from(distance: float) -> DepthView:
    T = looking_at(np.array([distance, 0.0, 0.8]), np.array([0.2, 0.0, 0.3]))
    return ray_cast(Scene([FLOOR, CRATE]), T, (290.0, 290.0, 159.5, 119.5), (320, 240), PANDA, HOME)


@pytest.mark.parametrize("spread", (0.001, 0.0015, 0.004))
@pytest.mark.parametrize("distance", (1.2, 2.5))
def test_the_estimated_noise_is_that_of_the_sensor(spread: float, distance: float) -> None:
    noisy = DepthNoise(spread=spread).applied(view_from(distance), np.random.default_rng(0))
    assert 0.85 < depth_spread(noisy.depth) / spread < 1.35, "edges and stray pixels add to it"


def test_images_without_noise_are_taken_as_they_are() -> None:
    view = view_from(1.5)
    depth, spread = filtered(view)
    assert spread == 0.0
    np.testing.assert_array_equal(depth, view.depth)
    assert depth_spread(np.zeros((240, 320), np.float32)) == 0.0, "without returns"


def test_the_filter_takes_the_median_of_the_returns_and_adds_none() -> None:
    rng = np.random.default_rng(2)
    depth = rng.uniform(1.0, 2.0, (60, 50)).astype(np.float32)
    depth[rng.random(depth.shape) < 0.2] = 0.0
    found = filtered(DepthView(depth, (40.0, 40.0, 25.0, 30.0), np.eye(4))).depth
    for v, u in np.ndindex(depth.shape):
        around = depth[max(v - 1, 0) : v + 2, max(u - 1, 0) : u + 2]
        returns = np.sort(around[around > 0])
        enough = depth[v, u] > 0 and len(returns) >= 4
        assert found[v, u] == (returns[(len(returns) - 1) // 2] if enough else 0.0)


@pytest.mark.parametrize("distance", (1.5, 3.0))
def test_points_of_the_arm_are_taken_away_with_noise_too(distance: float) -> None:
    """A fixed margin of 2 cm left points of the arm, three deviations from it, and starts collided."""
    view = DepthNoise().applied(view_from(distance), np.random.default_rng(1))
    points = seen_points([view], PANDA, HOME)
    above = points[(np.abs(points[:, 1]) < 0.12) & (points[:, 2] > 0.25)]
    assert len(above) <= 2, "only the arm is there"


def test_single_stray_pixels_do_not_undo_free_space() -> None:
    view = view_from(1.5)
    ideal = observe([view], PANDA, HOME).free
    noisy = observe([DepthNoise().applied(view, np.random.default_rng(1))], PANDA, HOME).free
    assert (ideal & noisy).sum() > 0.85 * ideal.sum()


def test_spheres_grow_with_the_square_of_their_distance() -> None:
    T = looking_at(np.array([2.0, 0.0, 0.0]), np.zeros(3))
    near = np.array([1.0, 0.0, 0.0, 0.1])
    far = np.array([0.0, 0.0, 0.0, 0.1])
    grown = grown_for_noise(np.stack([near, far]), T, 0.002)[:, 3] - 0.1
    assert grown[1] == pytest.approx(4 * grown[0]) and grown[0] > 0
    assert (grown_for_noise(np.stack([near, far]), T, 0.0)[:, 3] == 0.1).all()
