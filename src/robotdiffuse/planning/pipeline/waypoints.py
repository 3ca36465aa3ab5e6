"""Motions through waypoints and motions from a start velocity.

A motion through waypoints has a segment from each waypoint to the next; the segments are joined and validated
as one motion. Each segment begins where the segment before it ended. If a waypoint has many goal
configurations, the planner chooses one, from which the next waypoint may be out of reach. So if a later
segment has no path, all segments are planned again with another seed, as long as there is time.

A waypoint with a blend is a corner between two segments. It is rounded like the corners of paths, as widely
as its blend and the obstacles allow. The motion stops at the waypoint if no rounding is free, or if
stopping is faster, as it may be where the path turns back.

A motion from a start velocity begins while the arm moves at this velocity, with zero acceleration. It starts
with a straight line that is long enough to stop on, in the direction of the velocity. The planner plans from
the end of this line. The path with the line is then timed from the start velocity. The corner at the end of
the line is rounded if it is free, so that the arm need not stop there.
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from operator import attrgetter
from typing import Any

import numpy as np
from jaxtyping import Int
from numpy import ndarray

from robotdiffuse.core.errors import InputError, check_type, counted, shown
from robotdiffuse.core.types import ROWS, Path, PlanResult, Status, Trajectory, Values, for_kernels
from robotdiffuse.planning.context import (
    MIN_TIME_LIMIT,
    STOPS_NOTE,
    PlanningContext,
    PlanRequest,
    Solver,
    least_clearances,
)
from robotdiffuse.problems.constraints import CartesianLine
from robotdiffuse.problems.fields import FIELDS
from robotdiffuse.problems.problem import Goal, JointGoal, Problem
from robotdiffuse.robots.robot import robot_fingerprint
from robotdiffuse.trajectories.speed_limits import DEFAULT as TIMING
from robotdiffuse.trajectories.speed_limits import stopping_distance, within_limits
from robotdiffuse.trajectories.timing import joined_rows
from robotdiffuse.trajectories.timing_kernel import rounded_line
from robotdiffuse.validation.tolerances import DEFAULT, goal_error
from robotdiffuse.validation.validator import verifier

BLEND_FRACTION = 0.9
"""Fraction of a blend that is used; the remainder covers the motion between the validator's samples."""
MAX_DEVIATION_PER_BLEND = 10.0
"""First corner deviation that is tried [rad], as a multiple of the blend [m] or [rad]. It is large, because
some joints move the frame only a little."""
# Deviations are tried in turn, at most MAX_DEVIATIONS; each is DEVIATION_FACTOR times the one before.
DEVIATION_FACTOR = 0.9
MAX_DEVIATIONS = 80


def plan_through_waypoints(planner: Solver, problem: Problem, request: PlanRequest) -> PlanResult:
    """A motion that visits the problem's waypoints in order and ends at its goal. It stops at each waypoint,
    or passes it within its blend.

    The remaining time is divided equally among the remaining segments. `planning_time` of the result counts
    all segments and the final validation; `progress` has one entry, for the whole path.
    """
    context = PlanningContext(planner.name, problem, request)
    goals = (*problem.waypoints, problem.goal)
    has_choice = [not (isinstance(goal, JointGoal) and len(goal.positions) == 1) for goal in goals]
    attempts = 0
    failure: tuple[int, PlanResult] | None = None
    while True:
        segments = list[PlanResult]()
        start = problem.start
        for k, goal in enumerate(goals):
            segment_limit = max(request.time_limit - context.elapsed, MIN_TIME_LIMIT) / (len(goals) - k)
            segment = replace(problem, start=start, goal=goal, waypoints=(), blend=(), notes=())
            segment_request = replace(request, time_limit=segment_limit, seed=request.seed + attempts)
            segments.append(planner.attempt(segment, segment_request))
            path = segments[-1].path
            if path is None:
                break
            start = path.positions[-1]
        else:
            return _joined(context, segments, _motions(context, segments))
        attempts += 1
        failed = segments[-1]
        # an attempt that ran out of time does not say why the attempt before it failed
        if failure is None or failed.status is not Status.TIMEOUT:
            failure = len(segments), failed
        # Another seed cannot make an invalid configuration valid, nor a pose reachable. It also hardly helps
        # if all goals before the failed segment are single configurations, since the segment then begins at
        # the same one.
        hopeless = failed.status is Status.UNREACHABLE_GOAL or (
            failed.status is Status.INVALID_GOAL and isinstance(goals[len(segments) - 1], JointGoal)
        )
        if hopeless or not any(has_choice[: len(segments) - 1]) or context.remaining <= 0:
            number, failed = failure
            reason = f"segment {number} of {len(goals)}: {failed.reason}"
            # INVALID_START would blame the problem's start, but a later segment begins at a planned
            # configuration
            later = number > 1 and failed.status is Status.INVALID_START
            return context.fail(Status.NO_PATH if later else failed.status, reason)


