"""Compiled clearances of covering spheres to the scene and to each other, for 16 configurations or short
motions at once; see `lane_collision.py`.

A short motion is given by its middle configuration and dq, half of the joint motion from its start to its
end. The parameter t goes from -1 (start) over 0 (middle) to 1 (end). At t, the center of a sphere has moved
by t v + r from its position in the middle. v is the Jacobian times dq, and `motion_certificate.py` computes a
bound on the remainder |r| for the whole link. Let d be the distance to a convex obstacle in the middle, and n
the direction to its nearest point there. The distance is a convex function of the position, so it is nowhere
below its tangent at the middle: the sphere stays at least d - |n . v| - |r| away. A configuration is a motion
with v = 0.
"""

from typing import NamedTuple

import numpy as np

from robotdiffuse.collision.kernels.frames import parent_of
from robotdiffuse.collision.kernels.lane_collision import (
    W,
    centers_of,
    in_axes,
    lanes_that_may_touch,
    make_workspace,
    place_frames,
    take_block,
)
from robotdiffuse.collision.kernels.point_grid import POINT_RANGE, points_distance, points_lower_bound
from robotdiffuse.collision.kernels.simd import (
    absolute,
    copysign,
    lane,
    load,
    load_vector,
    maximum,
    minimum,
    reduce_min,
    sqrt,
    store,
    store_vector,
    vector_in,
)
from robotdiffuse.core.kernels import ONE, TINY, ZERO, allocation_free, inner_kernel, kernel
from robotdiffuse.robots.frame_kernel import cross, dot, minus, plus, times

_FAR = np.float32(1e9)


class ClearanceWorkspace(NamedTuple):
    """Scratch memory for 16 configurations or motions."""

    frames: np.ndarray
    """[dof + 1, 12 * W] in the middle of each motion."""
    twists: np.ndarray
    """[dof + 1, 6 * W] motion of each frame per unit of t: its angular velocity, and the velocity that a
    point fixed to the frame has at the base's origin."""
    centers: np.ndarray
    """[groups, 3 * W] centers of the bounding spheres."""
    positions: np.ndarray
    """[spheres, 3 * W] centers of the spheres of the groups in `placed`."""
    placed: np.ndarray
    """[groups] whether the group's positions have been computed for this block."""
    near: np.ndarray
    """[obstacles] whether the obstacle may be the nearest one of a group in any lane; the last entry stands
    for all points."""
    bounds: np.ndarray
    """[obstacles, W] distances of the obstacles from the center of a group's bounding sphere [m]; the last
    entry is a lower bound."""
    need: np.ndarray
    """[1, W] clearances are computed up to this value [m]; a lane with a negative value is skipped."""
    clearance: np.ndarray
    """[1, W] signed distances in the middle of each motion [m]."""
    lower: np.ndarray
    """[1, W] lower bounds along each motion, without the remainder [m]."""


@kernel()
def make_clearance_workspace(robot, solids):
    """Scratch memory for one thread and at most `solids` solids."""
    frames, centers, _ = make_workspace(robot)
    return ClearanceWorkspace(
        frames,
        np.zeros((len(frames), 6 * W), np.float32),
        centers,
        np.empty((len(robot.spheres), 3 * W), np.float32),
        np.empty(len(centers), np.bool_),
        np.empty(solids + 1, np.bool_),
        np.empty((solids + 1, W), np.float32),
        np.empty((1, W), np.float32),
        np.empty((1, W), np.float32),
        np.empty((1, W), np.float32),
    )


