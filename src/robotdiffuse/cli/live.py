"""robotdiffuse live"""

import argparse
import os
import signal
import socket
import sys
import threading
from typing import NoReturn

from robotdiffuse.cli.arguments import positive
from robotdiffuse.core.errors import InputError

LOOPBACK = "127.0.0.1"
PORT = 8080


def add(commands: argparse._SubParsersAction) -> None:
    parser = commands.add_parser(
        "live",
        help="an interactive page: drag target and obstacles, see plan and certificate",
        description="Serve an interactive page until Ctrl-C: drag the target, the start and obstacles; it "
        "plans anew and says at once whether the motion shown is still free. Without PROBLEM, the demo's.",
    )
    parser.add_argument(
        "problem", metavar="PROBLEM", nargs="?", help="problem file (.yaml or .json) to begin with"
    )
    parser.add_argument(
        "--robot", metavar="NAME", help="in place of PROBLEM: an arm, by its name or a URDF file"
    )
    parser.add_argument(
        "--planner", metavar="NAME", help="see `robotdiffuse planners` (default: robotdiffuse)"
    )
    parser.add_argument(
        "--time-limit", type=positive, default=1.0, metavar="S", help="for each plan (default: 1 s)"
    )
    parser.add_argument(
        "--host",
        default=LOOPBACK,
        metavar="ADDRESS",
        help="address to serve on (default: 127.0.0.1, this machine alone); elsewhere the page's address "
        "ends with a token, without which nothing is served",
    )
    parser.add_argument(
        "--port", type=port, default=PORT, metavar="N", help=f"default: {PORT}; 0: any that is free"
    )
    parser.set_defaults(run=run)


def port(text: str) -> int:
    """An integer from 0 to 65535."""
    if not (text.isascii() and text.isdecimal() and int(text) < 2**16):
        raise argparse.ArgumentTypeError(f"{text!r} is not a port, an integer from 0 to 65535")
    return int(text)


def run(arguments: argparse.Namespace) -> NoReturn:
    try:
        from robotdiffuse.visualization.live.page import Page
    except ModuleNotFoundError as error:
        if error.name != "viser":
            raise
        raise InputError("the page needs viser: pip install 'robotdiffuse[live]'") from None
    from rich.console import Console

    from robotdiffuse.cli import STOPPED
    from robotdiffuse.planning import DEFAULT_PLANNER, PLANNERS
    from robotdiffuse.visualization.live.access import bound, is_loopback, new_token
    from robotdiffuse.visualization.live.files import first_problem
    from robotdiffuse.visualization.live.session import Choice, Session

    planner = arguments.planner or DEFAULT_PLANNER
    PLANNERS.entry(planner)
    choice = Choice(planner, arguments.time_limit)
    listening = bound(arguments.host, arguments.port)
    with Console(stderr=True).status("loading the robot (a new URDF is fitted with spheres, for a minute)"):
        problem = first_problem(arguments.problem, arguments.robot)
    host, number = listening.getsockname()[:2]
    token = "" if is_loopback(host) else new_token()
    page = Page(Session(problem, choice), listening, token)
    ended = threading.Event()
    for wish in (signal.SIGINT, signal.SIGTERM):
        signal.signal(wish, lambda *_: ended.set())
    name = socket.gethostname() if host in ("0.0.0.0", "::") else f"[{host}]" if ":" in host else host
    print(f"the page is at http://{name}:{number}/{token} (Ctrl-C ends it)", flush=True)
    ended.wait()
    page.close()
    print("robotdiffuse: stopped", file=sys.stderr, flush=True)
    os._exit(STOPPED)  # threads that plan or compile would be waited for otherwise, and nothing is lost
