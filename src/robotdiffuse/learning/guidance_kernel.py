"""Compiled gradient steps that move whole trajectories out of collision."""

import numpy as np
from numba import njit

from robotdiffuse.collision.compiled import allocation_free
from robotdiffuse.collision.distance import cost_gradient_at
from robotdiffuse.collision.lane_clearance import (
    clearances_into,
    count_obstacles,
    make_clearance_workspace,
    pair_clearances_into,
)

_ZERO = np.float32(0.0)
_ONE = np.float32(1.0)


@njit(cache=True, nogil=True)
def descend(robot, scene, q, lower, upper, kernel, margin, self_margin, push, relax, steps):
    """Moves trajectories q[count, frames, dof] down their collision cost, in place; the ends stay.

    Each frame in cost is pushed by a Gauss-Newton step -g 2c / (g.g), at most `push` [rad]: for one contact
    just what clears it, whatever the scale. `kernel` [frames, frames] spreads the pushes over neighbouring
    frames, as the metric of CHOMP does (M. Zucker et al., IJRR 2013): a weighted mean, falling off where no
    frame is pushed. Then every inner frame moves by the share `relax` towards the middle of its neighbours.
    A trajectory without cost is left as it is. Returns the costs [count] met in the last step.
    """
    count, n, dof = q.shape
    frames = np.empty((dof + 1, 12), np.float32)
    pushes, active = np.empty((n, dof), np.float32), np.empty(n, np.float32)
    gradient = np.empty(dof, np.float32)
    costs = np.zeros(count, np.float32)
    work = make_clearance_workspace(robot, count_obstacles(scene))
    links = np.empty((n, len(robot.frame) - np.searchsorted(robot.frame, 1)), np.float32)
    pairs = np.empty((n, len(robot.pairs)), np.float32)
    for b in range(count):
        for _ in range(steps):
            total = _ZERO
            clearances_into(robot, scene, q[b], margin, work, links)
            pair_clearances_into(robot, q[b], self_margin, work, pairs)
            for i in range(1, n - 1):
                gradient[:] = _ZERO
                cost = cost_gradient_at(
                    robot, scene, q[b, i], links[i], pairs[i], margin, self_margin, frames, gradient
                )
                total += cost
                active[i] = _ZERO
                square = _ZERO
                for j in range(dof):
                    square += gradient[j] * gradient[j]
                if cost <= _ZERO or square <= np.float32(1e-12):
                    continue
                active[i] = _ONE
                scale = np.float32(2.0) * cost / square
                scale = min(scale, push / np.sqrt(square))
                for j in range(dof):
                    pushes[i, j] = -scale * gradient[j]
            costs[b] = total
            if total <= _ZERO:
                break
            _spread(q[b], pushes, active, kernel, lower, upper)
            _relax(q[b], relax)
    return costs


@allocation_free(fastmath=True)
def _spread(q, pushes, active, kernel, lower, upper):
    n, dof = q.shape
    for i in range(1, n - 1):
        weight = _ZERO
        for k in range(1, n - 1):
            weight += kernel[i, k] * active[k]
        if weight <= np.float32(1e-4):
            continue
        weight = _ONE / max(weight, _ONE)
        for k in range(1, n - 1):
            if active[k] > _ZERO and kernel[i, k] > np.float32(1e-3):
                share = weight * kernel[i, k]
                for j in range(dof):
                    q[i, j] += share * pushes[k, j]
        for j in range(dof):
            q[i, j] = min(max(q[i, j], lower[j]), upper[j])


@allocation_free(fastmath=True)
def _relax(q, share):
    n, dof = q.shape
    for parity in range(2):
        for i in range(1 + parity, n - 1, 2):
            for j in range(dof):
                q[i, j] += share * (np.float32(0.5) * (q[i - 1, j] + q[i + 1, j]) - q[i, j])
