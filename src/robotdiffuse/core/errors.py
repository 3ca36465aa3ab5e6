"""InputError, the exception for bad input; helpers that quote values in its message; and checks of numbers
from users, which raise it.

The checks convert numbers to arrays within bounds that all other code can handle."""

import re
from collections import Counter
from collections.abc import Collection, Hashable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import MISSING, fields
from difflib import get_close_matches
from types import UnionType
from typing import Any

import numpy as np
from numpy import ndarray

MAX_QUOTE = 60
"""Longest quote of a value in a message [characters]."""
MAX_WORD = 300
"""Longest word of a message, such as a file name [characters]."""
MAX_NAMES = 100
"""Largest number of known names that a message lists."""


class InputError(ValueError):
    """Bad input. The first line of the message names the field, its value and what would be right.

    The command line prints the message and exits with status 2.
    """

    def __init__(self, message: str = "", listed: Iterable[str] = ()) -> None:
        """Put the message on one line, and shorten words of more than MAX_WORD characters.

        Args:
            message: The field, its value and what would be right.
            listed: Further lines of the message, which are indented.
        """
        words = _printable(message).split()
        line = " ".join(shortened(word) if len(word) > MAX_WORD else word for word in words)
        super().__init__("\n  ".join([line, *listed]))

    def __reduce__(self) -> tuple[type, tuple[str, list[str]]]:
        """For pickle and copies, which would otherwise join the message and its `listed` lines into one
        line."""
        line, *listed = str(self).split("\n  ")
        return type(self), (line, listed)


class OutputError(InputError):
    """Output that could not be written, as on a full disk. The command line exits with status 3."""


class MissingPackageError(InputError):
    """An optional dependency that is not installed, or that cannot be imported."""


@contextmanager
def located(where: object) -> Iterator[None]:
    """Within the block, `where: ` is put before the message of an InputError, unless the message begins with
    `where`."""
    try:
        yield
    except InputError as error:
        kind, (line, listed) = error.__reduce__()
        at = "" if line.startswith(str(where)) else f"{where}: "
        raise kind(f"{at}{line}", listed) from None


@contextmanager
def reading(file: object) -> Iterator[None]:
    """Does what `located` does, for reading a file. Any exception other than InputError becomes an InputError
    that says that the file is damaged."""
    try:
        with located(file):
            yield
    except InputError:
        raise
    except Exception as error:  # the readers of formats raise many kinds of errors for damaged files
        raise InputError(f"{file} is damaged: {described(error)}") from None


@contextmanager
def needs(package: str, extra: str) -> Iterator[None]:
    """Within the block, an ImportError becomes a MissingPackageError that names the package and the optional
    dependencies (`robotdiffuse[extra]`) to install."""
    try:
        yield
    except ImportError as error:
        why = "not installed" if isinstance(error, ModuleNotFoundError) else shortened(error)
        text = f'this needs {package}, {why}: pip install "robotdiffuse[{extra}]"'
        raise MissingPackageError(text) from None


def check_type(what: str, value: object, kind: type | tuple[type, ...], wanted: str) -> None:
    """Raises InputError unless the value is an instance of `kind`. A class never counts as an instance, even
    if `kind` is a protocol whose members it has. The message says that the value must be `wanted`."""
    if isinstance(value, type) or not isinstance(value, kind):
        raise InputError(f"{what} is {shown(value)}; it must be {wanted}")


def filled_text(what: str, value: object, wanted: str) -> str:
    """The value, if it is a text that is not empty. Raises InputError for anything else; the message says
    that it must be `wanted`."""
    if not isinstance(value, str) or not value:
        raise InputError(f"{what} is {shown(value)}; it must be {wanted}")
    return value


