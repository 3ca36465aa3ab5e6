"""Reads MoveIt motion plan requests in YAML, as MotionBenchMaker and robowflex write them.

Message: https://docs.ros.org/en/noetic/api/moveit_msgs/html/msg/MotionPlanRequest.html
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.core.bounds import vector
from robotdiffuse.core.errors import InputError, shown
from robotdiffuse.core.transforms import inverse, transform
from robotdiffuse.problems.files.moveit.frames import MoveItFrames
from robotdiffuse.problems.files.moveit.objects import object_shapes
from robotdiffuse.problems.files.moveit.values import joint_state, list_of, mapping_of, pose_of, xyz_of
from robotdiffuse.robots.bodies import AttachedBody
from robotdiffuse.robots.kinematics import link_pose
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.shapes import Shape


@dataclass(frozen=True, eq=False)
class MoveItAttached:
    """An object that the robot holds at the start."""

    name: str
    link: str
    shapes: tuple[Shape, ...]
    in_link: bool
    """Whether the shapes are in the frame of the link; otherwise they are in the frame of the base, at the
    start."""
    touch_links: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class MoveItRequest:
    """The content of a motion plan request. Either `joint_goals` is not empty or `pose_goal` is not None."""

    start: dict[str, float]
    """Joint values by name [rad] or [m], including fingers."""
    joint_goals: tuple[dict[str, float], ...] = ()
    """Alternative goals, each with joint values by name."""
    pose_goal: tuple[str, Float[ndarray, "4 4"]] | None = None
    """A link and its goal pose T_base_link."""
    attached: tuple[MoveItAttached, ...] = ()
    notes: tuple[str, ...] = ()
    """Notes on parts of the request that are ignored."""


def moveit_request(data: object, frames: MoveItFrames, folder: Path = Path()) -> MoveItRequest:
    """Start, attached objects and goals of a parsed request; `frames` and `folder` are those of its scene.

    Several joint goal constraints are alternative goals. A position and an orientation constraint of one link
    are a pose goal at the centre of the region, whose size and tolerances are ignored. Raises InputError for
    anything else, and for path constraints, because ignoring them would change the problem.
    """
    data = mapping_of("a motion plan request", data)
    for name in ("path_constraints", "trajectory_constraints"):
        if any(mapping_of(name, data.get(name)).values()):
            raise InputError(f"{name} are not supported")
    for name in ("reference_trajectories", "max_cartesian_speed"):
        if data.get(name):
            raise InputError(f"{name} is not supported; leave it out")
    notes = _scaling_notes(data)
    state = mapping_of("start_state", data.get("start_state"))
    held = list_of("attached_collision_objects", state.get("attached_collision_objects"))
    attached = tuple(_attached(i, entry, frames, folder) for i, entry in enumerate(held))
    start = joint_state("start_state.joint_state", state.get("joint_state"))
    velocity = list_of("velocity", mapping_of("joint_state", state.get("joint_state")).get("velocity"))
    if any(velocity):
        notes = (
            *notes,
            f"start_state.joint_state.velocity {shown(velocity)} is ignored: the motion begins at rest",
        )
    goals = list_of("goal_constraints", data.get("goal_constraints"))
    if not goals:
        raise InputError("goal_constraints is empty; it must hold at least one goal")
    if len(goals) == 1 and mapping_of("goal_constraints[0]", goals[0]).get("position_constraints"):
        return MoveItRequest(start, pose_goal=_pose_goal(goals[0], frames), attached=attached, notes=notes)
    each = tuple(_joint_goal(f"goal_constraints[{i}]", goal) for i, goal in enumerate(goals))
    return MoveItRequest(start, each, attached=attached, notes=notes)


def _scaling_notes(data: dict[str, Any]) -> tuple[str, ...]:
    """Notes on velocity and acceleration scaling factors below 1, which are ignored; 0 means 1 in MoveIt."""
    notes = []
    for what in ("velocity", "acceleration"):
        name = f"max_{what}_scaling_factor"
        share = float(vector("request", name, [data.get(name) or 0], 1)[0])
        if not 0 <= share <= 1:
            raise InputError(f"{name} is {shown(data[name])}; it must be a number from 0 to 1")
        if 0 < share < 1:
            notes.append(f"the request's {name} {share:g} is ignored: plan with {what}_scaling={share:g}")
    return tuple(notes)


def _attached(i: int, entry: object, frames: MoveItFrames, folder: Path) -> MoveItAttached:
    where = f"attached_collision_objects[{i}]"
    entry = mapping_of(where, entry)
    link, given = str(entry.get("link_name") or ""), mapping_of(f"{where}.object", entry.get("object"))
    header = mapping_of(f"{where}.object.header", given.get("header"))
    in_link = str(header.get("frame_id") or "").removeprefix("/") == link
    if in_link:  # the shapes are already in the frame of the link
        frames = MoveItFrames(None, np.eye(4), (link,))
    try:
        shapes = tuple(object_shapes(given, frames, folder))
    except InputError as error:
        raise InputError(f"{where}.object: {error}") from None
    touch = tuple(map(str, list_of(f"{where}.touch_links", entry.get("touch_links"))))
    return MoveItAttached(str(given.get("id") or "object"), link, shapes, in_link, touch)


def _joint_goal(where: str, goal: object) -> dict[str, float]:
    goal = mapping_of(where, goal)
    if any(goal.get(f"{kind}_constraints") for kind in ("position", "orientation", "visibility")):
        raise InputError(f"{where} must have joint_constraints alone, or be the only goal and a pose")
    values: dict[str, float] = {}
    for i, entry in enumerate(list_of(f"{where}.joint_constraints", goal.get("joint_constraints"))):
        at = f"{where}.joint_constraints[{i}]"
        entry = mapping_of(at, entry)
        values[str(entry.get("joint_name"))] = float(vector(at, "position", [entry.get("position")], 1)[0])
    return values


def _pose_goal(goal: dict[str, Any], frames: MoveItFrames) -> tuple[str, ndarray]:
    where = "goal_constraints[0]"
    places = list_of(f"{where}.position_constraints", goal.get("position_constraints"))
    turns = list_of(f"{where}.orientation_constraints", goal.get("orientation_constraints"))
    if len(places) != 1 or len(turns) != 1 or goal.get("joint_constraints"):
        raise InputError(f"{where} must have one position and one orientation constraint, and no others")
    place, turn = (mapping_of(where, entry) for entry in (places[0], turns[0]))
    link = place.get("link_name")
    if link != turn.get("link_name"):
        raise InputError(
            f"{where} constrains {link} and {turn.get('link_name')}; both must constrain one link"
        )
    if xyz_of("target_point_offset", place.get("target_point_offset") or [0, 0, 0]).any():
        raise InputError(f"{where}.position_constraints[0].target_point_offset must be zero")
    region = mapping_of("constraint_region", place.get("constraint_region"))
    poses = list_of("constraint_region.primitive_poses", region.get("primitive_poses"))
    if len(poses) != 1:
        raise InputError(f"{where}: constraint_region has {len(poses)} primitive_poses; it must have one")
    T_base_region = frames.of("header", place) @ pose_of("constraint_region.primitive_poses[0]", poses[0])
    turned = pose_of(where, {"position": [0, 0, 0], "orientation": turn.get("orientation")})
    rotation = (frames.of("header", turn) @ turned)[:3, :3]
    return str(link), transform(T_base_region[:3, 3], rotation)


def holding_at(robot: Robot, held: MoveItAttached, start: list[float]) -> Robot:
    """The robot with an object attached at the start. touch_links that the robot lacks are ignored."""
    shapes = held.shapes
    if not held.in_link and held.link in robot.link_names:
        T_link_base = inverse(link_pose(robot, np.array(start), held.link))
        shapes = tuple(shape.moved(T_link_base) for shape in shapes)
    touch = tuple(link for link in held.touch_links if link in robot.link_names)
    T_link_body = shapes[0].solid()[0] if shapes else np.eye(4)
    return robot.with_body(AttachedBody(held.name, held.link, T_link_body, shapes, touch))


def linkable(robot: Robot, request: MoveItRequest | None) -> tuple[str, ...]:
    """Names of the robot's links and of what it holds at the start."""
    return (*robot.link_names, *(held.name for held in (request.attached if request else ())))
