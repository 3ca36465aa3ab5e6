"""Noise of depth images: its estimated size, and the noise that remains after the filter."""

from dataclasses import replace
from functools import cache
from inspect import unwrap

import numpy as np
import pytest

import robotdiffuse as rd
from helpers.panda import HOME, PANDA
from helpers.refusals import refuses
from robotdiffuse.perception.depth_filter import empty_regions, filtered, measured_share, median_filter, patch_noise
from robotdiffuse.perception.depth_view import DepthNoise
from robotdiffuse.perception.observed_volume import FREE, carve_view, observe
from robotdiffuse.perception.ray_caster import looking_at, ray_cast, voxels_within
from robotdiffuse.perception.seen_points import seen_points
from robotdiffuse.perception.voxel_grid import FINE
from robotdiffuse.planning.exploration.simulated import wrist_camera

FOCAL = 290.0
FLOOR, CRATE = rd.Box((0, 0, -0.05), (6, 6, 0.1)), rd.Box((0.6, 0.3, 0.2), (0.3, 0.3, 0.4))


@cache
def view_from(distance: float) -> rd.DepthView:
    T = looking_at(np.array([distance, 0.0, 0.8]), np.array([0.2, 0.0, 0.3]))
    return ray_cast(rd.Scene([FLOOR, CRATE]), T, (FOCAL, FOCAL, 159.5, 119.5), (320, 240), PANDA, HOME)


@pytest.mark.parametrize("spread", (0.001, 0.0015, 0.004))
@pytest.mark.parametrize("distance", (1.2, 2.5))
@pytest.mark.parametrize("correlation", (0.0, 1.5, 2.5))
def test_the_estimated_noise_is_that_of_the_sensor(spread: float, distance: float, correlation: float) -> None:
    """Regression: differences of neighboring pixels, whose errors are correlated, showed an eighth of recorded noise."""
    noise = DepthNoise(spread=spread, correlation=correlation)
    found, neighbors = patch_noise(noise.applied(view_from(distance), np.random.default_rng(0)).depth)
    assert 0.75 < found / spread < 1.2, "planes take away what goes together over a patch"
    by_hand = np.exp(-0.5 / correlation**2) if correlation else 0.0
    assert neighbors == pytest.approx(by_hand, abs=0.12)


def test_noise_is_measured_on_images_of_a_still_scene() -> None:
    view = view_from(1.2)
    noise = DepthNoise(spread=0.004, correlation=1.5, missing=0.05)
    images = [noise.applied(view, np.random.default_rng(i)).depth for i in range(4)]
    found = rd.measure_noise(images)
    # regression: depths above 1e4, which mean that nothing is in range, counted as exact
    far = [[np.where(np.arange(image.shape[1]) > 180, depth, image) for image in images] for depth in (1e6, np.inf)]
    assert rd.measure_noise(far[0]).spread == rd.measure_noise(far[1]).spread
    assert found.spread == pytest.approx(0.004, rel=0.15) and found.correlation == pytest.approx(1.5, rel=0.4)
    assert 0.04 < found.missing < 0.12
    stated = replace(noise.applied(view, np.random.default_rng(9)), noise=found)
    assert filtered(stated).spread == pytest.approx(filtered(replace(stated, noise=None)).spread, rel=0.5)
    refuses("at least two", rd.measure_noise, images[:1])
    noisy = [1 + 0.3 * np.random.default_rng(k).standard_normal((48, 64)) for k in range(5)]
    refuses("images: depth_noise.spread is 0.3", rd.measure_noise, noisy)
    refuses("images are .*a single number", unwrap(rd.measure_noise), np.array(1.0))
    refuses("images are .'not numbers'", unwrap(rd.measure_noise), ["a", "b"])
    refuses("images have depths about .*; they must be in meters", rd.measure_noise, [1000 * image for image in images])


