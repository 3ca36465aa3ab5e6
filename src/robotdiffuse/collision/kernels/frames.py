"""Compiled kinematics: frames of arms, rotations of quaternions, and distances of points to solids."""

import numpy as np
from numba.core import types
from numba.extending import overload

from robotdiffuse.core.kernels import inner_kernel
from robotdiffuse.robots.frame_kernel import dot, length, minus, step, write


def parent_of(parents, j):
    """The parent frame of joint j. `parents` is None for a chain. Code for chains is compiled separately, so
    chains pay nothing for the support of trees."""
    return j if parents is None else parents[j]


@overload(parent_of, inline="always")
def _parent_of(parents, j):
    return (lambda parents, j: j) if parents is types.none else (lambda parents, j: parents[j])


@inner_kernel()
def base_frames(dof):
    """Memory for the frames T_base_frame[dof + 1, 3, 4] of an arm; frame 0 is the base."""
    frames = np.zeros((dof + 1, 3, 4))
    for k in range(3):
        frames[0, k, k] = 1.0
    return frames


@inner_kernel()
def point_to_solid(p, rotation, middle, half, disc):
    """Signed distance [m] from a point to the Minkowski sum of a box and a disc around the box's z axis; a
    lower bound inside.

    Either the disc's radius or the box's first two half edges are zero. `rotation` is R_box_base[3, 3].
    """
    d = minus(p, middle)
    u = abs(dot(rotation[0], d)) - half[0]
    v = abs(dot(rotation[1], d)) - half[1]
    w = abs(dot(rotation[2], d)) - half[2]
    if disc > 0:
        u = np.sqrt(u * u + v * v) - disc
        v = u
    outside = max(u, 0.0), 0.0 if disc > 0 else max(v, 0.0), max(w, 0.0)
    return length(outside) + min(max(u, v, w), 0.0)


@inner_kernel()
def gap_to_solid(p, solids, o):
    """`point_to_solid` for obstacle o of `convex_bounds.Solids`, with its rounding [m]."""
    distance = point_to_solid(p, solids.rotation[o], solids.middle[o], solids.half[o], solids.disc[o])
    return distance - solids.rounding[o]


@inner_kernel()
def pose_arm(offsets, parents, slides, q, frames):
    """Writes the frames T_base_frame[dof + 1, 3, 4] of an arm at q[dof]; frame 0 is given."""
    for j in range(len(q)):
        step(frames[parent_of(parents, j)], offsets[j], slides[j], q[j], frames[j + 1])


@inner_kernel()
def write_rotation(w, x, y, z, out):
    """Writes the rotation matrix of the unit quaternion w, x, y, z to out[3, 3]."""
    for r, row in enumerate(
        (
            (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
            (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
            (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
        )
    ):
        write(row, out[r])
