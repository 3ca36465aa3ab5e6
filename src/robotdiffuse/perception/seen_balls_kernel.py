"""Which small balls a depth image sees through, and which lie in given voxels, in compiled code."""

import numpy as np

from robotdiffuse.core.kernels import kernel
from robotdiffuse.perception.free_space_kernel import MAX_DEPTH, usable_depth

MAX_LOST_FRACTION = 0.2
"""Largest fraction of a ball's pixels without a return."""
_HALF, _ZERO = np.float32(0.5), np.float32(0.0)


@kernel(nogil=True)
def see_through(depth, intrinsics, T, balls, radius, noise, border, seen):
    """Mark the balls that an image sees through: their projection lies within the image, and all returns of
    its pixels are behind the ball; a few pixels may have none.

    depth: float32[h, w], infinite where nothing is in range, and not above 0 without a return; intrinsics fx,
    fy, cx, cy; T [4, 4]: T_base_camera; balls [n, 3]: their centres, and their radius [m]; noise: how far
    behind a ball a return must lie, at a distance of 1 m; it grows with the square of the distance [m];
    border: pixels around the projection that count too. All numbers are float32; seen bool[n].
    """
    raw = usable_depth(depth, intrinsics[0])
    h, w = raw.shape
    fx, fy, cx, cy = intrinsics
    for n in range(len(balls)):
        if seen[n]:
            continue
        dx, dy, dz = balls[n, 0] - T[0, 3], balls[n, 1] - T[1, 3], balls[n, 2] - T[2, 3]
        z = T[0, 2] * dx + T[1, 2] * dy + T[2, 2] * dz
        near, far = z - radius, z + radius
        if near <= _ZERO:
            continue
        x, y = T[0, 0] * dx + T[1, 0] * dy + T[2, 0] * dz, T[0, 1] * dx + T[1, 1] * dy + T[2, 1] * dz
        u0 = np.floor(fx * (x - radius) / (near if x < radius else far) + cx) - border
        u1 = np.ceil(fx * (x + radius) / (near if x > -radius else far) + cx) + border
        v0 = np.floor(fy * (y - radius) / (near if y < radius else far) + cy) - border
        v1 = np.ceil(fy * (y + radius) / (near if y > -radius else far) + cy) + border
        if u0 < _ZERO or v0 < _ZERO or u1 > np.float32(w - 1) or v1 > np.float32(h - 1):
            continue
        behind = min(far + noise * far * far, MAX_DEPTH * _HALF)
        seen[n] = _all_behind(raw, int(v0), int(v1), int(u0), int(u1), behind)


@kernel(nogil=True)
def _all_behind(depth, v0, v1, u0, u1, least):
    """Whether all returns of a rectangle of pixels, whose bounds are inclusive, are deeper than `least`, and
    no more pixels than may are without one."""
    lost, most = 0, MAX_LOST_FRACTION * (v1 + 1 - v0) * (u1 + 1 - u0)
    for v in range(v0, v1 + 1):
        for u in range(u0, u1 + 1):
            if depth[v, u] > least:
                continue
            lost += 1
            if depth[v, u] > _ZERO or lost > most:
                return False
    return True


@kernel(nogil=True)
def within_voxels(balls, radius, marked, low, edge, within):
    """Mark the balls all of whose voxels are marked; arguments as above, marked bool[nx, ny, nz]."""
    nx, ny, nz = marked.shape
    for n in range(len(balls)):
        x, y, z = balls[n, 0] - low[0], balls[n, 1] - low[1], balls[n, 2] - low[2]
        i0, i1 = int(np.floor((x - radius) / edge)), int(np.floor((x + radius) / edge))
        j0, j1 = int(np.floor((y - radius) / edge)), int(np.floor((y + radius) / edge))
        k0, k1 = int(np.floor((z - radius) / edge)), int(np.floor((z + radius) / edge))
        if i0 < 0 or j0 < 0 or k0 < 0 or i1 >= nx or j1 >= ny or k1 >= nz:
            continue
        all_marked = True
        for i in range(i0, i1 + 1):
            for j in range(j0, j1 + 1):
                for k in range(k0, k1 + 1):
                    all_marked = all_marked and marked[i, j, k]
        within[n] |= all_marked
