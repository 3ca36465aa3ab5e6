"""Reads and writes ROS messages as YAML, in the form of `ros2 topic echo` and `ros2 topic pub`."""

from pathlib import Path

import yaml

from robotdiffuse.core.input_files import MAX_YAML_SIZE, parse_yaml, read_text
from robotdiffuse.core.output_files import write_atomically
from robotdiffuse.core.types import Trajectory
from robotdiffuse.interop.plain_messages import joint_trajectory, motion_from_record
from robotdiffuse.interop.recorded_motion import RecordedMotion
from robotdiffuse.problems.problem import Problem


def read(file: Path, topic: str | None = None) -> RecordedMotion:
    """Read a JointTrajectory, RobotTrajectory or DisplayTrajectory."""
    text = read_text(file, largest=MAX_YAML_SIZE).rstrip()
    text = text.removesuffix("---")  # `ros2 topic echo` ends each message with it
    return motion_from_record(parse_yaml(text, str(file)), str(file))


def write(problem: Problem, trajectory: Trajectory, file: Path) -> None:
    """Write a JointTrajectory; see `interop.write_motion`."""
    record = joint_trajectory(trajectory.joint_names, trajectory)
    text = yaml.dump(record, Dumper=yaml.CSafeDumper, sort_keys=False, default_flow_style=None, width=110)
    write_atomically(file, text)
