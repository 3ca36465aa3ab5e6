"""The command `robotdiffuse live`."""

import argparse
import os
import signal
import sys
import threading
from typing import TYPE_CHECKING, NoReturn

from robotdiffuse.cli.arguments import command, option, positive
from robotdiffuse.cli.exit_status import STOPPED
from robotdiffuse.core.errors import InputError

if TYPE_CHECKING:
    from robotdiffuse.visualization.live.exploration import ExplorationPage
    from robotdiffuse.visualization.live.page import Page

LOOPBACK = "127.0.0.1"
PORT = 8080


def add(commands: argparse._SubParsersAction) -> None:
    parser = command(
        commands,
        "live",
        "plan interactively in the browser",
        "Serve an interactive page until Ctrl-C. Drag the target, the start and obstacles: the "
        "page plans again after each change and shows at once whether the current motion is still valid. "
        "Without PROBLEM, it shows the demo problem.",
        run,
    )
    option(parser, "problem PROBLEM", "problem file (.yaml or .json) to open", nargs="?")
    option(parser, "--robot NAME", "instead of PROBLEM: name or URDF file of an arm")
    option(parser, "--planner NAME", "planner; see `robotdiffuse planners` (default: robotdiffuse)")
    option(parser, "--time-limit S", "time limit of each plan (default: 1 s)", positive, 1.0)
    add_address(parser)


def add_address(parser: argparse._ActionsContainer) -> None:
    """Add the options that say where a page is served."""
    option(
        parser,
        "--host ADDRESS",
        "address to listen on (default: 127.0.0.1, this machine only); on other addresses the URL of "
        "the page ends with a secret token that every visitor needs",
        default=LOOPBACK,
    )
    option(parser, "--port N", f"port; 0 for any free one (default: {PORT})", port, PORT)


def port(text: str) -> int:
    """An integer from 0 to 65535."""
    if not (text.isascii() and text.isdecimal() and int(text) < 2**16):
        raise argparse.ArgumentTypeError(f"{text!r} is not a port, an integer from 0 to 65535")
    return int(text)


def run(arguments: argparse.Namespace) -> NoReturn:
    require_viser("live")
    from rich.console import Console

    from robotdiffuse.planning import DEFAULT_PLANNER, PLANNERS
    from robotdiffuse.visualization.live.page import Page
    from robotdiffuse.visualization.live.server import PageServer, free_port
    from robotdiffuse.visualization.live.session import PageOptions, Session, first_problem

    planner = arguments.planner or DEFAULT_PLANNER
    PLANNERS.entry(planner)
    options = PageOptions(planner, arguments.time_limit)
    number = free_port(arguments.host, arguments.port)
    with Console(stderr=True).status("loading the robot (preparing a new URDF takes a minute)"):
        problem = first_problem(arguments.problem, arguments.robot)
    serve_until_stopped(Page(Session(problem, options), PageServer(arguments.host, number)))


def require_viser(command: str) -> None:
    """Raises InputError if viser is not installed."""
    try:
        import robotdiffuse.visualization.live.server  # noqa: F401
    except ModuleNotFoundError as error:
        if error.name != "viser":
            raise
        raise InputError(f"{command} needs viser: pip install 'robotdiffuse[live]'") from None


def serve_until_stopped(page: "Page | ExplorationPage") -> NoReturn:
    """Print the address of a page, serve it until Ctrl-C, and end the process."""
    ended = threading.Event()
    for stop_signal in (signal.SIGINT, signal.SIGTERM):
        signal.signal(stop_signal, lambda *_: ended.set())
    print(f"the page is at {page.server.url} (stop with Ctrl-C)", flush=True)
    ended.wait()
    page.close()
    print("robotdiffuse: stopped", file=sys.stderr, flush=True)
    os._exit(STOPPED)  # a normal exit would wait for threads that plan or compile
