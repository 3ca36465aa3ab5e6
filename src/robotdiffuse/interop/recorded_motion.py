"""Recorded: a motion as somebody else wrote it, and what of it a robot is to do."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.core.bounds import MAX_COORDINATE, MAX_RATE, numbers, within
from robotdiffuse.core.errors import InputError, joined, shown
from robotdiffuse.core.types import Path, Trajectory
from robotdiffuse.problems.goals import JointGoal
from robotdiffuse.problems.problem import Problem
from robotdiffuse.robots.robot import MOVING_KINDS, Robot
from robotdiffuse.scenes.scene import Scene

STANDS_STILL = 1e-6
"""A joint that moves less than this does not move [rad] or [m]."""
HELD = 1e-4
"""How far from where the problem holds it a joint may stand [rad] or [m]."""
MOST_NAMED = 6


@dataclass(frozen=True, eq=False)
class Recorded:
    """Rows of joint values, in any order, of any joints. Rates that are not there are None."""

    joint_names: tuple[str, ...]
    positions: Float[ndarray, "n joints"]
    times: Float[ndarray, "n"] | None = None
    """[s]; None: waypoints."""
    velocities: Float[ndarray, "n joints"] | None = None
    accelerations: Float[ndarray, "n joints"] | None = None
    notes: tuple[str, ...] = ()


def recorded(
    names: object,
    positions: object,
    times: object = None,
    velocities: object = None,
    accelerations: object = None,
    notes: tuple[str, ...] = (),
) -> Recorded:
    """The motion, if it is one: InputError for names that are none or twice there, no rows, rows of different
    lengths, numbers that are not finite, and times that do not increase.

    Rates that are empty count as not there; times that begin later begin at 0, those that are all 0 count as
    none.
    """
    if not isinstance(names, list | tuple) or not names or not all(isinstance(n, str) and n for n in names):
        raise InputError(f"joint_names is {shown(names)}; it must be a list of names, not empty")
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise InputError(f"joint_names has {', '.join(twice)} more than once")
    q = _rows("positions", positions, len(names), MAX_COORDINATE)
    v, a = (
        None if _empty(rates) else _rows(what, rates, len(names), MAX_RATE)
        for what, rates in (("velocities", velocities), ("accelerations", accelerations))
    )
    for what, rates in (("velocities", v), ("accelerations", a)):
        if rates is not None and len(rates) != len(q):
            raise InputError(f"{what} has {len(rates)} rows; positions has {len(q)}")
    t, more = _times(times, len(q))
    return Recorded(
        tuple(names), q, t, v if t is not None else None, a if t is not None else None, notes + more
    )


def _empty(rates: object) -> bool:
    """Whether there is nothing, or a list of nothing."""
    if rates is None:
        return True
    try:
        return all(len(row) == 0 for row in rates)  # type: ignore[attr-defined, arg-type, union-attr]
    except TypeError:
        return False


def _rows(what: str, value: object, columns: int, most: float) -> Float[ndarray, "n columns"]:
    array = numbers(value)
    if array is not None and array.size == 0:
        raise InputError(f"{what} is empty: a motion has at least one row")
    if array is None or array.ndim != 2 or array.shape[1] != columns:
        found = "not rows of numbers" if array is None else f"of shape {'x'.join(map(str, array.shape))}"
        raise InputError(f"{what} is {found}; it must be rows of {columns} numbers, one for each joint")
    if not within(array, most):
        row = int(np.flatnonzero(~(np.abs(array) <= most).all(axis=1))[0])
        raise InputError(
            f"{what}[{row}] is {shown(array[row])}; its numbers must be finite and within ±{most:g}"
        )
    return array


def _times(value: object, count: int) -> tuple[Float[ndarray, "n"] | None, tuple[str, ...]]:
    if _empty(value):
        return None, ()
    times = numbers(value)
    if times is None or times.shape != (count,):
        raise InputError(f"times is {shown(value)}; it must be {count} numbers, one for each row")
    if not np.isfinite(times).all():
        row = int(np.flatnonzero(~np.isfinite(times))[0])
        raise InputError(f"times[{row}] is {times[row]}; it must be a finite number")
    if count > 1 and not times.any():
        return None, ("all times are 0: the motion is validated as a path",)
    backwards = np.flatnonzero(np.diff(times) <= 0)
    if len(backwards):
        i = int(backwards[0])
        raise InputError(
            f"times do not increase: {times[i]:g} s in row {i}, {times[i + 1]:g} s in row {i + 1}"
        )
    note = () if times[0] == 0 else (f"times begin at {times[0]:.9g} s, counted from there",)
    return times - times[0], note


@dataclass(frozen=True, eq=False)
class Fitted:
    """What a robot is to do."""

    motion: Path | Trajectory
    notes: tuple[str, ...]


def fitted(motion: Recorded, robot: Robot) -> Fitted:
    """The motion of a robot's planned joints, by their names.

    Other joints of the robot may be there where they stand still where the robot holds them. Velocities that
    are not there are those of the smoothest curve from rest to rest through the rows, accelerations the means
    of the changes of velocity around each row. Raises InputError for joints that are missing, unknown, or
    held elsewhere.
    """
    notes = list(motion.notes)
    given = {name: j for j, name in enumerate(motion.joint_names)}
    known = {joint.name for joint in robot.joints if joint.kind in MOVING_KINDS}
    unknown = [name for name in given if name not in known]
    absent = [name for name in robot.joint_names if name not in given]
    if absent or unknown:
        parts = [f"lacks {joined(absent, MOST_NAMED)}"] if absent else []
        parts += [f"has {joined(unknown, MOST_NAMED)}, which {robot.name} has not"] if unknown else []
        right = joined(robot.joint_names, MOST_NAMED)
        raise InputError(f"the motion {' and '.join(parts)}; the robot's joints are {right}")
    for name in given:
        if name not in robot.joint_names:
            _check_held(motion.positions[:, given[name]], name, robot)
    extra = [name for name in given if name not in robot.joint_names]
    if extra:
        notes.append(f"{joined(extra, MOST_NAMED)} stand still where the robot holds them")
    order = [given[name] for name in robot.joint_names]
    if order != sorted(order):
        notes.append("joints were put into the robot's order by their names")
    q = motion.positions[:, order]
    if motion.times is None:
        return Fitted(Path(robot.joint_names, q), tuple(notes))
    v = None if motion.velocities is None else motion.velocities[:, order]
    a = None if motion.accelerations is None else motion.accelerations[:, order]
    if v is None:
        v = _smoothest(motion.times, q)
        notes.append("no velocities are given: those of the smoothest curve from rest to rest are validated")
    if a is None:
        a = _changes(motion.times, v)
        notes.append("no accelerations are given: those of the velocities are validated")
    return Fitted(Trajectory(robot.joint_names, motion.times, q, v, a), tuple(notes))


def _check_held(values: Float[ndarray, "n"], name: str, robot: Robot) -> None:
    held = robot.locked.get(name, 0.0)
    low, high = float(values.min()), float(values.max())
    if high - low > STANDS_STILL + HELD:
        raise InputError(
            f"the motion moves {name} from {low:.6g} to {high:.6g}, which the problem holds at {held:.6g}"
        )
    if max(abs(low - held), abs(high - held)) > HELD:
        raise InputError(
            f"the motion has {name} at {low:.6g}, the problem holds it at {held:.6g}: "
            f"write `locked: {{{name}: {low:.6g}}}` in the problem if that is right"
        )


def _smoothest(times: Float[ndarray, "n"], q: Float[ndarray, "n dof"]) -> Float[ndarray, "n dof"]:
    """Velocities of the cubic spline through the rows that begins and ends at rest."""
    if len(times) < 2:
        return np.zeros_like(q)
    from scipy.interpolate import CubicSpline

    return CubicSpline(times, q, bc_type="clamped")(times, 1)


def _changes(times: Float[ndarray, "n"], v: Float[ndarray, "n dof"]) -> Float[ndarray, "n dof"]:
    if len(times) < 2:
        return np.zeros_like(v)
    change = np.diff(v, axis=0) / np.diff(times)[:, None]
    return (np.concatenate([change[:1], change]) + np.concatenate([change, change[-1:]])) / 2


def own_problem(motion: Recorded, robot: Robot, scene: Scene) -> Problem:
    """The problem that a motion solves in a scene: from where it begins to where it ends. Joints that it has
    beside the planned ones are held where they stand."""
    held = {j.name for j in robot.joints if j.kind in MOVING_KINDS and j.mimic is None}
    held -= set(robot.joint_names)
    at = {name: float(motion.positions[0, j]) for j, name in enumerate(motion.joint_names) if name in held}
    robot = robot.with_locked(at)
    motion = replace(motion, notes=())
    q = fitted(motion, robot).motion.positions
    return Problem(robot, scene, q[0], JointGoal(q[-1:]))
