"""Problem: a robot, a scene, a start and a goal; and what cameras saw of the scene.

As with shapes, the constructors check their arguments themselves: see `no_type_check` in scenes/shapes.py.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from dataclasses import replace as dataclass_replace
from typing import TYPE_CHECKING, ClassVar, no_type_check

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from numpy.typing import ArrayLike

from robotdiffuse.core.bounds import LARGEST, SLOWEST, Value, numbers, rigid_transform
from robotdiffuse.core.errors import InputError, shown, unknown_name
from robotdiffuse.core.transforms import inverse
from robotdiffuse.perception.depth_view import DepthView, SeenPoints
from robotdiffuse.problems.constraints import CONSTRAINTS, CartesianLine, Constraint
from robotdiffuse.problems.goals import AnyGoal as AnyGoal
from robotdiffuse.problems.goals import Goal, OneGoal, moved_goal
from robotdiffuse.problems.goals import JointGoal as JointGoal
from robotdiffuse.problems.goals import PoseGoal as PoseGoal
from robotdiffuse.problems.goals import PosesGoal as PosesGoal
from robotdiffuse.robots.dynamics import check_dynamics
from robotdiffuse.robots.inertias import Payload
from robotdiffuse.robots.robot import Joint, Robot
from robotdiffuse.scenes.moving_obstacles import MovingObstacle
from robotdiffuse.scenes.scene import Scene

LIMIT_SLACK = 1e-5
"""Configurations that exceed a joint limit by no more than this are clamped, with a note [rad]."""
LEAST_BLEND, MOST_BLEND = 1e-3, 10.0
"""Of `Problem.blend`, but for 0 [rad] or [m]."""
OPTIMISTIC, PADDED, PREDICTED, OCCUPIED = "optimistic", "padded", "predicted", "occupied"
UNSEEN = (OPTIMISTIC, PADDED, PREDICTED, OCCUPIED)
"""What space that no view saw is taken for: free; free but near what was seen; as the completing network
predicts it; occupied. See `planning/pipeline/unknown_space.py`."""


@no_type_check
@dataclass(frozen=True, eq=False)
class Problem(Value):
    """`goal` may be given as a configuration, a list of them, a JointGoal, a PoseGoal or a PosesGoal, or a
    list of those, of which any is to be reached; so may each of the waypoints.

    Values up to `LIMIT_SLACK` beyond a joint limit are clamped, with a note; those of continuous joints are
    kept as they are, and whole turns of a goal do not matter. Raises InputError for everything else that no
    planner could work with: wrong lengths, values that are not finite or out of limits, a goal frame that the
    robot does not move. Collisions of start and goal are found by the planners.

    With views, the problem's scene is the given one and what they saw beside it, as points (`SeenPoints`).
    """

    robot: Robot
    scene: Scene
    start: Float[ndarray, "dof"]
    goal: Goal
    notes: tuple[str, ...] = ()
    """What was changed in the input, e.g. a start clamped to a limit."""
    clearance: float | None = None
    """Distance to obstacles that is to be kept where start, goal and passages allow it [m]; None: what the
    call of the planner says."""
    views: tuple[DepthView, ...] = ()
    """Pictures that depth cameras took of the scene."""
    unknown: str = OPTIMISTIC
    """What space that no view saw is taken for, one of UNSEEN; of no account without views."""
    T_world_base: Float[ndarray, "4 4"] | None = None
    """Where the base stands in the world, for files and pictures: scene, goal and views are in the base's
    frame all the same. `in_world` takes them in the world's. None: the base's frame is the world's."""
    waypoints: tuple[Goal, ...] = ()
    """Where the motion stops on its way, in this order, or what it passes by: see `blend`."""
    constraints: tuple[Constraint, ...] = ()
    """What holds all along the motion."""
    moving: tuple[MovingObstacle, ...] = ()
    """Obstacles that move, from time 0 of the motion on; `scene` holds those that stand still."""
    start_velocity: Float[ndarray, "dof"] | None = None
    """Of the joints when the motion begins [rad/s] or [m/s]; None, and all below 1e-6: it begins at rest."""
    blend: tuple[float, ...] = ()
    """For each waypoint, within what distance of it the motion may pass without stopping: of configurations
    in joint space [rad, L2], of the position of a pose, or the box that it may be in [m]; 0: it stops there.
    May be given as one number for all; empty: it stops at all."""
    payload: Payload | None = None
    """What a link carries: the timed motion keeps within the effort limits, which None does not look at."""

    def __post_init__(self) -> None:
        if self.clearance is not None:
            check_clearance("clearance", self.clearance)
        if not isinstance(self.robot, Robot):
            raise InputError(f"robot is {shown(self.robot)}; it must be a Robot, e.g. rd.load_robot('panda')")
        if not isinstance(self.scene, Scene):
            raise InputError(f"scene is {shown(self.scene)}; it must be a Scene, e.g. rd.Scene([shape, ...])")
        notes = list(self.notes)
        start = _configuration(self.robot, "start", self.start, notes)
        goal = _goal(self.robot, "goal", self.goal, notes)
        if not isinstance(self.waypoints, list | tuple):
            raise InputError(f"waypoints is {shown(self.waypoints)}; it must be a list of goals")
        fields = (f"waypoints[{i}]" for i in range(len(self.waypoints)))
        waypoints = tuple(_goal(self.robot, *of, notes) for of in zip(fields, self.waypoints, strict=True))
        if self.payload is not None:
            _check_payload(self.robot, self.payload)
        blend = _blend(self.blend, len(waypoints))
        constraints = _constraints(self.robot, self.constraints)
        if waypoints and any(isinstance(one, CartesianLine) for one in constraints):
            raise InputError("cartesian_line goes from start to goal: plan from one waypoint to the next")
        views = _views(self.robot, self.views)
        if views and waypoints:
            raise InputError("waypoints cannot be had beside views: plan from one to the next")
        moving = _moving(self.moving, self.scene)
        start_velocity = _velocity(self.robot, self.start_velocity)
        beside = {
            "views": views,
            "waypoints": waypoints,
            "constraints": constraints,
            "moving": moving,
            "start_velocity": () if start_velocity is None else (start_velocity,),
            "payload": () if self.payload is None else (self.payload,),
        }
        others = [name for name, given in beside.items() if name != "start_velocity" and given]
        if start_velocity is not None and others:
            raise InputError(f"start_velocity cannot be had beside {others[0]}")
        if moving and views:
            raise InputError("moving cannot be had beside views")
        if moving and any(blend):
            raise InputError("moving cannot be had beside blend: the motion stops at waypoints")
        check_unknown("unknown", self.unknown)
        T_world_base = self.T_world_base
        if T_world_base is not None:
            T_world_base = rigid_transform("T_world_base", T_world_base)
        scene = self.scene
        if views:
            from robotdiffuse.perception.seen_points import (
                seen_shapes,  # compiled code, which only views need
            )

            scene = self.known_scene
            ends = goal.positions if isinstance(goal, JointGoal) else start[None]
            scene = Scene([*scene.shapes, *seen_shapes(views, self.robot, scene, start, ends)])
        for key, value in {
            "scene": scene,
            "start": start,
            "goal": goal,
            "notes": tuple(notes),
            "views": views,
            "T_world_base": T_world_base,
            "waypoints": waypoints,
            "constraints": constraints,
            "moving": moving,
            "start_velocity": start_velocity,
            "blend": blend,
        }.items():
            object.__setattr__(self, key, value)
        super().__post_init__()

    if TYPE_CHECKING:

        def __init__(
            self,
            robot: Robot,
            scene: Scene,
            start: ArrayLike,
            goal: ArrayLike | Goal | Sequence[OneGoal],
            notes: tuple[str, ...] = (),
            clearance: float | None = None,
            views: Sequence[DepthView] = (),
            unknown: str = OPTIMISTIC,
            T_world_base: ArrayLike | None = None,
            waypoints: Sequence[ArrayLike | Goal | Sequence[OneGoal]] = (),
            constraints: Sequence[Constraint] = (),
            moving: Sequence[MovingObstacle] = (),
            start_velocity: ArrayLike | None = None,
            blend: ArrayLike = (),
            payload: Payload | None = None,
        ) -> None: ...

    @classmethod
    def in_world(
        cls,
        T_world_base: ArrayLike,
        robot: Robot,
        scene: Scene,
        start: ArrayLike,
        goal: "ArrayLike | Goal | Sequence[OneGoal]",
        notes: tuple[str, ...] = (),
        clearance: float | None = None,
        views: "Sequence[DepthView]" = (),
        unknown: str = OPTIMISTIC,
        waypoints: "Sequence[ArrayLike | Goal | Sequence[OneGoal]]" = (),
        constraints: "Sequence[Constraint]" = (),
        moving: "Sequence[MovingObstacle]" = (),
        start_velocity: ArrayLike | None = None,
        blend: ArrayLike = (),
        payload: Payload | None = None,
    ) -> "Problem":
        """The problem of a robot whose base stands somewhere in the world, in whose frame scene, views,
        obstacles that move, constraints and the poses of goals are given.

        They are moved into the base's frame, where planning is. Raises InputError as the constructor does.
        """
        T = rigid_transform("T_world_base", T_world_base)
        T_base_world = inverse(T)
        goal = moved_goal(goal, T_base_world)
        waypoints = [moved_goal(waypoint, T_base_world) for waypoint in waypoints]
        if isinstance(scene, Scene):
            scene = scene.moved(T_base_world)
        views = tuple(view.moved(T_base_world) if isinstance(view, DepthView) else view for view in views)
        kinds = tuple(CONSTRAINTS.values())
        constraints = [one.moved(T_base_world) if isinstance(one, kinds) else one for one in constraints]
        moving = [one.moved(T_base_world) if isinstance(one, MovingObstacle) else one for one in moving]
        asked = robot, scene, start, goal, notes, clearance, views, unknown, T, waypoints
        return cls(*asked, constraints, moving, start_velocity, blend, payload)

    def standing(self) -> tuple[Robot, Scene]:
        """Robot and scene as they stand in the world, for pictures and simulators: the robot's base is the
        world then."""
        T = self.T_world_base
        return (self.robot, self.scene) if T is None else (self.robot.placed_in_world(T), self.scene.moved(T))

    @property
    def known_scene(self) -> Scene:
        """The scene as it was given: without what the views saw."""
        known = [shape for shape in self.scene.shapes if not isinstance(shape, SeenPoints)]
        return self.scene if len(known) == len(self.scene.shapes) else Scene(known)

    load: ClassVar[Callable[..., "Problem"]]
    """`problems.files.load_problem`, put here by the package: files know problems, not the reverse."""


