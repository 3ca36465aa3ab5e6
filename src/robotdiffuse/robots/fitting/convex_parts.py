"""Approximate convex decomposition: convex parts that cover a collision mesh, for exact distances by Coal.

Planes cut a mesh into parts until no part's convex hull sticks out of the mesh by more than a tolerance. Then
parts are merged as long as their common hull stays within the tolerance. If a plane cuts a closed surface,
the convex hull of the surface's piece on one side contains the whole solid on that side. So the parts always
cover the mesh and the solid that it encloses. A voxel grid measures how far a hull sticks out. Voxels that
cannot be reached from outside without crossing the surface count as solid. Therefore holes smaller than a
voxel, inner walls and overlapping triangles do no harm.
"""

from dataclasses import dataclass
from itertools import combinations
from operator import itemgetter
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from scipy import ndimage
from scipy.spatial import ConvexHull, HalfspaceIntersection, KDTree, QhullError

from robotdiffuse.core.kernels import kernel
from robotdiffuse.core.transforms import box_around, scaled_normals
from robotdiffuse.core.types import Points, Values, Vector
from robotdiffuse.robots.bodies import ConvexMesh, Surface
from robotdiffuse.robots.fitting.triangles import Triangles, split
from robotdiffuse.robots.frame_kernel import dot

MIN_THICKNESS = 1e-3
"""Smallest thickness of a hull [m]: fitting spheres and computing distances need a volume, also for thin
sheets."""


def convex_hull(points: Points) -> ConvexMesh:
    """Convex hull with outward faces. The points are `thickened` first."""
    points = thickened(points)
    hull = ConvexHull(points)
    used, faces = np.unique(hull.simplices, return_inverse=True)
    vertices = points[used]
    inwards = np.einsum("fd,fd->f", scaled_normals(vertices[faces]), hull.equations[:, :3]) < 0
    faces[inwards] = faces[inwards][:, ::-1]
    return ConvexMesh(vertices, faces)


def thickened(points: Points) -> Points:
    """The points. Along each principal axis in which they span less than `MIN_THICKNESS`, they are replaced
    by two copies, shifted by plus and minus `MIN_THICKNESS / 2`."""
    axes = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2]
    for axis in axes[np.ptp(points @ axes.T, axis=0) < MIN_THICKNESS]:
        points = np.concatenate([points - axis * MIN_THICKNESS / 2, points + axis * MIN_THICKNESS / 2])
    return points


def face_normals(mesh: ConvexMesh) -> Points:
    """Outward unit normals of the faces that have an area."""
    normals = scaled_normals(mesh.triangles)
    size = np.linalg.norm(normals, axis=1, keepdims=True)
    return (normals / np.maximum(size, 1e-14))[size[:, 0] > 1e-14]


def planes_of(mesh: ConvexMesh) -> tuple[Points, Values]:
    """Unit normals n and offsets d [m] of the distinct face planes of a convex mesh; points x of the mesh
    have n . x <= d."""
    normals = np.unique(np.round(face_normals(mesh), 9), axis=0)
    # offsets from the farthest vertex, so that rounding does not put a plane inside the mesh
    return normals, (mesh.vertices @ normals.T).max(0)


def hull_volume(points: Points) -> float:
    try:
        return ConvexHull(points).volume
    except (QhullError, ValueError):  # flat, or fewer than four points
        return 0.0


TIGHT_FRACTION = 0.125
"""Parts may stick out by this fraction of `concavity` at tight places: points where two links pass close to
each other."""
TIGHT_SLOPE = 0.3
"""Beyond a distance of 2 `concavity` from a tight place, parts may stick out by this much more per meter
[m/m]."""


