"""Compiled collision checks of straight motions in joint space. They check configurations that are so close
together that no point of the arm moves further than a resolution [m] between neighbors."""

from typing import NamedTuple

import numpy as np

from robotdiffuse.collision.kernels.lane_collision import block_hits, make_workspace
from robotdiffuse.collision.kernels.simd import W, lane_numbers, store
from robotdiffuse.core.kernels import ONE, ZERO, allocation_free, kernel

RELAXATION_SLOPE = np.float32(0.1)
"""If a start or goal is closer to the scene than the padding, the padding is reduced at this configuration
and grows by this much per radian of distance from it [m/rad]."""
RELAXATION_STEP = np.float32(0.1)
"""If there is such a start or goal, motions are divided into parts of at most this length [rad], each with a
constant padding."""


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
    """No point of the arm moves further than this between neighboring checked configurations [m]."""
    padding: np.float32
    """Added to the radii of the spheres for checks against the scene [m]."""
    near_ends: np.ndarray
    """[m, dof + 1] starts and goals that are closer to the scene than `padding`; the last column is the
    padding that is free of collision there [m]."""


class Scratch(NamedTuple):
    """Scratch memory for checks of motions, and two configurations for the caller's use."""

    work: tuple
    block: np.ndarray
    """[dof, W] configurations that are checked at once."""
    a: np.ndarray
    b: np.ndarray


@kernel()
def make_scratch(space, q):
    """Scratch memory for one thread, with configurations of the data type of q."""
    dof = len(space.lower)
    work = make_workspace(space.robot)
    return Scratch(work, np.empty((dof, W), np.float32), np.empty(dof, q.dtype), np.empty(dof, q.dtype))


@allocation_free(fastmath=True)
def distance(a, b):
    """Distance of two configurations in joint space [rad, L2]."""
    total = ZERO
    for j in range(len(a)):
        d = np.float32(a[j] - b[j])
        total += d * d
    return np.sqrt(total)


@kernel()
def path_length(path):
    """Sum of the lengths of the segments [rad]."""
    total = ZERO
    for i in range(len(path) - 1):
        total += distance(path[i], path[i + 1])
    return total


@allocation_free(inner=False)
def motion_free(space, a, b, scratch):
    """Whether the straight motion from a (exclusive) to b (inclusive) is free of collision.

    a and b may be of any float type. The 16 configurations of a block are spread over the whole motion, so
    that the first block finds most collisions (called a rake by W. Thomason et al., "Motions in
    Microseconds", ICRA 2024).
    """
    if len(space.near_ends) == 0:
        return _stretch_free(space, a, b, ZERO, ONE, space.padding, scratch)
    length = distance(a, b)
    steps = max(int(np.ceil(length / RELAXATION_STEP)), 1)
    half = np.float32(0.5) * length / np.float32(steps)
    first = 0
    first_padding = padding_near(space, a, b, np.float32(0.5) / np.float32(steps), half)
    for k in range(1, steps + 1):
        padding = np.float32(-1.0)  # unlike any other: ends the last stretch
        if k < steps:
            padding = padding_near(space, a, b, (np.float32(k) + np.float32(0.5)) / np.float32(steps), half)
        if padding != first_padding:
            s = np.float32(first) / np.float32(steps)
            t = np.float32(k) / np.float32(steps)
            if not _stretch_free(space, a, b, s, t, first_padding, scratch):
                return False
            first = k
            first_padding = padding
    return True


@allocation_free()
def padding_near(space, a, b, share, around):
    """The smallest required padding [m] over the configurations within `around` [rad] of a + share * (b - a).

    Near a start or goal that is closer to the scene than `space.padding`, the required padding is the padding
    of that start or goal (`space.near_ends`), plus RELAXATION_SLOPE per radian of distance from it.
    """
    padding = space.padding
    dof = len(a)
    for m in range(len(space.near_ends)):
        total = ZERO
        for j in range(dof):
            d = np.float32(a[j] + share * (b[j] - a[j]) - space.near_ends[m, j])
            total += d * d
        padding = min(
            padding, space.near_ends[m, dof] + RELAXATION_SLOPE * max(np.sqrt(total) - around, ZERO)
        )
    return padding


@allocation_free()
def _stretch_free(space, a, b, s, t, padding, scratch):
    """Whether the motion from a + s (b - a), exclusive, to a + t (b - a), inclusive, is free of collision."""
    dof = len(a)
    travel = ZERO
    for j in range(dof):
        travel += (t - s) * np.float32(abs(b[j] - a[j])) * space.motion_radii[j]
    blocks = max(int(np.ceil(travel / space.resolution / np.float32(W))), 1)
    step = (t - s) / np.float32(blocks * W)
    for k in range(blocks):
        # the lanes of each block are spread evenly over the motion
        shares = (lane_numbers() * np.float32(blocks) + np.float32(blocks - k)) * step
        for j in range(dof):
            change = np.float32(b[j] - a[j])
            store(scratch.block, j, 0, shares * change + (np.float32(a[j]) + s * change))
        if block_hits(space.robot, space.scene, scratch.block, padding, True, scratch.work):
            return False
    return True


@kernel(nogil=True)
def motions_free(space, path):
    """For each row of path[n, dof] but the last, whether the straight motion to the next row is free of
    collision: bool[n - 1]. Row 0 itself is not checked."""
    scratch = make_scratch(space, space.lower)
    out = np.empty(len(path) - 1, np.bool_)
    for i in range(len(path) - 1):
        out[i] = motion_free(space, path[i], path[i + 1], scratch)
    return out
