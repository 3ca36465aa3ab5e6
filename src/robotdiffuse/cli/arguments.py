"""Types of command-line values, for argparse."""

import math
from argparse import ArgumentParser, ArgumentTypeError, Namespace
from argparse import _ActionsContainer as ActionsContainer
from argparse import _SubParsersAction as Commands
from collections.abc import Callable, Iterable
from typing import Any

# Exit statuses: done; no valid motion; bad input; the output could not be written; stopped by the user.
SOLVED = 0
NO_PLAN = 1
BAD_INPUT = 2
WRITE_FAILED = 3
STOPPED = 130
IGNORE_JOINTS = "ignore joints of MoveIt files that the robot does not have, with a note, instead of failing"


def command(
    commands: Commands,
    name: str,
    help: str,
    description: str,
    run: Callable[[Namespace], int | None] | None = None,
    *rows: tuple[Any, ...],
) -> ArgumentParser:
    """The parser of a command with its options, each a row of the arguments of `option`.

    run: what the command does; it returns the exit status, or None for 0.
    """
    parser = commands.add_parser(name, help=help, description=description)
    parser.set_defaults(run=run)
    options(parser, *rows)
    return parser


def group(
    commands: Commands, name: str, help: str, description: str, title: str = "actions", kind: str = "ACTION"
) -> Commands:
    """Where the commands of a command are added. title, kind: what the help calls them."""
    return command(commands, name, help, description).add_subparsers(title=title, metavar=kind, required=True)


def option(
    parser: ActionsContainer,
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


def options(parser: ActionsContainer, *rows: tuple[Any, ...]) -> None:
    """Add options, each a row of the arguments of `option`; keywords of argparse stand in a dictionary at its
    end."""
    for row in rows:
        *values, more = row if isinstance(row[-1], dict) else (*row, {})
        option(parser, *values, **more)


def chosen(arguments: Namespace, names: Iterable[str]) -> dict[str, Any]:
    """The options of these names that were given; the others keep the defaults of the settings."""
    return {name: value for name, value in vars(arguments).items() if name in names and value is not None}


def add_import_option(parser: ArgumentParser) -> None:
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
        raise ArgumentTypeError(f"{text!r} is not a positive number")
    return value


def jerk_limit(text: str) -> float:
    """A positive number, or infinity for "none"."""
    return math.inf if text == "none" else positive(text)


def natural(text: str) -> int:
    """An integer of at least 0."""
    if not (text.isascii() and text.isdecimal()):
        raise ArgumentTypeError(f"{text!r} is not an integer of at least 0")
    return int(text)


def count(text: str) -> int:
    """An integer of at least 1."""
    if not (text.isascii() and text.isdecimal() and int(text) > 0):
        raise ArgumentTypeError(f"{text!r} is not an integer of at least 1")
    return int(text)


def assignment(text: str) -> tuple[str, float]:
    """NAME=VALUE with a finite value."""
    name, _, number = text.partition("=")
    value = _number(number)
    if not name or not math.isfinite(value):
        raise ArgumentTypeError(f"{text!r} is not NAME=NUMBER")
    return name, value


def folder(text: str) -> tuple[str, str]:
    """NAME=FOLDER."""
    name, _, path = text.partition("=")
    if not name or not path:
        raise ArgumentTypeError(f"{text!r} is not NAME=FOLDER")
    return name, path


def not_negative(text: str) -> float:
    """A finite number of at least 0."""
    value = _number(text)
    if not 0 <= value < math.inf:
        raise ArgumentTypeError(f"{text!r} is not a number of at least 0")
    return value


def share(text: str) -> float:
    """A number from 0 to 1."""
    value = not_negative(text)
    if value > 1:
        raise ArgumentTypeError(f"{text!r} is not between 0 and 1")
    return value


def shares(text: str) -> dict[str, float]:
    """NAME=FRACTION,NAME=FRACTION,... with fractions of at least 0."""
    pairs = [part.strip().partition("=") for part in text.split(",")]
    if len({name for name, _, _ in pairs}) < len(pairs):
        raise ArgumentTypeError(f"{text!r} names a family twice")
    return {name: not_negative(number) for name, _, number in pairs}


def names(text: str) -> tuple[str, ...]:
    """NAME,NAME,..."""
    return tuple(part.strip() for part in text.split(","))
