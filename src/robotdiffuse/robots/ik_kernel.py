"""Compiled part of inverse kinematics: damped Newton iterations from many seeds.

There are no jaxtyping annotations because Numba compiles these functions. Arrays are float64 and
C-contiguous. Continuous joints are unbounded during the iterations, and wrapped to [-pi, pi] in solutions.
"""

from typing import NamedTuple

import numpy as np
from numpy import ndarray

from robotdiffuse.core.kernels import inner_kernel, kernel
from robotdiffuse.robots.frame_kernel import dot, length, step

# values of `IKChain.kinds`
REVOLUTE = 0
PRISMATIC = 1
CONTINUOUS = 2
TURN = 2 * np.pi

# Levenberg-Marquardt damping as a factor on the squared error; a seed is given up above MAX_DAMPING
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
def forward(q, offsets, tool, kinds, joints, T, axes, origins):
    """Write the axes and origins of the first `joints` joints, and the pose of the tool into T [3, 4].

    q [dof] is the configuration, offsets [dof, 4, 4], tool [4, 4] and kinds [dof] are as in `IKChain`; axes
    and origins are [dof, 3], in the base frame.
    """
    T[:] = 0.0
    for i in range(3):
        T[i, i] = 1.0
    for j in range(joints):
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
        x = 0.5 * (dot(target[2], T[1]) - dot(target[1], T[2]))
        y = 0.5 * (dot(target[0], T[2]) - dot(target[2], T[0]))
        z = 0.5 * (dot(target[1], T[0]) - dot(target[0], T[1]))
        r00 = dot(target[0], T[0])
        r11 = dot(target[1], T[1])
        r22 = dot(target[2], T[2])
        sine = length((x, y, z))
        cosine = 0.5 * (r00 + r11 + r22 - 1.0)
        scale = 1.0
        if sine > 1e-12:
            scale = np.arctan2(sine, cosine) / sine
        elif cosine < 0.0:  # half a turn: an approximate axis suffices as a descent direction
            x = np.sqrt(max(r00 + 1, 0.0))
            y = np.sqrt(max(r11 + 1, 0.0))
            z = np.sqrt(max(r22 + 1, 0.0))
            scale = np.pi / length((x, y, z))
        scale *= rotation_weight
        error[3] = x * scale
        error[4] = y * scale
        error[5] = z * scale
    total = 0.0
    for i in range(rows):
        total += error[i] * error[i]
    return total


@inner_kernel()
def _jacobian(T, axes, origins, kinds, joints, rotation_weight, J):
    """Write the geometric Jacobian of the tool into J [6, dof], with the rotation rows times
    `rotation_weight`."""
    for j in range(joints):
        for i in range(3):
            if kinds[j] == PRISMATIC:
                J[i, j] = axes[j, i]
                J[i + 3, j] = 0.0
            else:
                k = (i + 1) % 3
                m = (i + 2) % 3
                J[i, j] = axes[j, k] * (T[m, 3] - origins[j, m]) - axes[j, m] * (T[k, 3] - origins[j, k])
                J[i + 3, j] = rotation_weight * axes[j, i]


@inner_kernel()
def damped_step(J, error, damping, rows, joints, held, A, y, step):
    """Write step = J^T (J J^T + damping I)^-1 error; the columns of J and entries of step for held joints
    count as zero."""
    # A = J J^T + damping I, its Cholesky factor, and the two triangular solves
    for i in range(rows):
        for k in range(i + 1):
            total = damping if i == k else 0.0
            for j in range(joints):
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
    for j in range(joints):
        total = 0.0
        if not held[j]:
            for i in range(rows):
                total += J[i, j] * y[i]
        step[j] = total


@inner_kernel()
def limited_step(J, error, damping, rows, joints, q, lower, upper, endless, held, A, y, step):
    """Write the `damped_step` at q, in which joints that would be pushed through a limit are held.

    `endless` [dof] marks joints without limits; `held` [dof] is scratch memory.
    """
    held[:] = False
    damped_step(J, error, damping, rows, joints, held, A, y, step)
    limit_hit = False
    for j in range(joints):
        at_low = q[j] <= lower[j]
        at_high = q[j] >= upper[j]
        if not endless[j] and ((at_low and step[j] < 0.0) or (at_high and step[j] > 0.0)):
            held[j] = limit_hit = True
    if limit_hit:
        damped_step(J, error, damping, rows, joints, held, A, y, step)


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
    offsets, tool, kinds, joints, lower, upper = chain
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
    held = np.zeros(dof, np.bool_)
    endless = kinds == CONTINUOUS
    trial = np.empty(dof)
    solutions = np.empty((len(known) + wanted, dof))
    solutions[: len(known)] = known
    count = len(known)
    seeds_used = 0
    for s in range(len(seeds)):
        seeds_used = s + 1
        q = seeds[s].copy()
        forward(q, offsets, tool, kinds, joints, T, axes, origins)
        cost = pose_error(T, target, rows, rotation_weight, error)
        damping = INITIAL_DAMPING
        checked_cost = cost
        solved = False
        jacobian_outdated = True
        for iteration in range(max_iterations):
            rotation = length(error[3:]) / rotation_weight
            # `length` takes the first three numbers, the error of the position
            solved = length(error) <= position_tolerance and (position_only or rotation <= rotation_tolerance)
            if solved or damping > MAX_DAMPING:
                break
            if iteration % CHECK_EVERY == CHECK_EVERY - 1:
                if cost > REQUIRED_PROGRESS * REQUIRED_PROGRESS * checked_cost:
                    break
                checked_cost = cost
            if jacobian_outdated:
                _jacobian(T, axes, origins, kinds, joints, rotation_weight, J)
                jacobian_outdated = False
            limited_step(J, error, damping * cost, rows, joints, q, lower, upper, endless, held, A, y, step)
            for j in range(dof):
                trial[j] = q[j]
                if j < joints:
                    trial[j] += step[j]
                    if kinds[j] != CONTINUOUS:
                        trial[j] = min(max(trial[j], lower[j]), upper[j])
            forward(trial, offsets, tool, kinds, joints, T, axes, origins)
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
def follow(start, goal, steer, max_step, targets, chain, parameters):
    """A path of configurations through the targets [n, 4, 4]: the start [dof], then one configuration per
    target.

    Each joint moves by at most `max_step` [rad] or [m] from row to row. The path ends before the first target
    for which no such configuration is found. The seed for a target is the previous configuration; with
    `steer`, the seed is moved towards the goal [dof], evenly over the remaining targets.
    """
    dof = len(start)
    path = np.empty((len(targets) + 1, dof))
    none = np.empty((0, dof))
    one = np.int64(1)  # for a literal, Numba would compile `solve_seeds` again
    seed = np.empty((1, dof))
    path[0] = start
    for k in range(len(targets)):
        seed[0] = path[k]
        if steer:
            seed[0] += (goal - path[k]) / (len(targets) - k)
        solutions = solve_seeds(seed, none, one, chain, targets[k], parameters)[0]
        if len(solutions) == 0:
            return path[: k + 1].copy()
        for j in range(dof):
            step = solutions[0, j] - path[k, j]
            if chain.kinds[j] == CONTINUOUS:
                step -= TURN * np.round(step / TURN)
            if abs(step) > max_step:
                return path[: k + 1].copy()
            path[k + 1, j] = path[k, j] + step
    return path
