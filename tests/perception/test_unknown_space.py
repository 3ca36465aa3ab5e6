"""Unknown voxels that a motion sweeps, and its confidence."""

from itertools import pairwise

import numpy as np
import pytest

import robotdiffuse as rd
from robotdiffuse.collision.kernel_arrays import compile_robot
from robotdiffuse.perception import occupancy_map
from robotdiffuse.perception.observed_volume import ObservedVolume
from robotdiffuse.perception.occupancy_map import EXPLORED, ONE_VIEW, CrossedSpace, UnknownSpace, probability_free
from robotdiffuse.perception.voxel_grid import FINE, FINE_SHAPE, LOW, SHAPE, VOXEL, heaviest_part, surface, sweep

PANDA = rd.load_robot("panda")
START = np.array([-0.9, 0.3, 0.0, -1.8, 0.0, 2.1, 0.8])
TURNED = np.array([-1, 1, 1, 1, 1, 1, 1])
VOXELS = np.zeros(FINE_SHAPE, np.bool_)
VOXELS[40:70, 40:50, 20:40] = True


@pytest.mark.parametrize("curve", [ONE_VIEW, EXPLORED])
def test_the_probability_that_a_motion_is_free_falls_with_its_risk(curve: tuple[float, float]) -> None:
    stated = [probability_free(risk, curve) for risk in (0.0, 0.2, 1.0, 10.0, 100.0, 1e4)]
    assert stated[0] == stated[1] and 0.95 < stated[1] < 1
    assert all(0 < b < a for a, b in pairwise(stated[1:])) and stated[-1] < 0.05


def test_confidence_follows_from_the_risk_or_is_the_rate_of_the_assumption() -> None:
    stated = occupancy_map.confidence("predicted, p > 0.1", CrossedSpace(VOXELS, np.full(FINE_SHAPE, 0.01, np.float32)))
    assert np.isclose(stated, probability_free(0.01 * VOXELS.sum(), ONE_VIEW), rtol=1e-4)
    for name, rate in occupancy_map.RATES.items():
        assert occupancy_map.confidence(name, CrossedSpace(VOXELS, None)) == rate
        assert occupancy_map.confidence(name, CrossedSpace(VOXELS, None, lost_share=0.5)) == rate / 2


def test_only_wide_regions_without_a_return_lower_the_confidence() -> None:
    lost = np.zeros(SHAPE, np.bool_)
    volume = ObservedVolume(lost, lost, lost, lost, np.zeros(SHAPE, np.float32), lost)
    assert not occupancy_map.lost_regions(volume).any()
    lost[10:12, 10:30, 10:30] = True
    assert not occupancy_map.lost_regions(volume).any()
    lost[30:34, 20:23, 4:9] = True
    assert occupancy_map.lost_regions(volume).sum() == 8 * 4 * 3 * 5


def test_only_what_the_arm_fills_at_the_ends_is_left_out_without_a_margin() -> None:
    """Regression: the stated confidence was 0.98 for a hand that grazes an unseen cupboard beside its goal."""
    path = rd.Path(PANDA.joint_names, np.stack([START, START + 0.015, START]))
    arguments = PANDA, START[None], np.ones(FINE_SHAPE, np.bool_), np.full(FINE_SHAPE, 0.01, np.float32)
    bare = UnknownSpace(*arguments, margin=0.0).crossed(path)
    usual = UnknownSpace(*arguments).crossed(path)
    assert bare.voxels.any() and not (bare.voxels & FINE.filled(PANDA, [START])).any()
    assert not usual.voxels.any() and usual.risk == 0
    assert bare.risk is not None and np.isclose(bare.risk, 0.01 * bare.voxels.sum(), rtol=1e-4)


def test_a_motion_that_leaves_the_grid_has_a_low_confidence() -> None:
    """Regression: 0.2 m below the base, where no view is evaluated, the stated confidence was 0.97."""
    nothing = np.zeros(FINE_SHAPE, np.bool_)
    for q, blind in ((START, False), (np.array([-0.9, 1.5, 0, -1.0, 0, 2.5, 0.8]), True)):
        crossed = UnknownSpace(PANDA, [q], nothing, None).crossed(rd.Path(PANDA.joint_names, np.stack([q, q * TURNED])))
        assert bool(crossed.blind) == blind and (occupancy_map.confidence("as seen", crossed) <= 0.5) == blind


def test_swept_voxels_are_those_in_the_spheres_along_the_way() -> None:
    path = np.stack([START, START * TURNED]).astype(np.float32)
    swept = np.zeros(SHAPE, np.bool_)
    sweep(compile_robot(PANDA), path, np.float32(0), np.array(LOW, np.float32), np.float32(VOXEL), swept)
    some = np.argwhere(np.ones(SHAPE))[::7]
    centers = (some + 0.5) * VOXEL + LOW
    moving = {link for link in PANDA.spheres if PANDA.link_frame(link) > 0}
    fixed = sum(len(spheres) for link, spheres in PANDA.spheres.items() if link not in moving)
    for t in (0.0, 0.5, 1.0):
        spheres = PANDA.placed_spheres(START + t * (START * TURNED - START))[fixed:]
        distances = np.linalg.norm(centers[:, None] - spheres[None, :, :3], axis=2) - spheres[:, 3]
        within = (distances < -0.002).any(axis=1)
        assert within.sum() > 20 and swept[tuple(some[within].T)].all()


def test_the_part_that_weighs_most_is_boxed_and_the_surface_is_what_has_a_face_outside() -> None:
    marked = np.zeros((6, 7, 8), np.bool_)
    weights = np.ones((6, 7, 8), np.float32)
    marked[0, 0, :3] = True
    marked[5, 6, 7] = True
    marked[3:5, 3, 3] = True
    assert heaviest_part(marked, weights).tolist() == [[0, 0, 0], [1, 1, 3]]
    weights[5, 6, 7] = 4.0
    assert heaviest_part(marked, weights).tolist() == [[5, 6, 7], [6, 7, 8]]
    assert not heaviest_part(np.zeros_like(marked), weights).any()
    marked = np.zeros((5, 5, 5), np.bool_)
    marked[1:4, 1:4, 1:4] = True
    assert len(surface(marked)) == 26 and [2, 2, 2] not in surface(marked).tolist()
    assert len(surface(np.ones((3, 3, 3), np.bool_))) == 0
