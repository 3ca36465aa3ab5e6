"""Compiled part of inverse kinematics: damped Newton iterations from many seeds.

There are no jaxtyping annotations because Numba compiles these functions. Arrays are float64 and
C-contiguous. Continuous joints are unbounded during the iterations, and wrapped to [-pi, pi] in solutions.
"""

from typing import NamedTuple

import numpy as np
from numpy import ndarray

from robotdiffuse.core.kernels import inner_kernel, kernel
from robotdiffuse.robots.frame_kernel import step

# values of `IKChain.kinds`
REVOLUTE = 0
PRISMATIC = 1
CONTINUOUS = 2
TURN = 2 * np.pi

# Levenberg-Marquardt damping as a factor on the squared error; a seed is given up above the maximum
INITIAL_DAMPING = 1.0
MIN_DAMPING = 1e-9
MAX_DAMPING = 1e3
# factors on the damping after a step that reduces the error, and after a step that does not
DAMPING_DECREASE = 0.3
DAMPING_INCREASE = 4.0
CHECK_EVERY = 8
"""Number of iterations between two checks of the progress."""
REQUIRED_PROGRESS = 0.5
"""A seed is given up if its error is above this fraction of the error at the last check."""


@inner_kernel()
def forward(q, offsets, tool, kinds, length, T, axes, origins):
    """Write the axes and origins of the first `length` joints, and the pose of the tool into T [3, 4].

    q [dof] is the configuration, offsets [dof, 4, 4], tool [4, 4] and kinds [dof] are as in `IKChain`; axes
    and origins are [dof, 3], in the base frame.
    """
    T[:] = 0.0
    for i in range(3):
        T[i, i] = 1.0
    for j in range(length):
        step(T, offsets[j], kinds[j] == PRISMATIC, q[j], T)
        for i in range(3):
            axes[j, i] = T[i, 2]
            origins[j, i] = T[i, 3]
    step(T, tool, True, 0.0, T)


@inner_kernel()
def pose_error(T, target, rows, rotation_weight, error):
    """Write the error of pose T into `error` [6] and return its squared norm.

    Entries 0 to 2 are the position of the target minus that of T [m]. If `rows` is 6, entries 3 to 5 are the
    rotation vector from T to the target [rad] times `rotation_weight` [m/rad]; if it is 3, rotation is
    ignored.
    """
    for i in range(3):
        error[i] = target[i, 3] - T[i, 3]
    if rows == 6:
        # the rotation vector of R = target @ T.T, from the sine and cosine of its angle
        r01 = r02 = r10 = r12 = r20 = r21 = r00 = r11 = r22 = 0.0
        for k in range(3):
            r00 += target[0, k] * T[0, k]
            r01 += target[0, k] * T[1, k]
            r02 += target[0, k] * T[2, k]
            r10 += target[1, k] * T[0, k]
            r11 += target[1, k] * T[1, k]
            r12 += target[1, k] * T[2, k]
            r20 += target[2, k] * T[0, k]
            r21 += target[2, k] * T[1, k]
            r22 += target[2, k] * T[2, k]
        x = 0.5 * (r21 - r12)
        y = 0.5 * (r02 - r20)
        z = 0.5 * (r10 - r01)
        sine = np.sqrt(x * x + y * y + z * z)
        cosine = 0.5 * (r00 + r11 + r22 - 1.0)
        scale = 1.0
        if sine > 1e-12:
            scale = np.arctan2(sine, cosine) / sine
        elif cosine < 0.0:  # half a turn: an approximate axis suffices as a descent direction
            x = np.sqrt(max(r00 + 1, 0.0))
            y = np.sqrt(max(r11 + 1, 0.0))
            z = np.sqrt(max(r22 + 1, 0.0))
            scale = np.pi / np.sqrt(x * x + y * y + z * z)
        scale *= rotation_weight
        error[3] = x * scale
        error[4] = y * scale
        error[5] = z * scale
    total = 0.0
    for i in range(rows):
        total += error[i] * error[i]
    return total