def check_clearance(field: str, value: object) -> float:
    """The value as a distance [m]; InputError unless it is a finite number from 0 on."""
    clearance = numbers(value)
    if clearance is None or clearance.ndim != 0 or not 0 <= clearance <= LARGEST:
        raise InputError(f"{field} is {shown(value)}; it must be a distance from 0 to {LARGEST:g} m")
    return float(clearance)


def check_unknown(field: str, value: object) -> str:
    """The value as one of UNSEEN; InputError for anything else."""
    if not isinstance(value, str) or value not in UNSEEN:
        raise unknown_name(f"policy in {field}:", str(value), UNSEEN)
    return value


def _views(robot: Robot, views: object) -> tuple[DepthView, ...]:
    if not isinstance(views, list | tuple) or not all(isinstance(view, DepthView) for view in views):
        raise InputError(f"views is {shown(views)}; it must be a list of rd.DepthView")
    for i, view in enumerate(views):
        if view.configuration is not None and len(view.configuration) != robot.dof:
            raise InputError(
                f"views[{i}].configuration has {len(view.configuration)} values; {robot.name} has "
                f"{robot.dof} planned joints: {', '.join(robot.joint_names)}"
            )
    return tuple(views)


def _constraints(robot: Robot, constraints: object) -> tuple[Constraint, ...]:
    kinds = tuple(CONSTRAINTS.values())
    if not isinstance(constraints, list | tuple) or not all(isinstance(one, kinds) for one in constraints):
        known = ", ".join(f"rd.{kind.__name__}" for kind in kinds)
        raise InputError(f"constraints is {shown(constraints)}; it must be a list of {known}")
    for i, one in enumerate(constraints):
        _check_moved(robot, f"constraints[{i}].frame", one.frame)
    return tuple(constraints)


