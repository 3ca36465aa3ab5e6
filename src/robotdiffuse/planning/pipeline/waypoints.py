"""One motion by waypoints: legs that any planner plans, timed as one where waypoints are blended, validated as a
whole.

A leg begins where the one before it ended. Where a goal has many configurations, the planner takes one, from
which the next goal may be out of reach; so when a later leg has no path, all are planned again with another
seed, as long as there is time.

A waypoint that may be blended is a corner between two legs, which is rounded as corners of paths are: as
widely as its blend allows, less where that is not free. Where nothing is, or it takes longer than stopping,
as it may where the path turns back, the motion stops there after all.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from robotdiffuse.core.results import PlanResult
from robotdiffuse.core.types import Path, Status, Trajectory
from robotdiffuse.planning.context import PlanningContext, Request
from robotdiffuse.problems.goals import Goal, JointGoal
from robotdiffuse.problems.problem import Problem
from robotdiffuse.trajectories.corner_rounding import corner_middle
from robotdiffuse.validation.tolerances import DEFAULT, goal_error
from robotdiffuse.validation.validator import verifier

if TYPE_CHECKING:
    from robotdiffuse.planning.planner import Planner

SHARE = 0.9
"""Of a blend that is used, for the motion is validated at places."""
WIDEST, NARROWER, NARROWINGS = 10.0, 0.9, 80
"""Corners are first tried so many times as wide as the blend, for joints may move frames little [rad/m]; then
narrower each time, so often."""
SOON = 1e-3
"""Time limit of what is validated when time has run out [s]."""


def plan_by_waypoints(
    planner: "Planner", problem: Problem, time_limit: float, seed: int, request: Request
) -> PlanResult:
    """A motion that stops at each of the problem's waypoints in order, or passes within its blend, and ends
    at its goal.

    Each leg has an equal share of the time that is left. The result's `planning_time` is that of all legs and
    of the last verdict, its `progress` the whole path's alone.
    """
    context = PlanningContext(planner.name, problem, time_limit, seed, request)
    goals = (*problem.waypoints, problem.goal)
    many_ways = [not (isinstance(goal, JointGoal) and len(goal.positions) == 1) for goal in goals]
    attempt = 0
    while True:
        legs: list[PlanResult] = []
        start = problem.start
        for k, goal in enumerate(goals):
            left = max(time_limit - context.elapsed, SOON) / (len(goals) - k)
            leg = replace(problem, start=start, goal=goal, waypoints=(), blend=(), notes=())
            legs.append(planner.attempt(leg, left, seed + attempt, request))
            path = legs[-1].path
            if path is None:
                break
            start = path.positions[-1]
        else:
            return _joined(context, legs, _motions(context, request, legs))
        attempt += 1
        if not any(many_ways[: len(legs) - 1]) or context.remaining <= 0:
            failed = legs[-1]
            what = f"leg {len(legs)} of {len(goals)}: {failed.reason}"
            # where a later leg begins is no fault of the problem's start
            later = len(legs) > 1 and failed.status is Status.INVALID_START
            return context.fail(Status.NO_PATH if later else failed.status, what)


def _motions(context: PlanningContext, request: Request, legs: Sequence[PlanResult]) -> list[Trajectory]:
    """The motions between stops: of each leg, or of those between which waypoints are blended."""
    blend, motions, first = context.problem.blend, list[Trajectory](), 0
    for k in range(len(legs)):
        if k == len(blend) or blend[k] == 0:
            run = legs[first : k + 1]
            stopping = [leg.trajectory for leg in run if leg.trajectory is not None]
            one = _without_stops(context, request, run, first) if len(run) > 1 else None
            pays = one is not None and one.duration < sum(motion.duration for motion in stopping)
            motions += [one] if one is not None and pays else stopping
            first = k + 1
    return motions


def _without_stops(
    context: PlanningContext, request: Request, legs: Sequence[PlanResult], first: int
) -> Trajectory | None:
    """Legs from the first on as one motion, which does not stop in between; None if the validator refuses it."""
    problem, last = context.problem, first + len(legs) - 1
    goals, blend = (*problem.waypoints, problem.goal), problem.blend[first:last]
    path = _path(legs)
    part = replace(
        problem,
        start=path.positions[0],
        goal=goals[last],
        waypoints=goals[first:last],
        blend=blend,
        notes=(),
    )
    whole = PlanningContext(context.planner, part, max(context.remaining, SOON), context.seed, request)
    whole.timing = replace(whole.timing, line_intervals=len(legs) * whole.timing.line_intervals)
    corners = np.cumsum([len(leg.path.positions) - 1 for leg in legs[:-1] if leg.path is not None])
    deviations = np.full(len(path.positions), whole.timing.corner_deviation)
    for row, goal, radius in zip(corners, part.waypoints, blend, strict=True):
        deviations[row] = _deviation(part, path, int(row), goal, radius)
    kept = min(whole.clearance, *(leg.min_clearance for leg in legs if leg.min_clearance is not None))
    closer = verifier(part, replace(DEFAULT, contact=max(kept, DEFAULT.contact)))
    found = whole.finish(
        path.positions,
        context.planner,
        keeps=lambda q: closer.collision_free(replace(path, positions=q)),
        deviations=deviations,
    )
    return None if found is None else found.trajectory


def _deviation(problem: Problem, path: Path, row: int, goal: Goal, blend: float) -> float:
    """How far the motion may leave the path's corner at a row such that it passes a goal within its blend."""
    q, deviation = path.positions, WIDEST * blend
    for _ in range(NARROWINGS):
        middle = corner_middle(q, row, deviation)
        if goal_error(problem.robot, goal, middle, blend=SHARE * blend) is None:
            return deviation
        deviation *= NARROWER
    return 0.0