@inner_kernel()
def _jacobian(T, axes, origins, kinds, length, rows, rotation_weight, J):
    """Write the geometric Jacobian of the tool into J [6, dof], with the rotation rows times
    `rotation_weight`."""
    for j in range(length):
        ax = axes[j, 0]
        ay = axes[j, 1]
        az = axes[j, 2]
        if kinds[j] == PRISMATIC:
            J[0, j] = ax
            J[1, j] = ay
            J[2, j] = az
            for i in range(3, rows):
                J[i, j] = 0.0
        else:
            dx = T[0, 3] - origins[j, 0]
            dy = T[1, 3] - origins[j, 1]
            dz = T[2, 3] - origins[j, 2]
            J[0, j] = ay * dz - az * dy
            J[1, j] = az * dx - ax * dz
            J[2, j] = ax * dy - ay * dx
            if rows == 6:
                J[3, j] = rotation_weight * ax
                J[4, j] = rotation_weight * ay
                J[5, j] = rotation_weight * az


@inner_kernel()
def damped_step(J, error, damping, rows, length, held, A, y, step):
    """Write step = J^T (J J^T + damping I)^-1 error; the columns of J and entries of step for held joints
    count as zero."""
    # A = J J^T + damping I, its Cholesky factor, and the two triangular solves
    for i in range(rows):
        for k in range(i + 1):
            total = damping if i == k else 0.0
            for j in range(length):
                if not held[j]:
                    total += J[i, j] * J[k, j]
            A[i, k] = total
    for i in range(rows):
        for k in range(i + 1):
            total = A[i, k]
            for m in range(k):
                total -= A[i, m] * A[k, m]
            A[i, k] = np.sqrt(max(total, 1e-30)) if i == k else total / A[k, k]
    for i in range(rows):
        total = error[i]
        for k in range(i):
            total -= A[i, k] * y[k]
        y[i] = total / A[i, i]
    for i in range(rows - 1, -1, -1):
        total = y[i]
        for k in range(i + 1, rows):
            total -= A[k, i] * y[k]
        y[i] = total / A[i, i]
    for j in range(length):
        total = 0.0
        if not held[j]:
            for i in range(rows):
                total += J[i, j] * y[i]
        step[j] = total


@inner_kernel()
def _is_new(q, others, count, kinds, min_distance):
    """Whether q differs from each of the first `count` others by more than min_distance in at least one
    joint. Values of continuous joints that are a turn apart are equal."""
    for n in range(count):
        differs = False
        for j in range(len(q)):
            gap = abs(q[j] - others[n, j])
            if kinds[j] == CONTINUOUS:
                gap = min(gap, TURN - gap)
            if gap > min_distance:
                differs = True
                break
        if not differs:
            return False
    return True


class IKChain(NamedTuple):
    """A chain of joints with a tool frame at its end. Arrays have entries for `dof` joints: first the joints
    of the chain, then joints after the tool, which keep the values of the seed."""

    offsets: ndarray
    """[dof, 4, 4] `Robot.frame_offsets` of the joints."""
    tool: ndarray
    """[4, 4] pose of the tool in the frame of the chain's last joint."""
    kinds: ndarray
    """[dof] REVOLUTE, PRISMATIC or CONTINUOUS."""
    length: int
    """Number of joints in the chain."""
    lower: ndarray
    """[dof] lower limits [rad or m]."""
    upper: ndarray
    """[dof] upper limits [rad or m]."""


class IKParameters(NamedTuple):
    """Parameters of `solve_seeds`; see `inverse_kinematics.py` for their values and units."""

    position_only: bool
    rotation_weight: float
    position_tolerance: float
    rotation_tolerance: float
    max_iterations: int
    min_distance: float


