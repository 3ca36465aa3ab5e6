"""The checker's own tests of all requirements but freedom from collision: limits, start, goal and rates."""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.certificates.constraints import constraint_bounds, frame_speed_errors
from robotdiffuse.certificates.kinematics import Linkage
from robotdiffuse.certificates.proof import BOUND_TOLERANCE, MotionProof, Tolerances
from robotdiffuse.certificates.torques import torque_bounds
from robotdiffuse.core.errors import joined
from robotdiffuse.core.types import Path, Trajectory
from robotdiffuse.problems.goals import AnyGoal, Goal, JointGoal, PosesGoal
from robotdiffuse.problems.problem import Problem
from robotdiffuse.robots.robot import Robot

AVERAGING_WINDOWS = (1e-3, 4e-3, 16e-3)
"""Where rows are closer than the first of these [s], mean accelerations are also tested over windows of at
least these lengths: from one row to the next, the position tolerance would hide any rate."""
MIN_TIME = 1e-12
"""Shorter times are taken as this [s], so that rates over them are finite."""


def configurations(motion: Path | Trajectory, between: Float[ndarray, "k"]) -> Float[ndarray, "n dof"]:
    """The rows of a motion and further configurations between them, in order.

    `between`: times [s], for which the configurations are on the cubics through the rows' positions and
    velocities; for a path, rows plus shares of the way to the next, on its straight lines.
    """
    if not len(between):
        return motion.positions
    if not isinstance(motion, Trajectory):
        rows = np.arange(len(motion.positions))
        places = np.sort(np.concatenate([rows, between]))
        return np.column_stack([np.interp(places, rows, joint) for joint in motion.positions.T])
    times = np.concatenate([motion.times, between])
    q = np.concatenate([motion.positions, _cubic(motion, between)])
    return q[np.argsort(times, kind="stable")]


def _cubic(motion: Trajectory, at: Float[ndarray, "k"]) -> Float[ndarray, "k dof"]:
    """Configurations at times on the cubics through the rows' positions and velocities."""
    row = np.clip(np.searchsorted(motion.times, at, side="right") - 1, 0, len(motion.times) - 2)
    h = (motion.times[row + 1] - motion.times[row])[:, None]
    u = (at - motion.times[row])[:, None] / h
    # Hermite's basis
    q0, q1 = motion.positions[row], motion.positions[row + 1]
    v0, v1 = motion.velocities[row], motion.velocities[row + 1]
    return (
        (1 + 2 * u) * (1 - u) ** 2 * q0
        + u**2 * (3 - 2 * u) * q1
        + h * u * (1 - u) ** 2 * v0
        - h * u**2 * (1 - u) * v1
    )


def not_covered(problem: Problem, motion: Path | Trajectory) -> list[str]:
    """Requirements of the problem that no certificate of such a motion can prove."""
    untimed = not isinstance(motion, Trajectory)
    return ["moving, without times"] if untimed and problem.moving else []


def requirement_errors(problem: Problem, certificate: MotionProof) -> Iterator[str]:
    """A line for each requirement that the motion fails, or is not shown to meet."""
    robot, motion, tolerances = problem.robot, certificate.motion, certificate.tolerances
    for name in not_covered(problem, motion):
        yield f"problem: certificates do not prove anything about {name}"
    if tuple(motion.joint_names) != robot.joint_names:
        yield f"motion: its joints are {joined(motion.joint_names)}, not {joined(robot.joint_names)}"
        return
    q = configurations(motion, certificate.between)
    beyond = np.maximum(robot.lower - q, q - robot.upper)
    beyond[:, robot.continuous] = 0.0
    for j in np.flatnonzero((beyond > tolerances.limit_slack).any(axis=0)):
        yield f"motion: {robot.joint_names[j]} leaves its limits by {beyond[:, j].max():.3g}"
    off = np.abs(motion.positions[0] - problem.start).max(initial=0.0)
    if not off <= tolerances.start_tolerance:
        yield f"motion: it begins {off:.3g} off the start"
    if not at_goal(robot, problem.goal, motion.positions[-1], tolerances):
        yield "motion: it does not end at the goal"
    if isinstance(motion, Trajectory):
        begins = np.zeros(robot.dof) if problem.start_velocity is None else problem.start_velocity
        yield from _rate_errors(robot, motion, certificate, begins)
        yield from frame_speed_errors(problem, motion, tolerances.rate_slack)
        yield from _jerk_errors(motion, certificate)
    yield from _constraint_errors(problem, certificate, q)
    yield from _torque_errors(problem, certificate)


