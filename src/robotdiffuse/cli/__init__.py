"""The command line. Exit status: 0 solved or done, 1 no plan, 2 bad input, 130 stopped by Ctrl-C."""

import argparse
import sys
from collections.abc import Sequence
from typing import NoReturn

from robotdiffuse import __version__
from robotdiffuse.cli import bench, data, plan, planners, robot, simulate, train, view
from robotdiffuse.errors import InputError

SOLVED, NO_PLAN, BAD_INPUT, STOPPED = 0, 1, 2, 130

COMMANDS = (
    plan.add_plan,
    plan.add_demo,
    view.add_view,
    view.add_verify,
    simulate.add,
    planners.add,
    robot.add,
    data.add,
    train.add,
    bench.add,
)
"""Each adds one command to the parser and sets its function as `run`."""


class Parser(argparse.ArgumentParser):
    """Reports misuse in one line."""

    def error(self, message: str) -> NoReturn:
        self.exit(BAD_INPUT, f"{self.prog}: error: {message}; see {self.prog} --help\n")


def build_parser() -> Parser:
    parser = Parser(
        prog="robotdiffuse", description="Motion planning for redundant arms, every motion verified."
    )
    parser.add_argument("--version", action="version", version=f"robotdiffuse {__version__}")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    for add in COMMANDS:
        add(commands)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return the exit status; bad input is one line on standard error."""
    arguments = build_parser().parse_args(argv)
    try:
        return arguments.run(arguments)
    except InputError as error:
        print(f"robotdiffuse: error: {error}", file=sys.stderr)
        return BAD_INPUT
    except KeyboardInterrupt:
        print("robotdiffuse: stopped", file=sys.stderr)
        return STOPPED
    except BrokenPipeError:
        sys.stderr.close()
        return SOLVED
