"""Compiled path constraints: values of their rows, what a straight motion keeps, and projection onto them.

A row is a scalar function of the pose of a frame that must not exceed its limit:

- DISTANCE: from the frame's origin to a box [m], negative within. Lines, planes and segments are boxes
  without extent, or without end, along some of their axes.
- CONE: the angle between an axis of the frame and a direction [rad].
- TURN: the angle from the frame's orientation to the one that belongs to its share of a segment [rad].

What a piece of a motion keeps is proved from the poses at its two ends. Joints move by dq along it at
constant rates, so the frame's origin p leaves the straight line between its ends by at most an eighth of the
greatest second derivative, which is at most sum_jk |dq_j dq_k| r_max(j,k), r_k being the distance from the
axis of joint k to p. Distance to a box is convex with slope 1, hence DISTANCE is at most the greater of its
two ends and that. The cosine of CONE is linear in the axis, whose second derivative is at most
(sum_j |dq_j|)². TURN grows no faster than the frame and its reference turn.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from robotdiffuse.robots.ik_kernel import PRISMATIC, damped_step, forward, pose_error

DISTANCE, CONE, TURN = 0, 1, 2
ANGLE_WEIGHT = 0.3
"""Metres that one radian counts as in projection."""
DAMPING, MOST_STEP, ITERATIONS = 1e-5, 1.0, 30
"""Of projection: squared singular values well above it are inverted; longest step [rad]; steps."""


class Rows(NamedTuple):
    """Constraints of one robot as rows, each with the chain of joints that move its frame."""

    joints: np.ndarray
    """[m, dof] the joints of the chain, `last` of them."""
    offsets: np.ndarray
    """[m, dof, 4, 4] of these, of `Robot.frame_offsets`."""
    kinds: np.ndarray
    """[m, dof] of these, as in `robots.ik_kernel`."""
    endless: np.ndarray
    """[dof] whether a joint turns without limits."""
    lower: np.ndarray
    upper: np.ndarray
    what: np.ndarray
    """[m] DISTANCE, CONE or TURN."""
    last: np.ndarray
    """[m] joints that move the frame."""
    again: np.ndarray
    """[m] whether the frame is that of the row before."""
    tool: np.ndarray
    """[m, 4, 4] of the frame in that of its last joint."""
    place: np.ndarray
    """[m, 4, 4] DISTANCE: T_base_box; TURN: the pose at the start."""
    half: np.ndarray
    """[m, 3] DISTANCE: half edges, may be infinite."""
    core: np.ndarray
    """[m, 3] DISTANCE: half edges of the box that projection goes to."""
    a: np.ndarray
    """[m, 3] CONE: the axis in the frame; TURN: rotation vector from start to goal."""
    b: np.ndarray
    """[m, 3] CONE: the direction; TURN: the segment over its squared length."""
    limit: np.ndarray
    """[m]"""
    inner: np.ndarray
    """[m] what projection goes to."""
    room: np.ndarray
    """[m] size of the range of values, for shares of it."""
    reach: np.ndarray
    """[m, dof] of the chain's joints, bounds of the distance from each one's axis to the frame's origin, 1
    for sliding joints."""


class Work(NamedTuple):
    """Memory."""

    T: np.ndarray
    q: np.ndarray
    """[dof] values of a chain's joints."""
    axes: np.ndarray
    origins: np.ndarray
    values: np.ndarray
    """[2, m] at the ends of a piece."""
    levers: np.ndarray
    """[2, m, dof]"""
    limits: np.ndarray
    target: np.ndarray
    error: np.ndarray
    J: np.ndarray
    e: np.ndarray
    A: np.ndarray
    y: np.ndarray
    step: np.ndarray
    held: np.ndarray
    trial: np.ndarray


@njit(cache=True)
def make_work(rows):
    m, dof = rows.reach.shape
    most = 3 * m
    return Work(
        np.empty((3, 4)),
        np.empty(dof),
        np.empty((dof, 3)),
        np.empty((dof, 3)),
        np.empty((2, m)),
        np.empty((2, m, dof)),
        np.empty(m),
        np.empty((3, 4)),
        np.empty(6),
        np.zeros((most, dof)),
        np.zeros(most),
        np.zeros((most, most)),
        np.zeros(most),
        np.zeros(dof),
        np.zeros(dof, np.bool_),
        np.empty(dof),
    )


