"""Approximate convex decomposition: convex parts that cover a collision mesh, for exact distances by Coal.

Planes cut a mesh until no part's hull sticks out of it too far. Then parts are merged as long as their common
hull does not stick out too far. The hull of the part of a closed surface on one side of a plane contains the
solid on that side, so the parts cover mesh and solid by construction, whatever the mesh looks like. A voxel
grid measures how far a hull sticks out. Voxels that cannot be reached from outside without crossing the
surface count as solid, so holes smaller than a voxel, inner walls and overlapping triangles do no harm.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.spatial import HalfspaceIntersection, QhullError

from robotdiffuse.core.errors import InputError
from robotdiffuse.robots.bodies import ConvexMesh, Surface
from robotdiffuse.robots.fitting.convex_hulls import convex_hull, face_normals, hull_volume, planes_of
from robotdiffuse.robots.fitting.distance_grid import DistanceGrid, split

CUT_FRACTIONS = np.arange(1, 10) / 10
"""Candidate cuts along each axis, as fractions of the part's length."""
WALL_OFFSET = 1e-4
"""Distance between a surface and a cut beside it [m]."""
IMPROVEMENT = 0.999
"""A later candidate cut must reduce the volume of the hulls below this fraction of the best so far."""
MAX_WALLS = 6
"""Largest number of surfaces perpendicular to an axis at which further cuts are tried."""
MAX_CUT_POINTS = 1200
"""Approximate largest number of surface points for choosing a cut."""
MAX_NORMALS = 1000
"""A hull with more faces has similar normals merged before it is simplified."""
TIGHT_PART_FACTOR = 4
"""A link with tight places may have this many times as many parts."""
SIMPLIFIED_GROWTH = 1e-7
"""Growth of simplified hulls [m], larger than rounding errors."""


@dataclass(frozen=True)
class PartSettings:
    """How closely convex parts follow a mesh."""

    concavity: float = 0.007
    """How far the hull of a part may stick out of the mesh [m]."""
    most: int = 16
    """Largest number of parts per link."""
    voxels: int = 400_000
    """Approximate number of voxels of the grid that measures concavity."""
    finest: float = 0.0015
    """Smallest voxel edge [m]."""
    faces: int = 400
    """Hulls with more triangles are simplified; they only grow."""
    rounding: float = 5e-4
    """How far a simplified hull may stick out of the hull [m], if 120 planes suffice for that."""

    def __post_init__(self) -> None:
        if not self.finest > 0 or not self.concavity > 0 or self.most < 1:
            raise InputError(
                f"convex parts: concavity is {self.concavity}, finest {self.finest}, most {self.most}; "
                "all must be positive"
            )

    def scaled(self, size: float) -> "PartSettings":
        """The settings for meshes scaled by a factor."""
        lengths = ("concavity", "finest", "rounding")
        return replace(self, **{name: size * getattr(self, name) for name in lengths})

    def finer(self) -> "PartSettings":
        """The settings with voxels of half the size."""
        return replace(self, voxels=8 * self.voxels, finest=self.finest / 2)


def convex_parts(
    surfaces: tuple[Surface, ...],
    settings: PartSettings | None = None,
    tight: Float[ndarray, "n 3"] | None = None,
) -> tuple[ConvexMesh, ...]:
    """Convex meshes whose union contains the surfaces of a link and the space that they enclose.

    Near `tight` places [n, 3], in the link's frame, the meshes stick out as little as possible.
    """
    settings = settings or PartSettings()
    soups = [surface.vertices[surface.faces] for surface in surfaces]
    grid = settings if tight is None else settings.finer()
    space = DistanceGrid.around(soups, grid.voxels, grid.finest)
    parts = [Part.of(soup, _spread(soup, space.pitch), space, settings) for soup in soups]
    parts = _cut(parts, space, settings, max(settings.most, 2 * len(parts)))
    if tight is not None:
        tight_only, space = space.near_tight(tight, settings.concavity)
        parts = [replace(part, concavity=tight_only.concavity(part.hull)) for part in parts]
        parts = _cut(parts, tight_only, settings, TIGHT_PART_FACTOR * settings.most)
    return tuple(_without_contained(_merged([part.hull for part in parts], space, settings)))