@kernel()
def solve_seeds(seeds, known, wanted, chain, target, parameters):
    """Solve seed after seed until `wanted` configurations are found that differ from those in `known` and
    from each other.

    seeds [n, dof] and known [m, dof] are configurations, chain is an `IKChain`, target [4, 4] the pose that
    the tool shall reach, and parameters are `IKParameters`. Returns the new configurations [k, dof] and the
    number of seeds that were used.
    """
    offsets, tool, kinds, length, lower, upper = chain
    position_only, rotation_weight, position_tolerance, rotation_tolerance, max_iterations, min_distance = (
        parameters
    )
    dof = seeds.shape[1]
    rows = 3 if position_only else 6
    T = np.empty((3, 4))
    axes = np.empty((dof, 3))
    origins = np.empty((dof, 3))
    error = np.zeros(6)
    trial_error = np.zeros(6)
    J = np.zeros((6, dof))
    A = np.zeros((6, 6))
    y = np.zeros(6)
    step = np.zeros(dof)
    fixed = np.zeros(dof, dtype=np.bool_)
    trial = np.empty(dof)
    solutions = np.empty((len(known) + wanted, dof))
    solutions[: len(known)] = known
    count = len(known)
    seeds_used = 0
    for s in range(len(seeds)):
        seeds_used = s + 1
        q = seeds[s].copy()
        forward(q, offsets, tool, kinds, length, T, axes, origins)
        cost = pose_error(T, target, rows, rotation_weight, error)
        damping = INITIAL_DAMPING
        checked_cost = cost
        solved = False
        jacobian_outdated = True
        for iteration in range(max_iterations):
            position = np.sqrt(error[0] ** 2 + error[1] ** 2 + error[2] ** 2)
            rotation = np.sqrt(error[3] ** 2 + error[4] ** 2 + error[5] ** 2) / rotation_weight
            solved = position <= position_tolerance and (position_only or rotation <= rotation_tolerance)
            if solved or damping > MAX_DAMPING:
                break
            if iteration % CHECK_EVERY == CHECK_EVERY - 1:
                if cost > REQUIRED_PROGRESS * REQUIRED_PROGRESS * checked_cost:
                    break
                checked_cost = cost
            if jacobian_outdated:
                _jacobian(T, axes, origins, kinds, length, rows, rotation_weight, J)
                jacobian_outdated = False
            # hold joints that the step would push through a limit, and solve for the others again
            fixed[:] = False
            damped_step(J, error, damping * cost, rows, length, fixed, A, y, step)
            limit_hit = False
            for j in range(length):
                if kinds[j] != CONTINUOUS and (
                    (q[j] <= lower[j] and step[j] < 0.0) or (q[j] >= upper[j] and step[j] > 0.0)
                ):
                    fixed[j] = limit_hit = True
            if limit_hit:
                damped_step(J, error, damping * cost, rows, length, fixed, A, y, step)
            for j in range(dof):
                trial[j] = q[j]
                if j < length:
                    trial[j] += step[j]
                    if kinds[j] != CONTINUOUS:
                        trial[j] = min(max(trial[j], lower[j]), upper[j])
            forward(trial, offsets, tool, kinds, length, T, axes, origins)
            trial_cost = pose_error(T, target, rows, rotation_weight, trial_error)
            if trial_cost < cost:
                q[:] = trial
                error[:] = trial_error
                cost = trial_cost
                damping = max(damping * DAMPING_DECREASE, MIN_DAMPING)
                jacobian_outdated = True
            else:
                damping *= DAMPING_INCREASE
        if not solved:
            continue
        for j in range(dof):
            if kinds[j] == CONTINUOUS:
                q[j] = min(max((q[j] + np.pi) % TURN - np.pi, lower[j]), upper[j])
        if _is_new(q, solutions, count, kinds, min_distance):
            solutions[count] = q
            count += 1
            if count == len(solutions):
                break
    return solutions[len(known) : count], seeds_used


@kernel()
def follow(start, goal, steer, longest, targets, chain, parameters):
    """A path of configurations through the targets [n, 4, 4]: the start [dof], then one configuration per
    target.

    Each joint moves by at most `longest` [rad] or [m] from row to row. The path ends before the first target
    for which no such configuration is found. The seed for a target is the previous configuration; with
    `steer` it is moved towards the goal [dof], evenly over the remaining targets.
    """
    dof = len(start)
    rows = np.empty((len(targets) + 1, dof))
    none = np.empty((0, dof))
    seed = np.empty((1, dof))
    rows[0] = start
    for k in range(len(targets)):
        seed[0] = rows[k]
        if steer:
            seed[0] += (goal - rows[k]) / (len(targets) - k)
        solutions = solve_seeds(seed, none, 1, chain, targets[k], parameters)[0]
        if len(solutions) == 0:
            return rows[: k + 1].copy()
        for j in range(dof):
            step = solutions[0, j] - rows[k, j]
            if chain.kinds[j] == CONTINUOUS:
                step -= TURN * np.round(step / TURN)
            if abs(step) > longest:
                return rows[: k + 1].copy()
            rows[k + 1, j] = rows[k, j] + step
    return rows
