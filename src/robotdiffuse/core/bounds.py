"""Checks numbers that users give: converts them to arrays within bounds that all other code can handle, and
makes the arrays of dataclasses read-only, see `Value`."""

from dataclasses import MISSING, fields
from typing import Any, TypeVar

import numpy as np
from numpy import ndarray

from robotdiffuse.core.errors import InputError, shown

MAX_COORDINATE = 1e4
"""Largest absolute coordinate, size or joint value [m] or [rad]. At 10 km, adjacent float32 numbers are about
1 mm apart; compiled code adds a margin for this error."""
MIN_SIZE = 1e-9
"""Smallest size [m]. A smaller size must be an error in units: it is far below the 1e-7 m between adjacent
float32 numbers near 1 m."""
# Bounds on what may be given as velocities, accelerations and jerks of joints, in SI units: limits must be at
# least MIN_RATE, and no rate may exceed MAX_RATE.
MIN_RATE = 1e-6
MAX_RATE = 1e6
MAX_RPY = 6.3
"""Largest absolute value of roll, pitch and yaw, a whole turn [rad]; larger values are likely degrees."""
MAX_DURATION = 1e6
"""Longest motion in files and requests [s]."""
RIGID_SLACK = 1e-4
"""Largest allowed error of a pose matrix: of each entry of R R^T against the identity, and of each entry of
the last row against LAST_ROW."""
LAST_ROW = (0.0, 0.0, 0.0, 1.0)

T = TypeVar("T")


class Value:
    """Base of the dataclasses that are values: the arrays in their fields are read-only.

    Caches use the object's identity as the key, so its arrays must not change. A writable array is copied, so
    that the caller's array stays writable. A subclass that defines `__post_init__` calls this class's
    `__post_init__` at its end.
    """

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        if "__repr__" not in cls.__dict__:  # else @dataclass adds a __repr__ that prints whole arrays
            cls.__repr__ = Value.__repr__

    def __repr__(self) -> str:
        return one_line(self)

    def __dir__(self) -> list[str]:
        """The attributes, without the caches that modules keep in `__dict__` under their dotted names."""
        return [name for name in super().__dir__() if "." not in name]

    def __post_init__(self) -> None:
        for name in (field.name for field in fields(self)):  # type: ignore[arg-type]
            value = getattr(self, name)
            frozen = read_only(value)
            if frozen is not value:
                object.__setattr__(self, name, frozen)

    def __setstate__(self, state: dict[str, Any]) -> None:
        # arrays from a pickle or a deep copy are writable
        self.__dict__.update({name: read_only(value) for name, value in state.items()})


def read_only(value: T) -> T:
    """Returns the value unchanged if all its arrays are read-only, else a copy with read-only arrays. Arrays
    in tuples and dictionaries count too."""
    if isinstance(value, ndarray):
        if not _writable(value):
            return value
        frozen = np.array(value)
        frozen.setflags(write=False)
        return frozen  # type: ignore[return-value]
    if isinstance(value, tuple):
        frozen = [read_only(entry) for entry in value]
        if all(a is b for a, b in zip(frozen, value, strict=True)):
            return value
        return value._make(frozen) if hasattr(value, "_make") else tuple(frozen)  # type: ignore
    if isinstance(value, dict):
        frozen = {key: read_only(entry) for key, entry in value.items()}
        return value if all(frozen[key] is value[key] for key in value) else frozen  # type: ignore[return-value]
    return value


def for_kernels(array: ndarray, dtype: type = np.float64) -> ndarray:
    """The array as compiled code takes it: contiguous and writable. Numba gives read-only arrays another
    type, so it would compile all functions again for them."""
    array = np.ascontiguousarray(array, dtype)
    return array if array.flags.writeable else array.copy()


def _writable(array: ndarray) -> bool:
    """Whether the array's memory may be written to, through this array or an array that it is a view of.
    Memory of an owner outside NumPy counts as writable unless the owner is `bytes`."""
    owner: Any = array
    while isinstance(owner, ndarray):
        if owner.flags.writeable:
            return True
        owner = owner.base
    return owner is not None and not isinstance(owner, bytes)


def numbers(value: object) -> ndarray | None:
    """The value as a float64 array; None if it is not a number or nested lists of numbers."""
    try:
        array = np.asarray(value)
    except (TypeError, ValueError, OverflowError, RecursionError):
        return None
    return array.astype(np.float64) if array.dtype.kind in "iuf" and not _holds_boolean(value) else None


def _holds_boolean(value: object) -> bool:
    """Whether nested lists hold a boolean, which NumPy would turn into 0 or 1 in a list with numbers."""
    if isinstance(value, list | tuple):
        return any(map(_holds_boolean, value))
    return isinstance(value, bool) or getattr(value, "dtype", None) == np.bool_


def within(array: ndarray, most: float = MAX_COORDINATE) -> bool:
    """Whether all numbers are finite and at most `most` in absolute value."""
    return bool((np.abs(array) <= most).all())


def vector(owner: str, name: str, value: object, size: int, most: float = MAX_COORDINATE) -> ndarray:
    """The value as `size` numbers within ±most. Raises InputError, naming owner.name, for anything else."""
    array = numbers(value)
    if array is None or array.shape != (size,) or not within(array, most):
        rule = f"it must be {size} finite numbers within ±{most:g}"
        raise InputError(f"{owner}.{name} is {shown(value)}; {rule}")
    return array


