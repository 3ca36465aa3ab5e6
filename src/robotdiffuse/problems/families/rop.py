"""ROP: the paper's family of random scenes, a few spheres and cubes around the arm, and a dense variant."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from numpy.random import Generator

from robotdiffuse.errors import InputError, unknown_name
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.shapes import IDENTITY, Box, Shape, Sphere

Range = tuple[float, float]
KINDS = ("sphere", "box")
MAX_TRIES = 1000
"""Draws of an obstacle before the settings are called impossible."""


@dataclass(frozen=True)
class RopSettings:
    """What ROP scenes and problems are drawn from. The defaults are the paper's, as its code has them.

    Every range is drawn from uniformly; equal ends fix the value. Lengths in [m], in the robot's base frame.
    """

    obstacles: tuple[int, int] = (2, 2)
    """Least and greatest number of obstacles, both included."""
    kinds: tuple[str, ...] = KINDS
    """Drawn from for each obstacle: sphere, box (a cube)."""
    sphere_radius: Range = (0.25, 0.25)
    """The paper's planner sees 0.25 of spheres of 0.2: a margin of 5 cm."""
    cube_side: Range = (0.2, 0.2)
    x: Range = (-1.0, 1.0)
    """Centres of the obstacles."""
    y: Range = (-1.0, 1.0)
    z: Range = (0.1, 1.0)
    yaw: bool = False
    """Whether cubes are turned about the vertical."""
    floor: bool = True
    """Whether there is a floor with its top at z = 0."""
    floor_size: float = 2.0
    floor_thickness: float = 0.1
    tip_x: Range = (-0.6, 0.6)
    """Where the robot's tip is at the start and at the goal."""
    tip_y: Range = (-0.6, 0.6)
    tip_z: Range = (0.2, 0.8)

    def __post_init__(self) -> None:
        for kind in self.kinds:
            if kind not in KINDS:
                raise unknown_name("kind of ROP obstacle", kind, KINDS)
        ranges = ("obstacles", "sphere_radius", "cube_side", "x", "y", "z", "tip_x", "tip_y", "tip_z")
        for name in ranges:
            low, high = getattr(self, name)
            if not low <= high:
                raise InputError(f"{name} is from {low} to {high}; the first must not be greater")
        for name in ("sphere_radius", "cube_side"):
            if getattr(self, name)[0] <= 0:
                raise InputError(f"{name} is from {getattr(self, name)[0]}; it must be positive")
        if self.floor and not (self.floor_size > 0 and self.floor_thickness > 0):
            raise InputError(
                f"floor_size is {self.floor_size} and floor_thickness {self.floor_thickness}; "
                "both must be positive"
            )
        if self.obstacles[0] < 0 or (self.obstacles[1] > 0 and not self.kinds):
            raise InputError(f"obstacles is {self.obstacles} and kinds {self.kinds}; they must allow a scene")

    @property
    def slots(self) -> int:
        """The greatest number of shapes in a scene."""
        return self.obstacles[1] + self.floor


ROP = RopSettings()
ROP_DENSE = RopSettings(obstacles=(3, 12), sphere_radius=(0.08, 0.2), cube_side=(0.1, 0.3))
"""More and smaller obstacles of varied size: about half of these problems are not trivial."""


def floor_box(settings: RopSettings) -> Box | None:
    """The floor of the scenes, with its top at z = 0; None if they have none."""
    if not settings.floor:
        return None
    size = (settings.floor_size, settings.floor_size, settings.floor_thickness)
    return Box((0.0, 0.0, -settings.floor_thickness / 2), size, name="floor")


def sample_scene(
    settings: RopSettings, rng: Generator, keep_out: Float[ndarray, "m 4"] | None = None
) -> Scene:
    """A random scene; the floor, if any, comes first.

    `keep_out` are spheres, x y z radius, that no obstacle may enter: those of the robot's immovable base
    (see `base_spheres`), as no robot could stand inside an obstacle. The floor is not held against them.
    Raises InputError if the settings leave no place for an obstacle.
    """
    floor = floor_box(settings)
    shapes: list[Shape] = [] if floor is None else [floor]
    low, high = settings.obstacles
    for _ in range(int(rng.integers(low, high + 1))):
        for _ in range(MAX_TRIES):
            shape = _obstacle(settings, rng)
            if (
                keep_out is None
                or len(keep_out) == 0
                or (obstacle_distance(shape, keep_out[:, :3]) > keep_out[:, 3]).all()
            ):
                break
        else:
            raise InputError(
                f"no obstacle stays clear of the robot's base in {MAX_TRIES} draws; widen x, y, z"
            )
        shapes.append(shape)
    return Scene(shapes)


def _obstacle(settings: RopSettings, rng: Generator) -> Sphere | Box:
    kind = settings.kinds[int(rng.integers(len(settings.kinds)))]
    center = [rng.uniform(*settings.x), rng.uniform(*settings.y), rng.uniform(*settings.z)]
    if kind == "sphere":
        return Sphere(center, rng.uniform(*settings.sphere_radius))
    side = rng.uniform(*settings.cube_side)
    # A quarter turn of a cube is the cube again.
    angle = rng.uniform(-np.pi / 4, np.pi / 4) if settings.yaw else 0.0
    wxyz = (np.cos(angle / 2), 0.0, 0.0, np.sin(angle / 2)) if settings.yaw else IDENTITY
    return Box(center, (side, side, side), wxyz)


def obstacle_distance(shape: Sphere | Box, points: Float[ndarray, "m 3"]) -> Float[ndarray, "m"]:
    """From the shape to the points, negative or zero inside [m]."""
    local = points - shape.center
    if isinstance(shape, Sphere):
        return np.linalg.norm(local, axis=1) - shape.radius
    local = local @ shape.rotation
    return np.linalg.norm(np.maximum(0, np.abs(local) - shape.size / 2), axis=1)