@allocation_free(forceinline=True)
def to_solid(points, velocities, solid):
    """Signed distances of the points in 16 lanes to a row of `SceneArrays.solids`, and how fast the points
    move towards or away from the nearest points of the solid. A solid is a box or cylinder that a ball
    widens; for points inside the box or cylinder, this speed is 0."""
    u, v, w = in_axes(solid, minus(points, solid))
    # velocity in the solid's axes; multiplied by the sign of the coordinate, it is the speed away from the
    # center
    p, q, r = in_axes(solid, velocities)
    r = r * copysign(ONE, w)
    if solid[16] > ZERO:
        from_axis = sqrt(u * u + v * v)
        p = (u * p + v * q) / maximum(from_axis, TINY)
        u = from_axis - solid[12]
        v = minimum(u, ZERO)  # u alone counts
    else:
        p = p * copysign(ONE, u)
        q = q * copysign(ONE, v)
        u = absolute(u) - solid[12]
        v = absolute(v) - solid[13]
    w = absolute(w) - solid[14]
    inside = minimum(maximum(maximum(u, v), w), ZERO)
    outside = maximum(u, ZERO), maximum(v, ZERO), maximum(w, ZERO)
    d = _length(outside)
    return d + inside - solid[15], absolute(dot(outside, (p, q, r))) / maximum(d, TINY)


@allocation_free(forceinline=True)
def _velocity(twists, f, points):
    """Velocities of points of frame f."""
    return plus(cross(load_vector(twists, f, 0), points), load_vector(twists, f, 3))


@allocation_free(forceinline=True)
def _speed(twists, f, other, centers, radius):
    """Upper bounds on the speed, relative to frame `other`, of any point of a ball that is fixed to frame
    f."""
    moving = minus(_velocity(twists, f, centers), _velocity(twists, other, centers))
    return _length(moving) + radius * _length(minus(load_vector(twists, f, 0), load_vector(twists, other, 0)))


@allocation_free(forceinline=True)
def _length(v):
    return sqrt(dot(v, v))


@allocation_free()
def place_motions(robot, q, dq, work):
    """Writes the frames at the middle configurations q[dof, 16] and the frames' twists along dq[dof, 16]. A
    joint's axis is the z axis of its frame."""
    place_frames(robot, q, work.frames, work.centers)
    work.placed[:] = False
    for j in range(len(robot.offsets)):
        parent = parent_of(robot.parents, j)
        f = j + 1
        slides = robot.offsets[j, 12]
        z = load(work.frames, f, 2), load(work.frames, f, 5), load(work.frames, f, 8)
        axis = times(load(dq, j, 0), z)
        moment = cross(load_vector(work.frames, f, 9), axis)
        moving = plus(times(ONE - slides, moment), times(slides, axis))
        turning = times(ONE - slides, axis)
        store_vector(work.twists, f, 0, plus(load_vector(work.twists, parent, 0), turning))
        store_vector(work.twists, f, 3, plus(load_vector(work.twists, parent, 3), moving))


@allocation_free()
def _place_group(robot, g, work):
    if not work.placed[g]:
        for s in range(robot.first[g], robot.first[g + 1]):
            store_vector(work.positions, s, 0, centers_of(work.frames, robot.frame[g], robot.spheres, s))
        work.placed[g] = True


@allocation_free(forceinline=True)
def _reset(work):
    store(work.clearance, 0, 0, load(work.need, 0, 0))
    store(work.lower, 0, 0, load(work.need, 0, 0))


@allocation_free(forceinline=True)
def _lower_to(distance, towards, work):
    """Lowers the clearances to `distance`, and the bounds along the motions to `distance - towards` [m]."""
    store(work.clearance, 0, 0, minimum(load(work.clearance, 0, 0), distance))
    store(work.lower, 0, 0, minimum(load(work.lower, 0, 0), distance - towards))


