"""Compiled signed distances of points to obstacles with gradients, and the collision cost of a configuration
with its gradient, which guidance and refinement descend. The yes-or-no check is in `lane_collision.py`.

The cost is computed from coarse to fine, for rows of up to 16 of a link's spheres. First, obstacles are
selected whose bounding boxes are near the row's bounding sphere. Then the distances of all spheres of the row
to these obstacles are computed at once. Last, the spheres within the margin are processed one by one. The
gradients of a link's spheres add up to a force and a moment (a wrench), which act on the joints that move the
link. A group is a link with its covering spheres.
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
from robotdiffuse.collision.kernels.lane_collision import in_axes, near_boxes, placed
from robotdiffuse.collision.kernels.point_grid import near_point, points_lower_bound
from robotdiffuse.collision.kernels.simd import W, first_lane, lane, load, load_vector, minimum, vector_in
from robotdiffuse.core.kernels import HALF, ONE, TINY, ZERO, allocation_free, inner_kernel, kernel
from robotdiffuse.robots.frame_kernel import cross, dot, length, minus, plus, times, write

CLEARANCE_CAP = np.float32(1.0)
"""Larger clearances are capped at this value [m]."""


@allocation_free(fastmath=True)
def frames_of(robot, q, frames):
    """Writes frames[dof + 1, 12] (rotation row-major, translation) at q; frame 0 is the base."""
    frames[0, :] = ZERO
    frames[0, 0] = frames[0, 4] = frames[0, 8] = ONE
    for j in range(len(q)):
        parent = frames[parent_of(robot.parents, j)]
        child = frames[j + 1]
        offset = robot.offsets[j]
        c = np.cos(q[j])
        s = np.sin(q[j])
        slide = ZERO
        if robot.offsets[j, 12] > ZERO:
            c = ONE
            s = ZERO
            slide = q[j]
        for k in range(3):
            row = parent[3 * k :]
            x = dot(row, offset[::3])
            y = dot(row, offset[1::3])
            z = dot(row, offset[2::3])
            write((x * c + y * s, y * c - x * s, z), child[3 * k :])
            child[9 + k] = dot(row, offset[9:]) + parent[9 + k] + z * slide


@allocation_free(fastmath=True)
def solid_distance(solid, p):
    """Signed distance of a point to a row of `SceneArrays.solids` [m], and its gradient."""
    # the point in the solid's axes, and its distances outside the faces
    u, v, w = in_axes(solid, minus(p, solid))
    a = abs(u) - solid[12]
    b = abs(v) - solid[13]
    c = abs(w) - solid[14]
    # outward normals (ou, ov) and (pu, pv) of the faces along the first two axes; a cylinder has only one,
    # which is radial
    ou = np.copysign(ONE, u)
    ov = ZERO
    pu = ZERO
    pv = np.copysign(ONE, v)
    if solid[16] > ZERO:
        r = np.sqrt(u * u + v * v) + TINY
        a = r - solid[12]
        b = -solid[12]
        ou = u / r
        ov = v / r
    if a <= ZERO and b <= ZERO and c <= ZERO:
        d = max(a, b, c)
        na = ZERO
        nb = ZERO
        nc = ZERO
        if a >= b and a >= c:
            na = ONE
        elif b >= c:
            nb = ONE
        else:
            nc = ONE
    else:
        a = max(a, ZERO)
        b = max(b, ZERO)
        c = max(c, ZERO)
        d = np.sqrt(a * a + b * b + c * c) + TINY
        na = a / d
        nb = b / d
        nc = c / d
    normal = na * ou + nb * pu, na * ov + nb * pv, np.copysign(nc, w)
    gradient = dot(solid[3::3], normal), dot(solid[4::3], normal), dot(solid[5::3], normal)
    return d - solid[15], gradient


@allocation_free(inline="always")
def scene_distance(scene, p, limit):
    """Signed distance of a point to the nearest obstacle, at most `limit` [m], and its gradient (0 at
    `limit`).

    Distances to point clouds may be too large by a few millimeters.
    """
    best = limit
    gradient = ZERO, ZERO, ZERO
    for k in range(len(scene.solids)):
        d, away = solid_distance(scene.solids[k], p)
        if d < best:
            best = d
            gradient = away
    if len(scene.points):
        d, away = near_point(scene, p, best)
        if d < best:
            best = d
            gradient = away
    return best, gradient


@allocation_free(forceinline=True)
def _add_force(wrench, p, force):
    """Adds a force at the point p, and its moment about the base's origin, to a wrench."""
    write(plus(wrench, force), wrench)
    write(plus(wrench[3:], cross(p, force)), wrench[3:])


@allocation_free(forceinline=True)
def _subtract_torques(robot, frames, frame, wrench, grad):
    """Subtracts from `grad` the forces and torques that a wrench on a frame exerts on the joints that move
    the frame."""
    while frame > 0:
        j = frame - 1
        moved = frames[frame]
        frame = parent_of(robot.parents, j)
        if robot.offsets[j, 12] > ZERO:
            grad[j] -= dot(moved[2::3], wrench)
        else:
            grad[j] -= dot(moved[2::3], minus(wrench[3:], cross(moved[9:], wrench)))


