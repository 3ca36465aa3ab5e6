"""ROS 2 without ROS: messages, MCAP files and bags (folders with metadata.yaml and a database). Reads also
bags that hold MCAP files, and ROS 1 bags.

In MCAP files, three kinds of topics hold Foxglove messages: /scene has the obstacles, and the arm as
triangles that are fixed to its links; /tf has the poses of the base, links and moving obstacles; /points/NAME
has a point cloud. /joint_trajectory, /display_planned_path, /joint_states and /robot_description hold ROS 2
messages. /robot_description is the URDF, if the robot was read from one. The URDF and the problem are also
attached as files.
"""

import bz2
import io
import json
import os
import sqlite3
import struct
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from robotdiffuse.core.errors import InputError, OutputError, joined, needs, reading, shown
from robotdiffuse.core.files import (
    MAX_FILE_SIZE,
    MEGABYTE,
    JsonObject,
    input_file,
    parse_json,
    read_yaml,
    replaced_folder,
    write_atomically,
)
from robotdiffuse.core.transforms import xyzw_of
from robotdiffuse.core.types import Configuration, Pose, Trajectory
from robotdiffuse.drawables import Color, Drawable, Surface, drawables, link_surfaces
from robotdiffuse.interop.recorded_motion import (
    JOINT_TRAJECTORY,
    RecordedMotion,
    checked_motion,
    joint_trajectory,
    motion_from_record,
    time_message,
)
from robotdiffuse.problems.files import problem_from_record, problem_record
from robotdiffuse.problems.problem import Problem
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.shapes import Box, Cylinder, PointCloud, Sphere

with needs("mcap, mcap-protobuf-support, foxglove-schemas-protobuf and rosbags", "ros"):
    import lz4.frame
    import zstandard
    from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
    from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud as PointCloudMessage
    from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
    from mcap.reader import McapReader, make_reader
    from mcap.writer import MCAP0_MAGIC, Writer
    from mcap_protobuf.schema import register_schema
    from rosbags.highlevel import AnyReader
    from rosbags.rosbag1 import Reader as Ros1Reader
    from rosbags.rosbag2 import Writer as BagWriter
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    from rosbags.typesys.store import Typestore


ROBOT_TRAJECTORY = "moveit_msgs/msg/RobotTrajectory"
DISPLAY_TRAJECTORY = "moveit_msgs/msg/DisplayTrajectory"
JOINT_STATE = "sensor_msgs/msg/JointState"
STRING = "std_msgs/msg/String"

# Message definitions of moveit_msgs and object_recognition_msgs (ROS 2), by name.
MOVEIT = {
    "object_recognition_msgs/msg/ObjectType": "string key\nstring db",
    "moveit_msgs/msg/CollisionObject": (
        "std_msgs/Header header\ngeometry_msgs/Pose pose\nstring id\n"
        "object_recognition_msgs/ObjectType type\n"
        "shape_msgs/SolidPrimitive[] primitives\ngeometry_msgs/Pose[] primitive_poses\n"
        "shape_msgs/Mesh[] meshes\ngeometry_msgs/Pose[] mesh_poses\n"
        "shape_msgs/Plane[] planes\ngeometry_msgs/Pose[] plane_poses\n"
        "string[] subframe_names\ngeometry_msgs/Pose[] subframe_poses\n"
        "byte ADD=0\nbyte REMOVE=1\nbyte APPEND=2\nbyte MOVE=3\nbyte operation"
    ),
    "moveit_msgs/msg/AttachedCollisionObject": (
        "string link_name\nCollisionObject object\nstring[] touch_links\n"
        "trajectory_msgs/JointTrajectory detach_posture\nfloat64 weight"
    ),
    "moveit_msgs/msg/RobotState": (
        "sensor_msgs/JointState joint_state\nsensor_msgs/MultiDOFJointState multi_dof_joint_state\n"
        "AttachedCollisionObject[] attached_collision_objects\nbool is_diff"
    ),
    ROBOT_TRAJECTORY: (
        "trajectory_msgs/JointTrajectory joint_trajectory\n"
        "trajectory_msgs/MultiDOFJointTrajectory multi_dof_joint_trajectory"
    ),
    DISPLAY_TRAJECTORY: ("string model_id\nRobotTrajectory[] trajectory\nRobotState trajectory_start"),
}


