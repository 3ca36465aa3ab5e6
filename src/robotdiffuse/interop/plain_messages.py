"""Motions in ROS and MoveIt messages and in RobotDiffuse's own records, as plain Python data."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from robotdiffuse.core.errors import InputError, shown
from robotdiffuse.core.input_files import read_json
from robotdiffuse.interop.recorded_motion import RecordedMotion, checked_motion

SUPPORTED = "it must hold a RobotDiffuse result, a JointTrajectory, RobotTrajectory or DisplayTrajectory"


def read_json_file(file: Path, topic: str | None = None) -> RecordedMotion:
    """Read a result, a trajectory, or a ROS or MoveIt message in the JSON form of rosbridge."""
    return motion_from_record(read_json(file), str(file))


def motion_from_record(record: Any, where: str) -> RecordedMotion:
    """The motion in a record. Raises InputError, naming `where`, if there is none."""
    try:
        return _motion(record)
    except InputError as error:
        raise InputError(f"{where}: {error}") from None


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
