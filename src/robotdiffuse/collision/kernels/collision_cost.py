"""Compiled signed distances of points to obstacles with gradients, and the collision cost of a configuration
with its gradient, which guidance and refinement descend. The yes-or-no check is in `lane_collision.py`.

The cost is computed from coarse to fine, for rows of up to 16 of a link's spheres. First, obstacles are
selected whose bounding boxes are near the row's bounding sphere. Then the distances of all spheres of the row
to these obstacles are computed at once. Last, the spheres within the margin are processed one by one. The
gradients of a link's spheres add up to a force and a moment (a wrench), which act on the joints that move the
link.
"""

from typing import NamedTuple

import numpy as np

from robotdiffuse.collision.kernels.frames import parent_of
from robotdiffuse.collision.kernels.lane_clearance import (
    clearances_into,
    make_clearance_workspace,
    pair_clearances,
    to_solid,
)
from robotdiffuse.collision.kernels.point_grid import near_point, points_lower_bound
from robotdiffuse.collision.kernels.simd import W, first_lane, lane, load, maximum, minimum
from robotdiffuse.core.kernels import allocation_free, inner_kernel, kernel

CLEARANCE_CAP = np.float32(1.0)
"""Larger clearances are capped at this value [m]."""
_ZERO, _HALF, _ONE = np.float32(0.0), np.float32(0.5), np.float32(1.0)
_TINY = np.float32(1e-9)


@allocation_free(fastmath=True)
def frames_of(robot, q, frames):
    """Writes frames[dof + 1, 12] (rotation row-major, translation) at q; frame 0 is the base."""
    frames[0, :] = _ZERO
    frames[0, 0] = frames[0, 4] = frames[0, 8] = _ONE
    for j in range(len(q)):
        parent = frames[parent_of(robot.parents, j)]
        child = frames[j + 1]
        offset = robot.offsets[j]
        c = np.cos(q[j])
        s = np.sin(q[j])
        slide = _ZERO
        if robot.offsets[j, 12] > _ZERO:
            c = _ONE
            s = _ZERO
            slide = q[j]
        for k in range(3):
            r0 = parent[3 * k]
            r1 = parent[3 * k + 1]
            r2 = parent[3 * k + 2]
            x = r0 * offset[0] + r1 * offset[3] + r2 * offset[6]
            y = r0 * offset[1] + r1 * offset[4] + r2 * offset[7]
            z = r0 * offset[2] + r1 * offset[5] + r2 * offset[8]
            child[3 * k] = x * c + y * s
            child[3 * k + 1] = y * c - x * s
            child[3 * k + 2] = z
            child[9 + k] = r0 * offset[9] + r1 * offset[10] + r2 * offset[11] + parent[9 + k] + z * slide


@allocation_free(fastmath=True)
def placed(frame, x, y, z):
    """Position in the base frame of the point (x, y, z) of a frame[12]."""
    return (
        frame[0] * x + frame[1] * y + frame[2] * z + frame[9],
        frame[3] * x + frame[4] * y + frame[5] * z + frame[10],
        frame[6] * x + frame[7] * y + frame[8] * z + frame[11],
    )


@allocation_free(fastmath=True)
def solid_distance(solid, x, y, z):
    """Signed distance of a point to a row of `SceneArrays.solids` [m], and its gradient."""
    # the point in the solid's axes, and its distances outside the faces
    dx = x - solid[0]
    dy = y - solid[1]
    dz = z - solid[2]
    u = dx * solid[3] + dy * solid[4] + dz * solid[5]
    v = dx * solid[6] + dy * solid[7] + dz * solid[8]
    w = dx * solid[9] + dy * solid[10] + dz * solid[11]
    a = abs(u) - solid[12]
    b = abs(v) - solid[13]
    c = abs(w) - solid[14]
    # outward normals (ou, ov) and (pu, pv) of the faces along the first two axes; a cylinder has only one,
    # which is radial
    ou = np.copysign(_ONE, u)
    ov = _ZERO
    pu = _ZERO
    pv = np.copysign(_ONE, v)
    if solid[16] > _ZERO:
        r = np.sqrt(u * u + v * v) + _TINY
        a = r - solid[12]
        b = -solid[12]
        ou = u / r
        ov = v / r
    if a <= _ZERO and b <= _ZERO and c <= _ZERO:
        d = max(a, b, c)
        na = _ZERO
        nb = _ZERO
        nc = _ZERO
        if a >= b and a >= c:
            na = _ONE
        elif b >= c:
            nb = _ONE
        else:
            nc = _ONE
    else:
        a = max(a, _ZERO)
        b = max(b, _ZERO)
        c = max(c, _ZERO)
        d = np.sqrt(a * a + b * b + c * c) + _TINY
        na = a / d
        nb = b / d
        nc = c / d
    u = na * ou + nb * pu
    v = na * ov + nb * pv
    w = np.copysign(nc, w)
    return (
        d - solid[15],
        solid[3] * u + solid[6] * v + solid[9] * w,
        solid[4] * u + solid[7] * v + solid[10] * w,
        solid[5] * u + solid[8] * v + solid[11] * w,
    )


