"""The checker's own tests of all requirements but freedom from collision: limits, start, goal and rates."""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from robotdiffuse.certificates.constraints import constraint_bounds, frame_speed_errors
from robotdiffuse.certificates.cubics import Cubics, cubics_of
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
AGREEMENT = 0.5
"""Share of a joint's greatest acceleration by which written accelerations may leave those of the cubics
beside their row."""
REST_SHARE = 0.01
"""Accelerations below this share of a limit need not agree."""
JUMP = 1e-6
"""Where a jerk is stated, share of a joint's acceleration limit by which its acceleration may jump."""
MIN_JERK = 1e-6
"""Jerks below this are rounding errors [rad/s³] or [m/s³]."""
BLEND_SHARE, MAX_LOOKS = 0.25, 10_000
"""A blend is looked for at configurations at most this share of its radius apart, at most so many a step."""
MIN_TIME = 1e-12
"""Shorter times are taken as this [s], so that rates over them are finite."""


def configurations(motion: Path | Trajectory, between: Float[ndarray, "k"]) -> Float[ndarray, "n dof"]:
    """The rows of a motion and further configurations between them, in order.

    `between`: times [s], for which the configurations are on the cubics through the rows' positions and
    velocities; for a path, rows plus shares of the way to the next, on its straight lines.
    """
    if not len(between):
        return motion.positions
    cubics = cubics_of(motion)
    if cubics is None:
        rows = np.arange(len(motion.positions))
        places = np.sort(np.concatenate([rows, between]))
        return np.column_stack([np.interp(places, rows, joint) for joint in motion.positions.T])
    times = np.concatenate([motion.times, between])  # type: ignore[union-attr]
    q = np.concatenate([motion.positions, cubics.positions_at(between)])
    return q[np.argsort(times, kind="stable")]


def deviations(motion: Path | Trajectory, between: Float[ndarray, "k"]) -> Float[ndarray, "n1 dof"] | None:
    """How far a motion leaves the straight line from each of its `configurations` to the next; None for a
    path, which does not."""
    cubics = cubics_of(motion)
    if cubics is None:
        return None
    return cubics.deviations(np.sort(np.concatenate([motion.times, between])))  # type: ignore[union-attr]


def not_covered(problem: Problem, motion: Path | Trajectory) -> list[str]:
    """Requirements of the problem that no certificate of such a motion can prove."""
    untimed = not isinstance(motion, Trajectory)
    return ["moving, without times"] if untimed and problem.moving else []


def not_checked(problem: Problem, motion: Path | Trajectory) -> list[str]:
    """What the checker leaves to the validator, or cannot see, in words."""
    unchecked = ["sharp reversals"]
    if not isinstance(motion, Trajectory):
        unchecked.append("velocities, accelerations and times, which a path has not")
        unchecked += ["start_velocity"] if problem.start_velocity is not None else []
    return unchecked + (["what no view has seen"] if problem.views else [])


def requirement_errors(problem: Problem, certificate: MotionProof) -> Iterator[str]:
    """A line for each requirement that the motion fails, or is not shown to meet."""
    robot, motion, tolerances = problem.robot, certificate.motion, certificate.tolerances
    for name in not_covered(problem, motion):
        yield f"problem: certificates do not prove anything about {name}"
    q, cubics = configurations(motion, certificate.between), cubics_of(motion)
    every = motion.positions if cubics is None else np.concatenate([motion.positions, cubics.turns])
    beyond = np.maximum(robot.lower - every, every - robot.upper)
    beyond[:, robot.continuous] = 0.0
    for j in np.flatnonzero(~(beyond <= tolerances.limit_slack).all(axis=0)):
        yield f"motion: {robot.joint_names[j]} leaves its limits by {beyond[:, j].max():.3g}"
    off = np.abs(motion.positions[0] - problem.start).max(initial=0.0)
    if not off <= tolerances.start_tolerance:
        yield f"motion: it begins {off:.3g} off the start"
    if not at_goal(robot, problem.goal, motion.positions[-1:], tolerances).all():
        yield "motion: it does not end at the goal"
    yield from _waypoint_errors(problem, motion, tolerances)
    if isinstance(motion, Trajectory):
        begins = np.zeros(robot.dof) if problem.start_velocity is None else problem.start_velocity
        yield from _rate_errors(robot, motion, certificate, begins)
        yield from frame_speed_errors(problem, motion, tolerances.rate_slack)
        yield from _jerk_errors(robot, motion, certificate)
    yield from _constraint_errors(problem, certificate, q)
    yield from _torque_errors(problem, certificate)


