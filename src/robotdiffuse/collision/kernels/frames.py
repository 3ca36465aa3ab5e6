"""Compiled kinematics in float64: frames along a chain, points of a frame, and distances of points to
boxes."""

import numpy as np
from numba.core import types
from numba.extending import overload

from robotdiffuse.core.kernels import inner_kernel


def parent_of(parents, j):
    """The parent frame of joint j. `parents` is None for a chain. Code for chains is compiled separately, so
    chains pay nothing for the support of trees."""
    return j if parents is None else parents[j]


@overload(parent_of, inline="always")
def _parent_of(parents, j):
    return (lambda parents, j: j) if parents is types.none else (lambda parents, j: parents[j])


@inner_kernel()
def placed(T, p, r):
    """Coordinate r (0 to 2) of T @ p: the point p of a frame, seen in the base frame; T = T_base_frame."""
    return T[r, 0] * p[0] + T[r, 1] * p[1] + T[r, 2] * p[2] + T[r, 3]


@inner_kernel()
def point_to_box(x, y, z, rotation, middle, half, disc):
    """Lower bound of the signed distance [m] from a point to the Minkowski sum of a box and a disc around the
    box's z axis. The bound is the distance to a larger box: the first two half edges grow by the disc's
    radius.

    `rotation` is R_box_base[3, 3]; the result is negative inside.
    """
    outside = 0.0
    deepest = -np.inf
    x = x - middle[0]
    y = y - middle[1]
    z = z - middle[2]
    for r in range(3):
        d = rotation[r, 0] * x + rotation[r, 1] * y + rotation[r, 2] * z
        d = abs(d) - half[r] - (disc if r < 2 else 0.0)
        outside += max(d, 0.0) ** 2
        deepest = max(deepest, d)
    return np.sqrt(outside) + min(deepest, 0.0)


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
        out[r, 0], out[r, 1], out[r, 2] = row
