"""Fits covering spheres to the convex collision meshes of a link.

The surface is cut into small triangles, called cells. A sphere is convex, so it covers a triangle if and only
if it contains the three corners. If every cell is inside one sphere, the spheres provably cover the whole
surface, not just samples of it.

A grid stores the largest allowed radius of a sphere at each center (`SphereSizeGrid`). For the cells assigned
to a sphere, the best center p minimizes the excess radius max |corner - p| - max_radius(p). Like Lloyd's
algorithm, the fit alternates between two steps: assigning each cell to the sphere that covers it with the
least excess, and moving each sphere to its best center. It starts from a greedy set cover, and then drops
spheres as long as the others stay within their allowed radii.

A sphere may contain points up to a tolerance away from the link; the tolerance may be smaller near some
places. It may also contain points that are inside a neighboring link at all values of the joint between the
two links. It may not contain points below the plane that the robot stands on.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from scipy import ndimage
from scipy.spatial import KDTree

from robotdiffuse.core.transforms import box_around
from robotdiffuse.core.types import NO_SPHERES, Mask, Points, Spheres, Values, Vector, for_kernels
from robotdiffuse.robots.bodies import ConvexMesh
from robotdiffuse.robots.fitting.convex_parts import planes_of
from robotdiffuse.robots.fitting.sphere_fitting_kernel import (
    DIRECTIONS,
    assign,
    gaps,
    greedy_cover,
    held_by_one,
    max_radii_at,
    plane_depths,
    relax,
)
from robotdiffuse.robots.fitting.triangles import split

GRID_POINTS = 200_000
"""Approximate number of points of the grid around a link."""
MIN_SPACING = 0.0015
"""Smallest spacing of a grid [m]."""
MIN_PADDING = 0.03
"""Smallest padding of the grid around the link [m]: spheres may reach this far into a neighbor."""
TIGHT_RADIUS = 0.015
"""The smaller tolerance of a tight place applies within this distance from it [m]."""
TIGHT_SLOPE = 0.3
"""Beyond TIGHT_RADIUS from a tight place, the tolerance grows by this much per meter [m/m]."""

MIN_DEPTH = 5e-4
"""Lower bound on the inscribed radius of a link, for thin plates [m]."""
FLOOR_TOLERANCE = 0.0015
"""Lower bound of the tolerance near the floor [m]; not zero, since a link may lie on the floor."""
TOLERANCE_LEVEL = np.log(1.3)
"""Tight places with similar tolerances form a group, which saves time: the tolerances of a group differ by at
most a factor of 1.3 (here its logarithm), and the lowest one applies to all of its places."""

Planes = tuple[Points, Values, ndarray]


class Bounds(NamedTuple):
    """How far spheres may stick out of a link."""

    tolerance: float
    """How far a sphere may stick out of the link [m]."""
    hidden: Callable[[Points], Mask] | None = None
    """Tells which points are inside a neighboring link: spheres may contain such points."""
    tight: Spheres = NO_SPHERES
    """Tight places: rows of x, y, z and how far spheres may stick out there [m]. Near these places, `hidden`
    does not apply to points within 2 `tolerance` of the link."""
    floor: tuple[Vector, float] | None = None
    """Upward normal n and offset [m] of a plane: spheres may not contain points x with n . x below the
    offset. Less than `tolerance` above the plane, `hidden` does not apply to points within 2 `tolerance` of
    the link."""

    @property
    def varies(self) -> bool:
        """Whether the tolerance is smaller in some places."""
        return len(self.tight) > 0 or self.floor is not None

    def tolerances(self, points: Points) -> Values:
        """How far spheres may stick out at points [m]."""
        allowed = np.full(len(points), self.tolerance)
        if self.floor is not None:
            normal, offset = self.floor
            np.minimum(allowed, np.maximum(points @ normal - offset, FLOOR_TOLERANCE), out=allowed)
        level = np.ceil(np.log(self.tight[:, 3]) / TOLERANCE_LEVEL)
        for group_level in np.unique(level):
            places = self.tight[level == group_level]
            distances = KDTree(places[:, :3]).query(
                points, distance_upper_bound=TIGHT_RADIUS + self.tolerance / TIGHT_SLOPE
            )[0]
            tight_bound = places[:, 3].min() + TIGHT_SLOPE * np.maximum(distances - TIGHT_RADIUS, 0.0)
            np.minimum(allowed, tight_bound, out=allowed)
        return allowed


class SphereSizeGrid(NamedTuple):
    """Largest allowed radius of a sphere at each center [m], interpolated on a grid; negative where no sphere
    may be centered."""

    grid: Float[ndarray, "nx ny nz"]
    origin: Vector
    spacing: float

    def at(self, points: Points) -> Values:
        """Largest radius at points [m]."""
        return max_radii_at(np.ascontiguousarray(points), *self)


class Solid(NamedTuple):
    """A union of convex meshes, with signed distances from its surface on a grid [m], negative inside.
    Outside, these are distances from face planes, which near edges are less than those from the solid."""

    meshes: tuple[ConvexMesh, ...]
    distance: Float[ndarray, "nx ny nz"]
    origin: Vector
    spacing: float

    @staticmethod
    def of(meshes: tuple[ConvexMesh, ...], tolerance: float) -> "Solid":
        """The solid, with a grid large enough for spheres that stick out by a tolerance [m]."""
        corners = np.concatenate([mesh.vertices for mesh in meshes])
        low, high = box_around(corners)
        padding = max(MIN_PADDING, tolerance)
        spacing = max(float(np.prod(high - low + 2 * padding) / GRID_POINTS) ** (1 / 3), MIN_SPACING)
        low = low - padding - 2 * spacing
        high = high + padding + 2 * spacing
        shape = np.ceil((high - low) / spacing).astype(int) + 1
        planes = stacked_planes(meshes)
        depth = plane_depths(_grid_points(shape, low, spacing), *planes, -np.inf).reshape(shape)
        inside = depth > 0
        # face planes inside other meshes are not part of the surface: measure the depth from the outer
        # surface instead
        deep = depth if len(meshes) == 1 else _distance_inside(inside, spacing, np.maximum(-depth, 0.0))
        return Solid(meshes, np.where(inside, -deep, -depth), low, spacing)

    @property
    def points(self) -> Points:
        """Points of the grid."""
        return _grid_points(self.distance.shape, self.origin, self.spacing)

    @property
    def depth(self) -> float:
        """Approximate radius of the largest inscribed sphere, at least MIN_DEPTH [m]."""
        return max(float(-self.distance.min()), MIN_DEPTH)

    @property
    def inside(self) -> Points:
        """Grid points inside the solid. If none is deeper than half the spacing, the grid points whose
        distance exceeds the smallest distance by less than half the spacing."""
        distance = self.distance.ravel()
        return self.points[distance < max(0.0, float(distance.min()) + self.spacing / 2)]

    def inscribed_sizes(self) -> SphereSizeGrid:
        """Largest radii of spheres that do not stick out of the solid at all."""
        return SphereSizeGrid(-self.distance, self.origin, self.spacing)

    def sphere_sizes(self, bounds: Bounds) -> SphereSizeGrid:
        """Largest radii of spheres that respect the bounds."""
        # `beyond`: how far a grid point is outside the region that spheres may fill
        points = self.points
        distance = self.distance.ravel()
        allowed = np.full(len(points), bounds.tolerance)
        near = (distance > -bounds.tolerance) & (distance < 2 * bounds.tolerance)
        allowed[near] = bounds.tolerances(points[near])
        beyond = distance - allowed
        if bounds.hidden is not None:
            queried = np.flatnonzero((beyond > 0) & (allowed >= bounds.tolerance))
            beyond[queried[bounds.hidden(points[queried])]] = -self.spacing / 2
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
    """Distance of the points in a mask from the surface of the masked region [m]; 0 outside the mask.

    It is the distance to the nearest point outside the mask, minus the distance of this point from the
    surface, which `value` gives.
    """
    if not mask.any() or mask.all():
        return np.where(mask, spacing * sum(mask.shape), 0.0)
    transform: Any = ndimage.distance_transform_edt(mask, return_indices=True)
    far, at = transform
    return np.maximum(far * spacing - value[tuple(at)], 0.0)


def stacked_planes(meshes: tuple[ConvexMesh, ...]) -> Planes:
    """Normals and offsets of the face planes of all meshes, and the index where each mesh's planes start,
    with their total number last."""
    normals, offsets = zip(*map(planes_of, meshes), strict=True)
    return np.concatenate(normals), np.concatenate(offsets), np.cumsum([0, *map(len, offsets)])


def is_inside(points: Points, planes: Planes, depth: float) -> Mask:
    """Which points are deeper than `depth` [m] in one of the meshes; a negative depth includes points near a
    mesh."""
    return plane_depths(points, *planes, depth) > depth


def _grid_points(shape: tuple[int, ...] | ndarray, origin: Vector, spacing: float) -> Points:
    """Coordinates of all points of a grid [m]."""
    return origin + spacing * np.stack([*np.indices(tuple(shape))], axis=-1).reshape(-1, 3)


MARGIN = 1e-5
"""Margin added to the radii [m], since files and single-precision kernels round them."""
BURIED_DEPTH = 1e-9
"""Points deeper than this in another mesh are not on the surface of the union [m]."""
EXCESS_TOLERANCE = 0.1
"""Largest excess radius that is accepted, as a fraction of the grid spacing."""
# Cells for choosing spheres, and for the final fit: number of cell edges per radius of the disc that a sphere
# covers, and largest number of cells.
COARSE_CELLS = (5.0, 60_000)
FINE_CELLS = (8.0, 150_000)
MAX_CELL_RATIO = 10
"""If the estimated number of cells is more than this multiple of the allowed number, larger cells are chosen
before any are made, since small ones may not fit into memory."""
SMALLEST_TRIANGLE = 2e-6
"""A triangle of the surface that no single sphere contains is split down to this size [m]; a smaller one
counts as uncovered."""
ADDED_SPACING = 0.02
"""Smallest distance between spheres that are added in one round [m]."""


@dataclass(frozen=True)
class SphereSettings:
    """How closely covering spheres follow the meshes of a link."""

    first_half: float = 0.015
    """How far a sphere may stick out of a link in the first half of the arm [m]: the index of the link's
    frame is at most half the number of planned joints, rounded up."""
    second_half: float = 0.009
    """How far a sphere may stick out of a link in the second half [m]. It is smaller because the outer links
    of an arm work closer to obstacles."""
    fixed: float = 0.03
    """How far a sphere may stick out of a link that no planned joint moves [m]. It is larger because such a
    link is only checked against other links."""
    finest: float = 0.004
    """Lower bound of the tolerances above [m]."""
    candidates: int = 1000
    """Number of candidate centers of the greedy cover."""
    rounds: int = 5
    """Number of rounds of assigning cells and moving spheres, after each change of the number of spheres."""
    tries: int = 3
    """A round of dropping spheres ends after this number of failed attempts to drop one."""
    most: int = 200
    """Approximate largest number of spheres for each link; if they do not suffice, the spheres exceed the
    tolerance."""

    def tolerance(self, frame: int, dof: int, inradius: float) -> float:
        """How far the spheres of a link may stick out [m].

        The link is fixed to frame `frame` (see `Robot.link_frame`) of a robot with `dof` planned joints. The
        result is at most `inradius`, the radius of the link's largest inscribed sphere [m], but at least
        `finest`. For frame 0 it is the larger of `first_half` and `fixed`, within these bounds.
        """
        target = self.first_half if frame <= (dof + 1) // 2 else self.second_half
        if frame == 0:
            target = max(target, self.fixed)
        return float(max(min(target, inradius), self.finest))


def fit_spheres(
    solid: Solid,
    bounds: Bounds,
    rng: np.random.Generator,
    settings: SphereSettings,
) -> Spheres:
    """Spheres [x y z radius, m] that cover surface and interior of a solid and respect `bounds`."""
    sizes = solid.sphere_sizes(bounds)
    inside = solid.inside
    # a sphere that sticks out of a flat face by e covers a disc of radius sqrt(2 r e); cells are much smaller
    coarse_cells, fine_cells = (Cells.of(solid, bounds, *size) for size in (COARSE_CELLS, FINE_CELLS))
    places = rng.permutation(inside)[: settings.candidates] + rng.uniform(-0.5, 0.5, 3) * solid.spacing
    chosen = greedy_cover(coarse_cells.points, coarse_cells.corners, places, sizes.at(places))
    centers = _with_enough_spheres(sizes, coarse_cells, places[chosen], settings)
    centers = _with_enough_spheres(
        sizes, fine_cells, _thin_out(sizes, coarse_cells, centers, settings), settings
    )
    centers, _ = _relax(sizes, fine_cells, centers, settings.rounds, -np.inf)  # minimize the excess
    return _without_holes(solid, inside, _with_radii(sizes, fine_cells, centers))


def stick_out(solid: Solid, spheres: Spheres) -> Values:
    """How far each sphere sticks out of the solid [m]."""
    return spheres[:, 3] - solid.inscribed_sizes().at(spheres[:, :3])


def covered(meshes: tuple[ConvexMesh, ...], spheres: Spheres) -> bool:
    """Whether the spheres provably cover the surface of the union of the meshes.

    Triangles that no single sphere contains are cut in four. This ends when spheres contain all triangles
    (True), a corner is outside all spheres, or a triangle is smaller than SMALLEST_TRIANGLE (False).
    Triangles and corners inside another mesh are ignored, since they are not on the surface.
    """
    from trimesh.remesh import subdivide  # slow to import, and only preparation needs it

    triangles = np.concatenate([mesh.triangles for mesh in meshes])
    spheres = for_kernels(spheres)
    mesh_planes = [stacked_planes((mesh,)) for mesh in meshes] if len(meshes) > 1 else []
    while True:
        corners = triangles.reshape(-1, 3)
        contained, outside = held_by_one(triangles, spheres)
        is_open = ~contained
        for planes in mesh_planes:
            hidden = is_inside(corners, planes, BURIED_DEPTH)
            is_open &= ~hidden.reshape(-1, 3).all(1)
            outside &= ~hidden
        if outside.any():
            return False
        if not is_open.any():
            return True
        if np.linalg.norm(np.ptp(triangles[is_open], axis=1), axis=1).min() < SMALLEST_TRIANGLE:
            return False
        vertices, faces, *_ = subdivide(corners, np.arange(len(corners)).reshape(-1, 3)[is_open])
        triangles = vertices[faces]


class Cells(NamedTuple):
    """Small triangles on the surface of the union of meshes."""

    points: Points
    corners: Int[ndarray, "c 3"]
    """Indices in `points` of the corners of each cell."""
    sharp: Mask
    """Whether a point is a vertex of a mesh; true for all points if cells were left out or differ in size.
    A point that is not sharp lies on a face or an edge between neighboring points, so a sphere that covers
    the neighbors covers the point."""

    @staticmethod
    def of(solid: Solid, bounds: Bounds, cut: float, most: int) -> "Cells":
        """Cells on the surface of a solid. Triangles of a mesh that are inside another mesh are left out.

        A sphere within the bounds covers a disc of a flat face. The radius of the largest such disc is at
        least `cut` times the edge of a cell. If this makes more than `most` cells, the cells are larger, up
        to the triangles of the meshes.
        """
        size = _disc(bounds.tolerance, solid.depth) / cut
        corners = np.concatenate([mesh.triangles for mesh in solid.meshes])
        area = np.linalg.norm(np.cross(*np.diff(corners, axis=1).swapaxes(0, 1)), axis=1).sum() / 2
        ratio = area / size**2 / most
        if ratio > MAX_CELL_RATIO:
            return Cells.of(solid, bounds, cut / np.sqrt(ratio), most)
        soup = []
        vertices = []
        irregular = False
        planes = [stacked_planes((mesh,)) for mesh in solid.meshes]
        for k, mesh in enumerate(solid.meshes):
            triangles = split(mesh.triangles, size)
            hidden = np.zeros(len(triangles), bool)
            for mesh_planes in (*planes[:k], *planes[k + 1 :]):
                hidden |= is_inside(triangles.reshape(-1, 3), mesh_planes, BURIED_DEPTH).reshape(-1, 3).all(1)
            triangles = triangles[~hidden]
            if bounds.varies:
                tolerances = bounds.tolerances(triangles.mean(1))
                triangles = split(triangles, _disc(tolerances, solid.depth) / cut)
            soup.append(triangles)
            vertices.append(mesh.vertices)
            irregular |= bool(hidden.any() or bounds.varies)
        corners = np.concatenate(soup).reshape(-1, 3)
        ratio = len(corners) / 3 / most
        if ratio > 1 and len(corners) > 3 * sum(len(mesh.faces) for mesh in solid.meshes):
            return Cells.of(solid, bounds, cut / np.sqrt(1.1 * ratio), most)
        # join corners that agree to about a millionth of the size: round them to 21 bits for each axis
        points = np.concatenate([*vertices, corners])
        lattice = np.round((points - points.min(0)) * (2**20 / np.ptp(points, axis=0).max())).astype(np.int64)
        _, first, index = np.unique(lattice @ (1, 2**21, 2**42), return_index=True, return_inverse=True)
        count = len(points) - len(corners)
        points = points[first]
        sharp = np.zeros(len(points), bool)
        sharp[index[:count]] = True
        # if triangles are left out or split to different sizes, any point may be a corner of the surface
        sharp |= irregular
        return Cells(points, index[count:].reshape(-1, 3), sharp)

    def assigned(
        self, sizes: SphereSizeGrid, centers: Points
    ) -> tuple[Int[ndarray, "c"], Values, Int[ndarray, "c"], Values]:
        """For each cell: the sphere that covers it with the least excess, its excess radius [m], the second
        best sphere (-1 if there is none), and the excess radius of this one [m]."""
        return assign(self.points, self.corners, centers, sizes.at(centers))

    def part(self, mine: Mask) -> "Cells":
        """The cells in the mask `mine`. Points that other cells share count as sharp, since some of their
        neighbors are missing in the part."""
        outside = np.zeros(len(self.points), bool)
        outside[self.corners[~mine]] = True
        used, corners = np.unique(self.corners[mine], return_inverse=True)
        return Cells(self.points[used], corners, (self.sharp | outside)[used])


def _relax(
    sizes: SphereSizeGrid, cells: Cells, centers: Points, rounds: int, enough: float
) -> tuple[Points, float]:
    """Improved centers, and their largest excess radius [m]. Ends early when the excess is at most
    `enough`."""
    return relax(cells.points, cells.corners, cells.sharp, centers, rounds, enough, *sizes, DIRECTIONS)


def _with_enough_spheres(
    sizes: SphereSizeGrid, cells: Cells, centers: Points, settings: SphereSettings
) -> Points:
    """Improved centers. Spheres are added until none exceeds its allowed radius by more than EXCESS_TOLERANCE
    of the grid spacing, or there are `settings.most` spheres."""
    max_excess = sizes.spacing * EXCESS_TOLERANCE
    centers, largest_excess = _relax(sizes, cells, centers, settings.rounds, max_excess)
    while largest_excess > max_excess and len(centers) < settings.most:
        _, excess, _, _ = cells.assigned(sizes, centers)
        extra = _worst_points(cells.points[cells.corners].mean(1), excess, len(centers) // 20 + 1)
        centers, largest_excess = _relax(
            sizes, cells, np.concatenate([centers, extra]), settings.rounds, max_excess
        )
    return centers


def _worst_points(points: Points, excess: Values, count: int) -> Points:
    """Up to `count` points with the largest excess that are at least ADDED_SPACING apart."""
    order = np.argsort(-excess)[: max(1, int((excess > 0).sum()))]
    points = points[order]
    chosen = []
    while len(points) and len(chosen) < count:
        chosen.append(points[0])
        points = points[np.linalg.norm(points - points[0], axis=1) > ADDED_SPACING]
    return np.array(chosen)


def _thin_out(sizes: SphereSizeGrid, cells: Cells, centers: Points, settings: SphereSettings) -> Points:
    """Drops spheres as long as the remaining ones can cover the dropped spheres' cells, and returns the
    remaining centers. Spheres that are the easiest to replace are dropped first.

    When a sphere is dropped, only the spheres that take over its cells are moved.
    """
    max_excess = sizes.spacing * EXCESS_TOLERANCE
    centers, required = centers.copy(), np.zeros(len(centers), bool)
    while len(centers) > 1:
        owner, _, runner_up, second_excess = cells.assigned(sizes, centers)
        loss = np.full(len(centers), -np.inf)
        np.maximum.at(loss, owner, second_excess)
        dropped = np.zeros_like(required)
        moved = np.zeros_like(required)
        failures = 0
        for i in np.argsort(loss):
            takers = np.unique(runner_up[owner == i])  # the spheres that would cover the cells of sphere i
            if required[i] or moved[i] or moved[takers].any():
                continue
            if not len(takers):  # sphere i has no cells
                dropped[i] = True
                continue
            affected = np.zeros(len(centers), bool)
            affected[i] = affected[takers] = True
            part = cells.part(affected[owner])
            new_centers, excess = _relax(sizes, part, centers[takers], settings.rounds, max_excess)
            if excess > max_excess:
                required[i] = True
                failures += 1
                if failures == settings.tries:
                    break
                continue
            centers[takers] = new_centers
            dropped[i] = True
            moved |= affected
        if not dropped.any():
            break
        required &= ~moved
        centers = centers[~dropped]
        required = required[~dropped]
    return centers


def _with_radii(sizes: SphereSizeGrid, cells: Cells, centers: Points) -> Spheres:
    """Spheres at the centers, each with the smallest radius that covers the cells assigned to it. Spheres
    without cells are dropped."""
    owner, _, _, _ = cells.assigned(sizes, centers)
    radii = np.zeros(len(centers))
    corner_distances = np.linalg.norm(cells.points[cells.corners] - centers[owner][:, None], axis=2).max(1)
    np.maximum.at(radii, owner, corner_distances + MARGIN)
    return np.concatenate([centers, radii[:, None]], axis=1)[radii > 0]


def _without_holes(solid: Solid, inside: Points, spheres: Spheres) -> Spheres:
    """The spheres, plus further spheres that fill uncovered holes inside the solid, where a small obstacle
    could hide."""
    depth = solid.inscribed_sizes().at(inside)
    gap = gaps(inside, spheres)
    # No point is farther from the nearest grid point than `half`, half the diagonal of a grid cell. So a
    # sphere must contain the ball of this radius around a grid point deep in the solid; elsewhere, just the
    # grid point.
    half = np.sqrt(0.75) * solid.spacing
    is_open = gap > np.where(depth > 2 * half, -half, 0.0)
    inside = inside[is_open]
    depth = depth[is_open]
    extra = []
    while len(inside):
        deepest = int(depth.argmax())
        extra.append(np.append(inside[deepest], max(depth[deepest], half)))
        is_open = np.linalg.norm(inside - inside[deepest], axis=1) > extra[-1][3] - half
        is_open[deepest] = False
        inside = inside[is_open]
        depth = depth[is_open]
    return np.concatenate([spheres, np.reshape(extra, (-1, 4))])


def _disc(tolerance: Any, depth: float) -> Any:
    """Radius of the disc on a flat face that a sphere covers [m]. The sphere's center is `depth` below the
    face, and the sphere sticks out by `tolerance`."""
    return np.sqrt(2 * tolerance * depth + tolerance**2)
