"""The batches of the hybrid planner for a problem before any search or choice, for drawing."""

from dataclasses import dataclass
from functools import cache

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.core.errors import InputError
from robotdiffuse.core.results import PlanResult
from robotdiffuse.planning.context import PlanningContext, PlanRequest
from robotdiffuse.planning.diffusion.hybrid import WAYPOINTS, RobotDiffuse
from robotdiffuse.planning.diffusion.smooth_noise import smooth_noise
from robotdiffuse.planning.learned import nearest_goals
from robotdiffuse.planning.start_goal import usable_start_goal
from robotdiffuse.problems.problem import Problem

TIME_LIMIT = 1.0
"""For finding configurations of the goal [s]."""
PLACES_PER_SEGMENT = 4
"""Places at which clearances are measured, from one waypoint to the next."""


@dataclass(frozen=True, eq=False)
class Candidates:
    """A batch of trajectories and their clearances."""

    source: str
    """"network", or "smooth_noise" for an arm without weights."""
    positions: Float[ndarray, "count waypoints dof"]
    clearances: Float[ndarray, "count"]
    """Smallest signed distance of the covering spheres to the obstacles along each trajectory, sampled [m],
    at most 1 m; negative where spheres touch, though the meshes within may not."""


def draw_candidates(problem: Problem, seed: int = 0) -> Candidates:
    """Draw a batch as the planner `robotdiffuse` does.

    Raises InputError if the start or the goal cannot be used.
    """
    planner = _planner()
    model = planner.model(problem.robot)
    context = PlanningContext(planner.name, problem, PlanRequest(TIME_LIMIT, seed))
    start_goal = usable_start_goal(context)
    if isinstance(start_goal, PlanResult):
        raise InputError(f"nothing can be drawn: {start_goal.reason}")
    start, goals = start_goal.rows()
    if model is None:
        goals = nearest_goals(start, goals, planner.settings.samples)
        q = smooth_noise(start, goals, planner.settings.samples, WAYPOINTS, problem.robot, context.rng)
        q = planner.refine(start_goal.checker, q)
    else:
        code = planner.code(model, start_goal.checker, context.rng)
        q = planner.draw(model, start_goal.checker, code, start, goals, context.rng)
    count, waypoints, dof = q.shape
    at = np.linspace(0, waypoints - 1, PLACES_PER_SEGMENT * (waypoints - 1) + 1)
    low = np.minimum(at.astype(int), waypoints - 2)
    share = (at - low)[:, None]
    dense = (1 - share) * q[:, low] + share * q[:, low + 1]
    distances = start_goal.checker.link_clearances(dense.reshape(-1, dof)).reshape(count, -1)
    source = "smooth_noise" if model is None else "network"
    return Candidates(
        source, np.asarray(q, np.float64), distances.min(axis=1, initial=1.0).astype(np.float64)
    )


@cache
def _planner() -> RobotDiffuse:
    return RobotDiffuse()
