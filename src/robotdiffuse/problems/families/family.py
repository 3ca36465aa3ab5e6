"""Family: the protocol of random problem generators, and how they sample starts and goals."""

from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Any, ClassVar, Protocol, runtime_checkable

import numpy as np
from numpy.random import Generator

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.core.errors import InputError
from robotdiffuse.core.settings import Natural, Positive, Settings
from robotdiffuse.core.types import (
    NO_SPHERES,
    Configuration,
    Configurations,
    JointRows,
    Mask,
    Pose,
    Spheres,
    frozen_dataclass,
)
from robotdiffuse.problems.problem import JointGoal, Problem
from robotdiffuse.robots.inverse_kinematics import InverseKinematicsSettings, inverse_kinematics
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.shapes import Box, Corners, Sphere

Range = tuple[float, float]
PositiveRange = tuple[Positive, Positive]
NaturalRange = tuple[Natural, Natural]
"""A range that is sampled uniformly; equal bounds fix the value."""


class Ranges(Settings):
    """Settings whose pairs of numbers are ranges to sample from."""

    def __post_init__(self) -> None:
        """Raises InputError also for a range whose first number is larger than the second."""
        super().__post_init__()
        for name, value in self.to_json().items():
            # a pair of strings, such as `Rop.kinds`, is no range
            pair = value if isinstance(value, tuple) and len(value) == 2 else (0, 0)
            if not (isinstance(pair[0], str) or pair[0] <= pair[1]):
                raise InputError(f"{name} is from {pair[0]} to {pair[1]}; the first must not be greater")


# Kinds of targets: a goal configuration, a position of the robot's tip, or its pose.
CONFIGURATION = "configuration"
POSITION = "position"
POSE = "pose"

BATCH_SIZE = 64
"""Number of configurations in a batch; usually many of them are collision-free."""
MAX_BATCHES = 8
"""Number of batches sampled in one scene, at most: some scenes leave hardly any free space."""
MAX_SCENES = 100
"""Sampling fails with an error after this many scenes without a free start or goal."""
LIMIT_MARGIN = 1e-3
"""A joint this close to a limit counts as clipped by inverse kinematics [rad] or [m]."""
POSE_IK = InverseKinematicsSettings(max_rounds=4, patience=2)
"""Settings of the inverse kinematics of targets. The rounds are few: a target inside an obstacle is
unreachable, and sampling another target is faster than searching for long."""
MIN_POSE_DOF = 6
"""Minimum number of joints for an arm to reach arbitrary poses."""
POSITION_IK = replace(POSE_IK, position_only=True)


@frozen_dataclass
class SampledProblem:
    """A random problem. All of its goals bring the tip to the same target."""

    scene: Scene
    """The scene; its first shape is the floor, if the family has one."""
    start: Configuration
    goals: Configurations
    T_base_tip: Pose
    """Target pose of the tip. If the target is only a position, the first goal gives the orientation."""

    def problem(self, robot: Robot) -> Problem:
        """Make the problem of reaching any of the goals; joints may end whole turns away from a goal.

        Args:
            robot: The robot for which the problem was drawn.

        Returns:
            The problem, with all goal configurations.
        """
        goals = np.concatenate([robot.equivalent_configurations(goal, self.start) for goal in self.goals])
        return Problem(robot, self.scene, self.start, JointGoal(goals))


@runtime_checkable
class Family(Protocol):
    """Random problems of one kind. A new family is a file with such an object and a line in FAMILIES."""

    __dataclass_fields__: ClassVar[dict[str, Any]]
    """The settings, which data sets store."""

    @property
    def floor(self) -> Box | None:
        """The first shape of every scene; None if the scenes have no floor."""
        ...

    @property
    def max_obstacles(self) -> int:
        """Maximum number of obstacles of a scene, without the floor."""
        ...

    def scene(self, rng: Generator, keep_out: Spheres | None = None) -> Scene:
        """Draw a scene.

        Args:
            rng: Random generator.
            keep_out: Spheres (x, y, z, radius) [n, 4] that only the floor may intersect [m]; None: none.

        Returns:
            The scene; the floor is its first shape, if the family has one.
        """
        ...

    def draw(
        self, robot: Robot, rng: Generator, goals: int = 1, target: str = CONFIGURATION
    ) -> SampledProblem:
        """Draw a problem. Obstacles do not intersect the robot's fixed base.

        Args:
            robot: The robot.
            rng: Random generator; the same state gives the same problem.
            goals: Largest number of goal configurations.
            target: What the goals reach: a "configuration", or a "position" or "pose" of the tip.

        Returns:
            The problem, with a start and goals that are free of collision.

        Raises:
            InputError: If no such problem was found for this robot.
        """
        ...


