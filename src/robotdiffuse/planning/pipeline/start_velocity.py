"""Motions that begin moving: the problem's start velocity.

The arm first goes straight on, as far as it takes to stop. From there any planner plans; then the path is
timed from the start velocity on, and its corner at that place is rounded where that is free, so that the arm
need not stop there.
"""

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from robotdiffuse.core.errors import InputError
from robotdiffuse.core.results import PlanResult
from robotdiffuse.core.types import Status
from robotdiffuse.planning.context import PlanningContext, Request
from robotdiffuse.problems.problem import Problem

if TYPE_CHECKING:
    from robotdiffuse.planning.planner import Planner

SHARE = 0.9
"""Of the accelerations that the limits allow, for stopping: what is left lets corners be rounded."""


def plan_in_motion(
    planner: "Planner", problem: Problem, time_limit: float, seed: int, request: Request
) -> PlanResult:
    """A motion from the problem's start velocity to rest at its goal.

    Raises InputError for a velocity beyond the shares of the limits that the request asks for, and for a
    limit of jerk.
    """
    context, robot, velocity = (
        PlanningContext(planner.name, problem, time_limit, seed, request),
        problem.robot,
        problem.start_velocity,
    )
    assert velocity is not None
    if request.jerk is not None:
        raise InputError("jerk cannot be limited beside start_velocity: the motion before it is not known")
    beyond = np.flatnonzero(np.abs(velocity) > request.velocity_scaling * robot.velocity)
    if len(beyond):
        j = int(beyond[0])
        raise InputError(
            f"start_velocity: {robot.joint_names[j]} is {velocity[j]:g}; velocity_scaling leaves it "
            f"{request.velocity_scaling * robot.velocity[j]:g}"
        )
    speed = float(np.linalg.norm(velocity))
    ahead, moving = velocity / speed, velocity != 0
    most = (
        SHARE
        * request.acceleration_scaling
        * float((robot.acceleration[moving] / np.abs(ahead[moving])).min())
    )
    rest = problem.start + speed**2 / (2 * most) * ahead
    beyond = np.flatnonzero(((rest < robot.lower) | (rest > robot.upper)) & ~np.array(robot.continuous))
    if len(beyond):
        name = robot.joint_names[int(beyond[0])]
        return context.fail(Status.INVALID_START, f"{name} cannot stop from start_velocity within its limits")
    result = planner.attempt(replace(problem, start=rest, start_velocity=None), time_limit, seed, request)
    if result.path is None:
        return replace(result, reason=f"from where the arm can stop: {result.reason}")
    waypoints = np.concatenate([problem.start[None], result.path.positions])
    notes = tuple(note for note in result.notes if note not in problem.notes)
    found = context.finish(waypoints, result.stage or planner.name, notes=notes)
    if found is not None:
        return found
    if context.ended:
        return context.unsolved()
    why = context.validator.path(replace(result.path, positions=waypoints)).violation
    what = "" if why is None else f": {why.message}"
    return context.fail(
        Status.INVALID_START, f"the arm cannot stop from start_velocity along a free way{what}"
    )
