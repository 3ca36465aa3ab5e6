"""Shapes as rigid bodies: moved to elsewhere, and as convex meshes that a robot can hold."""

from dataclasses import replace
from functools import lru_cache
from typing import TypeVar

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.errors import InputError
from robotdiffuse.robots.bodies import ConvexMesh
from robotdiffuse.robots.convex_parts import Surface, convex_hull, convex_parts
from robotdiffuse.scenes.shapes import Box, Capsule, Cylinder, Mesh, PointCloud, Shape, Sphere, pose
from robotdiffuse.transforms import quaternion_from_rotation, rotation_from_quaternion, transform

SIDES = 32
"""Of the prism around a cylinder: 0.5 % wider than it."""
RINGS = 7
"""Of corners around a ball, and around the caps of a capsule."""

Any = TypeVar("Any", bound=Shape)


def moved(shape: Any, T: Float[ndarray, "4 4"]) -> Any:
    """The shape after a rigid motion. A cloud of points forgets the file that it was read from."""
    match shape:
        case Sphere():
            return replace(shape, center=T[:3, :3] @ shape.center + T[:3, 3])
        case Box() | Cylinder() | Capsule():
            at = T @ pose(shape)
            return replace(shape, center=at[:3, 3], wxyz=quaternion_from_rotation(at[:3, :3]))
        case Mesh():
            at = T @ placed(shape)
            return replace(shape, xyz=at[:3, 3], wxyz=quaternion_from_rotation(at[:3, :3]))
        case PointCloud():
            return replace(shape, points=shape.points @ T[:3, :3].T + T[:3, 3], file=None)
        case _:
            raise InputError(f"a {shape.kind} cannot be moved; write it as a mesh")


def placed(shape: Shape) -> Float[ndarray, "4 4"]:
    """Where a shape stands; InputError for a cloud of points, which has no frame of its own."""
    match shape:
        case Sphere():
            return transform(shape.center)
        case Box() | Cylinder() | Capsule():
            return pose(shape)
        case Mesh():
            return transform(shape.xyz, rotation_from_quaternion(shape.wxyz))
        case _:
            raise InputError(
                f"{shape.name!r} is a {shape.kind}; it must be one of sphere, box, cylinder, capsule and mesh"
            )


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