@allocation_free(forceinline=True)
def _mark_near(robot, scene, g, speed, work):
    """Marks in `work.near` the obstacles that may be the nearest one of group g in any lane; returns whether
    there is any.

    An obstacle at distance d from the center of the bounding sphere is at least d - radius and at most d +
    radius away from the group. All points together are the last obstacle; for them only the lower bound is
    used.
    """
    centers = load_vector(work.centers, g, 0)
    radius = robot.bounds[g, 3]
    upper_bound = load(work.need, 0, 0)
    solids = len(scene.solids)
    for k in range(solids):
        # without a velocity
        distance, _ = to_solid(centers, minus(centers, centers), scene.solids[k])
        if len(scene.may_touch) and scene.may_touch[g, k]:
            distance = distance * ZERO + _FAR  # _FAR in all lanes
        store(work.bounds, k, 0, distance)
        upper_bound = minimum(upper_bound, distance + radius)
    obstacles = solids
    if len(scene.points):
        obstacles += 1
        for i in range(W):
            work.bounds[solids, i] = min(
                points_lower_bound(scene, vector_in(centers, i)), POINT_RANGE + radius
            )
    any_near = False
    for k in range(obstacles):
        # a comparison gives a mask of the lanes, which is 0 if it holds in none
        work.near[k] = (load(work.bounds, k, 0) - radius - speed < upper_bound) != 0
        any_near |= work.near[k]
    return any_near


@allocation_free(forceinline=True)
def group_along(robot, scene, g, swept, work):
    """Writes to `work` the clearances of group g to the scene, at most `work.need`, and lower bounds of the
    clearances along the motions. Without `swept` the twists count as zero."""
    frame = robot.frame[g]
    solids = len(scene.solids)
    centers = load_vector(work.centers, g, 0)
    still = minus(centers, centers)
    speed = _speed(work.twists, frame, 0, centers, robot.bounds[g, 3]) if swept else still[0]
    _reset(work)
    if not _mark_near(robot, scene, g, speed, work):
        return
    _place_group(robot, g, work)
    for s in range(robot.first[g], robot.first[g + 1]):
        centers = load_vector(work.positions, s, 0)
        velocities = _velocity(work.twists, frame, centers) if swept else still
        radius = robot.spheres[s, 3]
        for k in range(solids):
            if work.near[k]:
                distance, towards = to_solid(centers, velocities, scene.solids[k])
                _lower_to(distance - radius, towards, work)
        if len(scene.points) and work.near[solids]:
            # the nearest point changes along the motion, so the bound uses the sphere's whole speed instead
            # of the component towards one point
            speed = _length(velocities)
            for i in range(W):
                limit = min(work.clearance[0, i] + lane(speed, i), POINT_RANGE) + radius
                distance = points_distance(scene, vector_in(centers, i), limit) - radius
                work.clearance[0, i] = min(work.clearance[0, i], distance)
                work.lower[0, i] = min(work.lower[0, i], distance - lane(speed, i))


@allocation_free(forceinline=True)
def pair_along(robot, p, swept, work):
    """Does what `group_along` does, for the clearance between the links of a checked pair."""
    a = robot.pairs[p, 0]
    b = robot.pairs[p, 1]
    spheres = robot.spheres
    bounds = robot.bounds
    twists = work.twists
    f = robot.frame[a]
    g = robot.frame[b]
    centers = load_vector(work.centers, a, 0)
    other_center = load_vector(work.centers, b, 0)
    still = minus(centers, centers)
    speed = _speed(twists, f, g, centers, bounds[a, 3]) if swept else still[0]
    _reset(work)
    gap = _length(minus(centers, other_center)) - (bounds[a, 3] + bounds[b, 3])
    if (gap - speed < load(work.clearance, 0, 0)) == 0:
        return
    _place_group(robot, a, work)
    _place_group(robot, b, work)
    for s in range(robot.first[a], robot.first[a + 1]):
        centers = load_vector(work.positions, s, 0)
        speed = _speed(twists, f, g, centers, ZERO) if swept else still[0]
        gap = _length(minus(centers, other_center)) - (spheres[s, 3] + bounds[b, 3])
        if (gap - speed < load(work.clearance, 0, 0)) == 0:
            continue
        velocities = _velocity(twists, f, centers) if swept else still
        for t in range(robot.first[b], robot.first[b + 1]):
            partners = load_vector(work.positions, t, 0)
            # only the difference of the velocities along the line between the centers matters; this
            # difference is the same in every frame of reference
            relative = minus(velocities, _velocity(twists, g, partners) if swept else still)
            offset = minus(centers, partners)
            distance = _length(offset)
            towards = absolute(dot(offset, relative)) / maximum(distance, TINY)
            _lower_to(distance - (spheres[s, 3] + spheres[t, 3]), towards, work)