def _jerk_errors(motion: Trajectory, certificate: MotionProof) -> Iterator[str]:
    """Jerks, where the proof states them, that are larger than it says."""
    stated = dict(certificate.jerks)
    if not stated:
        return
    if [*stated] != [*motion.joint_names]:
        yield "jerks: their joints are not those of the motion"
        return
    steps = np.diff(motion.times)[:, None]
    ends = np.abs(motion.accelerations[[0, -1]]).max(axis=0)
    most = np.abs(np.diff(motion.accelerations, axis=0) / steps).max(axis=0, initial=0.0)
    for name, jerk, end in zip(stated, most, ends, strict=True):
        if not jerk <= stated[name] * (1 + BOUND_TOLERANCE):
            yield f"jerks: that of {name} is {jerk:.6g}, not {stated[name]:.6g}"
        if end != 0:
            yield f"jerks: the acceleration of {name} jumps at the start or the end"


def _torque_errors(problem: Problem, certificate: MotionProof) -> Iterator[str]:
    """Torque limits that are not shown to be kept with the payload, and torques that differ from the
    proof."""
    motion, stated = certificate.motion, dict(certificate.torques)
    if problem.payload is None:
        if stated:
            yield "torques: the problem has no payload"
        return
    if [*stated] != [*problem.robot.joint_names]:
        yield "torques: their joints are not those of the robot"
        return
    if isinstance(motion, Trajectory) and not (np.diff(motion.times) > 0).all():
        return
    most = torque_bounds(problem, motion, certificate.torque_samples).max(axis=0)
    allowed = problem.robot.effort * (1 + certificate.tolerances.rate_slack)
    for name, torque, limit in zip(stated, most, allowed, strict=True):
        if abs(torque - stated[name]) > BOUND_TOLERANCE:
            yield f"torques: the bound of {name} is {torque:.6f}, not {stated[name]:.6f}"
        if not torque <= limit:
            yield f"torques: {name} is not shown to keep its limit: {torque:.6f} of {limit:.6f}"


def _constraint_errors(
    problem: Problem, certificate: MotionProof, q: Float[ndarray, "n dof"]
) -> Iterator[str]:
    """Path constraints that are not shown to be kept, and bounds that differ from the proof."""
    if not problem.constraints and not certificate.constraints:
        return
    shown = constraint_bounds(problem, q, certificate.tolerances.chord)
    if [one.name for one in shown] != [name for name, _ in certificate.constraints]:
        yield "constraints: they are not those of the problem"
        return
    for one, (_, stated) in zip(shown, certificate.constraints, strict=True):
        most = float(one.bounds.max())
        if abs(most - stated) > BOUND_TOLERANCE:
            yield f"constraints: the bound of {one.name} is {most:.6f}, not {stated:.6f}"
        if not most <= one.limit:
            yield f"constraints: {one.name} is not shown to be kept: {most:.6f} of {one.limit:.6f}"