class DistanceGrid(NamedTuple):
    """Distances of voxels from a solid, zero inside [m]."""

    origin: Vector
    """Lower corner of the grid [m]."""
    pitch: float
    """Edge of a voxel [m]."""
    distance: Float[ndarray, "nx ny nz"]

    @staticmethod
    def around(soups: list[Triangles], voxels: int, finest: float) -> "DistanceGrid":
        """A grid around triangles with about `voxels` voxels. Their edge is at least `finest` [m]."""
        low, high = box_around(np.concatenate(soups).reshape(-1, 3))
        size = np.maximum(high - low, finest)
        pitch = max(float(np.prod(size) / voxels) ** (1 / 3), size.max() / 300, finest)
        origin = low - 2.5 * pitch
        shape = np.ceil((high - origin) / pitch).astype(int) + 3
        occupied = np.zeros(shape, bool)
        for soup in soups:
            voxels_of = ((split(soup, pitch / 2).reshape(-1, 3) - origin) / pitch).astype(int)
            occupied[tuple(voxels_of.T)] = True
        components: Any = ndimage.label(~occupied)
        free = components[0] == components[0][0, 0, 0]
        return DistanceGrid(origin, pitch, ndimage.distance_transform_edt(free) * pitch)

    def near_tight(self, tight: Points, concavity: float) -> tuple["DistanceGrid", "DistanceGrid"]:
        """Two copies with enlarged distances near `tight` places. So a part that sticks out there has a
        larger concavity.

        At all other places, the first copy is zero, and the second copy has the original distances.
        """
        near = np.argwhere((self.distance > 0) & (self.distance < 3 * concavity))
        tight_distance = KDTree(tight).query(self.origin + (near + 0.5) * self.pitch)[0]
        allowed = TIGHT_FRACTION * concavity + TIGHT_SLOPE * np.maximum(tight_distance - 2 * concavity, 0.0)
        near = near[allowed < concavity]
        allowed = allowed[allowed < concavity]
        tight_distances = np.zeros_like(self.distance)
        tight_distances[tuple(near.T)] = self.distance[tuple(near.T)] * concavity / allowed
        enlarged = np.maximum(tight_distances, self.distance)
        return self._replace(distance=tight_distances), self._replace(distance=enlarged)

    def concavity(self, hull: ConvexMesh) -> float:
        """How far a hull sticks out of the solid, approximately [m]."""
        corners = (hull.vertices - self.origin) / self.pitch
        low = np.maximum(np.floor(corners.min(0)).astype(int), 0)
        high = np.minimum(np.ceil(corners.max(0)).astype(int) + 1, self.distance.shape)
        return _farthest_inside(self.distance, self.origin, self.pitch, low, high, *planes_of(hull))


@kernel()
def _farthest_inside(distance, origin, pitch, low, high, normals, offsets):
    """Largest `distance` of the voxels from `low` to `high` with centers within the planes."""
    farthest = 0.0
    for i in range(low[0], high[0]):
        for j in range(low[1], high[1]):
            for k in range(low[2], high[2]):
                if distance[i, j, k] <= farthest:
                    continue
                center = (
                    origin[0] + (i + 0.5) * pitch,
                    origin[1] + (j + 0.5) * pitch,
                    origin[2] + (k + 0.5) * pitch,
                )
                for f in range(len(offsets)):
                    if dot(normals[f], center) > offsets[f]:
                        break
                else:
                    farthest = distance[i, j, k]
    return farthest


CUT_FRACTIONS = np.arange(1, 10) / 10
"""Candidate cuts along each axis, as fractions of the part's length."""
WALL_OFFSET = 1e-4
"""Distance between a surface and a cut beside it [m]."""
IMPROVEMENT = 0.999
"""A candidate cut replaces the best cut so far only if the total volume of its two hulls is below this
fraction of the best volume."""
MAX_WALLS = 6
"""Largest number of surfaces perpendicular to an axis at which further cuts are tried."""
MAX_CUT_POINTS = 1200
"""Largest number of surface points for choosing a cut."""
MAX_NORMALS = 1000
"""If a hull has more faces, similar normals are merged before it is simplified."""
TIGHT_PART_FACTOR = 4
"""Factor on the largest number of parts of a link with tight places."""
MAX_PLANES = 120
"""Largest number of planes of a simplified hull."""
SIMPLIFIED_GROWTH = 1e-7
"""Distance by which the planes of simplified hulls are moved outwards [m], larger than rounding errors."""


@dataclass(frozen=True)
class PartSettings:
    """How closely convex parts follow a mesh."""

    concavity: float = 0.007
    """How far the hull of a part may stick out of the mesh [m]."""
    most: int = 16
    """Largest number of parts of a link, or two for each of its surfaces if that is more. For a link with
    tight places, TIGHT_PART_FACTOR times this number."""
    voxels: int = 400_000
    """Approximate number of voxels of the grid that measures concavity; with tight places, 8 times this."""
    finest: float = 0.0015
    """Smallest voxel edge [m]; with tight places, half of this."""
    faces: int = 400
    """Hulls with more triangles are simplified. A simplified hull contains the original one."""
    rounding: float = 5e-4
    """How far a simplified hull may stick out of the original hull [m]. A hull with MAX_PLANES planes may
    stick out further."""


