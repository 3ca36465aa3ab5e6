"""Unknown voxels that a motion sweeps, sampled worlds in which the motion is free, and its confidence."""

from itertools import pairwise

import numpy as np
import pytest

import robotdiffuse as rd
from robotdiffuse.collision.kernel_arrays import compile_robot
from robotdiffuse.perception.unknown_space import (
    MAX_CONFIDENCE,
    RATES,
    WORLDS,
    CrossedSpace,
    UnknownSpace,
    confidence,
    explored_confidence,
    free_share,
)
from robotdiffuse.perception.voxel_grid import FINE, FINE_SHAPE, LOW, SHAPE, VOXEL, heaviest_part, surface, sweep
from robotdiffuse.robots.kinematics import placed_spheres

PANDA = rd.load_robot("panda")
START = np.array([-0.9, 0.3, 0.0, -1.8, 0.0, 2.1, 0.8])
TURNED = np.array([-1, 1, 1, 1, 1, 1, 1])
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
    assert free_share(certain, VOXELS) == 0 and free_share(certain, ~VOXELS & (certain < 1)) > 0


def test_near_voxels_are_occupied_together() -> None:
    """If they were independent, 1,000 voxels with a probability of 0.01 would be free in no world."""
    near = np.zeros(FINE_SHAPE, np.bool_)
    near[50:60, 50:60, 30:40] = True
    probability = np.full(FINE_SHAPE, 0.01, np.float32)
    assert 0.9 < free_share(probability, near) < 0.99


@pytest.mark.parametrize("more", [0, 9])
def test_nothing_that_may_be_occupied_is_free_in_every_world(more: int) -> None:
    """Regression: in a grid larger than the observed volume, such as the map of an exploration, an index was
    out of bounds."""
    shape = tuple(size + more for size in FINE_SHAPE)
    assert free_share(np.zeros(shape, np.float32), np.ones(shape, np.bool_)) == 1
    assert free_share(np.ones(shape, np.float32), np.ones(shape, np.bool_)) == 0
    assert free_share(np.ones(shape, np.float32), np.zeros(shape, np.bool_)) == 1


def test_confidence_falls_with_the_predicted_probability_or_is_the_rate_of_the_assumption() -> None:
    crossed = [CrossedSpace(VOXELS, np.full(FINE_SHAPE, p, np.float32)) for p in (0, 0.01, 0.1, 0.5, 1)]
    stated = [confidence("predicted, p > 0.1", one) for one in crossed]
    assert stated[0] == MAX_CONFIDENCE and stated[-1] == 0 and all(b < a for a, b in pairwise(stated))
    explored = [explored_confidence(risk) for risk in (0.0, 0.1, 1.0, 10.0, 1000.0)]
    assert all(0 <= b <= a <= 1 for a, b in pairwise(explored))
    assert all(confidence(name, CrossedSpace(VOXELS, None)) == rate for name, rate in RATES.items())


def test_only_what_the_arm_fills_at_the_ends_is_left_out_without_a_margin() -> None:
    """Regression: the stated confidence was 0.98 for a hand that grazes an unseen cupboard beside its goal."""
    path = rd.Path(PANDA.joint_names, np.stack([START, START + 0.015, START]))
    filled = FINE.filled(PANDA, [START])
    arguments = PANDA, START[None], np.ones(FINE_SHAPE, np.bool_), np.full(FINE_SHAPE, 0.01, np.float32)
    bare = UnknownSpace(*arguments, margin=0.0).crossed(path)
    usual = UnknownSpace(*arguments).crossed(path)
    assert bare.voxels.any() and not (bare.voxels & filled).any()
    assert not usual.voxels.any() and usual.risk == 0
    assert bare.risk is not None and np.isclose(bare.risk, 0.01 * bare.voxels.sum(), rtol=1e-4)


def test_swept_voxels_are_those_in_the_spheres_along_the_way() -> None:
    path = np.stack([START, START * TURNED]).astype(np.float32)
    swept = np.zeros(SHAPE, np.bool_)
    sweep(compile_robot(PANDA), path, np.float32(0), np.array(LOW, np.float32), np.float32(VOXEL), swept)
    some = np.argwhere(np.ones(SHAPE))[::7]
    centers = (some + 0.5) * VOXEL + LOW
    moving = {link for link in PANDA.spheres if PANDA.link_frame(link) > 0}
    fixed = sum(len(spheres) for link, spheres in PANDA.spheres.items() if link not in moving)
    for t in (0.0, 0.5, 1.0):
        spheres = placed_spheres(PANDA, START + t * (START * TURNED - START))[fixed:]
        distances = np.linalg.norm(centers[:, None] - spheres[None, :, :3], axis=2) - spheres[:, 3]
        within = (distances < -0.002).any(axis=1)
        assert within.sum() > 20 and swept[tuple(some[within].T)].all()


def test_the_part_that_weighs_most_is_boxed() -> None:
    marked = np.zeros((6, 7, 8), np.bool_)
    weights = np.ones((6, 7, 8), np.float32)
    marked[0, 0, :3] = True
    marked[5, 6, 7] = True
    marked[3:5, 3, 3] = True
    assert heaviest_part(marked, weights).tolist() == [[0, 0, 0], [1, 1, 3]]
    weights[5, 6, 7] = 4.0
    assert heaviest_part(marked, weights).tolist() == [[5, 6, 7], [6, 7, 8]]
    assert not heaviest_part(np.zeros_like(marked), weights).any()


def test_the_surface_is_what_has_a_face_outside() -> None:
    marked = np.zeros((5, 5, 5), np.bool_)
    marked[1:4, 1:4, 1:4] = True
    assert len(surface(marked)) == 26 and [2, 2, 2] not in surface(marked).tolist()
    assert len(surface(np.ones((3, 3, 3), np.bool_))) == 0