def _check_payload(robot: Robot, payload: object) -> None:
    if not isinstance(payload, Payload):
        raise InputError(f"payload is {shown(payload)}; it must be a rd.Payload")
    check_dynamics(robot)
    _check_moved(robot, "payload.link", robot.tip if payload.link is None else payload.link)


def _blend(value: object, count: int) -> tuple[float, ...]:
    """One for each waypoint."""
    blends = numbers(value)
    if blends is not None and blends.ndim == 0 and count:
        blends = np.full(count, blends)
    given = blends is not None and blends.size > 0
    if given and not count:
        raise InputError(f"blend is {shown(value)}; there are no waypoints")
    if blends is None or (given and blends.shape != (count,)) or not _may_blend(blends).all():
        raise InputError(
            f"blend is {shown(value)}; it must be a number for all of {count} waypoints, or one for each: 0 "
            f"to stop there, or from {LEAST_BLEND:g} to {MOST_BLEND:g}"
        )
    return tuple(blends.tolist()) if given else (0.0,) * count


def _may_blend(blends: ndarray) -> ndarray:
    return (blends == 0) | ((blends >= LEAST_BLEND) & (blends <= MOST_BLEND))


def _check_moved(robot: Robot, field: str, frame: str) -> None:
    """InputError unless a planned joint moves the link."""
    moved = [link for link in robot.link_names if robot.link_frame(link) > 0]
    if frame not in robot.link_names:
        raise unknown_name(f"link in {field}:", frame, moved)
    if frame not in moved:
        raise InputError(f"{field} {frame!r} is moved by no planned joint; these are: {', '.join(moved)}")


