"""Checks of the fields of a Problem: each returns the value as the problem keeps it, or raises InputError."""

from dataclasses import replace as dataclass_replace

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.core.bounds import MAX_COORDINATE, MIN_RATE, numbers, rigid_transform
from robotdiffuse.core.errors import InputError, distinct, shown, unknown_name
from robotdiffuse.perception.depth_view import DepthView
from robotdiffuse.problems.constraints import CONSTRAINTS, Constraint
from robotdiffuse.problems.goals import AnyGoal, Goal, JointGoal, OneGoal, PoseGoal, PosesGoal
from robotdiffuse.robots.dynamics import check_dynamics
from robotdiffuse.robots.inertias import Payload
from robotdiffuse.robots.named_poses import named_pose
from robotdiffuse.robots.robot import Joint, Robot
from robotdiffuse.scenes.moving_obstacles import MovingObstacle
from robotdiffuse.scenes.scene import ALL_LINKS, Scene

LIMIT_SLACK = 1e-3
"""Configurations beyond a joint limit by at most this are clamped to it, with a note [rad] or [m]."""
VELOCITY_SLACK = 1e-6
"""The same of start velocities, as a share of the limit: float32 rounds by up to 6e-8."""
MIN_BLEND, MAX_BLEND = 1e-3, 10.0
"""Bounds of a `Problem.blend` that is not 0 [rad] or [m]."""


def base_pose(T_world_base: object) -> Float[ndarray, "4 4"] | None:
    return None if T_world_base is None else rigid_transform("T_world_base", T_world_base)


def waypoint_goals(robot: Robot, waypoints: object, notes: list[str]) -> tuple[Goal, ...]:
    if not isinstance(waypoints, list | tuple):
        raise InputError(f"waypoints is {shown(waypoints)}; it must be a list of goals")
    return tuple(checked_goal(robot, f"waypoints[{i}]", goal, notes) for i, goal in enumerate(waypoints))


def depth_views(robot: Robot, views: object) -> tuple[DepthView, ...]:
    if not isinstance(views, list | tuple) or not all(isinstance(view, DepthView) for view in views):
        raise InputError(f"views is {shown(views)}; it must be a list of rd.DepthView")
    for i, view in enumerate(views):
        if view.configuration is not None and len(view.configuration) != robot.dof:
            raise InputError(
                f"views[{i}].configuration has {len(view.configuration)} values; {robot.name} has "
                f"{robot.dof} planned joints: {', '.join(robot.joint_names)}"
            )
    return tuple(views)


def path_constraints(robot: Robot, constraints: object) -> tuple[Constraint, ...]:
    kinds = tuple(CONSTRAINTS.values())
    if not isinstance(constraints, list | tuple) or not all(isinstance(one, kinds) for one in constraints):
        known = ", ".join(f"rd.{kind.__name__}" for kind in kinds)
        raise InputError(f"constraints is {shown(constraints)}; it must be a list of {known}")
    for i, one in enumerate(constraints):
        _check_planned_joint_moves(robot, f"constraints[{i}].frame", one.frame)
    return tuple(constraints)


def checked_payload(robot: Robot, payload: object) -> Payload | None:
    if payload is None:
        return None
    if not isinstance(payload, Payload):
        raise InputError(f"payload is {shown(payload)}; it must be a rd.Payload")
    check_dynamics(robot)
    _check_planned_joint_moves(robot, "payload.link", robot.tip if payload.link is None else payload.link)
    return payload


def blend_radii(value: object, count: int) -> tuple[float, ...]:
    """One blend for each of `count` waypoints."""
    blends = numbers(value)
    if blends is not None and blends.ndim == 0 and count:
        blends = np.full(count, blends)
    given = blends is not None and blends.size > 0
    if given and not count:
        raise InputError(f"blend is {shown(value)}; there are no waypoints")
    if blends is None or (given and blends.shape != (count,)) or not _is_blend(blends).all():
        raise InputError(
            f"blend is {shown(value)}; it must be one number for all {count} waypoints, or one for each: 0 "
            f"to stop there, or from {MIN_BLEND:g} to {MAX_BLEND:g}"
        )
    return tuple(blends.tolist()) if given else (0.0,) * count


def _is_blend(blends: ndarray) -> ndarray:
    return (blends == 0) | ((blends >= MIN_BLEND) & (blends <= MAX_BLEND))


def _check_planned_joint_moves(robot: Robot, field: str, frame: str) -> None:
    """Raises InputError unless a planned joint moves the link."""
    moved = [link for link in robot.link_names if robot.link_frame(link) > 0]
    if frame not in robot.link_names:
        raise unknown_name(f"link in {field}:", frame, moved)
    if frame not in moved:
        raise InputError(f"{field}: no planned joint moves {frame!r}; they move {', '.join(moved)}")


def check_contacts(robot: Robot, scene: Scene) -> None:
    """Raises InputError for allowed contacts of links that the robot lacks."""
    known = {*robot.link_names}
    for obstacle, links in scene.allowed_contacts:
        for link in () if links == ALL_LINKS else links:
            if link not in known:
                raise unknown_name(f"link in allowed_contacts of {obstacle}:", link, robot.link_names)


def moving_obstacles(moving: object, scene: Scene) -> tuple[MovingObstacle, ...]:
    """The obstacles, renamed where a shape of the scene has the same name."""
    if not isinstance(moving, list | tuple) or not all(isinstance(one, MovingObstacle) for one in moving):
        raise InputError(f"moving is {shown(moving)}; it must be a list of rd.MovingObstacle")
    shapes = Scene([*scene.shapes, *(one.shape for one in moving)]).shapes[len(scene.shapes) :]
    return tuple(
        one if one.shape is shape else dataclass_replace(one, shape=shape)
        for one, shape in zip(moving, shapes, strict=True)
    )


