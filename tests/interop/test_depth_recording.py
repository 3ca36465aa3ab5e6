"""Depth images in MCAP files, and transforms over time."""

from collections.abc import Callable
from inspect import unwrap
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import Rotation

import robotdiffuse as rd
from helpers.explorations import FLOOR, HOME, WALL
from helpers.refusals import refuses
from robotdiffuse.core.transforms import transform
from robotdiffuse.interop import depth_recording, ros2
from robotdiffuse.perception.occupancy_map import OccupancyMap
from robotdiffuse.planning.exploration.simulated import RecordedExplorer, camera_beside, explore, wrist_camera

PANDA = rd.load_robot("panda")
PROBLEM = rd.Problem(PANDA, rd.Scene([FLOOR, WALL]), HOME, HOME + 0.2)


def test_a_recorded_exploration_is_read_again_and_gives_the_same_voxels(tmp_path: Path) -> None:
    settings = rd.ExplorerSettings(time_limit=1.0, max_views=1)
    explorer = RecordedExplorer(PANDA, [wrist_camera(PANDA)], rd.Scene([FLOOR]), settings=settings)
    explorer.observe(camera_beside(PROBLEM, None, 0))
    for _ in explore(PROBLEM, explorer):
        pass
    views: dict[str, list[depth_recording.StampedView]] = {"wrist": [], "beside": []}
    for one in explorer.views:
        views["beside" if one.camera is None else "wrist"].append(depth_recording.StampedView(one.time, one.view))
    assert all(views.values())
    depth_recording.write_depth_views(PANDA, views, tmp_path / "seen.mcap")
    again = OccupancyMap(PANDA)
    read = list(rd.read_depth_views(tmp_path / "seen.mcap", PANDA))
    for stamp, view in read:
        again.add(view, stamp)
    assert len(read) == len(explorer.views)
    np.testing.assert_allclose([one.stamp for one in read], [one.time for one in explorer.views], atol=1e-9)
    np.testing.assert_array_equal(again.occupied, explorer.map.occupied)
    np.testing.assert_array_equal(again.free, explorer.map.free)
    alone = list(rd.read_depth_views(tmp_path / "seen.mcap", PANDA, ["/beside/depth/image_rect_raw"]))
    assert len(alone) == len(views["beside"])


KINDS = {
    "/joint_states": ros2.JOINT_STATE,
    "/tf": depth_recording.TRANSFORMS,
    "/tf_static": depth_recording.TRANSFORMS,
    "/camera/camera_info": depth_recording.CAMERA_INFO,
    "/camera/image_rect": depth_recording.IMAGE,
}


def stamp(seconds: float) -> dict[str, int]:
    return {"sec": int(seconds), "nanosec": round(1e9 * (seconds % 1))}


def pose(parent: str, child: str, at: float, turn: float = 0.0, x: float = 0.0) -> dict[str, Any]:
    """A transform with a rotation about z."""
    rotation = {"x": 0.0, "y": 0.0, "z": np.sin(turn / 2), "w": np.cos(turn / 2)}
    place = {"translation": {"x": x, "y": 0.0, "z": 0.0}, "rotation": rotation}
    return {"header": {"stamp": stamp(at), "frame_id": parent}, "child_frame_id": child, "transform": place}


def camera(frame: str, at: float, encoding: str, unit: float, zeros: int = 0) -> tuple[Any, Any]:
    """CameraInfo and an image of two rows, in multiples of `unit` [m]."""
    size = {"header": {"stamp": stamp(at), "frame_id": frame}, "height": 2, "width": 2}
    data = np.frombuffer(np.round(np.array([[0.5, 0.0], [1.5, 2.0]]) / unit).astype("<u2").tobytes() + bytes(zeros), np.uint8)
    info = size | {"k": [300.0, 0.0, 0.5, 0.0, 310.0, 0.4, 0.0, 0.0, 1.0], "r": np.zeros(9), "p": np.zeros(12)}
    info |= {name.upper(): info[name] for name in "krp"}  # as ROS 1 has them
    return info, size | {"encoding": encoding, "step": 4, "data": data}


