"""Motions in JSON, YAML and CSV: of ROS and MoveIt messages and of RobotDiffuse's own records; rosbridge."""

import csv
from collections.abc import Mapping
from pathlib import Path
from time import sleep
from typing import Any

import yaml

from robotdiffuse.core.errors import InputError, reading, shown
from robotdiffuse.core.input_files import MAX_YAML_SIZE, parse_yaml, read_json, read_text
from robotdiffuse.core.output_files import write_atomically
from robotdiffuse.core.types import Trajectory
from robotdiffuse.interop import missing_package
from robotdiffuse.interop.recorded_motion import RecordedMotion, checked_motion
from robotdiffuse.problems.problem import Problem

JOINT_TRAJECTORY = "trajectory_msgs/msg/JointTrajectory"
PORT = 9090
"""Default port of rosbridge."""
MATCH_TIME = 0.5
"""Time for subscribers to match the publisher before it sends, and to receive before it ends [s]."""
TIMES = ("time", "t", "time_from_start", "timestamp")
"""Names of the column of times."""
KINDS = {"position": "positions", "velocity": "velocities", "acceleration": "accelerations"}
"""What the endings of columns mean."""
SUPPORTED = "it must hold a RobotDiffuse result, a JointTrajectory, RobotTrajectory or DisplayTrajectory"


def read_json_file(file: Path, topic: str | None = None) -> RecordedMotion:
    """Read a result, a trajectory, or a ROS or MoveIt message in the JSON form of rosbridge."""
    return motion_from_record(read_json(file), str(file))


def read_yaml(file: Path, topic: str | None = None) -> RecordedMotion:
    """Read a JointTrajectory, RobotTrajectory or DisplayTrajectory, as `ros2 topic echo` prints it."""
    text = read_text(file, largest=MAX_YAML_SIZE).rstrip()
    text = text.removesuffix("---")  # the end of a message
    return motion_from_record(parse_yaml(text, str(file)), str(file))


def write_yaml(problem: Problem, trajectory: Trajectory, file: Path) -> None:
    """Write a JointTrajectory as `ros2 topic pub` takes it; see `interop.write_motion`."""
    record = joint_trajectory(trajectory.joint_names, trajectory)
    text = yaml.dump(record, Dumper=yaml.CSafeDumper, sort_keys=False, default_flow_style=None, width=110)
    write_atomically(file, text)


def read_csv(file: Path, topic: str | None = None) -> RecordedMotion:
    """Read a motion in the columns of `Trajectory.save`: time, then NAME or NAME_position for each joint, and
    optionally NAME_velocity and NAME_acceleration. Without time, the rows are waypoints."""
    with reading(file):
        return _table(read_text(file))


def motion_from_record(record: Any, where: str) -> RecordedMotion:
    """The motion in a record. Raises InputError, naming `where`, if there is none."""
    with reading(where):
        return _motion(record)


def _motion(record: Any) -> RecordedMotion:
    if not isinstance(record, Mapping):
        raise InputError(f"it is {shown(record)}; {SUPPORTED}")
    if "status" in record and record.get("status") != "solved":
        raise InputError(f"it holds no motion: its status is {shown(record['status'])}")
    if "trajectory" in record:
        return _only(record["trajectory"])
    if "joint_trajectory" in record:
        other = record.get("multi_dof_joint_trajectory") or {}
        if isinstance(other, Mapping) and other.get("points"):
            raise InputError(
                "multi_dof_joint_trajectory has points; only arms on a fixed base can be validated"
            )
        return _motion(record["joint_trajectory"])
    if "points" in record:
        return _joint_trajectory(record)
    if record.get("times"):
        q, t, v, a = (record.get(name) for name in ("positions", "times", "velocities", "accelerations"))
        return checked_motion(record.get("joint_names"), q, t, v, a)
    for name in ("waypoints", "positions"):
        if record.get(name):
            return checked_motion(record.get("joint_names"), record[name])
    raise InputError(f"it holds no motion: {SUPPORTED}")


def _only(trajectories: Any) -> RecordedMotion:
    """The motion in the `trajectory` field of a DisplayTrajectory (a list) or a MoveIt response (one)."""
    if isinstance(trajectories, Mapping):
        return _motion(trajectories)
    if not isinstance(trajectories, list) or len(trajectories) != 1:
        count = len(trajectories) if isinstance(trajectories, list) else shown(trajectories)
        raise InputError(f"trajectory holds {count} parts; one is validated at a time")
    return _motion(trajectories[0])


