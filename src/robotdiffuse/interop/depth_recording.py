"""Reads and writes depth images with camera parameters, poses and joint states in MCAP files, as ROS 2
messages; reads them from ROS 1 and ROS 2 bags too.

A camera NAME has its images (sensor_msgs/Image) and parameters (sensor_msgs/CameraInfo) on topics of one
folder, such as /NAME/depth/image_rect_raw and /NAME/depth/camera_info. Its pose is the transform from the
arm's base to the `frame_id` of the images (tf2_msgs/TFMessage on /tf and /tf_static), and the arm's
configuration is in sensor_msgs/JointState. Bags of librealsense have only images and parameters:
/device_0/sensor_0/Depth_0/image/data and .../info/camera_info.
"""

import io
from bisect import bisect_left, insort
from collections.abc import Iterator, Mapping, Sequence
from operator import itemgetter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation, Slerp

from robotdiffuse.core.errors import InputError, check_list, reading, unit_quaternion
from robotdiffuse.core.files import JsonObject, file_name, write_atomically
from robotdiffuse.core.transforms import quaternion_from_rotation, rotation_from_quaternion, transform
from robotdiffuse.core.types import Configuration, JointValues, Pose
from robotdiffuse.interop.recorded_motion import time_message
from robotdiffuse.interop.ros2 import (
    JOINT_STATE,
    McapWriter,
    Recording,
    header_seconds,
    joint_state,
    opened_recording,
    to_plain,
)
from robotdiffuse.perception.depth_view import INTEGER_NO_RETURN, DepthView, Intrinsics
from robotdiffuse.robots.robot import Robot, check_robot

IMAGE = "sensor_msgs/msg/Image"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
TRANSFORMS = "tf2_msgs/msg/TFMessage"
MEASURED = "/joint_states"
"""If several topics hold the arm's joint states, only those of this topic are read."""
ENCODINGS = {"32FC1": ("f4", 1.0), "16UC1": ("u2", 0.001), "mono16": ("u2", 0.001)}
"""For each encoding of depth images, the type of the pixels and the meters per unit (REP 118)."""
MAX_SIZE = 64 * 10**9
"""Largest size of an .mcap file [bytes]; bags may be larger."""
MAX_GAP = 0.1
"""Joint states and transforms are interpolated between two messages that are at most this far from the image
in time [s]."""


class StampedView(NamedTuple):
    stamp: float
    """Time at which the image was taken [s]."""
    view: DepthView


def write_depth_views(robot: Robot, views: Mapping[str, Sequence[StampedView]], file: str | Path) -> None:
    """Write views as .mcap. views: the views of each camera, by its name; each view must have a
    configuration.

    Joint states and transforms are written only at the stamps of the images.
    """
    stream = io.BytesIO()
    out = McapWriter(stream)
    ordered = sorted(
        (
            (recorded.stamp, name, recorded.view)
            for name, views_of_camera in views.items()
            for recorded in views_of_camera
        ),
        key=itemgetter(0),
    )
    for stamp, name, view in ordered:
        at = round(1e9 * stamp)
        if view.configuration is None:
            raise InputError(f"the view of {name} at {stamp:g} s has no configuration")
        frame = f"{name}_depth_optical_frame"
        header = {"stamp": time_message(at), "frame_id": frame}
        out.ros("/joint_states", JOINT_STATE, joint_state(robot, view.configuration, at), at)
        stamped = _transform(robot.base, frame, header["stamp"], view.T_base_camera)
        out.ros("/tf", TRANSFORMS, {"transforms": [stamped]}, at)
        out.ros(f"/{name}/depth/camera_info", CAMERA_INFO, _camera_info(header, view), at)
        out.ros(f"/{name}/depth/image_rect_raw", IMAGE, _image(header, view), at)
    out.writer.finish()
    write_atomically(Path(file), stream.getvalue())


def _transform(parent: str, child: str, stamp: dict[str, int], T: Pose) -> JsonObject:
    w, x, y, z = quaternion_from_rotation(T).tolist()
    place = dict(zip("xyz", T[:3, 3].tolist(), strict=True))
    return {
        "header": {"stamp": stamp, "frame_id": parent},
        "child_frame_id": child,
        "transform": {"translation": place, "rotation": {"x": x, "y": y, "z": z, "w": w}},
    }


