"""MoveIt planning scenes: what is read, and what is refused rather than ignored."""

import shutil
from pathlib import Path

import numpy as np
import pytest
import trimesh
import yaml

from helpers.moveit_files import MOTION_BENCH_MAKER, QUARTER, ball, scene_data
from robotdiffuse import Box, Cylinder, InputError, JointGoal, Mesh, PointCloud, Sphere, load_robot
from robotdiffuse.problems.files import (
    load_motion_bench_maker,
    load_problems,
)
from robotdiffuse.problems.moveit import moveit_frames, moveit_scene, read_moveit_scene


def test_scene_as_motion_bench_maker_writes_it() -> None:
    can, board = read_moveit_scene(MOTION_BENCH_MAKER / "scene0001.yaml")[0].shapes
    assert isinstance(can, Cylinder) and (can.name, can.height, can.radius) == ("can", 0.14, 0.03)
    assert can.center.tolist() == [0.5, -0.4, 0.3]
    assert isinstance(board, Box) and board.size.tolist() == [1.2, 0.8, 0.04]
    # A quarter turn about z: the long side lies along y.
    np.testing.assert_allclose(board.bounds[1] - board.bounds[0], [0.8, 1.2, 0.04], atol=1e-12)


def test_folder() -> None:
    good, bad = load_motion_bench_maker(MOTION_BENCH_MAKER)
    assert good.name == "motion_bench_maker/0001" and good.error == ""
    problem = good.load()
    assert problem.start.tolist() == [0, -0.785, 0, -2.356, 0, 1.571, 0.785]
    assert isinstance(problem.goal, JointGoal)
    assert problem.goal.positions.tolist() == [[1.2, -0.3, 0.5, -1.9, -0.2, 2.1, 0.1]]
    assert problem.robot.locked == {"panda_finger_joint1": 0.065, "panda_finger_joint2": 0.065}
    assert [shape.name for shape in problem.scene.shapes] == ["can", "board"]
    assert bad.problem is None
    with pytest.raises(
        InputError, match=r"request0002.yaml: goal: panda_joint1 is 3.1 rad; its limits are -2.8"
    ):
        bad.load()
    assert [entry.name for entry in load_problems(MOTION_BENCH_MAKER)] == [good.name, bad.name]


def test_robot_may_be_given() -> None:
    robot = load_robot("panda")
    problem = load_motion_bench_maker(MOTION_BENCH_MAKER, robot)[0].load()
    assert problem.robot.locked["panda_finger_joint1"] == 0.065
    assert robot.locked["panda_finger_joint1"] == 0.04


def test_unusable_folders(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"has no files scene\*.yaml"):
        load_motion_bench_maker(tmp_path)
    shutil.copy(MOTION_BENCH_MAKER / "scene0001.yaml", tmp_path)
    [entry] = load_motion_bench_maker(tmp_path)
    assert "request0001.yaml does not exist" in entry.error
    (tmp_path / "scene0001.yaml").write_text("robot_model_name: r2d2")
    [entry] = load_motion_bench_maker(tmp_path)
    assert "scene0001.yaml: unknown robot 'r2d2'" in entry.error
    (tmp_path / "scene0001.yaml").write_text("[")
    [entry] = load_motion_bench_maker(tmp_path)
    assert "not valid YAML" in entry.error and "\n" not in entry.error


def test_vectors_as_mappings_types_as_numbers() -> None:
    data = scene_data(
        id=3,
        primitives=[{"type": 3, "dimensions": [0.4, 0.1]}],
        primitive_poses=[
            {"position": {"x": 1, "y": 2, "z": 3}, "orientation": {"x": 0, "y": 0, "z": 0, "w": 1}},
        ],
    )
    [shape] = moveit_scene(data, moveit_frames(data), Path()).shapes
    assert isinstance(shape, Cylinder) and shape.center.tolist() == [1, 2, 3]
    assert (shape.name, shape.height, shape.radius) == ("3", 0.4, 0.1)


def test_pose_of_the_object_alone_is_enough() -> None:
    entry = ball(pose={"position": [0, 0, 2], "orientation": [0, 0, 0, 1]})
    del entry["primitive_poses"]
    [shape] = moveit_scene(scene_data(**entry), moveit_frames({}), Path()).shapes
    assert isinstance(shape, Sphere) and shape.center.tolist() == [0, 0, 2]