@cache
def typestore() -> Typestore:
    """The message types of ROS 2 Humble and MoveIt."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    types = dict[str, Any]()
    for name, definition in MOVEIT.items():
        types |= get_types_from_msg(definition, name)
    store.register(types)
    return store


def to_message(kind: str, record: Mapping[str, Any]) -> Any:
    """A message from plain data; missing fields are empty or zero."""
    store = typestore()
    return store.types[kind](
        **{name: _value(definition, record.get(name)) for name, definition in store.fielddefs[kind][1]}
    )


def _value(definition: Any, value: Any) -> Any:
    node = int(definition[0])
    detail = definition[1]
    if node == 1:  # a base type
        return value or ("" if detail[0] == "string" else 0)
    if node == 2:  # a message
        return to_message(detail, value or {})
    element = detail[0]
    items = [] if value is None else value
    if int(element[0]) == 1 and element[1][0] not in ("string", "bool"):
        return np.asarray(items, dtype=element[1][0].replace("byte", "uint8"))
    return [_value(element, item) for item in items]


def to_plain(message: Any) -> JsonObject:
    """A message as plain data."""
    return asdict(
        message,
        dict_factory=lambda items: {
            name: value.tolist() if isinstance(value, np.ndarray) else value for name, value in items
        },
    )


def joint_state(robot: Robot, q: Configuration, at: int) -> JsonObject:
    """A JointState in plain data, with the locked joints. at: time [ns]."""
    names = [*robot.joint_names, *robot.locked]
    positions = [*q.tolist(), *robot.locked.values()]
    return {"header": {"stamp": time_message(at)}, "name": names, "position": positions}


def display_trajectory(problem: Problem, trajectory: Trajectory, record: Mapping[str, Any]) -> JsonObject:
    """A DisplayTrajectory in plain data: the JointTrajectory `record`, and the arm's start state."""
    robot = problem.robot
    return {
        "model_id": robot.name,
        "trajectory": [{"joint_trajectory": record}],
        "trajectory_start": {"joint_state": joint_state(robot, trajectory.positions[0], 0)},
    }


def header_seconds(stamp: Mapping[str, Any], logged: int = 0) -> float:
    """The time stamp of a message header [s]; the log time if the message has no stamp. logged: the log time
    [ns]."""
    return (stamp["sec"] + 1e-9 * stamp["nanosec"]) or 1e-9 * logged


def choose_topic(topics: Mapping[str, str], requested: str | None, where: str) -> str:
    """The topic to read a motion from, given all topics and their types.

    It is `requested` if that is given. Otherwise, the types JointTrajectory, RobotTrajectory,
    DisplayTrajectory and JointState are tried in this order, and the first one that occurs must have a single
    topic. Raises InputError if there is no topic `requested` or it has none of these types, if no topic has
    one of them, and if several topics have the type that is chosen.
    """
    kinds = (JOINT_TRAJECTORY, ROBOT_TRAJECTORY, DISPLAY_TRAJECTORY, JOINT_STATE)
    listed = ", ".join(f"{topic} ({kind})" for topic, kind in topics.items()) or "none"
    if requested is not None:
        if topics.get(requested) not in kinds:
            raise InputError(f"{where}: topic {requested!r} holds no motion; topics: {listed}")
        return requested
    for kind in kinds:
        candidates = [topic for topic, topic_kind in topics.items() if topic_kind == kind]
        if len(candidates) > 1:
            raise InputError(
                f"{where}: several topics hold motions: {', '.join(candidates)}; choose one with --topic"
            )
        if candidates:
            return candidates[0]
    raise InputError(f"{where} holds no motion; topics: {listed}; known types: {', '.join(kinds)}")