def rows(
    name: str,
    value: object,
    count: int | None,
    columns: int,
    most: float = MAX_COORDINATE,
    meaning: str = "",
) -> ndarray:
    """The value as an array of `count` rows (None: at least one row) of `columns` numbers within ±most.

    Raises InputError, naming the field `name` or its first wrong row, for anything else. For a wrong
    shape, the message states the right one and then `meaning`, e.g. ", a column for each joint".
    """
    array = numbers(value)
    requirement = f"it must be {count or 'n'} x {columns} finite numbers{meaning}"
    if array is None:
        raise InputError(f"{name} is {shown(value)}; {requirement}")
    if array.size == 0:
        raise InputError(f"{name} is empty; {requirement}")
    if array.ndim != 2 or array.shape[1] != columns or count not in (None, len(array)):
        raise InputError(f"{name} is {form(array)}; {requirement}")
    bad = np.flatnonzero(~(np.abs(array) <= most).all(axis=1))
    if len(bad):
        row = shown(array[bad[0]])
        raise InputError(f"{name}[{bad[0]}] is {row}; its numbers must be finite and within ±{most:g}")
    return array


def points(owner: str, name: str, value: object) -> ndarray:
    """The value as n x 3 coordinates within ±MAX_COORDINATE [m]; n may be 0.

    Raises InputError, naming owner.name or its first wrong row, for anything else.
    """
    array = numbers(value)
    if array is not None and array.size == 0:
        array = array.reshape(0, 3)
    else:
        array = rows(f"{owner}.{name}", value, None, 3)
    array.setflags(write=False)  # so that `Value` does not copy a large array
    return array


def positive(owner: str, name: str, value: object) -> float:
    """The value as a number from MIN_SIZE to MAX_COORDINATE.

    Raises InputError, naming owner.name, for anything else.
    """
    array = numbers(value)
    if array is None or array.ndim != 0 or not MIN_SIZE <= array <= MAX_COORDINATE:
        rule = f"it must be a number from {MIN_SIZE:g} to {MAX_COORDINATE:g}"
        raise InputError(f"{owner}.{name} is {shown(value)}; {rule}")
    return float(array)


def unit_quaternion(owner: str, value: object, name: str = "wxyz") -> ndarray:
    """The quaternion scaled to length 1. If its length is 1 already, its numbers are not changed at all.

    Raises InputError, naming owner.name, unless it is four numbers within ±MAX_COORDINATE, of a length of at
    least 1e-6.
    """
    wxyz = vector(owner, name, value, 4)
    norm = np.linalg.norm(wxyz)
    if norm < 1e-6:
        raise InputError(f"{owner}.{name} is {shown(value)}; a quaternion must not be zero")
    return wxyz if abs(norm - 1) < 1e-15 else wxyz / norm


def rigid_transform(what: str, value: object, slack: float = RIGID_SLACK) -> ndarray:
    """The value as a 4 x 4 pose, with the last row set to exactly 0 0 0 1.

    Raises InputError, naming `what`, for other shapes, for numbers beyond ±MAX_COORDINATE, for a reflection,
    and if an entry of R R^T or of the last row is off by more than `slack`.
    """
    T = numbers(value)
    if T is None or T.shape != (4, 4) or not within(T):
        raise InputError(
            f"{what} is {shown(value)}; it must be 4 x 4 finite numbers within ±{MAX_COORDINATE:g}"
        )
    rotation = T[:3, :3]
    off = max(np.abs(rotation @ rotation.T - np.eye(3)).max(), np.abs(T[3] - LAST_ROW).max())
    if off > slack or np.linalg.det(rotation) < 0:
        raise InputError(
            f"{what} is {shown(T)}; it must be a homogeneous transform: a rotation matrix, last row 0 0 0 1"
        )
    T[3] = LAST_ROW
    return T


def form(array: ndarray | None) -> str:
    """The shape of an array in words, for error messages."""
    return "not numbers" if array is None else f"an array of {' x '.join(map(str, array.shape))}"


MAX_NUMBERS = 8
"""If an array has more numbers than this, `short` shows only its shape."""
MAX_ENTRIES = 3
"""If a tuple or list has more entries than this, `short` shows only how many it has."""
MAX_TEXT = 200
"""Longest text that `one_line` returns [characters]."""


def one_line(value: Any) -> str:
    """A dataclass as Name(field=value, ...) in one line; fields with their default are left out."""
    fields_shown = []
    for field in fields(value):
        if field.repr and not _is_default(field.default, now := getattr(value, field.name)):
            fields_shown.append(f"{field.name}={short(now)}")
    text = f"{type(value).__name__}({', '.join(fields_shown)})"
    return text if len(text) <= MAX_TEXT else f"{text[: MAX_TEXT - 4]}...)"


def short(value: Any) -> str:
    """A short text of a value: the numbers of a small array, the shape of a large one."""
    if isinstance(value, ndarray):
        if value.size <= MAX_NUMBERS:
            return _numbers(value.tolist())
        return f"<{' x '.join(map(str, value.shape))} array>"
    if isinstance(value, tuple | list) and not hasattr(value, "_fields"):
        if len(value) > MAX_ENTRIES:
            return f"<{len(value)} entries>"
        items = ", ".join(map(short, value))
        return f"({items},)" if len(value) == 1 else f"({items})"
    if isinstance(value, dict):
        return f"<{len(value)} entries>"
    return " ".join(repr(value).split())


def _numbers(value: Any) -> str:
    if isinstance(value, list):
        return f"[{', '.join(map(_numbers, value))}]"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _is_default(default: Any, value: Any) -> bool:
    if default is MISSING:
        return False
    if value is default:
        return True
    try:
        return bool(np.array_equal(value, default))
    except (TypeError, ValueError):
        return False