def _motions(context: PlanningContext, segments: Sequence[PlanResult]) -> list[Trajectory]:
    """The motions from stop to stop. Segments between two stops are blended into one motion if it is valid
    and faster than stopping at the waypoints between them."""
    blend = context.problem.blend
    motions = list[Trajectory]()
    first = 0
    for k in range(len(segments)):
        if k == len(blend) or blend[k] == 0:
            run = segments[first : k + 1]
            stopping = [segment.trajectory for segment in run]
            blended = _without_stops(context, run, first) if len(run) > 1 else None
            stopping_duration = sum(motion.duration for motion in stopping)
            motions += [blended] if blended is not None and blended.duration < stopping_duration else stopping
            first = k + 1
    return motions


def _without_stops(context: PlanningContext, segments: Sequence[PlanResult], first: int) -> Trajectory | None:
    """One motion along several segments without stops; None if the validator refuses it or the time is over.
    first: index of the first segment."""
    problem = context.problem
    last = first + len(segments) - 1
    goals = (*problem.waypoints, problem.goal)
    blend = problem.blend[first:last]
    path = _path(segments)
    part = replace(
        problem,
        start=path.positions[0],
        goal=goals[last],
        waypoints=goals[first:last],
        blend=blend,
        notes=(),
    )
    request = replace(context.request, time_limit=max(context.remaining, MIN_TIME_LIMIT))
    combined = PlanningContext(context.planner_name, part, request, len(segments))
    corners, deviations = _corners(segments)
    for row, goal, radius in zip(corners, part.waypoints, blend, strict=True):
        deviations[row] = _deviation(part, path, int(row), goal, radius)
    clearance = min(combined.clearance, *(segment.min_clearance for segment in segments))
    # a rounded corner must keep the clearance too: meshes nearer than `contact` count as touching
    padded = verifier(part, replace(DEFAULT, contact=max(clearance, DEFAULT.contact)))
    result = combined.finish(
        path.positions,
        context.planner_name,
        keeps=lambda q: padded.collision_free(replace(path, positions=q)),
        deviations=deviations,
    )
    return None if result is None else result.trajectory


def _corners(segments: Sequence[PlanResult]) -> tuple[Int[ndarray, "waypoints"], Values]:
    """For the joined path of segments: the rows at which the waypoints are, and how far from each row the
    motion may pass [rad, joint-space L2], which is 0 at the waypoints."""
    ends = np.cumsum([len(segment.path.positions) - 1 for segment in segments])
    deviations = np.full(ends[-1] + 1, TIMING.corner_deviation)
    for row, segment in zip((0, *ends), segments, strict=False):
        deviations[row : row + len(segment.corner_deviations)] = segment.corner_deviations
    deviations[ends[:-1]] = 0.0
    return ends[:-1], deviations


def _deviation(problem: Problem, path: Path, row: int, goal: Goal, blend: float) -> float:
    """The largest corner deviation, of those tried, with which the motion at this row still passes within the
    blend of the goal [rad, joint-space L2]. 0 if all of them are too large."""
    corner = for_kernels(path.positions[row - 1 : row + 2])
    deviation = MAX_DEVIATION_PER_BLEND * blend
    for _ in range(MAX_DEVIATIONS):
        line = rounded_line(corner, np.array([deviation]))
        middle = line(line.knots[1:2], 0)[0]  # of the rounded corner
        if goal_error(problem.robot, goal, middle, blend=BLEND_FRACTION * blend) is None:
            return deviation
        deviation *= DEVIATION_FACTOR
    return 0.0


def _path(segments: Sequence[PlanResult]) -> Path:
    """The paths of the segments as one path; the row that two paths share appears once."""
    path = segments[0].path
    rows = np.concatenate([path.positions, *(segment.path.positions[1:] for segment in segments[1:])])
    return replace(path, positions=rows)


