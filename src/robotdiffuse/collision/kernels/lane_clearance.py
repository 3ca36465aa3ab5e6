"""Compiled clearances of links to the scene and to each other, 16 configurations at once; see
`lane_collision.py`."""

from typing import NamedTuple

import numpy as np

from robotdiffuse.collision.kernels.collision_cost import cost_gradient_at, make_cost_workspace
from robotdiffuse.collision.kernels.lane_collision import W, lanes_that_may_touch, place, place_frames
from robotdiffuse.collision.kernels.point_grid import POINT_RANGE, points_distance, points_lower_bound
from robotdiffuse.collision.kernels.simd import load, reduce_min
from robotdiffuse.core.kernels import allocation_free, inner_kernel, kernel

_ZERO, _FAR = np.float32(0.0), np.float32(1e9)


@allocation_free(fastmath=True)
def _to_spheres(at, s, obstacles, near, n, mark, out):
    """Signed distances of a point in 16 lanes to obstacles.

    With `mark`, writes them to row n + k of `out` for every obstacle k. Else lowers `out[0]` to the distances
    to the obstacles with near[n + k].
    """
    for k in range(len(obstacles)):
        if not (mark or near[n + k]):
            continue
        x, y, z, radius = obstacles[k, 0], obstacles[k, 1], obstacles[k, 2], obstacles[k, 3]
        row = n + k if mark else 0
        for i in range(W):
            dx, dy, dz = at[s, i] - x, at[s, W + i] - y, at[s, 2 * W + i] - z
            d = np.sqrt(dx * dx + dy * dy + dz * dz) - radius
            out[row, i] = d if mark else min(out[row, i], d)


@allocation_free(fastmath=True)
def _to_boxes(at, s, obstacles, near, n, mark, out):
    """The same for boxes."""
    for k in range(len(obstacles)):
        if not (mark or near[n + k]):
            continue
        x, y, z = obstacles[k, 0], obstacles[k, 1], obstacles[k, 2]
        a00, a01, a02 = obstacles[k, 3], obstacles[k, 4], obstacles[k, 5]
        a10, a11, a12 = obstacles[k, 6], obstacles[k, 7], obstacles[k, 8]
        a20, a21, a22 = obstacles[k, 9], obstacles[k, 10], obstacles[k, 11]
        hx, hy, hz = obstacles[k, 12], obstacles[k, 13], obstacles[k, 14]
        row = n + k if mark else 0
        for i in range(W):
            dx, dy, dz = at[s, i] - x, at[s, W + i] - y, at[s, 2 * W + i] - z
            u = abs(a00 * dx + a01 * dy + a02 * dz) - hx
            v = abs(a10 * dx + a11 * dy + a12 * dz) - hy
            w = abs(a20 * dx + a21 * dy + a22 * dz) - hz
            inside = min(max(max(u, v), w), _ZERO)
            u, v, w = max(u, _ZERO), max(v, _ZERO), max(w, _ZERO)
            d = np.sqrt(u * u + v * v + w * w) + inside
            out[row, i] = d if mark else min(out[row, i], d)


@allocation_free(fastmath=True)
def _to_round(at, s, obstacles, flat_ends, near, n, mark, out):
    """The same for cylinders (`flat_ends`) or capsules."""
    for k in range(len(obstacles)):
        if not (mark or near[n + k]):
            continue
        x, y, z = obstacles[k, 0], obstacles[k, 1], obstacles[k, 2]
        a00, a01, a02 = obstacles[k, 3], obstacles[k, 4], obstacles[k, 5]
        a10, a11, a12 = obstacles[k, 6], obstacles[k, 7], obstacles[k, 8]
        a20, a21, a22 = obstacles[k, 9], obstacles[k, 10], obstacles[k, 11]
        wide, half = obstacles[k, 12], obstacles[k, 13]
        row = n + k if mark else 0
        for i in range(W):
            dx, dy, dz = at[s, i] - x, at[s, W + i] - y, at[s, 2 * W + i] - z
            u = a00 * dx + a01 * dy + a02 * dz
            v = a10 * dx + a11 * dy + a12 * dz
            w = abs(a20 * dx + a21 * dy + a22 * dz) - half
            if flat_ends:
                r = np.sqrt(u * u + v * v) - wide
                inside = min(max(r, w), _ZERO)
                r, w = max(r, _ZERO), max(w, _ZERO)
                d = np.sqrt(r * r + w * w) + inside
            else:
                w = max(w, _ZERO)
                d = np.sqrt(u * u + v * v + w * w) - wide
            out[row, i] = d if mark else min(out[row, i], d)


