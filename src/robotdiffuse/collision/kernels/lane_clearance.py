"""Compiled clearances of covering spheres to the scene and to each other, for 16 configurations or short
motions at once; see `lane_collision.py`.

A short motion is given by its middle configuration and dq, half of the joint motion from its start to its
end. The parameter t goes from -1 (start) over 0 (middle) to 1 (end). At t, the center of a sphere has moved
by t v + r from its position in the middle. v is the Jacobian times dq, and `motion_certificate.py` computes a
bound on the remainder |r| for the whole link. The distance to a convex obstacle is a convex function of the
position, so along t v it is nowhere below its tangent in the middle. With d the distance and n the direction
to the obstacle's nearest point, both in the middle, the sphere stays at least d - |n . v| - |r| away. A
configuration is a motion with v = 0.
"""

from typing import NamedTuple

import numpy as np

from robotdiffuse.collision.kernels.frames import parent_of
from robotdiffuse.collision.kernels.lane_collision import (
    W,
    lanes_that_may_touch,
    place,
    place_frames,
    take_block,
)
from robotdiffuse.collision.kernels.point_grid import POINT_RANGE, points_distance, points_lower_bound
from robotdiffuse.collision.kernels.simd import (
    absolute,
    copysign,
    lane,
    load,
    maximum,
    minimum,
    reduce_min,
    sqrt,
    store,
)
from robotdiffuse.core.kernels import allocation_free, inner_kernel, kernel

_ZERO, _ONE, _TINY, _FAR = np.float32(0.0), np.float32(1.0), np.float32(1e-9), np.float32(1e9)


class ClearanceWorkspace(NamedTuple):
    """Scratch memory for 16 configurations or motions."""

    frames: np.ndarray
    """[dof + 1, 12 * W] in the middle of each motion."""
    twists: np.ndarray
    """[dof + 1, 6 * W] for each frame the angular velocity, and the velocity of the point of the frame that
    is at the base's origin, per unit of t."""
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
    """[obstacles, W] distances of the obstacles from the center of a group's bounding sphere [m]."""
    need: np.ndarray
    """[1, W] clearances are computed up to this value [m]; a lane with a negative value is skipped."""
    clearance: np.ndarray
    """[1, W] signed distances in the middle of each motion [m]."""
    lower: np.ndarray
    """[1, W] lower bounds along each motion, without the remainder [m]."""


@kernel()
def make_clearance_workspace(robot, solids):
    """Scratch memory for one thread and at most `solids` solids."""
    joints = len(robot.offsets)
    groups = len(robot.frame)
    frames = np.zeros((joints + 1, 12 * W), np.float32)
    for k in (0, 4, 8):
        frames[0, k * W : (k + 1) * W] = 1.0
    return ClearanceWorkspace(
        frames,
        np.zeros((joints + 1, 6 * W), np.float32),
        np.empty((groups, 3 * W), np.float32),
        np.empty((len(robot.spheres), 3 * W), np.float32),
        np.empty(groups, np.bool_),
        np.empty(solids + 1, np.bool_),
        np.empty((solids + 1, W), np.float32),
        np.empty((1, W), np.float32),
        np.empty((1, W), np.float32),
        np.empty((1, W), np.float32),
    )


