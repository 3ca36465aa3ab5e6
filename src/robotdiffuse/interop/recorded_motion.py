"""Motions read from files of other programs, and their conversion to motions of a robot."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.core.errors import InputError, joined
from robotdiffuse.core.types import Path, Trajectory, check_increasing, check_motion_arrays
from robotdiffuse.problems.goals import JointGoal
from robotdiffuse.problems.problem import Problem
from robotdiffuse.robots.robot import MOVING_KINDS, Robot
from robotdiffuse.scenes.scene import Scene

STATIONARY_TOLERANCE = 1e-6
"""A joint that moves less than this counts as stationary [rad] or [m]."""
LOCKED_TOLERANCE = 1e-4
"""Largest distance of a joint from the value that the problem locks it at [rad] or [m]."""
MAX_NAMES = 6
"""Most joint names in a message."""


@dataclass(frozen=True, eq=False)
class RecordedMotion:
    """A checked motion of any joints, in any order; absent rates are None."""

    joint_names: tuple[str, ...]
    positions: Float[ndarray, "n joints"]
    times: Float[ndarray, "n"] | None = None
    """[s]; None if the rows are waypoints."""
    velocities: Float[ndarray, "n joints"] | None = None
    accelerations: Float[ndarray, "n joints"] | None = None
    notes: tuple[str, ...] = ()


def checked_motion(
    names: object,
    positions: object,
    times: object = None,
    velocities: object = None,
    accelerations: object = None,
) -> RecordedMotion:
    """Check the parts of a motion and return it.

    Empty rates count as absent. Times are shifted to begin at 0; times that are all 0 count as absent. Raises
    InputError as `check_motion_arrays` does, and for times that do not increase.
    """
    given = {"times": times, "velocities": velocities, "accelerations": accelerations}
    arrays = {name: value for name, value in given.items() if not _empty(value)}
    joints, checked = check_motion_arrays(names, {"positions": positions, **arrays})
    if "times" not in checked:
        return RecordedMotion(joints, checked["positions"])
    t = checked["times"]
    if len(t) > 1 and not t.any():
        note = "all times are 0: the motion is validated as a path"
        return RecordedMotion(joints, checked["positions"], notes=(note,))
    check_increasing(t)
    notes = () if t[0] == 0 else (f"times begin at {t[0]:.9g} s; they were shifted to 0",)
    return RecordedMotion(joints, **checked | {"times": t - t[0]}, notes=notes)


def _empty(rates: object) -> bool:
    """Whether the value is None, or a list of empty rows."""
    if rates is None:
        return True
    try:
        return all(len(row) == 0 for row in rates)  # type: ignore[attr-defined, arg-type, union-attr]
    except TypeError:
        return False


@dataclass(frozen=True, eq=False)
class RobotMotion:
    """A recorded motion as one of a robot's planned joints, and notes on what the conversion changed or left
    out."""

    motion: Path | Trajectory
    notes: tuple[str, ...]


def motion_of_robot(motion: RecordedMotion, robot: Robot) -> RobotMotion:
    """The motion of a robot's planned joints, matched by name.

    The recording may contain other joints of the robot, if they stay at their locked values. Absent
    velocities become those of the cubic spline from rest to rest through the rows, absent accelerations the
    means of those of the cubics before and after each row. Raises InputError for missing or unknown joints,
    and for other joints that leave their locked values.
    """
    notes = list(motion.notes)
    given = {name: j for j, name in enumerate(motion.joint_names)}
    known = {joint.name for joint in robot.joints if joint.kind in MOVING_KINDS}
    unknown = [name for name in given if name not in known]
    absent = [name for name in robot.joint_names if name not in given]
    if absent or unknown:
        parts = [f"lacks {joined(absent, MAX_NAMES)}"] if absent else []
        parts += [f"has {joined(unknown, MAX_NAMES)}, which {robot.name} lacks"] if unknown else []
        right = joined(robot.joint_names, MAX_NAMES)
        raise InputError(f"the motion {' and '.join(parts)}; the robot's joints are {right}")
    for name in given:
        if name not in robot.joint_names:
            _check_locked(motion.positions[:, given[name]], name, robot)
    extra = [name for name in given if name not in robot.joint_names]
    if extra:
        notes.append(f"{joined(extra, MAX_NAMES)} stay at their locked values")
    order = [given[name] for name in robot.joint_names]
    if order != sorted(order):
        notes.append("joints were reordered by name")
    q = motion.positions[:, order]
    turns = robot.wraps(q)
    if turns.any():
        q = q - np.concatenate([turns[:1] * 0, np.cumsum(turns, axis=0)])
        wrapped = [robot.joint_names[j] for j in np.flatnonzero(turns.any(axis=0))]
        notes.append(f"values of {joined(wrapped, MAX_NAMES)} jump by whole turns; they were unwrapped")
    if motion.times is None:
        return RobotMotion(Path(robot.joint_names, q), tuple(notes))
    v = None if motion.velocities is None else motion.velocities[:, order]
    a = None if motion.accelerations is None else motion.accelerations[:, order]
    if v is None:
        v = _spline_velocities(motion.times, q)
        notes.append("no velocities are given: those of a cubic spline from rest to rest are validated")
    if a is None:
        a = _mean_accelerations(Trajectory(robot.joint_names, motion.times, q, v, np.zeros_like(v)))
        notes.append("no accelerations are given: those of the cubics through the rows are validated")
    return RobotMotion(Trajectory(robot.joint_names, motion.times, q, v, a), tuple(notes))


def _check_locked(values: Float[ndarray, "n"], name: str, robot: Robot) -> None:
    held = robot.locked.get(name, 0.0)
    low, high = float(values.min()), float(values.max())
    if high - low > STATIONARY_TOLERANCE + LOCKED_TOLERANCE:
        raise InputError(
            f"the motion moves {name} from {low:.6g} to {high:.6g}, which the problem locks at {held:.6g}"
        )
    if max(abs(low - held), abs(high - held)) > LOCKED_TOLERANCE:
        raise InputError(
            f"the motion has {name} at {low:.6g}, the problem locks it at {held:.6g}: "
            f"write `locked: {{{name}: {low:.6g}}}` in the problem if that is right"
        )


def _spline_velocities(times: Float[ndarray, "n"], q: Float[ndarray, "n dof"]) -> Float[ndarray, "n dof"]:
    """Velocities of the cubic spline through the rows that starts and ends at rest."""
    if len(times) < 2:
        return np.zeros_like(q)
    from scipy.interpolate import CubicSpline

    return CubicSpline(times, q, bc_type="clamped")(times, 1)


def _mean_accelerations(motion: Trajectory) -> Float[ndarray, "n dof"]:
    """Means of the accelerations of the cubics before and after each row."""
    if len(motion.times) < 2:
        return np.zeros_like(motion.velocities)
    start, end = motion.cubic_accelerations
    return (np.concatenate([start[:1], end]) + np.concatenate([start, end[-1:]])) / 2


def problem_of_motion(motion: RecordedMotion, robot: Robot, scene: Scene) -> Problem:
    """The problem in a scene whose start and goal are those of a motion; its other joints are locked at their
    first values."""
    held = {j.name for j in robot.joints if j.kind in MOVING_KINDS and j.mimic is None}
    held -= set(robot.joint_names)
    at = {name: float(motion.positions[0, j]) for j, name in enumerate(motion.joint_names) if name in held}
    robot = robot.with_locked(at)
    motion = replace(motion, notes=())
    q = motion_of_robot(motion, robot).motion.positions
    return Problem(robot, scene, q[0], JointGoal(q[-1:]))
