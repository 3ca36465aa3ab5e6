"""Problem: a robot, a scene, a start and a goal, and optionally depth views of the scene. Goals are
configurations, poses of one or several links with tolerances, or any of several goals.

The functions before the class `Problem` check its fields: they raise InputError for a wrong value, and most
return the value that the problem stores.

The constructors check their arguments themselves, so `no_type_check` keeps type checkers from checking them
at run time (see scenes/shapes.py)."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, replace
from itertools import chain
from pathlib import PurePath
from typing import TYPE_CHECKING, Any, ClassVar, TypedDict, Unpack

import numpy as np
from numpy.typing import ArrayLike

from robotdiffuse.core.errors import (
    MAX_COORDINATE,
    MIN_RATE,
    InputError,
    bounded,
    check_list,
    check_name,
    check_type,
    counted,
    distinct,
    located,
    numbers,
    repeated,
    rigid_motion,
    rigid_transform,
    short,
    shown,
)
from robotdiffuse.core.transforms import inverse
from robotdiffuse.core.types import (
    AnyConfiguration,
    Configuration,
    GivenConfigurations,
    GivenPose,
    JointValues,
    Pose,
    Value,
    Values,
    VectorOrNone,
    frozen_dataclass,
    no_type_check,
)
from robotdiffuse.perception.depth_view import DepthView, SeenPoints
from robotdiffuse.problems.constraints import CONSTRAINTS, CartesianLine, Constraint
from robotdiffuse.robots.bodies import Payload
from robotdiffuse.robots.dynamics import check_dynamics
from robotdiffuse.robots.kinematic_tree import Joint
from robotdiffuse.robots.robot import Robot, check_robot, configurations, named_pose
from robotdiffuse.scenes.scene import ALL_LINKS, MovingObstacle, Scene, added

MAX_TURN = 3.2
"""Largest tolerance of an angle, a little more than half a turn [rad]; larger numbers can only be degrees."""


@no_type_check
@frozen_dataclass
class JointGoal(Value):
    """A goal reached at any of several configurations."""

    positions: GivenConfigurations
    """The configurations, one per row [rad] or [m]."""

    def __post_init__(self) -> None:
        positions = numbers(self.positions)
        if positions is None or positions.ndim not in (1, 2) or positions.size == 0:
            raise InputError(
                f"goal is {shown(self.positions)}; it must be a configuration, or a list of configurations "
                "of one length"
            )
        object.__setattr__(self, "positions", np.atleast_2d(positions))
        super().__post_init__()

    def moved(self, T: Pose) -> "JointGoal":
        """Do nothing, since configurations do not move with poses.

        Args:
            T: The rigid motion, a homogeneous transform [4, 4].

        Returns:
            This goal.
        """
        return self


@no_type_check
@frozen_dataclass
class PoseGoal(Value):
    """A pose of a link. Without tolerances, the path must end within 1 cm and 15 degrees of it, as in the
    paper.

    With tolerances, the final pose of the link, in the frame of the goal, must have xyz and rpy within plus
    and minus the tolerances. xyz is a position along the goal's axes; rpy are roll, pitch and yaw about the
    goal's x, y and z axes, in the order of URDFs. A yaw tolerance of pi thus allows any turn about z. All
    poses within the tolerances are equally good.
    """

    frame: str
    """Name of the link."""
    T_base_frame: GivenPose
    """Pose of the link [4, 4]."""
    xyz_tolerance: VectorOrNone = None  # pyright: ignore[reportAssignmentType]
    """Tolerance of the position along the axes of the goal [m]; None: the exact position, validated to 1
    cm."""
    rpy_tolerance: VectorOrNone = None  # pyright: ignore[reportAssignmentType]
    """Tolerance of the orientation about the axes of the goal [rad], pi for any angle; None: the exact
    orientation, validated to 15 degrees."""

    def __post_init__(self) -> None:
        check_type("goal.frame", self.frame, str, "the name of a link")
        object.__setattr__(self, "T_base_frame", rigid_transform("goal.T_base_frame", self.T_base_frame))
        for name, limit, unit in (("xyz_tolerance", MAX_COORDINATE, "m"), ("rpy_tolerance", MAX_TURN, "rad")):
            value = getattr(self, name)
            if value is not None:
                wanted = f"3 numbers from 0 to {limit:g} [{unit}]"
                array = bounded(f"goal.{name}", value, (3,), 0.0, limit, wanted)
                object.__setattr__(self, name, array)
        super().__post_init__()

    def moved(self, T: Pose) -> "PoseGoal":
        """Move the pose.

        Args:
            T: The rigid motion, a homogeneous transform [4, 4].

        Returns:
            The goal after the motion.

        Raises:
            InputError: Unless T is rigid.
        """
        T = rigid_motion(T)
        return replace(self, T_base_frame=T @ self.T_base_frame)

    @property
    def tolerant(self) -> bool:
        """Whether more than one pose reaches the goal."""
        return any(t is not None and t.max() > 0 for t in (self.xyz_tolerance, self.rpy_tolerance))


@no_type_check
@frozen_dataclass
class PosesGoal(Value):
    """A pose for each of several links at once, e.g. for both hands of two arms, each with its tolerances."""

    poses: Sequence[PoseGoal]
    """One for each link."""

    def __post_init__(self) -> None:
        check_list("goal.poses", self.poses, PoseGoal, "rd.PoseGoal", least=1)
        twice = repeated(pose.frame for pose in self.poses)
        if twice:
            raise InputError(f"goal.poses names {twice[0]!r} twice; each link has one pose")
        object.__setattr__(self, "poses", tuple(self.poses))
        super().__post_init__()

    def moved(self, T: Pose) -> "PosesGoal":
        """Move all poses.

        Args:
            T: The rigid motion, a homogeneous transform [4, 4].

        Returns:
            The goal after the motion.

        Raises:
            InputError: Unless T is rigid.
        """
        return PosesGoal([pose.moved(T) for pose in self.poses])

    @property
    def tolerant(self) -> bool:
        """Whether any link has more than one pose that reaches the goal."""
        return any(pose.tolerant for pose in self.poses)


@no_type_check
@frozen_dataclass
class AnyGoal(Value):
    """Several goals, any of which may be reached. If one of the given goals is an AnyGoal, its own goals take
    its place."""

    goals: "tuple[OneGoal, ...]"
    """At least one; `PlanResult.goal_index` counts them from 0."""

    def __post_init__(self) -> None:
        types = "rd.JointGoal, rd.PoseGoal, rd.PosesGoal and rd.AnyGoal"
        check_list("goal.goals", self.goals, Goal, types, least=1)
        object.__setattr__(self, "goals", tuple(chain(*map(goals_of, self.goals))))
        super().__post_init__()

    def moved(self, T: Pose) -> "AnyGoal":
        """Move all goals.

        Args:
            T: The rigid motion, a homogeneous transform [4, 4].

        Returns:
            The goals after the motion.

        Raises:
            InputError: If any of the goals is a pose and T is not rigid.
        """
        return AnyGoal(tuple(goal.moved(T) for goal in self.goals))


OneGoal = JointGoal | PoseGoal | PosesGoal
Goal = OneGoal | AnyGoal


def goals_of(goal: Goal) -> "tuple[OneGoal, ...]":
    """The alternative goals: one of them must be reached."""
    return goal.goals if isinstance(goal, AnyGoal) else (goal,)


def poses_of(goal: Goal) -> Sequence[PoseGoal]:
    """The poses that must be reached together; empty for configurations and for AnyGoal."""
    if isinstance(goal, PosesGoal):
        return goal.poses
    return (goal,) if isinstance(goal, PoseGoal) else ()


LIMIT_SLACK = 1e-3
"""A joint value beyond a limit by up to this much [rad] or [m] is clamped to the limit, with a note."""
VELOCITY_SLACK = 1e-6
"""A start velocity beyond a limit by up to this fraction of the limit is clamped to the limit, with a note:
float32 rounds by up to 6e-8."""
# Bounds of a `Problem.blend` that is not 0 [rad] or [m].
MIN_BLEND = 1e-3
MAX_BLEND = 10.0


def waypoint_goals(robot: Robot, waypoints: Any, notes: list[str]) -> tuple[Goal, ...]:
    check_list("waypoints", waypoints, object, "goals")
    return tuple(checked_goal(robot, f"waypoints[{i}]", goal, notes) for i, goal in enumerate(waypoints))


def depth_views(robot: Robot, views: Any) -> tuple[DepthView, ...]:
    check_list("views", views, DepthView, "rd.DepthView")
    for i, view in enumerate(views):
        if view.configuration is not None and len(view.configuration) != robot.dof:
            raise InputError(
                f"views[{i}].configuration has {counted(len(view.configuration), 'value')}; {robot.name} has "
                f"{counted(robot.dof, 'planned joint')}: {', '.join(robot.joint_names)}"
            )
    return tuple(views)


def path_constraints(robot: Robot, constraints: Any) -> tuple[Constraint, ...]:
    names = ", ".join(f"rd.{kind.__name__}" for kind in CONSTRAINTS.values())
    check_list("constraints", constraints, Constraint, names)
    for i, constraint in enumerate(constraints):
        robot.check_moved(f"constraints[{i}].frame", constraint.frame)
    return tuple(constraints)


def checked_payload(robot: Robot, payload: Any) -> Payload | None:
    if payload is None:
        return None
    check_type("payload", payload, Payload, "an rd.Payload")
    check_dynamics(robot)
    robot.check_moved("payload.link", robot.tip if payload.link is None else payload.link)
    return payload


def blend_radii(value: object, count: int) -> tuple[float, ...]:
    """The blend radius of each of `count` waypoints; a single number stands for all of them."""
    blends = numbers(value)
    if blends is not None and blends.ndim == 0 and count:
        blends = np.full(count, blends)
    has_blends = blends is None or blends.size > 0
    if has_blends and not count:
        raise InputError(f"blend is {shown(value)}; there are no waypoints: leave out blend, or add some")
    if (
        blends is None
        or (has_blends and blends.shape != (count,))
        or not ((blends == 0) | ((blends >= MIN_BLEND) & (blends <= MAX_BLEND))).all()
    ):
        raise InputError(
            f"blend is {shown(value)}; it must be one number for all {count} waypoints, or one for each: 0 "
            f"to stop there, or from {MIN_BLEND:g} to {MAX_BLEND:g}"
        )
    return tuple(blends.tolist()) if has_blends else (0.0,) * count


def check_contacts(robot: Robot, scene: Scene) -> None:
    """Raises InputError for allowed contacts of links that the robot lacks."""
    for obstacle, links in scene.allowed_contacts:
        for link in () if links == ALL_LINKS else links:
            check_name(f"link in allowed_contacts of {obstacle}:", link, robot.link_names)


def moving_obstacles(moving: Any, scene: Scene) -> tuple[MovingObstacle, ...]:
    """The obstacles, renamed where a shape of the scene or an earlier moving obstacle has the same name."""
    check_list("moving", moving, MovingObstacle, "rd.MovingObstacle")
    shapes = Scene([*scene.shapes, *(obstacle.shape for obstacle in moving)]).shapes[len(scene.shapes) :]
    return tuple(
        obstacle if obstacle.shape is shape else replace(obstacle, shape=shape)
        for obstacle, shape in zip(moving, shapes, strict=True)
    )


def velocity_at_start(robot: Robot, value: object, notes: list[str]) -> JointValues | None:
    """The start velocity; None if the absolute values of all its numbers are below MIN_RATE.

    Values up to VELOCITY_SLACK beyond a limit are clamped to it, each with a note in `notes`.
    """
    if value is None:
        return None
    velocity = numbers(value)
    names = ", ".join(robot.joint_names)
    if velocity is None or velocity.shape != (robot.dof,) or not np.isfinite(velocity).all():
        raise InputError(
            f"start_velocity is {shown(value)}; it must be {counted(robot.dof, 'finite number')} "
            f"[rad/s] or [m/s]: {names}"
        )
    within = np.clip(velocity, -robot.velocity, robot.velocity)
    for j in np.flatnonzero((velocity != within) & (robot.velocity > 0)):  # 0: no limit
        name = robot.joint_names[j]
        limit = robot.velocity[j]
        if abs(velocity[j] - within[j]) > VELOCITY_SLACK * limit:
            velocity_text, _, limit_text = distinct(velocity[j], -limit, limit)
            raise InputError(f"start_velocity: {name} is {velocity_text}; its velocity limit is {limit_text}")
        notes.append(f"start_velocity: {name} clamped from {velocity[j]} to its limit {within[j]}")
        velocity[j] = within[j]
    return velocity if (np.abs(velocity) >= MIN_RATE).any() else None


def checked_goal(robot: Robot, field: str, goal: object, notes: list[str]) -> Goal:
    """The goal as one of the classes of `Goal`, with its configurations within the joint limits."""
    if isinstance(goal, list | tuple):
        goal = [_values(robot, f"{field}[{i}]", each) for i, each in enumerate(goal)]
        if any(isinstance(each, Goal) for each in goal):
            goals = list[Any]()
            for i, each in enumerate(goal):
                with located(f"{field}[{i}]"):
                    goals.append(each if isinstance(each, Goal) else JointGoal(each))
            goal = AnyGoal(tuple(goals))
    if isinstance(goal, AnyGoal):
        fields = (f"{field}.goals[{i}]" for i in range(len(goal.goals)))
        each = [
            checked_goal(robot, *named_goal, notes) for named_goal in zip(fields, goal.goals, strict=True)
        ]
        return AnyGoal(tuple(each))  # type: ignore[arg-type]
    if isinstance(goal, PoseGoal):
        robot.check_moved(f"{field}.frame", goal.frame)
        return goal
    goal = _values(robot, field, goal)
    if isinstance(goal, PosesGoal):
        _check_independent_links(robot, field, goal)
        return goal
    with located(field):
        goal = goal if isinstance(goal, JointGoal) else JointGoal(goal)  # type: ignore[arg-type]
    rows = goal.positions
    fields = [field] if len(rows) == 1 else [f"{field}[{i}]" for i in range(len(rows))]
    return JointGoal(
        np.stack([checked_configuration(robot, *row, notes) for row in zip(fields, rows, strict=True)])
    )


def _check_independent_links(robot: Robot, field: str, goal: PosesGoal) -> None:
    """Raises InputError unless planned joints move each link, and any two relative to each other."""
    parts = dict[int, str]()
    for pose in goal.poses:
        robot.check_moved(f"{field}.poses", pose.frame)
        linked = parts.setdefault(robot.link_frame(pose.frame), pose.frame)
        if linked != pose.frame:
            raise InputError(
                f"{field}.poses: {linked} and {pose.frame} are one rigid part; give the pose of one of them"
            )


def _values(robot: Robot, field: str, value: Any) -> Any:
    """The planned joint values for the name of a stored configuration of the robot (`robot.poses`), for a
    dict by joint, and for a series or a table of pandas with joints as labels or columns; any other value is
    returned unchanged."""
    if isinstance(value, str):
        return named_pose(robot, field, value)
    joint_names = [joint.name for joint in robot.joints]
    labels = list(value.keys()) if hasattr(value, "keys") else []
    if not isinstance(value, Mapping) and not any(name in joint_names for name in labels):
        return value
    for name in labels:
        check_name(f"joint in {field}:", name, joint_names)
    values = robot.planned_values(field, {name: value[name] for name in labels})
    return values if isinstance(value, Mapping) else np.transpose(values)


def configuration(robot: Robot, field: str, value: object) -> Configuration:
    """The planned joint values; `value` is a list of numbers, a dict by joint or the name of a pose."""
    q = numbers(_values(robot, field, value))
    names = ", ".join(robot.joint_names)
    if q is None or q.ndim != 1:
        raise InputError(
            f"{field} is {shown(value)}; it must be a list of {counted(robot.dof, 'number')}: {names}"
        )
    if len(q) != robot.dof:
        raise InputError(
            f"{field} has {counted(len(q), 'value')}; {robot.name} has "
            f"{counted(robot.dof, 'planned joint')}: {names}"
        )
    return q


def checked_configuration(robot: Robot, field: str, value: object, notes: list[str]) -> Configuration:
    """The configuration within the joint limits.

    Values up to LIMIT_SLACK beyond a limit are clamped to it, each with a note in `notes`.
    """
    values = zip(robot.planned_joints, configuration(robot, field, value), strict=True)
    return np.array([_position(field, joint, position, notes) for joint, position in values])


def _position(field: str, joint: Joint, value: float, notes: list[str]) -> float:
    unit = joint.unit
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
        value_text, lower, upper = distinct(value, joint.lower, joint.upper)
        raise InputError(
            f"{field}: {joint.name} is {value_text} {unit}; its limits are {lower} to {upper}{hint}"
        )
    if value != within:
        notes.append(f"{field}: {joint.name} clamped from {float(value)!r} to its limit {within!r} {unit}")
    return within


MAX_CLEARANCE = 0.5
"""Largest clearance that can be requested [m]; hardly any motion of an arm has a larger one."""
OPTIMISTIC = "optimistic"
PADDED = "padded"
PREDICTED = "predicted"
OCCUPIED = "occupied"
UNKNOWN_POLICIES = (OPTIMISTIC, PADDED, PREDICTED, OCCUPIED)
"""Policies for space that no view observed. `optimistic` assumes that it is free; `padded`, that it is free
except near observed surfaces; `predicted`, that it is occupied where the occupancy completion network
predicts obstacles; `occupied`, that all of it is occupied. See `planning/pipeline/unknown_space.py`."""
EXCLUSIVE_FIELDS = (
    ("cartesian_line", "waypoints", ": plan from one waypoint to the next"),
    ("waypoints", "views", ": plan from one waypoint to the next"),
    ("start_velocity", "views", ""),
    ("start_velocity", "waypoints", ""),
    ("start_velocity", "constraints", ""),
    ("start_velocity", "moving", ""),
    ("start_velocity", "payload", ""),
    ("moving", "views", ""),
    ("moving", "blend", ": among moving obstacles, motions stop at waypoints; leave out blend"),
)
"""Pairs of fields that cannot be combined, and advice for the message."""


class ProblemOptions(TypedDict, total=False):
    """What the constructors accept for the optional fields of `Problem`."""

    notes: tuple[str, ...]
    clearance: float | None
    views: Sequence[DepthView]
    unknown: str | None
    waypoints: Sequence[ArrayLike | Goal | Sequence[OneGoal | ArrayLike]]
    constraints: Sequence[Constraint]
    moving: Sequence[MovingObstacle]
    start_velocity: ArrayLike | None
    blend: ArrayLike
    payload: Payload | None


@dataclass(frozen=True)
class StateValidity:
    """Whether a configuration is free, and if not, why. It is true if the configuration is free: `if
    problem.is_free(q):`."""

    reason: str = ""
    """Why the configuration is not free: a joint out of limits, or the deepest contact."""
    links: tuple[str, ...] = ()
    """All links that touch an obstacle or another link, the deepest contact first."""

    def __bool__(self) -> bool:
        return not self.reason


@no_type_check
@frozen_dataclass
class Problem(Value):
    """A planning problem. Lengths in [m], angles in [rad], poses in the frame of the robot's base.

    `start` accepts a configuration, a dict of values by joint (values of joints that are not planned are
    ignored), or the name of a pose of the robot (`robot.poses`), such as "ready". `goal` accepts these, a
    list of configurations, a JointGoal, a PoseGoal, a PosesGoal, an AnyGoal, or a list of goals, any of which
    may be reached. Each waypoint accepts what `goal` accepts.

    Values up to `LIMIT_SLACK` beyond a joint limit are clamped, with a note. Values of continuous joints are
    not changed: a goal may be reached any number of full turns away. Planners, not this class, detect
    collisions of start and goal.

    With views, `scene` holds the given shapes and the points that the views observed (`SeenPoints`).

    Raises:
        InputError: For everything that no planner could work with, such as wrong lengths, values that are not
            finite or out of limits, and a goal frame that no planned joint moves.
    """

    robot: Robot
    """The robot, with the tool and the objects that it holds."""
    scene: Scene
    """The obstacles, in the frame of the base."""
    start: Configuration
    """Start configuration [dof]."""
    goal: Goal
    """The goal, in the frame of the base."""
    _: KW_ONLY
    notes: tuple[str, ...] = ()
    """Changes that were made to the input, e.g. a start that was clamped to a limit."""
    clearance: float | None = None
    """Distance to obstacles [m] that is kept where start, goal and passages allow it; None: the planning
    call's default."""
    views: tuple[DepthView, ...] = ()
    """Depth images of the scene."""
    unknown: str | None = None
    """Policy for space that no view observed, one of UNKNOWN_POLICIES; None: predicted if the completion
    network covers the arm's whole reach, else padded. Ignored without views."""
    T_world_base: Pose | None = None
    """Pose of the base in the world, for files and pictures; None: the base's frame is the world's frame.
    Scene, goal and views of a Problem are always in the base's frame; `in_world` accepts them in the
    world's."""
    waypoints: tuple[Goal, ...] = ()
    """Goals to reach before `goal`, in this order. The motion stops at waypoints whose `blend` is 0."""
    constraints: tuple[Constraint, ...] = ()
    """Path constraints, which hold along the whole motion."""
    moving: tuple[MovingObstacle, ...] = ()
    """Moving obstacles; the motion begins at their time 0. `scene` holds the static obstacles."""
    start_velocity: JointValues | None = None
    """Joint velocities at the start [rad/s] or [m/s]; None, or absolute values all below 1e-6: the motion
    starts at rest."""
    blend: tuple[float, ...] = ()
    """For each waypoint, the distance within which the motion may pass it without stopping; 0: the motion
    stops there. For a configuration it is the Euclidean distance in joint space [rad], for a pose the
    distance from its position or from its box of tolerances [m]. One number stands for all waypoints; empty:
    the motion stops at all of them."""
    payload: Payload | None = None
    """Load on a link. The timed motion then keeps the effort limits; None: effort limits are ignored."""

    def __post_init__(self) -> None:
        if self.unknown is not None:
            check_unknown("unknown", self.unknown)
        robot = self.robot
        check_robot(robot)
        check_type("scene", self.scene, Scene, "a Scene, e.g. rd.Scene([shape, ...])")
        check_contacts(robot, self.scene)
        check_list("notes", self.notes, str, "texts")
        notes = list(self.notes)
        T = self.T_world_base
        checked: dict[str, Any] = {
            "clearance": None if self.clearance is None else check_clearance(self.clearance),
            "start": checked_configuration(robot, "start", self.start, notes),
            "goal": checked_goal(robot, "goal", self.goal, notes),
            "waypoints": waypoint_goals(robot, self.waypoints, notes),
            "payload": checked_payload(robot, self.payload),
            "constraints": path_constraints(robot, self.constraints),
            "views": depth_views(robot, self.views),
            "moving": moving_obstacles(self.moving, self.scene),
            "start_velocity": velocity_at_start(robot, self.start_velocity, notes),
            "T_world_base": T if T is None else rigid_transform("T_world_base", T),
            "notes": tuple(notes),
        }
        checked["blend"] = blend_radii(self.blend, len(checked["waypoints"]))
        _check_combinations(checked)
        if checked["views"]:
            from robotdiffuse.perception.seen_points import seen_shapes  # compiled code

            known_scene = self.known_scene
            joint_goals = [
                goal.positions for goal in goals_of(checked["goal"]) if isinstance(goal, JointGoal)
            ]
            goals = np.concatenate(joint_goals or [checked["start"][None]])
            seen = seen_shapes(checked["views"], robot, known_scene, checked["start"], goals)
            checked["scene"] = added(known_scene, seen)
        for name, value in checked.items():
            object.__setattr__(self, name, value)
        super().__post_init__()

    def __repr__(self) -> str:
        more = ("views", "waypoints", "constraints", "moving")
        counts = "".join(f", {len(getattr(self, name))} {name}" for name in more if getattr(self, name))
        ends = f"start={short(self.start)}, goal={short(self.goal)}"
        return f"Problem({self.robot.name!r}, {self.scene!r}, {ends}{counts})"

    if TYPE_CHECKING:

        def __init__(
            self,
            robot: Robot,
            scene: Scene,
            start: AnyConfiguration,
            goal: AnyConfiguration | Goal | Sequence[OneGoal | AnyConfiguration],
            *,
            T_world_base: ArrayLike | None = None,
            **options: Unpack[ProblemOptions],
        ) -> None: ...

    @classmethod
    def in_world(
        cls,
        T_world_base: ArrayLike,
        robot: Robot,
        scene: Scene,
        start: AnyConfiguration,
        goal: "AnyConfiguration | Goal | Sequence[OneGoal | AnyConfiguration]",
        **options: Unpack[ProblemOptions],
    ) -> "Problem":
        """Make a problem in the frame of the world, for a robot whose base stands anywhere in it.

        Scene, poses of goals and waypoints, views, constraints and moving obstacles are given in the frame of
        the world; the problem stores them in the frame of the base.

        Args:
            T_world_base: Pose of the base [4, 4].
            robot: The robot.
            scene: Obstacles.
            start: Start configuration [dof], values by joint, or the name of a pose.
            goal: A goal, as `rd.Problem` accepts it.
            options: Further fields of `rd.Problem`.

        Returns:
            The problem, in the frame of the base.

        Raises:
            InputError: As the constructor does.
        """
        T = rigid_transform("T_world_base", T_world_base)
        T_base_world = inverse(T)
        moved_options = {name: moved(value, T_base_world) for name, value in options.items()}
        scene = moved(scene, T_base_world)
        goal = moved(goal, T_base_world)
        return cls(robot, scene, start, goal, T_world_base=T, **moved_options)  # type: ignore[arg-type]

    def robot_and_scene_in_world(self) -> tuple[Robot, Scene]:
        """Place the robot and the scene in the world, for pictures and simulators.

        Returns:
            The robot, with the world as its base, and the scene in the frame of the world; both unchanged if
            the problem has no `T_world_base`.
        """
        T = self.T_world_base
        return (self.robot, self.scene) if T is None else (self.robot.placed_in_world(T), self.scene.moved(T))

    @property
    def moving_in_world(self) -> tuple[MovingObstacle, ...]:
        """The moving obstacles in the world's frame, for pictures and simulators."""
        T = self.T_world_base
        return self.moving if T is None else tuple(obstacle.moved(T) for obstacle in self.moving)

    def clearance_at(self, q: ArrayLike) -> float | Values:
        """Lower bound of the distance of the arm to obstacles and between its links.

        It is the distance of the spheres that cover the links, so it may be some millimeters below zero
        although the links touch nothing. Moving obstacles are ignored.

        Args:
            q: A configuration [dof], or several [n, dof].

        Returns:
            The bound [m], one for each row. If it is positive, the arm is free of collision. It is capped at
            1 m, or at 0.3 m in scenes with point clouds or meshes.

        Raises:
            InputError: For q of the wrong shape, and numbers that are not finite or beyond ±1e4.
        """
        from robotdiffuse.collision import CollisionChecker  # compiled code

        rows = configurations(self.robot, q)
        checker = CollisionChecker(self.robot, self.scene)
        pairs = checker.robot_arrays.pairs.copy()
        pairs[:, 2] = -1  # no tables: they tell whether links touch, but not their distance
        checker.robot_arrays = checker.robot_arrays._replace(pairs=pairs)
        batch = np.atleast_2d(rows)
        each = np.hstack([checker.link_clearances(batch), checker.pair_clearances(batch)])
        clearances = each.min(axis=1, initial=1.0).astype(np.float64)
        return float(clearances[0]) if rows.ndim == 1 else clearances

    def is_free(self, q: AnyConfiguration) -> "StateValidity":
        """Whether the arm is within its limits and free of collision.

        The exact meshes decide, as for starts and goals. Moving obstacles and path constraints are ignored.

        Args:
            q: A configuration [dof], values by joint, or the name of a pose.

        Returns:
            A value that is true if the arm is free, for `if problem.is_free(q)`; otherwise its `reason` says
            why not.

        Raises:
            InputError: For q of the wrong shape, an unknown name, and values that lack a planned joint.

        Examples:
            >>> scene = rd.Scene([rd.Sphere([0.5, 0, 0.5], 0.2)])
            >>> problem = rd.Problem(rd.load_robot("panda"), scene, "ready", "extended")
            >>> bool(problem.is_free("ready"))
            False
        """
        from robotdiffuse.collision.exact_meshes import contact_message, contacts_at  # compiled code

        robot = self.robot
        row = configuration(robot, "q", q)
        try:
            row = checked_configuration(robot, "q", row, [])
        except InputError as error:
            return StateValidity(str(error).removeprefix("q: "))
        contacts = contacts_at(robot, self.scene, row)
        if not contacts:
            return StateValidity()
        touching = [name for contact in contacts for name in contact[:2] if name in robot.link_names]
        return StateValidity(contact_message(robot, contacts[0]), tuple(dict.fromkeys(map(str, touching))))

    @property
    def known_scene(self) -> Scene:
        """The scene as it was given: without the points that the views observed."""
        shapes = [shape for shape in self.scene.shapes if not isinstance(shape, SeenPoints)]
        return self.scene if len(shapes) == len(self.scene.shapes) else self.scene.with_shapes(shapes)

    load: ClassVar[Callable[..., "Problem"]]
    """`problems.files.load_problem`; the package assigns it, because files.py imports this module."""
    record: ClassVar[Callable[..., dict[str, object]]]
    """`problems.files.problem_record`, assigned by the package as well."""