@allocation_free(inline="always")
def scene_distance(scene, x, y, z, limit):
    """Signed distance of a point to the nearest obstacle, at most `limit` [m], and its gradient (0 at
    `limit`).

    Distances to point clouds may be too large by a few millimeters.
    """
    best = limit
    bx = _ZERO
    by = _ZERO
    bz = _ZERO
    for k in range(len(scene.solids)):
        d, nx, ny, nz = solid_distance(scene.solids[k], x, y, z)
        if d < best:
            best = d
            bx = nx
            by = ny
            bz = nz
    if len(scene.points):
        d, nx, ny, nz = near_point(scene, x, y, z, best)
        if d < best:
            best = d
            bx = nx
            by = ny
            bz = nz
    return best, bx, by, bz


@allocation_free(forceinline=True)
def _add_force(wrench, x, y, z, fx, fy, fz):
    """Adds a force at the point (x, y, z), and its moment about the base's origin, to a wrench."""
    wrench[0] += fx
    wrench[1] += fy
    wrench[2] += fz
    wrench[3] += y * fz - z * fy
    wrench[4] += z * fx - x * fz
    wrench[5] += x * fy - y * fx


@allocation_free(forceinline=True)
def _subtract_torques(robot, frames, frame, wrench, grad):
    """Subtracts from `grad` the forces and torques that a wrench on a frame exerts on the joints that move
    the frame."""
    while frame > 0:
        j = frame - 1
        axis = frames[j + 1]
        frame = parent_of(robot.parents, j)
        ax = axis[2]
        ay = axis[5]
        az = axis[8]
        fx = wrench[0]
        fy = wrench[1]
        fz = wrench[2]
        if robot.offsets[j, 12] > _ZERO:
            grad[j] -= ax * fx + ay * fy + az * fz
        else:
            px = axis[9]
            py = axis[10]
            pz = axis[11]
            mx = wrench[3] - (py * fz - pz * fy)
            my = wrench[4] - (pz * fx - px * fz)
            mz = wrench[5] - (px * fy - py * fx)
            grad[j] -= ax * mx + ay * my + az * mz


@allocation_free(forceinline=True)
def _close(around, part, x, y, z, reach):
    """Mask of the obstacles in row `part` of `around` with bounding boxes within `reach` [m] of a point."""
    dx = maximum(maximum(load(around, part, 0) - x, x - load(around, part, 3)), _ZERO)
    dy = maximum(maximum(load(around, part, 1) - y, y - load(around, part, 4)), _ZERO)
    dz = maximum(maximum(load(around, part, 2) - z, z - load(around, part, 5)), _ZERO)
    return dx * dx + dy * dy + dz * dz < reach * reach