@pytest.mark.parametrize("correlation", (0.0, 1.5))
def test_flat_surfaces_are_smoothed_and_edges_and_thin_things_stay(correlation: float) -> None:
    """Regression: correlated noise of recorded sensors passes the median, so motions kept away from it."""
    v, u = np.mgrid[:120, :160]
    clean = 1 / (0.4 + 0.001 * u + 0.0005 * v)
    clean[40:80, 60:110] = 1.0
    clean[:, 30:33] = 1.2
    view = rd.DepthView(clean, (150, 150, 80, 60), np.eye(4))
    noise = DepthNoise(spread=0.004, stray=0.0, flying=0.0, edge_missing=0.0, correlation=correlation)
    noisy = replace(noise.applied(view, np.random.default_rng(0)), noise=noise)
    smooth, spread, edge_spread = filtered(noisy)
    seen = (noisy.depth > 0) & (smooth > 0)
    errors = np.where(seen, smooth - clean, 0.0) / clean**2
    inner = np.zeros(clean.shape, np.bool_)
    for rows, columns in ((slice(46, 74), slice(66, 104)), (slice(86, 114), slice(40, 154))):
        inner[rows, columns] = True
    assert errors[inner].std() < 0.55 * edge_spread
    moved = np.where(seen, smooth - median_filter(noisy.depth), 0.0) / clean**2
    assert np.abs(moved).max() < 4 * noise.spread, "no pixel gets between two surfaces"
    same_surface = seen & (np.abs(errors) < 6 * noise.spread)  # the median takes corners from objects
    assert 0.6 < spread / errors[same_surface].std() < 1.6


@pytest.mark.parametrize("correlation", (0.0, 1.5))
def test_small_objects_are_not_smoothed_away(correlation: float) -> None:
    """Cubes of 3 cm on a floor, seen from above at 1.5 m, with a spread of 9 mm there."""
    clean = np.full((240, 320), 1.5)
    tops = np.zeros(clean.shape, np.bool_)
    for v, u in np.ndindex(9, 12):
        clean[20 + 24 * v : 28 + 24 * v, 20 + 24 * u : 28 + 24 * u] = 1.47
        tops[22 + 24 * v : 26 + 24 * v, 22 + 24 * u : 26 + 24 * u] = True
    noise = DepthNoise(spread=0.004, stray=0.0, flying=0.0, edge_missing=0.0, correlation=correlation)
    view = rd.DepthView(clean, (400, 400, 160, 120), np.eye(4))
    smooth = filtered(replace(noise.applied(view, np.random.default_rng(1)), noise=noise)).depth
    assert 0.02 < 1.5 - smooth[tops].mean() < 0.035


def test_zeros_are_told_from_nothing_in_range() -> None:
    """Regression: an open space was never seen free by a sensor that gives 0 both for no return and for nothing in range."""
    clean = view_from(1.2)
    clean = replace(clean, depth=np.where(clean.depth < 2.0, clean.depth, np.inf), range=2.0)
    view = DepthNoise(spread=0.003, correlation=1.5, missing=0.02, zeros=True).applied(clean, np.random.default_rng(0))
    nothing = np.isinf(clean.depth)
    found = empty_regions(view.depth, 2.0)
    assert nothing.mean() > 0.2 and found is not None and found[nothing].mean() > 0.95 and found[~nothing].mean() < 0.01
    hole = view.depth.copy()
    hole[150:190, 100:160] = 0.0
    empty = empty_regions(hole, 2.0)
    assert empty is not None
    assert not (empty & (clean.depth < 1.9))[150:190, 100:160].any(), "surrounded: a hole"
    assert empty_regions(np.where(np.arange(320) < 160, view.depth, 0.0), 2.0) is None, "half an image is lost"
    assert empty_regions(np.where(nothing, 0.0, 0.2 * clean.depth), 2.0) is None, "a surface too near to be measured"
    stated, silent = view, replace(view, range=None)
    free = [observe([one], PANDA, HOME).free for one in (clean, stated, silent)]
    assert free[1].sum() > 0.8 * free[0].sum() > 2 * free[2].sum()
    assert measured_share(stated) > 0.9 > measured_share(silent)


