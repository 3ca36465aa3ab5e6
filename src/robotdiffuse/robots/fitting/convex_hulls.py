"""Convex hulls of points, and their planes."""

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.spatial import ConvexHull, QhullError

from robotdiffuse.robots.bodies import ConvexMesh

MIN_THICKNESS = 1e-3
"""Smallest thickness of a hull [m]: spheres and distances need a sheet to have a volume."""


def convex_hull(points: Float[ndarray, "n 3"]) -> ConvexMesh:
    """Convex hull with outward faces; a point set thinner than `MIN_THICKNESS` in a direction is thickened to
    it."""
    points = thickened(points)
    hull = ConvexHull(points)
    used, index = np.unique(hull.simplices, return_inverse=True)
    vertices = points[used]
    faces = index.reshape(hull.simplices.shape)
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    inwards = np.einsum("fd,fd->f", np.cross(b - a, c - a), hull.equations[:, :3]) < 0
    faces[inwards] = faces[inwards][:, ::-1]
    return ConvexMesh(vertices, faces)


def thickened(points: Float[ndarray, "n 3"]) -> Float[ndarray, "m 3"]:
    """The points, or copies shifted to both sides along the principal axes in which the set is too thin."""
    axes = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2]
    for axis in axes[np.ptp(points @ axes.T, axis=0) < MIN_THICKNESS]:
        points = np.concatenate([points - axis * MIN_THICKNESS / 2, points + axis * MIN_THICKNESS / 2])
    return points


def face_normals(mesh: ConvexMesh) -> Float[ndarray, "f 3"]:
    """Outward unit normals of the faces; zero for a face without area."""
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
    normals = np.cross(b - a, c - a)
    size = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.where(size > 1e-14, normals / np.maximum(size, 1e-14), 0.0)


def planes_of(mesh: ConvexMesh) -> tuple[Float[ndarray, "p 3"], Float[ndarray, "p"]]:
    """Normals and offsets of the distinct planes of a convex mesh."""
    normals = face_normals(mesh)
    normals = np.unique(np.round(normals[np.linalg.norm(normals, axis=1) > 0.5], 9), axis=0)
    # offsets from the farthest vertex, so that rounding does not put a plane inside the mesh
    return normals, (mesh.vertices @ normals.T).max(0)


def hull_volume(points: Float[ndarray, "n 3"]) -> float:
    try:
        return ConvexHull(points).volume
    except (QhullError, ValueError):  # flat, or fewer than four points
        return 0.0