def motion_from_messages(kind: str, messages: list[tuple[int, Any]], where: str) -> RecordedMotion:
    """The motion in messages of one type: a single trajectory message, or a series of joint states.

    messages: log time [ns] and message. Raises InputError, naming `where`, if there is no motion or more than
    one, and for damaged motions.
    """
    if not messages:
        raise InputError(f"{where} holds no messages")
    if kind != JOINT_STATE:
        if len(messages) > 1:
            raise InputError(f"{where} holds {len(messages)} motions; one is validated at a time")
        return motion_from_record(to_plain(messages[0][1]), where)
    states = [to_plain(message) for _, message in messages]
    names = states[0]["name"]
    stamps = [header_seconds(state["header"]["stamp"]) for state in states]
    if not any(stamps):
        stamps = [1e-9 * (at - messages[0][0]) for at, _ in messages]
    rows: dict[str, list[list[float]]] = {"position": [], "velocity": []}
    for i, state in enumerate(states):
        if sorted(state["name"]) != sorted(names):
            mistake = f"joint state {i} has the joints {joined(state['name'])}"
            raise InputError(f"{where}: {mistake}; the first has {joined(names)}; all must have the same")
        order = [state["name"].index(name) for name in names]
        for quantity, column in rows.items():
            column.append([state[quantity][k] for k in order] if len(state[quantity]) == len(names) else [])
    has_values = [len(row) > 0 for row in rows["velocity"]]
    if any(has_values) and not all(has_values):
        i = has_values.index(False)
        mistake = f"joint state {i} has {len(states[i]['velocity'])} velocities for {len(names)} joints"
        raise InputError(
            f"{where}: {mistake}, other states have one for each; all must have one for each joint, or none"
        )
    velocities = rows["velocity"] if all(has_values) else None
    times = [stamp - stamps[0] for stamp in stamps]
    with reading(where):
        return checked_motion(names, rows["position"], times, velocities)


# MCAP files

FLOAT32 = 7
"""foxglove.PackedElementField.FLOAT32"""
MAX_UNPACKED = 128 * MEGABYTE
"""Largest size of a chunk, and of the messages of a motion [bytes]."""
CHUNK_HEADER = 1 + 8 + 3 * 8 + 4
"""Number of bytes of a chunk before the name of its compression: opcode, length, times, size and checksum."""
FRAME_HEADER = 32
"""Number of bytes at the beginning of a compressed frame that contain its header."""
OBSTACLE_OPACITY = 0.8
PROBLEM_ATTACHMENT = "problem.json"
"""Name of the attachment that holds the problem."""


class McapWriter:
    """Writes Protobuf and ROS 2 messages to one MCAP file."""

    def __init__(self, stream: io.BytesIO | io.BufferedWriter) -> None:
        self.writer = Writer(stream)
        self.writer.start(profile="", library="robotdiffuse")
        self._channels = dict[str, int]()

    def protobuf(self, topic: str, content: Any, at: int) -> None:
        if topic not in self._channels:
            schema = register_schema(self.writer, type(content))
            self._channels[topic] = self.writer.register_channel(topic, "protobuf", schema)
        self._add(topic, content.SerializeToString(), at)

    def ros(self, topic: str, kind: str, content: JsonObject, at: int) -> None:
        if topic not in self._channels:
            text, _ = typestore().generate_msgdef(kind, ros_version=2)
            schema = self.writer.register_schema(kind, "ros2msg", text.encode())
            self._channels[topic] = self.writer.register_channel(topic, "cdr", schema)
        self._add(topic, bytes(typestore().serialize_cdr(to_message(kind, content), kind)), at)

    def _add(self, topic: str, data: bytes, at: int) -> None:
        self.writer.add_message(self._channels[topic], log_time=at, data=data, publish_time=at)


