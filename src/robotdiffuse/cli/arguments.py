"""Types of command-line values, for argparse."""

import argparse
import math
from collections.abc import Callable
from typing import Any

# Exit statuses: done; no valid motion; bad input; the output could not be written; stopped by the user.
SOLVED = 0
NO_PLAN = 1
BAD_INPUT = 2
WRITE_FAILED = 3
STOPPED = 130
IGNORE_JOINTS = "ignore joints of MoveIt files that the robot does not have, with a note, instead of failing"


def command(
    commands: argparse._SubParsersAction,
    name: str,
    help: str,
    description: str,
    run: Callable[[argparse.Namespace], int] | None = None,
) -> argparse.ArgumentParser:
    """The parser of a command. run: what the command does; None: it has commands of its own."""
    parser = commands.add_parser(name, help=help, description=description)
    parser.set_defaults(run=run)
    return parser


def option(
    parser: argparse._ActionsContainer,
    spec: str,
    help: str,
    kind: Callable[[str], Any] | None = None,
    default: Any = None,
    **more: Any,
) -> None:
    """Add an option, or an argument.

    spec: its name and what its value is called: "--seed N". Without a value it is a flag; with "*" it may be
    repeated, and with "!" it is required. kind: reads the value; None: text. more: as of argparse.
    """
    name, *words = spec.split()
    values = [word for word in words if word not in ("*", "!")]
    if values:
        more |= {"metavar": values[0], "type": kind, "default": default}
    elif name.startswith("-") and "choices" not in more:
        more["action"] = "store_true"
    else:
        more["default"] = default
    if "*" in words:
        more |= {"action": "append", "default": []}
    if "!" in words:
        more["required"] = True
    parser.add_argument(name, help=help, **more)


def options(parser: argparse._ActionsContainer, *rows: tuple[Any, ...]) -> None:
    """Add options, each a row of the arguments of `option`."""
    for row in rows:
        option(parser, *row)


def add_import_option(parser: argparse.ArgumentParser) -> None:
    """Add the option --import; `main` imports the modules before it runs the command."""
    option(
        parser,
        "--import MODULE *",
        "import MODULE first (also from the current folder), for example to register planners or families; "
        "repeatable",
        dest="modules",
    )


def _number(text: str) -> float:
    """The text as a number; nan if it is not one."""
    try:
        return float(text)
    except ValueError:
        return math.nan


def positive(text: str) -> float:
    """A positive, finite number."""
    value = _number(text)
    if not 0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"{text!r} is not a positive number")
    return value


def jerk_limit(text: str) -> float:
    """A positive number, or infinity for "none"."""
    return math.inf if text == "none" else positive(text)


def natural(text: str) -> int:
    """An integer of at least 0."""
    if not (text.isascii() and text.isdecimal()):
        raise argparse.ArgumentTypeError(f"{text!r} is not an integer of at least 0")
    return int(text)


def count(text: str) -> int:
    """An integer of at least 1."""
    if not (text.isascii() and text.isdecimal() and int(text) > 0):
        raise argparse.ArgumentTypeError(f"{text!r} is not an integer of at least 1")
    return int(text)


def assignment(text: str) -> tuple[str, float]:
    """NAME=VALUE with a finite value."""
    name, _, number = text.partition("=")
    value = _number(number)
    if not name or not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"{text!r} is not NAME=NUMBER")
    return name, value


def folder(text: str) -> tuple[str, str]:
    """NAME=FOLDER."""
    name, _, path = text.partition("=")
    if not name or not path:
        raise argparse.ArgumentTypeError(f"{text!r} is not NAME=FOLDER")
    return name, path


def not_negative(text: str) -> float:
    """A finite number of at least 0."""
    value = _number(text)
    if not 0 <= value < math.inf:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number of at least 0")
    return value


def share(text: str) -> float:
    """A number from 0 to 1."""
    value = not_negative(text)
    if value > 1:
        raise argparse.ArgumentTypeError(f"{text!r} is not between 0 and 1")
    return value


def shares(text: str) -> dict[str, float]:
    """NAME=FRACTION,NAME=FRACTION,... with fractions of at least 0."""
    pairs = [part.strip().partition("=") for part in text.split(",")]
    if len({name for name, _, _ in pairs}) < len(pairs):
        raise argparse.ArgumentTypeError(f"{text!r} names a family twice")
    return {name: not_negative(number) for name, _, number in pairs}


def names(text: str) -> tuple[str, ...]:
    """NAME,NAME,..."""
    return tuple(part.strip() for part in text.split(","))
