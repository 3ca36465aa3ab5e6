"""The command `robotdiffuse serve`."""

import os
from collections.abc import Sequence

from robotdiffuse.cli.arguments import TOKEN, Namespace, chosen
from robotdiffuse.core.errors import InputError, shown
from robotdiffuse.core.network import is_loopback
from robotdiffuse.robots import ROBOTS, known_robots, load_robot
from robotdiffuse.robots.robot import Robot
from robotdiffuse.server.app import serve
from robotdiffuse.server.settings import ServeSettings


def run(arguments: Namespace) -> None:
    options = chosen(arguments, ServeSettings.__dataclass_fields__)
    settings = ServeSettings(**options, token=os.environ.get(TOKEN, "").strip())
    if not is_loopback(settings.host) and not settings.token:
        raise InputError(f"host is {shown(settings.host)}, which others can reach: set a token in {TOKEN}")
    serve(served_robots(arguments.robot), settings, lambda line: print(line, flush=True))


def served_robots(names: Sequence[str]) -> dict[str, Robot]:
    """The bundled robots and the named ones, by the names that requests use; a robot from a URDF has the name
    in the URDF.

    Raises InputError if two robots have the same name.
    """

    robots = {name: load_robot(name) for name in ROBOTS}
    for name in names:
        robot = load_robot(name)
        request_name = name if name in known_robots() else robot.name
        if request_name in robots:
            raise InputError(f"robot {shown(name)}: the server has a robot named {request_name} already")
        robots[request_name] = robot
    return robots