def check_problem(problem: object, field: str = "problem") -> None:
    """Raises InputError for anything but a Problem; for a file's name, the message says how to read it."""
    hint = "e.g. rd.Problem(robot, scene, start, goal)"
    if isinstance(problem, str | PurePath):
        hint = f"rd.load_problem({shown(str(problem))}) reads one from a file"
    check_type(field, problem, Problem, f"a Problem: {hint}")


def check_clearance(value: object) -> float:
    """The value as a distance [m]. Raises InputError unless it is from 0 to MAX_CLEARANCE."""
    wanted = f"a distance from 0 to {MAX_CLEARANCE:g} m"
    return float(bounded("clearance", value, (), 0.0, MAX_CLEARANCE, wanted))


def check_unknown(field: str, value: object) -> str:
    """The value, if it is one of UNKNOWN_POLICIES. Raises InputError for anything else."""
    check_name(f"policy in {field}:", value, UNKNOWN_POLICIES)
    return str(value)


def is_given(value: object) -> bool:
    """Whether the value of a field of a problem was given: neither None nor an empty tuple."""
    return not (value is None or (isinstance(value, tuple) and not value))


def _check_combinations(checked: dict[str, Any]) -> None:
    given_fields = {name for name, value in checked.items() if is_given(value)}
    if not any(checked["blend"]):
        given_fields.discard("blend")
    if any(isinstance(constraint, CartesianLine) for constraint in checked["constraints"]):
        given_fields.add("cartesian_line")
    for field, excluded, advice in EXCLUSIVE_FIELDS:
        if field in given_fields and excluded in given_fields:
            raise InputError(f"{field} cannot be combined with {excluded}{advice}")


def moved(value: Any, T: Pose) -> Any:
    """The value, or each item of a list, after the rigid motion T. A value without a pose is not changed."""
    if isinstance(value, list | tuple):
        return [moved(item, T) for item in value]
    return value.moved(T) if hasattr(value, "moved") and not isinstance(value, type) else value
