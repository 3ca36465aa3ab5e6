"""Numba kernel of path constraints: evaluates them, and proves them along straight motions.

`compiled_constraints.py` builds the arrays that this file reads (`Rows`) from the constraints of a problem. A
row is a scalar function of the pose of a link, which is called the row's frame. There are four kinds of rows;
the value of each must not exceed a limit:

- DISTANCE: from the frame's origin to a box [m], negative inside. Lines, planes and segments are boxes of
  zero or infinite size along some of their axes.
- CONE: the angle between an axis of the frame and a direction [rad].
- TURN: the angle from the frame's orientation to the orientation that is interpolated along a segment, at the
  point of the segment that is nearest to the frame's origin [rad].
- ROLL_PITCH_YAW: the largest excess of roll, pitch or yaw, relative to a reference, over its tolerance [rad].
  Only goals have such rows, not motions.

From the poses at the two ends of a piece of a motion, a bound for the whole piece is computed. Along the
piece, the joints move by dq at constant rates.

- DISTANCE: the frame's origin p leaves the straight line between the two ends by at most an eighth of the
  second derivative of p. This derivative is at most sum_jk |dq_j dq_k| r[max(j, k)], where r[k], the lever
  of joint k, is the distance from the joint's axis to p. Distance to a box is convex with slope 1, so it is
  at most this deviation plus the larger value at the two ends.
- CONE: the cosine of the angle is linear in the axis; the axis has a second derivative of at most
  (sum_j |dq_j|)².
- TURN: the angle changes no faster than the frame and the interpolated orientation together rotate.
"""

from typing import NamedTuple

import numpy as np

from robotdiffuse.core.kernels import inner_kernel, kernel
from robotdiffuse.robots.ik_kernel import PRISMATIC, forward, pose_error

DISTANCE = 0
CONE = 1
TURN = 2
ROLL_PITCH_YAW = 3


class Rows(NamedTuple):
    """Constraints of one robot as m rows, each with the chain of joints that move its frame."""

    chain: np.ndarray
    """[m, dof] indices of the joints that move the frame, `chain_length` of them."""
    offsets: np.ndarray
    """[m, dof, 4, 4] `Robot.frame_offsets` of these joints."""
    joint_kinds: np.ndarray
    """[m, dof] kinds of these joints, as in `robots.ik_kernel`."""
    continuous: np.ndarray
    """[dof] whether a joint turns without limits."""
    lower: np.ndarray
    upper: np.ndarray
    row_kind: np.ndarray
    """[m] kind of each row: DISTANCE, CONE, TURN or ROLL_PITCH_YAW."""
    chain_length: np.ndarray
    """[m] number of joints that move the frame."""
    same_frame: np.ndarray
    """[m] whether the row has the same frame as the row before."""
    T_joint_frame: np.ndarray
    """[m, 4, 4] pose of the frame relative to the last joint of its chain."""
    reference_pose: np.ndarray
    """[m, 4, 4] DISTANCE: T_base_box; TURN: pose of the frame at the start; ROLL_PITCH_YAW: the reference."""
    half_size: np.ndarray
    """[m, 3] DISTANCE: half edge lengths of the box; ROLL_PITCH_YAW: tolerances; may be infinite."""
    inner_half_size: np.ndarray
    """[m, 3] DISTANCE, ROLL_PITCH_YAW: half edge lengths of the box, or tolerances, that projection aims
    for."""
    a: np.ndarray
    """[m, 3] CONE: the axis in the frame; TURN: the rotation vector from start to goal [rad]."""
    b: np.ndarray
    """[m, 3] CONE: the direction; TURN: the vector from start to goal divided by its squared length, so that
    b · (p - start) is the fraction of the segment at p."""
    limit: np.ndarray
    """[m] largest allowed value, in meters or radians."""
    inner_limit: np.ndarray
    """[m] value that projection aims for."""
    tolerance: np.ndarray
    """[m] size of the allowed range of values; arguments named `tolerance_fraction` are fractions of it."""
    lever_bounds: np.ndarray
    """[m, dof] for each joint of the chain, an upper bound of its lever: the distance from its axis to the
    frame's origin in meters; 1 for prismatic joints."""