def recording(file: Path, change: Callable[[dict[str, Any]], object] = lambda messages: None) -> Path:
    """One image at 1.05 s, joint states and transforms every 0.1 s, a camera on a link; `change` changes messages by topic."""
    info, image = camera("camera_optical", 1.05, "16UC1", 1e-3)
    names = list(reversed(PANDA.joint_names))
    states = [{"header": {"stamp": stamp(t)}, "name": names, "position": (HOME[::-1] + t).tolist()} for t in (1, 1.1)]
    messages: dict[str, Any] = {
        "/joint_states": states,
        "/tf": [{"transforms": [pose("panda_link0", "panda_hand", at, x=at)]} for at in (1.0, 1.1)],
        "/tf_static": [{"transforms": [pose("panda_hand", "camera_optical", 0.0, x=0.5)]}],
        "/camera/camera_info": [info | {"r": np.eye(3).ravel()}],
        "/camera/image_rect": [image],
    }
    change(messages)
    each = [(topic, KINDS[topic], content) for topic, contents in messages.items() for content in contents]
    if file.suffix == ".mcap":
        with file.open("wb") as stream:
            out = ros2.McapWriter(stream)
            for topic, kind, content in each:
                out.ros(topic, kind, content, 10**9)
            out.writer.finish()
    else:
        write_bag(Writer1(file) if file.suffix == ".bag" else Writer2(file, version=9), each)
    return file


def write_bag(bag: Writer1 | Writer2, messages: list[tuple[str, str, Any]]) -> None:
    store = ros2.typestore()
    if isinstance(bag, Writer1):
        store = get_typestore(Stores.ROS1_NOETIC)
        store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", depth_recording.TRANSFORMS))
    with bag as writer, pytest.MonkeyPatch.context() as patch:
        patch.setattr(ros2, "typestore", lambda: store)
        kinds = dict.fromkeys((topic, kind) for topic, kind, _ in messages)
        connections = {topic: writer.add_connection(topic, kind, typestore=store) for topic, kind in kinds}
        serialized = store.serialize_ros1 if isinstance(bag, Writer1) else store.serialize_cdr
        for topic, kind, content in messages:
            writer.write(connections[topic], 10**9, serialized(ros2.to_message(kind, content), kind))


def test_poses_and_configurations_are_interpolated_and_millimeters_read(tmp_path: Path) -> None:
    [(stamp, view)] = rd.read_depth_views(recording(tmp_path / "r.mcap"), PANDA)
    assert stamp == pytest.approx(1.05)
    np.testing.assert_allclose(view.depth, [[0.5, 0.0], [1.5, 2.0]], rtol=1e-6)
    assert view.intrinsics == (300.0, 310.0, 0.5, 0.4)
    np.testing.assert_allclose(view.T_base_camera, transform(np.array([1.55, 0.0, 0.0])), atol=1e-9)
    assert view.configuration is not None
    np.testing.assert_allclose(view.configuration, HOME + 1.05, atol=1e-9)


@pytest.mark.parametrize("name", ("r.bag", "folder"))
def test_bags_hold_what_mcap_files_do(name: str, tmp_path: Path) -> None:
    [(stamp, view)] = rd.read_depth_views(recording(tmp_path / name), PANDA)
    [(same, twin)] = rd.read_depth_views(recording(tmp_path / "r.mcap"), PANDA)
    assert stamp == same and view.intrinsics == twin.intrinsics
    np.testing.assert_array_equal(view.depth, twin.depth)
    np.testing.assert_array_equal(view.T_base_camera, twin.T_base_camera)
    assert view.configuration is not None and twin.configuration is not None
    np.testing.assert_array_equal(view.configuration, twin.configuration)
    if name == "folder":
        refuses("part of a ROS 2 bag: give the folder", list, rd.read_depth_views(next((tmp_path / name).glob("*.db3")), PANDA))


def realsense(file: Path, compression: Writer1.CompressionFormat | None = None, zeros: int = 0) -> Path:
    """A bag as librealsense writes it: depth in units of 0.1 mm, without joint states and transforms."""
    info, image = camera("0", 3.0, "mono16", 1e-4, zeros)
    bag = Writer1(file)
    if compression is not None:
        bag.set_compression(compression)
    messages = [
        ("/device_0/sensor_0/option/Depth_Units/value", "std_msgs/msg/Float32", {"data": 1e-4}),
        ("/device_0/sensor_0/Depth_0/info/camera_info", depth_recording.CAMERA_INFO, info),
        ("/device_0/sensor_0/Depth_0/image/data", depth_recording.IMAGE, image),
    ]
    write_bag(bag, messages)
    return file