def write_mcap(problem: Problem, trajectory: Trajectory, file: Path) -> None:
    """Write the scene and the motion; see `interop.write_motion` and the module's description."""
    robot = problem.robot
    stream = io.BytesIO()
    out = McapWriter(stream)
    obstacles = drawables(problem.scene, problem.moving)
    out.protobuf("/scene", _scene(robot, obstacles), 0)
    for shape in problem.scene.shapes:
        if isinstance(shape, PointCloud):
            out.protobuf(f"/points/{shape.name}", _cloud(shape, robot.base), 0)
    record = joint_trajectory(trajectory)
    out.ros("/joint_trajectory", JOINT_TRAJECTORY, record, 0)
    out.ros("/display_planned_path", DISPLAY_TRAJECTORY, display_trajectory(problem, trajectory, record), 0)
    urdf = _urdf(robot.source)
    if urdf is not None:
        out.ros("/robot_description", STRING, {"data": urdf.decode("utf-8", "replace")}, 0)
        out.writer.add_attachment(0, 0, "robot.urdf", "application/xml", urdf)
    try:
        content = json.dumps(problem_record(problem)).encode()
        out.writer.add_attachment(0, 0, PROBLEM_ATTACHMENT, "application/json", content)
    except InputError:
        pass  # a robot that was made or changed in Python has no problem file
    poses = {link: robot.fk(trajectory.positions, link) for link in robot.link_names if link != robot.base}
    for i, t in enumerate(trajectory.times.tolist()):
        at = round(1e9 * t)
        frames = {link: T[i] for link, T in poses.items()}
        frames |= {
            _frame(obstacle, robot): obstacle.frame(t)
            for obstacle in obstacles
            if obstacle.moving is not None
        }
        out.protobuf("/tf", _transforms(problem, frames, at), at)
        rates = [*trajectory.velocities[i].tolist(), *(0.0 for _ in robot.locked)]
        state = joint_state(robot, trajectory.positions[i], at) | {"velocity": rates}
        out.ros("/joint_states", JOINT_STATE, state, at)
    out.writer.finish()
    write_atomically(file, stream.getvalue())


def _urdf(source: str | None) -> bytes | None:
    """The URDF that the robot was read from; None if it was not read from one, or the file is gone."""
    if source is None or not source.endswith(".urdf"):
        return None
    try:
        return input_file(source).read_bytes()
    except (InputError, OSError):
        return None


def _frame(obstacle: Drawable, robot: Robot) -> str:
    """The frame that an obstacle is fixed to."""
    return robot.base if obstacle.moving is None else f"moving/{obstacle.name}"


def _set(vector: Any, values: Sequence[float]) -> None:
    """Set the fields x, y and z of a message, and w if there is a fourth value."""
    for axis, value in zip("xyzw", values, strict=False):
        setattr(vector, axis, value)


def _scene(robot: Robot, obstacles: Sequence[Drawable]) -> SceneUpdate:
    update = SceneUpdate()

    def entity(name: str, frame: str) -> Any:
        return update.entities.add(id=name, frame_id=frame, frame_locked=True)

    for obstacle in obstacles:
        if isinstance(obstacle.shape, PointCloud):
            continue
        drawing = entity(obstacle.name, _frame(obstacle, robot))
        shape = obstacle.fixed.shape
        match shape:
            case Box():
                size = shape.size.tolist()
                solid = drawing.cubes.add()
            case Sphere():
                size = [2 * shape.radius] * 3
                solid = drawing.spheres.add()
            case Cylinder():
                size = [2 * shape.radius, 2 * shape.radius, shape.height]
                solid = drawing.cylinders.add(bottom_scale=1.0, top_scale=1.0)
            case _:
                _add_triangles(drawing, obstacle.fixed.surface, obstacle.color, OBSTACLE_OPACITY)
                continue
        _set(solid.size, size)
        _set(solid.pose.position, shape.T_base_shape[:3, 3].tolist())
        _set(solid.pose.orientation, xyzw_of(shape.T_base_shape).tolist())
        _set_color(solid.color, obstacle.color, OBSTACLE_OPACITY)
    for link, surface in link_surfaces(robot).items():
        for color, part in surface.by_color:
            _add_triangles(entity("{}/{:02x}{:02x}{:02x}".format(link, *color), link), part, color, 1.0)
    return update


