"""The commands `robotdiffuse export` and `publish`."""

from argparse import ArgumentTypeError
from typing import TYPE_CHECKING

from robotdiffuse.cli.arguments import Commands, Namespace, command, positive
from robotdiffuse.core.errors import InputError

if TYPE_CHECKING:
    from robotdiffuse.core.types import Trajectory
    from robotdiffuse.problems.problem import Problem


def add_export(commands: Commands) -> None:
    command(
        commands,
        "export",
        "write a result for ROS 2, Foxglove or Rerun",
        "Validate the motion of a result file again, and write it for other programs: .mcap (a "
        "scene that Foxglove opens, with ROS 2 messages), .rosbag2 (a ROS 2 bag, a folder), .rrd (Rerun), "
        ".yaml (a ROS 2 JointTrajectory), .csv and .json.",
        run_export,
        ("result RESULT", "result file (.json) of `robotdiffuse plan --out`"),
        ("--out FILE * !", "file to write; repeatable"),
        ("--rate HZ", "resample the motion, and validate it so, for a controller", float),
    )


def run_export(arguments: Namespace) -> None:
    from robotdiffuse.interop import check_export, write_motion

    outputs = [check_export(file) for file in arguments.out]
    problem, trajectory = validated_motion(arguments.result, arguments.rate)
    for file in outputs:
        write_motion(problem, trajectory, file)
        print(f"wrote {file}")


def validated_motion(file: str, rate: float | None = None) -> "tuple[Problem, Trajectory]":
    """The problem and the motion of a result file, resampled at `rate` [Hz] if it is given.

    Raises InputError if it holds no timed motion, and if the validator rejects the motion, because other
    programs may execute it.
    """
    from robotdiffuse.cli.view import read_solved
    from robotdiffuse.validation.validator import verify_trajectory

    result, problem = read_solved(file)
    if result.trajectory is None:
        raise InputError(f"{file} holds a path without times; plan again to get a trajectory")
    trajectory = result.trajectory if rate is None else result.trajectory.resample(rate)
    violation = verify_trajectory(problem, trajectory).violation
    if violation is not None:
        rows = "" if rate is None else f" with rows at {rate:g} Hz"
        raise InputError(f"{file} is not exported: its motion{rows} is not valid: {violation.message}")
    return problem, trajectory


PORT = 9090
"""Default port of rosbridge."""


def add_publish(commands: Commands) -> None:
    command(
        commands,
        "publish",
        "publish a result to ROS through rosbridge",
        "Validate the motion of a result file again, and publish it as a ROS JointTrajectory.",
        run_publish,
        ("result RESULT", "result file (.json) of `robotdiffuse plan --out`"),
        ("--to HOST[:PORT] !", f"rosbridge server (port: {PORT})", address),
        ("--topic NAME", "topic to publish on (default: /joint_trajectory)", None, "/joint_trajectory"),
        ("--timeout S", "timeout of the connection (default: 5 s)", positive, 5.0),
    )


def address(text: str) -> tuple[str, int]:
    """HOST or HOST:PORT."""
    host, colon, port = text.rpartition(":")
    if not colon:
        host = text
        port = str(PORT)
    if not host or not (port.isascii() and port.isdecimal() and 0 < int(port) < 65536):
        raise ArgumentTypeError(f"{text!r} is not HOST or HOST:PORT")
    return host, int(port)


def run_publish(arguments: Namespace) -> None:
    from robotdiffuse.interop.recorded_motion import publish

    host, port = arguments.to
    _, trajectory = validated_motion(arguments.result)
    publish(trajectory, host, port, arguments.topic, arguments.timeout)
    print(f"published {len(trajectory.times)} rows on {arguments.topic} at {host}:{port}")
