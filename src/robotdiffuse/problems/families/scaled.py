"""Scales families of random problems, which are designed for a Panda's reach, to the size of another arm.

A problem is sampled for a copy of the arm that is scaled to a Panda's reach; then scene and targets are
scaled to the arm's own size. The joint angles of the copy are those of the arm; values of prismatic joints
are scaled. Problems are thus equally hard for small and large arms, and families do not depend on the size of
the arm.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.random import Generator

from robotdiffuse.problems.families import load_family
from robotdiffuse.problems.families.family import CONFIGURATION, Family, SampledProblem, Spheres
from robotdiffuse.robots.kinematic_tree import once_per_robot
from robotdiffuse.robots.robot import Robot, scaled
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.shapes import Box, Shape

PANDA_REACH = 0.855
"""A Panda's reach, as computed by `Robot.reach` [m]."""
UNSCALED_RANGE = (0.8, 1.25)
"""Families are not scaled for arms whose reach, relative to a Panda's, is in this range."""


@once_per_robot
def scale_for(robot: Robot) -> float:
    """The factor that scales the lengths of families to an arm."""
    ratio = robot.reach / PANDA_REACH
    return 1.0 if UNSCALED_RANGE[0] <= ratio <= UNSCALED_RANGE[1] else round(ratio, 2)


def family_for(name: str, robot: Robot) -> Family:
    """A family scaled to the arm. Raises InputError, which lists the known names, for an unknown one."""
    family = load_family(name)
    scale = scale_for(robot)
    return family if scale == 1.0 else ScaledFamily(family, scale)


@dataclass(frozen=True)
class ScaledFamily:
    """A family whose lengths are multiplied by `scale`. Raises InputError where the family does."""

    family: Family
    scale: float

    @property
    def floor(self) -> Box | None:
        floor = self.family.floor
        return None if floor is None else _sized(floor, self.scale)  # type: ignore[return-value]

    @property
    def max_obstacles(self) -> int:
        return self.family.max_obstacles

    def scene(self, rng: Generator, keep_out: Spheres | None = None) -> Scene:
        keep_out = None if keep_out is None else keep_out / self.scale
        return _scene(self.family.scene(rng, keep_out), self.scale)

    def draw(
        self, robot: Robot, rng: Generator, goals: int = 1, target: str = CONFIGURATION
    ) -> SampledProblem:
        sample = self.family.draw(_panda_sized(robot), rng, goals, target)
        T_base_tip = sample.T_base_tip.copy()
        T_base_tip[:3, 3] *= self.scale
        by_joint = np.where(robot.prismatic, self.scale, 1.0)
        return SampledProblem(
            _scene(sample.scene, self.scale), sample.start * by_joint, sample.goals * by_joint, T_base_tip
        )


@once_per_robot
def _panda_sized(robot: Robot) -> Robot:
    """The arm scaled to about a Panda's reach."""
    return scaled(robot, 1 / scale_for(robot))


def _scene(scene: Scene, scale: float) -> Scene:
    return Scene([_sized(shape, scale) for shape in scene.shapes])


def _sized(shape: Shape, scale: float) -> Shape:
    """The shape, a sphere or a box, with its lengths multiplied by `scale`."""
    lengths = {
        name: getattr(shape, name) * scale for name in ("center", "radius", "size") if hasattr(shape, name)
    }
    return replace(shape, **lengths)  # type: ignore[type-var]
