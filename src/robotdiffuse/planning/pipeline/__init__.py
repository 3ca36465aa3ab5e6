"""Planning with moving obstacles, waypoints, a start velocity and unknown space, for any planner.

The modules handle one of these features each. A module calls the planner, once or several times, for problems
without the feature.
"""

from dataclasses import replace
from typing import ClassVar, Protocol, runtime_checkable

from robotdiffuse.core.deadline import OutOfTimeError
from robotdiffuse.core.loading import loading
from robotdiffuse.core.results import PlanResult
from robotdiffuse.planning.context import PlanningContext, PlanRequest
from robotdiffuse.planning.start_goal import StartGoal, usable_start_goal
from robotdiffuse.problems.constraints import CartesianLine
from robotdiffuse.problems.problem import Problem


@runtime_checkable
class Solver(Protocol):
    """What the pipeline needs of a planner."""

    name: ClassVar[str]
    follows_lines: ClassVar[bool]

    def solve(self, context: PlanningContext, start_goal: StartGoal) -> PlanResult:
        """Search from the start to a goal; see `planning.planner.Planner.solve`."""
        ...


def attempt(solver: Solver, problem: Problem, request: PlanRequest) -> PlanResult:
    """Plan from the problem's start to its goal by one call of the planner. The problem's waypoints, moving
    obstacles, start velocity and unknown space are ignored: other modules of the pipeline handle them."""
    context = PlanningContext(solver.name, problem, request)
    followed = None
    lines = any(isinstance(constraint, CartesianLine) for constraint in problem.constraints)
    with context.deadline():
        try:
            if solver.follows_lines and lines:
                with loading():
                    from robotdiffuse.planning.line_following import follow_line  # compiled code

                followed = follow_line(context)
            result = followed if followed is not None and followed.solved else _searched(solver, context)
        except OutOfTimeError as error:
            result = context.out_of_time(error)
    if lines and result.solved:
        return replace(result, fraction=1.0)
    if followed is None:
        return result
    return replace(result, fraction=followed.fraction, reason=f"{result.reason}; {followed.reason}")


def _searched(solver: Solver, context: PlanningContext) -> PlanResult:
    start_goal = usable_start_goal(context)
    if isinstance(start_goal, PlanResult):
        return start_goal
    context.begin_search()
    return solver.solve(context, start_goal)