class Work(NamedTuple):
    """Preallocated arrays of one thread."""

    T: np.ndarray
    """[3, 4] pose of the frame in the base frame."""
    q: np.ndarray
    """[dof] values of the joints of a chain."""
    axes: np.ndarray
    """[dof, 3] axes of the joints of a chain in the base frame."""
    origins: np.ndarray
    """[dof, 3] a point on each of these axes."""
    values: np.ndarray
    """[2, m] values of the rows at the two ends of a piece."""
    levers: np.ndarray
    """[2, m, dof] levers of the joints at the two ends."""
    target: np.ndarray
    """[3, 4] the interpolated pose of a TURN."""
    error: np.ndarray
    """[6] the error of an angular row: a rotation axis (CONE), a rotation vector in the entries from 3 on
    (TURN), or roll, pitch and yaw."""
    J: np.ndarray
    """[3 m, dof] Jacobian of the residuals e, for projection."""
    e: np.ndarray
    A: np.ndarray
    """[3 m, 3 m] matrix of the linear system of a step."""
    y: np.ndarray
    """[3 m] intermediate solution of this system; also scratch memory."""
    step: np.ndarray
    """[dof] the step of a projection."""
    held: np.ndarray
    """[dof] joints that a step must not move."""
    trial: np.ndarray
    """[dof] configuration at the end of a piece."""


@kernel()
def make_work(rows):
    m, dof = rows.lever_bounds.shape
    row_count = 3 * m
    return Work(
        np.empty((3, 4)),
        np.empty(dof),
        np.empty((dof, 3)),
        np.empty((dof, 3)),
        np.empty((2, m)),
        np.empty((2, m, dof)),
        np.empty((3, 4)),
        np.empty(6),
        np.zeros((row_count, dof)),
        np.zeros(row_count),
        np.zeros((row_count, row_count)),
        np.zeros(row_count),
        np.zeros(dof),
        np.zeros(dof, np.bool_),
        np.empty(dof),
    )


@inner_kernel()
def pose_frame(rows, m, q, work):
    """Writes the pose of the frame of row m to work.T, and the joint axes and origins of its chain."""
    for k in range(rows.chain_length[m]):
        work.q[k] = q[rows.chain[m, k]]
    forward(
        work.q,
        rows.offsets[m],
        rows.T_joint_frame[m],
        rows.joint_kinds[m],
        rows.chain_length[m],
        work.T,
        work.axes,
        work.origins,
    )


@inner_kernel()
def box_coordinate(rows, m, T, r):
    """Coordinate r of the frame's origin in the frame of the box."""
    place = rows.reference_pose[m]
    out = 0.0
    for i in range(3):
        out += place[i, r] * (T[i, 3] - place[i, 3])
    return out


@inner_kernel()
def length(vector):
    """The length of the first three entries."""
    return np.sqrt(vector[0] ** 2 + vector[1] ** 2 + vector[2] ** 2)


@inner_kernel()
def _cone(rows, m, T, normal):
    """The angle of a CONE. Writes to `normal` the rotation axis [3] that reduces the angle, of length
    sin(angle)."""
    b = rows.b[m]
    x = y = z = 0.0
    for k in range(3):
        x += T[0, k] * rows.a[m, k]
        y += T[1, k] * rows.a[m, k]
        z += T[2, k] * rows.a[m, k]
    normal[0] = y * b[2] - z * b[1]
    normal[1] = z * b[0] - x * b[2]
    normal[2] = x * b[1] - y * b[0]
    return np.arctan2(length(normal), x * b[0] + y * b[1] + z * b[2])


@inner_kernel()
def _turn(rows, m, T, target, error):
    """The angle of a TURN; writes to error[3:6] the rotation vector to the interpolated orientation."""
    place = rows.reference_pose[m]
    fraction = 0.0
    for i in range(3):
        fraction += rows.b[m, i] * (T[i, 3] - place[i, 3])
    fraction = min(max(fraction, 0.0), 1.0)
    x = fraction * rows.a[m, 0]
    y = fraction * rows.a[m, 1]
    z = fraction * rows.a[m, 2]
    angle = np.sqrt(x * x + y * y + z * z)
    c = np.cos(angle)
    s = 1.0
    v = 0.5
    if angle > 1e-9:
        s = np.sin(angle) / angle
        v = (1 - c) / (angle * angle)
    for k in range(3):  # Rodrigues' formula, times the orientation at the start
        p = place[0, k]
        q = place[1, k]
        r = place[2, k]
        along = v * (x * p + y * q + z * r)
        target[0, k] = c * p + s * (y * r - z * q) + along * x
        target[1, k] = c * q + s * (z * p - x * r) + along * y
        target[2, k] = c * r + s * (x * q - y * p) + along * z
    for i in range(3):
        target[i, 3] = T[i, 3]
    return np.sqrt(pose_error(T, target, 6, 1.0, error))