def _add_triangles(entity: Any, surface: Surface, color: Color, opacity: float) -> None:
    """Add a surface in the frame of an entity. To save space, vertices that are equal in single precision are
    written once."""
    points, number = np.unique(surface.vertices.astype(np.float32), axis=0, return_inverse=True)
    triangles = entity.triangles.add()
    triangles.pose.orientation.w = 1.0
    for x, y, z in points.tolist():
        triangles.points.add(x=x, y=y, z=z)
    triangles.indices.extend(number.reshape(-1)[surface.faces.ravel()].tolist())
    _set_color(triangles.color, color, opacity)


def _set_color(message: Any, color: Color, opacity: float) -> None:
    message.r, message.g, message.b = (part / 255 for part in color)
    message.a = opacity


def _cloud(cloud: PointCloud, frame: str) -> PointCloudMessage:
    message = PointCloudMessage(frame_id=frame, point_stride=12)
    message.pose.orientation.w = 1.0
    for k, axis in enumerate("xyz"):
        message.fields.add(name=axis, offset=4 * k, type=FLOAT32)
    message.data = cloud.points.astype("<f4").tobytes()
    return message


def _transforms(problem: Problem, poses: dict[str, Pose], at: int) -> FrameTransforms:
    """A message with the poses of frames. poses: the pose, in the base frame, of each moving obstacle
    and of each link other than the base. at: time [ns]."""
    update = FrameTransforms()
    robot = problem.robot
    frames = {frame: (robot.base, T) for frame, T in poses.items()}
    if problem.T_world_base is not None:
        frames[robot.base] = ("world", problem.T_world_base)
    for frame, (parent, T) in frames.items():
        transform = update.transforms.add(parent_frame_id=parent, child_frame_id=frame)
        transform.timestamp.FromNanoseconds(at)
        _set(transform.translation, T[:3, 3].tolist())
        _set(transform.rotation, xyzw_of(T).tolist())
    return update


def problem_in(file: Path) -> Problem | None:
    """The problem that `write_mcap` attached; None if there is none."""
    path = input_file(file)
    with reading(file), path.open("rb") as stream:
        reader = checked_reader(stream, str(file))
        attached = {attachment.name: attachment.data for attachment in reader.iter_attachments()}
        if PROBLEM_ATTACHMENT not in attached:
            return None
        record = parse_json(attached[PROBLEM_ATTACHMENT].decode(), f"{file}, {PROBLEM_ATTACHMENT}")
        return problem_from_record(record)


def checked_reader(stream: io.BufferedReader, where: str) -> McapReader:
    """The reader of an MCAP file.

    Raises InputError, naming `where`, if the file does not end as MCAP files do, and if the index or the head
    of a chunk states more than MAX_UNPACKED unpacked bytes, since small files may unpack to gigabytes.
    """
    stream.seek(-min(len(MCAP0_MAGIC), os.fstat(stream.fileno()).st_size), io.SEEK_END)
    if stream.read() != MCAP0_MAGIC:
        advice = "`mcap recover` writes what is left to a new file"
        raise InputError(f"{where} is no MCAP file or was cut short; {advice}")
    stream.seek(0)
    reader = make_reader(stream)
    summary = reader.get_summary()
    for chunk in summary.chunk_indexes if summary else ():
        stream.seek(chunk.chunk_start_offset + CHUNK_HEADER)
        (length,) = struct.unpack("<I", stream.read(4))
        compression = stream.read(length)
        stream.seek(8, io.SEEK_CUR)
        start = stream.read(FRAME_HEADER)
        size = chunk.uncompressed_size
        if compression == b"zstd":
            size = max(size, zstandard.frame_content_size(start))
        elif compression == b"lz4":
            size = max(size, lz4.frame.get_frame_info(start)["content_size"])
        if size > MAX_UNPACKED:
            raise InputError(f"{where} has a chunk of {size:,} bytes; {MAX_UNPACKED:,} are allowed")
    return reader


