"""Samples points on the surfaces of obstacles: the form in which networks receive a scene.

`datasets.surface_clouds` does this for many scenes at once.
"""

from dataclasses import dataclass
from functools import singledispatch
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from numpy.random import Generator

from robotdiffuse.core.errors import InputError
from robotdiffuse.core.settings import Positive, Settings
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.shapes import Box, Capsule, Cylinder, PointCloud, Shape, Sphere

MAX_SAMPLING_ROUNDS = 6
"""Largest number of rounds in which `sample_surface` draws points. If the points are still too few, they are
repeated."""


@dataclass(frozen=True)
class VisibleRegion(Settings, name="region"):
    """The region from which surface points become network inputs: within the arm's reach and above its
    mounting plane."""

    floor: float = 0.02
    """Points must be higher than this [m]: the mounting plane carries no information, since nearly all scenes
    contain it."""
    center: tuple[float, float, float] = (0.0, 0.0, 0.3)
    """Center of the region in the base frame [m]: on the base axis, near a Panda's shoulder."""
    reach: Positive = 1.2
    """Points must be within this distance of the center [m]; a Panda's flange reaches 0.86."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.floor >= self.center[2] + self.reach:
            raise InputError(
                f"floor is {self.floor}; it must be below the top of the reach, {self.center[2] + self.reach}"
            )

    def holds(self, points: Any) -> Any:
        """Which points are in the region; points: array or tensor [..., 3] [m]."""
        x, y, z = (points[..., i] - self.center[i] for i in range(3))
        return (points[..., 2] > self.floor) & (x * x + y * y + z * z < self.reach**2)


PANDA_REGION = VisibleRegion()


@singledispatch
def draw(shape: Any, n: int, rng: Generator) -> ndarray:
    """n points on a shape, uniform by area, in the base frame [m]. This default samples the triangles of the
    shape's mesh; other kinds of shapes register their own functions."""
    mesh = shape.mesh
    areas = np.cumsum(mesh.face_areas)
    face = np.searchsorted(areas[:-1], rng.random(n) * areas[-1], side="right")
    u, v = rng.random((2, n, 1))
    outside = u + v > 1
    u = np.where(outside, 1 - u, u)
    v = np.where(outside, 1 - v, v)
    a, b, c = np.moveaxis(mesh.world_vertices[mesh.faces[face]], 1, 0)
    return a + u * (b - a) + v * (c - a)


@draw.register
def _sphere(shape: Sphere, n: int, rng: Generator) -> ndarray:
    directions = rng.standard_normal((n, 3))
    directions *= (shape.radius / np.linalg.norm(directions, axis=1))[:, None]
    return directions + shape.center


@draw.register
def _box(shape: Box, n: int, rng: Generator) -> ndarray:
    points = rng.random((n, 3)) - 0.5
    x, y, z = shape.size
    faces = np.array([y * z, z * x, x * y])
    axis = np.searchsorted(np.cumsum(faces / faces.sum())[:2], rng.random(n), side="right")
    rows = np.arange(n)
    points[rows, axis] = np.where(points[rows, axis] < 0, -0.5, 0.5)
    return (points * shape.size) @ shape.rotation.T + shape.center


@draw.register
def _cylinder(shape: Cylinder, n: int, rng: Generator) -> ndarray:
    angle = rng.random(n) * (2 * np.pi)
    height = rng.random(n) - 0.5
    on_side = rng.random(n) * (shape.height + shape.radius) < shape.height
    radius = np.where(on_side, 1.0, np.sqrt(rng.random(n))) * shape.radius
    z = np.where(on_side, height, np.where(height < 0, -0.5, 0.5)) * shape.height
    local = np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)
    return local @ shape.rotation.T + shape.center


@draw.register
def _capsule(shape: Capsule, n: int, rng: Generator) -> ndarray:
    local = rng.standard_normal((n, 3))
    on_side = rng.random(n) * (shape.height + 2 * shape.radius) < shape.height
    local[on_side, 2] = 0
    local *= (shape.radius / np.linalg.norm(local, axis=1))[:, None]
    along = np.where(on_side, rng.random(n) - 0.5, np.copysign(0.5, local[:, 2]))
    local[:, 2] += along * shape.height
    return local @ shape.rotation.T + shape.center


@draw.register
def _point_cloud(shape: PointCloud, n: int, rng: Generator) -> ndarray:
    return shape.points[rng.integers(len(shape.points), size=n)]


def sample_surface(
    scene: Scene, count: int, rng: Generator, region: VisibleRegion = PANDA_REGION
) -> Float[ndarray, "count 3"]:
    """`count` points on the shapes, in random order, uniform by area within the region [m].

    Points repeat if only a small part of the surface is in the region. The array has shape (0, 3) if no point
    that was drawn is in the region.
    """
    shapes = [shape for shape in scene.shapes if shape.area > 0 and _may_intersect(shape, region)]
    if not shapes or count == 0:
        return np.zeros((0, 3))
    areas = np.array([shape.area for shape in shapes])
    shares = areas / areas.sum()
    batches = list[ndarray]()
    missing = count
    sample_count = 2 * count
    for _ in range(MAX_SAMPLING_ROUNDS):
        parts = rng.multinomial(sample_count, shares)
        samples = [draw(shape, int(n), rng) for shape, n in zip(shapes, parts, strict=True) if n > 0]
        points = np.concatenate(samples)
        points = points[region.holds(points)]
        # The points are ordered by shape: without the permutation, the first points would all be on the first
        # shape.
        points = points[rng.permutation(len(points))[:missing]]
        batches.append(points)
        missing -= len(points)
        if missing == 0:
            break
        sample_count = min(4 * sample_count, 65536)
    points = np.concatenate(batches)
    if 0 < missing < count:
        points = np.concatenate([points, points[rng.integers(len(points), size=missing)]])
    return points


def _may_intersect(shape: Shape, region: VisibleRegion) -> bool:
    low, high = shape.bounds
    if high[2] <= region.floor:
        return False
    gap = np.maximum(0, np.maximum(low - region.center, region.center - high))
    return bool(gap @ gap < region.reach**2)