@allocation_free(forceinline=True)
def _row_cost(robot, scene, g, row, frame, margin, nearest, wrench):
    """Cost of a row of spheres of group g against the scene; adds the spheres' forces to `wrench`."""
    # obstacles near the row's bounding sphere
    cost = ZERO
    boxes = scene.solid_boxes
    bound = robot.row_bounds[row]
    center = placed(frame, bound)
    reach = bound[3] + margin
    any_close = 0
    if reach <= ZERO:  # a margin this negative turns the cost off
        return cost
    for part in range(len(boxes)):
        any_close |= near_boxes(boxes, part, center, center, reach)
    near_cloud = len(scene.points) > 0 and points_lower_bound(scene, center) < reach
    if any_close == 0 and not near_cloud:
        return cost
    # nearest obstacle of each sphere within the margin; `pushed` is the mask of these spheres
    centers = placed(frame, load_vector(robot.rows, row, 0))
    radius_and_margin = load(robot.rows, row, 3) + margin
    best = radius_and_margin
    pushed = 0
    for part in range(len(boxes)):
        close = near_boxes(boxes, part, center, center, reach)
        while close:
            k = part * W + first_lane(close)
            close &= close - 1
            if len(scene.may_touch) and scene.may_touch[g, k]:
                continue
            d, _ = to_solid(centers, minus(centers, centers), scene.solids[k])  # velocities of 0
            nearer = d < best
            best = minimum(best, d)
            pushed |= nearer
            while nearer:
                nearest[first_lane(nearer)] = k
                nearer &= nearer - 1
    # cost of the spheres whose nearest obstacle is a point of a cloud, then of those nearest to a solid
    if near_cloud:
        for i in range(robot.row_sizes[row]):
            at = vector_in(centers, i)
            d, gradient = near_point(scene, at, lane(best, i))
            if d < lane(best, i):
                pushed &= ~(1 << i)
                h = lane(radius_and_margin, i) - d
                cost += HALF * h * h
                _add_force(wrench, at, times(h, gradient))
    pushed &= (1 << robot.row_sizes[row]) - 1
    while pushed:
        i = first_lane(pushed)
        pushed &= pushed - 1
        at = vector_in(centers, i)
        d, gradient = solid_distance(scene.solids[nearest[i]], at)
        h = max(lane(radius_and_margin, i) - d, ZERO)
        cost += HALF * h * h
        _add_force(wrench, at, times(h, gradient))
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
def cost_gradient_at(robot, scene, q, pair_distances, margin, self_margin, work, grad):
    """Returns the collision cost of a configuration and adds its gradient to `grad`.

    The cost is the paper's hinge loss, squared. A sphere at signed distance D < S from the scene costs
    (S - D)^2 / 2, where S is `margin` [m]. For two spheres of a checked pair of links, D is their distance
    and S is `self_margin` [m]. `pair_distances` are the clearances of the pairs at q, at most `self_margin`
    (`lane_clearance.pair_clearances_into`). A sufficiently negative margin turns off its part of the cost.
    """
    frames_of(robot, q, work.frames)
    frames = work.frames
    wrench = work.wrench[0]
    opposite_wrench = work.wrench[1]
    cost = ZERO
    for g in range(len(robot.frame)):
        index = robot.frame[g]
        if index == 0:
            continue
        wrench[:] = ZERO
        link_cost = ZERO
        for row in range(robot.first_row[g], robot.first_row[g + 1]):
            link_cost += _row_cost(robot, scene, g, row, frames[index], margin, work.nearest, wrench)
        if link_cost > ZERO:
            cost += link_cost
            _subtract_torques(robot, frames, index, wrench, grad)
    for p in range(len(robot.pairs)):
        a = robot.pairs[p, 0]
        b = robot.pairs[p, 1]
        if pair_distances[p] >= self_margin:
            continue
        ia = robot.frame[a]
        ib = robot.frame[b]
        bound = robot.bounds[b]
        center = placed(frames[ib], bound)
        wrench[:] = ZERO
        opposite_wrench[:] = ZERO
        for s in range(robot.first[a], robot.first[a + 1]):
            sphere = robot.spheres[s]
            at = placed(frames[ia], sphere)
            if length(minus(at, center)) >= sphere[3] + bound[3] + self_margin:
                continue
            for t in range(robot.first[b], robot.first[b + 1]):
                other_sphere = robot.spheres[t]
                partner = placed(frames[ib], other_sphere)
                offset = minus(at, partner)
                d = length(offset) + TINY
                h = sphere[3] + other_sphere[3] + self_margin - d
                if h > ZERO:
                    cost += HALF * h * h
                    _add_force(wrench, at, times(h / d, offset))
                    _add_force(opposite_wrench, partner, times(-h / d, offset))
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

    The gradients are those of sqrt(2 cost), where the cost is that of `cost_gradient_at` against the scene
    alone. This is the root of the sum of h^2 over the spheres, where h = max(0, S - D), S is the margin and D
    the signed distance. Because of the root, gradients are about as large as a sphere's distance from the
    joint axes, whether the sphere is at the edge of the margin or deep inside an obstacle. Gradients of the
    cost itself vary by a factor of a thousand.
    """
    clearances_into(robot, scene, q, limit, work, clearances)
    scratch = make_cost_workspace(q.shape[1])
    pairs = np.zeros(len(robot.pairs), np.float32)  # no cost at a self margin of 0
    gradients[:] = ZERO
    for i in range(len(q)):
        if clearances[i].min() < margin:
            cost = cost_gradient_at(robot, scene, q[i], pairs, margin, ZERO, scratch, gradients[i])
            if cost > ZERO:
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