@allocation_free(forceinline=True)
def to_solid(x, y, z, vx, vy, vz, solid):
    """Signed distances of the points (x, y, z) in 16 lanes to a row of `SceneArrays.solids`, and the
    components of the points' velocities (vx, vy, vz) along the lines to the solid's nearest points, as
    absolute values."""
    dx = x - solid[0]
    dy = y - solid[1]
    dz = z - solid[2]
    u = dx * solid[3] + dy * solid[4] + dz * solid[5]
    v = dx * solid[6] + dy * solid[7] + dz * solid[8]
    w = dx * solid[9] + dy * solid[10] + dz * solid[11]
    # velocity in the solid's axes; multiplied by the sign of the coordinate, it is the speed away from the
    # center
    p = vx * solid[3] + vy * solid[4] + vz * solid[5]
    q = vx * solid[6] + vy * solid[7] + vz * solid[8]
    r = (vx * solid[9] + vy * solid[10] + vz * solid[11]) * copysign(_ONE, w)
    if solid[16] > _ZERO:
        from_axis = sqrt(u * u + v * v)
        p = (u * p + v * q) / maximum(from_axis, _TINY)
        u, v = from_axis - solid[12], u * _ZERO - solid[12]
    else:
        p = p * copysign(_ONE, u)
        q = q * copysign(_ONE, v)
        u = absolute(u) - solid[12]
        v = absolute(v) - solid[13]
    w = absolute(w) - solid[14]
    inside = minimum(maximum(maximum(u, v), w), _ZERO)
    u = maximum(u, _ZERO)
    v = maximum(v, _ZERO)
    w = maximum(w, _ZERO)
    d = sqrt(u * u + v * v + w * w)
    return d + inside - solid[15], absolute(u * p + v * q + w * r) / maximum(d, _TINY)


@allocation_free(forceinline=True)
def _at(positions, s):
    return load(positions, s, 0), load(positions, s, 1), load(positions, s, 2)


@allocation_free(forceinline=True)
def _velocity(twists, f, x, y, z):
    """Velocities of the points (x, y, z) of frame f."""
    a, b, c = _at(twists, f)
    return (
        b * z - c * y + load(twists, f, 3),
        c * x - a * z + load(twists, f, 4),
        a * y - b * x + load(twists, f, 5),
    )


@allocation_free(forceinline=True)
def _speed(twists, f, other, x, y, z, radius):
    """Upper bounds on the speed, relative to frame `other`, of any point of a ball that is fixed to frame
    f."""
    u, v, w = _velocity(twists, f, x, y, z)
    p, q, r = _velocity(twists, other, x, y, z)
    a, b, c = _at(twists, f)
    d, e, g = _at(twists, other)
    return _length(u - p, v - q, w - r) + radius * _length(a - d, b - e, c - g)


@allocation_free(forceinline=True)
def _length(x, y, z):
    return sqrt(x * x + y * y + z * z)


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
        for k in range(3):
            a = (k + 1) % 3
            b = (k + 2) % 3
            axis = load(work.frames, f, 3 * k + 2) * load(dq, j, 0)
            moment = load(work.frames, f, 9 + a) * load(work.frames, f, 3 * b + 2)
            moment = moment - load(work.frames, f, 9 + b) * load(work.frames, f, 3 * a + 2)
            moment = moment * load(dq, j, 0) * (_ONE - slides) + axis * slides
            store(work.twists, f, k, load(work.twists, parent, k) + axis * (_ONE - slides))
            store(work.twists, f, 3 + k, load(work.twists, parent, 3 + k) + moment)


@allocation_free()
def _place_group(robot, g, work):
    if not work.placed[g]:
        for s in range(robot.first[g], robot.first[g + 1]):
            place(work.frames, robot.frame[g], robot.spheres, s, work.positions, s)
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
    x, y, z = _at(work.centers, g)
    radius = robot.bounds[g, 3]
    upper_bound = load(work.need, 0, 0)
    zero = x * _ZERO
    solids = len(scene.solids)
    for k in range(solids):
        distance, _ = to_solid(x, y, z, zero, zero, zero, scene.solids[k])
        if len(scene.may_touch) and scene.may_touch[g, k]:
            distance = zero + _FAR
        store(work.bounds, k, 0, distance)
        upper_bound = minimum(upper_bound, distance + radius)
    obstacles = solids
    if len(scene.points):
        obstacles += 1
        for i in range(W):
            distance = points_lower_bound(scene, lane(x, i), lane(y, i), lane(z, i))
            work.bounds[solids, i] = min(distance, POINT_RANGE + radius)
    any_near = False
    for k in range(obstacles):
        work.near[k] = (load(work.bounds, k, 0) - radius - speed < upper_bound) != 0
        any_near |= work.near[k]
    return any_near


