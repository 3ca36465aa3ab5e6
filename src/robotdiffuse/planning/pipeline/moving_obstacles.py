"""Motions among moving obstacles: a planner finds a path in the static scene, which is then timed so that the
arm does not meet the moving obstacles.

The path has places where the arm may stop. Motions between any two places without a sharp corner between
them, forwards and backwards, at full or half speed, are timed within the robot's limits. A search over a grid
of times finds the sequence of motions and waits that reaches the end as early as possible. A place is reached
at a time if the arm was there one step before and can wait, or if a collision-free motion ends there. This is
SIPP on a grid (M. Phillips and M. Likhachev, "SIPP: Safe interval path planning for dynamic environments",
ICRA 2011). The validator then checks the whole motion in continuous time. If it refuses the motion, or no
sequence reaches the end, other paths are tried: paths found with other seeds, and paths around the obstacles
of known motion as they stand at a random time.

With waypoints, the motion stops at each waypoint in their order. It may wait there or go back to an earlier
waypoint.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Int
from numpy import ndarray

from robotdiffuse.collision.kernels.moving_obstacles import free_at_times
from robotdiffuse.collision.moving_obstacles import MovingCollision, compile_links
from robotdiffuse.core.deadline import OutOfTimeError, check_timing
from robotdiffuse.core.kernels import kernel
from robotdiffuse.core.types import Path, PlanResult, Status, Trajectory
from robotdiffuse.planning.context import PlanningContext, PlanRequest, Solver, least_clearances
from robotdiffuse.planning.pipeline.waypoints import plan_through_waypoints
from robotdiffuse.problems.problem import Problem
from robotdiffuse.scenes.scene import added
from robotdiffuse.trajectories.timing import MIN_DISTANCE, SPEED_FACTORS, StopGraph, time_parameterize
from robotdiffuse.validation.tolerances import goal_error
from robotdiffuse.validation.validator import verifier

# Values of `came` (see `_reached`) for a place that is not reached, or is reached by waiting.
UNREACHED = -2
WAITED = -1
CELLS_PER_CLOCK_CHECK = 10_000_000
"""Number of configurations of motions that are tested between two readings of the clock."""


def earliest(
    clear: Bool[ndarray, "configurations ticks"],
    row: Int[ndarray, "places"],
    source: Int[ndarray, "motions"],
    target: Int[ndarray, "motions"],
    first: Int[ndarray, "n"],
    rows: Int[ndarray, "k"],
) -> tuple[list[int], bool]:
    """The schedule that takes the arm from the first place, where it rests at tick 0, to the last place as
    early as possible.

    clear: whether each configuration is free at each tick.
    row: row of `clear` of each place.
    source, target: indices of the places where each motion begins and ends.
    first, rows: motion m passes the rows rows[first[m] : first[m + 1]] of `clear`, one per tick.

    Returns the indices of the motions in order, with -1 for each tick of waiting, and whether the last place
    can be reached. Raises OutOfTimeError if the deadline leaves no time.
    """
    came = np.full((clear.shape[1], len(row)), UNREACHED)
    came[0, 0] = WAITED
    count = max(CELLS_PER_CLOCK_CHECK // len(rows), 1)
    for begin in range(0, len(came) - 1, count):
        check_timing("the grid of times")
        end = _reached(came, clear, row, source, target, first, rows, begin, count)
        if end >= 0:
            return _way_to(end, came, source, first), True
    return [], False


@kernel(nogil=True)
def _reached(came, clear, row, source, target, first, rows, begin, count):
    """Visit `count` ticks from `begin` on. For each tick and place, write to came [ticks, places] the index
    of the motion by which the place is reached then, or WAITED. Returns the tick at which the last place is
    first reached; -1 if it is not reached in these ticks."""
    places = len(row)
    ticks = clear.shape[1]
    for now in range(begin, min(begin + count, ticks - 1)):
        if came[now, places - 1] != UNREACHED:
            return now
        for i in range(places):
            can_wait = came[now, i] != UNREACHED and clear[row[i], now + 1]
            if can_wait and came[now + 1, i] == UNREACHED:
                came[now + 1, i] = WAITED
        for m in range(len(source)):
            steps = first[m + 1] - first[m] - 1
            arrival = now + steps
            if came[now, source[m]] == UNREACHED or arrival >= ticks or came[arrival, target[m]] != UNREACHED:
                continue
            # both configurations of each step must be free at both of its ticks
            free = True
            for k in range(steps):
                a = rows[first[m] + k]
                b = rows[first[m] + k + 1]
                if not (clear[a, now + k + 1] and clear[b, now + k] and clear[b, now + k + 1]):
                    free = False
                    break
            if free:
                came[arrival, target[m]] = m
    return -1


@kernel()
def _way_to(end, came, source, first):
    """The indices of the motions that reach the last place at tick `end`, in order; -1 for each tick of
    waiting."""
    motion_numbers = [0 for _ in range(0)]  # empty, with a type that Numba can infer
    place = came.shape[1] - 1
    while end > 0:
        m = came[end, place]
        motion_numbers.append(m)
        if m == WAITED:
            end -= 1
        else:
            end -= first[m + 1] - first[m] - 1
            place = source[m]
    return motion_numbers[::-1]


GRID_STEP = 0.02
"""Step of the grid of times [s]."""
CELL_SECONDS = 1e-8
"""Smallest computing time of a cell, one configuration at one tick [s]."""
GRID_TRAVEL = 0.02
"""Largest travel of any point of the arm between two neighboring configurations of the grid [m]."""
# The grid of times ends at DURATION_FACTOR times the duration of a motion that stops at every place (the mean
# over SPEED_FACTORS), plus EXTRA_TIME [s].
EXTRA_TIME = 5.0
DURATION_FACTOR = 3.0
PATH_TIME_FRACTION = 0.5
"""Time limit for planning a path, as a fraction of the remaining time."""


def plan_among_moving_obstacles(planner: Solver, problem: Problem, request: PlanRequest) -> PlanResult:
    """A motion among the problem's moving obstacles, certified at every time until it ends."""
    context = PlanningContext(planner.name, problem, request)
    robot = problem.robot
    still = replace(problem, moving=())
    contact = context.validator.settings.contact
    collision = MovingCollision(robot, problem.moving, contact, 0.0)
    first = collision.sweep(np.zeros(1), problem.start[None]).contact
    if first is not None:
        return context.fail(
            Status.INVALID_START, f"the start is in collision: {first.link} touches {first.obstacle}"
        )
    context.begin_search()
    rng = np.random.default_rng(request.seed)
    attempts = 0
    attempted_paths = 0
    horizon = 0.0
    reason = ""
    while attempts == 0 or context.remaining > 0:
        scene = problem.scene
        if attempts % 2:  # every other path avoids the moving obstacles at their places at a random time
            time = float(rng.uniform(0.0, horizon))
            standing = (obstacle.at(time) for obstacle in problem.moving if obstacle.known)
            scene = added(scene, standing)
        limit = max(PATH_TIME_FRACTION * (request.time_limit - context.elapsed), 1e-3)
        path_request = replace(request, time_limit=limit, seed=request.seed + attempts // 2)
        at_rest = replace(still, scene=scene)
        began = context.elapsed
        if problem.waypoints:
            result = plan_through_waypoints(planner, at_rest, path_request)
        else:
            result = planner.attempt(at_rest, path_request)
        attempts += 1
        if result.path is None or result.trajectory is None:
            if attempted_paths == 0 and scene is problem.scene:
                return result
            continue
        attempted_paths += 1
        horizon = max(horizon, result.trajectory.duration)
        for clearance in dict.fromkeys((context.clearance, 0.0)):
            try:
                with context.deadline():
                    timed = _timed(context, problem, collision, result, clearance)
            except OutOfTimeError as error:
                if attempted_paths == 1:
                    return context.out_of_time(error)
                attempted_paths -= 1  # timing the last path was not completed
                break
            if timed is None:
                continue
            report = context.validator.trajectory(timed)
            if report.violation is None:
                return replace(
                    result,
                    reason=f"{result.reason}, timed among moving obstacles",
                    planning_time=context.elapsed,
                    seed=request.seed,
                    trajectory=timed,
                    progress=tuple((began + at, length) for at, length in result.progress),
                    **least_clearances(result, report),
                    notes=context.notes_with(result.notes),
                )
            reason = f"; last: {report.violation.message}"
    paths = "one path" if attempted_paths == 1 else f"{attempted_paths} paths"
    return context.fail(
        Status.TIMEOUT,
        f"no timing of {paths}, with waits and retreats, passes the moving obstacles{reason}",
    )


def _stops(problem: Problem, path: Path) -> list[int]:
    """The row of a path at each waypoint: the first row that reaches it, not before the row of the previous
    waypoint."""
    rows = range(len(path.positions))
    stops = [0]
    for goal in problem.waypoints:
        reaching = (
            i for i in rows[stops[-1] :] if goal_error(problem.robot, goal, path.positions[i]) is None
        )
        stops.append(next(reaching))
    return stops[1:]


def _timed(
    context: PlanningContext,
    problem: Problem,
    collision: MovingCollision,
    static: PlanResult,
    clearance: float,
) -> Trajectory | None:
    """The motion along the path of `static`, a result for the static scene, that reaches the end as early as
    possible on the grid of times; None if there is none. Corners are rounded as in `static`. clearance: to
    moving obstacles [m]."""
    path = static.path
    assert path is not None
    robot = problem.robot
    validator = verifier(replace(problem, moving=()))
    timing = time_parameterize(
        robot,
        path,
        lambda motion: validator.trajectory(motion).valid,
        validator.collision_free,
        context.timing,
        context.keeps_constraints,
        extra=context.extra_limits,
        deviations=np.array(static.corner_deviations),
        stops=_stops(problem, path),
    )
    if path.length < MIN_DISTANCE:
        return timing.trajectory
    graph = StopGraph(robot, timing, context.timing, GRID_STEP, context.extra_limits)
    links = compile_links(robot)[1]
    s, configurations = graph.sample(links.motion_radii.max(axis=0), GRID_TRAVEL)
    # ticks of a motion that stops at every place: the mean over the speed factors
    ticks = sum(motion.ticks for motion in graph.motions if motion.target == motion.source + 1) // len(
        SPEED_FACTORS
    )
    count = int(DURATION_FACTOR * ticks + EXTRA_TIME / GRID_STEP)
    check_timing(f"a grid of {count} times", CELL_SECONDS * count * len(configurations))
    times = GRID_STEP * np.arange(count)
    speed = max(obstacle.top_speed for obstacle in problem.moving)
    needed = clearance + (GRID_TRAVEL + speed * GRID_STEP) / 2
    clear = free_at_times(links, collision.tracks, configurations, times, needed)
    cells = list[ndarray]()
    for motion in graph.motions:
        check_timing("the grid of times")
        cells.append(graph.nearest_samples(motion, configurations))
    motion_numbers, reached = earliest(
        clear,
        np.searchsorted(s, graph.stops),
        np.array([motion.source for motion in graph.motions]),
        np.array([motion.target for motion in graph.motions]),
        np.cumsum([0] + [len(of_motion) for of_motion in cells]),
        np.concatenate(cells),
    )
    return graph.trajectory(motion_numbers) if reached else None
