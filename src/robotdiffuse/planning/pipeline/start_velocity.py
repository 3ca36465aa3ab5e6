"""Motions from a problem's start velocity: the arm is moving when the motion begins, without acceleration.

The arm first goes straight on, as far as it needs to stop. The planner plans from there. The path is then
timed from the start velocity on, and its corner at the stopping place is rounded where that is free, so that
the arm need not stop there.
"""

from dataclasses import replace

import numpy as np

from robotdiffuse.core.errors import InputError
from robotdiffuse.core.results import PlanResult
from robotdiffuse.core.types import Status
from robotdiffuse.planning.attempt import Solver, attempt
from robotdiffuse.planning.context import PlanningContext, PlanRequest
from robotdiffuse.problems.problem import Problem
from robotdiffuse.trajectories.speed_limits import stopping_distance


def plan_from_start_velocity(solver: Solver, problem: Problem, request: PlanRequest) -> PlanResult:
    """A motion from the problem's start velocity to rest at its goal.

    Raises InputError for a velocity beyond the scaled velocity limits of the request.
    """
    context, robot = PlanningContext(solver.name, problem, request), problem.robot
    velocity = problem.start_velocity
    assert velocity is not None
    beyond = np.flatnonzero(np.abs(velocity) > request.velocity_scaling * robot.velocity)
    if len(beyond):
        j = int(beyond[0])
        raise InputError(
            f"start_velocity: {robot.joint_names[j]} is {velocity[j]:g}; velocity_scaling leaves it "
            f"{request.velocity_scaling * robot.velocity[j]:g}"
        )
    direction = velocity / np.linalg.norm(velocity)
    stop = problem.start + stopping_distance(robot, context.timing, velocity) * direction
    beyond = np.flatnonzero(((stop < robot.lower) | (stop > robot.upper)) & ~np.array(robot.continuous))
    if len(beyond):
        name = robot.joint_names[int(beyond[0])]
        return context.fail(Status.INVALID_START, f"{name} cannot stop from start_velocity within its limits")
    result = attempt(solver, replace(problem, start=stop, start_velocity=None), request)
    if result.path is None:
        return replace(result, reason=f"from where the arm can stop: {result.reason}")
    waypoints = np.concatenate([problem.start[None], result.path.positions])
    notes = tuple(note for note in result.notes if note not in context.notes)
    deviations = np.full(len(waypoints), context.timing.corner_deviation)
    if result.corner_deviations is not None:
        deviations[2:] = result.corner_deviations[1:]
    found = context.finish(waypoints, result.stage or solver.name, notes=notes, deviations=deviations)
    if found is not None:
        return found
    if context.ended:
        return context.unsolved()
    violation = context.validator.path(replace(result.path, positions=waypoints)).violation
    what = "" if violation is None else f": {violation.message}"
    return context.fail(
        Status.INVALID_START, f"the arm cannot stop from start_velocity without a collision{what}"
    )
