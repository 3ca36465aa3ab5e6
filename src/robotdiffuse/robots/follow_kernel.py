"""Compiled inverse kinematics from pose to pose along a line: each solution is the seed of the next."""

import numpy as np

from robotdiffuse.core.kernels import kernel
from robotdiffuse.robots.ik_kernel import CONTINUOUS, TURN, solve_seeds


@kernel()
def follow(start, goal, steer, longest, targets, chain, parameters):
    """Configurations from the start [dof] on, one for each target [n, 4, 4], as long as there is one whose
    joints are each within `longest` [rad] or [m] of the one before.

    steer: whether seeds approach the goal [dof] evenly, rather than being the configuration before.
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
        found = solve_seeds(seed, none, 1, chain, targets[k], parameters)[0]
        if len(found) == 0:
            return rows[: k + 1].copy()
        for j in range(dof):
            step = found[0, j] - rows[k, j]
            if chain.kinds[j] == CONTINUOUS:
                step -= TURN * np.round(step / TURN)
            if abs(step) > longest:
                return rows[: k + 1].copy()
            rows[k + 1, j] = rows[k, j] + step
    return rows
