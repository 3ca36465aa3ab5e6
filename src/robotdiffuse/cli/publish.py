"""The command `robotdiffuse publish`."""

import argparse

from robotdiffuse.cli.arguments import positive
from robotdiffuse.cli.export import validated_motion

PORT = 9090
"""Default port of rosbridge."""


def add(commands: argparse._SubParsersAction) -> None:
    parser = commands.add_parser(
        "publish",
        help="publish a result to ROS through rosbridge",
        description="Validate the motion of a result file again, and publish it as a ROS JointTrajectory.",
    )
    parser.add_argument("result", metavar="RESULT", help="result file (.json) of `robotdiffuse plan --out`")
    parser.add_argument(
        "--to", required=True, type=address, metavar="HOST[:PORT]", help=f"rosbridge server (port: {PORT})"
    )
    parser.add_argument(
        "--topic",
        default="/joint_trajectory",
        metavar="NAME",
        help="topic to publish on (default: /joint_trajectory)",
    )
    parser.add_argument(
        "--timeout", type=positive, default=5.0, metavar="S", help="timeout of the connection (default: 5 s)"
    )
    parser.set_defaults(run=run)


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
