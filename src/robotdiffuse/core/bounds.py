"""Numbers at the door: arrays of what anybody gave, within bounds that all code behind can work with, and
kept where nobody can write to them."""

from dataclasses import fields
from typing import Any, TypeVar

import numpy as np
from numpy import ndarray

from robotdiffuse.core.errors import InputError, shown

LARGEST = 1e4
"""Of all coordinates, sizes and joint values, either way [m] or [rad]: ten kilometres. float32 keeps a
millimetre there, which compiled code makes up for."""
SMALLEST = 1e-9
"""Of all sizes [m]: what is smaller is nothing in float32."""
FASTEST = 1e6
"""Of all rates, in their units."""
RIGID_SLACK = 1e-4
"""How far the rotation of a pose may be from orthonormal and its last row from 0 0 0 1, by entry."""
LAST_ROW = (0.0, 0.0, 0.0, 1.0)

T = TypeVar("T")


class Value:
    """Base of the dataclasses that are values: the arrays in their fields are read-only.

    What is prepared for a value, and verdicts on it, are kept by its identity. An array that can be written
    to is copied, so that whoever gave it keeps it as it was. Subclasses with a `__post_init__` of their own
    call this one at its end.
    """

    def __post_init__(self) -> None:
        for name in (field.name for field in fields(self)):  # type: ignore[arg-type]
            given = getattr(self, name)
            kept = read_only(given)
            if kept is not given:
                object.__setattr__(self, name, kept)

    def __setstate__(self, state: dict[str, Any]) -> None:
        # arrays can be written to when they come out of a pickle or a deep copy
        self.__dict__.update({name: read_only(value) for name, value in state.items()})


def read_only(value: T) -> T:
    """An array, or what tuples and dictionaries hold of arrays, without anyone who can write to it: itself if
    that is so, else a copy. Anything else is returned as it is."""
    if isinstance(value, ndarray):
        if not _writable(value):
            return value
        kept = np.array(value)
        kept.setflags(write=False)
        return kept  # type: ignore[return-value]
    if isinstance(value, tuple):
        kept = [read_only(one) for one in value]
        if all(a is b for a, b in zip(kept, value, strict=True)):
            return value
        return value._make(kept) if hasattr(value, "_make") else tuple(kept)  # type: ignore
    if isinstance(value, dict):
        kept = {key: read_only(one) for key, one in value.items()}
        return value if all(kept[key] is value[key] for key in value) else kept  # type: ignore[return-value]
    return value


def for_kernels(array: ndarray, dtype: type = np.float64) -> ndarray:
    """The array as compiled code takes it, contiguous and not read-only: to Numba a read-only one is of
    another type, for which it would compile everything once more."""
    array = np.ascontiguousarray(array, dtype)
    return array if array.flags.writeable else array.copy()


def _writable(array: ndarray) -> bool:
    """Whether anyone can write to it, by the array that it is a view of too."""
    owner: Any = array
    while isinstance(owner, ndarray):
        if owner.flags.writeable:
            return True
        owner = owner.base
    return owner is not None and not isinstance(owner, bytes)


def numbers(value: object) -> ndarray | None:
    """A float64 array, or None where the value is anything but (nested lists of) numbers."""
    try:
        array = np.asarray(value)
    except (TypeError, ValueError, OverflowError, RecursionError):
        return None
    return array.astype(np.float64) if array.dtype.kind in "iuf" else None


def within(array: ndarray, most: float = LARGEST) -> bool:
    """Whether all numbers are finite and at most so large either way."""
    return bool((np.abs(array) <= most).all())


def vector(owner: str, name: str, value: object, size: int, most: float = LARGEST) -> ndarray:
    """`size` numbers within ±most, or an InputError that names owner.name."""
    array = numbers(value)
    if array is None or array.shape != (size,) or not np.isfinite(array).all():
        raise InputError(f"{owner}.{name} is {shown(value)}; it must be {size} finite numbers")
    if not within(array, most):
        raise InputError(f"{owner}.{name} is {shown(value)}; its numbers must be within ±{most:g}")
    return array


def points(owner: str, name: str, value: object) -> ndarray:
    """n x 3 coordinates within ±LARGEST [m], or an InputError that names the first wrong row."""
    array = numbers(value)
    if array is not None and array.size == 0:
        array = array.reshape(0, 3)
    if array is None or array.ndim != 2 or array.shape[1] != 3:
        raise InputError(f"{owner}.{name} is {form(array)}; it must be n x 3 finite numbers")
    bad = np.flatnonzero(~(np.abs(array) <= LARGEST).all(axis=1))
    if len(bad):
        row, more = array[bad[0]], "" if len(bad) == 1 else f" and {len(bad) - 1} more"
        rule = f"finite numbers within ±{LARGEST:g} m"
        raise InputError(f"{owner}.{name}[{bad[0]}]{more} is {shown(row)}; it must be {rule}")
    array.setflags(write=False)  # so that large ones are not copied once more
    return array


def positive(owner: str, name: str, value: object, most: float = LARGEST) -> float:
    """A number from SMALLEST to `most`, or an InputError that names owner.name."""
    array = numbers(value)
    if array is None or array.ndim != 0 or not np.isfinite(array) or array <= 0:
        raise InputError(f"{owner}.{name} is {shown(value)}; it must be a positive number")
    if not SMALLEST <= array <= most:
        raise InputError(
            f"{owner}.{name} is {shown(value)}; it must be a number from {SMALLEST:g} to {most:g}"
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
        raise InputError(f"{what} is {shown(value)}; it must be 4 x 4 finite numbers within ±{LARGEST:g}")
    rotation = T[:3, :3]
    off = max(np.abs(rotation @ rotation.T - np.eye(3)).max(), np.abs(T[3] - LAST_ROW).max())
    if off > RIGID_SLACK or np.linalg.det(rotation) < 0:
        raise InputError(f"{what} is {shown(T)}; it must be a rotation and a translation over a row 0 0 0 1")
    T[3] = LAST_ROW
    return T


def form(array: ndarray | None) -> str:
    """What an array is, for messages."""
    return "not numbers" if array is None else f"an array of {' x '.join(map(str, array.shape))}"
