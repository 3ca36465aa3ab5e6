"""robotdiffuse serve"""

import argparse
import os
from collections.abc import Sequence
from typing import TYPE_CHECKING

from robotdiffuse.cli.arguments import count, natural, positive

if TYPE_CHECKING:
    from robotdiffuse.robots.robot import Robot

TOKEN = "ROBOTDIFFUSE_TOKEN"


def add(commands: argparse._SubParsersAction) -> None:
    parser = commands.add_parser(
        "serve",
        help="plan and verify over HTTP",
        description="Plan and verify over HTTP until SIGTERM or Ctrl-C: requests that a worker has are "
        "finished then, others are answered with 503. The address itself shows a page of what there is. "
        f"Listening elsewhere than at this machine's own address needs a token in {TOKEN}.",
    )
    parser.add_argument(
        "--robot",
        action="append",
        default=[],
        metavar="NAME",
        help="a robot that requests may name beside the bundled ones: one of `robot add`, or its URDF; "
        "repeatable",
    )
    parser.add_argument("--host", default="127.0.0.1", help="address to listen at (default: 127.0.0.1)")
    parser.add_argument("--port", type=natural, default=8000, help="0: any that is free (default: 8000)")
    parser.add_argument(
        "--workers", type=count, metavar="N", help="processes that plan (default: one a core)"
    )
    parser.add_argument(
        "--queue",
        type=natural,
        default=16,
        metavar="N",
        help="requests that may wait for a worker; others are answered with 429 (default: 16)",
    )
    parser.add_argument(
        "--longest",
        type=positive,
        default=10.0,
        metavar="S",
        help="time limit that a request may ask for at most (default: 10 s)",
    )
    parser.add_argument(
        "--largest",
        type=count,
        default=8,
        metavar="MB",
        help="size that a request may have (default: 8 MB)",
    )
    parser.add_argument(
        "--memory",
        type=count,
        default=2048,
        metavar="MB",
        help="what a worker may hold after an answer; one that holds more is replaced (default: 2048 MB)",
    )
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    from robotdiffuse.core.errors import InputError, shown
    from robotdiffuse.core.input_files import MEGABYTE

    try:
        from robotdiffuse.server.server import serve
    except ImportError:
        raise InputError('serve needs fastapi and uvicorn: pip install "robotdiffuse[serve]"') from None
    from robotdiffuse.server.settings import ServeSettings

    settings = ServeSettings(
        host=arguments.host,
        port=arguments.port,
        workers=arguments.workers or os.cpu_count() or 1,
        queue=arguments.queue,
        longest=arguments.longest,
        largest=arguments.largest * MEGABYTE,
        memory=arguments.memory * MEGABYTE,
        token=os.environ.get(TOKEN, ""),
    )
    if not settings.on_loopback and not settings.token:
        raise InputError(f"host is {shown(settings.host)}, where others can connect: set a token in {TOKEN}")
    serve(served_robots(arguments.robot), settings, lambda line: print(line, flush=True))
    return 0


def served_robots(names: Sequence[str]) -> "dict[str, Robot]":
    """The bundled robots and those named, by the names that requests use: a URDF's robot by its own.

    Raises InputError where two would have one name.
    """
    from robotdiffuse.core.errors import InputError, shown
    from robotdiffuse.robots import ROBOTS, known_robots, load_robot

    robots = {name: load_robot(name) for name in ROBOTS}
    for name in names:
        robot = load_robot(name)
        known = name if name in known_robots() else robot.name
        if known in robots:
            raise InputError(f"robot {shown(name)} would be called {known}, which another robot is")
        robots[known] = robot
    return robots
