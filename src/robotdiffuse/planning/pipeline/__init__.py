"""What surrounds any planner: moving obstacles, waypoints, a start velocity, unknown space."""

from collections.abc import Callable
from importlib import import_module

from robotdiffuse.core.results import PlanResult
from robotdiffuse.planning.attempt import Solver, attempt
from robotdiffuse.planning.context import PlanRequest
from robotdiffuse.problems.problem import Problem

PlanFunction = Callable[[Solver, Problem, PlanRequest], PlanResult]

STAGES: tuple[tuple[Callable[[Problem], bool], str], ...] = (
    (lambda problem: bool(problem.moving), "moving_obstacles:plan_among_moving_obstacles"),
    (lambda problem: bool(problem.waypoints), "waypoints:plan_through_waypoints"),
    (lambda problem: problem.start_velocity is not None, "start_velocity:plan_from_start_velocity"),
    (lambda problem: bool(problem.views), "unknown_space:plan_with_unknown_space"),
)
"""Which problems a function of this package handles, and module:function, imported when it is needed; the
first that applies is used."""


def pipeline_for(problem: Problem) -> PlanFunction:
    """The function that plans for a problem: the first of STAGES that applies, or `attempt` alone."""
    for applies, location in STAGES:
        if applies(problem):
            module, _, function = location.partition(":")
            return getattr(import_module(f"{__name__}.{module}"), function)
    return attempt
