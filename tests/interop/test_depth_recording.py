"""Depth images in MCAP files, and transforms over time."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import robotdiffuse as rd
from robotdiffuse.core.errors import InputError
from robotdiffuse.core.transforms import transform
from robotdiffuse.interop.depth_recording import (
    StampedView,
    TransformHistory,
    read_depth_views,
    write_depth_views,
)
from robotdiffuse.interop.ros2 import McapWriter
from robotdiffuse.perception.occupancy_map import OccupancyMap
from robotdiffuse.planning.exploration.simulated import RecordedExplorer, camera_beside, explore, wrist_camera
from robotdiffuse.planning.exploration.steps import ExplorerSettings

PANDA = rd.load_robot("panda")
HOME = np.array([0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785])
FLOOR = rd.Box((0, 0, -0.06), (6, 6, 0.1), name="floor")
WALL = rd.Box((0.45, -0.2, 0.3), (0.5, 0.02, 0.6), name="wall")
PROBLEM = rd.Problem(PANDA, rd.Scene([FLOOR, WALL]), HOME, HOME + 0.2)


def test_a_recorded_exploration_is_read_again_and_gives_the_same_voxels(tmp_path: Path) -> None:
    settings = ExplorerSettings(time_limit=1.0, max_looks=1)
    explorer = RecordedExplorer(PANDA, [wrist_camera(PANDA)], rd.Scene([FLOOR]), settings=settings)
    explorer.observe(camera_beside(PROBLEM, None, 0))
    for _ in explore(PROBLEM, explorer):
        pass
    views: dict[str, list[StampedView]] = {"wrist": [], "beside": []}
    for one in explorer.views:
        name = "beside" if one.camera is None else "wrist"
        views[name].append(StampedView(one.time, one.view))
    assert all(views.values())
    write_depth_views(PANDA, views, tmp_path / "seen.mcap")
    again = OccupancyMap(PANDA)
    read = list(rd.read_depth_views(tmp_path / "seen.mcap", PANDA))
    for stamp, view in read:
        again.add(view, stamp)
    assert len(read) == len(explorer.views)
    np.testing.assert_allclose([one.stamp for one in read], [one.time for one in explorer.views], atol=1e-9)
    np.testing.assert_array_equal(again.occupied, explorer.map.occupied)
    np.testing.assert_array_equal(again.free, explorer.map.free)
    alone = list(read_depth_views(tmp_path / "seen.mcap", PANDA, ["/beside/depth/image_rect_raw"]))
    assert len(alone) == len(views["beside"])


TURN = {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}


def recording(file: Path, change: Callable[[dict[str, Any]], None] = lambda messages: None) -> Path:
    """One image of 16 bits at 1.05 s, joint states and transforms every 0.1 s, and a camera on a link whose
    pose on it is static. `change` changes the messages by topic."""

    def stamp(seconds: float) -> dict[str, int]:
        return {"sec": int(seconds), "nanosec": round(1e9 * (seconds % 1))}

    def pose(parent: str, child: str, x: float, at: float) -> dict[str, Any]:
        place = {"translation": {"x": x, "y": 0.0, "z": 0.0}, "rotation": TURN}
        header = {"stamp": stamp(at), "frame_id": parent}
        return {"transforms": [{"header": header, "child_frame_id": child, "transform": place}]}

    header = {"stamp": stamp(1.05), "frame_id": "camera_optical"}
    pixels = np.array([[500, 0], [1500, 2000]], "<u2")
    k = [300.0, 0.0, 0.5, 0.0, 310.0, 0.4, 0.0, 0.0, 1.0]
    image = {"header": header, "height": 2, "width": 2, "encoding": "16UC1", "step": 4}
    names = list(reversed(PANDA.joint_names))
    rows = (1.0, 1.1)
    messages: dict[str, Any] = {
        "/joint_states": [
            {"header": {"stamp": stamp(at)}, "name": names, "position": (HOME[::-1] + at).tolist()}
            for at in rows
        ],
        "/tf": [pose("panda_link0", "panda_hand", at, at) for at in rows],
        "/tf_static": [pose("panda_hand", "camera_optical", 0.5, 0.0)],
        "/camera/camera_info": [
            {"header": header, "height": 2, "width": 2, "k": k, "r": np.eye(3).ravel(), "p": np.zeros(12)}
        ],
        "/camera/image_rect": [image | {"data": np.frombuffer(pixels.tobytes(), np.uint8)}],
    }
    change(messages)
    kinds = ("JointState", "TFMessage", "TFMessage", "CameraInfo", "Image")
    with file.open("wb") as stream:
        out = McapWriter(stream)
        for (topic, contents), kind in zip(messages.items(), kinds, strict=True):
            package = "tf2_msgs" if kind == "TFMessage" else "sensor_msgs"
            for content in contents:
                out.ros(topic, f"{package}/msg/{kind}", content, 10**9)
        out.writer.finish()
    return file


def test_poses_and_configurations_are_interpolated_and_millimetres_read(tmp_path: Path) -> None:
    [(stamp, view)] = read_depth_views(recording(tmp_path / "r.mcap"), PANDA)
    assert stamp == pytest.approx(1.05)
    np.testing.assert_allclose(view.depth, [[0.5, 0.0], [1.5, 2.0]], rtol=1e-6)
    assert view.intrinsics == (300.0, 310.0, 0.5, 0.4)
    np.testing.assert_allclose(view.T_base_camera, transform(np.array([1.55, 0.0, 0.0])), atol=1e-9)
    assert view.configuration is not None
    np.testing.assert_allclose(view.configuration, HOME + 1.05, atol=1e-9)


def remove(topic: str) -> Callable[[dict[str, Any]], None]:
    return lambda messages: messages.__setitem__(topic, [])


def late(messages: dict[str, Any]) -> None:
    messages["/joint_states"] = messages["/joint_states"][:1]
    messages["/joint_states"][0]["header"]["stamp"]["sec"] = 3


def far_apart(messages: dict[str, Any]) -> None:
    messages["/joint_states"][1]["header"]["stamp"]["sec"] = 100


def with_velocities_alone(messages: dict[str, Any]) -> None:
    header = {"stamp": {"sec": 1, "nanosec": 5 * 10**7}}
    rates = {"header": header, "name": list(PANDA.joint_names), "velocity": [0.0] * 7}
    messages["/joint_states"].append(rates)


@pytest.mark.parametrize(("change", "at"), [(far_apart, 1.0), (with_velocities_alone, 1.05)])
def test_only_joint_states_near_in_time_and_with_positions_count(
    change: Callable[[dict[str, Any]], None], at: float, tmp_path: Path
) -> None:
    """One far away was interpolated with, and one without positions was reported as damage."""
    [(_, view)] = read_depth_views(recording(tmp_path / "r.mcap", change), PANDA)
    assert view.configuration is not None
    np.testing.assert_allclose(view.configuration, HOME + at, atol=1e-9)


def test_continuous_joints_are_interpolated_the_short_way(tmp_path: Path) -> None:
    """Halfway between 3.13 and -3.13 rad a joint was taken to be at 0."""
    gen3 = rd.load_robot("gen3")

    def of_gen3(messages: dict[str, Any]) -> None:
        for state, angle in zip(messages["/joint_states"], (3.13, -3.13), strict=True):
            positions = np.where(gen3.continuous, angle, 0.5).tolist()
            state |= {"name": list(gen3.joint_names), "position": positions}

    [(_, view)] = read_depth_views(recording(tmp_path / "r.mcap", of_gen3), gen3, base="panda_link0")
    assert view.configuration is not None
    halfway = np.where(gen3.continuous, -1.0, np.cos(0.5))
    np.testing.assert_allclose(np.cos(view.configuration), halfway, atol=1e-9)


def in_colour(messages: dict[str, Any]) -> None:
    messages["/camera/image_rect"][0]["encoding"] = "rgb8"


def of_another_size(messages: dict[str, Any]) -> None:
    messages["/camera/camera_info"][0]["width"] = 3


def test_an_image_without_a_joint_state_leaves_the_rest(tmp_path: Path) -> None:
    """It ended the reading for good."""

    def early_too(messages: dict[str, Any]) -> None:
        [image] = messages["/camera/image_rect"]
        early = image | {"header": image["header"] | {"stamp": {"sec": 0, "nanosec": 0}}}
        early["header"]["stamp"]["nanosec"] = 5 * 10**8
        messages["/camera/image_rect"] = [early, image | {"encoding": "mono16"}]

    [(stamp, view)] = read_depth_views(recording(tmp_path / "r.mcap", early_too), PANDA)
    assert stamp == pytest.approx(1.05)
    np.testing.assert_allclose(view.depth, [[0.5, 0.0], [1.5, 2.0]], rtol=1e-6)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (remove("/camera/camera_info"), "no CameraInfo on /camera/camera_info"),
        (remove("/camera/image_rect"), "holds no depth images"),
        (remove("/tf"), "no transforms lead from panda_link0 to camera_optical.*panda_hand"),
        (late, "no joint state of panda_joint1.* within 0.1 s of the image"),
        (in_colour, "holds no depth images"),
        (of_another_size, "2 x 2 pixels; their CameraInfo has 3 x 2"),
    ],
)
def test_what_is_missing_is_said(
    change: Callable[[dict[str, Any]], None], message: str, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match=message) as error:
        list(read_depth_views(recording(tmp_path / "r.mcap", change), PANDA))
    assert "\n" not in str(error.value)


def test_other_files_and_topics_are_refused(tmp_path: Path) -> None:
    (tmp_path / "text.mcap").write_text("no recording")
    with pytest.raises(InputError, match="damaged"):
        list(read_depth_views(tmp_path / "text.mcap", PANDA))
    with pytest.raises(InputError, match="'/other' holds no images; topics of images: /camera/image_rect"):
        list(read_depth_views(recording(tmp_path / "r.mcap"), PANDA, ["/other"]))
    view = rd.DepthView(np.ones((2, 2)), (300, 300, 0.5, 0.5), np.eye(4))
    with pytest.raises(InputError, match="the view of wrist at 0 s has no configuration"):
        write_depth_views(PANDA, {"wrist": [StampedView(0.0, view)]}, tmp_path / "w.mcap")


def message(parent: str, child: str, at: float, turn: float = 0.0, x: float = 0.0) -> dict[str, Any]:
    """A transform with a turn about z."""
    stamp = {"sec": int(at), "nanosec": round(1e9 * (at % 1))}
    rotation = {"x": 0.0, "y": 0.0, "z": np.sin(turn / 2), "w": np.cos(turn / 2)}
    place = {"translation": {"x": x, "y": 0.0, "z": 0.0}, "rotation": rotation}
    return {"header": {"stamp": stamp, "frame_id": parent}, "child_frame_id": child, "transform": place}


def history() -> TransformHistory:
    """A link that turns by 1 rad in 0.1 s, logged in the wrong order, and a camera fixed to it."""
    out = TransformHistory()
    out.add(message("base", "link", 5.1, 1.0), static=False)
    out.add(message("base", "link", 5.0, 0.0), static=False)
    out.add(message("/link", "/camera", 0.0, x=2.0), static=True)
    return out


@pytest.mark.parametrize("share", (0.0, 0.25, 1.0))
def test_chains_are_followed_and_interpolated(share: float) -> None:
    T = history().at("base", "camera", 5.0 + 0.1 * share, 0.1, "the image")
    np.testing.assert_allclose(T[:3, :3], Rotation.from_rotvec([0, 0, share]).as_matrix(), atol=1e-6)
    np.testing.assert_allclose(T[:3, 3], [2 * np.cos(share), 2 * np.sin(share), 0.0], atol=1e-6)


def test_the_nearest_transform_counts_at_the_ends() -> None:
    T = history().at("base", "link", 5.15, 0.1, "the image")
    np.testing.assert_allclose(T[:3, :3], Rotation.from_rotvec([0, 0, 1.0]).as_matrix(), atol=1e-6)


def test_missing_transforms_are_said() -> None:
    with pytest.raises(InputError, match=r"no transform of link within 0\.1 s of the image"):
        history().at("base", "camera", 6.0, 0.1, "the image")
    with pytest.raises(InputError, match=r"no transforms lead from world to camera.*lead to link, base"):
        history().at("world", "camera", 5.0, 0.1, "the image")
    circle = history()
    circle.add(message("camera", "base", 5.0), static=True)
    with pytest.raises(InputError, match="no transforms lead from world"):
        circle.at("world", "camera", 5.0, 0.1, "the image")
    bad = message("base", "link", 5.0)
    bad["transform"]["rotation"] = dict.fromkeys("xyzw", 0.0)
    with pytest.raises(InputError, match="the transform of link has the rotation"):
        circle.add(bad, static=False)
