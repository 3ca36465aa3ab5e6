"""Depth images and clouds to a few points, in compiled code: what a scene needs of what a camera saw."""

import numpy as np
from numba import njit

from robotdiffuse.collision.kernels.distance import scene_distance

PIXELS, SHARE = np.float32(4.0), np.float32(0.01)
"""Neighbours whose depths differ by less than so many widths of a pixel there, or by less than this share of
the depth, are on the same surface."""
_AROUND = ((0, -1), (0, 1), (-1, 0), (1, 0), (-1, -1), (-1, 1), (1, -1), (1, 1))
_ZERO = np.float32(0.0)


@njit(cache=True, nogil=True, inline="always")
def _slot(keys, key):
    """Where a key is in an open table, or is to be put."""
    mask = len(keys) - 1
    x = np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)
    at = np.int64(x >> np.uint64(32)) & mask
    while keys[at] != key and keys[at] != -1:
        at = (at + 1) & mask
    return at


@njit(cache=True, nogil=True, inline="always")
def _within(spheres, x, y, z, last):
    """The sphere that a point is in, looked for from the `last` one that a point was in; -1: in none."""
    for k in range(-1, len(spheres)):
        s = last if k < 0 else k
        if s < 0:
            continue
        dx, dy, dz = x - spheres[s, 0], y - spheres[s, 1], z - spheres[s, 2]
        if dx * dx + dy * dy + dz * dz < spheres[s, 3] * spheres[s, 3]:
            return s
    return -1


@njit(cache=True, nogil=True, inline="always")
def _add(keys, cells, sums, count, x, y, z, voxel):
    """Add a point to its cell; the number of cells."""
    span = np.int64(1) << 20
    i, j, k = np.int64(np.floor(x / voxel)), np.int64(np.floor(y / voxel)), np.int64(np.floor(z / voxel))
    key = ((i + span) << 42) | ((j + span) << 21) | (k + span)
    at = _slot(keys, key)
    if keys[at] == -1:
        keys[at], cells[at] = key, count
        count += 1
    row = sums[cells[at]]
    row[0] += x
    row[1] += y
    row[2] += z
    row[3] += np.float32(1.0)
    return count


@njit(cache=True, nogil=True)
def gather_cloud(points, reach, spheres, voxel, keys, cells, sums, count):
    """Add a cloud to cells; as `gather_image`."""
    box = _box(spheres)
    last = -1
    for p in range(len(points)):
        if count >= len(sums):
            return -1
        x, y, z = np.float32(points[p, 0]), np.float32(points[p, 1]), np.float32(points[p, 2])
        if not x * x + y * y + z * z <= reach * reach:
            continue
        if _boxed(box, x, y, z):
            hit = _within(spheres, x, y, z, last)
            if hit >= 0:
                last = hit
                continue
        count = _add(keys, cells, sums, count, x, y, z, voxel)
    return count


@njit(cache=True, nogil=True)
def gather_image(depth, intrinsics, T, reach, spheres, voxel, keys, cells, sums, count):
    """Add a depth image to cells `voxel` wide; how many cells there are, -1 if `sums` has no room for them.

    depth [h, w], intrinsics fx, fy, cx, cy, T [4, 4] of the camera; what is beyond `reach` of the origin, in
    one of the spheres [n, 4] or a flying pixel is left out. keys int64 and cells int32 are an open
    table, keys -1 where it is empty; sums [m, 4] are sums of coordinates and numbers of points by cell.
    """
    h, w = depth.shape
    fx, fy, cx, cy = intrinsics
    box = _box(spheres)
    last = -1
    for v in range(h):
        b = (np.float32(v) - cy) / fy
        for u in range(w):
            if count >= len(sums):
                return -1
            d = depth[v, u]
            if not (d > _ZERO and d < np.float32(1e6)):
                continue
            a = (np.float32(u) - cx) / fx
            x = (T[0, 0] * a + T[0, 1] * b + T[0, 2]) * d + T[0, 3]
            y = (T[1, 0] * a + T[1, 1] * b + T[1, 2]) * d + T[1, 3]
            z = (T[2, 0] * a + T[2, 1] * b + T[2, 2]) * d + T[2, 3]
            if x * x + y * y + z * z > reach * reach:
                continue
            if _flies(depth, v, u, d, max(PIXELS * d / fx, SHARE * d)):
                continue
            if _boxed(box, x, y, z):
                hit = _within(spheres, x, y, z, last)
                if hit >= 0:
                    last = hit
                    continue
            count = _add(keys, cells, sums, count, x, y, z, voxel)
    return count


@njit(cache=True, nogil=True)
def supported(keys, cells, sums, count, least):
    """Which cells hold at least so many points, or are next to one that does."""
    out = np.empty(count, np.bool_)
    for at in range(len(keys)):
        if keys[at] == -1:
            continue
        enough = sums[cells[at], 3] >= least
        for i in range(-1, 2):
            for j in range(-1, 2):
                for k in range(-1, 2):
                    if not enough:
                        near = _slot(keys, keys[at] + (i << 42) + (j << 21) + k)
                        enough = keys[near] != -1 and sums[cells[near], 3] >= least
        out[cells[at]] = enough
    return out


@njit(cache=True, nogil=True, inline="always")
def _flies(depth, v, u, d, jump):
    """Whether fewer than two of the eight pixels around are on the same surface: at edges, sensors mix the
    depths of the near and the far one."""
    h, w = depth.shape
    alike = 0
    for k in range(8):
        dv, du = _AROUND[k]
        y, x = v + dv, u + du
        if 0 <= y < h and 0 <= x < w and abs(depth[y, x] - d) < jump:
            alike += 1
            if alike == 2:
                return False
    return True


@njit(cache=True, nogil=True)
def _box(spheres):
    """Low and high corner of a box around spheres, one after the other."""
    box = np.zeros(6, np.float32)
    for axis in range(3):
        for s in range(len(spheres)):
            low, high = spheres[s, axis] - spheres[s, 3], spheres[s, axis] + spheres[s, 3]
            box[axis] = low if s == 0 else min(box[axis], low)
            box[3 + axis] = high if s == 0 else max(box[3 + axis], high)
    return box


@njit(cache=True, nogil=True, inline="always")
def _boxed(box, x, y, z):
    return box[0] < x < box[3] and box[1] < y < box[4] and box[2] < z < box[5]


@njit(cache=True, nogil=True)
def sphere_distances(points, spheres):
    """Signed distance of each point [n, 3] to the nearest sphere [m, 4], infinite where there is none."""
    out = np.full(len(points), np.inf, np.float32)
    for p in range(len(points)):
        for s in range(len(spheres)):
            dx, dy, dz = (
                points[p, 0] - spheres[s, 0],
                points[p, 1] - spheres[s, 1],
                points[p, 2] - spheres[s, 2],
            )
            bound = out[p] + spheres[s, 3]
            square = dx * dx + dy * dy + dz * dz
            if bound > _ZERO and square < bound * bound:
                out[p] = np.sqrt(square) - spheres[s, 3]
    return out


@njit(cache=True, nogil=True)
def near_scene(scene, points, limit):
    """Whether each point [n, 3] is in an obstacle of SceneArrays or nearer than `limit` [m]."""
    out = np.empty(len(points), np.bool_)
    for p in range(len(points)):
        x, y, z = points[p, 0], points[p, 1], points[p, 2]
        out[p] = scene_distance(scene, x, y, z, limit)[0] < limit
    return out
