"""Reads motions from files of other programs, and converts them to motions of a robot; writes YAML.

The formats are JSON, YAML and CSV, with ROS and MoveIt messages or RobotDiffuse's own records. Also publishes
motions through rosbridge.
"""

import csv
from collections.abc import Mapping
from pathlib import Path as FilePath
from time import sleep
from typing import Any

import numpy as np
import yaml
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.core.errors import InputError, counted, joined, needs, reading, shown
from robotdiffuse.core.files import MAX_YAML_SIZE, parse_yaml, read_json, read_text, write_atomically
from robotdiffuse.core.types import (
    RATES,
    ROWS,
    Configurations,
    JointRows,
    JointValues,
    Path,
    Trajectory,
    Values,
    check_increasing,
    check_motion_arrays,
    frozen_dataclass,
)
from robotdiffuse.problems.moveit import at_state
from robotdiffuse.problems.problem import JointGoal, Problem
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene import Scene

STATIONARY_TOLERANCE = 1e-6
"""Allowance for the rounding of recorded values: a locked joint may move by the sum of this and
LOCKED_TOLERANCE [rad] or [m]."""
LOCKED_TOLERANCE = 1e-4
"""Largest distance of a joint from the value that the problem locks it at [rad] or [m]."""
MAX_NAMES = 6
"""Largest number of joint names in a message."""


@frozen_dataclass
class RecordedMotion:
    """A checked motion of any joints, in any order; velocities and accelerations that the recording lacks are
    None."""

    joint_names: tuple[str, ...]
    positions: Float[ndarray, "n joints"]
    times: Values | None = None
    """Times of the rows [s]; None if the rows are waypoints of a path."""
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
    """The motion with these parts, after checking them.

    Empty times, velocities and accelerations count as absent. If there are several rows and all their times
    are 0, the times count as absent too. If there are no times, the velocities and accelerations are left
    out, with a note. Times are shifted to begin at 0. Raises InputError as `check_motion_arrays` does, and
    for times that do not increase.
    """
    optional_fields = {"times": times, "velocities": velocities, "accelerations": accelerations}
    arrays = {name: value for name, value in optional_fields.items() if not _empty(value)}
    joints, checked = check_motion_arrays(names, {"positions": positions, **arrays})
    if "times" not in checked:
        rates = joined(checked.keys() - {"positions"})
        notes = (f"there are no times: {rates} are ignored, and the motion is validated as a path",)
        return RecordedMotion(joints, checked["positions"], notes=notes if rates else ())
    t = checked["times"]
    if len(t) > 1 and not t.any():
        note = "all times are 0: the motion is validated as a path"
        return RecordedMotion(joints, checked["positions"], notes=(note,))
    check_increasing(t)
    notes = () if t[0] == 0 else (f"times begin at {t[0]:.9g} s; they were shifted to 0",)
    return RecordedMotion(joints, **checked | {"times": t - t[0]}, notes=notes)


def _empty(value: object) -> bool:
    """Whether the value is None, or a list of empty rows."""
    if value is None:
        return True
    try:
        return all(len(row) == 0 for row in value)  # type: ignore[attr-defined, arg-type, union-attr]
    except TypeError:
        return False


@frozen_dataclass
class RobotMotion:
    """A recorded motion, converted to the planned joints of a robot, with notes on what the conversion
    changed or left out."""

    motion: Path | Trajectory
    notes: tuple[str, ...]


