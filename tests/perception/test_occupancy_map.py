"""Voxel maps from many views, against the scenes that the views show."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import robotdiffuse as rd
from helpers.panda import HOME, PANDA
from helpers.refusals import refuses
from robotdiffuse.perception.depth_view import DepthNoise
from robotdiffuse.perception.observed_volume import FREE, OUT, carve_view
from robotdiffuse.perception.occupancy_map import OccupancyMap
from robotdiffuse.perception.ray_caster import looking_at, ray_cast, voxels_within
from robotdiffuse.perception.voxel_grid import MAP

FLOOR, CRATE = rd.Box((0, 0, -0.05), (6, 6, 0.1)), rd.Box((0.6, 0.3, 0.2), (0.3, 0.3, 0.4))
SCENE = rd.Scene([FLOOR, CRATE])


@cache
def view_from(bearing: float, scene: rd.Scene = SCENE) -> rd.DepthView:
    T = looking_at(np.array([1.5 * np.cos(bearing), 1.5 * np.sin(bearing), 0.8]), np.array([0.2, 0.0, 0.3]))
    return ray_cast(scene, T, (290.0, 290.0, 159.5, 119.5), (320, 240), PANDA, HOME)


def true(margin: float) -> np.ndarray:
    return voxels_within(SCENE, MAP, margin)


@pytest.mark.parametrize("noisy", (False, True))
def test_free_voxels_hold_no_obstacle_and_most_of_the_space_is_seen(noisy: bool) -> None:
    rng = np.random.default_rng(0)
    known, clean = OccupancyMap(PANDA), OccupancyMap(PANDA)
    for bearing in np.linspace(-1.5, 1.5, 5):
        view = view_from(bearing)
        known.add(DepthNoise().applied(view, rng) if noisy else view)
        clean.add(view)
    assert not (known.free & known.occupied).any()
    assert (known.free & true(-0.0)).sum() <= (1e-3 if noisy else 1e-4) * known.free.sum()
    assert (known.free & clean.free).sum() > 0.9 * clean.free.sum()
    assert (known.occupied & ~true(0.06)).sum() <= 0.02 * known.occupied.sum(), "neither speckles nor the arm"


def test_what_obstacles_may_reach_is_free_only_by_a_margin_of_the_own_error() -> None:
    """Regression: points enlarged by the pose error of a far camera closed gaps, even if a near camera saw the gaps free."""
    known = OccupancyMap(PANDA)
    far = replace(view_from(0.3), pose_deviation=(0.005, 0.0175))
    known.add(far)
    before = known.free
    points = MAP.centers(np.argwhere(known.occupied))
    errors = np.full(len(points), 0.03)
    known.doubt(points, errors)
    reached = MAP.within(np.column_stack([points, errors]))
    doubted = before & ~known.free
    assert 0 < doubted.sum() < 0.2 * before.sum() and (doubted <= MAP.within(np.column_stack([points, errors + 0.03]))).all()
    narrow = carve_view(far, PANDA, HOME, MAP, narrowed=1.0)[0] == FREE
    assert (known.free & reached <= narrow).all() and known.unknown[doubted].all()
    declared = OccupancyMap(PANDA)
    declared.declare_free(((-1.0, -1.0, -0.4), (1.0, 1.0, 1.1)))
    zone = declared.free
    declared.doubt(points, errors)
    assert (declared.free == zone).all(), "declared free until a view finds it occupied"
    known.add(view_from(0.3))
    known.doubt(points, errors)
    assert (known.free[doubted & ~known.occupied]).mean() > 0.9, "an exact view leaves no doubt"


def test_a_view_counts_once_and_the_order_does_not_matter() -> None:
    ahead, back = OccupancyMap(PANDA), OccupancyMap(PANDA)
    views = [view_from(b) for b in (-1.0, 0.2, 1.1)]
    for first, last in zip(views, reversed(views), strict=True):
        ahead.add(first)
        back.add(last)
    np.testing.assert_array_equal(ahead.free, back.free)
    np.testing.assert_array_equal(ahead.occupied, back.occupied)


def test_a_voxel_is_the_same_wherever_its_block_begins() -> None:
    """If all voxels of a block are free, or all are outside of the image, they are decided together."""
    states = []
    for shift in (0.0, MAP.edge):
        x, y, z = (side + shift for side in MAP.low)
        states.append(carve_view(view_from(0.3), PANDA, HOME, replace(MAP, low=(x, y, z)))[0])
    assert {FREE, OUT} < set(np.unique(states[0]))
    assert (states[0][1:, 1:, 1:] != states[1][:-1, :-1, :-1]).mean() < 1e-4


def test_what_went_away_becomes_free_and_old_evidence_is_forgotten() -> None:
    middle = tuple(np.floor((np.array([0.451, 0.29, 0.31]) - MAP.low) / MAP.edge).astype(int))
    known = OccupancyMap(PANDA)
    known.add(view_from(2.8))
    assert known.occupied[middle]
    for _ in range(3):
        known.add(view_from(2.8, scene=rd.Scene([FLOOR])))
    assert known.free[middle]
    aging = OccupancyMap(PANDA, max_age=1.0)
    aging.add(view_from(2.8), stamp=10.0)
    assert aging.occupied[middle]
    aging.add(view_from(-1.4, scene=rd.Scene([FLOOR])), stamp=12.0)
    assert not aging.occupied[middle]


def test_what_appears_in_space_that_was_often_seen_free_is_there_at_once() -> None:
    """Regression: what was seen free from two sides stayed free, and a motion went through what had just appeared."""
    known = OccupancyMap(PANDA)
    for bearing in (2.8, -1.4, 0.3, -0.9):
        known.add(view_from(bearing, scene=rd.Scene([FLOOR])))
    y, z = np.meshgrid(np.arange(0.21, 0.4, 0.02), np.arange(0.11, 0.31, 0.02))
    front, behind = (np.column_stack([np.full(y.size, x), y.ravel(), z.ravel()]) for x in (0.451, 0.485))
    assert MAP.hold(known.free, front).all() and MAP.hold(known.free, behind).all()
    before = known.free
    known.add(view_from(2.8))
    assert MAP.hold(known.occupied, front).mean() > 0.9
    assert MAP.hold(known.stale, behind).mean() > 0.9 and not MAP.hold(known.free, behind).any(), "only its front is seen"
    assert (before & ~known.free & ~true(0.06)).sum() < 1e-3 * before.sum()
    known.add(view_from(2.8, scene=rd.Scene([FLOOR])))
    assert MAP.hold(known.stale, behind).mean() < 0.1, "the arm hides some"


def test_free_zones() -> None:
    known = OccupancyMap(PANDA)
    known.declare_free(((-0.3, -0.3, 0.0), (0.3, 0.3, 0.7)))
    assert known.free.sum() == 30 * 30 * 35
    refuses("free_zone is", known.declare_free, ((0.3, 0.0, 0.0), (0.1, 1.0, 1.0)))
    refuses(r"view\.configuration is None; a map needs", known.add, replace(view_from(0.0), configuration=None))