def sample_until_found(
    draw: Callable[[], SampledProblem | None], family: Family, robot: Robot
) -> SampledProblem:
    """The first problem that `draw` returns. Each call tries one scene; None means it has no free start or
    goal."""
    for _ in range(MAX_SCENES):
        problem = draw()
        if problem is not None:
            return problem
    raise InputError(
        f"no free start and goal in {MAX_SCENES} scenes of {type(family).__name__} for {robot.name}; "
        f"check that its tip {robot.tip} can reach the targets of these scenes"
    )


def uniform_configurations(
    robot: Robot, region: Corners, checker: CollisionChecker, count: int, rng: Generator
) -> JointRows:
    """Up to `count` collision-free configurations with the origin of the tip link in the region.

    They are uniform within the joint limits. Fewer are returned if MAX_BATCHES batches contain fewer.
    """
    configurations = np.zeros((0, robot.dof))
    for _ in range(MAX_BATCHES):
        q = robot.unwound(rng.uniform(robot.lower, robot.upper, (BATCH_SIZE, robot.dof)))
        xyz = robot.fk(q)[:, :3, 3]
        q = q[((xyz >= region[0]) & (xyz <= region[1])).all(axis=1)]
        configurations = np.concatenate([configurations, q[checker.free(q)] if len(q) else q])
        if len(configurations) >= count:
            break
    return configurations[:count]


def reaching_configurations(
    robot: Robot,
    T_base_tip: Pose,
    count: int,
    checker: CollisionChecker,
    rng: Generator,
    settings: InverseKinematicsSettings = POSE_IK,
) -> JointRows:
    """Up to `count` free configurations with the tip at its target. Arms with fewer than six joints only
    reach the position.

    The result is float32, as in data sets, so that the validator gets exactly the stored values. Solutions
    with a joint at a limit are left out: the solver clips joints to their limits, and clipped configurations
    would be far more frequent than others.
    """

    def accept(q: Configurations) -> Mask:
        inside = ((q > robot.lower + LIMIT_MARGIN) & (q < robot.upper - LIMIT_MARGIN)).all(axis=1)
        return inside & checker.free(q)

    settings = replace(settings, position_only=True) if robot.dof < MIN_POSE_DOF else settings
    q = inverse_kinematics(robot, robot.tip, T_base_tip, count, rng=rng, accept=accept, settings=settings)
    return robot.unwound(q).astype(np.float32)


def between_targets(
    robot: Robot,
    scene: Scene,
    checker: CollisionChecker,
    targets: Iterable[Pose],
    goals: int,
    rng: Generator,
    settings: InverseKinematicsSettings = POSE_IK,
) -> SampledProblem | None:
    """A problem whose start reaches the first of two targets, and whose goals, up to `goals` configurations,
    reach the second; None if no free configuration reaches one of the targets. The second target is drawn
    after the first is reached, and not otherwise."""
    reached = []
    T_base_tip = np.eye(4)
    for T_base_tip, count in zip(targets, (1, goals), strict=True):
        reached.append(reaching_configurations(robot, T_base_tip, count, checker, rng, settings))
        if not len(reached[-1]):
            return None
    (start,), q = reached
    if settings.position_only or robot.dof < MIN_POSE_DOF:
        T_base_tip = robot.fk(q[0])
    return SampledProblem(scene, start, q, T_base_tip)


def base_spheres(robot: Robot) -> Spheres:
    """Collision spheres (x, y, z, radius) of the links that no planned joint moves, in the base frame [m]."""
    fixed = [link for link in robot.spheres if robot.link_frame(link) == 0]
    return np.concatenate([NO_SPHERES, *map(robot.frame_spheres, fixed)])


def is_clear_of(shape: Sphere | Box, keep_out: Spheres | None) -> bool:
    """Whether a shape intersects none of the spheres (x, y, z, radius)."""
    if keep_out is None:
        return True
    local = keep_out[:, :3] - shape.center
    if isinstance(shape, Sphere):
        distance = np.linalg.norm(local, axis=1) - shape.radius
    else:
        beyond = np.maximum(0, np.abs(local @ shape.rotation) - shape.size / 2)
        distance = np.linalg.norm(beyond, axis=1)
    return bool((distance > keep_out[:, 3]).all())