def _joined(
    context: PlanningContext, segments: Sequence[PlanResult], motions: Sequence[Trajectory]
) -> PlanResult:
    """The result for all segments, with their motions joined and validated as one motion."""
    path = _path(segments)
    trajectory = one_after_another(motions)
    reports = context.validator.path(path), context.validator.trajectory(trajectory)
    for report in reports:
        if report.violation is not None:
            return context.fail(
                Status.NO_PATH,
                f"the segments are valid alone, but not as one motion: {report.violation.message}",
            )
    stages = dict.fromkeys(segment.stage for segment in segments)
    return replace(
        segments[-1],
        reason=f"solved in {len(segments)} segments by {', '.join(stages)}",
        planning_time=context.elapsed,
        seed=context.request.seed,
        stage=next(iter(stages)) if len(stages) == 1 else segments[-1].planner,
        path=path,
        trajectory=trajectory,
        corner_deviations=tuple(_corners(segments)[1].tolist()),
        **least_clearances(*reports),
        notes=context.notes_with(note for segment in segments for note in segment.notes),
        progress=((context.elapsed, path.length),),
    )


def one_after_another(motions: Sequence[Trajectory]) -> Trajectory:
    """Motions from rest to rest as one trajectory; the row that two motions share appears once."""
    rows = [(motion.times, *(getattr(motion, name) for name in ROWS)) for motion in motions]
    return Trajectory(motions[0].joint_names, *joined_rows(rows))


def join(
    results: Sequence[PlanResult],
    blend: float | Sequence[float] = 0.0,
    time_limit: float = 10.0,
    **request: Any,
) -> PlanResult:
    """Join several motions into one, which is verified as a whole. Each must begin where the one before it
    ends.

    Args:
        results: Results of `rd.plan` for the same robot and the same scene, without waypoints.
        blend: The joined motion passes within this distance of each place where two motions meet, without a
            stop: [m] for a pose, [rad] for a configuration; 0: it stops there. A list has one number for each
            place. The motion still stops where no rounding is free, or where stopping is faster. All must be
            0 if the motions have different path constraints, or Cartesian lines.
        time_limit: Wall time of the call [s].
        request: Further arguments of `rd.plan`: clearance, velocity_scaling, ... Motions that exceed the
            limits of this call are slowed down, and those that meet at a rounded corner are timed again, with
            these limits. To keep their speeds, give the scalings with which they were planned.

    Returns:
        A result whose problem has the goals of all motions but the last as waypoints; or a result that says
        why the joined motion is not valid.

    Raises:
        InputError: For fewer than two results; for results without a motion or problem, or with waypoints,
            views or a start velocity; for different robots, scenes or payloads; for motions that do not meet;
            and for a blend or further arguments out of bounds, or a blend that the motions do not allow.

    Examples:
        >>> space = rd.Workspace(rd.load_robot("panda"))
        >>> there = space.plan("extended", "ready")
        >>> rd.join([there, space.plan("ready", there.path.positions[-1])]).stops
        1
    """
    check_type("results", results, (list, tuple), "a list of results")
    for i, result in enumerate(results):
        check_type(f"results[{i}]", result, PlanResult, "a PlanResult")
        if not result.solved:
            raise InputError(f"results[{i}] has no motion: {result.reason}")
        if result.problem is None:
            raise InputError(f"results[{i}] has no problem; it must be a result of rd.plan")
        if result.problem.waypoints:
            raise InputError(f"results[{i}] has waypoints; join motions without them")
        if result.problem.start_velocity is not None:
            raise InputError(f"results[{i}] has a start_velocity; it must begin at rest")
    if len(results) < 2:
        raise InputError(f"results has {counted(len(results), 'result')}; it takes two to join")
    problems = [result.problem for result in results]
    first = problems[0]
    shared = [
        constraint
        for constraint in first.constraints
        if all(
            _entry("constraints", [constraint])[0] in _entry("constraints", problem.constraints)
            for problem in problems
        )
        and not isinstance(constraint, CartesianLine)
    ]
    objects = attrgetter("robot", "scene.shapes", "scene.allowed_contacts", "moving", "views", "payload")
    for i, (before, after) in enumerate(pairwise(results), 1):
        same_objects = objects(after.problem) == objects(first)
        if not same_objects and _content(after.problem) != _content(first):
            raise InputError(
                f"results[{i}] is for another robot, scene or payload than results[0]; execute these motions "
                "separately"
            )
        gap = np.abs(after.path.positions[0] - before.path.positions[-1])
        if gap.max() > DEFAULT.start_tolerance:
            j = int(gap.argmax())
            joint = first.robot.planned_joints[j]
            raise InputError(
                f"results[{i}] begins {gap[j]:.3g} {joint.unit} from the end of results[{i - 1}] in "
                f"{joint.name}: plan it from results[{i - 1}].path.positions[-1]"
            )
    goals = [problem.goal for problem in problems]
    problem = replace(first, waypoints=goals[:-1], blend=blend, goal=goals[-1], constraints=shared, notes=())
    if any(problem.blend) and any(len(each.constraints) > len(shared) for each in problems):
        raise InputError(
            f"blend is {shown(blend)}, but some motions have constraints (or lines) of their own, which a "
            "rounded corner could violate; join them with blend 0"
        )
    context = PlanningContext(results[-1].planner, problem, PlanRequest(time_limit, **request))
    # without a jerk limit in this call, the motions keep their jerks
    limits = replace(context.timing, jerk=context.request.jerk or np.inf)
    # notes on stops are left out: their times count from the beginning of one motion
    segments = [
        replace(
            result,
            trajectory=within_limits(result.trajectory, first.robot, limits),
            notes=tuple(note for note in result.notes if not note.startswith(STOPS_NOTE)),
        )
        for result in results
    ]
    return replace(_joined(context, segments, _motions(context, segments)), problem=problem)