def motion_of_robot(motion: RecordedMotion, robot: Robot, problem: Problem | None = None) -> RobotMotion:
    """The motion of a robot's planned joints, matched by name.

    Jumps of continuous joints by whole turns are removed, also from the start of a problem to the first row.
    The recording may contain other joints of the robot, if these stay at their locked values. Missing
    velocities are those of the cubic spline through the rows that ends at rest and starts at the problem's
    `start_velocity`, without it at rest. A missing acceleration is the mean of the accelerations of the two
    cubics that meet at its row.

    Raises InputError for missing or unknown joints, and for other joints that leave their locked values.
    """
    notes = list(motion.notes)
    columns = {name: j for j, name in enumerate(motion.joint_names)}
    movable = {joint.name for joint in robot.joints if joint.movable}
    unknown = [name for name in columns if name not in movable]
    absent = [name for name in robot.joint_names if name not in columns]
    if absent or unknown:
        parts = [f"lacks {joined(absent, MAX_NAMES)}"] if absent else []
        parts += [f"has {joined(unknown, MAX_NAMES)}, which {robot.name} lacks"] if unknown else []
        right = joined(robot.joint_names, MAX_NAMES)
        raise InputError(f"the motion {' and '.join(parts)}; the robot's joints are {right}")
    extra = [name for name in columns if name not in robot.joint_names]
    for name in extra:
        _check_locked(motion.positions[:, columns[name]], name, robot)
    if extra:
        notes.append(f"{joined(extra, MAX_NAMES)} stay at their locked values")
    order = [columns[name] for name in robot.joint_names]
    if order != sorted(order):
        notes.append("joints were reordered by name")
    q = motion.positions[:, order]
    start = q[0] if problem is None else problem.start
    turns = robot.wraps(np.vstack([start, q]))
    if turns.any():
        q = q - np.cumsum(turns, axis=0)
        wrapped = [robot.joint_names[j] for j in np.flatnonzero(turns.any(axis=0))]
        notes.append(f"values of {joined(wrapped, MAX_NAMES)} jump by whole turns; they were unwrapped")
    if motion.times is None:
        return RobotMotion(Path(robot.joint_names, q), tuple(notes))
    v = None if motion.velocities is None else motion.velocities[:, order]
    a = None if motion.accelerations is None else motion.accelerations[:, order]
    if v is None:
        start_velocity = None if problem is None else problem.start_velocity
        v = _spline_velocities(
            motion.times, q, np.zeros(robot.dof) if start_velocity is None else start_velocity
        )
        begin = "rest" if start_velocity is None else "start_velocity"
        notes.append(f"no velocities are given: those of a cubic spline from {begin} to rest are validated")
    if a is None:
        a = _mean_accelerations(Trajectory(robot.joint_names, motion.times, q, v, np.zeros_like(v)))
        notes.append("no accelerations are given: those of the cubics through the rows are validated")
    return RobotMotion(Trajectory(robot.joint_names, motion.times, q, v, a), tuple(notes))


def _check_locked(values: Values, name: str, robot: Robot) -> None:
    locked_value = robot.locked.get(name, 0.0)
    low = float(values.min())
    high = float(values.max())
    if high - low > STATIONARY_TOLERANCE + LOCKED_TOLERANCE:
        raise InputError(
            f"the motion moves {name} between {low:.6g} and {high:.6g}; "
            f"the problem locks it at {locked_value:.6g}"
        )
    if max(abs(low - locked_value), abs(high - locked_value)) > LOCKED_TOLERANCE:
        raise InputError(
            f"the motion has {name} at {low:.6g}, the problem locks it at {locked_value:.6g}: "
            f"write `locked: {{{name}: {low:.6g}}}` in the problem if that is right"
        )


def _spline_velocities(times: Values, q: Configurations, start: JointValues) -> JointRows:
    """Velocities of the cubic spline through the rows that begins at velocities `start` and ends at rest."""
    if len(times) < 2:
        return np.tile(start, (len(q), 1))
    from scipy.interpolate import CubicSpline

    ends: Any = ((1, start), (1, np.zeros_like(start)))
    return CubicSpline(times, q, bc_type=ends)(times, 1)


def _mean_accelerations(motion: Trajectory) -> JointRows:
    """Means of the accelerations of the cubics before and after each row."""
    if len(motion.times) < 2:
        return np.zeros_like(motion.velocities)
    start, end = motion.cubic_accelerations
    return (np.concatenate([start[:1], end]) + np.concatenate([start, end[-1:]])) / 2


def problem_of_motion(motion: RecordedMotion, robot: Robot, scene: Scene) -> Problem:
    """A problem in the scene, from the first to the last row of the motion. Joints of the recording that are
    not planned are locked at their values in the first row."""
    robot = at_state(robot, dict(zip(motion.joint_names, motion.positions[0].tolist(), strict=True)))
    q = motion_of_robot(motion, robot).motion.positions
    return Problem(robot, scene, q[0], JointGoal(q[-1:]))


JOINT_TRAJECTORY = "trajectory_msgs/msg/JointTrajectory"
MATCH_TIME = 0.5
"""Waiting time before the message is sent, so that subscribers match the publisher, and after it was sent, so
that they receive the message [s]."""
TIMES = ("time", "t", "time_from_start", "timestamp")
"""Names that the column of times may have."""
KINDS = {"position": "positions", "velocity": "velocities", "acceleration": "accelerations"}
"""Quantity of a column, by the ending of the column's name."""
SUPPORTED = (
    "it must hold a RobotDiffuse result, trajectory or path (joint_names and waypoints), a JointTrajectory, "
    "RobotTrajectory or DisplayTrajectory"
)


def read_json_file(file: FilePath, topic: str | None) -> RecordedMotion:
    """Read a result, a trajectory, or a ROS or MoveIt message in the JSON form of rosbridge."""
    return motion_from_record(read_json(file), str(file))


