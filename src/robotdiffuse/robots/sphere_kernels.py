"""Compiled inner loops of the sphere fit. A surface is cells (triangles of points), a mesh is face planes."""

import math

import numpy as np
from numba import njit

FIRST_STEP, LAST_STEP, SHRINK = 0.004, 0.0005, 0.8
"""Step of the search for centres [m]: in the first round, at least, and from round to round."""
FINEST_STEP = 2e-4
"""[m]; smaller steps than this end the search for one centre."""
GAIN = 1e-7
"""Steps that gain less than this are not taken [m]."""

DIRECTIONS = np.array(
    [[x, y, z] for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if x or y or z], dtype=np.float64
)
DIRECTIONS /= np.linalg.norm(DIRECTIONS, axis=1, keepdims=True)


@njit(cache=True, fastmath=True)
def depth_at(x, y, z, normals, offsets, starts):
    """Distance to the nearest face plane of the part in which the point is deepest; negative outside."""
    best = -1e9
    for part in range(len(starts) - 1):
        least = 1e9
        for f in range(starts[part], starts[part + 1]):
            least = min(least, offsets[f] - normals[f, 0] * x - normals[f, 1] * y - normals[f, 2] * z)
        best = max(best, least)
    return best


@njit(cache=True, fastmath=True)
def depths_at(centers, normals, offsets, starts):
    depths = np.empty(len(centers))
    for i in range(len(centers)):
        depths[i] = depth_at(centers[i, 0], centers[i, 1], centers[i, 2], normals, offsets, starts)
    return depths


@njit(cache=True, fastmath=True)
def squared_distance(a, i, b, j):
    x, y, z = a[i, 0] - b[j, 0], a[i, 1] - b[j, 1], a[i, 2] - b[j, 2]
    return x * x + y * y + z * z


@njit(cache=True, fastmath=True)
def assign(points, corners, centers, depths, owner, least, second):
    """For each cell the sphere that holds it with the least stick-out, that stick-out, and the next best."""
    for c in range(len(corners)):
        best, runner, mine = 1e9, 1e9, -1
        for i in range(len(centers)):
            # a first corner that is too far settles it: most spheres are
            reach = runner + depths[i]
            far = squared_distance(points, corners[c, 0], centers, i)
            if reach <= 0.0 or far >= reach * reach:
                continue
            far = max(far, squared_distance(points, corners[c, 1], centers, i))
            far = max(far, squared_distance(points, corners[c, 2], centers, i))
            needed = math.sqrt(far) - depths[i]
            if needed < best:
                runner, best, mine = best, needed, i
            elif needed < runner:
                runner = needed
        owner[c], least[c], second[c] = mine, best, runner


@njit(cache=True, fastmath=True)
def stick_out_at(x, y, z, own, count, normals, offsets, starts):
    """How far a sphere at a centre sticks out if it holds the own points."""
    far = 0.0
    for k in range(count):
        dx, dy, dz = own[k, 0] - x, own[k, 1] - y, own[k, 2] - z
        far = max(far, dx * dx + dy * dy + dz * dz)
    return math.sqrt(far) - depth_at(x, y, z, normals, offsets, starts)


@njit(cache=True, fastmath=True)
def move_center(center, own, count, step, normals, offsets, starts, directions):
    """Pattern search for the centre of least stick-out; changes `center`."""
    least = stick_out_at(center[0], center[1], center[2], own, count, normals, offsets, starts)
    while step > FINEST_STEP:
        best, way = least - GAIN, -1
        for k in range(len(directions)):
            x = center[0] + step * directions[k, 0]
            y = center[1] + step * directions[k, 1]
            z = center[2] + step * directions[k, 2]
            value = stick_out_at(x, y, z, own, count, normals, offsets, starts)
            if value < best:
                best, way = value, k
        if way < 0:
            step /= 2
        else:
            least = best
            center += step * directions[way]


@njit(cache=True, fastmath=True)
def relax(points, corners, sharp, centers, rounds, enough, normals, offsets, starts, directions):
    """Alternate between giving cells to spheres and moving the spheres.

    Returns the best centres met and how far they stick out; ends early at `enough`.
    """
    cells, count = len(corners), len(centers)
    owner = np.empty(cells, np.int64)
    least, second = np.empty(cells), np.empty(cells)
    first, stamp = np.empty(len(points), np.int64), np.empty(len(points), np.int64)
    rim = np.empty(len(points), np.bool_)
    own = np.empty((len(points), 3))
    order, ends = np.empty(cells, np.int64), np.empty(count + 1, np.int64)
    centers = centers.copy()
    best, best_value = centers.copy(), 1e9
    step = FIRST_STEP
    for r in range(rounds + 1):
        assign(points, corners, centers, depths_at(centers, normals, offsets, starts), owner, least, second)
        value = least.max()
        if value < best_value:
            best, best_value = centers.copy(), value
        if value <= enough or r == rounds:
            break
        # a point between cells of one owner matters only if it is a vertex of the mesh
        first[:] = -1
        rim[:] = sharp
        ends[:] = 0
        for c in range(cells):
            ends[owner[c] + 1] += 1
            for k in range(3):
                p = corners[c, k]
                if first[p] < 0:
                    first[p] = owner[c]
                elif first[p] != owner[c]:
                    rim[p] = True
        for i in range(count):
            ends[i + 1] += ends[i]
        fill = ends[:count].copy()
        for c in range(cells):
            order[fill[owner[c]]] = c
            fill[owner[c]] += 1
        stamp[:] = -1
        for i in range(count):
            found = 0
            for j in range(ends[i], ends[i + 1]):
                for k in range(3):
                    p = corners[order[j], k]
                    if rim[p] and stamp[p] != i:
                        stamp[p] = i
                        own[found] = points[p]
                        found += 1
            if found > 0:
                move_center(centers[i], own, found, step, normals, offsets, starts, directions)
        step = max(SHRINK * step, LAST_STEP)
    return best, best_value
