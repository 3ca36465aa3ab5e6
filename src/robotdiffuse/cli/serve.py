"""The command `robotdiffuse serve`."""

import os
from collections.abc import Sequence
from typing import TYPE_CHECKING

from robotdiffuse.cli.arguments import Commands, Namespace, command, count, natural, positive

if TYPE_CHECKING:
    from robotdiffuse.robots.robot import Robot

TOKEN = "ROBOTDIFFUSE_TOKEN"


def add(commands: Commands) -> None:
    command(
        commands,
        "serve",
        "plan and validate over HTTP",
        "Plan and validate over HTTP until SIGTERM or Ctrl-C. Running requests then finish; "
        "waiting ones are answered with 503. The server's address in a browser lists all endpoints. A server "
        f"that other machines can reach needs a token in the environment variable {TOKEN}.",
        run,
        (
            "--robot NAME *",
            "another robot that requests may name: one of `robot add`, or a URDF file; repeatable",
        ),
        ("--host HOST", "address to listen on (default: 127.0.0.1)", None, "127.0.0.1"),
        ("--port PORT", "port; 0 for any free one (default: 8000)", natural, 8000),
        ("--workers N", "processes that plan (default: one per core)", count),
        (
            "--queue N",
            "requests that may wait for a worker; further ones are answered with 429 (default: 16)",
            natural,
            16,
        ),
        ("--max-time-limit S", "largest time limit of a request (default: 10 s)", positive, 10.0),
        ("--max-request-size MB", "largest size of a request (default: 8 MB)", count, 8),
        (
            "--max-worker-memory MB",
            "memory of a worker, at least 512; requests that need more are refused (default: 2048 MB)",
            count,
            2048,
        ),
    )


def run(arguments: Namespace) -> None:
    from robotdiffuse.core.errors import InputError, shown
    from robotdiffuse.core.input_files import MEGABYTE

    try:
        from robotdiffuse.server.server import serve
    except ImportError:
        raise InputError(
            'serve needs fastapi, prometheus-client and uvicorn: pip install "robotdiffuse[serve]"'
        ) from None
    from robotdiffuse.server.settings import ServeSettings

    settings = ServeSettings(
        host=arguments.host,
        port=arguments.port,
        workers=arguments.workers or os.cpu_count() or 1,
        queue=arguments.queue,
        max_time_limit=arguments.max_time_limit,
        max_request_size=arguments.max_request_size * MEGABYTE,
        max_worker_memory=arguments.max_worker_memory * MEGABYTE,
        token=os.environ.get(TOKEN, ""),
    )
    if not settings.on_loopback and not settings.token:
        raise InputError(f"host is {shown(settings.host)}, which others can reach: set a token in {TOKEN}")
    serve(served_robots(arguments.robot), settings, lambda line: print(line, flush=True))


def served_robots(names: Sequence[str]) -> "dict[str, Robot]":
    """The bundled robots and those named, by the names for requests; a robot from a URDF has its own name.

    Raises InputError if two robots have the same name.
    """
    from robotdiffuse.core.errors import InputError, shown
    from robotdiffuse.robots import ROBOTS, known_robots, load_robot

    robots = {name: load_robot(name) for name in ROBOTS}
    for name in names:
        robot = load_robot(name)
        request_name = name if name in known_robots() else robot.name
        if request_name in robots:
            raise InputError(f"robot {shown(name)} has the name {request_name} of another robot")
        robots[request_name] = robot
    return robots
