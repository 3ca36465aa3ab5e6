"""Point clouds and meshes as covering spheres in a grid: what `point_grid.py` looks things up in."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float32, Int32
from numpy import ndarray

from robotdiffuse.collision.kernels.point_grid import KEEP, splat

MESH_SPACING = 0.02
"""Triangles of mesh obstacles are divided until no edge is longer [m]; each piece becomes a point."""
THINNING = 0.5
"""Edge of the thinning voxels of a point cloud, as a multiple of its point radius."""
MAX_POINTS = 400_000
"""Mesh obstacles are divided more coarsely, or their pieces joined, rather than into more points."""
EXACT = 0.1
"""Clearances to points are exact up to this [m], and lower bounds beyond."""
BAND_VOXELS = 10
MAX_VOXELS = 2e6
"""A grid of 8 MB still fits a processor's cache."""
EMPTY = np.zeros((0, 4))


class PointGrid(NamedTuple):
    """Fields of SceneArrays."""

    points: Float32[ndarray, "n 4"]
    cell_first: Int32[ndarray, "cells"]
    grid: Float32[ndarray, "voxels"]
    nearest: Int32[ndarray, "voxels"]
    grid_frame: Float32[ndarray, "14"]


def thin(points: Float[ndarray, "n 3"], radius: float, reach: float) -> Float[ndarray, "m 4"]:
    """One sphere per occupied voxel, large enough to hold the spheres of all points of the voxel [m].

    Points farther than `reach` and what is kept beyond it are left out.
    """
    with np.errstate(over="ignore"):
        points = points[np.linalg.norm(points, axis=1) <= reach + KEEP + radius]
    return _join(np.column_stack([points, np.full(len(points), radius)]), THINNING * radius)


def _join(spheres: Float[ndarray, "n 4"], voxel: float) -> Float[ndarray, "m 4"]:
    """One sphere around all spheres with centres in a voxel."""
    if not len(spheres):
        return EMPTY
    offsets = spheres[:, :3] - spheres[:, :3].min(axis=0)
    # 2^20 voxels along each axis at most, so that three indices fit an integer
    keys = (offsets / max(voxel, float(offsets.max()) / 2**20)).astype(np.int64)
    packed = (keys[:, 0] << 42) | (keys[:, 1] << 21) | keys[:, 2]
    _, which, counts = np.unique(packed, return_inverse=True, return_counts=True)
    if len(counts) == len(spheres):
        return spheres
    centres = np.stack([np.bincount(which, spheres[:, i]) / counts for i in range(3)], axis=1)
    radii = np.zeros(len(centres))
    np.maximum.at(radii, which, np.linalg.norm(spheres[:, :3] - centres[which], axis=1) + spheres[:, 3])
    return np.column_stack([centres, radii])


def cover(triangles: Float[ndarray, "n 3 3"], reach: float) -> Float[ndarray, "m 4"]:
    """Spheres around pieces of the triangles that together hold the surface within `reach` [m]."""
    near = _divide(triangles, reach / 4 if np.isfinite(reach) else np.inf, reach)
    # bisection ends with pieces of about a quarter of the squared spacing
    spacing = max(MESH_SPACING, float(np.sqrt(4 * _area(near) / MAX_POINTS)))
    pieces = _divide(near, spacing, reach)
    centres = pieces.mean(axis=1)
    radii = np.linalg.norm(pieces - centres[:, None], axis=2).max(axis=1, initial=0.0)
    spheres = np.column_stack([centres, radii + 1e-4])
    return _join(spheres, spacing) if len(spheres) > MAX_POINTS else spheres


def _divide(triangles: Float[ndarray, "n 3 3"], spacing: float, reach: float) -> Float[ndarray, "m 3 3"]:
    """Pieces of the triangles near the robot with no edge longer than `spacing`: longest edges are halved."""
    done = [np.zeros((0, 3, 3))]
    while len(triangles):
        edges = np.linalg.norm(triangles - np.roll(triangles, 1, axis=1), axis=2)
        near = np.linalg.norm(triangles.mean(axis=1), axis=1) <= reach + KEEP + edges.max(axis=1)
        triangles, edges = triangles[near], edges[near]
        small = edges.max(axis=1) <= spacing
        done.append(triangles[small])
        triangles, edges = triangles[~small], edges[~small]
        # edge i joins corners i - 1 and i; split the longest one
        longest = edges.argmax(axis=1)
        rows = np.arange(len(triangles))
        a, b = triangles[rows, longest - 1], triangles[rows, longest]
        c = triangles[rows, (longest + 1) % 3]
        middle = (a + b) / 2
        triangles = np.concatenate([np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)])
    return np.concatenate(done)


def _area(triangles: Float[ndarray, "n 3 3"]) -> float:
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    return float(np.linalg.norm(normals, axis=1).sum() / 2)


def build_grid(cloud: Float[ndarray, "n 4"], radius: float) -> PointGrid:
    """The grid over covering spheres for a robot with spheres of up to this radius [m]."""
    if not len(cloud):
        return PointGrid(
            EMPTY.astype(np.float32),
            np.zeros(2, np.int32),
            np.zeros(0, np.float32),
            np.zeros(0, np.int32),
            np.ones(14, np.float32),
        )
    cloud = cloud.astype(np.float32)
    band = EXACT + radius + float(cloud[:, 3].max())
    low = cloud[:, :3].min(axis=0) - np.float32(band)
    extent = (cloud[:, :3].max(axis=0) - low).astype(np.float64) + band
    voxel = np.float32(max(band / BAND_VOXELS, (extent.prod() / MAX_VOXELS) ** (1 / 3)))
    band = max(band, 2 * float(voxel))
    shape = np.ceil(extent / voxel).astype(np.int32) + 1
    cells = (shape + 1) // 2
    index = ((cloud[:, :3] - low) / (2 * voxel)).astype(np.int64)
    where = (index[:, 0] * cells[1] + index[:, 1]) * cells[2] + index[:, 2]
    order = np.argsort(where, kind="stable")
    points = np.ascontiguousarray(cloud[order])
    first = np.asarray(np.searchsorted(where[order], np.arange(int(np.prod(cells)) + 1)), np.int32)
    squares, nearest = splat(points, low, voxel, tuple(shape.tolist()), np.float32(band))
    from scipy.ndimage import distance_transform_edt  # which takes long to import, and only clouds need

    # Beyond the band: the way to the nearest voxel that is within it, less what voxels blur, and the band.
    steps = np.asarray(distance_transform_edt((nearest < 0).reshape(shape))).ravel()
    beyond = np.maximum(band, (steps - np.sqrt(3)) * voxel + band)
    grid = np.where(nearest >= 0, np.sqrt(squares), beyond).astype(np.float32)
    radii = cloud[:, 3]
    frame = [*low, voxel, 2 * voxel, radii.max(), radii.min(), band, *shape, *cells]
    return PointGrid(points, first, grid, nearest, np.array(frame, np.float32))
