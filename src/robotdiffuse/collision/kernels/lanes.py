"""The compiled collision check: 16 configurations at once, yes or no.

Everything is written so that LLVM turns the loops over lanes into SIMD instructions: flat float32 arrays with
constant lane offsets, small functions with few stores, polynomial sine and cosine, integer hit counts in
place of early exits inside a lane loop.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from robotdiffuse.collision.kernels.compiled import allocation_free
from robotdiffuse.collision.kernels.point_grid import W, touch_points

_INV_TAU = np.float32(0.15915494309189535)
_QUARTER = np.float32(0.25)
_HALF = np.float32(0.5)
HEAD, SIDE = 6, 130
"""Numbers before the cells, and cells along each side, of a table of `near_pairs.py`."""
_ZERO = np.float32(0.0)
# sin(2 pi u) for |u| <= 1/4: Taylor coefficients, error below 6e-8
_S1 = np.float32(6.283185307179586)
_S3 = np.float32(-41.341702240399755)
_S5 = np.float32(81.60524927607504)
_S7 = np.float32(-76.70585975306136)
_S9 = np.float32(42.058693944897655)
_S11 = np.float32(-15.094642576822984)


@njit(fastmath=True, inline="always")
def _sine_of_turn(u):
    v = u * u
    return u * (_S1 + v * (_S3 + v * (_S5 + v * (_S7 + v * (_S9 + v * _S11)))))


@allocation_free(fastmath=True)
def _turn(parent, child, offset, q):
    """Frame behind a revolute joint: child = parent @ offset @ Rz(q), 16 lanes."""
    a00, a01, a02 = offset[0], offset[1], offset[2]
    a10, a11, a12 = offset[3], offset[4], offset[5]
    a20, a21, a22 = offset[6], offset[7], offset[8]
    px, py, pz = offset[9], offset[10], offset[11]
    for i in range(W):
        turns = q[i] * _INV_TAU
        turns -= np.floor(turns + _HALF)
        far = abs(turns)
        c = _sine_of_turn(_QUARTER - far)
        s = _sine_of_turn(_QUARTER - abs(far - _QUARTER))
        s = -s if turns < _ZERO else s
        for k in range(3):
            r0, r1, r2 = parent[(3 * k) * W + i], parent[(3 * k + 1) * W + i], parent[(3 * k + 2) * W + i]
            x = r0 * a00 + r1 * a10 + r2 * a20
            y = r0 * a01 + r1 * a11 + r2 * a21
            child[(3 * k) * W + i] = x * c + y * s
            child[(3 * k + 1) * W + i] = y * c - x * s
            child[(3 * k + 2) * W + i] = r0 * a02 + r1 * a12 + r2 * a22
            child[(9 + k) * W + i] = r0 * px + r1 * py + r2 * pz + parent[(9 + k) * W + i]


@allocation_free(fastmath=True)
def _slide(parent, child, offset, q):
    """Frame behind a prismatic joint: child = parent @ offset @ Tz(q), 16 lanes."""
    a00, a01, a02 = offset[0], offset[1], offset[2]
    a10, a11, a12 = offset[3], offset[4], offset[5]
    a20, a21, a22 = offset[6], offset[7], offset[8]
    px, py, pz = offset[9], offset[10], offset[11]
    for i in range(W):
        for k in range(3):
            r0, r1, r2 = parent[(3 * k) * W + i], parent[(3 * k + 1) * W + i], parent[(3 * k + 2) * W + i]
            z = r0 * a02 + r1 * a12 + r2 * a22
            child[(3 * k) * W + i] = r0 * a00 + r1 * a10 + r2 * a20
            child[(3 * k + 1) * W + i] = r0 * a01 + r1 * a11 + r2 * a21
            child[(3 * k + 2) * W + i] = z
            child[(9 + k) * W + i] = r0 * px + r1 * py + r2 * pz + parent[(9 + k) * W + i] + z * q[i]


@allocation_free(fastmath=True)
def place(frames, f, spheres, s, positions, p):
    """Positions of a sphere's centre in 16 lanes, to row p."""
    x, y, z = spheres[s, 0], spheres[s, 1], spheres[s, 2]
    for i in range(W):
        for k in range(3):
            positions[p, k * W + i] = (
                frames[f, (3 * k) * W + i] * x
                + frames[f, (3 * k + 1) * W + i] * y
                + frames[f, (3 * k + 2) * W + i] * z
                + frames[f, (9 + k) * W + i]
            )