def _camera_info(header: JsonObject, view: DepthView) -> JsonObject:
    fx, fy, cx, cy = view.intrinsics
    return {
        "header": header,
        "height": view.depth.shape[0],
        "width": view.depth.shape[1],
        "distortion_model": "plumb_bob",
        "d": [0.0] * 5,
        "k": [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0],
        "r": np.eye(3).ravel(),
        "p": [fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0],
    }


def _image(header: JsonObject, view: DepthView) -> JsonObject:
    height, width = view.depth.shape
    return {
        "header": header,
        "height": height,
        "width": width,
        "encoding": "32FC1",
        "is_bigendian": 0,
        "step": 4 * width,
        "data": np.frombuffer(view.depth.astype("<f4").tobytes(), np.uint8),
    }


def read_depth_views(
    file: str | Path,
    robot: Robot,
    topics: Sequence[str] | None = None,
    base: str | None = None,
    T_base_camera: ArrayLike | None = None,
) -> Iterator[StampedView]:
    """Read the depth images of a recording, as `Explorer.observe` takes them.

    Images are returned in the order of their log times, and must be rectified. The camera's pose and the
    arm's configuration are interpolated to the stamp of each image. Images without joint states or transforms
    within 0.1 s are left out.

    Args:
        file: An .mcap file, a ROS 1 bag (.bag, of librealsense too) or the folder of a ROS 2 bag.
        robot: The robot whose joint states the file holds.
        topics: Topics of the images; None: all with depth images (32FC1 in m, 16UC1 or mono16 in mm).
        base: The frame of the arm's base in the file; None: `robot.base`.
        T_base_camera: The pose of a fixed camera [4, 4], in place of the file's transforms. Views of a file
            without joint states then have no configuration.

    Returns:
        An iterator over the views, each with the stamp of its image [s].

    Raises:
        InputError: For a file that cannot be read or holds no uncompressed depth images, for a topic without
            images or with another encoding, if no image has joint states and transforms within 0.1 s, for an
            image without CameraInfo of its size, and for distorted images.

    Examples:
        >>> for stamp, view in rd.read_depth_views("recording.mcap", rd.load_robot("panda")):
        ...     print(f"{stamp:.1f} s: {view.depth.shape}")
        0.0 s: (48, 64)
        0.5 s: (48, 64)
    """
    path = file_name(file)
    check_robot(robot)
    if topics is not None:
        check_list("topics", topics, str, "names of topics", least=1)
    if path.suffix == ".db3":
        raise InputError(f"{path} is a part of a ROS 2 bag: give the folder with it and its metadata.yaml")
    with reading(file), opened_recording(path, MAX_SIZE) as recording:
        yield from _read(path, recording, robot, topics, base or robot.base, T_base_camera)


def _read(
    path: Path,
    recording: Recording,
    robot: Robot,
    topics: Sequence[str] | None,
    base: str,
    T_base_camera: ArrayLike | None,
) -> Iterator[StampedView]:
    kinds = recording.kinds
    images = _image_topics(kinds, topics)
    states_of = dict[str, _States]()
    transforms = TransformHistory()
    infos = dict[str, JsonObject]()
    units = dict[str, float]()
    has_states = JOINT_STATE in kinds.values()
    # topics with the meters per unit of a sensor's depth images, in bags of librealsense
    unit_topics = [name for name in kinds if name.replace(" ", "_").endswith("/option/Depth_Units/value")]
    other_topics = [name for name, kind in kinds.items() if kind in (JOINT_STATE, TRANSFORMS, CAMERA_INFO)]
    for topic, at, message in recording.messages(other_topics + unit_topics):
        kind = kinds[topic]
        if kind == CAMERA_INFO:  # fields are upper-case in ROS 1: K, D, P
            infos.setdefault(_folder(topic), {k.lower(): value for k, value in to_plain(message).items()})
        elif kind == JOINT_STATE:
            states_of.setdefault(topic, _States(robot)).add(_seconds(message, at), to_plain(message))
        elif kind == TRANSFORMS:
            for stamped in message.transforms:
                transforms.add(to_plain(stamped), topic.endswith("static"), at)
        else:
            units[topic.partition("/option/")[0]] = float(message.data)
    # several topics may hold the arm's joints, such as the measured and the commanded ones
    of_arm = {topic: states for topic, states in states_of.items() if states.known}
    if len(of_arm) > 1 and MEASURED not in of_arm:
        raise InputError(
            f"several topics hold joint states of {robot.name}: {', '.join(of_arm)}; the measured "
            f"ones must be on {MEASURED}"
        )
    states = of_arm.get(MEASURED) or next(iter(of_arm.values()), _States(robot))
    has_views = False
    first = ""
    reason: InputError | None = None
    for topic, at, message in recording.messages(images):
        if message.encoding not in ENCODINGS and topics is None:
            continue
        if T_base_camera is not None and topic != (first := first or topic):
            raise InputError(
                f"{first} and {topic} hold depth images, and T_base_camera is the pose of one camera: name "
                "its topic in topics"
            )
        stamp = _seconds(message, at)
        location = f"the image of {topic} at {stamp:.3f} s"
        try:
            T = T_base_camera
            if T is None:
                T = transforms.at(base, message.header.frame_id, stamp, location)
            q = states.at(stamp, location) if has_states or T_base_camera is None else None
        except InputError as error:
            reason = reason or error
            continue
        has_views = True
        intrinsics = _intrinsics(topic, infos.get(_folder(topic)), message)
        unit = next((unit for sensor, unit in units.items() if topic.startswith(f"{sensor}/")), None)
        yield StampedView(stamp, DepthView(_depth(location, message, unit), intrinsics, T, q))
    if not has_views:
        listed = ", ".join(f"{topic} ({kind})" for topic, kind in kinds.items()) or "none"
        raise reason or InputError(f"{path} holds no depth images ({', '.join(ENCODINGS)}); topics: {listed}")