@pytest.mark.parametrize("height", (0.55, 0.6))
def test_a_board_seen_almost_edge_on_is_not_empty(height: float) -> None:
    """Regression: the board gives no return, like the open space behind it, and was seen as free."""
    board = rd.Scene([rd.Box((0.5, 0.0, 0.5), (0.4, 0.8, 0.02))])
    T = looking_at(np.array([1.6, 0.1, height]), np.array([0.5, 0.0, 0.5]), roll=0.1)
    clean = ray_cast(board, T, (FOCAL, FOCAL, 159.5, 119.5), (320, 240))
    noisy = DepthNoise(spread=0.004, correlation=1.5, zeros=True).applied(clean, np.random.default_rng(0))
    state, _, _ = carve_view(replace(noisy, range=4.0), PANDA, HOME, FINE)
    free = state == FREE
    assert free.mean() > 0.4 and not free[voxels_within(board, FINE, 0.0)].any()


def test_rays_through_the_arm_are_not_empty() -> None:
    """A gripper too near to be measured gives 0 too; the space behind it was not seen."""
    T = looking_at(np.array([0.9, 0.0, 0.8]), np.array([0.0, 0.0, 0.8]))
    view = ray_cast(rd.Scene([]), T, (FOCAL, FOCAL, 159.5, 119.5), (320, 240), PANDA, HOME)
    few = np.zeros((240, 320))
    few[:20, :20] = 3.0
    freed = observe([rd.DepthView(few, view.intrinsics, T, range=4.0)], PANDA, HOME)
    assert freed.free.any() and not (freed.free & observe([view], PANDA, HOME).shadow).any()


def test_the_arm_beside_its_own_camera_leaves_open_space_open() -> None:
    """Regression: regions beside the near arm counted as too near to be measured, so the gripper hid half of the image."""
    camera = wrist_camera(PANDA)
    q = np.array([-0.9, -1.6, -1.4, -2.3, 0.1, 1.1, -1.1])
    view = ray_cast(rd.Scene([FLOOR]), camera.poses(PANDA, q[None])[0], camera.intrinsics, camera.size, PANDA, q)
    ideal = replace(view, depth=np.where(view.depth < 0.15, 0.0, view.depth), range=4.0)
    zeros = replace(ideal, depth=np.where(np.isinf(ideal.depth), 0.0, ideal.depth))
    free, with_zeros = (observe([one], PANDA, q).free for one in (ideal, zeros))
    assert with_zeros.sum() > 0.9 * free.sum() > 10_000
    assert observe([replace(zeros, pose_deviation=(0.005, 0.0175))], PANDA, q).free.sum() > 0.7 * free.sum()


def test_a_straight_edge_is_not_the_end_of_the_image() -> None:
    """Regression: a board's edge along a row was taken for the border of a cropped image, despite returns beyond it."""
    depth = np.zeros((240, 320))
    depth[100:] = 1.0
    assert empty_regions(depth, 2.0) is None, "cropped, perhaps"
    depth[40:60, 20:50] = 1.2
    found = empty_regions(depth, 2.0)
    assert found is not None and found[:36].all()


def test_a_covered_lens_measures_nothing() -> None:
    for value in (0.0, np.nan, 0.02, -1.0):
        view = rd.DepthView(np.full((240, 320), value), (FOCAL, FOCAL, 159.5, 119.5), np.eye(4), range=3.0)
        assert measured_share(view) == 0.0 and not observe([view], PANDA, HOME).free.any()