def check_list(
    what: str, value: Any, kinds: type | tuple[type, ...] | UnionType, wanted: str, least: int = 0
) -> None:
    """Raises InputError unless the value is a list or tuple of at least `least` instances of `kinds`. The
    message says that it must be a list of `wanted`."""
    of_kind = isinstance(value, list | tuple) and all(isinstance(entry, kinds) for entry in value)
    if not of_kind or len(value) < least:
        raise InputError(
            f"{what} is {shown(value)}; it must be a list of {wanted}{', not empty' if least else ''}"
        )


def distinct(*values: float | int, digits: int = 6) -> list[str]:
    """The numbers as texts of `digits` digits, for messages that compare numbers. If different numbers would
    have equal texts, all texts have more digits."""
    texts = [f"{value:.{digits}g}" for value in values]
    if len({*texts}) < len({*values}) and digits < 17:
        return distinct(*values, digits=digits + 1)
    return texts


def shown(value: object) -> str:
    """The value as one short line, for error messages."""
    if isinstance(value, np.ndarray | np.generic):
        value = (value if value.size <= MAX_QUOTE else value.ravel()[:MAX_QUOTE]).tolist()
    if isinstance(value, str | bytes):
        value = value[: MAX_QUOTE + 1]
    try:
        # 0.5 in place of np.float64(0.5) in lists
        text = re.sub(r"np\.(?:u?int|float)\d+\(([^()]*)\)", r"\1", repr(value))
    except (ValueError, RecursionError):  # an integer of too many digits; lists nested too deeply
        text = f"a very long {type(value).__name__}"
    return shortened(text)


def shortened(text: object, most: int = MAX_QUOTE) -> str:
    """Text from a file or a user as one printable line of at most `most` characters."""
    text = " ".join(_printable(str(text)).split())
    return text if len(text) <= most else text[: most - 3] + "..."


def described(error: BaseException) -> str:
    """The kind and the message of another library's error as one line. It may be long, since such messages
    often end with the file, line or element that is wrong."""
    return f"{type(error).__name__}: {shortened(error, MAX_WORD)}"


def joined(names: Iterable[object], most: int = MAX_NAMES) -> str:
    """Names from a user's input as one line: the first `most`, each shortened, and the number of the
    others."""
    short_names = [shortened(name) for name in names]
    more = f" and {len(short_names) - most} more" if len(short_names) > most else ""
    return ", ".join(short_names[:most]) + more


def counted(count: Any, noun: str, plural: str | None = None) -> str:
    """A number and its noun: "1 problem", "2,000 problems". plural: None: the noun with an s."""
    number = f"{count:,}" if isinstance(count, int) else count
    return f"{number} {noun if count == 1 else plural or f'{noun}s'}"


def repeated(names: Iterable[str]) -> list[str]:
    """The names that appear more than once, in order."""
    return [name for name, count in Counter(names).items() if count > 1]


def unknown_name(what: str, name: object, known: Iterable[object]) -> InputError:
    """An InputError for a name that is not in a table; it lists the known names."""
    names = sorted(map(str, known))
    return InputError(
        f"unknown {what} {shown(name)}; known: {joined(names) or 'none'}{suggestion(name, names)}"
    )


def check_name(what: str, name: object, known: Collection[object]) -> None:
    """Raises the InputError of `unknown_name` unless the name is in the table."""
    if not isinstance(name, Hashable) or name not in known:
        raise unknown_name(what, name, known)


def suggestion(name: object, known: Iterable[str]) -> str:
    """The end of a message about an unknown name: "; did you mean ...?" with the most similar known name;
    empty if none is similar."""
    similar = get_close_matches(str(name)[:MAX_WORD], list(known)[:MAX_NAMES], n=1)
    return f"; did you mean {similar[0]}?" if similar else ""


