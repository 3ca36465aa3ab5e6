"""Compiled signed distances of points to obstacles, with gradients, and the frames of single configurations.

The yes-or-no check is in `lane_collision.py`. These functions serve where the amount of clearance matters, as
in guidance and refinement.
"""

import numpy as np

from robotdiffuse.collision.kernels.compiled import parent_of
from robotdiffuse.collision.kernels.point_grid import near_point
from robotdiffuse.core.kernels import allocation_free

CLEARANCE_CAP = np.float32(1.0)
"""Clearances beyond this [m] are reported as this."""
_ONE = np.float32(1.0)
_ZERO = np.float32(0.0)
_TINY = np.float32(1e-9)


@allocation_free(fastmath=True)
def frames_of(robot, q, frames):
    """Writes frames[dof + 1, 12] (rotation row-major, translation) at q; frame 0 is the base."""
    frames[0, :] = _ZERO
    frames[0, 0] = frames[0, 4] = frames[0, 8] = _ONE
    for j in range(len(q)):
        parent, child, offset = frames[parent_of(robot.parents, j)], frames[j + 1], robot.offsets[j]
        c, s, slide = np.cos(q[j]), np.sin(q[j]), _ZERO
        if robot.offsets[j, 12] > _ZERO:
            c, s, slide = _ONE, _ZERO, q[j]
        for k in range(3):
            r0, r1, r2 = parent[3 * k], parent[3 * k + 1], parent[3 * k + 2]
            x = r0 * offset[0] + r1 * offset[3] + r2 * offset[6]
            y = r0 * offset[1] + r1 * offset[4] + r2 * offset[7]
            z = r0 * offset[2] + r1 * offset[5] + r2 * offset[8]
            child[3 * k] = x * c + y * s
            child[3 * k + 1] = y * c - x * s
            child[3 * k + 2] = z
            child[9 + k] = r0 * offset[9] + r1 * offset[10] + r2 * offset[11] + parent[9 + k] + z * slide


@allocation_free(fastmath=True)
def placed(frame, x, y, z):
    """Position of a point of a frame in the base frame."""
    return (
        frame[0] * x + frame[1] * y + frame[2] * z + frame[9],
        frame[3] * x + frame[4] * y + frame[5] * z + frame[10],
        frame[6] * x + frame[7] * y + frame[8] * z + frame[11],
    )


@allocation_free(fastmath=True)
def solid_distance(solid, x, y, z):
    """Signed distance of a point to a row of `SceneArrays.solids`, and its gradient."""
    dx, dy, dz = x - solid[0], y - solid[1], z - solid[2]
    u = dx * solid[3] + dy * solid[4] + dz * solid[5]
    v = dx * solid[6] + dy * solid[7] + dz * solid[8]
    w = dx * solid[9] + dy * solid[10] + dz * solid[11]
    a, b, c = abs(u) - solid[12], abs(v) - solid[13], abs(w) - solid[14]
    # outward directions along the first two axes; a cylinder has a single radial one
    ou, ov, pu, pv = np.copysign(_ONE, u), _ZERO, _ZERO, np.copysign(_ONE, v)
    if solid[16] > _ZERO:
        r = np.sqrt(u * u + v * v) + _TINY
        a, b, ou, ov = r - solid[12], -solid[12], u / r, v / r
    if a <= _ZERO and b <= _ZERO and c <= _ZERO:
        d, na, nb, nc = max(a, b, c), _ZERO, _ZERO, _ZERO
        if a >= b and a >= c:
            na = _ONE
        elif b >= c:
            nb = _ONE
        else:
            nc = _ONE
    else:
        a, b, c = max(a, _ZERO), max(b, _ZERO), max(c, _ZERO)
        d = np.sqrt(a * a + b * b + c * c) + _TINY
        na, nb, nc = a / d, b / d, c / d
    u, v, w = na * ou + nb * pu, na * ov + nb * pv, np.copysign(nc, w)
    return (
        d - solid[15],
        solid[3] * u + solid[6] * v + solid[9] * w,
        solid[4] * u + solid[7] * v + solid[10] * w,
        solid[5] * u + solid[8] * v + solid[11] * w,
    )


@allocation_free(inline="always")
def scene_distance(scene, x, y, z, limit):
    """Signed distance of a point to the nearest obstacle, at most `limit`, and its gradient.

    Distances to point clouds may be too large by a few millimetres.
    """
    best, bx, by, bz = limit, _ZERO, _ZERO, _ZERO
    for k in range(len(scene.solids)):
        d, nx, ny, nz = solid_distance(scene.solids[k], x, y, z)
        if d < best:
            best, bx, by, bz = d, nx, ny, nz
    if len(scene.points):
        d, nx, ny, nz = near_point(scene, x, y, z, best)
        if d < best:
            best, bx, by, bz = d, nx, ny, nz
    return best, bx, by, bz