@allocation_free(forceinline=True)
def group_along(robot, scene, g, moving, work):
    """Writes to `work` the clearances of group g to the scene, at most `work.need`, and lower bounds of the
    clearances along the motions. Without `moving` the twists count as zero."""
    frame = robot.frame[g]
    solids = len(scene.solids)
    x, y, z = _at(work.centers, g)
    zero = x * _ZERO
    speed = _speed(work.twists, frame, 0, x, y, z, robot.bounds[g, 3]) if moving else zero
    _reset(work)
    if not _mark_near(robot, scene, g, speed, work):
        return
    _place_group(robot, g, work)
    for s in range(robot.first[g], robot.first[g + 1]):
        x, y, z = _at(work.positions, s)
        u, v, w = _velocity(work.twists, frame, x, y, z) if moving else (zero, zero, zero)
        radius = robot.spheres[s, 3]
        for k in range(solids):
            if work.near[k]:
                distance, towards = to_solid(x, y, z, u, v, w, scene.solids[k])
                _lower_to(distance - radius, towards, work)
        if len(scene.points) and work.near[solids]:
            # the nearest point changes along the motion, so the bound uses the sphere's whole speed instead
            # of the component towards one point
            speed = _length(u, v, w)
            for i in range(W):
                limit = min(work.clearance[0, i] + lane(speed, i), POINT_RANGE) + radius
                distance = points_distance(scene, lane(x, i), lane(y, i), lane(z, i), limit) - radius
                work.clearance[0, i] = min(work.clearance[0, i], distance)
                work.lower[0, i] = min(work.lower[0, i], distance - lane(speed, i))


@allocation_free(forceinline=True)
def pair_along(robot, p, moving, work):
    """Like `group_along`, for the clearance between the links of a checked pair."""
    a = robot.pairs[p, 0]
    b = robot.pairs[p, 1]
    spheres = robot.spheres
    bounds = robot.bounds
    twists = work.twists
    f = robot.frame[a]
    g = robot.frame[b]
    x, y, z = _at(work.centers, a)
    u, v, w = _at(work.centers, b)
    zero = x * _ZERO
    speed = _speed(twists, f, g, x, y, z, bounds[a, 3]) if moving else zero
    _reset(work)
    gap = _length(x - u, y - v, z - w) - (bounds[a, 3] + bounds[b, 3])
    if (gap - speed < load(work.clearance, 0, 0)) == 0:
        return
    _place_group(robot, a, work)
    _place_group(robot, b, work)
    for s in range(robot.first[a], robot.first[a + 1]):
        x, y, z = _at(work.positions, s)
        speed = _speed(twists, f, g, x, y, z, _ZERO) if moving else zero
        gap = _length(x - u, y - v, z - w) - (spheres[s, 3] + bounds[b, 3])
        if (gap - speed < load(work.clearance, 0, 0)) == 0:
            continue
        p, q, r = _velocity(twists, f, x, y, z) if moving else (zero, zero, zero)
        for t in range(robot.first[b], robot.first[b + 1]):
            dx, dy, dz = _at(work.positions, t)
            # only the difference of the velocities along the line between the centers matters; this
            # difference is the same in every frame of reference
            i, j, k = _velocity(twists, g, dx, dy, dz) if moving else (zero, zero, zero)
            dx = x - dx
            dy = y - dy
            dz = z - dz
            distance = _length(dx, dy, dz)
            towards = absolute(dx * (p - i) + dy * (q - j) + dz * (r - k)) / maximum(distance, _TINY)
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
        if table >= 0 and reduce_min(load(work.clearance, 0, 0)) <= _ZERO:
            separated_lanes = ~lanes_that_may_touch(robot, table, bit, q)
        for i in range(W):
            separated = work.clearance[0, i] <= _ZERO and separated_lanes >> i & 1
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
