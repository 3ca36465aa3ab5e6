"""ROS 2 messages without ROS: types, MoveIt's too, as plain data, and the motion in those of a topic."""

from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from functools import cache
from typing import Any

import numpy as np

from robotdiffuse.core.errors import InputError, missing_package, reading
from robotdiffuse.core.types import Trajectory
from robotdiffuse.interop.recorded_motion import (
    JOINT_TRAJECTORY,
    RecordedMotion,
    checked_motion,
    motion_from_record,
)
from robotdiffuse.problems.problem import Problem

try:
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    from rosbags.typesys.store import Typestore
except ImportError:
    raise missing_package("rosbags", "ros") from None

ROBOT_TRAJECTORY = "moveit_msgs/msg/RobotTrajectory"
DISPLAY_TRAJECTORY = "moveit_msgs/msg/DisplayTrajectory"
JOINT_STATE = "sensor_msgs/msg/JointState"
STRING = "std_msgs/msg/String"

# Message definitions of moveit_msgs and object_recognition_msgs (ROS 2), by name.
MOVEIT = {
    "object_recognition_msgs/msg/ObjectType": "string key\nstring db",
    "moveit_msgs/msg/CollisionObject": (
        "std_msgs/Header header\ngeometry_msgs/Pose pose\nstring id\n"
        "object_recognition_msgs/ObjectType type\n"
        "shape_msgs/SolidPrimitive[] primitives\ngeometry_msgs/Pose[] primitive_poses\n"
        "shape_msgs/Mesh[] meshes\ngeometry_msgs/Pose[] mesh_poses\n"
        "shape_msgs/Plane[] planes\ngeometry_msgs/Pose[] plane_poses\n"
        "string[] subframe_names\ngeometry_msgs/Pose[] subframe_poses\n"
        "byte ADD=0\nbyte REMOVE=1\nbyte APPEND=2\nbyte MOVE=3\nbyte operation"
    ),
    "moveit_msgs/msg/AttachedCollisionObject": (
        "string link_name\nCollisionObject object\nstring[] touch_links\n"
        "trajectory_msgs/JointTrajectory detach_posture\nfloat64 weight"
    ),
    "moveit_msgs/msg/RobotState": (
        "sensor_msgs/JointState joint_state\nsensor_msgs/MultiDOFJointState multi_dof_joint_state\n"
        "AttachedCollisionObject[] attached_collision_objects\nbool is_diff"
    ),
    ROBOT_TRAJECTORY: (
        "trajectory_msgs/JointTrajectory joint_trajectory\n"
        "trajectory_msgs/MultiDOFJointTrajectory multi_dof_joint_trajectory"
    ),
    DISPLAY_TRAJECTORY: ("string model_id\nRobotTrajectory[] trajectory\nRobotState trajectory_start"),
}


