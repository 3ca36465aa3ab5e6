"""The command line. Exit status: 0 solved or done, 1 no valid motion, 2 bad input, 3 output that could not be
written, 130 stopped by Ctrl-C, 143 by SIGTERM."""

import argparse
import errno
import io
import os
import re
import signal
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from importlib import import_module
from typing import Any, NoReturn

from robotdiffuse import __version__
from robotdiffuse.cli.arguments import BAD_INPUT, WRITE_FAILED
from robotdiffuse.cli.commands import COMMANDS
from robotdiffuse.core.errors import InputError, OutputError, suggestion
from robotdiffuse.core.interrupts import STOPS, handled
from robotdiffuse.core.registry import import_modules

RETRY_DELAY = 0.05
"""Time after which a lost Ctrl-C is tried again [s]."""


class Parser(argparse.ArgumentParser):
    """An argument parser that reports an error in one line, under the name of the command in which it
    occurred."""

    def parse_known_args(self, args=None, namespace=None):  # type: ignore[override]
        arguments, unknown = super().parse_known_args(args, namespace)
        if unknown:
            similar = suggestion(unknown[0].partition("=")[0], self._option_string_actions)
            self.error(f"unrecognized arguments: {' '.join(unknown)}{similar}")
        return arguments, unknown

    def error(self, message: str) -> NoReturn:
        choice = re.search(r"invalid choice: '(.*?)' \(choose from (.*)\)", message)
        if choice:
            message += suggestion(choice[1], re.findall(r"'(.*?)'", choice[2]))
        # InputError puts the message on one line and shortens long words
        self.exit(BAD_INPUT, f"{self.prog}: error: {InputError(message)}; see {self.prog} --help\n")


def build_parser() -> Parser:
    """The parser of all commands."""
    parser = Parser(
        prog="robotdiffuse",
        description="Motion planning for robot arms; every motion is verified.",
        usage="robotdiffuse [-h] [--version] COMMAND ...",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"robotdiffuse {__version__}")
    commands = parser.add_subparsers(
        metavar="COMMAND", required=True, help=argparse.SUPPRESS, prog="robotdiffuse"
    )
    topics = list[str]()
    for topic, group in COMMANDS.items():
        for command in group:
            command.add(commands)
        lines = [f"  {added.dest:<12} {added.help}" for added in commands._choices_actions]
        topics.append("\n".join([f"{topic}:", *lines]))
        commands._choices_actions.clear()  # else argparse lists all of them without topics
    parser.epilog = "\n\n".join(topics)
    return parser


@contextmanager
def _repeated_interrupts() -> Iterator[None]:
    """Within the block, signals of STOPS raise KeyboardInterrupt with their number. If it is lost in a
    callback, such as one that runs while compiled code is loaded, it is raised again until it arrives."""
    report = sys.unraisablehook
    stopped_by = signal.SIGINT

    def interrupt(number: int, _frame: object) -> NoReturn:
        nonlocal stopped_by
        stopped_by = number
        raise KeyboardInterrupt(number)

    def schedule(lost: Any) -> None:
        if lost.exc_type is KeyboardInterrupt:
            # later, since a second one would be lost in the same callback
            signal.setitimer(signal.ITIMER_REAL, RETRY_DELAY)
        else:
            report(lost)

    def repeat(_number: int, frame: Any) -> None:
        if frame.f_code is schedule.__code__:  # an exception within `schedule` would be lost for good
            signal.setitimer(signal.ITIMER_REAL, RETRY_DELAY)
        else:
            signal.raise_signal(stopped_by)

    sys.unraisablehook = schedule
    with handled(repeat, signal.SIGALRM), handled(interrupt, *STOPS):
        try:
            yield
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
            sys.unraisablehook = report


@_repeated_interrupts()
def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit status. Bad input is reported on standard error: one line, then the
    further lines of the InputError (its argument `listed`), if it has any."""
    _prepare_streams()
    try:
        arguments = build_parser().parse_args(argv)
        import_modules(getattr(arguments, "modules", ()))
        module, _, run = arguments.run.partition(":")
        status = getattr(import_module(f"{__name__}.{module}"), run)(arguments) or 0
        sys.stdout.flush()
        return status
    except InputError as error:
        return _refused(error, WRITE_FAILED if isinstance(error, OutputError) else BAD_INPUT)
    except MemoryError as error:
        return _refused(f"not enough memory; use smaller numbers. {error}")
    except (KeyboardInterrupt, SystemError) as error:
        cause: BaseException | None = error
        while isinstance(cause, SystemError):  # Ctrl-C in compiled code can arrive as one
            cause = cause.__cause__
        if not isinstance(cause, KeyboardInterrupt):
            raise
        print("robotdiffuse: stopped", file=sys.stderr)
        return 128 + next(iter(cause.args), signal.SIGINT)
    except BrokenPipeError:
        return _write_failed()
    except SystemExit as stop:
        if isinstance(stop.__context__, BrokenPipeError):  # from rich, which would exit with status 1
            return _write_failed()
        raise
    except OSError as error:
        if error.errno == errno.ENAMETOOLONG:
            return _refused(InputError(f"{error.filename}: {error.strerror}"))
        return _write_failed(error.strerror or str(error))


def _refused(why: object, status: int = BAD_INPUT) -> int:
    """Report an error on standard error, and return the exit status."""
    print(f"robotdiffuse: error: {why}", file=sys.stderr)
    return status


def _prepare_streams() -> None:
    """Replace characters that the terminal lacks by question marks, and closed streams by /dev/null."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, open(os.devnull, "w"))  # noqa: SIM115  (as long as the process)
        elif isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")


def _write_failed(why: str = "") -> int:
    """Report the failure, and redirect standard output to /dev/null so that flushing it at exit cannot fail.

    why: the reason to report; empty if the reader closed the pipe, as `head` does, which is not reported.
    """
    with suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    with suppress(OSError):
        if why:
            print(f"robotdiffuse: the output could not be written: {why}", file=sys.stderr)
    return WRITE_FAILED