def _moving(moving: object, scene: Scene) -> tuple[MovingObstacle, ...]:
    """With names that nothing else in the scene has."""
    if not isinstance(moving, list | tuple) or not all(isinstance(one, MovingObstacle) for one in moving):
        raise InputError(f"moving is {shown(moving)}; it must be a list of rd.MovingObstacle")
    shapes = Scene([*scene.shapes, *(one.shape for one in moving)]).shapes[len(scene.shapes) :]
    return tuple(
        one if one.shape is shape else dataclass_replace(one, shape=shape)
        for one, shape in zip(moving, shapes, strict=True)
    )


def _velocity(robot: Robot, value: object) -> Float[ndarray, "dof"] | None:
    """A velocity within limits; None for rest, and what is nearly that."""
    if value is None:
        return None
    velocity = numbers(value)
    names = ", ".join(robot.joint_names)
    if velocity is None or velocity.shape != (robot.dof,) or not np.isfinite(velocity).all():
        raise InputError(
            f"start_velocity is {shown(value)}; it must be {robot.dof} finite numbers [rad/s]: {names}"
        )
    beyond = np.flatnonzero((np.abs(velocity) > robot.velocity) & (robot.velocity > 0))
    if len(beyond):
        j = int(beyond[0])
        raise InputError(
            f"start_velocity: {robot.joint_names[j]} is {velocity[j]:g}; its velocity limit is "
            f"{robot.velocity[j]:g}"
        )
    return velocity if (np.abs(velocity) >= SLOWEST).any() else None


def _goal(robot: Robot, field: str, goal: object, notes: list[str]) -> Goal:
    """The goal as one of its classes, its configurations within limits."""
    if isinstance(goal, list | tuple) and any(isinstance(one, OneGoal) for one in goal):
        goal = AnyGoal(tuple(goal))
    if isinstance(goal, AnyGoal):
        fields = (f"{field}.goals[{i}]" for i in range(len(goal.goals)))
        each = [_goal(robot, *of, notes) for of in zip(fields, goal.goals, strict=True)]
        return AnyGoal(tuple(each))  # type: ignore[arg-type]
    if isinstance(goal, PoseGoal):
        _check_moved(robot, f"{field}.frame", goal.frame)
        return goal
    if isinstance(goal, PosesGoal):
        _check_apart(robot, field, goal)
        return goal
    rows = goal.positions if isinstance(goal, JointGoal) else JointGoal(goal).positions  # type: ignore[arg-type]
    fields = [field] if len(rows) == 1 else [f"{field}[{i}]" for i in range(len(rows))]
    return JointGoal(np.stack([_configuration(robot, *row, notes) for row in zip(fields, rows, strict=True)]))


def _check_apart(robot: Robot, field: str, goal: PosesGoal) -> None:
    """InputError unless planned joints move each link, and any two of them against each other."""
    parts = dict[int, str]()
    for pose in goal.poses:
        _check_moved(robot, f"{field}.poses", pose.frame)
        other = parts.setdefault(robot.link_frame(pose.frame), pose.frame)
        if other != pose.frame:
            raise InputError(
                f"{field}.poses: {other} and {pose.frame} are one rigid part; give the pose of one of them"
            )


def _configuration(robot: Robot, field: str, value: object, notes: list[str]) -> Float[ndarray, "dof"]:
    """The configuration within limits; appends to `notes` what was changed."""
    q = numbers(value)
    names = ", ".join(robot.joint_names)
    if q is None or q.ndim != 1:
        raise InputError(f"{field} is {shown(value)}; it must be a list of {robot.dof} numbers: {names}")
    if len(q) != robot.dof:
        raise InputError(f"{field} has {len(q)} values; {robot.name} has {robot.dof} planned joints: {names}")
    return np.array([_position(field, *pair, notes) for pair in zip(robot.planned_joints, q, strict=True)])


def _position(field: str, joint: Joint, value: float, notes: list[str]) -> float:
    unit = "m" if joint.kind == "prismatic" else "rad"
    if not abs(value) <= LARGEST:
        raise InputError(
            f"{field}: {joint.name} is {value}; it must be a finite number within ±{LARGEST:g} [{unit}]"
        )
    if joint.kind == "continuous":
        return float(value)
    within = float(np.clip(value, joint.lower, joint.upper))
    if abs(value - within) > LIMIT_SLACK:
        raise InputError(
            f"{field}: {joint.name} is {value:g} {unit}; its limits are {joint.lower:g} to {joint.upper:g}"
        )
    if value != within:
        notes.append(f"{field}: {joint.name} clamped from {float(value)!r} to its limit {within!r} {unit}")
    return within
