"""Voxels that an arm sweeps, their surface, and their heaviest connected part."""

import numpy as np

from robotdiffuse import load_robot
from robotdiffuse.collision.kernel_arrays import compile_robot
from robotdiffuse.perception.voxel_grid import LOW, SHAPE, VOXEL, heaviest_part, surface, sweep
from robotdiffuse.robots.kinematics import placed_spheres

PANDA = load_robot("panda")
START = np.array([-0.9, 0.3, 0.0, -1.8, 0.0, 2.1, 0.8])
GOAL = np.array([0.9, 0.3, 0.0, -1.8, 0.0, 2.1, 0.8])


def test_swept_voxels_are_those_in_the_spheres_along_the_way() -> None:
    path = np.stack([START, GOAL]).astype(np.float32)
    swept = np.zeros(SHAPE, np.bool_)
    sweep(compile_robot(PANDA), path, np.float32(0), np.array(LOW, np.float32), np.float32(VOXEL), swept)
    centers = (np.argwhere(np.ones(SHAPE)) + 0.5) * VOXEL + LOW
    moving = {link for link in PANDA.spheres if PANDA.link_frame(link) > 0}
    fixed = sum(len(spheres) for link, spheres in PANDA.spheres.items() if link not in moving)
    for t in (0.0, 0.5, 1.0):
        spheres = placed_spheres(PANDA, START + t * (GOAL - START))[fixed:]
        distances = np.linalg.norm(centers[:, None] - spheres[None, :, :3], axis=2) - spheres[:, 3]
        within = (distances < -0.002).any(axis=1).reshape(SHAPE)
        assert within.any() and swept[within].all()


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