def _content(problem: Problem) -> list[object]:
    """What joined motions share, by value: equal also for different objects, such as unpickled ones."""
    scene = [_entry(name, problem.scene) for name in ("scene", "allowed_contacts")]
    payload = problem.payload and _entry("payload", problem.payload)
    return [robot_fingerprint(problem.robot), problem.views, _entry("moving", problem.moving), payload, scene]


def _entry(name: str, value: object) -> Any:
    """The value of a field as in a file."""
    return FIELDS[name].write(value, None)


def plan_from_start_velocity(planner: Solver, problem: Problem, request: PlanRequest) -> PlanResult:
    """A motion from the problem's start velocity to rest at its goal.

    Raises InputError for a velocity beyond the scaled velocity limits of the request.
    """
    context = PlanningContext(planner.name, problem, request)
    robot = problem.robot
    velocity = problem.start_velocity
    assert velocity is not None
    beyond = np.flatnonzero(np.abs(velocity) > request.velocity_scaling * robot.velocity)
    if len(beyond):
        j = int(beyond[0])
        raise InputError(
            f"start_velocity: {robot.joint_names[j]} is {velocity[j]:g}; velocity_scaling allows "
            f"{request.velocity_scaling * robot.velocity[j]:g}"
        )
    direction = velocity / np.linalg.norm(velocity)
    # how far the arm can move in this direction within its limits
    margin = np.where(direction > 0, robot.upper - problem.start, problem.start - robot.lower)
    limited = (direction != 0) & ~robot.continuous
    room = float((margin[limited] / np.abs(direction[limited])).min(initial=np.inf))
    stop = problem.start + stopping_distance(robot, context.timing, velocity, 0.9 * room) * direction
    beyond = np.flatnonzero(robot.limit_excess(stop) > 0)
    if len(beyond):
        reason = f"{robot.joint_names[beyond[0]]} cannot stop from start_velocity within its limits"
        return context.fail(Status.INVALID_START, reason)
    result = planner.attempt(replace(problem, start=stop, start_velocity=None), request)
    if result.path is None:
        return replace(result, reason=f"planning from where the arm comes to rest: {result.reason}")
    waypoints = np.vstack([problem.start, result.path.positions])
    deviations = np.full(len(waypoints), TIMING.corner_deviation)
    deviations[2:] = result.corner_deviations[1:]
    verified_result = context.finish(waypoints, result.stage, notes=result.notes, deviations=deviations)
    if verified_result is not None:
        return verified_result
    if context.ended:
        return context.unsolved()
    violation = context.validator.path(replace(result.path, positions=waypoints)).violation
    details = "" if violation is None else f": {violation.message}"
    return context.fail(
        Status.INVALID_START, f"the arm cannot stop from start_velocity without a collision{details}"
    )