def _rate_errors(
    robot: Robot, motion: Trajectory, certificate: MotionProof, begins: Float[ndarray, "dof"]
) -> Iterator[str]:
    tolerances, step = certificate.tolerances, np.diff(motion.times)[:, None]
    if not (step > 0).all():
        yield "motion: its times do not increase"
        return
    times = np.sort(np.concatenate([motion.times, certificate.between]), kind="stable")
    if len(np.unique(times)) != len(times) or times[0] < motion.times[0] or times[-1] > motion.times[-1]:
        yield "motion: the times of `between` do not lie between its rows"
        return
    if (
        len(motion.times) > 1
        and not _largest_chord_error(motion, times) <= tolerances.chord * (1 + 1e-6) + 1e-12
    ):
        yield "motion: its cubics leave the straight lines that were certified"
    v, a, share = motion.velocities, motion.accelerations, 1 + tolerances.rate_slack
    mean, change = np.diff(motion.positions, axis=0) / step, np.diff(v, axis=0) / step
    rates = (
        ("velocity", v, robot.velocity),
        ("mean velocity between rows", mean, robot.velocity),
        ("acceleration", a, robot.acceleration),
        ("mean acceleration between rows", change, robot.acceleration),
    )
    unsure = 2 * tolerances.limit_slack
    blur = {"mean velocity between rows": unsure / np.maximum(step, MIN_TIME)}
    for what, values, limit in rates:
        over = ~(np.abs(values) <= share * limit + blur.get(what, 0.0)) & (limit > 0)
        for j in np.flatnonzero(over.any(axis=0)):
            most = np.abs(values[:, j]).max()
            yield f"motion: {robot.joint_names[j]} exceeds its limit of {what}: {most:.4g} > {limit[j]:.4g}"
    yield from _position_errors(robot, motion, share, unsure)
    yield from _acceleration_errors(robot, motion, begins, share, unsure, tolerances.rate_slack)
    known = np.where(robot.velocity > 0, robot.velocity, np.abs(v).max(axis=0, initial=0.0))
    off = np.abs(np.stack([v[0] - begins, v[-1]]))
    if (off > tolerances.rate_slack * known + tolerances.rest).any():
        how = "at the problem's start_velocity, or end" if begins.any() else "and end"
        yield f"motion: it does not begin {how} at rest"


def _position_errors(robot: Robot, motion: Trajectory, share: float, unsure: float) -> Iterator[str]:
    """Joints that move further, from any row to any later one, than their velocity limits allow in that time.

    Positions have a tolerance of `unsure`: once for the two rows and, for rows far apart, once for each step
    between them.
    """
    step, q = np.diff(motion.times)[:, None], motion.positions
    allowed = np.zeros_like(q)
    most = share * robot.velocity * step + unsure * np.minimum(step / AVERAGING_WINDOWS[0], 1.0)
    np.cumsum(most, axis=0, out=allowed[1:])
    furthest = np.zeros(q.shape[1])
    for way in (q, -q):
        # largest excess over all earlier rows, by a running minimum
        least = np.minimum.accumulate(way - allowed, axis=0)
        furthest = np.maximum(furthest, (way - allowed - least).max(axis=0))
    for j in np.flatnonzero((furthest > unsure) & (robot.velocity > 0)):
        name, limit = robot.joint_names[j], robot.velocity[j]
        how = f"it gets {furthest[j]:.3g} further than {limit:.4g} allows"
        yield f"motion: {name} exceeds its limit of mean velocity from one row to another: {how}"


def _acceleration_errors(
    robot: Robot,
    motion: Trajectory,
    begins: Float[ndarray, "dof"],
    share: float,
    unsure: float,
    rest_slack: float,
) -> Iterator[str]:
    """Joints whose mean accelerations over windows, computed from positions, exceed their limits.

    Before the first row the arm is taken to move at its start velocity, and after the last row to stand
    still. The mean acceleration, from the mean velocity before a row to that after it, is a value that the
    joint must have reached.
    """
    times, q, limit = motion.times, motion.positions, robot.acceleration
    fine = np.diff(times).min(initial=np.inf) < AVERAGING_WINDOWS[0]
    for window in AVERAGING_WINDOWS if fine else AVERAGING_WINDOWS[:1]:
        at = np.concatenate([[times[0] - window], times, [times[-1] + window]])
        rows = np.concatenate([q[:1] - window * begins, q, q[-1:]])
        first = np.searchsorted(at, times - window, side="right") - 1
        last = np.searchsorted(at, times + window, side="left")
        before, after = (times - at[first])[:, None], (at[last] - times)[:, None]
        apart = (before + after) / 2
        bent = np.abs((rows[last] - q) / after - (q - rows[first]) / before) / apart
        outside = ((first == 0) * 1.0 + (last == len(at) - 1))[:, None]
        room = unsure / before + unsure / after + outside * rest_slack * robot.velocity
        over = ~(bent <= share * limit + room / apart) & (limit > 0)
        for j in np.flatnonzero(over.any(axis=0)):
            name, most = robot.joint_names[j], bent[over[:, j], j].max()
            what = "mean acceleration by its positions"
            yield f"motion: {name} exceeds its limit of {what}: {most:.4g} > {limit[j]:.4g}"
        if over.any():
            return


