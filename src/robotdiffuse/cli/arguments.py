"""Commands of the command line, options that several commands have, and types of values, for argparse."""

import math
from argparse import ArgumentTypeError, Namespace
from argparse import _ActionsContainer as ActionsContainer
from argparse import _SubParsersAction as Commands
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, NamedTuple

from robotdiffuse.core.errors import InputError
from robotdiffuse.core.files import MEGABYTE
from robotdiffuse.processes.workers import CLUSTERS

# Exit statuses: done; no valid motion; bad input; the output could not be written.
SOLVED = 0
NO_PLAN = 1
BAD_INPUT = 2
WRITE_FAILED = 3
VIEW_ENDINGS = (".html", ".png")
"""Endings of replays and pictures."""
ROSBRIDGE_PORT = 9090
"""Default port of rosbridge."""


def option(parser: ActionsContainer, spec: str, help: str, *more: Any) -> None:
    """Add an option, or a positional argument.

    spec: the option's name and the placeholder of its value in the help: "--seed N". Without a placeholder,
    the option is a flag, unless it has `choices`. With "*" it may be repeated, with "!" it is required. more:
    the function that parses the value (None: text, not empty), the default, and further keywords of argparse
    in a dictionary.
    """
    *values, keywords = more if more and isinstance(more[-1], dict) else (*more, {})
    kind, default, *_ = *values, None, None  # what `more` leaves out is None
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
    """The values of the options with these names, except those that are None: they were not given, so the
    settings keep their own defaults. Flags are always included."""
    return {name: value for name, value in vars(arguments).items() if name in names and value is not None}


def check_workers(arguments: Namespace) -> None:
    """Refuses --workers together with --cluster."""
    if arguments.cluster and arguments.workers:
        raise InputError("--workers cannot be combined with --cluster, which uses all cores of the cluster")


def number(kind: type, fits: Callable[[Any], bool], what: str) -> Callable[[str], Any]:
    """A function that reads a finite number for which `fits` holds. what: what messages call it."""

    def read(text: str) -> Any:
        is_digits = text.isascii() and text.isdecimal()
        try:
            value = kind(text) if kind is float or is_digits else math.nan
        except ValueError:
            value = math.nan
        if not (fits(value) and math.isfinite(value)):
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
    """HOST or HOST:PORT. An IPv6 address must be in brackets if a port follows; otherwise, missing brackets
    are added."""
    host, colon, digits = text.rpartition(":")
    if colon and (":" not in host or host.endswith("]")):
        return filled(host), port(digits)
    return f"[{text}]" if colon and not text.endswith("]") else filled(text), ROSBRIDGE_PORT


Rows = tuple[Any, ...]
"""Options: each row holds arguments of `option`, the last of them a dictionary if argparse needs keywords."""


class Group(NamedTuple):
    """Options below a title. Without a title, at most one of the options may be given."""

    title: str | None
    rows: Rows


@dataclass(frozen=True)
class Command:
    """A command, or a group of commands."""

    name: str
    help: str
    description: str
    run: "str | tuple[Command, ...]"
    """MODULE:FUNCTION of `robotdiffuse.cli`, which takes the arguments and returns the exit status, or None
    for 0; or the commands below it."""
    rows: Rows = ()
    """The options of the command, and groups of options."""
    below: str = "actions"
    """What the help calls the commands below it."""

    def add(self, commands: Commands) -> None:
        """Add the command to a parser."""
        parser = commands.add_parser(self.name, help=self.help, description=self.description)
        parser.set_defaults(run=self.run)
        for row in self.rows:
            if not isinstance(row, Group):
                option(parser, *row)
                continue
            title, rows = row
            group = parser.add_argument_group(title) if title else parser.add_mutually_exclusive_group()
            for options in rows:
                option(group, *options)
        if isinstance(self.run, tuple):
            actions = parser.add_subparsers(title=self.below, metavar=self.below[:-1].upper(), required=True)
            for command in self.run:
                command.add(actions)


PORT = 8080
TOKEN = "ROBOTDIFFUSE_TOKEN"
LOOPBACK = "127.0.0.1"
SHELLS = ("bash", "zsh")
PROBLEM = ("problem PROBLEM", "problem file")
RESULT = ("result RESULT", "result file (.json) of `robotdiffuse plan --out`")
INDEX = ("--index INDEX", "which problem of a .jsonl file (default: 0)", natural, 0)
SEED = ("--seed N", "random seed (default: 0)", natural, 0)
VIEW = ("--view", "write a replay (.html) and open it")
PANDA = ("--robot NAME", "bundled name or URDF (default: panda)")
ALL_CORES = ("--workers N", "processes (default: all cores)", count)
HALF_OF_CORES = ("--workers N", "planners that run at once (default: half of the cores)", count)
CPU_TIME = ("--cpu-time", "limits and times are CPU time, for a machine that does other work")
CLUSTER = ("--cluster", "use the Ray cluster at RAY_ADDRESS", None, None, {"choices": CLUSTERS})
IGNORE_JOINTS = (
    "--ignore-joints",
    "ignore joints of MoveIt files that the robot does not have, with a note, instead of failing",
)
IMPORT = (
    "--import MODULE *",
    "import MODULE first (also from the current folder), for example to register planners or families; "
    "repeatable",
    {"dest": "modules"},
)
ADDRESS = (
    (
        "--host ADDRESS",
        "address to listen on (default: 127.0.0.1, this machine only); on other addresses the URL of the "
        "page ends with a secret token that every visitor needs",
        None,
        LOOPBACK,
    ),
    ("--port N", f"port; 0 for any free one (default: {PORT})", port, PORT),
)