@allocation_free()
def _bound_points(at, s, scene, radius, row, out):
    """Writes lower bounds of the distances of a sphere's centre to the points to a row of `out`."""
    for i in range(W):
        d = points_lower_bound(scene, at[s, i], at[s, W + i], at[s, 2 * W + i])
        out[row, i] = min(d, POINT_RANGE + radius)


@allocation_free()
def _to_points(at, s, scene, radius, out):
    """Lowers `out[0]` to the distances of a sphere's centre to the points."""
    for i in range(W):
        limit = min(out[0, i], POINT_RANGE + radius)
        out[0, i] = points_distance(scene, at[s, i], at[s, W + i], at[s, 2 * W + i], limit)


@allocation_free()
def _pass_over_allowed(may_touch, g, out):
    """Moves the solids that a group may touch out of its way, in the distances of its bounding sphere."""
    for k in range(may_touch.shape[1]):
        if may_touch[g, k]:
            for i in range(W):
                out[k, i] = _FAR


@allocation_free(inline="always")
def to_scene(at, s, scene, radius, near, mark, out):
    """Distances to all obstacles; see `_to_spheres`. With `mark`, s is a group and `at` holds the centres of
    all bounding spheres."""
    n = 0
    _to_spheres(at, s, scene.spheres, near, n, mark, out)
    n += len(scene.spheres)
    _to_boxes(at, s, scene.boxes, near, n, mark, out)
    n += len(scene.boxes)
    _to_round(at, s, scene.cylinders, True, near, n, mark, out)
    n += len(scene.cylinders)
    _to_round(at, s, scene.capsules, False, near, n, mark, out)
    n += len(scene.capsules)
    if mark and len(scene.may_touch):
        _pass_over_allowed(scene.may_touch, s, out)
    if len(scene.points):
        if mark:
            _bound_points(at, s, scene, radius, n, out)
        elif near[n]:
            _to_points(at, s, scene, radius, out)


@allocation_free(fastmath=True)
def _nearer(a, s, b, t, radii, best):
    """Number of lanes in which the distance of sphere s of a and t of b is below best[0]."""
    total = 0
    for i in range(W):
        dx, dy, dz = a[s, i] - b[t, i], a[s, W + i] - b[t, W + i], a[s, 2 * W + i] - b[t, 2 * W + i]
        total += np.int32(np.sqrt(dx * dx + dy * dy + dz * dz) - radii < best[0, i])
    return total


@allocation_free(fastmath=True)
def _keep_least(a, s, b, first, last, spheres, radius, best):
    """Lowers best[0] to the distances of sphere s of a to the spheres `first` to `last` of b."""
    for t in range(first, last):
        radii = radius + spheres[t, 3]
        for i in range(W):
            dx, dy, dz = a[s, i] - b[t, i], a[s, W + i] - b[t, W + i], a[s, 2 * W + i] - b[t, 2 * W + i]
            best[0, i] = min(best[0, i], np.sqrt(dx * dx + dy * dy + dz * dz) - radii)


class ClearanceWorkspace(NamedTuple):
    """Scratch memory of `block_clearances` and `block_pair_clearances`."""

    frames: np.ndarray
    """[dof + 1, 12 * W]"""
    centres: np.ndarray
    """[groups, 3 * W] centres of the bounding spheres."""
    position: np.ndarray
    """[1, 3 * W]"""
    near: np.ndarray
    """[obstacles]"""
    bounds: np.ndarray
    """[obstacles, W] distances of a bounding sphere's centre."""
    least: np.ndarray
    """[1, W]"""
    positions: np.ndarray
    """[spheres, 3 * W]"""
    placed: np.ndarray
    """[groups] whether the group's positions have been computed for this block."""