def _image_topics(kinds: Mapping[str, str], requested: Sequence[str] | None) -> list[str]:
    image_topics = [topic for topic, kind in kinds.items() if kind == IMAGE]
    for topic in requested or ():
        if topic not in image_topics:
            raise InputError(
                f"topic {topic!r} holds no images; topics of images: {', '.join(image_topics) or 'none'}"
            )
    return image_topics if requested is None else list(requested)


def _folder(topic: str) -> str:
    """The part of a topic's name that images and CameraInfo of one camera have in common. librealsense puts
    each of the two into one more folder, `image` or `info`, which is left out."""
    folder, _, last = topic.rpartition("/")[0].rpartition("/")
    return folder if last in ("image", "info") else f"{folder}/{last}"


def _seconds(message: Any, logged: int) -> float:
    """The stamp of a message; its log time if the message has no stamp [s]."""
    return header_seconds(to_plain(message.header.stamp), logged)


def _intrinsics(topic: str, info: Any, image: Any) -> Intrinsics:
    if info is None:
        raise InputError(f"there is no CameraInfo in the folder {_folder(topic)} for {topic}")
    if (info["width"], info["height"]) != (image.width, image.height):
        raise InputError(
            f"images of {topic} have {image.width} x {image.height} pixels; their CameraInfo has "
            f"{info['width']} x {info['height']}"
        )
    if np.any(np.asarray(info["d"]) != 0) and "rect" not in topic.rpartition("/")[2]:
        raise InputError(f"images of {topic} are distorted; record the rectified ones (image_rect)")
    p = np.asarray(info["p"]).reshape(3, 4)
    k = np.asarray(info["k"]).reshape(3, 3)
    used = p if p[0, 0] else k
    return float(used[0, 0]), float(used[1, 1]), float(used[0, 2]), float(used[1, 2])


def _depth(where: str, image: Any, unit: float | None) -> Float[ndarray, "h w"]:
    """The depth image [m]. unit: meters per unit of integer pixels; None: the default of the encoding."""
    if image.encoding not in ENCODINGS:
        raise InputError(f"{where} has the encoding {image.encoding!r}; it must be {' or '.join(ENCODINGS)}")
    kind, scale = ENCODINGS[image.encoding]
    rows = np.asarray(image.data, np.uint8).reshape(image.height, image.step)
    size = np.dtype(kind).itemsize * image.width
    pixels = np.ascontiguousarray(rows[:, :size]).view((">" if image.is_bigendian else "<") + kind)
    pixels = pixels.reshape(image.height, image.width)  # fails if the rows are too short for the encoding
    if kind == "u2":
        scale = scale if unit is None else unit
        pixels = np.where(pixels == INTEGER_NO_RETURN, 0, pixels)
    return scale * pixels.astype(np.float32)


