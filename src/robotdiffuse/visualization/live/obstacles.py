"""Obstacles as hands change them: new ones, moved ones, resized ones."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.core.errors import InputError, unknown_name
from robotdiffuse.core.transforms import inverse, rotation_from_quaternion, transform
from robotdiffuse.scenes.shapes import Box, Capsule, Cylinder, Mesh, Shape, Sphere

NEW: dict[str, Callable[[Float[ndarray, "3"], float], Shape]] = {
    "sphere": lambda center, size: Sphere(center, size),
    "box": lambda center, size: Box(center, (2 * size, 2 * size, 2 * size)),
    "cylinder": lambda center, size: Cylinder(center, 0.75 * size, 3 * size),
    "capsule": lambda center, size: Capsule(center, 0.75 * size, 2.5 * size),
}
"""Obstacles that can be added, as they are at first, by where they stand and by a ball's radius [m]."""
LEAST, MOST = 0.01, 2.0
"""Of a dimension [m]."""
AXES = ("x", "y", "z")
ORIENTED = (Box, Cylinder, Capsule, Mesh)
"""Others are turned by nothing: balls, and points, which a pose of their own would have to be kept for."""


def new_obstacle(kind: str, center: Float[ndarray, "3"], size: float) -> Shape:
    """An obstacle of a kind in NEW; InputError for another kind."""
    if kind not in NEW:
        raise unknown_name("kind of obstacle", kind, NEW)
    return NEW[kind](center, size)


def handle_pose(shape: Shape) -> Float[ndarray, "4 4"]:
    """T_base_handle of what a shape is held by: its own frame, or the middle of its bounds."""
    if isinstance(shape, Box | Cylinder | Capsule):
        return shape.T_base_shape
    if isinstance(shape, Sphere):
        return transform(shape.center)
    if isinstance(shape, Mesh):
        return transform(shape.xyz, rotation_from_quaternion(shape.wxyz))
    return transform(shape.bounds.mean(axis=0))


def held_at(shape: Shape, T_base_handle: Float[ndarray, "4 4"]) -> Shape:
    """The shape with its handle at a pose; those without an orientation of their own are not turned."""
    if not isinstance(shape, ORIENTED):
        T_base_handle = transform(T_base_handle[:3, 3])
    return shape.moved(T_base_handle @ inverse(handle_pose(shape)))


def dimensions(shape: Shape) -> dict[str, float]:
    """What can be changed about its size, by name [m]; nothing of meshes and point clouds."""
    if isinstance(shape, Box):
        return {f"size {axis}": float(value) for axis, value in zip(AXES, shape.size, strict=True)}
    if isinstance(shape, Sphere):
        return {"radius": shape.radius}
    if isinstance(shape, Cylinder | Capsule):
        return {"radius": shape.radius, "height": shape.height}
    return {}


def resized(shape: Shape, dimension: str, value: float) -> Shape:
    """The shape with one of its `dimensions` changed; InputError for another name, and beyond bounds."""
    known = dimensions(shape)
    if dimension not in known:
        raise unknown_name(f"dimension of {shape.name}:", dimension, known)
    if not LEAST <= value <= MOST:
        raise InputError(f"{dimension} of {shape.name} is {value:g} m; it must be {LEAST:g} to {MOST:g} m")
    if isinstance(shape, Box):
        size = np.array([value if name == dimension else old for name, old in known.items()])
        return replace(shape, size=size)
    return replace(shape, **{dimension: value})  # type: ignore[type-var]