@inner_kernel()
def make_clearance_workspace(robot, obstacles):
    """Scratch memory for one thread and at most so many obstacles; all point clouds and meshes count as
    one."""
    frames = np.zeros((len(robot.offsets) + 1, 12 * W), np.float32)
    for k in (0, 4, 8):
        frames[0, k * W : (k + 1) * W] = 1.0
    return ClearanceWorkspace(
        frames,
        np.empty((len(robot.frame), 3 * W), np.float32),
        np.empty((1, 3 * W), np.float32),
        np.empty(obstacles, np.bool_),
        np.empty((obstacles, W), np.float32),
        np.empty((1, W), np.float32),
        np.empty((len(robot.spheres), 3 * W), np.float32),
        np.empty(len(robot.frame), np.bool_),
    )


@allocation_free()
def count_obstacles(scene):
    """Number of obstacles for `make_clearance_workspace`."""
    return len(scene.spheres) + len(scene.boxes) + len(scene.cylinders) + len(scene.capsules) + 1


@allocation_free(fastmath=True)
def _mark_near(solids, obstacles, radius, limit, near, bounds, least):
    """Marks the obstacles that can be nearest to a group in any lane, from distances of its bounding sphere.

    An obstacle at distance d from the centre is at least d - radius and at most d + radius away from the
    group. For the points, which come after the solid obstacles, `bounds` holds only a lower bound. Returns
    the number of marks.
    """
    for i in range(W):
        least[0, i] = limit
    for k in range(solids):
        for i in range(W):
            least[0, i] = min(least[0, i], bounds[k, i] + radius)
    count = 0
    for k in range(obstacles):
        total = 0
        for i in range(W):
            total += np.int32(bounds[k, i] - radius < least[0, i])
        near[k] = total > 0
        count += near[k]
    return count


@allocation_free(fastmath=True)
def _lower_to(least, radius, best):
    """Lowers best[0] to the distances of centres less the radius."""
    for i in range(W):
        best[0, i] = min(best[0, i], least[0, i] - radius)


@allocation_free()
def group_clearance(robot, scene, g, limit, work, best):
    """Writes signed distances of a group to the scene, at most `limit`, in 16 lanes to best[1, 16].

    The frames and centres of `work` must be those of the configurations (`place_frames`).
    """
    solids = count_obstacles(scene) - 1
    obstacles = solids + (len(scene.points) > 0)
    radius = robot.bounds[g, 3]
    to_scene(work.centres, g, scene, radius, work.near, True, work.bounds)
    for i in range(W):
        best[0, i] = limit
    if _mark_near(solids, obstacles, radius, limit, work.near, work.bounds, work.least) > 0:
        for s in range(robot.first[g], robot.first[g + 1]):
            place(work.frames, robot.frame[g], robot.spheres, s, work.position, 0)
            # distances beyond those of previous spheres do not matter
            for i in range(W):
                work.least[0, i] = best[0, i] + robot.spheres[s, 3]
            to_scene(work.position, 0, scene, robot.spheres[s, 3], work.near, False, work.least)
            _lower_to(work.least, robot.spheres[s, 3], best)


@allocation_free(inner=False)
def block_clearances(robot, scene, first, q, limit, work, best, out):
    """Writes signed distances to the scene, at most `limit`, of the groups from `first` on to out[groups,
    16].

    q: [dof, 16]. `best` is scratch memory, [1, 16].
    """
    place_frames(robot, q, work.frames, work.centres)
    for g in range(first, len(robot.frame)):
        group_clearance(robot, scene, g, limit, work, best)
        for i in range(W):
            out[g - first, i] = best[0, i]


@allocation_free(inline="always")
def _place_group(robot, g, work):
    if not work.placed[g]:
        for s in range(robot.first[g], robot.first[g + 1]):
            place(work.frames, robot.frame[g], robot.spheres, s, work.positions, s)
        work.placed[g] = True


