"""The checker's own geometry: distances of points to obstacles, and how far obstacles reach in a
direction."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.core.errors import InputError
from robotdiffuse.core.transforms import rotation_from_quaternion
from robotdiffuse.core.types import Points, Rotation, Values, Vector
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.shapes import Box, Capsule, Cylinder, PointCloud, Shape, Sphere, Triangulated

CLEARANCE_CAP = 1.0
"""Larger clearances are reported as this [m]."""
PLANE_RANGE = 0.2
"""Elements of surfaces further from a part's ball than this are taken to be at this distance, without planes
[m]."""
EXACT_TRIANGLE_RANGE = 4.0
"""Triangles further away than this many times their size are replaced by balls around them."""
MAX_ARRAY_SIZE = 1_000_000
"""Numbers in a temporary array at most, about."""


class Rounded(NamedTuple):
    """The Minkowski sum of a box, a disc about its z axis and a ball: a sphere, box, cylinder or capsule."""

    center: Vector
    R: Rotation
    half: Vector
    disc: float
    rounding: float

    def reach(self, n: Float[ndarray, "k 3"]) -> Values:
        """The maximum of n · x over its points x, for unit vectors n (its support function)."""
        local = n @ self.R
        across = np.hypot(local[:, 0], local[:, 1])
        return n @ self.center + np.abs(local) @ self.half + self.disc * across + self.rounding


class Surface(NamedTuple):
    """Triangles or points, inflated by a radius."""

    corners: Float[ndarray, "m 1|3 3"]
    radius: float

    def reach(self, n: Float[ndarray, "k 3"]) -> Float[ndarray, "m k"]:
        """The same for each of its elements."""
        return (self.corners @ n.T).max(axis=1) + self.radius


class Obstacles:
    """The obstacles of a scene."""

    def __init__(self, scene: Scene) -> None:
        """Raises InputError for a shape that certificates do not support."""
        shapes = [s for s in scene.shapes if not (isinstance(s, PointCloud) and len(s.points) == 0)]
        self.names = tuple(shape.name for shape in shapes)
        self.bodies: tuple[Rounded | Surface, ...] = tuple(map(_body, shapes))
        rounded = [(i, body) for i, body in enumerate(self.bodies) if isinstance(body, Rounded)]
        self._at = np.array([i for i, _ in rounded], int)
        # to transform points into the frames of all bodies at once
        self._turns = np.concatenate([np.zeros((3, 0)), *(body.R for _, body in rounded)], axis=1)
        self._shifts = np.concatenate([np.zeros(0), *(body.center @ body.R for _, body in rounded)])
        self._half = np.array([body.half for _, body in rounded]).reshape(-1, 3)
        self._disc = np.array([body.disc for _, body in rounded])
        self._rounding = np.array([body.rounding for _, body in rounded])
        self._indices = {i: _Index(body) for i, body in enumerate(self.bodies) if isinstance(body, Surface)}

    def distances(self, points: Points) -> Float[ndarray, "n obstacles"]:
        """Distances of points to each obstacle [m], at most CLEARANCE_CAP; 0 or less inside."""
        distances_to_each = np.full((len(points), len(self.bodies)), CLEARANCE_CAP)
        step = max(MAX_ARRAY_SIZE // max(3 * len(self._at), 1), 1)
        for first in range(0, len(points), step):
            some = slice(first, first + step)
            distances_to_each[some, self._at] = np.minimum(self._to_rounded(points[some]), CLEARANCE_CAP)
        for i, index in self._indices.items():
            distances_to_each[:, i] = index.distances(points)
        return distances_to_each

    def near(self, center: Vector, radius: float) -> tuple[Rounded | Surface, ...]:
        """The bodies; a surface is reduced to elements near a ball, at least to those within PLANE_RANGE."""
        return tuple(
            self._indices[i].near(center, radius + PLANE_RANGE) if isinstance(body, Surface) else body
            for i, body in enumerate(self.bodies)
        )

    def _to_rounded(self, points: ndarray) -> ndarray:
        local = (points @ self._turns - self._shifts).reshape(len(points), -1, 3)
        out = np.maximum(np.abs(local) - self._half, 0.0)
        # the disc: the distance from the box across the axis, less its radius
        across = np.maximum(np.hypot(out[..., 0], out[..., 1]) - self._disc, 0.0)
        return np.hypot(across, out[..., 2]) - self._rounding


def _body(shape: Shape) -> Rounded | Surface:
    zero = np.zeros(3)
    eye = np.eye(3)
    match shape:
        case Sphere():
            return Rounded(shape.center, eye, zero, 0.0, shape.radius)
        case Box():
            return Rounded(shape.center, rotation_from_quaternion(shape.wxyz), shape.size / 2, 0.0, 0.0)
        case Cylinder() | Capsule():
            half = np.array([0.0, 0.0, shape.height / 2])
            R = rotation_from_quaternion(shape.wxyz)
            round_ends = isinstance(shape, Capsule)
            disc, rounding = (0.0, shape.radius) if round_ends else (shape.radius, 0.0)
            return Rounded(shape.center, R, half, disc, rounding)
        case PointCloud():
            return Surface(shape.points[:, None], shape.point_radius)
        case Triangulated():
            mesh = shape.mesh
            vertices = mesh.vertices @ rotation_from_quaternion(mesh.wxyz).T + mesh.xyz
            return Surface(vertices[mesh.faces], 0.0)
        case _:
            raise InputError(f"{shape.name}: a {type(shape).__name__} cannot be certified")


class _Index:
    """A spatial index of the elements of a surface."""

    def __init__(self, surface: Surface) -> None:
        from scipy.spatial import KDTree  # imported here: it would double the import time of the checker

        self.surface = surface
        self._classes = [(KDTree(middles), rows, size) for middles, rows, size in _by_size(surface.corners)]

    def distances(self, points: Points) -> Values:
        """Distances to the nearest element [m], at most CLEARANCE_CAP: exact where it is near, else to a ball
        around it."""
        nearest = np.full(len(points), CLEARANCE_CAP)
        for tree, rows, size in self._classes:
            to_middle = tree.query(points)[0]
            near = (to_middle <= EXACT_TRIANGLE_RANGE * size) & (to_middle - size < nearest)
            if len(self.surface.corners[0]) == 1:
                near[:] = False
            nearest = np.where(near, nearest, np.minimum(nearest, to_middle - size))
            near_points = np.flatnonzero(near)
            within = tree.query_ball_point(points[near_points], to_middle[near_points] + size)
            counts = np.array([len(some) for some in within], int)
            for some in np.array_split(np.arange(len(near_points)), counts.sum() * 9 // MAX_ARRAY_SIZE + 1):
                if len(some):
                    of = np.repeat(near_points[some], counts[some])
                    triangles = self.surface.corners[rows[np.concatenate(within[some]).astype(int)]]
                    np.minimum.at(nearest, of, _to_triangles(points[of], triangles))
        return np.minimum(nearest - self.surface.radius, CLEARANCE_CAP)

    def near(self, center: Vector, reach: float) -> Surface:
        """The elements that come within a distance of a point, and possibly others."""
        reach += self.surface.radius
        element_rows = [
            rows[tree.query_ball_point(center, reach + size)] for tree, rows, size in self._classes
        ]
        return self.surface._replace(
            corners=self.surface.corners[np.sort(np.concatenate(element_rows).astype(int))]
        )


def _by_size(corners: Float[ndarray, "m c 3"]) -> Iterator[tuple[ndarray, ndarray, float]]:
    """Groups of elements of similar size: their middles, their rows, and the radius of balls about the
    middles that contain them."""
    middles = corners.mean(axis=1)
    sizes = np.sqrt(((corners - middles[:, None]) ** 2).sum(axis=-1)).max(axis=1)
    octaves = np.ceil(np.log2(np.maximum(sizes, 1e-6))).astype(int)
    for octave in np.unique(octaves):
        rows = np.flatnonzero(octaves == octave)
        yield middles[rows], rows, float(sizes[rows].max())


def _to_triangles(p: Points, triangles: Float[ndarray, "n 3 3"]) -> Values:
    """Distances of points to one triangle each: to its plane if the foot point is inside, else to an edge."""
    a, b, c = np.moveaxis(triangles, 1, 0)
    normal = np.cross(b - a, c - a)
    area = np.sqrt((normal**2).sum(axis=1))
    within = area > 0
    distance = np.full(len(p), np.inf)
    for start, stop in ((a, b), (b, c), (c, a)):
        edge = stop - start
        out = p - start
        within &= (np.cross(edge, out) * normal).sum(axis=1) >= 0
        length2 = np.maximum((edge**2).sum(axis=1), 1e-300)
        share = np.clip((edge * out).sum(axis=1) / length2, 0.0, 1.0)
        distance = np.minimum(distance, np.sqrt(((out - share[:, None] * edge) ** 2).sum(axis=1)))
    height = np.abs(((p - a) * normal).sum(axis=1)) / np.where(area > 0, area, 1.0)
    return np.where(within, np.minimum(height, distance), distance)
