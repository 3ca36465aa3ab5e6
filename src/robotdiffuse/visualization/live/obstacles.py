"""Adding, moving and resizing obstacles on the page."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.core.errors import InputError, distinct, unknown_name
from robotdiffuse.core.transforms import inverse, rotation_from_quaternion, transform
from robotdiffuse.scenes.mesh import Mesh
from robotdiffuse.scenes.shapes import Box, Capsule, Cylinder, Shape, Sphere

NEW_OBSTACLES: dict[str, Callable[[Float[ndarray, "3"], float], Shape]] = {
    "sphere": lambda center, size: Sphere(center, size),
    "box": lambda center, size: Box(center, (2 * size, 2 * size, 2 * size)),
    "cylinder": lambda center, size: Cylinder(center, 0.75 * size, 3 * size),
    "capsule": lambda center, size: Capsule(center, 0.75 * size, 2.5 * size),
}
"""Makers of new obstacles, by kind, from their centre and the radius of a sphere of similar size [m]."""
MIN_DIMENSION, MAX_DIMENSION = 0.01, 2.0
"""Bounds of a dimension [m]."""
AXES = ("x", "y", "z")
ORIENTED = (Box, Cylinder, Capsule, Mesh)
"""Shapes that can be rotated. Rotating a sphere has no effect, and point clouds store no pose."""


def new_obstacle(kind: str, center: Float[ndarray, "3"], size: float) -> Shape:
    """A new obstacle of a kind in NEW_OBSTACLES. Raises InputError for another kind."""
    if kind not in NEW_OBSTACLES:
        raise unknown_name("kind of obstacle", kind, NEW_OBSTACLES)
    return NEW_OBSTACLES[kind](center, size)


def handle_pose(shape: Shape) -> Float[ndarray, "4 4"]:
    """T_base_handle of the frame that a shape is dragged by: its own, or the middle of its bounds."""
    if isinstance(shape, Box | Cylinder | Capsule):
        return shape.T_base_shape
    if isinstance(shape, Sphere):
        return transform(shape.center)
    if isinstance(shape, Mesh):
        return transform(shape.xyz, rotation_from_quaternion(shape.wxyz))
    return transform(shape.bounds.mean(axis=0))


def moved_to(shape: Shape, T_base_handle: Float[ndarray, "4 4"]) -> Shape:
    """The shape with its handle at a pose; shapes without an orientation are not rotated."""
    if not isinstance(shape, ORIENTED):
        T_base_handle = transform(T_base_handle[:3, 3])
    return shape.moved(T_base_handle @ inverse(handle_pose(shape)))


def dimensions(shape: Shape) -> dict[str, float]:
    """The adjustable dimensions of a shape by name [m]; none for meshes and point clouds."""
    if isinstance(shape, Box):
        return {f"size {axis}": float(value) for axis, value in zip(AXES, shape.size, strict=True)}
    if isinstance(shape, Sphere):
        return {"radius": shape.radius}
    if isinstance(shape, Cylinder | Capsule):
        return {"radius": shape.radius, "height": shape.height}
    return {}


def resized(shape: Shape, dimension: str, value: float) -> Shape:
    """The shape with one of its `dimensions` changed. Raises InputError for another name and values out of
    bounds."""
    known = dimensions(shape)
    if dimension not in known:
        raise unknown_name(f"dimension of {shape.name}:", dimension, known)
    if not MIN_DIMENSION <= value <= MAX_DIMENSION:
        size, least, most = distinct(value, MIN_DIMENSION, MAX_DIMENSION)
        raise InputError(f"{dimension} of {shape.name} is {size} m; it must be {least} to {most} m")
    if isinstance(shape, Box):
        size = np.array([value if name == dimension else old for name, old in known.items()])
        return replace(shape, size=size)
    return replace(shape, **{dimension: value})  # type: ignore[type-var]