@njit(cache=True)
def _pose(rows, m, q, work):
    """The pose of the frame of row m into work.T, with the axes and origins of the joints before it."""
    for k in range(rows.last[m]):
        work.q[k] = q[rows.joints[m, k]]
    forward(
        work.q, rows.offsets[m], rows.tool[m], rows.kinds[m], rows.last[m], work.T, work.axes, work.origins
    )


@njit(cache=True)
def _in_box(rows, m, T, r):
    """Coordinate r of the frame's origin in the box."""
    place, out = rows.place[m], 0.0
    for i in range(3):
        out += place[i, r] * (T[i, 3] - place[i, 3])
    return out


@njit(cache=True)
def _cone(rows, m, T, normal):
    """The angle of a CONE; into normal[3] the direction in which to turn the axis, of length sin(angle)."""
    a, b = rows.a[m], rows.b[m]
    x = T[0, 0] * a[0] + T[0, 1] * a[1] + T[0, 2] * a[2]
    y = T[1, 0] * a[0] + T[1, 1] * a[1] + T[1, 2] * a[2]
    z = T[2, 0] * a[0] + T[2, 1] * a[1] + T[2, 2] * a[2]
    normal[0], normal[1], normal[2] = y * b[2] - z * b[1], z * b[0] - x * b[2], x * b[1] - y * b[0]
    sine = np.sqrt(normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2)
    return np.arctan2(sine, x * b[0] + y * b[1] + z * b[2])


@njit(cache=True)
def _turn(rows, m, T, target, error):
    """The angle of a TURN; into error[3:6] the rotation vector to the orientation that belongs there."""
    place, share = rows.place[m], 0.0
    for i in range(3):
        share += rows.b[m, i] * (T[i, 3] - place[i, 3])
    share = min(max(share, 0.0), 1.0)
    x, y, z = share * rows.a[m, 0], share * rows.a[m, 1], share * rows.a[m, 2]
    angle = np.sqrt(x * x + y * y + z * z)
    c, s, v = np.cos(angle), 1.0, 0.5
    if angle > 1e-9:
        s, v = np.sin(angle) / angle, (1 - c) / (angle * angle)
    for k in range(3):  # Rodrigues, times the orientation at the start
        p, q, r = place[0, k], place[1, k], place[2, k]
        along = v * (x * p + y * q + z * r)
        target[0, k] = c * p + s * (y * r - z * q) + along * x
        target[1, k] = c * q + s * (z * p - x * r) + along * y
        target[2, k] = c * r + s * (x * q - y * p) + along * z
    for i in range(3):
        target[i, 3] = T[i, 3]
    return np.sqrt(pose_error(T, target, 6, 1.0, error))


@njit(cache=True)
def _value(rows, m, work):
    """The value of row m at the pose in work.T."""
    if rows.what[m] == CONE:
        return _cone(rows, m, work.T, work.error)
    if rows.what[m] == TURN:
        return _turn(rows, m, work.T, work.target, work.error)
    outside, deepest = 0.0, -np.inf
    for r in range(3):
        d = abs(_in_box(rows, m, work.T, r)) - rows.half[m, r]
        outside += max(d, 0.0) ** 2
        deepest = max(deepest, d)
    return np.sqrt(outside) + min(deepest, 0.0)


@njit(cache=True)
def evaluate(rows, q, end, work):
    """Values at a configuration into work.values[end], and the distances from the joints' axes to the frame's
    origin into work.levers[end]."""
    for m in range(len(rows.what)):
        if not rows.again[m]:
            _pose(rows, m, q, work)
        work.values[end, m] = _value(rows, m, work)
        if rows.what[m] != CONE:
            for k in range(rows.last[m]):
                velocity = work.y
                velocity[0] = velocity[1] = velocity[2] = 0.0
                _add_velocity(rows, m, k, 1.0, work, velocity)
                work.levers[end, m, k] = np.sqrt(velocity[0] ** 2 + velocity[1] ** 2 + velocity[2] ** 2)


