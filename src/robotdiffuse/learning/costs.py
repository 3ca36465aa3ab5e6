"""Cost functions of guidance besides the compiled ones of `guidance_kernel`, each as a step down the cost.

Programs add costs of their own to COSTS, by name; `GuidanceSettings.extra_costs` gives these their strength.
The cost of a problem's path constraints depends on the problem, so `path_constraint_cost` makes one for each.
"""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.core.kernels import kernel
from robotdiffuse.core.registry import Registry
from robotdiffuse.problems.compiled_constraints import PathConstraints
from robotdiffuse.problems.constraint_kernel import make_work
from robotdiffuse.problems.projection_kernel import step

CostStep = Callable[
    [CollisionChecker, Float[ndarray, "count waypoints dof"], float], Float[ndarray, "count waypoints dof"]
]
"""From trajectories [rad] and the strength of the cost to the trajectories after one step down the cost.
Guidance puts back the ends and what leaves the limits."""

COSTS = Registry("guidance cost", {}, group="robotdiffuse.costs")
"""Functions of the type CostStep by name."""


def path_constraint_cost(constraints: PathConstraints, share: float) -> CostStep:
    """The cost of a problem's path constraints: the sum of h^2 / 2 over their rows.

    h is how far a row's value exceeds `share` of its tolerance [m]; a radian counts as
    `projection_kernel.ANGLE_WEIGHT` metres. The strength is the longest step of a waypoint [rad].
    """
    rows, limits = constraints.rows, constraints.limits(share)

    def step(
        _checker: CollisionChecker, q: Float[ndarray, "count waypoints dof"], max_step: float
    ) -> Float[ndarray, "count waypoints dof"]:
        moved = q.astype(np.float64)
        _steps(rows, limits, moved.reshape(-1, q.shape[2]), max_step)
        return moved.astype(q.dtype)

    return step


@kernel(nogil=True)
def _steps(rows, limits, q, max_step):
    """Moves each configuration of q [n, dof] by a Gauss-Newton step down the cost, in place."""
    work = make_work(rows)
    for i in range(len(q)):
        step(rows, limits, q[i], max_step, work)
