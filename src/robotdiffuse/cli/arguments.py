"""Types of command-line values, for argparse."""

import math
from argparse import ArgumentTypeError, Namespace
from argparse import _ActionsContainer as ActionsContainer
from collections.abc import Callable, Iterable
from typing import Any

from robotdiffuse.core.errors import InputError
from robotdiffuse.core.input_files import MEGABYTE

# Exit statuses: done; no valid motion; bad input; the output could not be written; stopped by the user.
SOLVED = 0
NO_PLAN = 1
BAD_INPUT = 2
WRITE_FAILED = 3
STOPPED = 130
VIEW_ENDINGS = (".html", ".png")
"""Endings of replays and pictures."""
ROSBRIDGE_PORT = 9090
"""Default port of rosbridge."""


def option(parser: ActionsContainer, spec: str, help: str, *more: Any) -> None:
    """Add an option, or a positional argument.

    spec: the option's name and the placeholder of its value in the help: "--seed N". Without a placeholder,
    the option is a flag. With "*" it may be repeated, with "!" it is required. more: the function that parses
    the value (None: it stays text), the default, and further keywords of argparse in a dictionary.
    """
    *values, keywords = more if more and isinstance(more[-1], dict) else (*more, {})
    kind, default, *_ = *values, None, None
    name, *words = spec.split()
    called = [word for word in words if word not in "*!"]
    about: dict[str, Any] = {"default": default}
    if called:
        about |= {"metavar": called[0], "type": kind or filled}
    elif name.startswith("-") and "choices" not in keywords:
        about = {"action": "store_true"}
    if "*" in words:
        about |= {"action": "append", "default": []}
    if "!" in words:
        about["required"] = True
    parser.add_argument(name, help=help, **about | keywords)


def chosen(arguments: Namespace, names: Iterable[str]) -> dict[str, Any]:
    """The options of these names that the user gave; for all others, the settings keep their defaults."""
    return {name: value for name, value in vars(arguments).items() if name in names and value is not None}


def check_workers(arguments: Namespace) -> None:
    """Refuses --workers together with --cluster."""
    if arguments.cluster and arguments.workers:
        raise InputError("--workers cannot be combined with --cluster, which uses all cores of the cluster")


def number(kind: type, fits: Callable[[Any], bool], what: str) -> Callable[[str], Any]:
    """A function that reads a finite number for which `fits` holds. what: such a number, in messages."""

    def read(text: str) -> Any:
        is_digits = text.isascii() and text.isdecimal()
        try:
            value = kind(text) if kind is float or is_digits else math.nan
        except ValueError:
            value = math.nan
        if not (math.isfinite(value) and fits(value)):
            raise ArgumentTypeError(f"{text!r} is not {what}")
        return value

    return read


positive = number(float, lambda x: x > 0, "a positive number")
not_negative = number(float, lambda x: x >= 0, "a number of at least 0")
share = number(float, lambda x: 0 <= x <= 1, "between 0 and 1")
natural = number(int, lambda x: x < 2**63, "an integer of at least 0, below 2^63")
count = number(int, lambda x: 0 < x <= 10**9, "an integer of at least 1, at most 10^9")
port = number(int, lambda x: x < 2**16, "a port, an integer from 0 to 65535")


def filled(text: str) -> str:
    """A text, such as a name, that is not empty."""
    if not text:
        raise ArgumentTypeError("empty; it must be a name or value")
    return text


def megabytes(text: str) -> int:
    """The number of bytes of an integer of megabytes, at least 1."""
    return MEGABYTE * count(text)


def pair(text: str, kind: str = "FOLDER") -> tuple[str, str]:
    """NAME=VALUE. kind: what messages call the value."""
    name, _, value = text.partition("=")
    if not name or not value:
        raise ArgumentTypeError(f"{text!r} is not NAME={kind}")
    return name, value


def assignment(text: str) -> tuple[str, float]:
    """NAME=VALUE with a finite value."""
    name, value = pair(text, "NUMBER")
    return name, number(float, lambda _: True, "a number")(value)


def shares(text: str) -> dict[str, float]:
    """NAME=FRACTION,NAME=FRACTION,..."""
    pairs = list(map(assignment, names(text)))
    if len(dict(pairs)) < len(pairs):
        raise ArgumentTypeError(f"{text!r} names a family twice")
    return dict(pairs)


def names(text: str) -> tuple[str, ...]:
    """NAME,NAME,..."""
    return tuple(map(filled, map(str.strip, text.split(","))))


def positives(text: str) -> list[float]:
    """NUMBER,NUMBER,... of positive numbers."""
    return list(map(positive, names(text)))


def address(text: str) -> tuple[str, int]:
    """HOST or HOST:PORT."""
    host, colon, digits = text.rpartition(":")
    return (filled(host), port(digits)) if colon else (filled(text), ROSBRIDGE_PORT)