@allocation_free(fastmath=True)
def _touch_spheres(at, s, radius, obstacles, near, n, mark, hits):
    """Adds 1 to the lanes whose sphere touches an obstacle; returns how many touches there are.

    Tests the obstacles k with near[n + k]; with `mark` tests all and sets near[n + k] for those touched.
    """
    touches = 0
    for k in range(len(obstacles)):
        if not (mark or near[n + k]):
            continue
        x, y, z = obstacles[k, 0], obstacles[k, 1], obstacles[k, 2]
        reach = radius + obstacles[k, 3]
        reach *= reach
        total = 0
        for i in range(W):
            dx, dy, dz = at[s, i] - x, at[s, W + i] - y, at[s, 2 * W + i] - z
            hit = np.int32(dx * dx + dy * dy + dz * dz < reach)
            hits[i] += hit
            total += hit
        if mark:
            near[n + k] = total > 0
        touches += total
    return touches


@allocation_free(fastmath=True)
def _touch_boxes(at, s, radius, obstacles, near, n, mark, hits):
    touches = 0
    reach = radius * radius
    for k in range(len(obstacles)):
        if not (mark or near[n + k]):
            continue
        x, y, z = obstacles[k, 0], obstacles[k, 1], obstacles[k, 2]
        a00, a01, a02 = obstacles[k, 3], obstacles[k, 4], obstacles[k, 5]
        a10, a11, a12 = obstacles[k, 6], obstacles[k, 7], obstacles[k, 8]
        a20, a21, a22 = obstacles[k, 9], obstacles[k, 10], obstacles[k, 11]
        hx, hy, hz = obstacles[k, 12], obstacles[k, 13], obstacles[k, 14]
        total = 0
        for i in range(W):
            dx, dy, dz = at[s, i] - x, at[s, W + i] - y, at[s, 2 * W + i] - z
            u = max(abs(a00 * dx + a01 * dy + a02 * dz) - hx, _ZERO)
            v = max(abs(a10 * dx + a11 * dy + a12 * dz) - hy, _ZERO)
            w = max(abs(a20 * dx + a21 * dy + a22 * dz) - hz, _ZERO)
            hit = np.int32(u * u + v * v + w * w < reach)
            hits[i] += hit
            total += hit
        if mark:
            near[n + k] = total > 0
        touches += total
    return touches


@allocation_free(fastmath=True)
def _touch_round(at, s, radius, obstacles, flat_ends, near, n, mark, hits):
    """Cylinders (`flat_ends`) or capsules."""
    touches = 0
    for k in range(len(obstacles)):
        if not (mark or near[n + k]):
            continue
        x, y, z = obstacles[k, 0], obstacles[k, 1], obstacles[k, 2]
        a00, a01, a02 = obstacles[k, 3], obstacles[k, 4], obstacles[k, 5]
        a10, a11, a12 = obstacles[k, 6], obstacles[k, 7], obstacles[k, 8]
        a20, a21, a22 = obstacles[k, 9], obstacles[k, 10], obstacles[k, 11]
        half = obstacles[k, 13]
        wide = obstacles[k, 12] if flat_ends else _ZERO
        reach = radius if flat_ends else radius + obstacles[k, 12]
        reach *= reach
        total = 0
        for i in range(W):
            dx, dy, dz = at[s, i] - x, at[s, W + i] - y, at[s, 2 * W + i] - z
            u = a00 * dx + a01 * dy + a02 * dz
            v = a10 * dx + a11 * dy + a12 * dz
            w = max(abs(a20 * dx + a21 * dy + a22 * dz) - half, _ZERO)
            r = max(np.sqrt(u * u + v * v) - wide, _ZERO)
            hit = np.int32(r * r + w * w < reach)
            hits[i] += hit
            total += hit
        if mark:
            near[n + k] = total > 0
        touches += total
    return touches


