"""Covering spheres of point clouds and meshes, and the grid over these spheres, which
`kernels/point_grid.py` queries."""

import numpy as np
from numpy import ndarray

from robotdiffuse.collision.kernels.point_grid import POINT_RANGE, make_grid
from robotdiffuse.collision.kernels.simd import by_sixteen
from robotdiffuse.core.transforms import scaled_normals
from robotdiffuse.core.types import NO_SPHERES, Points, Spheres
from robotdiffuse.robots.fitting.triangles import Triangles, split
from robotdiffuse.scenes.point_cloud import grouped

MESH_SPACING = 0.02
"""Triangles of mesh obstacles are divided until no edge is longer than this [m]; each piece is covered by one
sphere."""
THINNING = 0.5
"""Edge of the thinning voxels of a point cloud, as a multiple of its point radius."""
MAX_POINTS = 400_000
"""Approximate largest number of spheres of a mesh obstacle; larger meshes are divided more coarsely, or their
pieces merged."""
MAX_SOLIDS = 1000
"""Largest number of spheres of a surface that some link is allowed to touch. These spheres are not in the
grid but checked one by one; `join_to_few` merges them until few enough are left."""
JOIN_VOXEL = 0.004
"""Edge of the voxels by which `join_to_few` first merges spheres [m]; it grows from round to round."""
EXACT_RANGE = 0.1
"""Clearances to points are exact up to this [m], and lower bounds beyond."""
VOXELS_PER_RANGE = 10
"""The grid stores nearby points up to a distance of this many voxels, or fewer if MAX_VOXELS requires larger
voxels."""
MAX_VOXELS = 1e6
"""Approximate largest number of voxels of a grid: 4 MB, which fits a processor's cache."""


def thin_points(points: Points, radius: float, reach: float) -> Spheres:
    """One sphere per occupied voxel, large enough to contain the spheres of all the voxel's points [m].

    Points whose spheres are more than POINT_RANGE beyond `reach` [m] are left out.
    """
    with np.errstate(over="ignore"):
        points = points[np.einsum("ij,ij->i", points, points) <= (reach + POINT_RANGE + radius) ** 2]
    return _join(np.column_stack([points, np.full(len(points), radius)]), THINNING * radius)


def _join(spheres: Spheres, voxel: float) -> Spheres:
    """One sphere per occupied voxel: it contains all spheres with centers in the voxel."""
    if not len(spheres):
        return NO_SPHERES
    offsets = spheres[:, :3] - spheres[:, :3].min(axis=0)
    # the number of a voxel and the index of a sphere fit into 62 bits, see `grouped`
    axis_bits = (62 - len(spheres).bit_length()) // 3
    xyz = (offsets * (1 / max(voxel, float(offsets.max()) / (2**axis_bits - 1)))).astype(np.int64)
    order, starts = grouped((xyz[:, 0] << (2 * axis_bits)) | (xyz[:, 1] << axis_bits) | xyz[:, 2])
    if len(starts) == len(spheres):
        return spheres
    spheres = spheres[order]
    counts = np.diff(starts, append=len(spheres))
    centers = np.add.reduceat(spheres[:, :3], starts) / counts[:, None]
    offsets_from_center = spheres[:, :3] - np.repeat(centers, counts, axis=0)
    radii = np.maximum.reduceat(
        np.sqrt(np.einsum("ij,ij->i", offsets_from_center, offsets_from_center)) + spheres[:, 3], starts
    )
    return np.column_stack([centers, radii])


def join_to_few(spheres: Spheres) -> Spheres:
    """At most MAX_SOLIDS spheres that together contain all given spheres."""
    voxel = JOIN_VOXEL
    while len(spheres) > MAX_SOLIDS:
        spheres = _join(spheres, voxel)
        voxel *= 1.5
    return spheres


def cover_triangles(triangles: Triangles, reach: float) -> Spheres:
    """Spheres that cover the surface up to POINT_RANGE beyond the arm's `reach` [m]: one around each piece of
    the triangles, merged if they are more than MAX_POINTS."""
    within = reach + float(POINT_RANGE)
    near = split(triangles, reach / 4, within)
    area = np.linalg.norm(scaled_normals(near), axis=1).sum() / 2
    # bisected triangles have an area of about spacing² / 4
    spacing = max(MESH_SPACING, float(np.sqrt(4 * area / MAX_POINTS)))
    triangle_parts = split(near, spacing, within)
    centers = triangle_parts.mean(axis=1)
    radii = np.linalg.norm(triangle_parts - centers[:, None], axis=2).max(axis=1, initial=0.0)
    spheres = np.column_stack([centers, radii + 1e-4])
    return _join(spheres, spacing) if len(spheres) > MAX_POINTS else spheres


def build_grid(cloud: Spheres, radius: float) -> tuple[ndarray, ...]:
    """The grid over the covering spheres `cloud` of obstacles: the fields of SceneArrays from `points` to
    `grid_frame`. `radius` is that of the robot's largest sphere [m]."""
    if not len(cloud):
        return (
            NO_SPHERES.astype(np.float32),
            by_sixteen(NO_SPHERES, NO_SPHERES),
            np.zeros(2, np.int32),
            np.zeros(0, np.float32),
            np.zeros(0, np.int32),
            np.ones(14, np.float32),
        )
    # the grid's box and voxels; a cell has 2 x 2 x 2 voxels
    cloud = cloud.astype(np.float32)
    radii = cloud[:, 3]
    exact_distance = EXACT_RANGE + radius + float(radii.max())
    low = cloud[:, :3].min(axis=0) - np.float32(exact_distance)
    extent = (cloud[:, :3].max(axis=0) - low).astype(np.float64) + exact_distance
    voxel = np.float32(max(exact_distance / VOXELS_PER_RANGE, (extent.prod() / MAX_VOXELS) ** (1 / 3)))
    shape = np.ceil(extent / voxel).astype(np.int32) + 1
    cells = (shape + 1) // 2
    # points sorted by cell, then by voxel within the cell
    index = ((cloud[:, :3] - low) / voxel).astype(np.int64)
    cell = np.ravel_multi_index((index // 2).T, cells.tolist())
    order = np.argsort(cell * 8 + (index % 2) @ np.array([4, 2, 1]))
    points = np.ascontiguousarray(cloud[order])
    index = index[order]
    cell = cell[order]
    first = np.asarray(np.searchsorted(cell, np.arange(int(np.prod(cells)) + 1)), np.int32)
    # up to `band` [m], stored distances are exact: enough to decide whether the largest sphere touches a
    # point; beyond it they are lower bounds, and queries compute exact distances up to `exact_distance`
    band = np.float32(max(radius + float(radii.max()) + 1e-3, 2 * float(voxel)))
    # runs of points in the same voxel
    voxels = np.ravel_multi_index(index.T, shape.tolist())
    starts = np.flatnonzero(np.diff(voxels, prepend=-1))
    run = np.full(int(np.prod(shape)), -1, np.int32)
    run[voxels[starts]] = np.arange(len(starts))
    run_starts = np.append(starts, len(points)).astype(np.int32)
    sizes = tuple(shape.tolist())
    grid, nearest = make_grid(points, run_starts, run, low, voxel, sizes, band, np.float32(exact_distance))
    frame = [*low, voxel, 2 * voxel, radii.max(), radii.min(), band, *shape, *cells]
    return points, by_sixteen(points, points[-1:]), first, grid, nearest, np.array(frame, np.float32)
