"""robotdiffuse export, robotdiffuse publish"""

import argparse
from typing import TYPE_CHECKING

from robotdiffuse.cli.arguments import positive
from robotdiffuse.core.errors import InputError

if TYPE_CHECKING:
    from robotdiffuse.core.types import Trajectory
    from robotdiffuse.problems.problem import Problem

PORT = 9090


def add_export(commands: argparse._SubParsersAction) -> None:
    parser = commands.add_parser(
        "export",
        help="write a result for ROS 2, Foxglove or Rerun",
        description="Validate the motion of a result file anew, and write it for other programs: .mcap (a scene "
        "that Foxglove opens, with ROS 2 messages), .rosbag2 (a ROS 2 bag, a folder), .rrd (Rerun), .yaml (a "
        "ROS 2 JointTrajectory), .csv and .json.",
    )
    parser.add_argument("result", metavar="RESULT", help="result file (.json) of `robotdiffuse plan --out`")
    parser.add_argument("--out", action="append", required=True, metavar="FILE", help="repeatable")
    parser.set_defaults(run=run_export)


def add_publish(commands: argparse._SubParsersAction) -> None:
    parser = commands.add_parser(
        "publish",
        help="send a result to ROS by a rosbridge",
        description="Validate the motion of a result file anew, and publish it as a JointTrajectory.",
    )
    parser.add_argument("result", metavar="RESULT", help="result file (.json) of `robotdiffuse plan --out`")
    parser.add_argument(
        "--to", required=True, type=address, metavar="HOST[:PORT]", help=f"of the rosbridge (port: {PORT})"
    )
    parser.add_argument("--topic", default="/joint_trajectory", help="(default: /joint_trajectory)")
    parser.add_argument(
        "--timeout", type=positive, default=5.0, metavar="S", help="for the connection (default: 5 s)"
    )
    parser.set_defaults(run=run_publish)


def address(text: str) -> tuple[str, int]:
    """HOST or HOST:PORT."""
    host, colon, port = text.rpartition(":")
    if not colon:
        host, port = text, str(PORT)
    if not host or not (port.isascii() and port.isdecimal() and 0 < int(port) < 65536):
        raise argparse.ArgumentTypeError(f"{text!r} is not HOST or HOST:PORT")
    return host, int(port)


def validated(file: str) -> "tuple[Problem, Trajectory]":
    """The problem and the motion of a result file. Raises InputError where there is none, and for one that
    the validator does not call valid: what leaves here may be executed."""
    from robotdiffuse.cli.view import read
    from robotdiffuse.validation.validator import verify_trajectory

    result, problem = read(file)
    if result.trajectory is None:
        raise InputError(f"{file} holds a path without times; plan again to have a trajectory")
    violation = verify_trajectory(problem, result.trajectory).violation
    if violation is not None:
        raise InputError(f"{file} is not handed over: its motion is not valid: {violation.message}")
    return problem, result.trajectory


def run_export(arguments: argparse.Namespace) -> int:
    from robotdiffuse.interop import check_export, write_motion

    outputs = [check_export(file) for file in arguments.out]
    problem, trajectory = validated(arguments.result)
    for file in outputs:
        write_motion(problem, trajectory, file)
        print(f"wrote {file}")
    return 0


def run_publish(arguments: argparse.Namespace) -> int:
    from robotdiffuse.interop.rosbridge import publish

    host, port = arguments.to
    _, trajectory = validated(arguments.result)
    publish(trajectory, host, port, arguments.topic, arguments.timeout)
    print(f"published {len(trajectory.times)} rows on {arguments.topic} at {host}:{port}")
    return 0