def _path(legs: Sequence[PlanResult]) -> Path:
    """The legs' paths as one; rows at which one ends and the next begins are kept once."""
    paths = [leg.path for leg in legs if leg.path is not None]
    rows = np.concatenate([paths[0].positions, *(path.positions[1:] for path in paths[1:])])
    return Path(paths[0].joint_names, rows)


def _joined(
    context: PlanningContext, legs: Sequence[PlanResult], motions: Sequence[Trajectory]
) -> PlanResult:
    """The legs as one motion, validated as one."""
    path, trajectory = _path(legs), _one_after_another(motions)
    reports = context.validator.path(path), context.validator.trajectory(trajectory)
    for report in reports:
        if report.violation is not None:
            return context.fail(
                Status.NO_PATH, f"the legs are free, not the whole: {report.violation.message}"
            )
    scene = min(report.scene_clearance for report in reports if report.scene_clearance is not None)
    itself = min(report.self_clearance for report in reports if report.self_clearance is not None)
    stages = dict.fromkeys(leg.stage for leg in legs)
    notes = dict.fromkeys(note for leg in legs for note in leg.notes)
    return replace(
        legs[-1],
        reason=f"solved in {len(legs)} legs by {', '.join(stages)}",
        planning_time=context.elapsed,
        seed=context.seed,
        stage=next(iter(stages)) if len(stages) == 1 else legs[-1].planner,
        path=path,
        trajectory=trajectory,
        min_clearance=min(scene, itself),
        scene_clearance=scene,
        self_clearance=itself,
        notes=(*context.notes, *(note for note in notes if note not in context.notes)),
        progress=((context.elapsed, path.length),),
    )


def _one_after_another(motions: Sequence[Trajectory]) -> Trajectory:
    """Motions from rest to rest as one; the row at which one ends and the next begins is kept once."""
    times, parts = [motions[0].times], [motions[0]]
    for motion in motions[1:]:
        if len(motion.times) > 1:  # a leg that has nowhere to go takes no time
            times.append(times[-1][-1] + motion.times[1:])
            parts.append(motion)
    rows = [
        np.concatenate([getattr(parts[0], name), *(getattr(part, name)[1:] for part in parts[1:])])
        for name in ("positions", "velocities", "accelerations")
    ]
    return Trajectory(motions[0].joint_names, np.concatenate(times), *rows)