def place_errors(problem: Problem, certificate: MotionProof) -> list[str]:
    """What would make the other tests meaningless: joints that are not the robot's, times that do not begin
    at 0 or do not increase, and places of the proof that are not on the motion."""
    motion, robot = certificate.motion, problem.robot
    if tuple(motion.joint_names) != robot.joint_names:
        return [f"motion: its joints are {joined(motion.joint_names)}, not {joined(robot.joint_names)}"]
    timed = isinstance(motion, Trajectory)
    clock = motion.times if timed else np.arange(len(motion.positions), dtype=float)
    if clock[0] != 0:
        return [f"motion: its times begin at {clock[0]:g} s, not at 0"]
    if not (np.diff(clock) > 0).all():
        return ["motion: its times do not increase"]
    for name, places in (("between", certificate.between), ("looks", certificate.torque_samples)):
        if not ((places > 0) & (places < clock[-1])).all() or len(np.unique(places)) < len(places):
            return [f"motion: the places of `{name}` do not lie between its rows"]
    if timed and np.isin(certificate.between, clock).any():
        return ["motion: the times of `between` do not lie between its rows"]
    return []


def cubic_jerks(robot: Robot, motion: Path | Trajectory) -> Float[ndarray, "dof"] | None:
    """The largest jerk of each joint along the cubics; None for a path, and where accelerations jump or are
    written otherwise."""
    cubics = cubics_of(motion)
    if cubics is None:
        return None
    most = np.where(robot.acceleration > 0, robot.acceleration, cubics.pulls.max(axis=0))
    written = motion.accelerations  # type: ignore[union-attr]
    off = np.maximum(np.abs(written[:-1] - cubics.start), np.abs(written[1:] - cubics.end))
    if not (cubics.jumps() <= JUMP * most).all() or not (off <= JUMP * most).all():
        return None
    return (np.abs(cubics.end - cubics.start) / cubics.steps).max(axis=0)


def _jerk_errors(robot: Robot, motion: Trajectory, certificate: MotionProof) -> Iterator[str]:
    """Jerks, where the proof states them, that are larger than it says."""
    stated = dict(certificate.jerks)
    if not stated:
        return
    if [name for name, _ in certificate.jerks] != [*motion.joint_names]:
        yield "jerks: their joints are not those of the motion"
        return
    most = cubic_jerks(robot, motion)
    if most is None:
        yield "jerks: accelerations jump, or are not those of the cubics"
        return
    for name, jerk in zip(stated, most, strict=True):
        if not jerk <= stated[name] * (1 + BOUND_TOLERANCE) + MIN_JERK:
            yield f"jerks: that of {name} is {jerk:.6g}, not {stated[name]:.6g}"


def _waypoint_errors(problem: Problem, motion: Path | Trajectory, tolerances: Tolerances) -> Iterator[str]:
    """The first waypoint at which the motion does not stop, or that it does not pass within its blend, after
    those before it."""
    robot, after = problem.robot, 0.0
    for k, (goal, blend) in enumerate(zip(problem.waypoints, problem.blend, strict=True)):
        rows = np.arange(len(motion.positions))
        if isinstance(motion, Trajectory):
            still = (np.abs(motion.velocities) <= tolerances.rest).all(axis=1)
        else:
            still = np.ones(len(rows), bool)
        places = rows[still].astype(float)
        if blend:
            # straight lines between rows, looked at more often than the blend is wide
            lengths = np.linalg.norm(np.diff(motion.positions, axis=0), axis=1)
            counts = np.clip(np.ceil(lengths / (BLEND_SHARE * blend)), 1, MAX_LOOKS).astype(int)
            within = [i + np.arange(count) / count for i, count in enumerate(counts)]
            places = np.concatenate([*within, rows[-1:]])
        places = places[places >= after]
        q = np.column_stack([np.interp(places, rows, joint) for joint in motion.positions.T])
        there = np.flatnonzero(at_goal(robot, goal, q, tolerances, blend))
        if not len(there):
            what = f"pass within {blend:g} of" if blend else "stop at"
            yield f"motion: it does not {what} waypoints[{k}] after those before it"
            return
        after = float(places[there[0]])


def _torque_errors(problem: Problem, certificate: MotionProof) -> Iterator[str]:
    """Torque limits that are not shown to be kept with the payload, and torques that differ from the
    proof."""
    motion, stated = certificate.motion, dict(certificate.torques)
    if problem.payload is None:
        if stated:
            yield "torques: the problem has no payload"
        return
    if [name for name, _ in certificate.torques] != [*problem.robot.joint_names]:
        yield "torques: their joints are not those of the robot"
        return
    most = torque_bounds(problem, motion, certificate.torque_samples).max(axis=0)
    allowed = problem.robot.effort * (1 + certificate.tolerances.rate_slack)
    for name, torque, limit in zip(stated, most, allowed, strict=True):
        if not abs(torque - stated[name]) <= BOUND_TOLERANCE:
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
        if not abs(most - stated) <= BOUND_TOLERANCE:
            yield f"constraints: the bound of {one.name} is {most:.6f}, not {stated:.6f}"
        if not most <= one.limit:
            yield f"constraints: {one.name} is not shown to be kept: {most:.6f} of {one.limit:.6f}"


