"""Numbers at the door: arrays of what anybody gave, within bounds that all code behind can work with."""

import numpy as np
from numpy import ndarray

from robotdiffuse.core.errors import InputError, shown

MAX_COORDINATE = 1e4
"""Of all coordinates, sizes and joint values, either way [m] or [rad]: ten kilometres. float32 keeps a
millimetre there, which compiled code makes up for."""
MIN_SIZE = 1e-9
"""Of all sizes [m]: what is smaller is nothing in float32."""
MAX_RATE = 1e6
"""Of all rates, in their units."""
RIGID_SLACK = 1e-4
"""How far the rotation of a pose may be from orthonormal and its last row from 0 0 0 1, by entry."""
LAST_ROW = (0.0, 0.0, 0.0, 1.0)


def numbers(value: object) -> ndarray | None:
    """A float64 array, or None where the value is anything but (nested lists of) numbers."""
    try:
        array = np.asarray(value)
    except (TypeError, ValueError, OverflowError, RecursionError):
        return None
    return array.astype(np.float64) if array.dtype.kind in "iuf" else None


def within(array: ndarray, most: float = MAX_COORDINATE) -> bool:
    """Whether all numbers are finite and at most so large either way."""
    return bool((np.abs(array) <= most).all())


def vector(owner: str, name: str, value: object, size: int, most: float = MAX_COORDINATE) -> ndarray:
    """`size` numbers within ±most, or an InputError that names owner.name."""
    array = numbers(value)
    if array is None or array.shape != (size,) or not np.isfinite(array).all():
        raise InputError(f"{owner}.{name} is {shown(value)}; it must be {size} finite numbers")
    if not within(array, most):
        raise InputError(f"{owner}.{name} is {shown(value)}; its numbers must be within ±{most:g}")
    return array


def points(owner: str, name: str, value: object) -> ndarray:
    """n x 3 coordinates within ±MAX_COORDINATE [m], or an InputError that names the first wrong row."""
    array = numbers(value)
    if array is not None and array.size == 0:
        array = array.reshape(0, 3)
    if array is None or array.ndim != 2 or array.shape[1] != 3:
        raise InputError(f"{owner}.{name} is {form(array)}; it must be n x 3 finite numbers")
    bad = np.flatnonzero(~(np.abs(array) <= MAX_COORDINATE).all(axis=1))
    if len(bad):
        row, more = array[bad[0]], "" if len(bad) == 1 else f" and {len(bad) - 1} more"
        rule = f"finite numbers within ±{MAX_COORDINATE:g} m"
        raise InputError(f"{owner}.{name}[{bad[0]}]{more} is {shown(row)}; it must be {rule}")
    return array


def positive(owner: str, name: str, value: object, most: float = MAX_COORDINATE) -> float:
    """A number from MIN_SIZE to `most`, or an InputError that names owner.name."""
    array = numbers(value)
    if array is None or array.ndim != 0 or not np.isfinite(array) or array <= 0:
        raise InputError(f"{owner}.{name} is {shown(value)}; it must be a positive number")
    if not MIN_SIZE <= array <= most:
        raise InputError(
            f"{owner}.{name} is {shown(value)}; it must be a number from {MIN_SIZE:g} to {most:g}"
        )
    return float(array)


def unit_quaternion(owner: str, value: object, name: str = "wxyz") -> ndarray:
    """The quaternion scaled to length 1; one that has it already is kept bit for bit."""
    wxyz = vector(owner, name, value, 4)
    norm = np.linalg.norm(wxyz)
    if norm < 1e-6:
        raise InputError(f"{owner}.{name} is {shown(value)}; a quaternion must not be zero")
    return wxyz if abs(norm - 1) < 1e-15 else wxyz / norm


def rigid_transform(what: str, value: object) -> ndarray:
    """A pose as a 4 x 4 array, or an InputError that names `what`."""
    T = numbers(value)
    if T is None or T.shape != (4, 4) or not within(T):
        raise InputError(
            f"{what} is {shown(value)}; it must be 4 x 4 finite numbers within ±{MAX_COORDINATE:g}"
        )
    rotation = T[:3, :3]
    off = max(np.abs(rotation @ rotation.T - np.eye(3)).max(), np.abs(T[3] - LAST_ROW).max())
    if off > RIGID_SLACK or np.linalg.det(rotation) < 0:
        raise InputError(f"{what} is {shown(T)}; it must be a rotation and a translation over a row 0 0 0 1")
    T[3] = LAST_ROW
    return T


def form(array: ndarray | None) -> str:
    """What an array is, for messages."""
    return "not numbers" if array is None else f"an array of {' x '.join(map(str, array.shape))}"