def _types_of(schema: Any) -> Any:
    """A store with the message types of a topic, as the file defines them; without ros2msg, `typestore`."""
    if schema.encoding != "ros2msg":
        return typestore()
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(schema.data.decode(), schema.name))
    return store


# Bags

DECOMPRESSORS: dict[Any, Any] = {
    bz2.decompress: bz2.BZ2Decompressor,
    lz4.frame.decompress: lz4.frame.LZ4FrameDecompressor,
}
"""For each function by which rosbags unpacks a chunk of a ROS 1 bag, a decompressor that can stop before the
end of the chunk."""
VERSION = 9
"""Version of the bag's metadata. ROS 2 Humble writes an older version, and ignores fields that it does not
know."""


def write_bag(problem: Problem, trajectory: Trajectory, file: Path) -> None:
    """Write a JointTrajectory on /joint_trajectory and a DisplayTrajectory on /display_planned_path, which
    RViz's MoveIt plugin shows. An existing bag is replaced; see `interop.write_motion`."""
    if file.exists() and not (file / "metadata.yaml").is_file():
        raise InputError(f"{file} cannot be written: it exists and is not a ROS 2 bag")
    record = joint_trajectory(trajectory)
    topics = {
        "/joint_trajectory": (JOINT_TRAJECTORY, record),
        "/display_planned_path": (DISPLAY_TRAJECTORY, display_trajectory(problem, trajectory, record)),
    }
    try:
        # the writer names the database after `new`, which has the same name as `file`
        with replaced_folder(file) as new, BagWriter(new, version=VERSION) as writer:
            for topic, (kind, content) in topics.items():
                connection = writer.add_connection(topic, kind, typestore=typestore())
                writer.write(connection, 0, typestore().serialize_cdr(to_message(kind, content), kind))
    except sqlite3.Error as error:
        raise OutputError(f"{file} cannot be written: {error}") from None


@contextmanager
def _opened_bag(file: Path) -> Iterator[AnyReader]:
    """A reader of a ROS 1 bag or of the folder of a ROS 2 bag. Raises InputError for a folder without
    metadata.yaml, for parts that are not regular files, for a compressed ROS 2 bag, and for chunks that
    unpack to more than MAX_UNPACKED bytes."""
    if file.is_dir():
        if not (file / "metadata.yaml").is_file():
            raise InputError(f"{file} is not a ROS 2 bag: it has no metadata.yaml")
        for part in file.iterdir():
            if not part.is_dir():
                input_file(part, largest=sys.maxsize)
        _check_unpacking(file)
    else:
        input_file(file, largest=sys.maxsize)
    with AnyReader([file], default_typestore=typestore()) as reader:
        for bag in reader.readers:
            if isinstance(bag, Ros1Reader):
                bag.chunks |= {
                    at: chunk._replace(decompressor=partial(_bounded, chunk.decompressor))
                    for at, chunk in bag.chunks.items()
                }
        yield reader


def _bounded(decompressor: Callable[[bytes], bytes], packed: bytes) -> bytes:
    """The unpacked content of a chunk of a ROS 1 bag. Raises InputError if it is larger than MAX_UNPACKED
    bytes."""
    make = DECOMPRESSORS.get(decompressor)
    content = packed if make is None else make().decompress(packed, MAX_UNPACKED + 1)
    if len(content) > MAX_UNPACKED:
        raise InputError(f"the bag has a chunk of more than {MAX_UNPACKED:,} bytes")
    return content


