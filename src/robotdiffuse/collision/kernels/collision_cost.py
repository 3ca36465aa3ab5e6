"""The compiled collision cost of a configuration and its gradient, which guidance and refinement descend.

The computation goes from coarse to fine: first the obstacles whose boxes are within reach of the bounding
sphere of 16 of a link's spheres, then their distances to these 16 at once, then, one by one, the spheres
within the margin. The gradients of a link's spheres add up to a force and a moment (a wrench), which act on
the joints before the link.
"""

from typing import NamedTuple

import numpy as np

from robotdiffuse.collision.kernels.compiled import parent_of
from robotdiffuse.collision.kernels.distance import frames_of, placed, solid_distance
from robotdiffuse.collision.kernels.point_grid import near_point, points_lower_bound
from robotdiffuse.collision.kernels.simd import W, absolute, first_lane, lane, load, maximum, minimum, sqrt
from robotdiffuse.core.kernels import allocation_free, inner_kernel

_ZERO, _HALF, _ONE = np.float32(0.0), np.float32(0.5), np.float32(1.0)
_TINY = np.float32(1e-9)


@allocation_free(forceinline=True)
def _signed_distances(x, y, z, solid):
    """Signed distances of points in 16 lanes to an obstacle."""
    dx, dy, dz = x - solid[0], y - solid[1], z - solid[2]
    u = dx * solid[3] + dy * solid[4] + dz * solid[5]
    v = dx * solid[6] + dy * solid[7] + dz * solid[8]
    w = absolute(dx * solid[9] + dy * solid[10] + dz * solid[11]) - solid[14]
    if solid[16] > _ZERO:
        u = sqrt(u * u + v * v) - solid[12]
        inside = minimum(maximum(u, w), _ZERO)
        v = u * _ZERO
    else:
        u, v = absolute(u) - solid[12], absolute(v) - solid[13]
        inside = minimum(maximum(maximum(u, v), w), _ZERO)
    u, v, w = maximum(u, _ZERO), maximum(v, _ZERO), maximum(w, _ZERO)
    return sqrt(u * u + v * v + w * w) + inside - solid[15]


@allocation_free(forceinline=True)
def _push(wrench, x, y, z, fx, fy, fz):
    """Adds a force at a point, and its moment about the base's origin, to a wrench."""
    wrench[0] += fx
    wrench[1] += fy
    wrench[2] += fz
    wrench[3] += y * fz - z * fy
    wrench[4] += z * fx - x * fz
    wrench[5] += x * fy - y * fx


@allocation_free(forceinline=True)
def _pull(robot, frames, frame, wrench, grad):
    """Subtracts the effect of a wrench on a frame on the joints before it from `grad`."""
    while frame > 0:
        j = frame - 1
        axis, frame = frames[j + 1], parent_of(robot.parents, j)
        ax, ay, az = axis[2], axis[5], axis[8]
        fx, fy, fz = wrench[0], wrench[1], wrench[2]
        if robot.offsets[j, 12] > _ZERO:
            grad[j] -= ax * fx + ay * fy + az * fz
        else:
            px, py, pz = axis[9], axis[10], axis[11]
            mx, my, mz = (
                wrench[3] - (py * fz - pz * fy),
                wrench[4] - (pz * fx - px * fz),
                wrench[5] - (px * fy - py * fx),
            )
            grad[j] -= ax * mx + ay * my + az * mz


@allocation_free(forceinline=True)
def _close(around, part, x, y, z, reach):
    """Mask of those of 16 obstacles whose bounding boxes are within reach of a point."""
    dx = maximum(maximum(load(around, part, 0) - x, x - load(around, part, 3)), _ZERO)
    dy = maximum(maximum(load(around, part, 1) - y, y - load(around, part, 4)), _ZERO)
    dz = maximum(maximum(load(around, part, 2) - z, z - load(around, part, 5)), _ZERO)
    return dx * dx + dy * dy + dz * dz < reach * reach