def test_the_filter_takes_the_median_of_the_returns_and_adds_none_but_in_single_holes() -> None:
    rng = np.random.default_rng(2)
    depth = rng.uniform(1.0, 2.0, (120, 100)).astype(np.float32)
    depth[rng.random(depth.shape) < 0.2] = 0.0
    found = median_filter(depth)
    for v, u in np.ndindex(depth.shape):
        around = depth[max(v - 1, 0) : v + 2, max(u - 1, 0) : u + 2]
        returns = np.sort(around[around > 0])
        enough = len(returns) >= (4 if depth[v, u] > 0 else 6)
        assert found[v, u] == (returns[(len(returns) - 1) // 2] if enough else 0.0)


@pytest.mark.parametrize("distance", (1.5, 3.0))
def test_points_of_the_arm_are_taken_away_with_noise_too(distance: float) -> None:
    """Regression: a margin of 2 cm left points of the arm at three deviations of the noise, so starts collided."""
    points = seen_points([DepthNoise().applied(view_from(distance), np.random.default_rng(1))], PANDA, HOME)
    assert len(points[(np.abs(points[:, 1]) < 0.12) & (points[:, 2] > 0.25)]) <= 2, "only the arm is there"


def test_a_pose_that_may_be_off_narrows_free_space() -> None:
    view = view_from(1.2)
    seen = observe([view], PANDA, HOME)
    narrowed = observe([replace(view, pose_deviation=(0.005, 0.0175))], PANDA, HOME).free
    assert not (narrowed & ~(seen.free | seen.occupied)).any() and narrowed.sum() < 0.9 * seen.free.sum()


def test_noise_is_as_its_settings_say() -> None:
    rng = np.random.default_rng(1)
    none = DepthNoise(0.0, 0.0, 0.0, 0.0, 0.0, grazing=0.0)
    depth = np.full((200, 300), 2.0, np.float32)
    depth[:, 150:] = 1.0
    depth[:20] = np.inf
    view = rd.DepthView(depth, (300.0, 300.0, 150.0, 100.0), np.eye(4))
    noisy = replace(none, spread=0.003, missing=0.05).applied(view, rng).depth
    missing = noisy == 0
    near = noisy[20:, 150:]
    far = noisy[20:, :150]
    assert abs(missing.mean() - 0.05) < 0.005
    for part, at in ((near[near > 0], 1.0), (far[far > 0], 2.0)):
        assert abs(part.std() / (0.003 * at**2) - 1) < 0.03 and abs(part.mean() - at) < 1e-3
    assert not np.isfinite(noisy[:20][~missing[:20]]).any()
    flying = replace(none, flying=0.4).applied(view, rng).depth[20:]
    between = (flying > 1.001) & (flying < 1.999)
    assert not np.delete(between, 149, axis=1).any() and 0.3 < between[:, 149].mean() < 0.5
    assert abs((replace(none, stray=0.1).applied(view, rng).depth[20:] < depth[20:]).mean() - 0.1) < 0.01
    np.testing.assert_array_equal(none.applied(view, rng).depth, depth)
    refuses("missing is 1", DepthNoise, missing=1.0)
    refuses("spread is 1.5; it must be between 0 and 0.1", DepthNoise, spread=1.5)


@pytest.mark.parametrize("angle", (0.1, 0.25))
def test_a_floor_at_a_grazing_angle_gives_no_return(angle: float) -> None:
    """A floor 1 m below a horizontal camera: each row of pixels sees the floor at the row's angle below the horizon."""
    focal = 200.0
    rows = np.arange(1, 150)
    view = rd.DepthView(np.broadcast_to((focal / rows)[:, None], (len(rows), 40)), (focal, focal, 20.0, -1.0), np.eye(4))
    noise = DepthNoise(spread=0.0, stray=0.0, flying=0.0, edge_missing=0.0, grazing=angle)
    seen = np.asarray((noise.applied(view, np.random.default_rng(0)).depth > 0).all(axis=1))
    expected = np.asarray(np.arctan(rows / focal) > angle)
    assert (seen[5:-5] == expected[5:-5]).mean() > 0.97, "differences of pixels, not derivatives"
