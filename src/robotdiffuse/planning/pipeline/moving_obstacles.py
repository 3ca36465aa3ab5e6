"""Motions among obstacles that move: a path that any planner finds among those that stand still, and a timing
that waits, goes slower or draws back so that the others pass.

Along the path are places where the arm may rest; motions from rest to rest between any two of them, forwards
and backwards, at full speed or slower, are timed within the limits as always. Which of them, after which
waits, reach the end first is found by going through a grid of times once: a place is reached at a time if the
arm rested there before, or a motion that nothing is in the way of ends there (safe intervals, M. Phillips and
M. Likhachev, "SIPP: Safe interval path planning for dynamic environments", ICRA 2011, on a grid). The grid
only proposes: the motion as a whole is validated in time. Without success other paths are tried: other seeds,
and ways round where the obstacles are at some time.

A path by waypoints is timed as one: no motion between rests goes through a waypoint, so that the arm stops at
each, in their order, waits there if it must, and may draw back to one before it.
"""

from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from numpy import ndarray

from robotdiffuse.collision.kernels.moving_obstacles import free_over
from robotdiffuse.collision.moving_obstacles import MovingCollision, links_of
from robotdiffuse.core.deadline import OutOfTimeError, check_timing
from robotdiffuse.core.results import PlanResult
from robotdiffuse.core.types import Path, Status, Trajectory
from robotdiffuse.planning.context import PlanningContext, Request
from robotdiffuse.planning.pipeline.moving_obstacles_kernel import earliest
from robotdiffuse.planning.pipeline.waypoints import plan_by_waypoints
from robotdiffuse.planning.search.constrained import corner_kept
from robotdiffuse.problems.problem import Problem
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.trajectories.stops import APART, PACES, Rests
from robotdiffuse.trajectories.timing import time_parameterize
from robotdiffuse.validation.tolerances import goal_error
from robotdiffuse.validation.validator import verifier

if TYPE_CHECKING:
    from robotdiffuse.planning.planner import Planner

STEP = 0.02
"""Of the grid of times [s]."""
CELL_SECONDS = 1e-8
"""What a time and a configuration of the grid take at least [s]."""
TRAVEL = 0.02
"""No point of the arm moves further between two configurations of the grid [m]."""
PATIENCE, LONGER = 5.0, 3.0
"""The grid ends so long after the path could have been gone without obstacles [s], so many times over."""
SHARE = 0.5
"""Of the time that is left, for each path."""


def plan_among_moving(
    planner: "Planner", problem: Problem, time_limit: float, seed: int, request: Request
) -> PlanResult:
    """A motion among the problem's moving obstacles, certified in time until it ends."""
    context = PlanningContext(planner.name, problem, time_limit, seed, request)
    robot = problem.robot
    still = replace(problem, moving=())
    contact = context.validator.settings.contact
    collision = MovingCollision(robot, problem.moving, contact, 0.0)
    first = collision.sweep(np.zeros(1), problem.start[None]).contact
    if first is not None:
        return context.fail(
            Status.INVALID_START, f"the start is in collision: {first.link} touches {first.obstacle}"
        )
    rng, attempt, tried = np.random.default_rng(seed), 0, 0
    horizon, reason = 0.0, ""
    while attempt == 0 or context.remaining > 0:
        scene = problem.scene
        if attempt % 2:  # ways round the obstacles as they stand at some time
            time = float(rng.uniform(0.0, horizon))
            scene = Scene([*scene.shapes, *(one.at(time) for one in problem.moving if one.known)])
        limit = max(SHARE * (time_limit - context.elapsed), 1e-3)
        asked = replace(still, scene=scene), limit, seed + attempt // 2, request
        found = plan_by_waypoints(planner, *asked) if problem.waypoints else planner.attempt(*asked)
        attempt += 1
        if found.path is None or found.trajectory is None:
            if scene is problem.scene:
                return found
            continue
        tried += 1
        horizon = max(horizon, found.trajectory.duration)
        for clearance in (context.clearance, 0.0):
            try:
                with context.deadline():
                    timed = _timed(context, problem, collision, found.path, clearance)
            except OutOfTimeError as error:
                return context.out_of_time(error)
            if timed is None:
                continue
            report = context.validator.trajectory(timed)
            if report.violation is None:
                return _solved(context, found, timed, report.scene_clearance, report.self_clearance)
            reason = f"; last: {report.violation.message}"
    return context.fail(
        Status.TIMEOUT,
        f"no timing of {tried} paths with waits and retreats gets by the moving obstacles{reason}",
    )


def _solved(
    context: PlanningContext, found: PlanResult, timed: Trajectory, scene: float | None, itself: float | None
) -> PlanResult:
    assert found.scene_clearance is not None and found.self_clearance is not None
    assert scene is not None and itself is not None
    scene, itself = min(scene, found.scene_clearance), min(itself, found.self_clearance)
    return replace(
        found,
        reason=f"{found.reason}, timed among moving obstacles",
        planning_time=context.elapsed,
        seed=context.seed,
        trajectory=timed,
        scene_clearance=scene,
        self_clearance=itself,
        min_clearance=min(scene, itself),
        notes=(*context.notes, *(note for note in found.notes if note not in context.notes)),
    )


def _stops(problem: Problem, path: Path) -> list[int]:
    """The rows of a path at its waypoints, the first of each after those before it."""
    rows, stops = range(len(path.positions)), [0]
    for goal in problem.waypoints:
        there = (i for i in rows[stops[-1] :] if goal_error(problem.robot, goal, path.positions[i]) is None)
        stops.append(next(there))
    return stops[1:]


def _timed(
    context: PlanningContext,
    problem: Problem,
    collision: MovingCollision,
    path: Path,
    clearance: float,
) -> Trajectory | None:
    """The earliest motion along the path that the grid knows, None if there is none."""
    robot, validator = problem.robot, verifier(replace(problem, moving=()))
    if path.length < APART:
        return time_parameterize(robot, path, lambda _: True, validator.collision_free, context.timing)
    rests = Rests(
        robot,
        path,
        lambda t: validator.trajectory(t).valid,
        validator.collision_free,
        context.timing,
        STEP,
        partial(corner_kept, validator.constraints),
        context.beside,
        _stops(problem, path),
    )
    links = links_of(robot)[1]
    s, configurations = rests.spaced(links.levers.max(axis=0), TRAVEL)
    longest = sum(motion.ticks for motion in rests.motions if motion.target == motion.source + 1) // len(
        PACES
    )
    count = int(LONGER * longest + PATIENCE / STEP)
    check_timing(f"a grid of {count} times", CELL_SECONDS * count * len(configurations))
    times = STEP * np.arange(count)
    speed = max(one.greatest_speed for one in problem.moving)
    asked = clearance + (TRAVEL + speed * STEP) / 2
    clear = free_over(links, collision.tracks, configurations, times, asked)
    cells = list[ndarray]()
    for motion in rests.motions:
        check_timing("the grid of times")
        cells.append(rests.cells(motion, configurations))
    way, found = earliest(
        clear,
        np.searchsorted(s, rests.places),
        np.array([motion.source for motion in rests.motions]),
        np.array([motion.target for motion in rests.motions]),
        np.cumsum([0] + [len(of_motion) for of_motion in cells]),
        np.concatenate(cells),
    )
    return rests.trajectory([rests.motions[m] if m >= 0 else m for m in way]) if found else None