def _cut(parts: list["Part"], space: DistanceGrid, settings: PartSettings, most: int) -> list["Part"]:
    """Parts cut in two, the most concave first, until all are within `settings.concavity` or there are
    `most`."""
    parts = list(parts)
    while len(parts) < most:
        worst = max(range(len(parts)), key=lambda i: parts[i].concavity)
        if parts[worst].concavity <= settings.concavity:
            break
        parts[worst : worst + 1] = parts[worst].halves(space, settings)
    return parts


def simplified(hull: ConvexMesh, settings: PartSettings = PartSettings(), most: int = 120) -> ConvexMesh:
    """A convex mesh with fewer faces that contains a hull; the hull itself if it has at most
    `settings.faces`.

    It is bounded by up to `most` of the hull's planes. Planes are added where its corners stick out most.
    """
    settings = settings or PartSettings()
    if len(hull.faces) <= settings.faces:
        return hull
    normals = face_normals(hull)
    if len(normals) > MAX_NORMALS:  # merge similar normals
        _, first = np.unique(np.round(normals * 12).astype(int) @ [1, 100, 10_000], return_index=True)
        normals = normals[first]
    normals = np.concatenate([np.eye(3), -np.eye(3), normals[np.linalg.norm(normals, axis=1) > 0.5]])
    offsets = (hull.vertices @ normals.T).max(0) + SIMPLIFIED_GROWTH
    chosen = list(range(6))
    middle = hull.vertices.mean(0)
    try:
        while True:
            halfspaces = np.column_stack([normals[chosen], -offsets[chosen]])
            corners = HalfspaceIntersection(halfspaces, middle).intersections
            beyond = corners @ normals.T - offsets
            worst = beyond.max(1)
            if worst.max() <= settings.rounding or len(chosen) >= most:
                return convex_hull(corners)
            for corner in np.argsort(-worst)[: min(8, most - len(chosen))]:
                plane = int(beyond[corner].argmax())
                if worst[corner] > settings.rounding and plane not in chosen:
                    chosen.append(plane)
    except QhullError:  # almost flat
        return hull


@dataclass(frozen=True, eq=False)
class Part:
    triangles: Float[ndarray, "n 3 3"]
    points: Float[ndarray, "m 3"]
    """Points spread over the triangles, for choosing cuts."""
    hull: ConvexMesh
    concavity: float

    @staticmethod
    def of(triangles: ndarray, points: ndarray, space: DistanceGrid, settings: PartSettings) -> "Part":
        hull = simplified(convex_hull(triangles.reshape(-1, 3)), settings)
        if not len(points):  # the other side of a thin sheet has them
            points = _spread(triangles, space.pitch)
        return Part(triangles, points, hull, space.concavity(hull))

    def halves(self, space: DistanceGrid, settings: PartSettings) -> list["Part"]:
        """The two parts on the sides of the plane that gives hulls of least volume; the part itself if too
        small to cut."""
        low = self.hull.vertices.min(0)
        size = np.ptp(self.hull.vertices, axis=0)
        points, apart = _thinned(self.points, space.pitch)
        best = None
        least = np.inf
        for axis in sorted(np.flatnonzero(size > 6 * space.pitch), key=lambda axis: -size[axis]):
            for at in (*_wall_cuts(points[:, axis], space.pitch), *(low[axis] + CUT_FRACTIONS * size[axis])):
                height = points[:, axis] - at
                volume = 0.0
                for side in (points[height <= 0], points[height > 0]):
                    edge = side[np.abs(side[:, axis] - at) <= apart]
                    edge[:, axis] = at  # approximates the intersection of surface and plane
                    volume += hull_volume(np.concatenate([side, edge]))
                if volume < IMPROVEMENT * least:
                    best = (int(axis), float(at))
                    least = volume
        halves = _sides(self.triangles, *best) if best else ()
        if best is None or not all(map(len, halves)):
            return [replace(self, concavity=0.0)]
        low_points = self.points[:, best[0]] <= best[1]
        points = (self.points[low_points], self.points[~low_points])
        return [Part.of(side, near, space, settings) for side, near in zip(halves, points, strict=True)]