@allocation_free()
def pair_clearance(robot, p, limit, work, best):
    """Writes distances between the links of a checked pair, at most `limit`, in 16 lanes to best[1, 16].

    The frames and centres of `work` must be those of the configurations; `placed` marks the groups whose
    positions are.
    """
    a, b = robot.pairs[p, 0], robot.pairs[p, 1]
    centres, positions = work.centres, work.positions
    spheres, bounds, first = robot.spheres, robot.bounds, robot.first
    for i in range(W):
        best[0, i] = limit
    if _nearer(centres, a, centres, b, bounds[a, 3] + bounds[b, 3], best) > 0:
        _place_group(robot, a, work)
        _place_group(robot, b, work)
        for s in range(first[a], first[a + 1]):
            radius = spheres[s, 3]
            if _nearer(positions, s, centres, b, radius + bounds[b, 3], best) > 0:
                _keep_least(positions, s, positions, first[b], first[b + 1], spheres, radius, best)


@allocation_free()
def block_pair_clearances(robot, q, limit, work, out):
    """Writes distances between the links of the checked pairs at q[dof, 16], at most `limit`, to out[pairs,
    16].

    Where spheres touch although the pair's table excludes contact, the distance is unknown and `limit` is
    written.
    """
    place_frames(robot, q, work.frames, work.centres)
    work.placed[:] = False
    for p in range(len(robot.pairs)):
        pair_clearance(robot, p, limit, work, work.least)
        table, bit, known = robot.pairs[p, 2], robot.pairs[p, 3], 0
        if table >= 0 and reduce_min(load(work.least, 0, 0)) <= _ZERO:
            known = ~lanes_that_may_touch(robot, table, bit, q)
        for i in range(W):
            apart = work.least[0, i] <= _ZERO and known >> i & 1
            out[p, i] = limit if apart else work.least[0, i]


@inner_kernel()
def pair_clearances_into(robot, q, limit, work, out):
    """Writes clearances of the checked pairs for the rows of q[n, dof] to out[n, pairs]."""
    n, dof = q.shape
    block, found = np.empty((dof, W), np.float32), np.empty((out.shape[1], W), np.float32)
    for start in range(0, n, W):
        for i in range(W):
            row = min(start + i, n - 1)
            for j in range(dof):
                block[j, i] = q[row, j]
        block_pair_clearances(robot, block, limit, work, found)
        for i in range(min(W, n - start)):
            for p in range(out.shape[1]):
                out[start + i, p] = found[p, i]


@kernel(nogil=True)
def pair_clearances(robot, q, limit):
    """Distances [n, pairs] between the checked pairs of links at q[n, dof], at most `limit`."""
    out = np.empty((len(q), len(robot.pairs)), np.float32)
    pair_clearances_into(robot, q, limit, make_clearance_workspace(robot, 1), out)
    return out


@inner_kernel()
def clearances_into(robot, scene, q, limit, work, out):
    """Writes clearances of the moving groups for the rows of q[n, dof] to out[n, groups]."""
    n, dof = q.shape
    first = len(robot.frame) - out.shape[1]
    block, found = np.empty((dof, W), np.float32), np.empty((out.shape[1], W), np.float32)
    best = np.empty((1, W), np.float32)
    for start in range(0, n, W):
        for i in range(W):
            row = min(start + i, n - 1)
            for j in range(dof):
                block[j, i] = q[row, j]
        block_clearances(robot, scene, first, block, limit, work, best, found)
        for i in range(min(W, n - start)):
            for g in range(out.shape[1]):
                out[start + i, g] = found[g, i]


@kernel(nogil=True)
def link_clearances(robot, scene, q, limit):
    """Signed distances [n, moving groups] to the scene at q[n, dof], at most `limit`."""
    moving = len(robot.frame) - np.searchsorted(robot.frame, 1)
    out = np.empty((len(q), moving), np.float32)
    work = make_clearance_workspace(robot, count_obstacles(scene))
    clearances_into(robot, scene, q, limit, work, out)
    return out


@kernel(nogil=True)
def cost_gradients(robot, scene, q, margin, self_margin):
    """Collision costs [n] of the rows of q[n, dof] and their gradients [n, dof]; see `cost_gradient_at`."""
    n, dof = q.shape
    costs, grads = np.empty(n, np.float32), np.zeros((n, dof), np.float32)
    scratch = make_cost_workspace(dof)
    pairs = pair_clearances(robot, q, self_margin)
    for i in range(n):
        costs[i] = cost_gradient_at(robot, scene, q[i], pairs[i], margin, self_margin, scratch, grads[i])
    return costs, grads
