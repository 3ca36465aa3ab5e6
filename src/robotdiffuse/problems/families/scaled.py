"""Families in the size of an arm: they are made for a Panda, and stretched for arms of another reach.

What is drawn is drawn for the arm in the size that has a Panda's reach; then scene and targets take the arm's
own size. Joints turn through the same angles in both. So the problems of a small arm are as hard as those of
a large one, and a family needs to know nothing of it.
"""

from dataclasses import dataclass, replace

from jaxtyping import Float
from numpy import ndarray
from numpy.random import Generator

from robotdiffuse.problems.families import load_family
from robotdiffuse.problems.families.family import CONFIGURATION, Drawn, Family
from robotdiffuse.robots.robot import Robot, once_per_robot
from robotdiffuse.robots.scaling import reach, scaled
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.shapes import Box, Shape, Sphere

PANDA_REACH = 0.855
"""[m], by `robots.scaling.reach`."""
ALIKE = (0.8, 1.25)
"""Arms whose reach is such a share of a Panda's get the families as they are: a table is a table."""


@once_per_robot
def scale_for(robot: Robot) -> float:
    """What the lengths of families are multiplied by for an arm."""
    share = reach(robot) / PANDA_REACH
    return 1.0 if ALIKE[0] <= share <= ALIKE[1] else round(share, 2)


def family_for(name: str, robot: Robot) -> Family:
    """A family in the size of the arm. Raises InputError, listing the known names, for an unknown one."""
    family, scale = load_family(name), scale_for(robot)
    return family if scale == 1.0 else ScaledFamily(family, scale)


@dataclass(frozen=True)
class ScaledFamily:
    """A family, so many times as large. Raises InputError where the family does."""

    family: Family
    scale: float

    @property
    def floor(self) -> Box | None:
        return None if self.family.floor is None else _box(self.family.floor, self.scale)

    @property
    def region(self) -> Float[ndarray, "2 3"]:
        return self.family.region * self.scale

    @property
    def most_obstacles(self) -> int:
        return self.family.most_obstacles

    def scene(self, rng: Generator, keep_out: Float[ndarray, "m 4"] | None = None) -> Scene:
        keep_out = None if keep_out is None else keep_out / self.scale
        return _scene(self.family.scene(rng, keep_out), self.scale)

    def draw(self, robot: Robot, rng: Generator, goals: int = 1, target: str = CONFIGURATION) -> Drawn:
        drawn = self.family.draw(_as_drawn_for(robot), rng, goals, target)
        T_base_tip = drawn.T_base_tip.copy()
        T_base_tip[:3, 3] *= self.scale
        return replace(drawn, scene=_scene(drawn.scene, self.scale), T_base_tip=T_base_tip)


@once_per_robot
def _as_drawn_for(robot: Robot) -> Robot:
    """The arm with about a Panda's reach."""
    return scaled(robot, 1 / scale_for(robot))


def _scene(scene: Scene, scale: float) -> Scene:
    return Scene([_sized(shape, scale) for shape in scene.shapes])


def _sized(shape: Shape, scale: float) -> Shape:
    """Families are of spheres and boxes."""
    if isinstance(shape, Sphere):
        return replace(shape, center=shape.center * scale, radius=shape.radius * scale)
    assert isinstance(shape, Box)
    return _box(shape, scale)


def _box(box: Box, scale: float) -> Box:
    return replace(box, center=box.center * scale, size=box.size * scale)