@cache
def typestore() -> Typestore:
    """The message types of ROS 2 Humble and MoveIt."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    types: dict[str, Any] = {}
    for name, definition in MOVEIT.items():
        types |= get_types_from_msg(definition, name)
    store.register(types)
    return store


def to_message(kind: str, record: Mapping[str, Any]) -> Any:
    """A message from plain data; missing fields are empty or zero."""
    store = typestore()
    field_types = store.fielddefs[kind][1]
    return store.types[kind](**{name: _value(of, record.get(name)) for name, of in field_types})


def _value(definition: Any, value: Any) -> Any:
    node = int(definition[0])
    of = definition[1]
    if node == 1:  # a base type
        kind = of[0]
        if kind == "string":
            return "" if value is None else str(value)
        return bool(value) if kind == "bool" else (value or 0.0 if kind.startswith("float") else value or 0)
    if node == 2:  # a message
        return to_message(of, value or {})
    element = of[0]
    items = [] if value is None else value
    if int(element[0]) == 1 and element[1][0] not in ("string", "bool"):
        return np.asarray(items, dtype=element[1][0].replace("byte", "uint8"))
    return [_value(element, item) for item in items]


def to_plain(value: Any) -> Any:
    """A message as plain data."""
    if is_dataclass(value) and not isinstance(value, type):
        return {
            f.name: to_plain(getattr(value, f.name)) for f in fields(value) if not f.name.startswith("__")
        }
    if isinstance(value, np.ndarray):
        return value.tolist()
    return [to_plain(item) for item in value] if isinstance(value, list | tuple) else value


def display_trajectory(problem: Problem, trajectory: Trajectory, record: Mapping[str, Any]) -> dict[str, Any]:
    """A DisplayTrajectory in plain data: a JointTrajectory, and the state in which the arm starts."""
    robot = problem.robot
    names = [*trajectory.joint_names, *robot.locked]
    values = [*trajectory.positions[0].tolist(), *robot.locked.values()]
    state = {"joint_state": {"header": record["header"], "name": names, "position": values}}
    return {
        "model_id": robot.name,
        "trajectory": [{"joint_trajectory": record}],
        "trajectory_start": state,
    }


def header_seconds(stamp: Mapping[str, Any]) -> float:
    """The time stamp of a message header [s]."""
    return float(stamp.get("sec", 0)) + 1e-9 * float(stamp.get("nanosec", 0))


def choose_topic(topics: Mapping[str, str], requested: str | None, where: str) -> str:
    """The topic to read a motion from, given all topics and their types.

    This is `requested`, or else the only topic of the first type of JointTrajectory, RobotTrajectory,
    DisplayTrajectory and JointState that occurs. Raises InputError if there is no such topic or several.
    """
    kinds = (JOINT_TRAJECTORY, ROBOT_TRAJECTORY, DISPLAY_TRAJECTORY, JOINT_STATE)
    motions = {topic: kind for topic, kind in topics.items() if kind in kinds}
    listed = ", ".join(f"{topic} ({kind})" for topic, kind in topics.items()) or "none"
    if requested is not None:
        if requested not in motions:
            raise InputError(f"{where}: topic {requested!r} holds no motion; topics: {listed}")
        return requested
    for kind in kinds:
        candidates = [topic for topic, of in motions.items() if of == kind]
        if len(candidates) > 1:
            raise InputError(
                f"{where}: several topics hold motions: {', '.join(candidates)}; choose one with --topic"
            )
        if candidates:
            return candidates[0]
    raise InputError(f"{where} holds no motion; topics: {listed}; known types: {', '.join(kinds)}")


def motion_from_messages(kind: str, messages: list[tuple[int, Any]], where: str) -> RecordedMotion:
    """The motion in messages with their log times [ns]: a single message, or a series of joint states.

    Raises InputError, naming `where`, for no or several motions, and for damaged ones.
    """
    if not messages:
        raise InputError(f"{where} holds no messages")
    if kind != JOINT_STATE:
        if len(messages) > 1:
            raise InputError(f"{where} holds {len(messages)} motions; one is validated at a time")
        return motion_from_record(to_plain(messages[0][1]), where)
    states = [to_plain(message) for _, message in messages]
    names = states[0]["name"]
    logged = messages[0][0]
    stamps = [header_seconds(state["header"]["stamp"]) for state in states]
    if not any(stamps):
        stamps = [1e-9 * (at - logged) for at, _ in messages]
    rows: dict[str, list[list[float]]] = {"position": [], "velocity": []}
    for i, state in enumerate(states):
        if sorted(state["name"]) != sorted(names):
            raise InputError(f"{where}: joint state {i} has other joints than the first")
        column_of = {name: k for k, name in enumerate(state["name"])}
        order = [column_of[name] for name in names]
        for quantity, column in rows.items():
            column.append([state[quantity][k] for k in order] if len(state[quantity]) == len(names) else [])
    velocities = rows["velocity"] if all(rows["velocity"]) else None
    first = stamps[0]
    with reading(where):
        return checked_motion(names, rows["position"], [stamp - first for stamp in stamps], velocities)
