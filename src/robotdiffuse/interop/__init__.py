"""Motions to and from other programs: ROS 2, MCAP and Foxglove, Rerun, rosbridge; a file for each format."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from robotdiffuse.core.errors import InputError
from robotdiffuse.core.input_files import file_name
from robotdiffuse.core.output_files import check_output
from robotdiffuse.core.registry import Entry, Registry

if TYPE_CHECKING:
    from robotdiffuse.core.types import Trajectory
    from robotdiffuse.interop.recorded_motion import Recorded
    from robotdiffuse.problems.problem import Problem

BAG = ".rosbag2"
WRITERS = Registry(
    "motion format to write",
    {
        ".mcap": Entry("robotdiffuse.interop.mcap_file:write", "a scene that Foxglove shows, and the motion"),
        ".rosbag2": Entry("robotdiffuse.interop.rosbag:write", "a ROS 2 bag (a folder)"),
        ".rrd": Entry("robotdiffuse.interop.rerun_file:write", "a recording that Rerun shows"),
        ".yaml": Entry("robotdiffuse.interop.ros_yaml:write", "a ROS 2 JointTrajectory"),
    },
)
"""By ending: functions of problem, trajectory and file."""
READERS = Registry(
    "motion format",
    {
        ".json": Entry(
            "robotdiffuse.interop.plain_messages:read_json_file", "results, trajectories, ROS messages"
        ),
        ".csv": Entry("robotdiffuse.interop.csv_file:read", "a column for each joint, and time"),
        ".yaml": Entry("robotdiffuse.interop.ros_yaml:read", "ROS JointTrajectory, MoveIt RobotTrajectory"),
        ".yml": Entry("robotdiffuse.interop.ros_yaml:read", "the same"),
        ".mcap": Entry("robotdiffuse.interop.mcap_file:read", "ROS 2 messages"),
        ".rosbag2": Entry("robotdiffuse.interop.rosbag:read", "a ROS 2 bag (a folder)"),
    },
)
"""By ending: functions of a file and of the topic that is asked for, or None."""


OWN = (".json", ".csv")
"""Endings that `Trajectory.save` knows."""


def check_export(file: str | Path) -> Path:
    """The file as a path, after a check that there is a writer for it, installed, and that it can be written.

    Raises InputError for an ending that is not in WRITERS or OWN, for a package that is not installed, and
    for a folder that is missing or read-only.
    """
    path = file_name(file)
    ending = path.suffix.lower()
    if ending not in OWN:
        WRITERS.load(ending)
    return path if path.is_dir() and ending == BAG else check_output(path, (*OWN, *WRITERS))


def write_motion(problem: "Problem", trajectory: "Trajectory", file: str | Path) -> None:
    """Write a motion and what it is for, by the file's ending, one of WRITERS or OWN.

    Raises InputError as `check_export`.
    """
    path = check_export(file)
    if path.suffix.lower() in OWN:
        trajectory.save(path)
    else:
        WRITERS.load(path.suffix.lower())(problem, trajectory, path)


def read_motion(file: str | Path, topic: str | None = None) -> "Recorded":
    """A motion that anybody wrote; a folder is a ROS 2 bag.

    Raises InputError for another ending, a file that is damaged or holds no motion, and a package that is not
    installed.
    """
    path = file_name(file)
    ending = BAG if path.is_dir() else path.suffix.lower()
    if ending == ".db3":
        raise InputError(f"{path} is a part of a ROS 2 bag; give the folder that it is in")
    read: Callable[..., Recorded] = READERS.load(ending)
    return read(path, topic)


def missing(package: str, extra: str) -> InputError:
    """For an extra that is not installed."""
    return InputError(f'this needs {package}, not installed: pip install "robotdiffuse[{extra}]"')