@allocation_free(forceinline=True)
def _row_cost(robot, scene, g, row, frame, margin, nearest, wrench):
    """Cost of a row of spheres of group g towards the scene; adds the spheres' forces to `wrench`."""
    # obstacles near the row's bounding sphere
    cost = _ZERO
    around = scene.solid_boxes
    bound = robot.row_bounds[row]
    u, v, w = placed(frame, bound[0], bound[1], bound[2])
    reach = bound[3] + margin
    any_close = 0
    if reach <= _ZERO:  # a margin this negative turns the cost off
        return cost
    for part in range(len(around)):
        any_close |= _close(around, part, u, v, w, reach)
    near_cloud = len(scene.points) > 0 and points_lower_bound(scene, u, v, w) < reach
    if any_close == 0 and not near_cloud:
        return cost
    # nearest obstacle of each sphere within the margin; `pushed` is the mask of these spheres
    a = load(robot.rows, row, 0)
    b = load(robot.rows, row, 1)
    c = load(robot.rows, row, 2)
    x = a * frame[0] + b * frame[1] + c * frame[2] + frame[9]
    y = a * frame[3] + b * frame[4] + c * frame[5] + frame[10]
    z = a * frame[6] + b * frame[7] + c * frame[8] + frame[11]
    radius_and_margin = load(robot.rows, row, 3) + margin
    best = radius_and_margin
    pushed = 0
    zero = x * _ZERO
    for part in range(len(around)):
        close = _close(around, part, u, v, w, reach)
        while close:
            k = part * W + first_lane(close)
            close &= close - 1
            if len(scene.may_touch) and scene.may_touch[g, k]:
                continue
            d, _ = to_solid(x, y, z, zero, zero, zero, scene.solids[k])
            nearer = d < best
            best = minimum(best, d)
            pushed |= nearer
            while nearer:
                nearest[first_lane(nearer)] = k
                nearer &= nearer - 1
    # cost of spheres that are nearest to a point of a cloud, then of spheres that are nearest to a solid
    if near_cloud:
        for i in range(robot.row_sizes[row]):
            px = lane(x, i)
            py = lane(y, i)
            pz = lane(z, i)
            d, nx, ny, nz = near_point(scene, px, py, pz, lane(best, i))
            if d < lane(best, i):
                pushed &= ~(1 << i)
                h = lane(radius_and_margin, i) - d
                cost += _HALF * h * h
                _add_force(wrench, px, py, pz, h * nx, h * ny, h * nz)
    pushed &= (1 << robot.row_sizes[row]) - 1
    while pushed:
        i = first_lane(pushed)
        pushed &= pushed - 1
        px = lane(x, i)
        py = lane(y, i)
        pz = lane(z, i)
        d, nx, ny, nz = solid_distance(scene.solids[nearest[i]], px, py, pz)
        h = max(lane(radius_and_margin, i) - d, _ZERO)
        cost += _HALF * h * h
        _add_force(wrench, px, py, pz, h * nx, h * ny, h * nz)
    return cost


class CostWorkspace(NamedTuple):
    """Scratch memory of `cost_gradient_at`."""

    frames: np.ndarray
    """[dof + 1, 12]"""
    nearest: np.ndarray
    """[16] index of the nearest obstacle of each sphere in a row."""
    wrench: np.ndarray
    """[2, 6] force and moment on each of two links."""


@inner_kernel()
def make_cost_workspace(dof):
    """Scratch memory for one thread."""
    return CostWorkspace(
        np.empty((dof + 1, 12), np.float32), np.empty(W, np.int64), np.empty((2, 6), np.float32)
    )


