"""Sampled worlds, in which a motion through unknown space is free or not."""

import numpy as np
import pytest

from robotdiffuse.perception.unknown_space import WORLDS, free_share
from robotdiffuse.perception.voxel_grid import FINE_SHAPE

RNG = np.random.default_rng(0)
VOXELS = np.zeros(FINE_SHAPE, np.bool_)
VOXELS[40:70, 40:50, 20:40] = True
UNLIKELY = np.full(FINE_SHAPE, 1e-4, np.float32)


@pytest.mark.parametrize("p", [0.05, 0.3, 0.9])
def test_each_voxel_keeps_its_probability(p: float) -> None:
    probability = np.full(FINE_SHAPE, p, np.float32)
    shares = []
    for at in RNG.integers(FINE_SHAPE, size=(100, 3)):
        one = np.zeros(FINE_SHAPE, np.bool_)
        one[tuple(at)] = True
        shares.append(free_share(probability, one))
    # four standard errors of one voxel's 256 worlds; the voxels' shares depend on each other
    assert abs(np.mean(shares) - (1 - p)) < 4 * np.sqrt(p * (1 - p) / WORLDS)


def test_a_certain_voxel_in_the_way_leaves_no_world_free() -> None:
    certain = UNLIKELY.copy()
    certain[tuple(np.argwhere(VOXELS)[0])] = 1.0
    assert free_share(certain, VOXELS) == 0
    assert free_share(certain, ~VOXELS & (certain < 1)) > 0


def test_nothing_that_may_be_occupied_is_free_in_every_world() -> None:
    assert free_share(np.zeros(FINE_SHAPE, np.float32), np.ones(FINE_SHAPE, np.bool_)) == 1
    assert free_share(np.ones(FINE_SHAPE, np.float32), np.zeros(FINE_SHAPE, np.bool_)) == 1


def test_more_voxels_and_higher_probabilities_are_free_in_fewer_worlds() -> None:
    probability = 0.2 * RNG.random(FINE_SHAPE).astype(np.float32) ** 4
    fewer = VOXELS & (RNG.random(FINE_SHAPE) < 0.5)
    share = free_share(probability, VOXELS)
    assert 0 < free_share(2 * probability, VOXELS) < share < free_share(probability, fewer) < 1


def test_near_voxels_are_occupied_together() -> None:
    """As independent ones, 1,000 voxels with a probability of 0.01 would be free in no world."""
    near = np.zeros(FINE_SHAPE, np.bool_)
    near[50:60, 50:60, 30:40] = True
    probability = np.full(FINE_SHAPE, 0.01, np.float32)
    assert 0.9 < free_share(probability, near) < 0.99


def test_a_grid_larger_than_the_observed_volume() -> None:
    """The map of an exploration is one; an index was out of bounds."""
    shape = tuple(size + 9 for size in FINE_SHAPE)
    assert free_share(np.zeros(shape, np.float32), np.ones(shape, np.bool_)) == 1
    assert free_share(np.ones(shape, np.float32), np.ones(shape, np.bool_)) == 0