def test_meshes(tmp_path: Path) -> None:
    trimesh.creation.box([1, 1, 1]).export(tmp_path / "cube.stl")
    at = {"position": [0, 0, 1], "orientation": QUARTER}
    rows = [{"x": 0, "y": 0, "z": 0}, {"x": 1, "y": 0, "z": 0}, {"x": 0, "y": 1, "z": 0}]
    data = scene_data(
        id="things",
        meshes=[
            {"triangles": [{"vertex_indices": [0, 1, 2]}], "vertices": rows},
            {"resource": "cube.stl", "dimensions": [2, 1, 1]},
        ],
        mesh_poses=[at, at],
    )
    triangle, cube = moveit_scene(data, moveit_frames(data), tmp_path).shapes
    assert isinstance(triangle, Mesh) and isinstance(cube, Mesh)
    np.testing.assert_allclose(triangle.world_vertices, [[0, 0, 1], [0, 1, 1], [-1, 0, 1]], atol=1e-12)
    np.testing.assert_allclose(cube.bounds, [[-0.5, -1, 0.5], [0.5, 1, 1.5]], atol=1e-12)
    assert (triangle.name, cube.name) == ("things", "things_2")


CONE = {"type": "cone", "dimensions": [0.4, 0.1]}
SHORT = {"type": "box", "dimensions": [0.4, 0.1]}


def octomap(data: list[int]) -> dict[str, object]:
    message = {"binary": True, "id": "OcTree", "resolution": 0.1, "data": data}
    origin = {"position": [0, 0, 1], "orientation": [0, 0, 0, 1]}
    return {"world": {"octomap": {"header": {"frame_id": "world"}, "origin": origin, "octomap": message}}}


def test_cones_planes_and_octomaps() -> None:
    place = {"position": [1, 0, 0], "orientation": [0, 0, 0, 1]}
    data = scene_data(**ball(primitives=[CONE], primitive_poses=[place]))
    [cone] = moveit_scene(data, moveit_frames(data), Path()).shapes
    assert isinstance(cone, Mesh)
    np.testing.assert_allclose(cone.bounds, [[0.9, -0.1, -0.2], [1.1, 0.1, 0.2]], atol=1e-3)
    flat = {"id": "ground", "planes": [{"coef": [0, 0, 2, -1]}], "plane_poses": [place]}
    data = scene_data(**flat)
    [ground] = moveit_scene(data, moveit_frames(data), Path()).shapes
    assert isinstance(ground, Box) and ground.name == "ground"
    np.testing.assert_allclose(ground.bounds[1], [11, 10, 0.5])
    data = octomap([-1 & 3, 0] + 14 * [3, 0] + [2, 0])  # the voxel at the lower end of everything
    [cloud] = moveit_scene(data, moveit_frames(data), Path()).shapes
    assert isinstance(cloud, PointCloud) and cloud.point_radius == pytest.approx(0.05 * 3**0.5)
    np.testing.assert_allclose(cloud.points, [np.array([0, 0, 1]) - 0.1 * (2**15 - 0.5)])


WRONG_SCENES: dict[str, tuple[object, str]] = {
    "number": (3, "a planning scene is 3; it must be a mapping"),
    "prism": (
        scene_data(**ball(primitives=[CONE | {"type": 5}])),
        "object ball: unknown type of .*'prism'; known: box, cone, cylinder",
    ),
    "cone": (scene_data(**ball(primitives=[CONE | {"dimensions": [0, 1]}])), "must be positive"),
    "dimensions": (scene_data(**ball(primitives=[SHORT])), r"primitives\[0\].dimensions .* 3 finite numbers"),
    "poses": (scene_data(**ball(primitive_poses=[])), "has 1 primitives and 0 primitive_poses"),
    "quaternion": (
        scene_data(**ball(primitive_poses=[{"position": [0, 0, 0], "orientation": [0, 0, 0, 0]}])),
        r"ball: primitive_poses\[0\].orientation .* must not be zero",
    ),
    "position": (scene_data(**ball(primitive_poses=[{"orientation": [0, 0, 0, 1]}])), "position.xyz is None"),
    "frame": (
        scene_data(**ball(header={"frame_id": "moon"})),
        "unknown frame_id of header: 'moon'; known: world",
    ),
    "plane": (scene_data(**ball(planes=[{"coef": [0, 0, 0, 1]}])), "must not all be zero"),
    "package": (
        scene_data(**ball(meshes=[{"resource": "package://a/b.stl"}], mesh_poses=ball()["primitive_poses"])),
        r"object ball: meshes\[0\].resource is package://a/b.stl",
    ),
    "objects": ({"world": {"collision_objects": {}, "octomap": {"octomap": {"data": [1]}}}}, "not binary"),
    "octomap": (octomap([3, 0]), "world.octomap: the tree ends too soon"),
    "objects a text": ({"world": {"collision_objects": "ball"}}, "'ball'; it must be a list"),
    "attached": ({"robot_state": {"attached_collision_objects": [1]}}, "attached_collision_objects"),
}


@pytest.mark.parametrize("case", WRONG_SCENES)
def test_wrong_scenes(case: str, tmp_path: Path) -> None:
    data, message = WRONG_SCENES[case]
    file = tmp_path / "scene.yaml"
    file.write_text(yaml.safe_dump(data))
    with pytest.raises(InputError, match=message) as raised:
        read_moveit_scene(file)
    assert str(raised.value).startswith(str(file)) and "\n" not in str(raised.value)
