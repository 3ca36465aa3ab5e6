"""Reads and writes goals of problem files.

[...], or the name of a pose of the robot
{joints: [...]}
{joint_set: [[...], [...]]}
{pose: {frame: panda_hand, xyz: [...], wxyz: [...]}}
{pose: {..., relative_to: shelf, xyz_tolerance: [0.1, 0.1, 0], rpy_tolerance: [0, 0, 3.1416]}}
{poses: {left_gripper: {xyz: [...], wxyz: [...]}, right_gripper: {...}}}
{any: [{pose: {...}}, {joints: [...]}]}
"""

from typing import Any

from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.core.bounds import numbers
from robotdiffuse.core.errors import InputError, shown, unknown_name
from robotdiffuse.core.transforms import pose_entry
from robotdiffuse.problems.files.robot_setup import pose_of
from robotdiffuse.problems.goals import AnyGoal, Goal, JointGoal, PoseGoal, PosesGoal
from robotdiffuse.robots.named_poses import named_pose
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.files import check_fields
from robotdiffuse.scenes.scene import Scene

GOAL_KINDS = ("joints", "joint_set", "pose", "poses", "any")
TOLERANCES = ("xyz_tolerance", "rpy_tolerance")


def read_goal(field: str, data: object, scene: Scene, robot: Robot) -> Goal:
    """The goal of an entry of a problem file. Raises InputError that names the field.

    As in Python, it may also be a configuration, a list of them, the name of a pose of the robot, or a list
    of goals, any of which may be reached.

    Poses are in the frame of the scene, or of the object of the scene that `relative_to` names.
    """
    if isinstance(data, str):
        return JointGoal(named_pose(robot, field, data))
    if isinstance(data, list):
        data = {_kind_of_list(data): data}
    if not isinstance(data, dict) or len(data) != 1:
        kinds = ", ".join(GOAL_KINDS)
        raise InputError(f"{field} is {shown(data)}; it must be one of {kinds}, or a configuration")
    [(kind, value)] = data.items()
    if kind not in GOAL_KINDS:
        raise unknown_name(f"field of {field}:", kind, GOAL_KINDS)
    if kind == "any":
        if not isinstance(value, list) or not value:
            raise InputError(f"{field}.any is {shown(value)}; it must be a non-empty list of goals")
        goals = [read_goal(f"{field}.any[{i}]", one, scene, robot) for i, one in enumerate(value)]
        return AnyGoal(tuple(goals))  # type: ignore[arg-type]
    if kind == "pose":
        return _pose_goal(f"{field}.pose", value, scene)
    if kind == "poses":
        if not isinstance(value, dict) or not value:
            raise InputError(f"{field}.poses is {shown(value)}; it must map link names to poses")
        each = [_pose_goal(f"{field}.poses.{frame}", one, scene, frame) for frame, one in value.items()]
        return PosesGoal(each)
    if kind == "joints" and isinstance(value, str):
        value = named_pose(robot, f"{field}.joints", value)
    array = numbers(value)
    if array is None or array.ndim != (1 if kind == "joints" else 2):
        form = "a list of numbers" if kind == "joints" else "a list of configurations of one length"
        raise InputError(f"{field}.{kind} is {shown(value)}; it must be {form}")
    return JointGoal(array)


def _kind_of_list(data: list[Any]) -> str:
    """Which of GOAL_KINDS a list stands for."""
    if any(isinstance(one, dict | str) for one in data):
        return "any"
    return "joint_set" if data and all(isinstance(one, list) for one in data) else "joints"


def read_waypoints(data: object, scene: Scene, robot: Robot) -> tuple[Goal, ...]:
    """The waypoints of a problem file. Raises InputError that names the field."""
    if not isinstance(data, list):
        raise InputError(f"waypoints is {shown(data)}; it must be a list of goals")
    return tuple(read_goal(f"waypoints[{i}]", one, scene, robot) for i, one in enumerate(data))


def goal_entry(goal: Goal) -> dict[str, Any]:
    """The entry of a goal, as `read_goal` reads it."""
    if isinstance(goal, AnyGoal):
        return {"any": [goal_entry(one) for one in goal.goals]}
    if isinstance(goal, JointGoal):
        rows = goal.positions.tolist()
        return {"joints": rows[0]} if len(rows) == 1 else {"joint_set": rows}
    if isinstance(goal, PosesGoal):
        return {"poses": {pose.frame: _entry(pose) for pose in goal.poses}}
    return {"pose": {"frame": goal.frame, **_entry(goal)}}


def _entry(pose: PoseGoal) -> dict[str, Any]:
    tolerances = {name: getattr(pose, name) for name in TOLERANCES}
    given = {name: value.tolist() for name, value in tolerances.items() if value is not None}
    return {**pose_entry(pose.T_base_frame), **given}


def _pose_goal(field: str, value: object, scene: Scene, frame: object = None) -> PoseGoal:
    """The goal of a pose entry. frame: the link, if the entry itself does not name it."""
    required = ("xyz", "wxyz") if frame is not None else ("frame", "xyz", "wxyz")
    pose = {"frame": frame, **check_fields(field, value, required, ("relative_to", *TOLERANCES))}
    T = pose_of(field, pose)
    if "relative_to" in pose:
        T = _object_pose(field, pose["relative_to"], scene) @ T
    return PoseGoal(pose["frame"], T, *(pose.get(name) for name in TOLERANCES))  # type: ignore[arg-type]


def _object_pose(field: str, name: object, scene: Scene) -> Float[ndarray, "4 4"]:
    shapes = {shape.name: shape for shape in scene.shapes}
    if name not in shapes:
        raise unknown_name(f"object in {field}.relative_to:", str(name), shapes)
    try:
        return shapes[str(name)].T_base_shape
    except InputError as error:
        raise InputError(f"{field}.relative_to: {error}") from None
