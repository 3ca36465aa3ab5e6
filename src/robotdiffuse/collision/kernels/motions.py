"""Compiled checks of straight motions in joint space, at configurations so close to each other that no point
of the arm moves further than a resolution between two of them."""

from typing import NamedTuple

import numpy as np

from robotdiffuse.collision.kernels.lane_collision import block_hits, make_workspace
from robotdiffuse.collision.kernels.simd import W, lane_numbers, store
from robotdiffuse.core.kernels import allocation_free, kernel

_ZERO, _ONE = np.float32(0.0), np.float32(1.0)
RELAXATION_SLOPE = np.float32(0.1)
"""If a start or goal is closer to the scene than the padding, the padding is reduced there, and grows by this
per radian of distance from that configuration [m/rad]."""
RELAXATION_STEP = np.float32(0.1)
"""There the padding changes in steps of this length [rad]."""


class Space(NamedTuple):
    """The arguments of a search: the robot, the scene, and how motions are checked."""

    robot: tuple
    """RobotArrays"""
    scene: tuple
    """SceneArrays"""
    lower: np.ndarray
    upper: np.ndarray
    motion_radii: np.ndarray
    """[dof] largest distance of any point of the arm from each joint's axis [m]; 1 for prismatic joints."""
    resolution: np.float32
    """No point of the arm moves further than this between two checked configurations [m]."""
    padding: np.float32
    """Added to the radii of the spheres for checks against the scene [m]."""
    near_ends: np.ndarray
    """[m, dof + 1] starts and goals that are closer to the scene than `padding`, each with the padding that
    it allows [m]."""


@allocation_free(fastmath=True)
def distance(a, b):
    """Distance of two configurations in joint space [rad, L2]."""
    total = np.float32(0.0)
    for j in range(len(a)):
        d = np.float32(a[j] - b[j])
        total += d * d
    return np.sqrt(total)


@kernel()
def path_length(path):
    """Sum of the lengths of the segments [rad]."""
    total = np.float32(0.0)
    for i in range(len(path) - 1):
        total += distance(path[i], path[i + 1])
    return total


@allocation_free(inner=False)
def motion_free(space, a, b, block, work):
    """Whether the straight motion from a to b is free of collision; b is checked, a is not.

    a and b may be of any float type. The 16 configurations of a block are spread over the whole motion, so
    that the first block finds most collisions (the rake of W. Thomason et al., "Motions in Microseconds",
    ICRA 2024).
    """
    if len(space.near_ends) == 0:
        return _stretch_free(space, a, b, np.float32(0.0), _ONE, space.padding, block, work)
    length = distance(a, b)
    steps = max(int(np.ceil(length / RELAXATION_STEP)), 1)
    half = np.float32(0.5) * length / np.float32(steps)
    first = 0
    first_padding = padding_near(space, a, b, np.float32(0.5) / np.float32(steps), half)
    for k in range(1, steps + 1):
        padding = np.float32(-1.0)
        if k < steps:
            padding = padding_near(space, a, b, (np.float32(k) + np.float32(0.5)) / np.float32(steps), half)
        if padding != first_padding:
            s = np.float32(first) / np.float32(steps)
            t = np.float32(k) / np.float32(steps)
            if not _stretch_free(space, a, b, s, t, first_padding, block, work):
                return False
            first = k
            first_padding = padding
    return True


@allocation_free()
def padding_near(space, a, b, share, around):
    """The least padding [m] that is required at configurations at most `around` [rad] from a + share * (b -
    a).

    Near a start or goal that is closer to the scene than `space.padding`, the required padding is what this
    start or goal allows, plus RELAXATION_SLOPE per radian of distance from it.
    """
    padding = space.padding
    dof = len(a)
    for m in range(len(space.near_ends)):
        total = np.float32(0.0)
        for j in range(dof):
            d = np.float32(a[j] + share * (b[j] - a[j]) - space.near_ends[m, j])
            total += d * d
        padding = min(
            padding, space.near_ends[m, dof] + RELAXATION_SLOPE * max(np.sqrt(total) - around, _ZERO)
        )
    return padding


@allocation_free()
def _stretch_free(space, a, b, s, t, padding, block, work):
    """Whether the part of the motion from a to b between a + s (b - a), exclusive, and a + t (b - a),
    inclusive, is free of collision."""
    dof = len(a)
    travel = np.float32(0.0)
    for j in range(dof):
        travel += (t - s) * np.float32(abs(b[j] - a[j])) * space.motion_radii[j]
    blocks = max(int(np.ceil(travel / space.resolution / np.float32(W))), 1)
    step = (t - s) / np.float32(blocks * W)
    for k in range(blocks):
        shares = (lane_numbers() * np.float32(blocks) + np.float32(blocks - k)) * step
        for j in range(dof):
            far = np.float32(b[j] - a[j])
            store(block, j, 0, shares * far + (np.float32(a[j]) + s * far))
        if block_hits(space.robot, space.scene, block, padding, True, work):
            return False
    return True


@kernel(nogil=True)
def motions_free(space, path):
    """Whether each straight motion between rows of path[n, dof] is free of collision; row 0 is not
    checked."""
    work = make_workspace(space.robot, space.scene)
    block = np.empty((path.shape[1], W), np.float32)
    out = np.empty(len(path) - 1, np.bool_)
    for i in range(len(path) - 1):
        out[i] = motion_free(space, path[i], path[i + 1], block, work)
    return out
