"""Convex meshes that enclose shapes, used when a robot holds a shape."""

from collections.abc import Callable
from functools import lru_cache
from itertools import product
from typing import Any

import numpy as np

from robotdiffuse.core.transforms import scaled_normals
from robotdiffuse.robots.bodies import ConvexMesh, polygon_around_circle
from robotdiffuse.robots.fitting.convex_parts import Surface, convex_hull, convex_parts

SPHERE_RINGS = 7
"""Number of rings of vertices on a sphere. A capsule has one more, since both caps have the equator."""


def capsule_polyhedron(radius: float, height: float) -> ConvexMesh:
    """A polyhedron around a capsule along the z axis [m]; with a height of 0, around a sphere."""
    angles = np.pi * np.arange(1, SPHERE_RINGS + 1) / (SPHERE_RINGS + 1) - np.pi / 2
    rings = [np.insert(polygon_around_circle(np.cos(a)), 2, np.sin(a), axis=1) for a in angles]
    corners = np.concatenate([*rings, [[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]]])
    hull = convex_hull(corners)
    # scale the polyhedron up until the sphere is inside all faces
    normals = scaled_normals(hull.triangles)
    inradius = (np.einsum("fd,fd->f", normals, hull.triangles[:, 0]) / np.linalg.norm(normals, axis=1)).min()
    corners *= radius / inradius
    if height == 0:
        return convex_hull(corners)
    half = np.array([0.0, 0.0, height / 2])
    return convex_hull(np.concatenate([corners - half, corners + half]))


@lru_cache(maxsize=64)
def mesh_parts(vertices: bytes, faces: bytes) -> tuple[ConvexMesh, ...]:
    """Convex parts that cover a triangle mesh. Its float64 vertices and int64 faces are given as bytes.

    The result is cached, because decomposing a mesh that is not convex takes seconds.
    """
    points = np.frombuffer(vertices).reshape(-1, 3)
    return convex_parts((Surface(points, np.frombuffer(faces, np.int64).reshape(-1, 3)),))


def _prism(shape: Any) -> ConvexMesh:
    """A prism around a cylinder."""
    ring = polygon_around_circle(shape.radius)
    ends = [np.insert(ring, 2, z * shape.height, axis=1) for z in (-0.5, 0.5)]
    return convex_hull(np.concatenate(ends))


SOLIDS: dict[str, Callable[[Any], tuple[ConvexMesh, ...]]] = {
    "sphere": lambda shape: (capsule_polyhedron(shape.radius, 0.0),),
    "box": lambda shape: (convex_hull(np.array([*product((-1, 1), repeat=3)]) * shape.size / 2),),
    "cylinder": lambda shape: (_prism(shape),),
    "capsule": lambda shape: (capsule_polyhedron(shape.radius, shape.height),),
    "mesh": lambda shape: mesh_parts(shape.vertices.tobytes(), shape.faces.tobytes()),
}
"""Functions by kind of shape. Each returns convex meshes that enclose the shape, in the shape's frame."""