@inner_kernel()
def _roll_pitch_yaw(rows, m, T, angles):
    """The value of a ROLL_PITCH_YAW. Writes roll, pitch and yaw to `angles`; of the two equivalent sets of
    angles, the set that exceeds the tolerances less."""
    # entries of the rotation from the reference to the frame
    R = rows.reference_pose[m]
    r00 = r10 = r20 = r21 = r22 = 0.0
    for i in range(3):
        r00 += R[i, 0] * T[i, 0]
        r10 += R[i, 1] * T[i, 0]
        r20 += R[i, 2] * T[i, 0]
        r21 += R[i, 2] * T[i, 1]
        r22 += R[i, 2] * T[i, 2]
    roll = np.arctan2(r21, r22)
    yaw = np.arctan2(r10, r00)
    pitch = np.arctan2(-r20, np.sqrt(r21 * r21 + r22 * r22))
    half = rows.half_size[m]
    value = max(abs(roll) - half[0], abs(pitch) - half[1], abs(yaw) - half[2])
    alternative = (
        roll - np.copysign(np.pi, roll),
        np.copysign(np.pi, pitch) - pitch,
        yaw - np.copysign(np.pi, yaw),
    )
    other_value = max(
        abs(alternative[0]) - half[0], abs(alternative[1]) - half[1], abs(alternative[2]) - half[2]
    )
    if other_value < value:
        angles[0], angles[1], angles[2] = alternative
        return other_value
    angles[0] = roll
    angles[1] = pitch
    angles[2] = yaw
    return value


@inner_kernel()
def row_value(rows, m, work):
    """The value of row m at the pose in work.T [m] or [rad]. For an angular row, writes the error to
    work.error."""
    kind = rows.row_kind[m]
    if kind == CONE:
        return _cone(rows, m, work.T, work.error)
    if kind == TURN:
        return _turn(rows, m, work.T, work.target, work.error)
    if kind == ROLL_PITCH_YAW:
        return _roll_pitch_yaw(rows, m, work.T, work.error)
    outside = 0.0
    deepest = -np.inf
    for r in range(3):
        d = abs(box_coordinate(rows, m, work.T, r)) - rows.half_size[m, r]
        outside += max(d, 0.0) ** 2
        deepest = max(deepest, d)
    return np.sqrt(outside) + min(deepest, 0.0)


@kernel()
def evaluate(rows, q, end, work):
    """Writes the values at a configuration to work.values[end], and the joints' levers to work.levers[end].
    end: 0 or 1."""
    for m in range(len(rows.row_kind)):
        if not rows.same_frame[m]:
            pose_frame(rows, m, q, work)
        work.values[end, m] = row_value(rows, m, work)
        if rows.row_kind[m] != CONE:
            for k in range(rows.chain_length[m]):
                frame_velocity(rows, m, k, work, work.y)
                work.levers[end, m, k] = length(work.y)


@kernel()
def values(rows, q):
    """Values of the rows [n, m] at configurations [n, dof]."""
    work = make_work(rows)
    out = np.empty((len(q), len(rows.row_kind)))
    for i in range(len(q)):
        evaluate(rows, q[i], 0, work)
        out[i] = work.values[0]
    return out


@kernel()
def speeds(rows, m, q, rates):
    """Speeds [n] of the origin of row m's frame at configurations [n, dof] with joint rates [n, dof]."""
    work = make_work(rows)
    out = np.empty(len(q))
    for i in range(len(q)):
        pose_frame(rows, m, q[i], work)
        total = np.zeros(3)
        for k in range(rows.chain_length[m]):
            frame_velocity(rows, m, k, work, work.y)
            for r in range(3):
                total[r] += rates[i, rows.chain[m, k]] * work.y[r]
        out[i] = length(total)
    return out


