"""The one exception for bad input, and how its messages quote what was given."""

from collections.abc import Iterable

import numpy as np

MAX_QUOTE = 60
"""Characters of a given value that a message repeats."""
MAX_WORD = 300
"""Characters of any word of a message, as the name of a file."""
MAX_NAMES = 100
"""Known names that a message lists."""


class InputError(ValueError):
    """Bad input: the message is one line that names the field, the value and what would be right; after it
    `listed`, a line each.

    The command line prints it and exits with status 2.
    """

    def __init__(self, message: str = "", listed: Iterable[str] = ()) -> None:
        words = _printable(message).split()
        line = " ".join(shortened(word) if len(word) > MAX_WORD else word for word in words)
        super().__init__("\n  ".join([line, *listed]))


def shown(value: object) -> str:
    """A value as one short line, for error messages."""
    if isinstance(value, np.ndarray):
        value = (value if value.size <= MAX_QUOTE else value.ravel()[:MAX_QUOTE]).tolist()
    if isinstance(value, str | bytes):
        value = value[: MAX_QUOTE + 1]
    try:
        text = repr(value)
    except (ValueError, RecursionError):  # an integer of too many digits, lists within lists
        text = f"a very long {type(value).__name__}"
    return shortened(text)


def shortened(text: str) -> str:
    """Text that others wrote, as one short line."""
    text = " ".join(_printable(text).split())
    return text if len(text) <= MAX_QUOTE else text[: MAX_QUOTE - 3] + "..."


def joined(names: Iterable[object], most: int = MAX_NAMES) -> str:
    """Names that others wrote, as one line of short ones."""
    short = [shortened(str(name)) for name in names]
    more = f" and {len(short) - most} more" if len(short) > most else ""
    return ", ".join(short[:most]) + more


def unknown_name(what: str, name: object, known: Iterable[object]) -> InputError:
    """An error for a name that is not in a table; lists the known ones."""
    return InputError(f"unknown {what} {shown(name)}; known: {joined(sorted(map(str, known)))}")


def _printable(text: str) -> str:
    """Without terminal codes and the halves of surrogate pairs, which cannot be printed."""
    return "".join(c if c.isprintable() or c.isspace() else "\N{REPLACEMENT CHARACTER}" for c in text)