def _largest_chord_error(motion: Trajectory, times: Float[ndarray, "n"]) -> float:
    """Upper bound on how far the cubics leave the straight lines between certified configurations [rad] or
    [m].

    It is an eighth of the greatest second derivative times the square of the time between configurations. The
    second derivative is linear in time, so its greatest value is at an end.
    """
    row = np.clip(np.searchsorted(motion.times, times[:-1], side="right") - 1, 0, len(motion.times) - 2)
    h = (motion.times[row + 1] - motion.times[row])[:, None]
    mean = (motion.positions[row + 1] - motion.positions[row]) / h
    v0, v1 = motion.velocities[row], motion.velocities[row + 1]
    most = np.zeros_like(mean)
    for end in (times[:-1], times[1:]):
        u = (end - motion.times[row])[:, None] / h
        most = np.maximum(most, np.abs((6 * u - 4) * v0 + (6 * u - 2) * v1 + (6 - 12 * u) * mean) / h)
    return float((most * np.diff(times)[:, None] ** 2 / 8).max(initial=0.0))


def at_goal(robot: Robot, goal: Goal, q: Float[ndarray, "dof"], tolerances: Tolerances) -> bool:
    """Whether a configuration is at a goal."""
    if isinstance(goal, AnyGoal):
        return any(at_goal(robot, one, q, tolerances) for one in goal.goals)
    if isinstance(goal, PosesGoal):
        return all(at_goal(robot, one, q, tolerances) for one in goal.poses)
    if isinstance(goal, JointGoal):
        off = goal.positions - q
        off = np.where(robot.continuous, np.arctan2(np.sin(off), np.cos(off)), off)
        return bool((np.abs(off) <= tolerances.goal_tolerance).all(axis=1).any())
    linkage = Linkage(robot)
    T = linkage.place(q[None]).T[0, linkage.links.index(goal.frame)]
    xyz = goal.T_base_frame[:3, :3].T @ (T[:3, 3] - goal.T_base_frame[:3, 3])
    turn = goal.T_base_frame[:3, :3].T @ T[:3, :3]
    if goal.xyz_tolerance is None:
        there = bool(np.linalg.norm(xyz) <= tolerances.goal_distance)
    else:
        there = bool((np.abs(xyz) <= goal.xyz_tolerance + tolerances.goal_slack).all())
    if goal.rpy_tolerance is None:
        angle = np.arccos(np.clip((np.trace(turn) - 1) / 2, -1.0, 1.0))
        return there and bool(angle <= tolerances.goal_angle + tolerances.goal_slack)
    roll, pitch = np.arctan2(turn[2, 1], turn[2, 2]), np.arcsin(np.clip(-turn[2, 0], -1.0, 1.0))
    yaw = np.arctan2(turn[1, 0], turn[0, 0])
    ways = np.array([[roll, pitch, yaw], [roll + np.pi, np.pi - pitch, yaw + np.pi]])
    ways = (ways + np.pi) % (2 * np.pi) - np.pi
    return there and bool((np.abs(ways) <= goal.rpy_tolerance + tolerances.goal_slack).all(axis=1).any())
