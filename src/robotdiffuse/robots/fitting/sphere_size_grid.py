"""Largest allowed radius of a link's covering spheres as a function of their centre, on a grid.

A sphere may contain points whose distance from the link is at most the tolerance, which may be smaller near
some places, and points that are inside a neighbouring link at any angle of the joint between them. It may not
contain points below the plane that the robot stands on.
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
from robotdiffuse.robots.fitting.convex_hulls import planes_of
from robotdiffuse.robots.fitting.sphere_fitting_kernel import max_radii_at, plane_depths

GRID_POINTS = 200_000
"""Approximate number of points of the grid around a link."""
MIN_SPACING = 0.0015
"""Smallest spacing of a grid [m]."""
MIN_PADDING = 0.03
"""Smallest padding of the grid around the link [m]: spheres may reach this far into a neighbour."""
# A smaller tolerance applies within this distance of its place [m]; beyond, it grows by this much per
# metre.
TIGHT_RADIUS = 0.015
TIGHT_SLOPE = 0.3

MIN_DEPTH = 5e-4
"""Lower bound on the inscribed radius of a link, for thin plates [m]."""
FLOOR_TOLERANCE = 0.0015
"""Spheres may always stick out this far towards the floor [m], since a link may lie on it."""
TOLERANCE_LEVEL = np.log(1.3)
"""Logarithm of the factor within which tolerances are grouped; the lowest of a group applies to all of it."""

Planes = tuple[Float[ndarray, "p 3"], Float[ndarray, "p"], ndarray]


@dataclass(frozen=True, eq=False)
class Bounds:
    """How far the spheres of a link may stick out of it."""

    tolerance: float
    """[m]"""
    hidden: Callable[[Float[ndarray, "n 3"]], Bool[ndarray, "n"]] | None = None
    """Whether points are inside a neighbour, so that spheres may contain them."""
    tight: Float[ndarray, "n 4"] | None = None
    """Rows x y z and how far spheres may stick out there [m]. Near these, `hidden` does not apply."""
    floor: tuple[Float[ndarray, "3"], float] | None = None
    """Upward normal n and offset of a plane: spheres may not contain points x with n . x below the offset."""

    @property
    def varies(self) -> bool:
        """Whether the tolerance is smaller in some places."""
        return self.tight is not None or self.floor is not None

    def tolerances(self, points: Float[ndarray, "n 3"]) -> Float[ndarray, "n"]:
        """How far spheres may stick out at points [m]."""
        allowed = np.full(len(points), self.tolerance)
        if self.floor is not None:
            normal, offset = self.floor
            np.minimum(allowed, np.maximum(points @ normal - offset, FLOOR_TOLERANCE), out=allowed)
        if self.tight is None:
            return allowed
        level = np.ceil(np.log(self.tight[:, 3]) / TOLERANCE_LEVEL)
        for one in np.unique(level):
            places = self.tight[level == one]
            far = KDTree(places[:, :3]).query(
                points, distance_upper_bound=TIGHT_RADIUS + self.tolerance / TIGHT_SLOPE
            )[0]
            least = places[:, 3].min() + TIGHT_SLOPE * np.maximum(far - TIGHT_RADIUS, 0.0)
            np.minimum(allowed, least, out=allowed)
        return allowed


@dataclass(frozen=True, eq=False)
class SphereSizeGrid:
    """Largest radius of a sphere by its centre [m], interpolated on a grid; negative where no sphere may
    be."""

    grid: Float[ndarray, "nx ny nz"]
    origin: Float[ndarray, "3"]
    spacing: float

    @property
    def arrays(self) -> tuple[ndarray, ndarray, float]:
        return self.grid, self.origin, self.spacing

    def at(self, points: Float[ndarray, "n 3"]) -> Float[ndarray, "n"]:
        """Largest radius at points [m]."""
        return max_radii_at(np.ascontiguousarray(points), *self.arrays)


@dataclass(frozen=True, eq=False)
class Solid:
    """A union of convex meshes, with signed distances from its surface on a grid [m], negative inside."""

    meshes: tuple[ConvexMesh, ...]
    distance: Float[ndarray, "nx ny nz"]
    origin: Float[ndarray, "3"]
    spacing: float

    @staticmethod
    def of(meshes: tuple[ConvexMesh, ...], tolerance: float) -> "Solid":
        """The solid, with a grid large enough for spheres that stick out by a tolerance [m]."""
        corners = np.concatenate([mesh.vertices for mesh in meshes])
        low = corners.min(0)
        high = corners.max(0)
        beside = max(MIN_PADDING, tolerance)
        spacing = max(float(np.prod(high - low + 2 * beside) / GRID_POINTS) ** (1 / 3), MIN_SPACING)
        low = low - beside - 2 * spacing
        high = high + beside + 2 * spacing
        shape = np.ceil((high - low) / spacing).astype(int) + 1
        planes = stacked_planes(meshes)
        depth = plane_depths(_grid_points(shape, low, spacing), *planes).reshape(shape)
        inside = depth > 0
        # planes between overlapping meshes are not surface: measure from the outer surface instead
        deep = depth if len(meshes) == 1 else _distance_inside(inside, spacing, np.maximum(-depth, 0.0))
        return Solid(meshes, np.where(inside, -deep, -depth), low, spacing)

    @property
    def points(self) -> Float[ndarray, "n 3"]:
        """Points of the grid."""
        return _grid_points(self.distance.shape, self.origin, self.spacing)

    @property
    def depth(self) -> float:
        """Approximate radius of the largest inscribed sphere [m]."""
        return max(float(-self.distance.min()), MIN_DEPTH)

    @property
    def inside(self) -> Float[ndarray, "n 3"]:
        """Grid points inside the solid; the nearest ones if the solid is thinner than the spacing."""
        distance = self.distance.ravel()
        return self.points[distance < max(0.0, float(distance.min()) + self.spacing / 2)]

    def inscribed_sizes(self) -> SphereSizeGrid:
        """Largest radii of spheres that do not stick out at all."""
        return SphereSizeGrid(-self.distance, self.origin, self.spacing)

    def sphere_sizes(self, bounds: Bounds) -> SphereSizeGrid:
        """Largest radii of spheres within bounds."""
        points = self.points
        distance = self.distance.ravel()
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
        grid = _distance_inside(~outside, self.spacing, np.maximum(beyond, 0.0))
        return SphereSizeGrid(np.where(outside, -beyond, grid), self.origin, self.spacing)


def _distance_inside(
    mask: Bool[ndarray, "nx ny nz"], spacing: float, value: Float[ndarray, "nx ny nz"]
) -> Float[ndarray, "nx ny nz"]:
    """Distance of the points of a mask from its surface [m]: that to the nearest point outside the mask,
    minus `value` there, the distance of that point from the surface."""
    if not mask.any() or mask.all():
        return np.where(mask, spacing * sum(mask.shape), 0.0)
    found: Any = ndimage.distance_transform_edt(mask, return_indices=True)
    far, at = found
    return np.maximum(far * spacing - value[tuple(at)], 0.0)


def stacked_planes(meshes: tuple[ConvexMesh, ...]) -> Planes:
    """Normals and offsets of the face planes of all meshes, and the index where each mesh's planes start,
    with their total number last."""
    planes = [planes_of(mesh) for mesh in meshes]
    starts = np.cumsum([0, *(len(offsets) for _, offsets in planes)])
    return np.concatenate([normals for normals, _ in planes]), np.concatenate([o for _, o in planes]), starts


def depths(meshes: tuple[ConvexMesh, ...], points: Float[ndarray, "n 3"]) -> Float[ndarray, "n"]:
    """Distance from points to the nearest face plane of the mesh in which they are deepest [m]; negative
    outside."""
    return plane_depths(np.ascontiguousarray(points), *stacked_planes(meshes))


def _grid_points(
    shape: tuple[int, ...] | ndarray, origin: Float[ndarray, "3"], spacing: float
) -> Float[ndarray, "n 3"]:
    """Coordinates of all points of a grid [m]."""
    axes = [low + spacing * np.arange(count) for low, count in zip(origin, shape, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
