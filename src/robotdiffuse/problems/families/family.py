"""What a family of random problems is, and how all of them draw starts and goals."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray
from numpy.random import Generator

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.core.errors import InputError
from robotdiffuse.core.settings import Positive, Settings
from robotdiffuse.problems.problem import JointGoal, Problem
from robotdiffuse.robots.inverse_kinematics import InverseKinematicsSettings, inverse_kinematics
from robotdiffuse.robots.kinematics import link_origins
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.shapes import Box, Sphere

Range = tuple[float, float]
PositiveRange = tuple[Positive, Positive]
"""Drawn from uniformly; equal ends fix the value."""


class Ranges(Settings):
    """Settings whose pairs of numbers are ranges that are drawn from."""

    def __post_init__(self) -> None:
        """Raises InputError, too, for a range whose first number is the greater one."""
        super().__post_init__()
        for name, value in self.to_json().items():
            pair = value if isinstance(value, tuple) and len(value) == 2 else (0, 0)
            if not (isinstance(pair[0], str) or pair[0] <= pair[1]):
                raise InputError(f"{name} is from {pair[0]} to {pair[1]}; the first must not be greater")


CONFIGURATION, POSITION, POSE = "configuration", "position", "pose"
"""What is given of the goal: a configuration, the position of the robot's tip, or its whole pose."""

BATCH = 64
"""Configurations drawn at once; a good part of them is usable."""
BATCHES = 8
"""Draws before a scene is given up: a few leave hardly any room."""
SCENES = 100
"""Scenes given up, for want of a start or of a goal, before a family is called impossible."""
AT_LIMIT = 1e-3
"""Joints closer than this to a limit count as clipped [rad]."""
FULL_POSE = InverseKinematicsSettings(max_rounds=4, patience=2)
"""A few rounds: a target inside an obstacle is better drawn anew than searched for long."""
POSE_JOINTS = 6
"""Joints that any pose takes."""
POSITION_ONLY = replace(FULL_POSE, position_only=True)


@dataclass(frozen=True, eq=False)
class Drawn:
    """A random problem. With several goals, all of them bring the tip to one target."""

    scene: Scene
    """The floor first, if the family has one."""
    start: Float[ndarray, "dof"]
    goals: Float[ndarray, "k dof"]
    T_base_tip: Float[ndarray, "4 4"]
    """The target; where only its position is given, the orientation is that of the first goal."""

    def problem(self, robot: Robot) -> Problem:
        """Any of the goals will do, and any of whole turns of their joints."""
        goals = np.concatenate([robot.equivalent_configurations(goal, self.start) for goal in self.goals])
        return Problem(robot, self.scene, self.start, JointGoal(goals))


@runtime_checkable
class Family(Protocol):
    """Random problems of one kind. A new family is a file with one of these and a line in FAMILIES."""

    __dataclass_fields__: ClassVar[dict[str, Any]]
    """Its settings, which data sets keep."""

    @property
    def floor(self) -> Box | None:
        """The first shape of every scene; None if they have no floor."""
        ...

    @property
    def region(self) -> Float[ndarray, "2 3"]:
        """Low and high corner of where the robot's tip is at start and goal [m]."""
        ...

    @property
    def most_obstacles(self) -> int:
        """Of a scene, the floor left out."""
        ...

    def scene(self, rng: Generator, keep_out: Float[ndarray, "m 4"] | None = None) -> Scene:
        """A random scene. `keep_out` are spheres, x y z radius, that nothing but the floor may enter."""
        ...

    def draw(self, robot: Robot, rng: Generator, goals: int = 1, target: str = CONFIGURATION) -> Drawn:
        """A random problem with up to so many goals; the same state of `rng` gives the same one.

        Obstacles stay clear of the robot's immovable base; start and goals are free of collision. Raises
        InputError if the family leaves this robot no such problem.
        """
        ...


def first_drawn(draw: Callable[[], Drawn | None], family: Family, robot: Robot) -> Drawn:
    """The first problem that `draw` makes: it draws a scene anew and gives None if that has no ends."""
    for _ in range(SCENES):
        drawn = draw()
        if drawn is not None:
            return drawn
    raise InputError(
        f"no free start and goal in {SCENES} scenes of {type(family).__name__} for {robot.name}: its tip "
        f"{robot.tip} cannot be where these scenes want it"
    )


def uniform_configurations(
    robot: Robot, region: Float[ndarray, "2 3"], checker: CollisionChecker, count: int, rng: Generator
) -> Float[ndarray, "k dof"]:
    """Up to `count` configurations, uniform within the joint limits among those that are free of collision
    and have the origin of the tip link in the region; fewer where a number of draws found no more."""
    found = np.zeros((0, robot.dof))
    for _ in range(BATCHES):
        q = robot.unwound(rng.uniform(robot.lower, robot.upper, (BATCH, robot.dof)))
        xyz = link_origins(robot, q, robot.tip)
        q = q[((xyz >= region[0]) & (xyz <= region[1])).all(axis=1)]
        found = np.concatenate([found, q[checker.free(q)] if len(q) else q])
        if len(found) >= count:
            break
    return found[:count]


def reaching_configurations(
    robot: Robot,
    T_base_tip: Float[ndarray, "4 4"],
    count: int,
    checker: CollisionChecker,
    rng: Generator,
    settings: InverseKinematicsSettings = FULL_POSE,
) -> Float[ndarray, "k dof"]:
    """Up to `count` free configurations with the tip at its target, as float32: what data hold, so that the
    validator sees exactly these. Arms of fewer than six joints reach positions alone.

    Solutions with a joint at a limit, where the solver clips it, would be far too many, and are left out.
    """

    def accept(q: Float[ndarray, "n dof"]) -> Bool[ndarray, "n"]:
        inside = ((q > robot.lower + AT_LIMIT) & (q < robot.upper - AT_LIMIT)).all(axis=1)
        return inside & checker.free(q)

    settings = replace(settings, position_only=True) if robot.dof < POSE_JOINTS else settings
    q = inverse_kinematics(robot, robot.tip, T_base_tip, count, rng=rng, accept=accept, settings=settings)
    return robot.unwound(q).astype(np.float32)


def base_spheres(robot: Robot) -> Float[ndarray, "m 4"]:
    """Collision spheres, x y z radius, of the links that no planned joint moves, in the base frame [m]."""
    parts = [np.zeros((0, 4))]
    for link, spheres in robot.spheres.items():
        if robot.link_frame(link) == 0:
            T = robot.T_frame_link(link)
            parts.append(np.column_stack([spheres[:, :3] @ T[:3, :3].T + T[:3, 3], spheres[:, 3]]))
    return np.concatenate(parts)


def keeps_out(shape: Sphere | Box, keep_out: Float[ndarray, "m 4"] | None) -> bool:
    """Whether a shape stays clear of spheres, x y z radius."""
    if keep_out is None:
        return True
    local = keep_out[:, :3] - shape.center
    if isinstance(shape, Sphere):
        distance = np.linalg.norm(local, axis=1) - shape.radius
    else:
        beyond = np.maximum(0, np.abs(local @ shape.rotation) - shape.size / 2)
        distance = np.linalg.norm(beyond, axis=1)
    return bool((distance > keep_out[:, 3]).all())
