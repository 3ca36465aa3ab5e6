"""The one exception for bad input."""

from collections.abc import Iterable


class InputError(ValueError):
    """Bad input: the message is one line that names the field, the value and what would be right.

    The command line prints it and exits with status 2.
    """


def unknown_name(what: str, name: object, known: Iterable[str]) -> InputError:
    """An error for a name that is not in a table; lists the known ones."""
    return InputError(f"unknown {what} {name!r}; known: {', '.join(sorted(known))}")
