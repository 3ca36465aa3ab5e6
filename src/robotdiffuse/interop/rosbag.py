"""Reads and writes ROS 2 bags (folders with metadata.yaml and a database) without ROS."""

import sqlite3
import sys
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory

from robotdiffuse.core.errors import InputError, OutputError, missing_package, reading, shown
from robotdiffuse.core.input_files import input_file, read_yaml
from robotdiffuse.core.output_files import write_error
from robotdiffuse.core.types import Trajectory
from robotdiffuse.interop.mcap_file import MAX_UNPACKED, check_chunks, make_reader
from robotdiffuse.interop.recorded_motion import RecordedMotion, joint_trajectory
from robotdiffuse.interop.ros_messages import (
    DISPLAY_TRAJECTORY,
    JOINT_TRAJECTORY,
    choose_topic,
    display_trajectory,
    motion_from_messages,
    to_message,
    typestore,
)
from robotdiffuse.problems.problem import Problem

try:
    from rosbags.highlevel import AnyReader
    from rosbags.rosbag2 import Writer
except ImportError:
    raise missing_package("rosbags", "ros") from None

VERSION = 9
"""Version of the bag's metadata; ROS 2 Humble reads the fields that it knows."""


def write(problem: Problem, trajectory: Trajectory, file: Path) -> None:
    """Write a JointTrajectory on /joint_trajectory and a DisplayTrajectory on /display_planned_path, which
    RViz's MoveIt plugin shows. An existing bag is replaced; see `interop.write_motion`."""
    if file.exists() and not (file / "metadata.yaml").is_file():
        raise InputError(f"{file} cannot be written: it exists and is not a ROS 2 bag")
    record = joint_trajectory(trajectory.joint_names, trajectory)
    topics = {
        "/joint_trajectory": (JOINT_TRAJECTORY, record),
        "/display_planned_path": (DISPLAY_TRAJECTORY, display_trajectory(problem, trajectory, record)),
    }
    try:
        with TemporaryDirectory(prefix=f".{file.name}.", dir=file.parent, ignore_cleanup_errors=True) as part:
            new = Path(part, file.name)
            old = Path(part, "old")
            with Writer(new, version=VERSION) as writer:  # it names the database after the folder
                for topic, (kind, content) in topics.items():
                    connection = writer.add_connection(topic, kind, typestore=typestore())
                    writer.write(connection, 0, typestore().serialize_cdr(to_message(kind, content), kind))
            _replace(file, new, old)
    except sqlite3.Error as error:
        raise OutputError(f"{file} cannot be written: {error}") from None
    except OSError as error:
        raise write_error(file, error) from None


def _replace(file: Path, new: Path, old: Path) -> None:
    """Move an existing bag, or a link to one, to `old`, and `new` to its place; if that fails, move it
    back."""
    try:
        with suppress(FileNotFoundError):
            file.replace(old)
        new.replace(file)
    except BaseException:
        with suppress(OSError):
            old.replace(file)
        raise


def read(file: Path, topic: str | None = None) -> RecordedMotion:
    """Read the motion on a topic; see `choose_topic`."""
    if not (file / "metadata.yaml").is_file():
        raise InputError(f"{file} is not a ROS 2 bag: it has no metadata.yaml")
    for part in file.iterdir():
        if not part.is_dir():
            input_file(part, largest=sys.maxsize)
    with reading(file):
        _check_unpacking(file)
        with AnyReader([file], default_typestore=typestore()) as reader:
            topics = {connection.topic: connection.msgtype for connection in reader.connections}
            name = choose_topic(topics, topic, str(file))
            chosen = [connection for connection in reader.connections if connection.topic == name]
            messages = []
            size = 0
            for connection, at, raw in reader.messages(chosen):
                size += len(raw)
                if size > MAX_UNPACKED:
                    raise InputError(f"the messages of {name} take more than {MAX_UNPACKED:,} bytes")
                messages.append((at, reader.deserialize(raw, connection.msgtype)))
            return motion_from_messages(topics[name], messages, f"{file}, {name}")


def _check_unpacking(bag: Path) -> None:
    """Refuse what may unpack to gigabytes."""
    information = read_yaml(bag / "metadata.yaml")["rosbag2_bagfile_information"]
    if mode := information.get("compression_mode"):
        raise InputError(f"{bag} is compressed (mode {shown(mode)}); write it anew with: ros2 bag convert")
    for part in bag.glob("*.mcap"):
        with part.open("rb") as stream:
            check_chunks(stream, make_reader(stream), str(part))