@allocation_free(fastmath=True)
def cost_gradient_at(robot, scene, q, pairs, margin, self_margin, work, grad):
    """Returns the collision cost of a configuration and adds its gradient to `grad`.

    The cost is the paper's hinge loss, squared. A sphere at signed distance D < S from the scene costs
    (S - D)^2 / 2, where S is `margin` [m]. Two spheres of a checked pair of links cost the same expression of
    their distance and `self_margin` [m]. `pairs` are the clearances of the pairs at q, at most `self_margin`
    (`lane_clearance.pair_clearances_into`). A sufficiently negative margin turns off its part of the cost.
    """
    frames_of(robot, q, work.frames)
    frames = work.frames
    wrench = work.wrench[0]
    opposite_wrench = work.wrench[1]
    cost = _ZERO
    for g in range(len(robot.frame)):
        index = robot.frame[g]
        if index == 0:
            continue
        wrench[:] = _ZERO
        link_cost = _ZERO
        for row in range(robot.first_row[g], robot.first_row[g + 1]):
            link_cost += _row_cost(robot, scene, g, row, frames[index], margin, work.nearest, wrench)
        if link_cost > _ZERO:
            cost += link_cost
            _subtract_torques(robot, frames, index, wrench, grad)
    for p in range(len(robot.pairs)):
        a = robot.pairs[p, 0]
        b = robot.pairs[p, 1]
        if pairs[p] >= self_margin:
            continue
        ia = robot.frame[a]
        ib = robot.frame[b]
        fa = frames[ia]
        fb = frames[ib]
        bb = robot.bounds[b]
        cx, cy, cz = placed(fb, bb[0], bb[1], bb[2])
        wrench[:] = _ZERO
        opposite_wrench[:] = _ZERO
        for s in range(robot.first[a], robot.first[a + 1]):
            x, y, z = placed(fa, robot.spheres[s, 0], robot.spheres[s, 1], robot.spheres[s, 2])
            reach = robot.spheres[s, 3] + bb[3] + self_margin
            if (x - cx) ** 2 + (y - cy) ** 2 + (z - cz) ** 2 >= reach * reach:
                continue
            for t in range(robot.first[b], robot.first[b + 1]):
                u, v, w = placed(fb, robot.spheres[t, 0], robot.spheres[t, 1], robot.spheres[t, 2])
                dx = x - u
                dy = y - v
                dz = z - w
                d = np.sqrt(dx * dx + dy * dy + dz * dz) + _TINY
                h = robot.spheres[s, 3] + robot.spheres[t, 3] + self_margin - d
                if h > _ZERO:
                    cost += _HALF * h * h
                    fx = h * dx / d
                    fy = h * dy / d
                    fz = h * dz / d
                    _add_force(wrench, x, y, z, fx, fy, fz)
                    _add_force(opposite_wrench, u, v, w, -fx, -fy, -fz)
        _subtract_torques(robot, frames, ia, wrench, grad)
        _subtract_torques(robot, frames, ib, opposite_wrench, grad)
    return cost


@kernel(nogil=True)
def cost_gradients(robot, scene, q, margin, self_margin):
    """Collision costs [n] of the rows of q[n, dof] and their gradients [n, dof]; see `cost_gradient_at`."""
    costs = np.empty(len(q), np.float32)
    grads = np.zeros(q.shape, np.float32)
    scratch = make_cost_workspace(q.shape[1])
    pairs = pair_clearances(robot, q, self_margin)
    for i in range(len(q)):
        costs[i] = cost_gradient_at(robot, scene, q[i], pairs[i], margin, self_margin, scratch, grads[i])
    return costs, grads


@inner_kernel()
def clearances_and_gradients_into(robot, scene, q, limit, margin, work, clearances, gradients):
    """Writes clearances[n, groups] of the moving groups and gradients[n, dof] for the rows of q[n, dof].

    The gradients are those of sqrt(2 cost), where the cost is that of `cost_gradient_at` towards the scene
    alone. This is the root of the sum of h^2 over the spheres, where h = max(0, S - D), S is the margin and D
    the signed distance. Because of the root, gradients are about as large as a sphere's distance from the
    joint axes, whether the sphere is at the edge of the margin or deep inside an obstacle. Gradients of the
    cost itself vary by a factor of a thousand.
    """
    clearances_into(robot, scene, q, limit, work, clearances)
    scratch = make_cost_workspace(q.shape[1])
    pairs = np.zeros(len(robot.pairs), np.float32)  # no cost at a self margin of 0
    gradients[:] = np.float32(0.0)
    for i in range(len(q)):
        if clearances[i].min() < margin:
            cost = cost_gradient_at(robot, scene, q[i], pairs, margin, np.float32(0.0), scratch, gradients[i])
            if cost > np.float32(0.0):
                gradients[i] /= np.sqrt(np.float32(2.0) * cost)


@kernel(nogil=True)
def clearances_and_gradients(robot, scene, q, limit, margin):
    """Clearances [n, moving groups] to the scene, at most `limit`, and gradients [n, dof]; see
    `clearances_and_gradients_into`."""
    moving = len(robot.frame) - np.searchsorted(robot.frame, 1)
    clearances = np.empty((len(q), moving), np.float32)
    gradients = np.empty(q.shape, np.float32)
    work = make_clearance_workspace(robot, len(scene.solids))
    clearances_and_gradients_into(robot, scene, q, limit, margin, work, clearances, gradients)
    return clearances, gradients
