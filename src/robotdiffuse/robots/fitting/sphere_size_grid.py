"""Where the spheres of a link may reach: how large a sphere may be about each place, on a grid.

A sphere may hold every point whose distance from the link is at most the tolerance, which may be less near
some places; points that neighbouring links hide at any angle of the joints between them; and none below the
plane that the robot stands on.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray
from scipy import ndimage
from scipy.spatial import KDTree

from robotdiffuse.robots.bodies import ConvexMesh
from robotdiffuse.robots.fitting.convex_parts import planes_of
from robotdiffuse.robots.fitting.sphere_fitting_kernel import max_radii_at, plane_depths

GRID_POINTS = 200_000
"""Of a grid around a link, about."""
FINEST = 0.0015
"""Spacing of a grid, at least [m]."""
BESIDE = 0.03
"""How far a grid reaches beyond the link, at least [m]: spheres may reach so far into a neighbour."""
AROUND, SLOPE = 0.015, 0.3
"""A smaller tolerance holds so far from its place [m], and grows by so much per distance beyond."""

THIN = 5e-4
"""Radius that spheres inside a plate are taken to have at least [m]."""
FLOOR = 0.0015
"""Spheres may always stick out so far towards the floor [m]: a link may lie on it."""
LEVEL = np.log(1.3)
"""Tolerances within such a factor count as the lowest of them."""

Planes = tuple[Float[ndarray, "p 3"], Float[ndarray, "p"], ndarray]


@dataclass(frozen=True, eq=False)
class Bounds:
    """How far the spheres of a link may reach out of it."""

    tolerance: float
    """[m]"""
    hidden: Callable[[Float[ndarray, "n 3"]], Bool[ndarray, "n"]] | None = None
    """Whether neighbours hide points, which then may be held."""
    tight: Float[ndarray, "n 4"] | None = None
    """Places x y z, and how far spheres may stick out there [m]; nothing is hidden about them."""
    floor: tuple[Float[ndarray, "3"], float] | None = None
    """Upward normal n of a plane and its offset: points with n . x below it are not held."""

    @property
    def varies(self) -> bool:
        """Whether the tolerance is less in some places."""
        return self.tight is not None or self.floor is not None

    def tolerances(self, points: Float[ndarray, "n 3"]) -> Float[ndarray, "n"]:
        """How far spheres may stick out at points [m]."""
        allowed = np.full(len(points), self.tolerance)
        if self.floor is not None:
            normal, offset = self.floor
            np.minimum(allowed, np.maximum(points @ normal - offset, FLOOR), out=allowed)
        if self.tight is None:
            return allowed
        level = np.ceil(np.log(self.tight[:, 3]) / LEVEL)
        for one in np.unique(level):
            places = self.tight[level == one]
            far = KDTree(places[:, :3]).query(points, distance_upper_bound=AROUND + self.tolerance / SLOPE)[0]
            least = places[:, 3].min() + SLOPE * np.maximum(far - AROUND, 0.0)
            np.minimum(allowed, least, out=allowed)
        return allowed


@dataclass(frozen=True, eq=False)
class SphereSizeGrid:
    """How large a sphere may be about each place: negative where none may be [m], linear between points."""

    grid: Float[ndarray, "nx ny nz"]
    origin: Float[ndarray, "3"]
    spacing: float

    @property
    def arrays(self) -> tuple[ndarray, ndarray, float]:
        return self.grid, self.origin, self.spacing

    def at(self, points: Float[ndarray, "n 3"]) -> Float[ndarray, "n"]:
        return max_radii_at(np.ascontiguousarray(points), *self.arrays)


@dataclass(frozen=True, eq=False)
class Solid:
    """Signed distances from the faces of a union of convex meshes on a grid [m]: negative inside."""

    meshes: tuple[ConvexMesh, ...]
    distance: Float[ndarray, "nx ny nz"]
    origin: Float[ndarray, "3"]
    spacing: float

    @staticmethod
    def of(meshes: tuple[ConvexMesh, ...], tolerance: float) -> "Solid":
        """With a grid that suffices for spheres that stick out by a tolerance [m]."""
        corners = np.concatenate([mesh.vertices for mesh in meshes])
        low, high = corners.min(0), corners.max(0)
        beside = max(BESIDE, tolerance)
        spacing = max(float(np.prod(high - low + 2 * beside) / GRID_POINTS) ** (1 / 3), FINEST)
        low, high = low - beside - 2 * spacing, high + beside + 2 * spacing
        shape = np.ceil((high - low) / spacing).astype(int) + 1
        planes = stacked_planes(meshes)
        depth = plane_depths(_places(shape, low, spacing), *planes).reshape(shape)
        inside = depth > 0
        # inside of several meshes the planes between them do not count: carried on from the outer surface
        deep = depth if len(meshes) == 1 else _carried(inside, spacing, np.maximum(-depth, 0.0))
        return Solid(meshes, np.where(inside, -deep, -depth), low, spacing)

    @property
    def points(self) -> Float[ndarray, "n 3"]:
        """The points of the grid."""
        return _places(self.distance.shape, self.origin, self.spacing)

    @property
    def depth(self) -> float:
        """Radius of the largest sphere inside [m], about."""
        return max(float(-self.distance.min()), THIN)

    @property
    def inside(self) -> Float[ndarray, "n 3"]:
        """Points of the grid inside; of something that is thinner than the grid, the nearest ones."""
        distance = self.distance.ravel()
        return self.points[distance < max(0.0, float(distance.min()) + self.spacing / 2)]

    def inscribed_sizes(self) -> SphereSizeGrid:
        """SphereSizeGrid for spheres that do not stick out at all."""
        return SphereSizeGrid(-self.distance, self.origin, self.spacing)

    def sphere_sizes(self, bounds: Bounds) -> SphereSizeGrid:
        """SphereSizeGrid for the spheres of a link."""
        points, distance = self.points, self.distance.ravel()
        allowed = np.full(len(points), bounds.tolerance)
        near = (distance > -bounds.tolerance) & (distance < 2 * bounds.tolerance)
        allowed[near] = bounds.tolerances(points[near])
        beyond = distance - allowed
        if bounds.hidden is not None:
            asked = np.flatnonzero((beyond > 0) & (allowed >= bounds.tolerance))
            hidden = asked[bounds.hidden(points[asked])]
            beyond[hidden] = -self.spacing / 2
        if bounds.floor is not None:
            normal, offset = bounds.floor
            beyond = np.maximum(beyond, offset - points @ normal)
        beyond = beyond.reshape(self.distance.shape)
        outside = beyond > 0
        grid = _carried(~outside, self.spacing, np.maximum(beyond, 0.0))
        return SphereSizeGrid(np.where(outside, -beyond, grid), self.origin, self.spacing)


def _carried(
    mask: Bool[ndarray, "nx ny nz"], spacing: float, value: Float[ndarray, "nx ny nz"]
) -> Float[ndarray, "nx ny nz"]:
    """On a mask, the distance from its surface: to the nearest point off the mask, less that one's `value`,
    its own distance from the surface."""
    if not mask.any() or mask.all():
        return np.where(mask, spacing * sum(mask.shape), 0.0)
    found: Any = ndimage.distance_transform_edt(mask, return_indices=True)
    far, at = found
    return np.maximum(far * spacing - value[tuple(at)], 0.0)


def stacked_planes(meshes: tuple[ConvexMesh, ...]) -> Planes:
    """Normals and offsets of the planes of all meshes, and the first of each mesh and their number."""
    planes = [planes_of(mesh) for mesh in meshes]
    starts = np.cumsum([0, *(len(offsets) for _, offsets in planes)])
    return np.concatenate([normals for normals, _ in planes]), np.concatenate([o for _, o in planes]), starts


def depths(meshes: tuple[ConvexMesh, ...], points: Float[ndarray, "n 3"]) -> Float[ndarray, "n"]:
    """Distance from points to the nearest face plane of the mesh in which they are deepest [m]; negative
    outside."""
    return plane_depths(np.ascontiguousarray(points), *stacked_planes(meshes))


def _places(
    shape: tuple[int, ...] | ndarray, origin: Float[ndarray, "3"], spacing: float
) -> Float[ndarray, "n 3"]:
    axes = [low + spacing * np.arange(count) for low, count in zip(origin, shape, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