def _wall_cuts(heights: Float[ndarray, "n"], pitch: float) -> list[float]:
    """Cuts just before and after surfaces perpendicular to an axis, where parts often meet."""
    counts, edges = np.histogram(heights, max(int(np.ptp(heights) / pitch), 1))
    most = np.argsort(-counts)[:MAX_WALLS]
    middles = [
        float(np.median(heights[(heights >= edges[k]) & (heights <= edges[k + 1])]))
        for k in most
        if counts[k] > 2 * np.median(counts)
    ]
    return [middle + step for middle in middles for step in (-WALL_OFFSET, WALL_OFFSET)]


def _spread(triangles: Float[ndarray, "n 3 3"], pitch: float) -> Float[ndarray, "m 3"]:
    """Points spread over a surface, one per cube of edge `pitch` [m]."""
    return _one_per_cube(split(triangles, 2 * pitch).reshape(-1, 3), pitch)


def _thinned(points: Float[ndarray, "n 3"], size: float) -> tuple[Float[ndarray, "m 3"], float]:
    """At most `MAX_CUT_POINTS` points, one per cube, and the edge of the cubes [m]."""
    while len(points) > MAX_CUT_POINTS:
        size *= 1.3
        points = _one_per_cube(points, size)
    return points, size


def _one_per_cube(points: Float[ndarray, "n 3"], size: float) -> Float[ndarray, "m 3"]:
    cubes = np.floor((points - points.min(0)) / size).astype(np.int64)
    _, first = np.unique(np.ravel_multi_index(tuple(cubes.T), cubes.max(0) + 1), return_index=True)
    return points[first]


def _sides(
    triangles: Float[ndarray, "n 3 3"], axis: int, at: float
) -> tuple[Float[ndarray, "a 3 3"], Float[ndarray, "b 3 3"]]:
    """Triangles cut by an axis-aligned plane: those below and those above it."""
    height = triangles[:, :, axis] - at
    below = (height <= 0).all(1)
    above = (height >= 0).all(1)
    crossing = triangles[~below & ~above]
    height = height[~below & ~above]
    # rotate corners so that the one alone on its side comes first
    negative = height < 0
    alone = np.where(negative.sum(1) == 1, negative.argmax(1), (~negative).argmax(1))
    turn = (alone[:, None] + np.arange(3)) % 3
    rows = np.arange(len(crossing))[:, None]
    (a, b, c), (x, y, z) = np.moveaxis(crossing[rows, turn], 1, 0), height[rows, turn].T[:, :, None]
    ab = a + (b - a) * (x / (x - y))
    ac = a + (c - a) * (x / (x - z))
    single = np.stack([a, ab, ac], axis=1)
    double = np.concatenate([np.stack([ab, b, c], axis=1), np.stack([ab, c, ac], axis=1)])
    low = x[:, 0] < 0
    return (
        np.concatenate([triangles[below], single[low], double[np.tile(~low, 2)]]),
        np.concatenate([triangles[above & ~below], single[~low], double[np.tile(low, 2)]]),
    )


def _merged(hulls: list[ConvexMesh], space: DistanceGrid, settings: PartSettings) -> list[ConvexMesh]:
    """Hulls merged pairwise, least common concavity first, while it is within `settings.concavity`."""
    hulls = list(hulls)
    known: dict[tuple[int, int], tuple[float, ConvexMesh]] = {}
    while len(hulls) > 1:
        for i, a in enumerate(hulls):
            for b in hulls[i + 1 :]:
                if (id(a), id(b)) not in known:
                    both = convex_hull(np.concatenate([a.vertices, b.vertices]))
                    both = simplified(both, settings)
                    known[id(a), id(b)] = (space.concavity(both), both)
        pairs = [
            (known[id(a), id(b)][0], i, j) for i, a in enumerate(hulls) for j, b in enumerate(hulls) if i < j
        ]
        least, i, j = min(pairs)
        if least > settings.concavity:
            break
        both = known[id(hulls[i]), id(hulls[j])][1]
        hulls = [hull for k, hull in enumerate(hulls) if k not in (i, j)] + [both]
    return hulls


def _without_contained(hulls: list[ConvexMesh]) -> list[ConvexMesh]:
    """Hulls without those contained in another one."""
    kept = sorted(hulls, key=lambda hull: float(np.prod(np.ptp(hull.vertices, axis=0))))
    for hull in tuple(kept):
        others = [planes_of(other) for other in kept if other is not hull]
        if any((hull.vertices @ normals.T <= offsets).all() for normals, offsets in others):
            kept.remove(hull)
    return kept