def read_yaml(file: FilePath, topic: str | None) -> RecordedMotion:
    """Read a JointTrajectory, RobotTrajectory or DisplayTrajectory, as `ros2 topic echo` prints it."""
    text = read_text(file, largest=MAX_YAML_SIZE).rstrip()
    text = text.removesuffix("---")  # the end of a message
    return motion_from_record(parse_yaml(text, str(file)), str(file))


def write_yaml(problem: Problem, trajectory: Trajectory, file: FilePath) -> None:
    """Write a JointTrajectory as `ros2 topic pub` takes it; see `interop.write_motion`."""
    record = joint_trajectory(trajectory)
    text = yaml.dump(record, Dumper=yaml.CSafeDumper, sort_keys=False, default_flow_style=None, width=110)
    write_atomically(file, text)


def read_csv(file: FilePath, topic: str | None) -> RecordedMotion:
    """Read a motion in the columns of `Trajectory.save`: time, then NAME or NAME_position for each joint, and
    optionally NAME_velocity and NAME_acceleration. Without time, the rows are waypoints."""
    with reading(file):
        return _table(read_text(file))


def motion_from_record(record: Any, where: str) -> RecordedMotion:
    """The motion in a record. Raises InputError, naming `where`, for a record without a valid motion."""
    with reading(where):
        return _motion(record)


def _motion(record: Any) -> RecordedMotion:
    if not isinstance(record, Mapping):
        raise InputError(f"it is {shown(record)}; {SUPPORTED}")
    if record.get("status", "solved") != "solved":
        raise InputError(f"it holds no motion: its status is {shown(record['status'])}")
    if "trajectory" in record:
        return _only(record["trajectory"])
    if "joint_trajectory" in record:
        multi_dof = record.get("multi_dof_joint_trajectory") or {}
        if isinstance(multi_dof, Mapping) and multi_dof.get("points"):
            raise InputError(
                "multi_dof_joint_trajectory has points; only arms on a fixed base can be validated"
            )
        return _motion(record["joint_trajectory"])
    if "points" in record:
        return _joint_trajectory(record)
    if record.get("times"):
        q, t, v, a = (record.get(name) for name in ("positions", "times", *RATES))
        return checked_motion(record.get("joint_names"), q, t, v, a)
    for name in ("waypoints", "positions"):
        if record.get(name):
            return checked_motion(record.get("joint_names"), record[name])
    raise InputError(f"it holds no motion: {SUPPORTED}")


def _only(trajectories: Any) -> RecordedMotion:
    """The only motion in a field `trajectory`: a list in a DisplayTrajectory, one motion in a MoveIt
    response."""
    if isinstance(trajectories, Mapping):
        return _motion(trajectories)
    if not isinstance(trajectories, list) or len(trajectories) != 1:
        count = (
            f"has {counted(len(trajectories), 'part')}"
            if isinstance(trajectories, list)
            else f"is {shown(trajectories)}"
        )
        raise InputError(f"trajectory {count}; it must be a trajectory, or a list of one")
    return _motion(trajectories[0])


def _joint_trajectory(record: Mapping[str, Any]) -> RecordedMotion:
    points = record["points"]
    if not isinstance(points, list) or not points:
        raise InputError(f"points is {shown(points)}; it must be a list of at least one row")
    for i, point in enumerate(points):
        if not isinstance(point, Mapping):
            raise InputError(f"points[{i}] is {shown(point)}; it must be a JointTrajectoryPoint")
    rows = {name: [_list(point.get(name)) for point in points] for name in ROWS}
    times = [
        _seconds(f"points[{i}].time_from_start", p.get("time_from_start", 0)) for i, p in enumerate(points)
    ]
    for name in RATES:
        has_values = [len(row) > 0 for row in rows[name]]
        if any(has_values) and not all(has_values):
            raise InputError(f"points[{has_values.index(False)}] has no {name}; other points have them")
    q, v, a = rows.values()
    return checked_motion(_list(record.get("joint_names")), q, times, v, a)


def _list(value: Any) -> list[Any]:
    return [] if value is None else list(value) if isinstance(value, list | tuple) else [value]


def _seconds(where: str, value: Any) -> float:
    """Seconds of a duration of ROS 2 (sec, nanosec), ROS 1 (secs, nsecs) or Foxglove (sec, nsec), or of a
    plain number."""
    parts: tuple[Any, Any] = (value, 0)
    if isinstance(value, Mapping):
        for seconds_name, nanoseconds_name in (("sec", "nanosec"), ("secs", "nsecs"), ("sec", "nsec")):
            if seconds_name in value and not value.keys() - {seconds_name, nanoseconds_name, "__msgtype__"}:
                parts = (value[seconds_name], value.get(nanoseconds_name, 0))
    if not all(isinstance(part, int | float) and not isinstance(part, bool) for part in parts):
        raise InputError(f"{where} is {shown(value)}; it must be a duration: sec and nanosec")
    return float(parts[0]) + 1e-9 * float(parts[1])


