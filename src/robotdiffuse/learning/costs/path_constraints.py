"""The sum of h^2 / 2 over the rows of a problem's path constraints, with the hinge h of what is beyond their
limits [m]; a radian counts as ANGLE_WEIGHT metres.

It comes with the problem and not by a setting, so it is made for each: see `CollisionGuidance`.
"""

import numpy as np
from jaxtyping import Float
from numba import njit
from numpy import ndarray

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.learning.costs.cost import Cost
from robotdiffuse.problems import constraint_kernel as kernel
from robotdiffuse.problems.compiled_constraints import PathConstraints
from robotdiffuse.problems.constraint_kernel import ANGLE_WEIGHT, DISTANCE


def path_constraints(constraints: PathConstraints, share: float) -> Cost:
    """The cost of being beyond a share of the tolerances; its strength is the longest step of a waypoint
    [rad]."""
    rows, kept = constraints.rows, constraints.limits(share)
    unit = np.where(rows.row_kind == DISTANCE, 1.0, ANGLE_WEIGHT)

    def value(
        _checker: CollisionChecker, q: Float[ndarray, "count waypoints dof"], _push: float
    ) -> Float[ndarray, "count"]:
        beyond = unit * np.maximum(constraints.values(q.reshape(-1, q.shape[2])) - kept, 0.0)
        return 0.5 * (beyond**2).sum(axis=1).reshape(q.shape[:2]).sum(axis=1)

    def step(
        _checker: CollisionChecker, q: Float[ndarray, "count waypoints dof"], push: float
    ) -> Float[ndarray, "count waypoints dof"]:
        moved = q.astype(np.float64)
        _steps(rows, kept, moved.reshape(-1, q.shape[2]), push)
        return moved.astype(q.dtype)

    return Cost(value, step)


@njit(cache=True, nogil=True)
def _steps(rows, limits, q, push):
    """Each of the configurations [n, dof] by a Gauss-Newton step down the cost, in place."""
    work = kernel.make_work(rows)
    for i in range(len(q)):
        kernel.step(rows, limits, q[i], push, work)
