"""Shapes of MoveIt that scenes have no kind of their own for: cones and planes."""

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.core.errors import InputError, shown
from robotdiffuse.core.transforms import quaternion_from_rotation, rotation_z_to
from robotdiffuse.scenes.mesh import Mesh
from robotdiffuse.scenes.shapes import Box

CONE_SIDES = 32
"""Sides of the pyramid around a cone, which is 0.5 % wider than the cone."""
PLANE_EXTENT, PLANE_THICKNESS = 20.0, 0.01
"""Edge and thickness of the box below a plane [m]."""


def cone(size: Float[ndarray, "2"], xyz: Float[ndarray, "3"], wxyz: Float[ndarray, "4"], name: str) -> Mesh:
    """A pyramid around a cone of height and radius [m] about its z axis, with the tip at half the height."""
    height, radius = size
    if not (size > 0).all():
        raise InputError(f"dimensions of a cone are {shown(size)}; they must be positive")
    angles = 2 * np.pi * np.arange(CONE_SIDES) / CONE_SIDES
    ring = radius / np.cos(np.pi / CONE_SIDES) * np.column_stack([np.cos(angles), np.sin(angles)])
    bottom = np.column_stack([ring, np.full(CONE_SIDES, -height / 2)])
    vertices = np.concatenate([bottom, [[0, 0, -height / 2], [0, 0, height / 2]]])
    one, following = np.arange(CONE_SIDES), np.roll(np.arange(CONE_SIDES), -1)
    base = np.column_stack([following, one, np.full(CONE_SIDES, CONE_SIDES)])
    side = np.column_stack([one, following, np.full(CONE_SIDES, CONE_SIDES + 1)])
    return Mesh(vertices, np.concatenate([base, side]), xyz, wxyz, name=name)


def plane(coefficients: Float[ndarray, "4"], name: str) -> Box:
    """A large, thin box below the plane a x + b y + c z + d = 0; (a, b, c) points away from it.

    Raises InputError if a, b and c are all zero.
    """
    normal = coefficients[:3]
    length = np.linalg.norm(normal)
    if length < 1e-9:
        raise InputError(f"coef of a plane is {shown(coefficients)}; a, b and c must not all be zero")
    normal = normal / length
    center = -normal * (coefficients[3] / length + PLANE_THICKNESS / 2)
    wxyz = quaternion_from_rotation(rotation_z_to(normal))
    return Box(center, [PLANE_EXTENT, PLANE_EXTENT, PLANE_THICKNESS], wxyz, name)