@allocation_free(fastmath=True)
def _touch_each_other(a, s, b, t, reach, hits):
    reach *= reach
    total = 0
    for i in range(W):
        dx, dy, dz = a[s, i] - b[t, i], a[s, W + i] - b[t, W + i], a[s, 2 * W + i] - b[t, 2 * W + i]
        hit = np.int32(dx * dx + dy * dy + dz * dz < reach)
        hits[i] += hit
        total += hit
    return total


@allocation_free(inline="always")
def _touch_scene(at, s, radius, scene, near, mark, scratch, hits):
    """Touches of sphere s with the obstacles marked as near (with `mark`: with all, marking them)."""
    n = 0
    total = _touch_spheres(at, s, radius, scene.spheres, near, n, mark, hits)
    n += len(scene.spheres)
    total += _touch_boxes(at, s, radius, scene.boxes, near, n, mark, hits)
    n += len(scene.boxes)
    total += _touch_round(at, s, radius, scene.cylinders, True, near, n, mark, hits)
    n += len(scene.cylinders)
    total += _touch_round(at, s, radius, scene.capsules, False, near, n, mark, hits)
    n += len(scene.capsules)
    if len(scene.points) and (mark or near[n]):
        touches = touch_points(at, s, radius, scene, mark, scratch, hits)
        if mark:
            near[n] = touches > 0
        total += touches
    return total


@allocation_free()
def _all_lanes_hit(hits):
    total = 0
    for i in range(W):
        total += np.int32(hits[i] > 0)
    return total == W


class Workspace(NamedTuple):
    """Scratch memory of `block_hits`, so that it allocates nothing."""

    frames: np.ndarray
    """[dof + 1, 12 * W]"""
    positions: np.ndarray
    """[spheres, 3 * W]"""
    centres: np.ndarray
    """[groups, 3 * W] centres of the bounding spheres."""
    placed: np.ndarray
    """[groups] whether the group's positions are those of this block."""
    near: np.ndarray
    """[obstacles] whether the obstacle touches the group's bounding sphere."""
    scratch: np.ndarray
    """[W] hits of bounding spheres, not read; what the grid of points says."""
    hits: np.ndarray
    """[W] hits of each lane."""


@njit(cache=True)
def make_workspace(robot, scene):
    """Scratch memory for one thread."""
    frames = np.zeros((len(robot.offsets) + 1, 12 * W), np.float32)
    for k in (0, 4, 8):
        frames[0, k * W : (k + 1) * W] = 1.0
    obstacles = len(scene.spheres) + len(scene.boxes) + len(scene.cylinders) + len(scene.capsules) + 1
    return Workspace(
        frames,
        np.zeros((len(robot.spheres), 3 * W), np.float32),
        np.zeros((len(robot.frame), 3 * W), np.float32),
        np.zeros(len(robot.frame), np.bool_),
        np.zeros(obstacles, np.bool_),
        np.zeros(W, np.int32),
        np.zeros(W, np.int32),
    )


@allocation_free(inline="always")
def _place_group(robot, g, work):
    if not work.placed[g]:
        for s in range(robot.first[g], robot.first[g + 1]):
            place(work.frames, robot.frame[g], robot.spheres, s, work.positions, s)
        work.placed[g] = True


@allocation_free(inline="always")
def place_frames(robot, q, frames, centres):
    """Frames of 16 configurations, and the centres of the bounding spheres of all groups."""
    for j in range(len(robot.offsets)):
        if robot.offsets[j, 12] > _ZERO:
            _slide(frames[j], frames[j + 1], robot.offsets[j], q[j])
        else:
            _turn(frames[j], frames[j + 1], robot.offsets[j], q[j])
    for g in range(len(robot.frame)):
        place(frames, robot.frame[g], robot.bounds, g, centres, g)