@pytest.mark.parametrize("compression", (None, *Writer1.CompressionFormat))
def test_bags_of_librealsense(compression: Writer1.CompressionFormat | None, tmp_path: Path) -> None:
    file = realsense(tmp_path / "r.bag", compression)
    T = transform(np.array([1.0, 0.0, 0.5]))
    [(stamp, view)] = rd.read_depth_views(file, PANDA, T_base_camera=T)
    assert stamp == 3.0 and view.configuration is None and view.intrinsics == (300.0, 310.0, 0.5, 0.4)
    np.testing.assert_allclose(view.depth, [[0.5, 0.0], [1.5, 2.0]], rtol=1e-6)
    np.testing.assert_array_equal(view.T_base_camera, T)
    refuses("no transforms connect 0.* with panda_link0", list, rd.read_depth_views(file, PANDA))


@pytest.mark.parametrize("compression", Writer1.CompressionFormat)
def test_small_bags_that_unpack_to_much_are_refused(compression: Any, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr("robotdiffuse.interop.ros2.MAX_UNPACKED", 10**6)
    file = realsense(tmp_path / "r.bag", compression, zeros=2 * 10**6)
    assert file.stat().st_size < 10**5
    refuses("a chunk of more than 1,000,000 bytes", list, rd.read_depth_views(file, PANDA, T_base_camera=np.eye(4)))


@pytest.mark.parametrize("size", (0, 40, 5000))
def test_damaged_bags_are_refused(size: int, tmp_path: Path) -> None:
    file = realsense(tmp_path / "r.bag")
    file.write_bytes(file.read_bytes()[:size])
    refuses(r"r\.bag is damaged", list, rd.read_depth_views(file, PANDA, T_base_camera=np.eye(4)))


def test_joint_states_near_in_time_count(tmp_path: Path) -> None:
    """Regression: one far away in time was used, one without positions was damage; log times of transforms did not count."""
    rates = {"header": {"stamp": stamp(1.05)}, "name": list(PANDA.joint_names), "velocity": [0.0] * 7}
    changes: tuple[tuple[Callable[[dict[str, Any]], object], float], ...] = (
        (lambda messages: messages["/joint_states"][1]["header"]["stamp"].update(sec=100), 1.0),
        (lambda messages: messages["/joint_states"].append(rates), 1.05),
        (lambda of: [m["header"].update(stamp=stamp(0)) for m in (*of["/camera/image_rect"], *of["/tf"][0]["transforms"])], 1),
    )
    for change, at in changes:
        [(_, view)] = rd.read_depth_views(recording(tmp_path / "r.mcap", change), PANDA)
        assert view.configuration is not None
        np.testing.assert_allclose(view.configuration, HOME + at, atol=1e-9)


def test_continuous_joints_are_interpolated_the_short_way(tmp_path: Path) -> None:
    """Regression: halfway between 3.13 and -3.13 rad, a joint was taken to be at 0."""
    gen3 = rd.load_robot("gen3")

    def of_gen3(messages: dict[str, Any]) -> None:
        for state, angle in zip(messages["/joint_states"], (3.13, -3.13), strict=True):
            state |= {"name": list(gen3.joint_names), "position": np.where(gen3.continuous, angle, 0.5).tolist()}

    [(_, view)] = rd.read_depth_views(recording(tmp_path / "r.mcap", of_gen3), gen3, base="panda_link0")
    assert view.configuration is not None
    np.testing.assert_allclose(np.cos(view.configuration), np.where(gen3.continuous, -1.0, np.cos(0.5)), atol=1e-9)


def test_an_image_without_a_joint_state_leaves_the_rest(tmp_path: Path) -> None:
    """Regression: such an image ended the reading."""

    def early_too(messages: dict[str, Any]) -> None:
        [image] = messages["/camera/image_rect"]
        early = image | {"header": image["header"] | {"stamp": stamp(0.5)}}
        messages["/camera/image_rect"] = [early, image | {"encoding": "mono16"}]

    [(at, view)] = rd.read_depth_views(recording(tmp_path / "r.mcap", early_too), PANDA)
    assert at == pytest.approx(1.05)
    np.testing.assert_allclose(view.depth, [[0.5, 0.0], [1.5, 2.0]], rtol=1e-6)


def test_what_is_missing_is_said(tmp_path: Path) -> None:
    changes: tuple[tuple[Callable[[dict[str, Any]], object], str], ...] = (
        (lambda of: of["/camera/camera_info"].clear(), "no CameraInfo in the folder /camera"),
        (lambda of: of["/camera/image_rect"].clear(), "holds no depth images"),
        (lambda of: of["/tf"].clear(), "no transforms connect camera_optical.*with panda_link0.*panda_hand"),
        (lambda of: [s["header"].update(stamp=stamp(3)) for s in of["/joint_states"]], "no joint state of panda.*0.1 s of the"),
        (lambda of: of["/camera/image_rect"][0].update(encoding="32FC1"), "is damaged: .*cannot reshape"),
        (lambda of: of["/camera/image_rect"][0].update(encoding="rgb8"), "holds no depth images"),
        (lambda of: of["/camera/camera_info"][0].update(width=3), "2 x 2 pixels; their CameraInfo has 3 x 2"),
    )
    for change, message in changes:
        refuses(message, list, rd.read_depth_views(recording(tmp_path / "r.mcap", change), PANDA))


def test_commanded_joints_and_other_cameras_are_told_apart(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Regressions: commanded joints were mixed with the measured ones, and T_base_camera was used for every camera."""
    monkeypatch.setitem(KINDS, "/joint_commands", ros2.JOINT_STATE)
    command = {"header": {"stamp": stamp(1.05)}, "name": list(PANDA.joint_names), "position": (HOME + 3).tolist()}
    file = recording(tmp_path / "r.mcap", lambda messages: messages.update({"/joint_commands": [command]}))
    [(_, view)] = rd.read_depth_views(file, PANDA)
    assert np.allclose(np.array(view.configuration), HOME + 1.05, atol=1e-9)
    info, image = camera("second", 1.06, "16UC1", 1e-3)
    more = {"/second/camera_info": [info | {"r": np.eye(3).ravel()}], "/second/image_rect": [image]}
    for topic, kind in zip(more, (depth_recording.CAMERA_INFO, depth_recording.IMAGE), strict=True):
        monkeypatch.setitem(KINDS, topic, kind)
    file = recording(tmp_path / "two.mcap", lambda messages: messages.update(more))
    refuses("pose of one camera", list, rd.read_depth_views(file, PANDA, T_base_camera=np.eye(4)))


def test_other_files_and_topics_are_refused(tmp_path: Path) -> None:
    (tmp_path / "text.mcap").write_text("no recording")
    refuses("is no MCAP file or was cut short", list, rd.read_depth_views(tmp_path / "text.mcap", PANDA))
    other = rd.read_depth_views(recording(tmp_path / "r.mcap"), PANDA, ["/other"])
    refuses("'/other' holds no images; topics of images: /camera/image_rect", list, other)
    views = {"wrist": [depth_recording.StampedView(0.0, rd.DepthView(np.ones((2, 2)), (300, 300, 0.5, 0.5), np.eye(4)))]}
    refuses("view of wrist at 0 s has no configuration", depth_recording.write_depth_views, PANDA, views, tmp_path / "w.mcap")
    read = unwrap(rd.read_depth_views)
    refuses("topics is '/cam/depth'; it must be a list of names", list, read(tmp_path / "a.mcap", PANDA, "/cam/depth"))
    refuses("robot is 'panda'; it must be a Robot", list, read(tmp_path / "a.mcap", "panda"))


def history() -> depth_recording.TransformHistory:
    """Transforms of a link that turns by 1 rad in 0.1 s, logged in the wrong order, and of a camera fixed to it."""
    out = depth_recording.TransformHistory()
    out.add(pose("base", "link", 5.1, 1.0), static=False)
    out.add(pose("base", "link", 5.0, 0.0), static=False)
    out.add(pose("/link", "/camera", 0.0, x=2.0), static=True)
    return out


@pytest.mark.parametrize(("at", "share"), [(5.0, 0.0), (5.025, 0.25), (5.1, 1.0), (5.15, 1.0)])
def test_chains_are_followed_and_interpolated_and_at_the_ends_the_nearest_counts(at: float, share: float) -> None:
    T = history().at("base", "camera", at, "the image")
    np.testing.assert_allclose(T[:3, :3], Rotation.from_rotvec([0, 0, share]).as_matrix(), atol=1e-6)
    np.testing.assert_allclose(T[:3, 3], [2 * np.cos(share), 2 * np.sin(share), 0.0], atol=1e-6)


def test_missing_transforms_are_said() -> None:
    refuses(r"no transform of link within 0\.1 s of the image", history().at, "base", "camera", 6.0, "the image")
    refuses(r"no transforms connect camera.*with world.*are link, base", history().at, "world", "camera", 5.0, "the image")
    circle = history()
    circle.add(pose("camera", "base", 5.0), static=True)
    refuses("no transforms connect camera", circle.at, "world", "camera", 5.0, "the image")
    bad = pose("base", "link", 5.0)
    bad["transform"]["rotation"] = dict.fromkeys("xyzw", 0.0)
    refuses("transform of link.rotation is .* must not be zero", circle.add, bad, static=False)
