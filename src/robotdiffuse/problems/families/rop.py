"""ROP: the paper's family of random scenes, a few spheres and cubes around the arm."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from numpy.random import Generator

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.core.errors import InputError
from robotdiffuse.core.settings import Natural, OneOf
from robotdiffuse.problems.families.family import (
    CONFIGURATION,
    POSITION,
    POSITION_ONLY,
    Drawn,
    PositiveRange,
    Range,
    Ranges,
    base_spheres,
    first_drawn,
    keeps_out,
    reaching_configurations,
    uniform_configurations,
)
from robotdiffuse.robots.kinematics import link_pose
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.shapes import IDENTITY, Box, Sphere

KINDS = ("sphere", "box")
FLOOR = Box((0.0, 0.0, -0.05), (2.0, 2.0, 0.1), name="floor")
"""With its top at z = 0."""
MAX_TRIES = 1000
"""Draws of an obstacle before the settings are called impossible."""


@dataclass(frozen=True)
class Rop(Ranges):
    """What ROP scenes and problems are drawn from. The defaults are the paper's, as its code has them.

    Every range is drawn from uniformly; equal ends fix the value. Lengths in [m], in the robot's base frame.
    """

    obstacles: tuple[Natural, Natural] = (2, 2)
    """Least and greatest number of obstacles, both included."""
    kinds: tuple[Annotated[str, OneOf(KINDS)], ...] = KINDS
    """Drawn from for each obstacle: sphere, box (a cube)."""
    sphere_radius: PositiveRange = (0.25, 0.25)
    """The paper's planner sees 0.25 of spheres of 0.2: a margin of 5 cm."""
    cube_side: PositiveRange = (0.2, 0.2)
    x: Range = (-1.0, 1.0)
    """Centres of the obstacles."""
    y: Range = (-1.0, 1.0)
    z: Range = (0.1, 1.0)
    yaw: bool = False
    """Whether cubes are turned about the vertical."""
    tip_x: Range = (-0.6, 0.6)
    """Where the robot's tip is at the start and at the goal."""
    tip_y: Range = (-0.6, 0.6)
    tip_z: Range = (0.2, 0.8)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.obstacles[1] > 0 and not self.kinds:
            raise InputError(f"obstacles is {self.obstacles} and kinds {self.kinds}; they must allow a scene")

    @property
    def floor(self) -> Box:
        return FLOOR

    @property
    def region(self) -> Float[ndarray, "2 3"]:
        return np.array([self.tip_x, self.tip_y, self.tip_z]).T

    @property
    def most_obstacles(self) -> int:
        return self.obstacles[1]

    def scene(self, rng: Generator, keep_out: Float[ndarray, "m 4"] | None = None) -> Scene:
        """A random scene. `keep_out` are spheres, x y z radius, that no obstacle may enter: those of the
        robot's immovable base. The floor is not held against them.

        Raises InputError if the settings leave no place for an obstacle.
        """
        low, high = self.obstacles
        return Scene([self.floor, *(self._placed(rng, keep_out) for _ in range(rng.integers(low, high + 1)))])

    def _placed(self, rng: Generator, keep_out: Float[ndarray, "m 4"] | None) -> Sphere | Box:
        for _ in range(MAX_TRIES):
            shape = self._obstacle(rng)
            if keeps_out(shape, keep_out):
                return shape
        raise InputError(f"no obstacle stays clear of the robot's base in {MAX_TRIES} draws; widen x, y, z")

    def _obstacle(self, rng: Generator) -> Sphere | Box:
        kind = self.kinds[int(rng.integers(len(self.kinds)))]
        center = [rng.uniform(*self.x), rng.uniform(*self.y), rng.uniform(*self.z)]
        if kind == "sphere":
            return Sphere(center, rng.uniform(*self.sphere_radius))
        side = rng.uniform(*self.cube_side)
        # A quarter turn of a cube is the cube again.
        angle = rng.uniform(-np.pi / 4, np.pi / 4) if self.yaw else 0.0
        wxyz = (np.cos(angle / 2), 0.0, 0.0, np.sin(angle / 2)) if self.yaw else IDENTITY
        return Box(center, (side, side, side), wxyz)

    def draw(self, robot: Robot, rng: Generator, goals: int = 1, target: str = CONFIGURATION) -> Drawn:
        """Target `position`: the positions of the tip at start and goal are uniform in the region, as the
        authors' are; configurations come from inverse kinematics. Otherwise start and goal are uniform among
        the free configurations with the tip in the region; with `pose`, further goals share the tip's pose.
        """
        keep_out = base_spheres(robot)

        def attempt() -> Drawn | None:
            scene = self.scene(rng, keep_out)
            checker = CollisionChecker(robot, scene)
            ends = self._by_position if target == POSITION else self._by_configuration
            return ends(robot, scene, checker, goals, target, rng)

        return first_drawn(attempt, self, robot)

    def _by_position(
        self, robot: Robot, scene: Scene, checker: CollisionChecker, goals: int, _: str, rng: Generator
    ) -> Drawn | None:
        found = []
        for count in (1, goals):
            T_base_tip = np.eye(4)
            T_base_tip[:3, 3] = rng.uniform(*self.region)
            found.append(reaching_configurations(robot, T_base_tip, count, checker, rng, POSITION_ONLY))
            if not len(found[-1]):
                return None
        (start,), reached = found
        return Drawn(scene, start, reached, link_pose(robot, reached[0].astype(np.float64), robot.tip))

    def _by_configuration(
        self,
        robot: Robot,
        scene: Scene,
        checker: CollisionChecker,
        goals: int,
        target: str,
        rng: Generator,
    ) -> Drawn | None:
        # a draw of two, or two of one each: the distribution is the same, the stream of rng is not
        each = (2,) if target == CONFIGURATION else (1, 1)
        ends = [uniform_configurations(robot, self.region, checker, count, rng) for count in each]
        if sum(map(len, ends)) < 2:
            return None
        start, goal = np.concatenate(ends)
        T_base_tip = link_pose(robot, goal, robot.tip)
        if target == CONFIGURATION:
            return Drawn(scene, start, goal[None], T_base_tip)
        reached = goal[None].astype(np.float32)
        if goals > 1:
            others = reaching_configurations(robot, T_base_tip, goals - 1, checker, rng)
            reached = np.concatenate([reached, others])
        return Drawn(scene, start.astype(np.float32), reached, T_base_tip)


ROP = Rop()