def _rate_errors(
    robot: Robot, motion: Trajectory, certificate: MotionProof, begins: Float[ndarray, "dof"]
) -> Iterator[str]:
    tolerances, step = certificate.tolerances, np.diff(motion.times)[:, None]
    cubics, off = cubics_of(motion), deviations(motion, certificate.between)
    if off is not None and not off.max() <= tolerances.chord * (1 + 1e-6) + 1e-12:
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
    if cubics is not None:
        # velocities of cubics contain up to 3/2 of the mean velocity, accelerations 6 of it over the step
        along, bent = "velocity along its cubics", "acceleration along its cubics"
        rates += (along, cubics.speeds, robot.velocity), (bent, cubics.pulls, robot.acceleration)
        blur |= {along: 1.5 * unsure / step, bent: 6 * unsure / step**2}
        yield from _agreement_errors(robot, motion, cubics, begins, unsure)
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


def _agreement_errors(
    robot: Robot, motion: Trajectory, cubics: Cubics, begins: Float[ndarray, "dof"], unsure: float
) -> Iterator[str]:
    """Joints whose written accelerations are not near those of the cubics beside their rows."""
    before = np.concatenate([cubics.start[:1], cubics.end])
    after = np.concatenate([cubics.start, cubics.end[-1:]])
    off = np.maximum(np.minimum(before, after) - motion.accelerations, 0.0)
    off = np.maximum(off, motion.accelerations - np.maximum(before, after))
    if begins.any():
        off[0] = 0.0  # the motion before may have ended in any acceleration
    peak = np.maximum(cubics.pulls.max(axis=0), np.abs(motion.accelerations).max(axis=0))
    peak = np.maximum(peak, REST_SHARE * robot.acceleration)
    blur = 6 * unsure / cubics.steps**2
    room = np.maximum(np.concatenate([blur[:1], blur]), np.concatenate([blur, blur[-1:]]))
    for j in np.flatnonzero(~(off <= AGREEMENT * peak + room).all(axis=0)):
        name = robot.joint_names[j]
        yield f"motion: accelerations of {name} are {off[:, j].max():.4g} off those of its cubics"


def at_goal(
    robot: Robot, goal: Goal, q: Float[ndarray, "n dof"], tolerances: Tolerances, blend: float = 0.0
) -> Bool[ndarray, "n"]:
    """Which configurations are at a goal, or within `blend` of it: of a configuration in joint space, of a
    pose by its position or its box of tolerances."""
    if isinstance(goal, AnyGoal):
        return np.any([at_goal(robot, one, q, tolerances, blend) for one in goal.goals], axis=0)
    if isinstance(goal, PosesGoal):
        return np.all([at_goal(robot, one, q, tolerances, blend) for one in goal.poses], axis=0)
    if isinstance(goal, JointGoal):
        off = goal.positions - q[:, None]
        off = np.where(robot.continuous, np.arctan2(np.sin(off), np.cos(off)), off)
        there = (np.abs(off) <= tolerances.goal_tolerance).all(axis=2)
        return (there | (np.linalg.norm(off, axis=2) <= blend)).any(axis=1)
    linkage, T_goal = Linkage(robot), goal.T_base_frame
    T = linkage.place(q).T[:, linkage.links.index(goal.frame)]
    xyz, turn = (T[:, :3, 3] - T_goal[:3, 3]) @ T_goal[:3, :3], T_goal[:3, :3].T @ T[:, :3, :3]
    if goal.xyz_tolerance is None:
        there = np.linalg.norm(xyz, axis=1) <= max(tolerances.goal_distance, blend)
    else:
        beyond = np.maximum(np.abs(xyz) - goal.xyz_tolerance - tolerances.goal_slack, 0.0)
        there = np.linalg.norm(beyond, axis=1) <= blend
    if goal.rpy_tolerance is None:
        angle = np.arccos(np.clip((np.trace(turn, axis1=1, axis2=2) - 1) / 2, -1.0, 1.0))
        return there & (angle <= tolerances.goal_angle + tolerances.goal_slack)
    roll, pitch = np.arctan2(turn[:, 2, 1], turn[:, 2, 2]), np.arcsin(np.clip(-turn[:, 2, 0], -1.0, 1.0))
    yaw = np.arctan2(turn[:, 1, 0], turn[:, 0, 0])
    ways = np.stack([(roll, pitch, yaw), (roll + np.pi, np.pi - pitch, yaw + np.pi)])
    ways = (ways + np.pi) % (2 * np.pi) - np.pi
    allowed = (goal.rpy_tolerance + tolerances.goal_slack)[:, None]
    return there & (np.abs(ways) <= allowed).all(axis=1).any(axis=0)
