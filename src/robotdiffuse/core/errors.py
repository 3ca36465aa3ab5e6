"""InputError, the exception for bad input, and helpers that quote values in its message."""

from collections import Counter
from collections.abc import Collection, Hashable, Iterable, Iterator
from contextlib import contextmanager
from difflib import get_close_matches
from types import UnionType
from typing import Any

import numpy as np

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
    """As `located`, for reading a file. Any exception other than InputError becomes an InputError that says
    that the file is damaged."""
    try:
        with located(file):
            yield
    except InputError:
        raise
    except Exception as error:  # the readers of formats raise many kinds of errors for damaged files
        raise InputError(f"{file} is damaged: {type(error).__name__}: {str(error)[:MAX_WORD]}") from None


@contextmanager
def needs(package: str, extra: str) -> Iterator[None]:
    """Within the block, an ImportError becomes an InputError that names the package and the optional
    dependencies (`robotdiffuse[extra]`) to install."""
    try:
        yield
    except ImportError:
        text = f'this needs {package}, not installed: pip install "robotdiffuse[{extra}]"'
        raise InputError(text) from None


def check_type(what: str, value: object, kind: type | tuple[type, ...], wanted: str) -> None:
    """Raises InputError unless the value is an instance of `kind`. The message says that it must be
    `wanted`."""
    if not isinstance(value, kind):
        raise InputError(f"{what} is {shown(value)}; it must be {wanted}")


def check_list(
    what: str, value: Any, kinds: type | tuple[type, ...] | UnionType, wanted: str, least: int = 0
) -> None:
    """Raises InputError unless the value is a list or tuple of at least `least` instances of `kinds`. The
    message says that it must be a list of `wanted`."""
    of_kind = isinstance(value, list | tuple) and all(isinstance(entry, kinds) for entry in value)
    if not of_kind or len(value) < least:
        raise InputError(f"{what} is {shown(value)}; it must be a list of {wanted}")


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
        text = repr(value)
    except (ValueError, RecursionError):  # an integer of too many digits; lists nested too deeply
        text = f"a very long {type(value).__name__}"
    return shortened(text)


def shortened(text: str) -> str:
    """Text from a file or a user as one printable line of at most MAX_QUOTE characters."""
    text = " ".join(_printable(text).split())
    return text if len(text) <= MAX_QUOTE else text[: MAX_QUOTE - 3] + "..."


def joined(names: Iterable[object], most: int = MAX_NAMES) -> str:
    """Names from a user's input as one line: the first `most`, each shortened, and the number of the
    others."""
    short_names = [shortened(str(name)) for name in names]
    more = f" and {len(short_names) - most} more" if len(short_names) > most else ""
    return ", ".join(short_names[:most]) + more


def repeated(names: Iterable[str]) -> list[str]:
    """The names that appear more than once, in order."""
    return [name for name, count in Counter(names).items() if count > 1]


def unknown_name(what: str, name: object, known: Iterable[object]) -> InputError:
    """An InputError for a name that is not in a table; it lists the known names."""
    names = sorted(map(str, known))
    return InputError(f"unknown {what} {shown(name)}; known: {joined(names)}{suggestion(name, names)}")


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
