"""Compiled signed distances of the covering spheres, and gradients: one configuration after the other.

The yes-or-no check is in `lanes.py`; these serve where the amount of clearance matters: the judge, guidance,
refinement, and the clearances that the denoiser sees.
"""

import numpy as np

from robotdiffuse.collision.kernels.compiled import allocation_free
from robotdiffuse.collision.kernels.point_grid import near_point

CAP = np.float32(1.0)
"""Clearances beyond this [m] are reported as this."""
_ONE = np.float32(1.0)
_ZERO = np.float32(0.0)
_TINY = np.float32(1e-9)


@allocation_free(fastmath=True)
def frames_of(robot, q, frames):
    """Fills frames[dof + 1, 12] (rotation row-major, translation); frame 0 is the base."""
    frames[0, :] = _ZERO
    frames[0, 0] = frames[0, 4] = frames[0, 8] = _ONE
    for j in range(len(q)):
        parent, child, offset = frames[j], frames[j + 1], robot.offsets[j]
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
    """Position of a point of a frame."""
    return (
        frame[0] * x + frame[1] * y + frame[2] * z + frame[9],
        frame[3] * x + frame[4] * y + frame[5] * z + frame[10],
        frame[6] * x + frame[7] * y + frame[8] * z + frame[11],
    )


@allocation_free(fastmath=True)
def _local(obstacle, x, y, z):
    dx, dy, dz = x - obstacle[0], y - obstacle[1], z - obstacle[2]
    return (
        obstacle[3] * dx + obstacle[4] * dy + obstacle[5] * dz,
        obstacle[6] * dx + obstacle[7] * dy + obstacle[8] * dz,
        obstacle[9] * dx + obstacle[10] * dy + obstacle[11] * dz,
    )


@allocation_free(fastmath=True)
def _outwards(obstacle, u, v, w):
    return (
        obstacle[3] * u + obstacle[6] * v + obstacle[9] * w,
        obstacle[4] * u + obstacle[7] * v + obstacle[10] * w,
        obstacle[5] * u + obstacle[8] * v + obstacle[11] * w,
    )


@allocation_free(fastmath=True)
def _sphere(obstacle, x, y, z):
    dx, dy, dz = x - obstacle[0], y - obstacle[1], z - obstacle[2]
    d = np.sqrt(dx * dx + dy * dy + dz * dz) + _TINY
    return d - obstacle[3], dx / d, dy / d, dz / d


@allocation_free(fastmath=True)
def _box(obstacle, x, y, z):
    u, v, w = _local(obstacle, x, y, z)
    a, b, c = abs(u) - obstacle[12], abs(v) - obstacle[13], abs(w) - obstacle[14]
    if a <= _ZERO and b <= _ZERO and c <= _ZERO:
        if a >= b and a >= c:
            nu, nv, nw, d = np.copysign(_ONE, u), _ZERO, _ZERO, a
        elif b >= c:
            nu, nv, nw, d = _ZERO, np.copysign(_ONE, v), _ZERO, b
        else:
            nu, nv, nw, d = _ZERO, _ZERO, np.copysign(_ONE, w), c
    else:
        a, b, c = max(a, _ZERO), max(b, _ZERO), max(c, _ZERO)
        d = np.sqrt(a * a + b * b + c * c) + _TINY
        nu, nv, nw = np.copysign(a / d, u), np.copysign(b / d, v), np.copysign(c / d, w)
    nx, ny, nz = _outwards(obstacle, nu, nv, nw)
    return d, nx, ny, nz


@allocation_free(fastmath=True)
def _cylinder(obstacle, x, y, z):
    u, v, w = _local(obstacle, x, y, z)
    r = np.sqrt(u * u + v * v) + _TINY
    a, c = r - obstacle[12], abs(w) - obstacle[13]
    if a <= _ZERO and c <= _ZERO:
        if a >= c:
            nr, nw, d = _ONE, _ZERO, a
        else:
            nr, nw, d = _ZERO, np.copysign(_ONE, w), c
    else:
        a, c = max(a, _ZERO), max(c, _ZERO)
        d = np.sqrt(a * a + c * c) + _TINY
        nr, nw = a / d, np.copysign(c / d, w)
    nx, ny, nz = _outwards(obstacle, nr * u / r, nr * v / r, nw)
    return d, nx, ny, nz


@allocation_free(fastmath=True)
def _capsule(obstacle, x, y, z):
    u, v, w = _local(obstacle, x, y, z)
    w -= min(max(w, -obstacle[13]), obstacle[13])
    d = np.sqrt(u * u + v * v + w * w) + _TINY
    nx, ny, nz = _outwards(obstacle, u / d, v / d, w / d)
    return d - obstacle[12], nx, ny, nz


@allocation_free(inline="always")
def scene_distance(scene, x, y, z, limit):
    """Signed distance of a point to the nearest obstacle if below `limit` (else `limit`), and its gradient.

    To point clouds up to a few millimetres too much.
    """
    best, bx, by, bz = limit, _ZERO, _ZERO, _ZERO
    for k in range(len(scene.spheres)):
        d, nx, ny, nz = _sphere(scene.spheres[k], x, y, z)
        if d < best:
            best, bx, by, bz = d, nx, ny, nz
    for k in range(len(scene.boxes)):
        d, nx, ny, nz = _box(scene.boxes[k], x, y, z)
        if d < best:
            best, bx, by, bz = d, nx, ny, nz
    for k in range(len(scene.cylinders)):
        d, nx, ny, nz = _cylinder(scene.cylinders[k], x, y, z)
        if d < best:
            best, bx, by, bz = d, nx, ny, nz
    for k in range(len(scene.capsules)):
        d, nx, ny, nz = _capsule(scene.capsules[k], x, y, z)
        if d < best:
            best, bx, by, bz = d, nx, ny, nz
    if len(scene.points):
        d, nx, ny, nz = near_point(scene, x, y, z, best)
        if d < best:
            best, bx, by, bz = d, nx, ny, nz
    return best, bx, by, bz