@njit(cache=True)
def values(rows, q):
    """Values of the rows [n, m] at configurations [n, dof]."""
    work = make_work(rows)
    out = np.empty((len(q), len(rows.what)))
    for i in range(len(q)):
        evaluate(rows, q[i], 0, work)
        out[i] = work.values[0]
    return out


@njit(cache=True)
def speeds(rows, m, q, rates):
    """Speed of the origin of the frame of row m [n] at configurations [n, dof] with joint rates [n, dof]."""
    work = make_work(rows)
    out = np.empty(len(q))
    for i in range(len(q)):
        _pose(rows, m, q[i], work)
        total = np.zeros(3)
        for k in range(rows.last[m]):
            _add_velocity(rows, m, k, rates[i, rows.joints[m, k]], work, total)
        out[i] = np.sqrt((total * total).sum())
    return out


@njit(cache=True)
def _add_velocity(rows, m, k, rate, work, total):
    """Adds the velocity of the origin of the frame of row m by joint k of its chain."""
    a, b, c = work.axes[k, 0], work.axes[k, 1], work.axes[k, 2]
    if rows.kinds[m, k] == PRISMATIC:
        x, y, z = a, b, c
    else:
        dx, dy = work.T[0, 3] - work.origins[k, 0], work.T[1, 3] - work.origins[k, 1]
        dz = work.T[2, 3] - work.origins[k, 2]
        x, y, z = b * dz - c * dy, c * dx - a * dz, a * dy - b * dx
    total[0] += rate * x
    total[1] += rate * y
    total[2] += rate * z


@njit(cache=True)
def _unproved(rows, limits, a, b, share, first, second, work):
    """The first row that the share of the motion from a to b between two ends, evaluated as `first` and
    `second`, is not proved to keep; -1 if there is none."""
    for m in range(len(rows.what)):
        u, v = work.values[first, m], work.values[second, m]
        turn = 0.0
        for k in range(rows.last[m]):
            if rows.kinds[m, k] != PRISMATIC:
                j = rows.joints[m, k]
                turn += share * abs(b[j] - a[j])
        if rows.what[m] == CONE:
            if limits[m] < np.pi and min(np.cos(u), np.cos(v)) - turn * turn / 8 < np.cos(limits[m]):
                return m
            continue
        beyond, before, travel, bend = 0.0, 0.0, 0.0, 0.0
        for k in range(rows.last[m]):
            j = rows.joints[m, k]
            beyond += rows.reach[m, k] * share * abs(b[j] - a[j])
        for k in range(rows.last[m]):
            j = rows.joints[m, k]
            d = share * abs(b[j] - a[j])
            beyond -= rows.reach[m, k] * d
            lever = max(work.levers[first, m, k], work.levers[second, m, k])
            if rows.kinds[m, k] != PRISMATIC:
                lever += 0.5 * max(beyond, 0.0)
            travel += lever * d
            bend += lever * d * (d + 2 * before)
            before += d
        if rows.what[m] == DISTANCE:
            if max(u, v) + bend / 8 > limits[m]:
                return m
            continue
        spin = np.sqrt(rows.a[m, 0] ** 2 + rows.a[m, 1] ** 2 + rows.a[m, 2] ** 2)
        spin *= np.sqrt(rows.b[m, 0] ** 2 + rows.b[m, 1] ** 2 + rows.b[m, 2] ** 2)
        if 0.5 * (u + v + turn + spin * travel) > limits[m]:
            return m
    return -1


@njit(cache=True)
def proved(rows, limits, a, b, least, work):
    """Up to which share the straight motion from a to b is proved to keep the limits, and the row that it is
    not proved to keep there, -1 for none. Pieces are split down to the share `least`."""
    done, share, end = 0.0, 1.0, 0
    evaluate(rows, a, 0, work)
    while done < 1.0:
        share = min(share, 1.0 - done)
        for k in range(len(a)):
            work.trial[k] = a[k] + (done + share) * (b[k] - a[k])
        evaluate(rows, work.trial, 1 - end, work)
        row = _unproved(rows, limits, a, b, share, end, 1 - end, work)
        if row < 0:
            done, end, share = done + share, 1 - end, 2 * share
        elif share <= least:
            return done, row
        else:
            share *= 0.5
    return 1.0, -1


