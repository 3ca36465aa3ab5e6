"""Numbers and transforms of URDF elements. Errors begin with the path of the file."""

import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.core.bounds import MAX_COORDINATE, unit_quaternion, within
from robotdiffuse.core.errors import InputError, shown
from robotdiffuse.core.transforms import rotation_from_quaternion, rotation_from_rpy, transform


def numbers_of(
    path: Path, text: str, count: int, what: str, most: float = MAX_COORDINATE
) -> Float[ndarray, "n"]:
    """The numbers of an attribute, whose absolute values are at most `most`."""
    try:
        values = np.array([float(word) for word in text.split()])
    except ValueError:
        values = np.zeros(0)
    if len(values) != count or not np.isfinite(values).all():
        raise InputError(f"{path}: {what} is {shown(text)}; it must be {count} finite number(s)")
    if not within(values, most):
        raise InputError(f"{path}: {what} is {shown(text)}; it must be within ±{most:g}")
    return values


def origin_of(path: Path, element: ET.Element, what: str) -> Float[ndarray, "4 4"]:
    """The transform of the element's <origin>."""
    origin = element.find("origin")
    if origin is None:
        return np.eye(4)
    xyz = numbers_of(path, origin.get("xyz", "0 0 0"), 3, f"{what}: origin xyz")
    turned = origin.get("quat_xyzw")
    if turned is None:
        rpy = numbers_of(path, origin.get("rpy", "0 0 0"), 3, f"{what}: origin rpy")
        return transform(xyz, rotation_from_rpy(*map(float, rpy)))
    if "rpy" in origin.attrib:
        raise InputError(f"{path}: {what}: origin has rpy and quat_xyzw; it must have one of them")
    where = f"{what}: origin quat_xyzw"
    x, y, z, w = unit_quaternion(f"{path}: {what}", numbers_of(path, turned, 4, where), "origin quat_xyzw")
    return transform(xyz, rotation_from_quaternion(np.array([w, x, y, z])))