@allocation_free(forceinline=True)
def _row_cost(robot, scene, g, row, frame, margin, nearest, wrench):
    """Cost of a group's row of spheres towards the scene; adds their forces to the wrench."""
    cost, around, bound = _ZERO, scene.solid_boxes, robot.row_bounds[row]
    u, v, w = placed(frame, bound[0], bound[1], bound[2])
    reach, any_close = bound[3] + margin, 0
    if reach <= _ZERO:  # a margin this negative turns the cost off
        return cost
    for part in range(len(around)):
        any_close |= _close(around, part, u, v, w, reach)
    near_cloud = len(scene.points) > 0 and points_lower_bound(scene, u, v, w) < reach
    if any_close == 0 and not near_cloud:
        return cost
    a, b, c = load(robot.rows, row, 0), load(robot.rows, row, 1), load(robot.rows, row, 2)
    x = a * frame[0] + b * frame[1] + c * frame[2] + frame[9]
    y = a * frame[3] + b * frame[4] + c * frame[5] + frame[10]
    z = a * frame[6] + b * frame[7] + c * frame[8] + frame[11]
    within = load(robot.rows, row, 3) + margin
    best, pushed = within, 0
    for part in range(len(around)):
        close = _close(around, part, u, v, w, reach)
        while close:
            k = part * W + first_lane(close)
            close &= close - 1
            if len(scene.may_touch) and scene.may_touch[g, k]:
                continue
            d = _signed_distances(x, y, z, scene.solids[k])
            nearer = d < best
            best = minimum(best, d)
            pushed |= nearer
            while nearer:
                nearest[first_lane(nearer)] = k
                nearer &= nearer - 1
    if near_cloud:
        for i in range(robot.row_sizes[row]):
            px, py, pz = lane(x, i), lane(y, i), lane(z, i)
            d, nx, ny, nz = near_point(scene, px, py, pz, lane(best, i))
            if d < lane(best, i):
                pushed &= ~(1 << i)
                h = lane(within, i) - d
                cost += _HALF * h * h
                _push(wrench, px, py, pz, h * nx, h * ny, h * nz)
    pushed &= (1 << robot.row_sizes[row]) - 1
    while pushed:
        i = first_lane(pushed)
        pushed &= pushed - 1
        px, py, pz = lane(x, i), lane(y, i), lane(z, i)
        d, nx, ny, nz = solid_distance(scene.solids[nearest[i]], px, py, pz)
        h = max(lane(within, i) - d, _ZERO)
        cost += _HALF * h * h
        _push(wrench, px, py, pz, h * nx, h * ny, h * nz)
    return cost


class CostWorkspace(NamedTuple):
    """Scratch memory of `cost_gradient_at`."""

    frames: np.ndarray
    """[dof + 1, 12]"""
    nearest: np.ndarray
    """[16] index of the obstacle that is nearest to each sphere of a row."""
    wrench: np.ndarray
    """[2, 6] forces and moments on one link and on another."""


@inner_kernel()
def make_cost_workspace(dof):
    """Scratch memory for one thread."""
    return CostWorkspace(
        np.empty((dof + 1, 12), np.float32), np.empty(W, np.int64), np.empty((2, 6), np.float32)
    )


@allocation_free(fastmath=True)
def cost_gradient_at(robot, scene, q, pairs, margin, self_margin, work, grad):
    """Collision cost of a configuration and its gradient (added to `grad`).

    The cost is the paper's hinge loss, squared: the sum over the spheres of (S - D)^2 / 2 for D < S, with D
    the signed distance and S the margin [m], plus the same between the links of the checked pairs. `pairs`
    are the clearances of the pairs at q (`lane_clearance.pair_clearances_into`), at most the self margin. A
    sufficiently negative margin turns its part of the cost off.
    """
    frames_of(robot, q, work.frames)
    frames, wrench, other = work.frames, work.wrench[0], work.wrench[1]
    cost = _ZERO
    for g in range(len(robot.frame)):
        index = robot.frame[g]
        if index == 0:
            continue
        wrench[:], of_link = _ZERO, _ZERO
        for row in range(robot.first_row[g], robot.first_row[g + 1]):
            of_link += _row_cost(robot, scene, g, row, frames[index], margin, work.nearest, wrench)
        if of_link > _ZERO:
            cost += of_link
            _pull(robot, frames, index, wrench, grad)
    for p in range(len(robot.pairs)):
        a, b = robot.pairs[p, 0], robot.pairs[p, 1]
        if pairs[p] >= self_margin:
            continue
        ia, ib = robot.frame[a], robot.frame[b]
        fa, fb, bb = frames[ia], frames[ib], robot.bounds[b]
        cx, cy, cz = placed(fb, bb[0], bb[1], bb[2])
        wrench[:], other[:] = _ZERO, _ZERO
        for s in range(robot.first[a], robot.first[a + 1]):
            x, y, z = placed(fa, robot.spheres[s, 0], robot.spheres[s, 1], robot.spheres[s, 2])
            reach = robot.spheres[s, 3] + bb[3] + self_margin
            if (x - cx) ** 2 + (y - cy) ** 2 + (z - cz) ** 2 >= reach * reach:
                continue
            for t in range(robot.first[b], robot.first[b + 1]):
                u, v, w = placed(fb, robot.spheres[t, 0], robot.spheres[t, 1], robot.spheres[t, 2])
                dx, dy, dz = x - u, y - v, z - w
                d = np.sqrt(dx * dx + dy * dy + dz * dz) + _TINY
                h = robot.spheres[s, 3] + robot.spheres[t, 3] + self_margin - d
                if h > _ZERO:
                    cost += _HALF * h * h
                    fx, fy, fz = h * dx / d, h * dy / d, h * dz / d
                    _push(wrench, x, y, z, fx, fy, fz)
                    _push(other, u, v, w, -fx, -fy, -fz)
        _pull(robot, frames, ia, wrench, grad)
        _pull(robot, frames, ib, other, grad)
    return cost