def convex_parts(
    surfaces: tuple[Surface, ...],
    settings: PartSettings = PartSettings(),
    tight: Points | None = None,
) -> tuple[ConvexMesh, ...]:
    """Convex meshes that together contain the surfaces of a link and the space that they enclose.

    Near `tight` places [n, 3], in the link's frame [m], the meshes stick out less.
    """
    soups = [surface.triangles for surface in surfaces]
    finer = 1 if tight is None else 2
    space = DistanceGrid.around(soups, finer**3 * settings.voxels, settings.finest / finer)
    parts = [Part.of(soup, _spread(soup, space.pitch), space, settings) for soup in soups]
    parts = _cut(parts, space, settings, max(settings.most, 2 * len(parts)))
    if tight is not None:
        tight_only, space = space.near_tight(tight, settings.concavity)
        parts = [part._replace(concavity=tight_only.concavity(part.hull)) for part in parts]
        parts = _cut(parts, tight_only, settings, TIGHT_PART_FACTOR * settings.most)
    return tuple(_without_contained(_merged([part.hull for part in parts], space, settings)))


def _cut(parts: list["Part"], space: DistanceGrid, settings: PartSettings, most: int) -> list["Part"]:
    """Cuts parts in two, the most concave part first, until all parts are within `settings.concavity` or
    there are `most` parts."""
    parts = list(parts)
    while len(parts) < most:
        most_concave = max(range(len(parts)), key=lambda i: parts[i].concavity)
        if parts[most_concave].concavity <= settings.concavity:
            break
        parts[most_concave : most_concave + 1] = parts[most_concave].halves(space, settings)
    return parts


def simplified(hull: ConvexMesh, settings: PartSettings = PartSettings()) -> ConvexMesh:
    """A convex mesh with fewer faces that contains a hull; the hull itself if it has at most `settings.faces`
    faces.

    The mesh is bounded by up to `MAX_PLANES` of the hull's planes. Planes are added where the mesh's corners
    stick out most.
    """
    if len(hull.faces) <= settings.faces:
        return hull
    normals = face_normals(hull)
    if len(normals) > MAX_NORMALS:  # merge similar normals
        _, first = np.unique(np.round(normals * 12).astype(int) @ [1, 100, 10_000], return_index=True)
        normals = normals[first]
    normals = np.concatenate([np.eye(3), -np.eye(3), normals])
    # plane by plane: a table of 650,000 corners and 1,000 planes would take 5 GB
    offsets = np.array([(hull.vertices @ normal).max() for normal in normals]) + SIMPLIFIED_GROWTH
    chosen = list(range(6))
    middle = hull.vertices.mean(0)
    try:
        while True:
            halfspaces = np.column_stack([normals[chosen], -offsets[chosen]])
            corners = HalfspaceIntersection(halfspaces, middle).intersections
            beyond = corners @ normals.T - offsets
            max_excess = beyond.max(1)
            if max_excess.max() <= settings.rounding or len(chosen) >= MAX_PLANES:
                return convex_hull(corners)
            for corner in np.argsort(-max_excess)[: min(8, MAX_PLANES - len(chosen))]:
                plane = int(beyond[corner].argmax())
                if max_excess[corner] > settings.rounding and plane not in chosen:
                    chosen.append(plane)
    except QhullError:  # almost flat
        return hull


class Part(NamedTuple):
    triangles: Triangles
    points: Points
    """Points spread over the triangles, for choosing cuts."""
    hull: ConvexMesh
    concavity: float

    @staticmethod
    def of(triangles: Triangles, points: Points, space: DistanceGrid, settings: PartSettings) -> "Part":
        hull = simplified(convex_hull(triangles.reshape(-1, 3)), settings)
        # all sampled points of a thin sheet may lie on the other side of the cut: sample this side again
        if not len(points):
            points = _spread(triangles, space.pitch)
        return Part(triangles, points, hull, space.concavity(hull))

    def halves(self, space: DistanceGrid, settings: PartSettings) -> list["Part"]:
        """The two parts on both sides of the plane that minimizes the total volume of their hulls. A part
        that is too small to cut is returned alone, with concavity 0."""
        low = self.hull.vertices.min(0)
        size = np.ptp(self.hull.vertices, axis=0)
        points, pitch = _thinned(self.points, space.pitch)
        best = None
        min_volume = np.inf
        for axis in sorted(np.flatnonzero(size > 6 * space.pitch), key=lambda axis: -size[axis]):
            for at in (*_wall_cuts(points[:, axis], space.pitch), *(low[axis] + CUT_FRACTIONS * size[axis])):
                height = points[:, axis] - at
                volume = 0.0
                for side in (points[height <= 0], points[height > 0]):
                    edge = side[np.abs(side[:, axis] - at) <= pitch]
                    edge[:, axis] = at  # approximates the intersection of surface and plane
                    volume += hull_volume(np.concatenate([side, edge]))
                if volume < IMPROVEMENT * min_volume:
                    best = (int(axis), at)
                    min_volume = volume
        halves = _sides(self.triangles, *best) if best else []
        if best is None or not all(map(len, halves)):
            return [self._replace(concavity=0.0)]
        is_low = self.points[:, best[0]] <= best[1]
        points = self.points[is_low], self.points[~is_low]
        return [Part.of(side, near, space, settings) for side, near in zip(halves, points, strict=True)]


