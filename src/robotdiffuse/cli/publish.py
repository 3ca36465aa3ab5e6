"""The command `robotdiffuse publish`."""

import argparse

from robotdiffuse.cli.arguments import command, option, positive
from robotdiffuse.cli.export import validated_motion

PORT = 9090
"""Default port of rosbridge."""


def add(commands: argparse._SubParsersAction) -> None:
    parser = command(
        commands,
        "publish",
        "publish a result to ROS through rosbridge",
        "Validate the motion of a result file again, and publish it as a ROS JointTrajectory.",
        run,
    )
    option(parser, "result RESULT", "result file (.json) of `robotdiffuse plan --out`")
    option(parser, "--to HOST[:PORT] !", f"rosbridge server (port: {PORT})", address)
    option(
        parser,
        "--topic NAME",
        "topic to publish on (default: /joint_trajectory)",
        default="/joint_trajectory",
    )
    option(parser, "--timeout S", "timeout of the connection (default: 5 s)", positive, 5.0)


def address(text: str) -> tuple[str, int]:
    """HOST or HOST:PORT."""
    host, colon, port = text.rpartition(":")
    if not colon:
        host, port = text, str(PORT)
    if not host or not (port.isascii() and port.isdecimal() and 0 < int(port) < 65536):
        raise argparse.ArgumentTypeError(f"{text!r} is not HOST or HOST:PORT")
    return host, int(port)


def run(arguments: argparse.Namespace) -> int:
    from robotdiffuse.interop.plain_messages import publish

    host, port = arguments.to
    _, trajectory = validated_motion(arguments.result)
    publish(trajectory, host, port, arguments.topic, arguments.timeout)
    print(f"published {len(trajectory.times)} rows on {arguments.topic} at {host}:{port}")
    return 0
