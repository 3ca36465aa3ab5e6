"""Numba kernel that projects configurations onto path constraints by damped Newton steps.

`constraint_kernel.py` defines the rows, their values and the working memory.
"""

import numpy as np

from robotdiffuse.core.kernels import inner_kernel, kernel
from robotdiffuse.problems.constraint_kernel import (
    CONE,
    DISTANCE,
    ROLL_PITCH_YAW,
    TURN,
    box_coordinate,
    frame_velocity,
    length,
    make_work,
    pose_frame,
    row_value,
)
from robotdiffuse.robots.ik_kernel import PRISMATIC, limited_step

ANGLE_WEIGHT = 0.3
"""An error of 1 rad counts as this many meters in projection [m/rad]."""
MIN_COSINE = 0.05
"""Lower bound of |cos(pitch)| in the rates of roll and yaw, which diverge at a pitch of 90°."""
DAMPING = 1e-5
"""Damping of the steps; only squared singular values well above it are inverted."""
MAX_STEP = 1.0
"""Longest step of a projection [rad, joint-space L2]."""
MAX_ITERATIONS = 30
"""Maximum number of steps of a projection."""


@inner_kernel()
def _angle_rate(reference, axis, angles, r):
    """Rate [rad/s] of roll (r = 0), pitch (1) or yaw (2) relative to a reference orientation, while the frame
    turns about an axis (base frame) at 1 rad/s. angles: the present roll, pitch and yaw."""
    sine = np.sin(angles[2])
    cosine = np.cos(angles[2])
    x = y = z = 0.0
    for i in range(3):
        x += axis[i] * (cosine * reference[i, 0] + sine * reference[i, 1])
        y += axis[i] * (cosine * reference[i, 1] - sine * reference[i, 0])
        z += axis[i] * reference[i, 2]
    if r == 1:
        return y
    roll_rate = x / np.copysign(max(abs(np.cos(angles[1])), MIN_COSINE), np.cos(angles[1]))
    return roll_rate if r == 0 else z + roll_rate * np.sin(angles[1])


@inner_kernel()
def _residuals(rows, limits, q, work):
    """The number of residuals of the rows that exceed their limits.

    Writes these residuals to work.e: the differences to the values that projection aims for, with angles
    multiplied by ANGLE_WEIGHT. Writes their Jacobian to work.J.
    """
    count = 0
    dof = len(q)
    for m in range(len(rows.row_kind)):
        kind = rows.row_kind[m]
        if not rows.same_frame[m]:
            pose_frame(rows, m, q, work)
        value = row_value(rows, m, work)
        if value <= limits[m]:
            continue
        residuals = 1 if kind == CONE else 3
        # the fraction of the error to remove, so that inner_limit is left
        share = 1.0 - rows.inner_limit[m] / value if value > 0 else 1.0
        sine = length(work.error)  # of a CONE's angle
        for r in range(residuals):
            inner = rows.inner_half_size[m, r]
            if kind == DISTANCE:
                x = box_coordinate(rows, m, work.T, r)
                offset = min(max(x, -inner), inner) - x
                if offset == 0.0:
                    continue
                work.e[count] = offset * share
            elif kind == CONE:
                work.e[count] = ANGLE_WEIGHT * (value - rows.inner_limit[m])
            elif kind == ROLL_PITCH_YAW:
                angle = work.error[r]
                if abs(angle) <= rows.half_size[m, r]:
                    continue
                work.e[count] = ANGLE_WEIGHT * (min(max(angle, -inner), inner) - angle)
            else:
                work.e[count] = ANGLE_WEIGHT * work.error[3 + r] * share
            # the derivatives with respect to the joints of the chain
            for j in range(dof):
                work.J[count, j] = 0.0
            for k in range(rows.chain_length[m]):
                entry = 0.0
                if kind == DISTANCE:
                    frame_velocity(rows, m, k, work, work.y)
                    for i in range(3):
                        entry += rows.reference_pose[m, i, r] * work.y[i]
                elif rows.joint_kinds[m, k] == PRISMATIC:
                    pass  # it does not turn the frame
                elif kind == TURN:
                    entry = ANGLE_WEIGHT * work.axes[k, r]
                elif kind == ROLL_PITCH_YAW:
                    entry = ANGLE_WEIGHT * _angle_rate(rows.reference_pose[m], work.axes[k], work.error, r)
                elif sine > 1e-9:
                    for i in range(3):
                        entry += ANGLE_WEIGHT * work.axes[k, i] * work.error[i] / sine
                else:
                    # the axis of the CONE is opposite to its direction: a turn about any other axis
                    # reduces the angle; (1, 1, 1) is taken
                    entry = ANGLE_WEIGHT * np.sum(work.axes[k])
                work.J[count, rows.chain[m, k]] = entry
            count += 1
    return count


@inner_kernel()
def step(rows, limits, q, most, work):
    """Moves q by one damped Newton step towards the limits, within the joint limits.

    most: longest step [rad]. Returns the number of residuals before the step: 0 if q satisfied all limits and
    was not moved; or -1 if the step is shorter than 1e-9, so that q cannot come nearer to the limits.
    """
    dof = len(q)
    count = _residuals(rows, limits, q, work)
    if count == 0:
        return 0
    limited_step(
        work.J,
        work.e,
        DAMPING,
        count,
        dof,
        q,
        rows.lower,
        rows.upper,
        rows.continuous,
        work.held,
        work.A,
        work.y,
        work.step,
    )
    distance = np.sqrt((work.step * work.step).sum())
    if distance < 1e-9:
        return -1
    scale = min(1.0, most / distance)
    for k in range(dof):
        q[k] += scale * work.step[k]
        if not rows.continuous[k]:
            q[k] = min(max(q[k], rows.lower[k]), rows.upper[k])
    return count


@kernel()
def project(rows, limits, q, work):
    """Projects q in place onto the limits by damped Newton steps, within the joint limits.

    Returns whether q satisfies the limits.
    """
    for _ in range(MAX_ITERATIONS):
        residuals = step(rows, limits, q, MAX_STEP, work)
        if residuals <= 0:
            return residuals == 0
    return _residuals(rows, limits, q, work) == 0


@kernel(nogil=True)
def project_each(rows, limits, q, most):
    """Projects configurations q[n, dof] in place, in order, until `most` of them satisfy the limits; -1:
    projects all. Returns which configurations were projected and satisfy the limits [n]."""
    work = make_work(rows)
    satisfied = np.zeros(len(q), np.bool_)
    count = 0
    for i in range(len(q)):
        satisfied[i] = project(rows, limits, q[i], work)
        count += satisfied[i]
        if count == most:
            break
    return satisfied
