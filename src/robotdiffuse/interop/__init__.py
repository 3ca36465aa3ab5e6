"""Import and export of motions: ROS 2, MCAP and Foxglove, Rerun, rosbridge."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from robotdiffuse.core.errors import InputError, check_type
from robotdiffuse.core.files import check_output, file_name
from robotdiffuse.core.registry import Entry, Registry
from robotdiffuse.core.types import Trajectory

if TYPE_CHECKING:
    from robotdiffuse.interop.recorded_motion import RecordedMotion
    from robotdiffuse.problems.problem import Problem

BAG = ".rosbag2"
WRITERS = Registry(
    "motion format to write",
    {
        ".mcap": Entry("robotdiffuse.interop.ros2:write_mcap", "a Foxglove scene, and ROS 2 messages"),
        ".rosbag2": Entry("robotdiffuse.interop.ros2:write_bag", "a ROS 2 bag (a folder)"),
        ".rrd": Entry("robotdiffuse.interop.rerun_file:write", "a Rerun recording"),
        ".yaml": Entry("robotdiffuse.interop.recorded_motion:write_yaml", "a ROS 2 JointTrajectory"),
    },
)
"""Functions that write a trajectory, by the ending of the file. Their arguments are problem, trajectory and
file."""
READERS = Registry(
    "motion format",
    {
        ".json": Entry(
            "robotdiffuse.interop.recorded_motion:read_json_file", "results, trajectories, ROS messages"
        ),
        ".csv": Entry(
            "robotdiffuse.interop.recorded_motion:read_csv", "a column for time and for each joint"
        ),
        ".yaml": Entry(
            "robotdiffuse.interop.recorded_motion:read_yaml", "ROS JointTrajectory, MoveIt RobotTrajectory"
        ),
        ".yml": Entry("robotdiffuse.interop.recorded_motion:read_yaml", "as .yaml"),
        ".mcap": Entry("robotdiffuse.interop.ros2:read_recording", "ROS 2 messages"),
        ".rosbag2": Entry("robotdiffuse.interop.ros2:read_recording", "a ROS 2 bag (a folder)"),
    },
)
"""Functions that read a motion, by the ending of the file. Their arguments are the file and an optional
topic."""
TRAJECTORY_ENDINGS = (".json", ".csv")
"""Endings that `Trajectory.save` writes."""


def check_export(file: str | Path, *inputs: str) -> Path:
    """The file as a path. Its format must be known, the package of the format installed, and the file
    writable; whether an existing bag folder is writable is not checked.

    Raises InputError for an ending that is not in WRITERS or TRAJECTORY_ENDINGS, for a package that is not
    installed, for a folder that is missing or read-only, and if the file is one of `inputs`.
    """
    path = file_name(file)
    ending = path.suffix.lower()
    if ending in WRITERS:
        WRITERS.load(ending)
    if path.is_dir() and ending == BAG:
        return path
    return check_output(path, (*TRAJECTORY_ENDINGS, *WRITERS), *inputs)


def write_motion(problem: "Problem", trajectory: Trajectory, file: str | Path) -> None:
    """Write a motion and its problem in the format of the file's ending, one of WRITERS or
    TRAJECTORY_ENDINGS.

    Raises InputError for arguments of another type, for joints that are not those of the problem, for
    rows less than 1 ns apart in the formats of ROS, and as `check_export` does.
    """
    from robotdiffuse.problems.problem import check_problem
    from robotdiffuse.robots.robot import check_joints

    check_problem(problem)
    check_type("trajectory", trajectory, Trajectory, "a Trajectory, such as rd.plan(problem).trajectory")
    check_joints("trajectory", trajectory.joint_names, problem.robot)
    path = check_export(file)
    if path.suffix.lower() in TRAJECTORY_ENDINGS:
        trajectory.save(path)
    else:
        WRITERS.load(path.suffix.lower())(problem, trajectory, path)


def read_motion(file: str | Path, topic: str | None = None) -> "RecordedMotion":
    """Read a motion from a file of any program; a folder is read as a ROS 2 bag.

    Raises InputError for an ending that is not in READERS, a file that is missing or damaged, or holds
    no motion or several, a topic that holds no motion, and a package that is not installed.
    """
    path = file_name(file)
    ending = BAG if path.is_dir() else path.suffix.lower()
    if ending == ".db3":
        raise InputError(f"{path} is part of a ROS 2 bag; give the folder that contains it")
    read: Callable[..., RecordedMotion] = READERS.load(ending)
    return read(path, topic)