def _check_unpacking(bag: Path) -> None:
    """Raise InputError for a ROS 2 bag that may unpack to gigabytes: a compressed one, or one with large
    chunks."""
    information = read_yaml(bag / "metadata.yaml")["rosbag2_bagfile_information"]
    if mode := information.get("compression_mode"):
        raise InputError(f"{bag} is compressed (mode {shown(mode)}); write it anew with: ros2 bag convert")
    for part in bag.glob("*.mcap"):
        with part.open("rb") as stream:
            checked_reader(stream, str(part))


# Motions in MCAP files and bags

Record = tuple[str, int, bytes, Callable[[bytes], Any]]
"""A message of a bag: its topic, log time [ns] and bytes, and the function that decodes the bytes."""


class Recording(NamedTuple):
    """An open MCAP file or bag."""

    kinds: dict[str, str]
    """Type of the ROS messages, by topic."""
    records: Callable[[Sequence[str]], Iterator[Record]]
    """A function from topics to the messages on these topics, in the order of their log times."""

    def messages(self, topics: Sequence[str], allowed: int = sys.maxsize) -> Iterator[tuple[str, int, Any]]:
        """Topic, log time [ns] and message of all messages on some topics, in the order of their log times.

        allowed: largest size of all the messages together [bytes]; raises InputError beyond it.
        """
        bytes_left = allowed
        for topic, at, content, read in self.records(topics) if topics else ():
            bytes_left -= len(content)
            if bytes_left < 0:
                raise InputError(f"the messages of {', '.join(topics)} take more than {allowed:,} bytes")
            yield topic, at, read(content)


@contextmanager
def opened_recording(file: Path, largest: int = MAX_FILE_SIZE) -> Iterator[Recording]:
    """An MCAP file of at most `largest` bytes, a ROS 1 bag, or the folder of a ROS 2 bag."""
    if file.is_dir() or file.suffix == ".bag":
        with _opened_bag(file) as bag:

            def of_bag(topics: Sequence[str]) -> Iterator[Record]:
                for connection, at, raw in bag.messages(
                    [connection for connection in bag.connections if connection.topic in topics]
                ):
                    yield connection.topic, at, raw, partial(bag.deserialize, typ=connection.msgtype)

            yield Recording({connection.topic: connection.msgtype for connection in bag.connections}, of_bag)
        return
    with input_file(file, largest=largest).open("rb") as stream:
        reader = checked_reader(stream, str(file))
        summary = reader.get_summary()
        if summary is None:
            raise InputError(f"{file} is damaged: it ends before its summary")
        schemas = {
            channel.topic: summary.schemas[channel.schema_id]
            for channel in summary.channels.values()
            if channel.message_encoding == "cdr" and channel.schema_id in summary.schemas
        }

        kinds = {topic: schema.name for topic, schema in schemas.items()}

        def of_file(topics: Sequence[str]) -> Iterator[Record]:
            stores = {topic: _types_of(schemas[topic]) for topic in topics}
            for _, channel, message in reader.iter_messages(topics=topics):
                read = partial(stores[channel.topic].deserialize_cdr, typename=kinds[channel.topic])
                yield channel.topic, message.log_time, message.data, read

        yield Recording(kinds, of_file)


def read_recording(file: Path, topic: str | None) -> RecordedMotion:
    """Read the motion on a topic of an MCAP file or bag; see `choose_topic`."""
    with reading(file), opened_recording(file) as recording:
        name = choose_topic(recording.kinds, topic, str(file))
        messages = [(at, message) for _, at, message in recording.messages([name], MAX_UNPACKED)]
        return motion_from_messages(recording.kinds[name], messages, f"{file}, {name}")