def time_message(nanoseconds: int) -> dict[str, int]:
    """A time or a duration as a message in plain data."""
    sec, nanosec = divmod(nanoseconds, 10**9)
    return {"sec": sec, "nanosec": nanosec}


def joint_trajectory(trajectory: Trajectory) -> dict[str, Any]:
    """A trajectory as a trajectory_msgs/msg/JointTrajectory in plain data.

    Raises InputError for rows less than 1 ns apart, which controllers would refuse.
    """
    nanoseconds = np.round(1e9 * trajectory.times).astype(int)
    late = np.flatnonzero(np.diff(nanoseconds) <= 0)
    if len(late):
        raise InputError(
            f"rows {late[0]} and {late[0] + 1} are less than 1 ns apart, which ROS cannot express; resample "
            "the motion, as --rate does"
        )
    points = [
        {name: getattr(trajectory, name)[i].tolist() for name in ROWS}
        | {"effort": [], "time_from_start": time_message(at)}
        for i, at in enumerate(nanoseconds.tolist())
    ]
    header = {"stamp": time_message(0), "frame_id": ""}
    return {"header": header, "joint_names": list(trajectory.joint_names), "points": points}


def _table(text: str) -> RecordedMotion:
    try:
        reader = csv.reader(text.splitlines())
        rows = [(reader.line_num, row) for row in reader if any(cell.strip() for cell in row)]
    except csv.Error as error:
        raise InputError(f"it is not valid CSV: {error}") from None
    if not rows:
        raise InputError("it is empty; it must have a header and rows of numbers")
    header = [cell.strip() for cell in rows[0][1]]
    # `Trajectory.save` puts a quote before names that a spreadsheet would take for formulas
    header = [cell[1:] if cell[:1] == "'" and cell[1:2] in "=+-@" else cell for cell in header]
    if "" in header:  # such as the index that pandas writes
        raise InputError(f"column {header.index('') + 1} of the header has no name; leave it out, or name it")
    if len(rows) == 1:
        raise InputError("it has a header and no rows")
    columns: list[list[float]] = [[] for _ in header]
    for number, row in rows[1:]:
        if len(row) != len(header):
            raise InputError(f"line {number} has {counted(len(row), 'cell')}; the header has {len(header)}")
        for name, column, cell in zip(header, columns, row, strict=True):
            try:
                column.append(float(cell))
            except ValueError:
                raise InputError(f"line {number}: {name} is {shown(cell)}; it must be a number") from None
    times: list[float] | None = None
    columns_of: dict[str, dict[str, list[float]]] = {quantity: {} for quantity in KINDS.values()}
    for name, column in zip(header, columns, strict=True):
        if name.lower() in TIMES and times is None:
            times = column
            continue
        joint, _, kind = name.rpartition("_")
        quantity = KINDS.get(kind, "positions")
        joint = joint if kind in KINDS else name
        if joint in columns_of[quantity]:
            raise InputError(f"the header has {quantity} of {shown(joint)} more than once")
        columns_of[quantity][joint] = column
    names = list(columns_of["positions"])
    for quantity in RATES:
        incomplete = sorted(columns_of[quantity].keys() ^ {*names})
        if columns_of[quantity] and incomplete:
            raise InputError(
                f"the header must have both positions and {quantity} of {joined(incomplete)}, or neither"
            )
    table = {
        quantity: np.transpose([of_joint[name] for name in names]) if of_joint else None
        for quantity, of_joint in columns_of.items()
    }
    q, v, a = table.values()
    return checked_motion(names, q, times, v, a)


def publish(trajectory: Trajectory, host: str, port: int, topic: str, timeout: float) -> None:
    """Publish a trajectory once through rosbridge, as a JointTrajectory. The caller must have validated it.

    ROS does not confirm deliveries, so the caller does not learn whether a subscriber received the message.
    Raises InputError if roslibpy is not installed, if no rosbridge answers within `timeout` [s], and for rows
    less than 1 ns apart.
    """
    with needs("roslibpy", "ros"):
        import roslibpy
    ros = roslibpy.Ros(host, port)
    try:
        ros.run(timeout=timeout)  # type: ignore[arg-type]
    except Exception:
        ros.close()
        raise InputError(f"no rosbridge answers at {host}:{port} within {timeout:g} s") from None
    try:
        publisher = roslibpy.Topic(ros, topic, JOINT_TRAJECTORY, latch=True)
        publisher.advertise()
        sleep(MATCH_TIME)
        publisher.publish(roslibpy.Message(joint_trajectory(trajectory)))
        sleep(MATCH_TIME)
        publisher.unadvertise()
    finally:
        ros.close()