def _joint_trajectory(record: Mapping[str, Any]) -> RecordedMotion:
    points = record["points"]
    if not isinstance(points, list) or not points:
        raise InputError("points is empty: a motion has at least one row")
    rows: dict[str, list[Any]] = {"positions": [], "velocities": [], "accelerations": []}
    for i, point in enumerate(points):
        if not isinstance(point, Mapping):
            raise InputError(f"points[{i}] is {shown(point)}; it must be a JointTrajectoryPoint")
        for name, column in rows.items():
            column.append(_list(point.get(name)))
    times = [
        _seconds(f"points[{i}].time_from_start", p.get("time_from_start", 0)) for i, p in enumerate(points)
    ]
    for name in ("velocities", "accelerations"):
        given = [len(row) > 0 for row in rows[name]]
        if any(given) and not all(given):
            raise InputError(f"points[{given.index(False)}] has no {name}, but others do")
    return checked_motion(
        _list(record.get("joint_names")), rows["positions"], times, rows["velocities"], rows["accelerations"]
    )


def _list(value: Any) -> list[Any]:
    return [] if value is None else list(value) if isinstance(value, list | tuple) else [value]


def _seconds(where: str, value: Any) -> float:
    """Seconds of a ROS 2 (sec, nanosec) or ROS 1 (secs, nsecs) duration, or of a plain number."""
    parts: tuple[Any, Any] = (value, 0)
    if isinstance(value, Mapping):
        for whole, rest in (("sec", "nanosec"), ("secs", "nsecs")):
            if whole in value:
                parts = (value[whole], value.get(rest, 0))
    if not all(isinstance(part, int | float) and not isinstance(part, bool) for part in parts):
        raise InputError(f"{where} is {shown(value)}; it must be a duration: sec and nanosec")
    return float(parts[0]) + 1e-9 * float(parts[1])


def joint_trajectory(names: tuple[str, ...], trajectory: Any) -> dict[str, Any]:
    """A trajectory as a trajectory_msgs/msg/JointTrajectory in plain data."""
    points = []
    for i, t in enumerate(trajectory.times.tolist()):
        nanoseconds = round(t * 1e9)
        points.append(
            {
                "positions": trajectory.positions[i].tolist(),
                "velocities": trajectory.velocities[i].tolist(),
                "accelerations": trajectory.accelerations[i].tolist(),
                "effort": [],
                "time_from_start": {"sec": nanoseconds // 10**9, "nanosec": nanoseconds % 10**9},
            }
        )
    header = {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": ""}
    return {"header": header, "joint_names": list(names), "points": points}


def _table(text: str) -> RecordedMotion:
    try:
        reader = csv.reader(text.splitlines())
        rows = [(reader.line_num, row) for row in reader if any(cell.strip() for cell in row)]
    except csv.Error as error:
        raise InputError(f"it is not valid CSV: {error}") from None
    if not rows:
        raise InputError("it is empty; it must have a header and rows of numbers")
    header = [cell.strip() for cell in rows[0][1]]
    header = [cell[1:] if cell[:1] == "'" and cell[1:2] in "=+-@" else cell for cell in header]
    if len(rows) == 1:
        raise InputError("it has a header and no rows")
    columns: list[list[float]] = [[] for _ in header]
    for number, row in rows[1:]:
        if len(row) != len(header):
            raise InputError(f"line {number} has {len(row)} cells; the header has {len(header)}")
        for name, column, cell in zip(header, columns, row, strict=True):
            try:
                column.append(float(cell))
            except ValueError:
                raise InputError(f"line {number}: {name} is {shown(cell)}; it must be a number") from None
    times: list[float] | None = None
    columns_of: dict[str, dict[str, list[float]]] = {what: {} for what in KINDS.values()}
    for name, column in zip(header, columns, strict=True):
        if name.lower() in TIMES and times is None:
            times = column
            continue
        joint, _, kind = name.rpartition("_")
        what = KINDS.get(kind, "positions")
        joint = joint if kind in KINDS else name
        if joint in columns_of[what]:
            raise InputError(f"the header has {shown(name)} more than once")
        columns_of[what][joint] = column
    names = list(columns_of["positions"])
    for what in ("velocities", "accelerations"):
        if columns_of[what] and sorted(columns_of[what]) != sorted(names):
            raise InputError(f"the header has {what} of other joints than positions")
    table = {
        what: [list(r) for r in zip(*(c[n] for n in names), strict=True)] if c else None
        for what, c in columns_of.items()
    }
    return checked_motion(names, table["positions"], times, table["velocities"], table["accelerations"])


def publish(
    trajectory: Trajectory,
    host: str,
    port: int = PORT,
    topic: str = "/joint_trajectory",
    timeout: float = 5.0,
) -> None:
    """Publish a trajectory once through rosbridge, as a JointTrajectory; the caller must have validated it.

    Whether a subscriber received it is not known: ROS does not confirm deliveries. Raises InputError if no
    rosbridge answers within `timeout` [s].
    """
    try:
        import roslibpy
    except ImportError:
        raise missing_package("roslibpy", "ros") from None
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
        publisher.publish(roslibpy.Message(joint_trajectory(trajectory.joint_names, trajectory)))
        sleep(MATCH_TIME)
        publisher.unadvertise()
    finally:
        ros.close()
