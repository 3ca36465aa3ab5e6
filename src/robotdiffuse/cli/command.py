"""A command of the command line and its options, and options that several commands have."""

from argparse import _SubParsersAction as Commands
from dataclasses import dataclass
from typing import Any, NamedTuple

from robotdiffuse.cli.arguments import count, natural, option, port
from robotdiffuse.processes.ray_cluster import CLUSTERS

Rows = tuple[Any, ...]
"""Options: each row holds arguments of `option`, the last of them a dictionary if argparse needs keywords."""


class Group(NamedTuple):
    """Options below a title; without a title, options of which at most one may be given."""

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