def _wall_cuts(heights: Values, pitch: float) -> list[float]:
    """Coordinates of cuts just below and above surfaces perpendicular to an axis, where parts often meet
    [m]."""
    counts, edges = np.histogram(heights, max(int(np.ptp(heights) / pitch), 1))
    fullest = np.argsort(-counts)[:MAX_WALLS]
    middles = [
        float(np.median(heights[(heights >= edges[k]) & (heights <= edges[k + 1])]))
        for k in fullest
        if counts[k] > 2 * np.median(counts)
    ]
    return [middle + step for middle in middles for step in (-WALL_OFFSET, WALL_OFFSET)]


def _spread(triangles: Triangles, size: float) -> Points:
    """Points spread over a surface, one per cube of edge `size` [m], whatever the order of the triangles."""
    points = np.unique(split(triangles, 2 * size).reshape(-1, 3), axis=0)
    return points[one_per_cube(points, size)]


def _thinned(points: Points, size: float) -> tuple[Points, float]:
    """At most `MAX_CUT_POINTS` of the points, one per cube, and the edge of the cubes [m]."""
    while len(points) > MAX_CUT_POINTS:
        size *= 1.3
        points = points[one_per_cube(points, size)]
    return points, size


def one_per_cube(points: Points, size: float) -> Int[ndarray, "n"]:
    """Index of the first point in each cube of edge `size` [m] that has points."""
    cubes = np.floor(points / size).astype(np.int64)
    return np.unique(cubes @ (1, 2**21, 2**42), return_index=True)[1]


def _sides(triangles: Triangles, axis: int, at: float) -> list[Triangles]:
    """Cuts triangles by an axis-aligned plane; returns the triangles below and above it."""
    from trimesh.intersections import slice_faces_plane  # slow to import, and few robots need it

    corners = triangles.reshape(-1, 3)
    faces = np.arange(len(corners)).reshape(-1, 3)
    upwards = np.eye(3)[axis]
    sides = [slice_faces_plane(corners, faces, normal, at * upwards) for normal in (-upwards, upwards)]
    return [vertices[face_corners] for vertices, face_corners, _ in sides]


def _merged(hulls: list[ConvexMesh], space: DistanceGrid, settings: PartSettings) -> list[ConvexMesh]:
    """Merges pairs of hulls. Each step merges the pair with the common hull that sticks out least, as long as
    it sticks out by at most `settings.concavity`."""

    def candidate(a: ConvexMesh, b: ConvexMesh) -> tuple[float, ConvexMesh, set[ConvexMesh]]:
        common_hull = simplified(convex_hull(np.concatenate([a.vertices, b.vertices])), settings)
        return space.concavity(common_hull), common_hull, {a, b}

    candidates = [candidate(*pair) for pair in combinations(hulls, 2)]
    while candidates:
        concavity, common_hull, pair = min(candidates, key=itemgetter(0))
        if concavity > settings.concavity:
            break
        hulls = [hull for hull in hulls if hull not in pair]
        candidates = [entry for entry in candidates if not entry[2] & pair]
        candidates += [candidate(hull, common_hull) for hull in hulls]
        hulls.append(common_hull)
    return hulls


def _without_contained(hulls: list[ConvexMesh]) -> list[ConvexMesh]:
    """The hulls without those that another hull contains."""
    by_size = sorted(hulls, key=lambda hull: float(np.prod(np.ptp(hull.vertices, axis=0))))
    remaining = {hull: planes_of(hull) for hull in by_size}
    for hull, planes in tuple(remaining.items()):
        del remaining[hull]
        if not any((hull.vertices @ normals.T <= offsets).all() for normals, offsets in remaining.values()):
            remaining[hull] = planes
    return list(remaining)