def velocity_at_start(robot: Robot, value: object, notes: list[str]) -> Float[ndarray, "dof"] | None:
    """A velocity, clamped where it is within VELOCITY_SLACK of the limits; `notes` says where. None if it is
    zero, or nearly."""
    if value is None:
        return None
    velocity = numbers(value)
    names = ", ".join(robot.joint_names)
    if velocity is None or velocity.shape != (robot.dof,) or not np.isfinite(velocity).all():
        raise InputError(
            f"start_velocity is {shown(value)}; it must be {robot.dof} finite numbers [rad/s]: {names}"
        )
    within = np.clip(velocity, -robot.velocity, robot.velocity)
    for j in np.flatnonzero((velocity != within) & (robot.velocity > 0)):
        name, limit = robot.joint_names[j], robot.velocity[j]
        if abs(velocity[j] - within[j]) > VELOCITY_SLACK * limit:
            given, _, most = distinct(velocity[j], -limit, limit)
            raise InputError(f"start_velocity: {name} is {given}; its velocity limit is {most}")
        notes.append(f"start_velocity: {name} clamped from {velocity[j]!r} to its limit {within[j]!r}")
        velocity[j] = within[j]
    return velocity if (np.abs(velocity) >= MIN_RATE).any() else None


def checked_goal(robot: Robot, field: str, goal: object, notes: list[str]) -> Goal:
    """The goal as an object of its class, with its configurations within limits."""
    if isinstance(goal, list | tuple):
        goal = [
            named_pose(robot, f"{field}[{i}]", one) if isinstance(one, str) else one
            for i, one in enumerate(goal)
        ]
        if any(isinstance(one, OneGoal) for one in goal):
            goal = AnyGoal(tuple(one if isinstance(one, OneGoal) else JointGoal(one) for one in goal))
    if isinstance(goal, AnyGoal):
        fields = (f"{field}.goals[{i}]" for i in range(len(goal.goals)))
        each = [checked_goal(robot, *of, notes) for of in zip(fields, goal.goals, strict=True)]
        return AnyGoal(tuple(each))  # type: ignore[arg-type]
    if isinstance(goal, PoseGoal):
        _check_planned_joint_moves(robot, f"{field}.frame", goal.frame)
        return goal
    if isinstance(goal, str):
        goal = named_pose(robot, field, goal)
    if isinstance(goal, PosesGoal):
        _check_independent_links(robot, field, goal)
        return goal
    rows = goal.positions if isinstance(goal, JointGoal) else JointGoal(goal).positions  # type: ignore[arg-type]
    fields = [field] if len(rows) == 1 else [f"{field}[{i}]" for i in range(len(rows))]
    return JointGoal(
        np.stack([checked_configuration(robot, *row, notes) for row in zip(fields, rows, strict=True)])
    )


def _check_independent_links(robot: Robot, field: str, goal: PosesGoal) -> None:
    """Raises InputError unless planned joints move each link, and any two relative to each other."""
    parts = dict[int, str]()
    for pose in goal.poses:
        _check_planned_joint_moves(robot, f"{field}.poses", pose.frame)
        other = parts.setdefault(robot.link_frame(pose.frame), pose.frame)
        if other != pose.frame:
            raise InputError(
                f"{field}.poses: {other} and {pose.frame} are one rigid part; give the pose of one of them"
            )


def configuration(robot: Robot, field: str, value: object) -> Float[ndarray, "dof"]:
    """The value of each planned joint, of a list of numbers or the name of a pose."""
    q = numbers(named_pose(robot, field, value) if isinstance(value, str) else value)
    names = ", ".join(robot.joint_names)
    if q is None or q.ndim != 1:
        raise InputError(f"{field} is {shown(value)}; it must be a list of {robot.dof} numbers: {names}")
    if len(q) != robot.dof:
        raise InputError(f"{field} has {len(q)} values; {robot.name} has {robot.dof} planned joints: {names}")
    return q


def checked_configuration(robot: Robot, field: str, value: object, notes: list[str]) -> Float[ndarray, "dof"]:
    """The configuration, clamped where it is within LIMIT_SLACK of the limits; `notes` says where."""
    values = zip(robot.planned_joints, configuration(robot, field, value), strict=True)
    return np.array([_position(field, joint, position, notes) for joint, position in values])


def _position(field: str, joint: Joint, value: float, notes: list[str]) -> float:
    unit = "m" if joint.kind == "prismatic" else "rad"
    if not abs(value) <= MAX_COORDINATE:
        raise InputError(
            f"{field}: {joint.name} is {value}; "
            f"it must be a finite number within ±{MAX_COORDINATE:g} [{unit}]"
        )
    if joint.kind == "continuous":
        return float(value)
    within = float(np.clip(value, joint.lower, joint.upper))
    if abs(value - within) > LIMIT_SLACK:
        hint = " (angles are in radians)" if unit == "rad" and abs(value) > 2 * np.pi else ""
        given, lower, upper = distinct(value, joint.lower, joint.upper)
        raise InputError(f"{field}: {joint.name} is {given} {unit}; its limits are {lower} to {upper}{hint}")
    if value != within:
        notes.append(f"{field}: {joint.name} clamped from {float(value)!r} to its limit {within!r} {unit}")
    return within