def _printable(text: str) -> str:
    """The text with U+FFFD in place of every character, except white space, that cannot be printed, such as
    escape characters and lone surrogates."""
    return "".join(c if c.isprintable() or c.isspace() else "\N{REPLACEMENT CHARACTER}" for c in text)


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
MOTION_SLACK = 1e-3
"""RIGID_SLACK for the arguments of `moved`; larger, since these are often products of poses."""
ROUNDED = 1e-6
"""A rotation that is off by more than this, as RIGID_SLACK counts, is replaced by the nearest exact one;
otherwise products of poses with few decimals would exceed the slack."""
LAST_ROW = (0.0, 0.0, 0.0, 1.0)


def numbers(value: Any) -> ndarray | None:
    """The value as a float64 array; None if it is not a number or nested lists of numbers."""
    try:
        if hasattr(value, "detach"):  # a tensor of PyTorch, which may have gradients
            value = value.detach().cpu()
        # what a mask hides is missing
        array = value.filled(np.nan) if isinstance(value, np.ma.MaskedArray) else np.asarray(value)
        if array.dtype == object:  # as a row of a table of numbers and texts
            value = array.tolist()
            array = np.asarray(value)
    except (TypeError, ValueError, OverflowError, RuntimeError):
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


def bounded(
    what: str, value: object, shape: tuple[int, ...], low: float, high: float, wanted: str
) -> ndarray:
    """The value as an array of this shape with numbers from `low` to `high`. Raises InputError for anything
    else; the message says that it must be `wanted`."""
    array = numbers(value)
    if array is None or array.shape != shape or not ((array >= low) & (array <= high)).all():
        raise InputError(f"{what} is {shown(value)}; it must be {wanted}")
    return array


def vector(owner: str, name: str, value: object, size: int | None, most: float = MAX_COORDINATE) -> ndarray:
    """The value as `size` numbers (None: at least one) within ±most. Raises InputError, naming owner.name,
    for anything else."""
    array = numbers(value)
    count = size if size is not None or array is None else max(array.size, 1)
    if array is None or array.shape != (count,) or not within(array, most):
        rule = f"it must be {'n' if size is None else size} finite numbers within ±{most:g}"
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
    wanted = f"a number from {MIN_SIZE:g} to {MAX_COORDINATE:g}"
    return float(bounded(f"{owner}.{name}", value, (), MIN_SIZE, MAX_COORDINATE, wanted))


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
    """The value as a 4 x 4 pose, with the last row set to exactly 0 0 0 1, and a rotation that is off by more
    than ROUNDED replaced by the nearest exact one.

    Raises InputError, naming `what`, for other shapes, for numbers beyond ±MAX_COORDINATE, for a reflection,
    and if an entry of R R^T or of the last row is off by more than `slack`.
    """
    wanted = f"4 x 4 finite numbers within ±{MAX_COORDINATE:g}"
    T = bounded(what, value, (4, 4), -MAX_COORDINATE, MAX_COORDINATE, wanted)
    rotation = T[:3, :3]
    off = max(np.abs(rotation @ rotation.T - np.eye(3)).max(), np.abs(T[3] - LAST_ROW).max())
    handedness = np.linalg.det(rotation)
    if off > slack or handedness < 0:
        raise InputError(
            f"{what} is {shown(T)}, with the determinant {handedness:.3g} and the last row {shown(T[3])}; it"
            " must be a homogeneous transform: a rotation matrix (determinant 1), last row 0 0 0 1"
        )
    if off > ROUNDED:
        u, _, v = np.linalg.svd(rotation)
        T[:3, :3] = u @ v
    T[3] = LAST_ROW
    return T


def rigid_motion(T: object) -> ndarray:
    """The argument `T` of a method `moved`, a rigid motion. Raises InputError as `rigid_transform` does."""
    return rigid_transform("T", T, MOTION_SLACK)


def form(array: ndarray | None) -> str:
    """The shape of an array in words, for error messages."""
    if array is None:
        return "not numbers"
    return f"an array of {' x '.join(map(str, array.shape))}" if array.ndim else "a single number"


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
        return f"<{counted(len(value), 'entry', 'entries')}>"
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