@allocation_free(inner=False)
def block_clearances(robot, scene, q, limit, work, out):
    """Writes the signed distances of the moving groups to the scene at q[dof, 16], at most `limit` [m], to
    out[groups, 16]. Moving groups come last in `robot`."""
    place_frames(robot, q, work.frames, work.centers)
    work.placed[:] = False
    work.need[:] = limit
    for g in range(len(out)):
        group_along(robot, scene, len(robot.frame) - len(out) + g, False, work)
        store(out, g, 0, load(work.clearance, 0, 0))


@allocation_free()
def block_pair_clearances(robot, q, limit, work, out):
    """Writes the distances between the links of the checked pairs at q[dof, 16], at most `limit` [m], to
    out[pairs, 16].

    Where the spheres touch although the pair's table excludes contact of the links, the distance is unknown
    and `limit` is written.
    """
    place_frames(robot, q, work.frames, work.centers)
    work.placed[:] = False
    work.need[:] = limit
    for p in range(len(out)):
        pair_along(robot, p, False, work)
        table = robot.pairs[p, 2]
        bit = robot.pairs[p, 3]
        separated_lanes = 0
        if table >= 0 and reduce_min(load(work.clearance, 0, 0)) <= ZERO:
            separated_lanes = ~lanes_that_may_touch(robot, table, bit, q)
        for i in range(W):
            separated = work.clearance[0, i] <= ZERO and separated_lanes >> i & 1
            out[p, i] = limit if separated else work.clearance[0, i]


@inner_kernel()
def pair_clearances_into(robot, q, limit, work, out):
    """Writes clearances of the checked pairs for the rows of q[n, dof] to out[n, pairs]."""
    block = np.empty((q.shape[1], W), np.float32)
    lane_clearances = np.empty((out.shape[1], W), np.float32)
    for start in range(0, len(q), W):
        take_block(q, start, block)
        block_pair_clearances(robot, block, limit, work, lane_clearances)
        _put_block(lane_clearances, start, out)


@inner_kernel()
def clearances_into(robot, scene, q, limit, work, out):
    """Writes clearances of the moving groups for the rows of q[n, dof] to out[n, groups]."""
    block = np.empty((q.shape[1], W), np.float32)
    lane_clearances = np.empty((out.shape[1], W), np.float32)
    for start in range(0, len(q), W):
        take_block(q, start, block)
        block_clearances(robot, scene, block, limit, work, lane_clearances)
        _put_block(lane_clearances, start, out)


@inner_kernel()
def _put_block(block, start, out):
    """Writes the columns of a block to the rows of `out` from `start` on."""
    for i in range(min(W, len(out) - start)):
        out[start + i] = block[:, i]


@kernel(nogil=True)
def pair_clearances(robot, q, limit):
    """Distances [n, pairs] between the checked pairs of links at q[n, dof], at most `limit`."""
    out = np.empty((len(q), len(robot.pairs)), np.float32)
    pair_clearances_into(robot, q, limit, make_clearance_workspace(robot, 0), out)
    return out


@kernel(nogil=True)
def link_clearances(robot, scene, q, limit):
    """Signed distances [n, moving groups] to the scene at q[n, dof], at most `limit`."""
    out = np.empty((len(q), len(robot.frame) - np.searchsorted(robot.frame, 1)), np.float32)
    clearances_into(robot, scene, q, limit, make_clearance_workspace(robot, len(scene.solids)), out)
    return out
