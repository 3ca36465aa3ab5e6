"""Compiled descent of whole trajectories down their costs; `guidance` has the costs' formulas and sources."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numba import njit
from numpy import ndarray

from robotdiffuse.collision.kernels.collision_cost import cost_gradient_at, make_cost_workspace
from robotdiffuse.collision.kernels.compiled import allocation_free
from robotdiffuse.collision.kernels.distance import CLEARANCE_CAP
from robotdiffuse.collision.kernels.lane_clearance import make_clearance_workspace, pair_clearances_into

_ZERO = np.float32(0.0)
_ONE = np.float32(1.0)
OFF = -CLEARANCE_CAP
"""A margin that nothing is ever within: the cost does not act."""


class Steps(NamedTuple):
    """What one round of steps does: `GuidanceSettings` as compiled code takes them."""

    margin: np.float32
    """[m] here and below, or OFF."""
    self_margin: np.float32
    limit_margin: np.float32
    """[rad], or OFF."""
    push: np.float32
    kernel: Float[ndarray, "waypoints waypoints"]
    """Weights by which pushes spread over neighbouring waypoints."""
    smoothness: np.float32
    length: np.float32


@njit(cache=True, nogil=True)
def descend(robot, scene, q, lower, upper, steps, prefix, suffix, count):
    """Moves trajectories q[batch, waypoints, dof] by `count` rounds, in place; the first `prefix` and the
    last `suffix` waypoints, at least one each, stay. Returns the margins' costs [batch] that the last round
    met.

    Each waypoint within a margin is pushed out of it, the pushes are spread over its neighbours, then the
    steps of smoothness and length follow. A trajectory of which no waypoint is within a margin is left as it
    is, unless no margin is on.
    """
    batch, n, dof = q.shape
    first, last = prefix, n - suffix
    scratch = make_cost_workspace(dof)
    pushes, active = np.empty((n, dof), np.float32), np.empty(n, np.float32)
    gradient = np.empty(dof, np.float32)
    costs = np.zeros(batch, np.float32)
    work = make_clearance_workspace(robot, 1)
    pairs = np.full((n, len(robot.pairs)), CLEARANCE_CAP)
    pushed = max(steps.margin, steps.self_margin, steps.limit_margin) > OFF
    for b in range(batch):
        for _ in range(count):
            total = _ZERO
            if steps.self_margin > OFF:
                pair_clearances_into(robot, q[b], steps.self_margin, work, pairs)
            for i in range(first, last):
                gradient[:] = _ZERO
                cost = cost_gradient_at(
                    robot, scene, q[b, i], pairs[i], steps.margin, steps.self_margin, scratch, gradient
                )
                total += cost
                active[i] = _push_away(cost, gradient, steps.push, pushes[i])
                if steps.limit_margin > OFF:
                    cost = _push_inside(q[b, i], lower, upper, steps.limit_margin, steps.push, pushes[i])
                    total += cost
                    if cost > _ZERO:
                        active[i] = _ONE
            costs[b] = total
            if pushed and total <= _ZERO:
                break
            _spread(q[b], first, last, pushes, active, steps.kernel, lower, upper)
            if steps.smoothness > _ZERO:
                _smooth(q[b], first, last, steps.smoothness, lower, upper)
            _shorten(q[b], first, last, steps.length)
    return costs


@njit(cache=True)
def _push_away(cost, gradient, push, pushed):
    """The Gauss-Newton step -g 2c / (g.g) of the collision costs, at most `push` [rad], into pushed[dof].

    For one contact it is just what clears it, whatever the scale. Returns 1 if there is one, else 0.
    """
    pushed[:] = _ZERO
    square = _ZERO
    for j in range(len(gradient)):
        square += gradient[j] * gradient[j]
    if cost <= _ZERO or square <= np.float32(1e-12):
        return _ZERO
    scale = np.float32(2.0) * cost / square
    scale = min(scale, push / np.sqrt(square))
    for j in range(len(gradient)):
        pushed[j] = -scale * gradient[j]
    return _ONE


@njit(cache=True)
def _push_inside(q, lower, upper, margin, push, pushed):
    """Adds to pushed[dof] the Newton step of the limits' cost, each at most `push` [rad]. Returns the cost.

    Where a joint's range is narrower than two margins, its middle is far enough from both limits.
    """
    cost = _ZERO
    for j in range(len(q)):
        near = min(margin, np.float32(0.5) * (upper[j] - lower[j]))
        step = max(lower[j] + near - q[j], _ZERO) - max(q[j] - upper[j] + near, _ZERO)
        cost += np.float32(0.5) * step * step
        pushed[j] += min(max(step, -push), push)
    return cost


@allocation_free(fastmath=True)
def _spread(q, first, last, pushes, active, kernel, lower, upper):
    """Each waypoint takes a weighted mean of the pushes of its neighbours, falling off where none is
    pushed."""
    dof = q.shape[1]
    for i in range(first, last):
        weight = _ZERO
        for k in range(first, last):
            weight += kernel[i, k] * active[k]
        if weight <= np.float32(1e-4):
            continue
        weight = _ONE / max(weight, _ONE)
        for k in range(first, last):
            if active[k] > _ZERO and kernel[i, k] > np.float32(1e-3):
                share = weight * kernel[i, k]
                for j in range(dof):
                    q[i, j] += share * pushes[k, j]
        for j in range(dof):
            q[i, j] = min(max(q[i, j], lower[j]), upper[j])


@allocation_free(fastmath=True)
def _smooth(q, first, last, share, lower, upper):
    """Each waypoint by a share of the way to where the accelerations that it is part of are smallest:
    Newton's step in that waypoint alone. Every third waypoint at a time, for these do not meet."""
    n, dof = q.shape
    for offset in range(3):
        for i in range(first + offset, last, 3):
            for j in range(dof):
                gradient = np.float32(-2.0) * (q[i - 1, j] - np.float32(2.0) * q[i, j] + q[i + 1, j])
                curvature = np.float32(4.0)
                if i >= 2:
                    gradient += q[i - 2, j] - np.float32(2.0) * q[i - 1, j] + q[i, j]
                    curvature += _ONE
                if i + 2 < n:
                    gradient += q[i, j] - np.float32(2.0) * q[i + 1, j] + q[i + 2, j]
                    curvature += _ONE
                # the middle of two neighbours is within the limits, but this may not be
                q[i, j] = min(max(q[i, j] - share * gradient / curvature, lower[j]), upper[j])


@allocation_free(fastmath=True)
def _shorten(q, first, last, share):
    """Each waypoint by a share of the way to the middle of its neighbours, where the two steps that it is
    part of are shortest: Newton's step in that waypoint alone. Every second waypoint at a time."""
    dof = q.shape[1]
    for parity in range(2):
        for i in range(first + parity, last, 2):
            for j in range(dof):
                q[i, j] += share * (np.float32(0.5) * (q[i - 1, j] + q[i + 1, j]) - q[i, j])
