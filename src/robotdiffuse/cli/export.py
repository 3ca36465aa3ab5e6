"""The command `robotdiffuse export`."""

import argparse
from typing import TYPE_CHECKING

from robotdiffuse.cli.arguments import command, option
from robotdiffuse.core.errors import InputError

if TYPE_CHECKING:
    from robotdiffuse.core.types import Trajectory
    from robotdiffuse.problems.problem import Problem


def add(commands: argparse._SubParsersAction) -> None:
    parser = command(
        commands,
        "export",
        "write a result for ROS 2, Foxglove or Rerun",
        "Validate the motion of a result file again, and write it for other programs: .mcap (a "
        "scene that Foxglove opens, with ROS 2 messages), .rosbag2 (a ROS 2 bag, a folder), .rrd (Rerun), "
        ".yaml (a ROS 2 JointTrajectory), .csv and .json.",
        run,
    )
    option(parser, "result RESULT", "result file (.json) of `robotdiffuse plan --out`")
    option(parser, "--out FILE * !", "file to write; repeatable")
    option(parser, "--rate HZ", "resample the motion, and validate it so, for a controller", float)


def run(arguments: argparse.Namespace) -> int:
    from robotdiffuse.interop import check_export, write_motion

    outputs = [check_export(file) for file in arguments.out]
    problem, trajectory = validated_motion(arguments.result, arguments.rate)
    for file in outputs:
        write_motion(problem, trajectory, file)
        print(f"wrote {file}")
    return 0


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
