"""Points on the surfaces of obstacles: what the encoder sees of a scene.

Two forms of the same rule: `sample_surface` for any scene, `sample_surfaces_batch` for many scenes of spheres
and boxes at once, as training needs them.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Int8
from numpy import ndarray
from numpy.random import Generator

from robotdiffuse.errors import InputError
from robotdiffuse.scenes.packed import BOX, SPHERE
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.shapes import Box, Capsule, Cylinder, Mesh, PointCloud, Shape, Sphere, Triangulated
from robotdiffuse.transforms import rotation_from_quaternion

ROUNDS = 6
"""How often `sample_surface` draws before it repeats points that it has."""


@dataclass(frozen=True)
class VisibleRegion:
    """Where points on obstacles count: within reach of the arm and above the plane that it stands on."""

    floor: float = 0.02
    """Points must be higher than this [m]: the mounting plane is part of every scene and tells nothing."""
    center: tuple[float, float, float] = (0.0, 0.0, 0.3)
    """In the base frame [m]: on the base axis, about at a Panda's shoulder."""
    reach: float = 1.2
    """Points must be within this distance of the centre [m]; a Panda's flange reaches 0.86."""

    def __post_init__(self) -> None:
        if self.floor >= self.center[2] + self.reach:
            raise InputError(
                f"floor is {self.floor}; it must be below the top of the reach, {self.center[2] + self.reach}"
            )

    def holds(self, points: Float[ndarray, "*b 3"]) -> ndarray:
        x, y, z = (points[..., i] - self.center[i] for i in range(3))
        return (points[..., 2] > self.floor) & (x * x + y * y + z * z < self.reach**2)


PANDA_REGION = VisibleRegion()


def _sphere(shape: Sphere, n: int, rng: Generator) -> ndarray:
    directions = rng.standard_normal((n, 3))
    directions *= (shape.radius / np.sqrt((directions * directions).sum(axis=1)))[:, None]
    return directions + shape.center


def _box(shape: Box, n: int, rng: Generator) -> ndarray:
    points = rng.random((n, 3)) - 0.5
    x, y, z = shape.size
    faces = np.array([y * z, z * x, x * y])
    axis = np.searchsorted(np.cumsum(faces / faces.sum())[:2], rng.random(n), side="right")
    rows = np.arange(n)
    points[rows, axis] = np.where(points[rows, axis] < 0, -0.5, 0.5)
    return (points * shape.size) @ shape.rotation.T + shape.center


def _cylinder(shape: Cylinder, n: int, rng: Generator) -> ndarray:
    angle = rng.random(n) * (2 * np.pi)
    height = rng.random(n) - 0.5
    on_side = rng.random(n) * (shape.height + shape.radius) < shape.height
    radius = np.where(on_side, 1.0, np.sqrt(rng.random(n))) * shape.radius
    z = np.where(on_side, height, np.where(height < 0, -0.5, 0.5)) * shape.height
    local = np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)
    return local @ shape.rotation.T + shape.center


def _capsule(shape: Capsule, n: int, rng: Generator) -> ndarray:
    local = rng.standard_normal((n, 3))
    on_side = rng.random(n) * (shape.height + 2 * shape.radius) < shape.height
    local[on_side, 2] = 0
    local *= (shape.radius / np.sqrt((local * local).sum(axis=1)))[:, None]
    along = np.where(on_side, rng.random(n) - 0.5, np.copysign(0.5, local[:, 2]))
    local[:, 2] += along * shape.height
    return local @ shape.rotation.T + shape.center


def _triangles(shape: Triangulated, n: int, rng: Generator) -> ndarray:
    mesh = shape.mesh
    edges = np.cumsum(mesh.face_areas)
    face = np.searchsorted(edges[:-1], rng.random(n) * edges[-1], side="right")
    u, v = rng.random((2, n, 1))
    outside = u + v > 1
    u, v = np.where(outside, 1 - u, u), np.where(outside, 1 - v, v)
    a, b, c = np.moveaxis(mesh.world_vertices[mesh.faces[face]], 1, 0)
    return a + u * (b - a) + v * (c - a)


def _point_cloud(shape: PointCloud, n: int, rng: Generator) -> ndarray:
    return shape.points[rng.integers(len(shape.points), size=n)]


SAMPLERS: dict[type[Shape], Callable[..., ndarray]] = {
    Sphere: _sphere,
    Box: _box,
    Cylinder: _cylinder,
    Capsule: _capsule,
    Mesh: _triangles,
    PointCloud: _point_cloud,
}
"""By shape: n points, uniform by area, in the base frame; of a shape that is not here, on its triangles."""


