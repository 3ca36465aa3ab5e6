"""ROP: the paper's family of random problems, with a few spheres and cubes around the arm."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.random import Generator

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.core.errors import InputError
from robotdiffuse.core.settings import OneOf
from robotdiffuse.core.transforms import transform
from robotdiffuse.problems.families.family import (
    CONFIGURATION,
    POSITION,
    POSITION_IK,
    NaturalRange,
    PositiveRange,
    Range,
    Ranges,
    SampledProblem,
    Spheres,
    base_spheres,
    between_targets,
    is_clear_of,
    reaching_configurations,
    sample_until_found,
    uniform_configurations,
)
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.shapes import IDENTITY, Box, Corners, Sphere

KINDS = ("sphere", "box")
FLOOR = Box((0.0, 0.0, -0.05), (2.0, 2.0, 0.1), name="floor")
"""A floor with its top at z = 0."""
MAX_TRIES = 1000
"""If this many samples of an obstacle all intersect the robot's base, the settings are rejected."""


@dataclass(frozen=True)
class Rop(Ranges):
    """The distribution of ROP scenes and problems. The defaults are those of the paper's code.

    Every range is sampled uniformly; equal bounds fix the value. Lengths in [m], in the robot's base frame.
    """

    obstacles: NaturalRange = (2, 2)
    """Minimum and maximum number of obstacles, inclusive."""
    kinds: tuple[Annotated[str, OneOf(KINDS)], ...] = KINDS
    """Kinds of obstacles to choose from: sphere, box (a cube)."""
    sphere_radius: PositiveRange = (0.25, 0.25)
    """The paper's spheres have a radius of 0.2, and its planner inflates them to 0.25: a margin of 5 cm."""
    cube_side: PositiveRange = (0.2, 0.2)
    x: Range = (-1.0, 1.0)
    """Coordinates of the obstacles' centers."""
    y: Range = (-1.0, 1.0)
    z: Range = (0.1, 1.0)
    yaw: bool = False
    """Whether cubes are rotated about the vertical axis."""
    tip_x: Range = (-0.6, 0.6)
    """Coordinates of the robot's tip at start and goal."""
    tip_y: Range = (-0.6, 0.6)
    tip_z: Range = (0.2, 0.8)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.obstacles[1] > 0 and not self.kinds:
            raise InputError(f"kinds is {self.kinds}; it must not be empty, as obstacles is {self.obstacles}")

    @property
    def floor(self) -> Box:
        return FLOOR

    @property
    def region(self) -> Corners:
        return np.array([self.tip_x, self.tip_y, self.tip_z]).T

    @property
    def max_obstacles(self) -> int:
        return self.obstacles[1]

    def scene(self, rng: Generator, keep_out: Spheres | None = None) -> Scene:
        """A random scene. keep_out: spheres (x, y, z, radius), e.g. of the robot's fixed base, that no
        obstacle may intersect; the floor may.

        Raises InputError if no place for an obstacle was found.
        """
        low, high = self.obstacles
        return Scene([self.floor, *(self._placed(rng, keep_out) for _ in range(rng.integers(low, high + 1)))])

    def _placed(self, rng: Generator, keep_out: Spheres | None) -> Sphere | Box:
        for _ in range(MAX_TRIES):
            shape = self._obstacle(rng)
            if is_clear_of(shape, keep_out):
                return shape
        raise InputError(
            f"x is {self.x}, y {self.y} and z {self.z}; no obstacle stays clear of the robot's base in "
            f"{MAX_TRIES} samples: widen these ranges"
        )

    def _obstacle(self, rng: Generator) -> Sphere | Box:
        kind = self.kinds[int(rng.integers(len(self.kinds)))]
        center = [rng.uniform(*self.x), rng.uniform(*self.y), rng.uniform(*self.z)]
        if kind == "sphere":
            return Sphere(center, rng.uniform(*self.sphere_radius))
        side = rng.uniform(*self.cube_side)
        # A quarter turn maps a cube to itself.
        angle = rng.uniform(-np.pi / 4, np.pi / 4) if self.yaw else 0.0
        wxyz = (np.cos(angle / 2), 0.0, 0.0, np.sin(angle / 2)) if self.yaw else IDENTITY
        return Box(center, (side, side, side), wxyz)

    def draw(
        self, robot: Robot, rng: Generator, goals: int = 1, target: str = CONFIGURATION
    ) -> SampledProblem:
        """A random problem; see `Family.draw`.

        With target `position`, the tip positions at start and goal are uniform in the region, as in the
        authors' code, and configurations come from inverse kinematics. Otherwise start and goal are uniform
        among the free configurations with the tip in the region; with `pose`, all goals share the tip's pose.
        """
        keep_out = base_spheres(robot)

        def attempt() -> SampledProblem | None:
            scene = self.scene(rng, keep_out)
            checker = CollisionChecker(robot, scene)
            if target != POSITION:
                return self._by_configuration(robot, scene, checker, goals, target, rng)
            targets = (transform(rng.uniform(*self.region)) for _ in range(2))
            return between_targets(robot, scene, checker, targets, goals, rng, POSITION_IK)

        return sample_until_found(attempt, self, robot)

    def _by_configuration(
        self,
        robot: Robot,
        scene: Scene,
        checker: CollisionChecker,
        goals: int,
        target: str,
        rng: Generator,
    ) -> SampledProblem | None:
        # Start and goal come from one call or from two. The distribution does not depend on this, but the
        # numbers drawn from rng do, and these must not change between versions.
        counts = (2,) if target == CONFIGURATION else (1, 1)
        samples = [uniform_configurations(robot, self.region, checker, count, rng) for count in counts]
        if sum(map(len, samples)) < 2:
            return None
        start, goal = np.concatenate(samples)
        T_base_tip = robot.fk(goal)
        if target == CONFIGURATION:
            return SampledProblem(scene, start, goal[None], T_base_tip)
        reached = goal[None].astype(np.float32)
        if goals > 1:
            additional = reaching_configurations(robot, T_base_tip, goals - 1, checker, rng)
            reached = np.concatenate([reached, additional])
        return SampledProblem(scene, start.astype(np.float32), reached, T_base_tip)


ROP = Rop()


ROP_DENSE = Rop(obstacles=(3, 12), sphere_radius=(0.08, 0.2), cube_side=(0.1, 0.3))
"""More obstacles, of varied size: in about half of these problems the straight line is blocked."""