@njit(cache=True)
def first_unproved(rows, limits, q, least):
    """The segment of the motion through q[n, dof], the share of it and the row at which the limits are first
    not proved to be kept; row -1 if they are all along."""
    work = make_work(rows)
    evaluate(rows, q[0], 0, work)
    for m in range(len(rows.what)):
        if work.values[0, m] > limits[m]:
            return 0, 0.0, m
    for i in range(len(q) - 1):
        share, row = proved(rows, limits, q[i], q[i + 1], least, work)
        if row >= 0:
            return i, share, row
    return len(q) - 1, 0.0, -1


@njit(cache=True)
def _residuals(rows, limits, q, work):
    """Of the rows beyond their limits, what is left to where projection goes, into work.e, and its Jacobian
    into work.J; returns their number."""
    count, dof = 0, len(q)
    for m in range(len(rows.what)):
        if not rows.again[m]:
            _pose(rows, m, q, work)
        value = _value(rows, m, work)
        if value <= limits[m]:
            continue
        lines = 1 if rows.what[m] == CONE else 3
        keep = 1.0 - rows.inner[m] / value if value > 0 else 1.0
        sine = np.sqrt(work.error[0] ** 2 + work.error[1] ** 2 + work.error[2] ** 2)
        for r in range(lines):
            if rows.what[m] == DISTANCE:
                x = _in_box(rows, m, work.T, r)
                off = min(max(x, -rows.core[m, r]), rows.core[m, r]) - x
                if off == 0.0:
                    continue
                work.e[count] = off * keep
            elif rows.what[m] == CONE:
                work.e[count] = ANGLE_WEIGHT * (value - rows.inner[m])
            else:
                work.e[count] = ANGLE_WEIGHT * work.error[3 + r] * keep
            for j in range(dof):
                work.J[count, j] = 0.0
            for k in range(rows.last[m]):
                entry = 0.0
                if rows.what[m] == DISTANCE:
                    moved = work.y
                    moved[0] = moved[1] = moved[2] = 0.0
                    _add_velocity(rows, m, k, 1.0, work, moved)
                    for i in range(3):
                        entry += rows.place[m, i, r] * moved[i]
                elif rows.kinds[m, k] != PRISMATIC and rows.what[m] == TURN:
                    entry = ANGLE_WEIGHT * work.axes[k, r]
                elif rows.kinds[m, k] != PRISMATIC and sine > 1e-9:
                    for i in range(3):
                        entry += ANGLE_WEIGHT * work.axes[k, i] * work.error[i] / sine
                elif rows.kinds[m, k] != PRISMATIC:  # opposite: any way to turn
                    entry = ANGLE_WEIGHT * work.axes[k, 0]
                work.J[count, rows.joints[m, k]] = entry
            count += 1
    return count


@njit(cache=True)
def step(rows, limits, q, most, work):
    """Moves q by a damped Newton step, at most so long [rad], towards where it keeps the limits, within the
    joints' limits; how many residuals there were, 0 for none and so no step, -1 where no step helps."""
    dof = len(q)
    count = _residuals(rows, limits, q, work)
    if count == 0:
        return 0
    work.held[:] = False
    damped_step(work.J, work.e, DAMPING, count, dof, work.held, work.A, work.y, work.step)
    again = False
    for k in range(dof):
        low, high = q[k] <= rows.lower[k], q[k] >= rows.upper[k]
        if not rows.endless[k] and ((low and work.step[k] < 0.0) or (high and work.step[k] > 0.0)):
            work.held[k] = again = True
    if again:
        damped_step(work.J, work.e, DAMPING, count, dof, work.held, work.A, work.y, work.step)
    length = np.sqrt((work.step * work.step).sum())
    scale = min(1.0, most / max(length, 1e-12))
    if length < 1e-9:
        return -1
    for k in range(dof):
        q[k] += scale * work.step[k]
        if not rows.endless[k]:
            q[k] = min(max(q[k], rows.lower[k]), rows.upper[k])
    return count


@njit(cache=True)
def project(rows, limits, q, work):
    """Moves q to a configuration near by that keeps the limits, by damped Newton steps within the joints'
    limits; whether it got there."""
    for _ in range(ITERATIONS):
        left = step(rows, limits, q, MOST_STEP, work)
        if left <= 0:
            return left == 0
    return _residuals(rows, limits, q, work) == 0
