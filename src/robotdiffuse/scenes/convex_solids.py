"""Shapes as convex meshes that a robot can hold."""

from functools import lru_cache

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.robots.bodies import ConvexMesh
from robotdiffuse.robots.fitting.convex_parts import Surface, convex_hull, convex_parts
from robotdiffuse.scenes.shape_transforms import placed
from robotdiffuse.scenes.shapes import Box, Capsule, Cylinder, Mesh, Shape, Sphere

SIDES = 32
"""Of the prism around a cylinder: 0.5 % wider than it."""
RINGS = 7
"""Of corners around a ball, and around the caps of a capsule."""


def solid(shape: Shape) -> tuple[Float[ndarray, "4 4"], tuple[ConvexMesh, ...]]:
    """Where a shape stands, and convex meshes in its own frame that hold it: exactly a box, else polyhedra
    around it. InputError for a cloud of points."""
    T = placed(shape)
    match shape:
        case Sphere():
            return T, (_rounded(shape.radius, 0.0),)
        case Capsule():
            return T, (_rounded(shape.radius, shape.height),)
        case Cylinder():
            return T, (_prism(shape.radius, shape.height),)
        case Box():
            corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
            return T, (convex_hull(corners * shape.size / 2),)
        case _:
            assert isinstance(shape, Mesh)
            return T, _parts(shape.vertices.tobytes(), shape.faces.tobytes())


@lru_cache(maxsize=64)
def _parts(vertices: bytes, faces: bytes) -> tuple[ConvexMesh, ...]:
    """Kept, for cutting a mesh that is not convex takes seconds."""
    points = np.frombuffer(vertices).reshape(-1, 3)
    return convex_parts((Surface(points, np.frombuffer(faces, np.int64).reshape(-1, 3)),))


def _circle(radius: float) -> Float[ndarray, "k 2"]:
    """Corners of a polygon around a circle."""
    angles = 2 * np.pi * np.arange(SIDES) / SIDES
    return radius / np.cos(np.pi / SIDES) * np.column_stack([np.cos(angles), np.sin(angles)])


def _prism(radius: float, height: float) -> ConvexMesh:
    ring = _circle(radius)
    ends = [np.column_stack([ring, np.full(SIDES, z)]) for z in (-height / 2, height / 2)]
    return convex_hull(np.concatenate(ends))


def _rounded(radius: float, height: float) -> ConvexMesh:
    """A polyhedron around a capsule, or around a ball if the height is 0."""
    angles = np.pi * np.arange(1, RINGS + 1) / (RINGS + 1) - np.pi / 2
    rings = [np.column_stack([_circle(np.cos(a)), np.full(SIDES, np.sin(a))]) for a in angles]
    corners = np.concatenate([*rings, [[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]]])
    hull = convex_hull(corners)
    # moved out until the ball is inside all planes
    a, b, c = np.moveaxis(hull.vertices[hull.faces], 1, 0)
    normals = np.cross(b - a, c - a)
    inner = (np.einsum("fd,fd->f", normals, a) / np.linalg.norm(normals, axis=1)).min()
    corners *= radius / inner
    if height == 0:
        return convex_hull(corners)
    half = np.array([0.0, 0.0, height / 2])
    return convex_hull(np.concatenate([corners - half, corners + half]))
