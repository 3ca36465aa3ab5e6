"""The frames of MoveIt planning scenes and where objects stand in them."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from helpers.moveit_files import MOUNTED, QUARTER, ball, scene_data
from helpers.urdfs import read_urdf
from robotdiffuse import InputError, Robot, Sphere, load_robot
from robotdiffuse.core.transforms import (
    rotation_about,
)
from robotdiffuse.problems.moveit import moveit_frames, moveit_scene
from robotdiffuse.robots.robot_folder import read_robot_folder, write_robot_folder

Z = np.array([0.0, 0.0, 1.0])
WHEELED = """<robot name="wheeled">
  <link name="root"/><link name="x"/><link name="y"/>
  <link name="base"><collision><geometry><box size="0.1 0.1 0.1"/></geometry></collision></link>
  <link name="arm"><collision>
    <origin xyz="0.3 0 0"/><geometry><box size="0.4 0.05 0.05"/></geometry></collision>
  </link>
  {above}
  <joint name="turn" type="revolute"><parent link="base"/><child link="arm"/><axis xyz="0 0 1"/>
    <limit lower="-3" upper="3" velocity="1" effort="1"/></joint>
</robot>"""
"""An arm on wheels; joints above its base stand for these."""
SLIDES = "".join(
    f'<joint name="to_{child}" type="prismatic"><parent link="{parent}"/><child link="{child}"/>'
    f'<axis xyz="{axis}"/><limit lower="-9" upper="9" velocity="1" effort="1"/></joint>'
    for parent, child, axis in (("root", "x", "1 0 0"), ("x", "y", "0 1 0"))
)
WHEELS = {
    "three joints": SLIDES + '<joint name="yaw" type="continuous"><parent link="y"/><child link="base"/>'
    '<axis xyz="0 0 1"/></joint>',
    "a planar joint": '<joint name="drive" type="planar"><parent link="root"/><child link="base"/></joint>'
    '<joint name="a" type="fixed"><parent link="base"/><child link="x"/></joint>'
    '<joint name="b" type="fixed"><parent link="base"/><child link="y"/></joint>',
}


def place(data: dict[str, Any], robot: Robot | None = None) -> list[float]:
    [shape] = moveit_scene(data, moveit_frames(data, robot), Path()).shapes
    assert isinstance(shape, Sphere)
    return shape.center.round(9).tolist()


def at(frame: str, **more: object) -> dict[str, Any]:
    pose = {"position": [0, 0, 0], "orientation": [0, 0, 0, 1]}
    return scene_data(**ball(header={"frame_id": frame}, primitive_poses=[pose])) | more


def state(frame: str, *translations: list[float]) -> dict[str, Any]:
    transforms = [{"translation": xyz, "rotation": [0, 0, 0, 1]} for xyz in translations]
    floating = {"header": {"frame_id": frame}, "joint_names": ["virtual"], "transforms": transforms}
    return {"robot_state": {"multi_dof_joint_state": floating}}


def mounted(folder: Path, kind: str) -> Robot:
    """As `robot add --base base` keeps it, less the spheres, which take their time."""
    (folder / "mounted.urdf").write_text(MOUNTED.format(kind=kind))
    write_robot_folder(read_urdf(folder / "mounted.urdf", base="base"), folder / "mounted", {})
    return read_robot_folder(folder / "mounted")


def test_poses_compose_from_the_base_outwards() -> None:
    """The base stands at [1, 0, 0] and is turned; a frame, the object and its part are offset and turned."""
    data = scene_data(
        **ball(
            header={"frame_id": "table"},
            pose={"position": [0, 2, 0], "orientation": QUARTER},
        )
    )
    data["robot_state"] = {
        "multi_dof_joint_state": {"transforms": [{"translation": [1, 0, 0], "rotation": QUARTER}]}
    }
    table = {"translation": [0, 0, 5], "rotation": QUARTER}
    data["fixed_frame_transforms"] = [
        {"transform": {"translation": [0, 0, 0], "rotation": [0, 0, 0, 1]}, "child_frame_id": "world"},
        {"header": {"frame_id": "world"}, "transform": table, "child_frame_id": "table"},
    ]
    [shape] = moveit_scene(data, moveit_frames(data), Path()).shapes
    turn = rotation_about(Z, np.pi / 2)
    in_object = np.array([1.0, 0, 0])
    in_world = np.array([0, 0, 5.0]) + turn @ (np.array([0, 2.0, 0]) + turn @ in_object)
    expected = turn.T @ (in_world - np.array([1.0, 0, 0]))
    assert isinstance(shape, Sphere)
    np.testing.assert_allclose(shape.center, expected, atol=1e-12)
    data["world"]["collision_objects"][0]["header"]["frame_id"] = "panda_link0"
    [shape] = moveit_scene(data, moveit_frames(data, load_robot("panda")), Path()).shapes
    assert isinstance(shape, Sphere)
    np.testing.assert_allclose(shape.center, np.array([0, 2.0, 0]) + turn @ in_object, atol=1e-12)


def test_scene_in_the_world_of_a_robot_whose_base_is_not_its_root(tmp_path: Path) -> None:
    """`robot add --base` once dropped the transform between them: verified motions met obstacles by 8 cm."""
    robot = mounted(tmp_path, "fixed")
    in_base = np.array([0.5, 0.0, 0.1])
    turn = rotation_about(Z, np.pi / 2)
    in_world = turn @ in_base + [1, 2, 0.8]
    for frame, at in {
        "": in_world,
        "world": in_world,
        "stand": in_base + np.array([0, 0, 0.3]),
        "base": in_base,
    }.items():
        pose = {"position": at.tolist(), "orientation": [0, 0, 0, 1]}
        data = scene_data(**ball(header={"frame_id": frame}, primitive_poses=[pose]))
        [shape] = moveit_scene(data, moveit_frames(data, robot), tmp_path).shapes
        assert isinstance(shape, Sphere)
        np.testing.assert_allclose(shape.center, in_base, atol=1e-9, err_msg=frame)


def test_scene_in_the_world_of_a_robot_whose_base_moves_there_is_refused(tmp_path: Path) -> None:
    robot = mounted(tmp_path, "prismatic")
    data = scene_data(**ball(header={"frame_id": "world"}))
    data["fixed_frame_transforms"] = [
        {"transform": {"translation": [0, 0, 0], "rotation": [0, 0, 0, 1]}, "child_frame_id": "world"}
    ]
    with pytest.raises(InputError, match="a joint moves base in world"):
        moveit_scene(data, moveit_frames(data, robot), tmp_path)
    data = scene_data(**ball(header={"frame_id": "base"}))
    [shape] = moveit_scene(data, moveit_frames(data, robot), tmp_path).shapes
    assert isinstance(shape, Sphere) and shape.center.tolist() == [1, 0, 0]


@pytest.mark.parametrize("wheels", WHEELS)
def test_a_scene_places_what_a_mobile_base_carries(tmp_path: Path, wheels: str) -> None:
    """Every scene of a Fetch whose URDF has joints for its wheels was refused: a joint moves its base."""
    (tmp_path / "wheeled.urdf").write_text(WHEELED.format(above=WHEELS[wheels]))
    robot = read_urdf(tmp_path / "wheeled.urdf", base="base")
    assert robot.root == robot.base == "base"
    data = scene_data(**ball(header={"frame_id": "world"})) | state("world", [0.5, 0, 0])
    assert place(data, robot) == [0.5, 0, 0]


def test_a_lift_is_no_mobile_base(tmp_path: Path) -> None:
    tilted = WHEELS["three joints"].replace('"0 1 0"', '"0 0 1"')
    (tmp_path / "wheeled.urdf").write_text(WHEELED.format(above=tilted))
    assert read_urdf(tmp_path / "wheeled.urdf", base="base").root == "root"


def test_scene_in_a_frame_that_the_robot_is_placed_in(tmp_path: Path) -> None:
    """Objects in `odom`, where multi_dof_joint_state says that the root stands; `world` is then unknown."""
    robot = mounted(tmp_path, "fixed")
    base_in_root = np.array([1, 2, 0.8])
    turn = rotation_about(Z, np.pi / 2).T
    expected = (turn @ (-np.array([3.0, 0, 0]) - base_in_root)).round(9).tolist()
    for frame in ("odom", "/odom", ""):
        assert place(at(frame, **state("odom", [3, 0, 0])), robot) == expected
    panda = load_robot("panda")
    with pytest.raises(InputError, match=r"unknown frame_id of header: 'world'; known: odom, panda_link0"):
        place(at("world", **state("odom", [3, 0, 0])), panda)
    for named in ("world", "panda_link0", ""):
        assert place(at("world", **state(named, [3, 0, 0])), panda) == [-3, 0, 0]
    with pytest.raises(InputError, match="has 2 transforms; it must have one"):
        place(at("world", **state("odom", [3, 0, 0], [0, 0, 0])), panda)


def test_links_of_the_robot_are_frames_where_they_stand(tmp_path: Path) -> None:
    """Also a link called world that is not the root; a file cannot place a link of the robot anew."""
    text = MOUNTED.format(kind="fixed").replace(
        '<link name="world"/>',
        """<link name="map"/><link name="world"/><link name="camera"/>
        <joint name="on" type="fixed"><parent link="map"/><child link="world"/><origin xyz="0 0 7"/></joint>
        <joint name="eye" type="fixed"><parent link="base"/><child link="camera"/>
        <origin xyz="0 0 1"/></joint>""",
    )
    (tmp_path / "arm.urdf").write_text(text)
    robot = read_urdf(tmp_path / "arm.urdf", base="base")
    assert place(at("camera"), robot) == [0, 0, 1]
    assert place(at("world"), robot) == [-2, 1, -0.8]
    assert place(at(""), robot) == [-2, 1, -7.8]
    fixed = {"transform": {"translation": [9, 9, 9], "rotation": [0, 0, 0, 1]}, "child_frame_id": "stand"}
    assert place(at("stand", fixed_frame_transforms=[fixed]), robot) == [0, 0, -0.3]
    with pytest.raises(InputError, match=r"unknown frame_id of header: 'arm'; known: base, camera, map"):
        place(at("arm"), robot)