@inner_kernel()
def frame_velocity(rows, m, k, work, out):
    """Writes to `out` the velocity of the origin of row m's frame while joint k of the chain moves at 1 rad/s
    or 1 m/s."""
    a = work.axes[k, 0]
    b = work.axes[k, 1]
    c = work.axes[k, 2]
    if rows.joint_kinds[m, k] == PRISMATIC:
        out[0] = a
        out[1] = b
        out[2] = c
    else:
        dx = work.T[0, 3] - work.origins[k, 0]
        dy = work.T[1, 3] - work.origins[k, 1]
        dz = work.T[2, 3] - work.origins[k, 2]
        out[0] = b * dz - c * dy
        out[1] = c * dx - a * dz
        out[2] = a * dy - b * dx


@inner_kernel()
def _unproved(rows, limits, a, b, fraction, first, second, work):
    """The first row that is not proved along a piece of the motion from a to b; -1 if all are proved.

    fraction: length of the piece, relative to the motion. first, second: the indices in work.values and
    work.levers at which `evaluate` has written the two ends of the piece.
    """
    for m in range(len(rows.row_kind)):
        u = work.values[first, m]
        v = work.values[second, m]
        turn = 0.0  # bound of the frame's rotation along the piece [rad]
        beyond = 0.0  # how far the joints after joint k can move the frame's origin [m]
        for k in range(rows.chain_length[m]):
            j = rows.chain[m, k]
            d = fraction * abs(b[j] - a[j])
            beyond += rows.lever_bounds[m, k] * d
            if rows.joint_kinds[m, k] != PRISMATIC:
                turn += d
        if rows.row_kind[m] == CONE:
            if limits[m] < np.pi and min(np.cos(u), np.cos(v)) - turn * turn / 8 < np.cos(limits[m]):
                return m
            continue
        before = 0.0  # summed motion of the joints before joint k
        travel = 0.0  # bound of the length of the origin's path [m]
        bend = 0.0  # bound of the origin's second derivative over the piece [m]
        for k in range(rows.chain_length[m]):
            j = rows.chain[m, k]
            d = fraction * abs(b[j] - a[j])
            beyond -= rows.lever_bounds[m, k] * d
            lever = max(work.levers[first, m, k], work.levers[second, m, k])
            if rows.joint_kinds[m, k] != PRISMATIC:
                # between the ends, the later joints can lengthen the lever by half of what they move
                lever += 0.5 * max(beyond, 0.0)
            travel += lever * d
            bend += lever * d * (d + 2 * before)
            before += d
        if rows.row_kind[m] == DISTANCE:
            if max(u, v) + bend / 8 > limits[m]:
                return m
            continue
        # how much the interpolated orientation turns for each meter along the segment [rad/m]
        spin = length(rows.a[m]) * length(rows.b[m])
        if 0.5 * (u + v + turn + spin * travel) > limits[m]:
            return m
    return -1


@inner_kernel()
def proved(rows, limits, a, b, min_fraction, work):
    """The fraction of the straight motion from a to b up to which the limits are proved, and the row that is
    not proved there; 1.0 and -1 if all are proved. min_fraction: pieces up to this fraction are not split."""
    proved_fraction = 0.0
    fraction = 1.0
    end = 0
    evaluate(rows, a, 0, work)
    while proved_fraction < 1.0:
        fraction = min(fraction, 1.0 - proved_fraction)
        for k in range(len(a)):
            work.trial[k] = a[k] + (proved_fraction + fraction) * (b[k] - a[k])
        evaluate(rows, work.trial, 1 - end, work)
        row = _unproved(rows, limits, a, b, fraction, end, 1 - end, work)
        if row < 0:
            proved_fraction = proved_fraction + fraction
            end = 1 - end
            fraction = 2 * fraction
        elif fraction <= min_fraction:
            return proved_fraction, row
        else:
            fraction *= 0.5
    return 1.0, -1


@kernel()
def first_unproved(rows, limits, q, min_fraction):
    """The first place where the limits are not proved along the motion through q[n, dof].

    Returns the segment, the fraction of the segment, and the row that is not proved: -1 if all are proved.
    """
    work = make_work(rows)
    evaluate(rows, q[0], 0, work)
    for m in range(len(rows.row_kind)):
        if work.values[0, m] > limits[m]:
            return 0, 0.0, m
    for i in range(len(q) - 1):
        fraction, row = proved(rows, limits, q[i], q[i + 1], min_fraction, work)
        if row >= 0:
            return i, fraction, row
    return len(q) - 1, 0.0, -1
