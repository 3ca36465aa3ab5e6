"""One motion by waypoints, at each of which it stops: legs that any planner plans, judged as a whole.

A leg begins where the one before it ended. Where a goal has many configurations, the planner takes one, from
which the next goal may be out of reach; so when a later leg has no path, all are planned again with another
seed, as long as there is time.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from robotdiffuse.planners.call import Call, Request
from robotdiffuse.problems.goals import JointGoal
from robotdiffuse.problems.problem import Problem
from robotdiffuse.results import PlanResult
from robotdiffuse.types import Path, Status, Trajectory

if TYPE_CHECKING:
    from robotdiffuse.planners.base import Planner


def plan_by_waypoints(
    planner: "Planner", problem: Problem, time_limit: float, seed: int, request: Request
) -> PlanResult:
    """A motion that stops at each of the problem's waypoints in order and ends at its goal.

    Each leg has an equal share of the time that is left. The result's `planning_time` is that of all legs and
    of the last verdict, its `progress` the whole path's alone.
    """
    call = Call(planner.name, problem, time_limit, seed, request)
    goals = (*problem.waypoints, problem.goal)
    many_ways = [not (isinstance(goal, JointGoal) and len(goal.positions) == 1) for goal in goals]
    attempt = 0
    while True:
        legs: list[PlanResult] = []
        start = problem.start
        for k, goal in enumerate(goals):
            left = max(time_limit - call.elapsed, 1e-3) / (len(goals) - k)
            leg = replace(problem, start=start, goal=goal, waypoints=(), notes=())
            legs.append(planner.attempt(leg, left, seed + attempt, request))
            path = legs[-1].path
            if path is None:
                break
            start = path.positions[-1]
        else:
            return _joined(call, legs)
        attempt += 1
        if not any(many_ways[: len(legs) - 1]) or call.remaining <= 0:
            failed = legs[-1]
            what = f"leg {len(legs)} of {len(goals)}: {failed.reason}"
            # where a later leg begins is no fault of the problem's start
            later = len(legs) > 1 and failed.status is Status.INVALID_START
            return call.fail(Status.NO_PATH if later else failed.status, what)


def _joined(call: Call, legs: Sequence[PlanResult]) -> PlanResult:
    """The legs as one motion, judged as one."""
    paths = [leg.path for leg in legs if leg.path is not None]
    timed = [leg.trajectory for leg in legs if leg.trajectory is not None]
    rows = np.concatenate([paths[0].positions, *(path.positions[1:] for path in paths[1:])])
    path = Path(paths[0].joint_names, rows)
    trajectory = _one_after_another(timed)
    reports = call.judge.path(path), call.judge.trajectory(trajectory)
    for report in reports:
        if report.violation is not None:
            return call.fail(Status.NO_PATH, f"the legs are free, not the whole: {report.violation.message}")
    scene = min(report.scene_clearance for report in reports if report.scene_clearance is not None)
    itself = min(report.self_clearance for report in reports if report.self_clearance is not None)
    stages = dict.fromkeys(leg.stage for leg in legs)
    notes = dict.fromkeys(note for leg in legs for note in leg.notes)
    return replace(
        legs[-1],
        reason=f"solved in {len(legs)} legs by {', '.join(stages)}",
        planning_time=call.elapsed,
        seed=call.seed,
        stage=next(iter(stages)) if len(stages) == 1 else legs[-1].planner,
        path=path,
        trajectory=trajectory,
        min_clearance=min(scene, itself),
        scene_clearance=scene,
        self_clearance=itself,
        notes=(*call.notes, *(note for note in notes if note not in call.notes)),
        progress=((call.elapsed, path.length),),
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