def around(history: list[tuple[float, Any]], stamp: float) -> tuple[Any, Any, float] | None:
    """The entries before and after a time, in a history sorted by time, and where the time is between them:
    0 at the first, 1 at the second. An entry at the time itself, or the only one within MAX_GAP of the time,
    is returned twice; None if there is none."""
    i = bisect_left(history, stamp, key=itemgetter(0))
    near = [row for row in history[max(i - 1, 0) : i + 1] if abs(row[0] - stamp) <= MAX_GAP]
    if not near:
        return None
    (t0, first), (t1, last) = near[0], near[-1]
    if t1 <= stamp or len(near) == 1:
        return last, last, 0.0
    return first, last, (stamp - t0) / (t1 - t0)


class TransformHistory:
    """Poses of frames relative to their parent frames, at the times when they were published."""

    def __init__(self) -> None:
        self._parent = dict[str, str]()
        self._static = set[str]()
        self._poses = dict[str, list[tuple[float, Pose]]]()
        """Sorted by time: messages may be logged in another order than that of their stamps."""

    def add(self, message: Mapping[str, Any], static: bool, logged: int = 0) -> None:
        """Add a geometry_msgs/TransformStamped, as plain data. logged: its log time [ns]."""
        child = message["child_frame_id"].lstrip("/")
        place = message["transform"]["translation"]
        turn = message["transform"]["rotation"]
        wxyz = unit_quaternion(f"transform of {child}", [turn[axis] for axis in "wxyz"], "rotation")
        T = transform(np.array([place[axis] for axis in "xyz"]), rotation_from_quaternion(wxyz))
        self._parent[child] = message["header"]["frame_id"].lstrip("/")
        if static:
            self._static.add(child)
        stamped = header_seconds(message["header"]["stamp"], logged), T
        insort(self._poses.setdefault(child, []), stamped, key=itemgetter(0))

    def at(self, base: str, frame: str, stamp: float, where: str) -> Pose:
        """T_base_frame at a time, interpolated between two transforms at most MAX_GAP from it.

        Raises InputError, naming `where`, if no chain of transforms leads from the base to the frame, or if a
        transform of the chain is not near in time.
        """
        T = np.eye(4)
        current = frame.lstrip("/")
        passed = [current]  # `frame` and its ancestors up to `current`
        while current != base.lstrip("/"):
            if current not in self._parent or len(passed) > len(self._parent) + 1:  # no parent, or a cycle
                raise InputError(
                    f"no transforms connect {frame}, the frame of {where}, with {base}; the ancestors of "
                    f"{frame} are {', '.join(passed[1:]) or 'none'}"
                )
            T = self._pose_in_parent(current, stamp, where) @ T
            current = self._parent[current]
            passed.append(current)
        return T

    def _pose_in_parent(self, frame: str, stamp: float, where: str) -> Pose:
        poses = self._poses[frame]
        if frame in self._static:
            return poses[-1][1]
        near = around(poses, stamp)
        if near is None:
            raise InputError(f"there is no transform of {frame} within {MAX_GAP:g} s of {where}")
        first, last, share = near
        turn = Slerp([0, 1], Rotation.from_matrix([first[:3, :3], last[:3, :3]]))(share).as_matrix()
        return transform((1 - share) * first[:3, 3] + share * last[:3, 3], turn)


class _States:
    """The configurations of an arm over time."""

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        self.known = list[tuple[float, JointValues]]()

    def add(self, stamp: float, state: Mapping[str, Any]) -> None:
        """Add a message, if it has positions of all joints of the arm."""
        positions = dict(zip(state["name"], state["position"], strict=False))  # positions may be empty
        if all(name in positions for name in self._robot.joint_names):
            q = np.array([positions[name] for name in self._robot.joint_names])
            insort(self.known, (stamp, q), key=itemgetter(0))

    def at(self, stamp: float, where: str) -> Configuration:
        """The configuration at a time, interpolated. Raises InputError, naming `where`, if there is no joint
        state within MAX_GAP of the time."""
        near = around(self.known, stamp)
        if near is None:
            names = ", ".join(self._robot.joint_names)
            raise InputError(f"there is no joint state of {names} within {MAX_GAP:g} s of {where}")
        first, last, share = near
        change = last - first
        return first + share * (change - self._robot.whole_turns(change))
