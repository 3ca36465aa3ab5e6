"""Compiled steps of whole trajectories down their costs; `guidance` states the formulas and their sources."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.collision.kernels.collision_cost import CLEARANCE_CAP, cost_gradient_at, make_cost_workspace
from robotdiffuse.collision.kernels.lane_clearance import make_clearance_workspace, pair_clearances_into
from robotdiffuse.core.kernels import allocation_free, inner_kernel, kernel

_ZERO = np.float32(0.0)
_ONE = np.float32(1.0)
OFF = -CLEARANCE_CAP
"""The margin of a cost that is not enabled: nothing is ever within it."""


class Steps(NamedTuple):
    """Parameters of one round of steps: `GuidanceSettings` in the types that compiled code takes."""

    margin: np.float32
    """[m] here and below, or OFF."""
    self_margin: np.float32
    push: np.float32
    """[rad]"""
    kernel: Float[ndarray, "waypoints waypoints"]
    """Weights by which pushes spread over neighbouring waypoints."""
    length: np.float32


@kernel(nogil=True)
def descend(robot, scene, q, lower, upper, steps, rounds):
    """Moves trajectories q [batch, waypoints, dof] by some rounds, in place; the first and the last waypoint
    stay. Returns the costs of the margins [batch] that the last round found.

    Each waypoint within a margin is pushed out of it, the pushes are spread over its neighbours, then the
    step of length follows. A trajectory without a waypoint within a margin is left as it is,
    unless no margin is enabled.
    """
    batch, n, dof = q.shape
    first = 1
    last = n - 1
    scratch = make_cost_workspace(dof)
    pushes = np.empty((n, dof), np.float32)
    active = np.empty(n, np.float32)
    gradient = np.empty(dof, np.float32)
    costs = np.zeros(batch, np.float32)
    work = make_clearance_workspace(robot, 1)
    pairs = np.full((n, len(robot.pairs)), CLEARANCE_CAP)
    pushed = max(steps.margin, steps.self_margin) > OFF
    for b in range(batch):
        for _ in range(rounds):
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
            costs[b] = total
            if pushed and total <= _ZERO:
                break
            _spread(q[b], first, last, pushes, active, steps.kernel, lower, upper)
            _shorten(q[b], first, last, steps.length)
    return costs


@inner_kernel()
def _push_away(cost, gradient, push, pushed):
    """The Gauss-Newton step -g 2c / (g.g) of the collision costs, at most `push` [rad], into pushed[dof].

    For a single contact this step just clears it, whatever the scale of the cost. Returns 1 if there is a
    contact, else 0.
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


@allocation_free(fastmath=True)
def _spread(q, first, last, pushes, active, kernel, lower, upper):
    """Moves each waypoint by a weighted mean of its neighbours' pushes, less where no neighbour is pushed."""
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
def _shorten(q, first, last, share):
    """Moves each waypoint by a share of the way to the middle of its neighbours, which is Newton's step in
    that waypoint alone. Every second waypoint at a time: these share no segment."""
    dof = q.shape[1]
    for parity in range(2):
        for i in range(first + parity, last, 2):
            for j in range(dof):
                q[i, j] += share * (np.float32(0.5) * (q[i - 1, j] + q[i + 1, j]) - q[i, j])
