"""Values in MoveIt files: lists, mappings, vectors, poses and joint states, checked as they are read.

Vectors may be lists or mappings (x, y, z), and quaternions are xyzw.
"""

from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.core.bounds import unit_quaternion, vector
from robotdiffuse.core.errors import InputError, shown
from robotdiffuse.core.transforms import rotation_from_quaternion, transform


def mapping_of(where: str, value: object) -> dict[str, Any]:
    """The mapping; None counts as empty, as in the messages."""
    if value is not None and not isinstance(value, dict):
        raise InputError(f"{where} is {shown(value)}; it must be a mapping")
    return value or {}


def list_of(where: str, value: object) -> list[Any]:
    """The list; None counts as empty."""
    if value is not None and not isinstance(value, list):
        raise InputError(f"{where} is {shown(value)}; it must be a list")
    return value or []


def xyz_of(where: str, value: object) -> Float[ndarray, "3"]:
    """A position, a list or a mapping (x, y, z)."""
    value = [value.get(axis) for axis in "xyz"] if isinstance(value, dict) else value
    return vector(where, "xyz", value, 3)


def pose_of(
    where: str, value: object, position: str = "position", orientation: str = "orientation"
) -> Float[ndarray, "4 4"]:
    """The transform of a geometry_msgs/Pose, or of a Transform with other names of its two fields."""
    value = mapping_of(where, value)
    turn = value.get(orientation)
    xyzw = [turn.get(axis) for axis in "xyzw"] if isinstance(turn, dict) else turn
    x, y, z, w = unit_quaternion(where, xyzw, orientation)
    rotation = rotation_from_quaternion(np.array([w, x, y, z]))
    return transform(xyz_of(f"{where}.{position}", value.get(position)), rotation)


def joint_state(where: str, value: object) -> dict[str, float]:
    """Joint values by name."""
    state = mapping_of(where, value)
    names = list_of(f"{where}.name", state.get("name"))
    positions = vector(where, "position", list_of(f"{where}.position", state.get("position")), len(names))
    return dict(zip(map(str, names), positions.tolist(), strict=True))