def sample_surface(
    scene: Scene, count: int, rng: Generator, region: VisibleRegion = PANDA_REGION
) -> Float[ndarray, "count 3"]:
    """`count` points on the shapes, in random order, uniform by area within the region [m].

    Where hardly anything of a surface lies in the region, points repeat. If nothing does: no points, an
    array of shape (0, 3).
    """
    shapes = [shape for shape in scene.shapes if shape.area > 0 and _may_be_seen(shape, region)]
    if not shapes or count == 0:
        return np.zeros((0, 3))
    areas = np.array([shape.area for shape in shapes])
    shares = areas / areas.sum()
    found: list[ndarray] = []
    missing, draw = count, 2 * count
    for _ in range(ROUNDS):
        parts = rng.multinomial(draw, shares)
        samplers = [SAMPLERS.get(type(shape), _triangles) for shape in shapes]
        drawn = [f(s, int(n), rng) for f, s, n in zip(samplers, shapes, parts, strict=True) if n > 0]
        points = np.concatenate(drawn)
        points = points[region.holds(points)]
        # The points come shape by shape; any first few of them would be of the first shape alone.
        points = points[rng.permutation(len(points))[:missing]]
        found.append(points)
        missing -= len(points)
        if missing == 0:
            break
        draw = min(4 * draw, 65536)
    points = np.concatenate(found)
    if 0 < missing < count:
        points = np.concatenate([points, points[rng.integers(len(points), size=missing)]])
    return points


def _may_be_seen(shape: Shape, region: VisibleRegion) -> bool:
    low, high = shape.bounds
    if high[2] <= region.floor:
        return False
    gap = np.maximum(0, np.maximum(low - region.center, region.center - high))
    return bool(gap @ gap < region.reach**2)


def sample_surfaces_batch(
    kinds: Int8[ndarray, "n k"],
    params: Float32[ndarray, "n k 10"],
    count: int,
    rng: Generator,
    region: VisibleRegion = PANDA_REGION,
) -> Float32[ndarray, "n count 3"]:
    """`count` points for each of n packed scenes, by the rule of `sample_surface` [m].

    Each scene is drawn from `count` times; draws outside the region are replaced by repeating those inside.
    A scene of which nothing lies in the region is all zeros.
    """
    n, k = kinds.shape
    if k == 0:
        return np.zeros((n, count, 3), np.float32)
    box = kinds == BOX
    size = np.where(box[..., None], params[..., 3:6], 0)
    wxyz = np.where(box[..., None], params[..., 6:10], np.array([1, 0, 0, 0], np.float32))
    rotation = rotation_from_quaternion(wxyz).astype(np.float32)
    faces = np.stack(
        [size[..., 1] * size[..., 2], size[..., 2] * size[..., 0], size[..., 0] * size[..., 1]], -1
    )
    radius = np.where(kinds == SPHERE, params[..., 3], 0)
    area = 4 * np.float32(np.pi) * radius**2 + 2 * faces.sum(-1)
    half = np.where(box[..., None], (np.abs(rotation) @ size[..., None])[..., 0] / 2, radius[..., None])
    area *= _may_be_seen_batch(params[..., :3] - half, params[..., :3] + half, region)

    ends = np.cumsum(area, axis=1)
    pick = rng.random((n, count), dtype=np.float32) * ends[:, -1:]
    shape = (pick[:, :, None] >= ends[:, None, :-1]).sum(axis=2)
    shape += np.arange(n)[:, None] * k
    flat = shape.reshape(-1)
    points = np.empty((n * count, 3), np.float32)
    is_box = (kinds == BOX).reshape(-1)[flat]
    for mask, draw in ((~is_box, _spheres), (is_box, _boxes)):
        rows = np.flatnonzero(mask)
        of = flat[rows]
        points[rows] = draw(of, radius.reshape(-1), size.reshape(-1, 3), faces, rotation, rng)
    points += params[..., :3].reshape(-1, 3)[flat]
    points = points.reshape(n, count, 3)

    inside = region.holds(points) & (ends[:, -1:] > 0)
    total = inside.sum(axis=1, keepdims=True)
    order = np.argsort(~inside, axis=1, kind="stable")
    source = np.take_along_axis(order, np.arange(count)[None] % np.maximum(total, 1), axis=1)
    points = points.reshape(-1, 3)[source + np.arange(n)[:, None] * count]
    points[total[:, 0] == 0] = 0
    return points


def _may_be_seen_batch(low: ndarray, high: ndarray, region: VisibleRegion) -> ndarray:
    center = np.array(region.center, np.float32)
    gap = np.maximum(0, np.maximum(low - center, center - high))
    return (high[..., 2] > region.floor) & ((gap**2).sum(-1) < region.reach**2)


def _spheres(
    of: ndarray, radius: ndarray, _size: ndarray, _faces: ndarray, _rotation: ndarray, rng: Generator
) -> ndarray:
    z = 2 * rng.random(len(of), dtype=np.float32) - 1
    angle = np.float32(2 * np.pi) * rng.random(len(of), dtype=np.float32)
    ring = np.sqrt(1 - z * z)
    directions = np.stack([ring * np.cos(angle), ring * np.sin(angle), z], axis=1)
    return directions * radius[of][:, None]


def _boxes(
    of: ndarray, _radius: ndarray, size: ndarray, faces: ndarray, rotation: ndarray, rng: Generator
) -> ndarray:
    points = rng.random((len(of), 3), dtype=np.float32) - np.float32(0.5)
    ends = np.cumsum(faces.reshape(-1, 3), axis=1)[of]
    pick = rng.random(len(of), dtype=np.float32) * ends[:, 2]
    axis = (pick >= ends[:, 0]).astype(np.int64) + (pick >= ends[:, 1])
    at = np.arange(0, 3 * len(of), 3) + axis
    flat = points.reshape(-1)
    flat[at] = np.copysign(np.float32(0.5), flat[at])
    points *= size[of]
    return np.einsum("nij,nj->ni", rotation.reshape(-1, 3, 3)[of], points)