@allocation_free(inline="always")
def _hits_scene(robot, scene, padding, stop_at_first, work):
    any_hit = False
    for g in range(len(robot.frame)):
        if robot.frame[g] == 0:
            continue
        reach = robot.bounds[g, 3] + padding
        if _touch_scene(work.centres, g, reach, scene, work.near, True, work.scratch, work.scratch) == 0:
            continue
        _place_group(robot, g, work)
        for s in range(robot.first[g], robot.first[g + 1]):
            reach = robot.spheres[s, 3] + padding
            if _touch_scene(work.positions, s, reach, scene, work.near, False, work.scratch, work.hits) > 0:
                any_hit = True
                if stop_at_first:
                    return True
        if any_hit and _all_lanes_hit(work.hits):
            return True
    return any_hit


@allocation_free()
def _open_pairs(robot, table, q):
    """Bits of the table's pairs that may touch in any of 16 lanes; see `near_pairs.py`."""
    row = robot.near[table]
    first, second = q[np.int32(row[0])], q[np.int32(row[3])]
    low1, per1, low2, per2 = row[1], row[2], row[4], row[5]
    last = np.float32(SIDE - 1)
    found = np.int32(0)
    for i in range(W):
        k = np.int32(min(max((first[i] - low1) * per1, _ZERO), last)) * np.int32(SIDE)
        k += np.int32(min(max((second[i] - low2) * per2, _ZERO), last))
        found |= np.int32(row[HEAD + k])
    return found


@allocation_free(inline="always")
def _hits_itself(robot, q, stop_at_first, work):
    any_hit = False
    known, opened = -1, np.int32(0)
    positions, centres, scratch, hits = work.positions, work.centres, work.scratch, work.hits
    spheres, bounds, first = robot.spheres, robot.bounds, robot.first
    for p in range(len(robot.pairs)):
        table = robot.pairs[p, 2]
        if table >= 0:
            if table != known:
                known, opened = table, _open_pairs(robot, table, q)
            if not opened & robot.pairs[p, 3]:
                continue
        a, b = robot.pairs[p, 0], robot.pairs[p, 1]
        if _touch_each_other(centres, a, centres, b, bounds[a, 3] + bounds[b, 3], scratch) == 0:
            continue
        _place_group(robot, a, work)
        _place_group(robot, b, work)
        for s in range(first[a], first[a + 1]):
            radius = spheres[s, 3]
            if _touch_each_other(positions, s, centres, b, radius + bounds[b, 3], scratch) == 0:
                continue
            for t in range(first[b], first[b + 1]):
                if _touch_each_other(positions, s, positions, t, radius + spheres[t, 3], hits) > 0:
                    any_hit = True
                    if stop_at_first:
                        return True
        if any_hit and _all_lanes_hit(hits):
            return True
    return any_hit


@allocation_free()
def block_hits(robot, scene, q, padding, stop_at_first, work):
    """Collisions of 16 configurations, q[dof, 16]; `work.hits` counts them by lane.

    `padding` [m] is added to the radii towards the scene. With `stop_at_first` it returns at the first
    link or pair that collides in any lane, otherwise when all lanes are decided. Returns whether any lane
    collides.
    """
    work.hits[:] = 0
    work.placed[:] = False
    place_frames(robot, q, work.frames, work.centres)
    any_hit = _hits_scene(robot, scene, padding, stop_at_first, work)
    if any_hit and (stop_at_first or _all_lanes_hit(work.hits)):
        return True
    return _hits_itself(robot, q, stop_at_first, work) or any_hit


@njit(cache=True, nogil=True)
def free_many(robot, scene, q, padding):
    """Whether each row of q[n, dof] is free of collision."""
    n, dof = q.shape
    out = np.empty(n, np.bool_)
    work = make_workspace(robot, scene)
    hits = work.hits
    block = np.empty((dof, W), np.float32)
    for start in range(0, n, W):
        for i in range(W):
            row = min(start + i, n - 1)
            for j in range(dof):
                block[j, i] = q[row, j]
        block_hits(robot, scene, block, padding, False, work)
        for i in range(min(W, n - start)):
            out[start + i] = hits[i] == 0
    return out
