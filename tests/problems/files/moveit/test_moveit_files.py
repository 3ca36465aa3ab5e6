"""MoveIt scenes, requests, joints and contacts: what is read, and what is refused rather than ignored."""

import re
import shutil
from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
import yaml

import robotdiffuse as rd
from helpers.commands import written as write_record
from helpers.made_arms import joint, link, read_urdf, written
from helpers.panda import PANDA
from helpers.refusals import refuses
from robotdiffuse.core.files import read_yaml
from robotdiffuse.core.transforms import quaternion_from_rotation, rotation_about, rotation_from_quaternion, transform
from robotdiffuse.problems import moveit
from robotdiffuse.problems.files import ProblemEntry, load_motion_bench_maker, load_problems, problem_record
from robotdiffuse.robots.robot_folder import read_robot_folder, write_robot_folder
from robotdiffuse.scenes.shapes import Shape

MOTION_BENCH_MAKER = Path(__file__).parents[3] / "files" / "motion_bench_maker"
QUARTER = [0, 0, 0.7071067811865476, 0.7071067811865476]
"""xyzw of a quarter turn about z."""
MOUNT = """<joint name="mount" type="fixed"><parent link="world"/><child link="stand"/>
  <origin xyz="1 2 0.5" rpy="0 0 1.5707963267948966"/></joint>"""
TURN = link("arm") + joint("turn", "base", "arm", xyz="0 0 0", axis="0 0 1")


def scene_data(**world: object) -> dict[str, Any]:
    return {"world": {"collision_objects": [dict(world)]}}


def ball(**more: object) -> dict[str, Any]:
    at = [{"position": [1, 0, 0], "orientation": [0, 0, 0, 1]}]
    return {"id": "ball", "primitives": [{"type": "sphere", "dimensions": [0.2]}], "primitive_poses": at, **more}


def request_data() -> dict[str, Any]:
    return read_yaml(MOTION_BENCH_MAKER / "request0001.yaml")


def change(data: dict[str, Any], path: list[Any], value: object) -> dict[str, Any]:
    at: Any = data
    for key in path[:-1]:
        at = at[key]
    at[path[-1]] = value
    return data


def shapes_of(data: dict[str, Any], robot: rd.Robot = PANDA, folder: Path = MOTION_BENCH_MAKER) -> tuple[Shape, ...]:
    return moveit.moveit_scene(data, moveit.moveit_frames(data, robot), folder).shapes


def test_scene_as_motion_bench_maker_writes_it() -> None:
    can, board = moveit.read_moveit_scene(MOTION_BENCH_MAKER / "scene0001.yaml", PANDA)[0].shapes
    assert isinstance(can, rd.Cylinder) and (can.name, can.height, can.radius) == ("can", 0.14, 0.03)
    assert can.center.tolist() == [0.5, -0.4, 0.3]
    assert isinstance(board, rd.Box) and board.size.tolist() == [1.2, 0.8, 0.04]
    # A quarter turn about z: the long side lies along y.
    np.testing.assert_allclose(board.bounds[1] - board.bounds[0], [0.8, 1.2, 0.04], atol=1e-12)


def test_folder() -> None:
    good, bad = load_motion_bench_maker(MOTION_BENCH_MAKER)
    assert good.name == "motion_bench_maker/0001" and good.error == ""
    problem = good.load()
    assert problem.start.tolist() == [0, -0.785, 0, -2.356, 0, 1.571, 0.785]
    assert isinstance(problem.goal, rd.JointGoal)
    assert problem.goal.positions.tolist() == [[1.2, -0.3, 0.5, -1.9, -0.2, 2.1, 0.1]]
    assert problem.robot.locked == {"panda_finger_joint1": 0.065, "panda_finger_joint2": 0.065}
    assert [shape.name for shape in problem.scene.shapes] == ["can", "board"]
    assert bad.problem is None
    refuses(r"request0002.yaml: goal: panda_joint1 is 3.1 rad; its limits are -2.8", bad.load)
    assert [entry.name for entry in load_problems(MOTION_BENCH_MAKER)] == [good.name, bad.name]


def test_unusable_folders(tmp_path: Path) -> None:
    refuses(r"has no files scene\*.yaml", load_motion_bench_maker, tmp_path)
    shutil.copy(MOTION_BENCH_MAKER / "scene0001.yaml", tmp_path)
    [entry] = load_motion_bench_maker(tmp_path)
    assert "request0001.yaml does not exist" in entry.error
    for text, message in (("robot_model_name: r2d2", "scene0001.yaml: unknown robot 'r2d2'"), ("[", "not valid YAML")):
        (tmp_path / "scene0001.yaml").write_text(text)
        [entry] = load_motion_bench_maker(tmp_path)
        assert message in entry.error and "\n" not in entry.error


def test_vectors_as_mappings_types_as_numbers_and_poses_of_the_object_alone() -> None:
    at = {"position": {"x": 1, "y": 2, "z": 3}, "orientation": {"x": 0, "y": 0, "z": 0, "w": 1}}
    [shape] = shapes_of(scene_data(id=3, primitives=[{"type": 3, "dimensions": [0.4, 0.1]}], primitive_poses=[at]))
    assert isinstance(shape, rd.Cylinder) and shape.center.tolist() == [1, 2, 3]
    assert (shape.name, shape.height, shape.radius) == ("3", 0.4, 0.1)
    entry = ball(pose={"position": [0, 0, 2], "orientation": [0, 0, 0, 1]})
    del entry["primitive_poses"]
    assert place(scene_data(**entry)) == [0, 0, 2]


def test_meshes(tmp_path: Path) -> None:
    trimesh.creation.box([1, 1, 1]).export(tmp_path / "cube.stl")
    at = {"position": [0, 0, 1], "orientation": QUARTER}
    rows = [{"x": 0, "y": 0, "z": 0}, {"x": 1, "y": 0, "z": 0}, {"x": 0, "y": 1, "z": 0}]
    flat = {"triangles": [{"vertex_indices": [0, 1, 2]}], "vertices": rows}
    meshes = [flat, {"resource": "cube.stl", "dimensions": [2, 1, 1]}]
    triangle, cube = shapes_of(scene_data(id="things", meshes=meshes, mesh_poses=[at, at]), folder=tmp_path)
    assert isinstance(triangle, rd.Mesh) and isinstance(cube, rd.Mesh)
    np.testing.assert_allclose(triangle.world_vertices, [[0, 0, 1], [0, 1, 1], [-1, 0, 1]], atol=1e-12)
    np.testing.assert_allclose(cube.bounds, [[-0.5, -1, 0.5], [0.5, 1, 1.5]], atol=1e-12)
    assert (triangle.name, cube.name) == ("things", "things_2")


CONE = {"type": "cone", "dimensions": [0.4, 0.1]}


def octomap(data: list[int]) -> dict[str, object]:
    message = {"binary": True, "id": "OcTree", "resolution": 0.1, "data": data}
    origin = {"position": [0, 0, 1], "orientation": [0, 0, 0, 1]}
    return {"world": {"octomap": {"header": {"frame_id": "world"}, "origin": origin, "octomap": message}}}


def test_cones_planes_and_octomaps() -> None:
    place = {"position": [1, 0, 0], "orientation": [0, 0, 0, 1]}
    [cone] = shapes_of(scene_data(**ball(primitives=[CONE], primitive_poses=[place])))
    assert isinstance(cone, rd.Mesh)
    np.testing.assert_allclose(cone.bounds, [[0.9, -0.1, -0.2], [1.1, 0.1, 0.2]], atol=1e-3)
    [ground] = shapes_of(scene_data(id="ground", planes=[{"coef": [0, 0, 2, -1]}], plane_poses=[place]))
    assert isinstance(ground, rd.Box) and ground.name == "ground"
    np.testing.assert_allclose(ground.bounds[1], [11, 10, 0.5])
    [cloud] = shapes_of(octomap([-1 & 3, 0] + 14 * [3, 0] + [2, 0]))  # the voxel at the lower end of everything
    assert isinstance(cloud, rd.PointCloud) and cloud.point_radius == pytest.approx(0.05 * 3**0.5)
    np.testing.assert_allclose(cloud.points, [np.array([0, 0, 1]) - 0.1 * (2**15 - 0.5)])


ZERO = {"position": [0, 0, 0], "orientation": [0, 0, 0, 0]}
ELSEWHERE = {"meshes": [{"resource": "package://a/b.stl"}], "mesh_poses": ball()["primitive_poses"]}
WRONG_SCENES: dict[str, tuple[object, str]] = {
    "prism": (scene_data(**ball(primitives=[CONE | {"type": 5}])), "unknown type of .*'prism'; known"),
    "poses": (scene_data(**ball(primitive_poses=[])), "has 1 primitives and 0 primitive_poses"),
    "quaternion": (scene_data(**ball(primitive_poses=[ZERO])), r"ball: primitive_poses\[0\].orientation .* must not be zero"),
    "frame": (scene_data(**ball(header={"frame_id": "moon"})), "header: 'moon'; known: panda_link0, world"),
    "removed": (scene_data(**ball(operation=1)), r"operation is 1; only objects that are added \(0\) or appended \(2\) can be"),
    "plane": (scene_data(**ball(planes=[{"coef": [0, 0, 0, 1]}])), "must not all be zero"),
    "planes": (scene_data(**ball(planes=[{"coef": [0, 0, 1, 1]}] * 2000)), "2,000 planes; at most 1,000"),
    "package": (scene_data(**ball(**ELSEWHERE)), r"object ball: meshes\[0\].resource is package://a/b.stl"),
    "objects": ({"world": {"collision_objects": {}, "octomap": {"octomap": {"data": [1]}}}}, "not binary"),
    "octomap": (octomap([3, 0]), "world.octomap: the tree ends too soon"),
    "octomap of no bytes": (octomap([300, 0]), r"octomap.data is \[300, 0\]; it must be 2 finite numbers within ±255"),
    "a problem": ({"robot": "panda", "scene": []}, "unknown field of a planning scene: 'robot'"),
    "misspelled world": ({"world": {"objects": []}}, "unknown field of world: 'objects'"),
    "misspelled object": (scene_data(primitive=[]), "unknown field of the object: 'primitive'; .* mean primitives"),
    "empty": (None, "a planning scene is None"),
    "misspelled state": ({"robot_state": {"joint_states": {}}}, "unknown field of robot_state: 'joint_states'"),
    "attached": ({"robot_state": {"attached_collision_objects": [1]}}, "attached_collision_objects"),
}


@pytest.mark.parametrize(("data", "message"), WRONG_SCENES.values(), ids=WRONG_SCENES)
def test_wrong_scenes(data: object, message: str, tmp_path: Path) -> None:
    file = write_record(tmp_path, data, "scene.yaml")
    refuses(f"^{re.escape(str(file))}.*{message}", moveit.read_moveit_scene, file, PANDA)


LINKS = ("hand", "finger")


def matrix(names: list[str], pairs: list[tuple[str, str]], **defaults: bool) -> dict[str, Any]:
    enabled = {frozenset(pair) for pair in pairs}
    return {
        "entry_names": names,
        "entry_values": [{"enabled": [frozenset((a, b)) in enabled for b in names]} for a in names],
        "default_entry_names": list(defaults),
        "default_entry_values": list(defaults.values()),
    }


def test_pairs_of_links_and_objects_count_and_defaults_decide_where_no_pair_does() -> None:
    data = matrix(["hand", "finger", "can", "stale"], [("hand", "can"), ("hand", "finger"), ("stale", "can")])
    assert moveit.matrix_contacts(data, ["can", "board"], LINKS) == {"can": ("hand",)}
    data = matrix(["hand", "can"], [], can=True, board=True, finger=False)
    assert moveit.matrix_contacts(data, ["can", "board"], LINKS) == {"board": ("hand",)}
    assert moveit.matrix_contacts(matrix([], [], can=True), ["can"], LINKS) == {"can": LINKS}
    assert moveit.matrix_contacts(None, ["can"], LINKS) == {}
    rows = {"entry_names": ["hand", "<octomap>"], "entry_values": [[0, 1], [1, 0]]}
    assert moveit.matrix_contacts(rows, ["octomap"], LINKS) == {"octomap": ("hand",)}
    for damaged in ({"entry_names": ["hand", "can"], "entry_values": [[0, 1]]}, {"entry_names": "hand"}, ["hand"]):
        refuses("allowed_collision_matrix", moveit.matrix_contacts, damaged, ["can"], LINKS)


def test_a_scene_and_a_problem_file_allow_contacts(tmp_path: Path) -> None:
    shutil.copytree(MOTION_BENCH_MAKER, tmp_path, dirs_exist_ok=True)
    file = tmp_path / "scene0001.yaml"
    data = read_yaml(file)
    names = [entry["id"] for entry in data["world"]["collision_objects"]]
    data["allowed_collision_matrix"] = matrix(["panda_hand", names[0], "gone"], [("panda_hand", names[0])])
    file.write_text(yaml.safe_dump(data))
    scene, *_ = moveit.read_moveit_scene(file, PANDA)
    assert scene.allowed_contacts == ((names[0], ("panda_hand",)),)
    problem = {"robot": "panda", "scene": "scene0001.yaml", "request": "request0001.yaml"}
    loaded = rd.load_problem(write_record(tmp_path, problem | {"allowed_contacts": {names[1]: "all"}}))
    assert loaded.scene.allowed_contacts == ((names[0], ("panda_hand",)), (names[1], "all"))


UR5_JOINTS = ["shoulder_pan_joint", "shoulder_lift_joint", "elbow_joint", *(f"wrist_{i}_joint" for i in (1, 2, 3))]


def ur5_files(folder: Path, model: str, more: list[str]) -> Path:
    """A problem file of `ur5`, with a MoveIt scene and request of a robot that has further joints."""
    here = {"joint_state": {"name": [*UR5_JOINTS, *more], "position": [0.0] * (6 + len(more))}}
    here["multi_dof_joint_state"] = {"joint_names": ["virtual_joint"]}
    goal = [{"joint_name": name, "position": 0.1} for name in UR5_JOINTS]
    scene = {"robot_model_name": model, "robot_state": here, "world": {}}
    request = {"start_state": here, "goal_constraints": [{"joint_constraints": goal}]}
    problem = {"robot": "ur5", "scene": "scene0001.yaml", "request": "request0001.yaml"}
    for name, data in {"scene0001": scene, "request0001": request, "problem": problem}.items():
        (folder / f"{name}.yaml").write_text(yaml.safe_dump(data))
    return folder / "problem.yaml"


def test_files_of_another_robot_are_refused_by_its_joints(tmp_path: Path) -> None:
    """Regression: 224 of 238 motions collided, since scenes of a UR5 with stand and gripper were used for a UR5 alone."""
    file = ur5_files(tmp_path, "ur5_robotiq85", ["gripper_finger1_joint"])
    values = "robot_state.joint_state has values of gripper_finger1_joint, movable joints that ur5 lacks"
    text = refuses(values, rd.load_problem, file)
    assert "robot_model_name is ur5_robotiq85" in text and "its movable joints are shoulder_pan_joint, " in text
    ur5 = rd.load_robot("ur5")
    refuses(r"scene0001.yaml: .* gripper_finger1_joint", moveit.read_moveit_scene, tmp_path / "scene0001.yaml", ur5)
    [entry] = load_motion_bench_maker(tmp_path, ur5)
    assert "gripper_finger1_joint" in entry.error
    scene = read_yaml(tmp_path / "scene0001.yaml")
    del scene["robot_state"]["joint_state"]
    (tmp_path / "scene0001.yaml").write_text(yaml.safe_dump(scene))
    refuses(r"start_state.joint_state has values of gripper_finger1_joint", rd.load_problem, file)


def test_joints_that_the_robot_lacks_can_be_ignored_and_another_model_name_is_a_note(tmp_path: Path) -> None:
    notes = rd.load_problem(ur5_files(tmp_path, "ur5_robotiq85", ["gripper_finger1_joint"]), ignore_joints=True).notes
    assert "the scene's robot_model_name is ur5_robotiq85; planned for ur5" in notes
    assert "start_state.joint_state: ignored gripper_finger1_joint, which ur5 lacks" in notes
    [entry] = load_motion_bench_maker(tmp_path, rd.load_robot("ur5"), ignore_joints=True)
    assert entry.load().notes == notes
    moveit.read_moveit_scene(tmp_path / "scene0001.yaml", rd.load_robot("ur5"), ignore_joints=True)
    notes = rd.load_problem(ur5_files(tmp_path, "ur5_lab", [])).notes
    assert notes == ("the scene's robot_model_name is ur5_lab; planned for ur5",)
    assert rd.load_problem(ur5_files(tmp_path, "ur5", [])).notes == ()


def test_fixed_joints_of_the_robot_are_known_where_they_stand(tmp_path: Path) -> None:
    fixed = next(joint.name for joint in rd.load_robot("ur5").joints if joint.kind == "fixed")
    file = ur5_files(tmp_path, "ur5", [fixed])
    assert rd.load_problem(file).notes == ()
    request = read_yaml(tmp_path / "request0001.yaml")
    change(request, ["start_state", "joint_state", "position", 6], 0.3)  # type: ignore[arg-type]
    (tmp_path / "request0001.yaml").write_text(yaml.safe_dump(request))
    refuses(f"has values of {fixed}, movable joints that ur5 lacks", rd.load_problem, file)


def test_a_mimic_joint_elsewhere_than_its_master_puts_it_is_a_note(tmp_path: Path) -> None:
    slide = {"kind": "prismatic", "axis": "0 1 0", "limits": 'lower="0" upper="0.04"'}
    follow = joint("follow", "arm", "right", more='<mimic joint="grip"/>', **slide)
    robot = mounted(tmp_path, "fixed", link("left", ""), joint("grip", "arm", "left", **slide), link("right", ""), follow)
    here = {"joint_state": {"name": ["turn", "grip", "follow"], "position": [0, 0.03, 0.01]}}
    goal = {"joint_constraints": [{"joint_name": "turn", "position": 0.1}]}
    (tmp_path / "scene0001.yaml").write_text("{}")
    (tmp_path / "request0001.yaml").write_text(yaml.safe_dump({"start_state": here, "goal_constraints": [goal]}))
    [entry] = load_motion_bench_maker(tmp_path, robot)
    assert entry.load().notes == ("start_state: follow is 0.01, but it mimics grip and is held at 0.03",)


def pose_constraint() -> dict[str, Any]:
    region = {"primitive_poses": [{"position": [0.4, 0, 0.5], "orientation": [0, 0, 0, 1]}]}
    return {
        "position_constraints": [{"link_name": "panda_hand", "constraint_region": region}],
        "orientation_constraints": [{"link_name": "panda_hand", "orientation": [1, 0, 0, 0]}],
    }


def asked(folder: Path, data: dict[str, Any]) -> ProblemEntry:
    """The first problem of MotionBenchMaker, with this request."""
    for file in MOTION_BENCH_MAKER.glob("*0001.yaml"):
        shutil.copy(file, folder)
    (folder / "request0001.yaml").write_text(yaml.safe_dump(data))
    return load_motion_bench_maker(folder)[0]


def test_several_goal_constraints_are_a_set_and_one_without_a_joint_is_refused(tmp_path: Path) -> None:
    data = request_data()
    data["goal_constraints"].append(deepcopy(data["goal_constraints"][0]))
    assert len(moveit.moveit_request(data, moveit.moveit_frames({}, PANDA)).joint_goals) == 2
    del data["goal_constraints"][0]["joint_constraints"][3]
    assert "goal_constraints[0] has no panda_joint4" in asked(tmp_path, data).error


def test_pose_goal(tmp_path: Path) -> None:
    data = request_data() | {"goal_constraints": [pose_constraint()]}
    goal = asked(tmp_path, data).load().goal
    assert isinstance(goal, rd.PoseGoal) and goal.frame == "panda_hand"
    np.testing.assert_allclose(goal.T_base_frame[:3, 3], [0.4, 0, 0.5])
    np.testing.assert_allclose(goal.T_base_frame[:3, :3], np.diag([1.0, -1, -1]), atol=1e-12)
    link, T = moveit.moveit_request(data, moveit.MoveItFrames({"": np.diag([-1.0, -1, 1, 1])})).pose_goal or ("", np.eye(4))
    assert link == "panda_hand"
    np.testing.assert_allclose(T[:3, 3], [-0.4, 0, 0.5])
    flipped = np.diag([-1.0, -1, 1]) @ rotation_from_quaternion(np.array([0.0, 1, 0, 0]))
    np.testing.assert_allclose(T[:3, :3], flipped, atol=1e-12)


def test_wide_tolerances_of_a_pose_goal_are_noted() -> None:
    goal = pose_constraint()
    data = request_data() | {"goal_constraints": [goal]}
    region = goal["position_constraints"][0]["constraint_region"]
    region["primitives"] = [{"type": "sphere", "dimensions": [0.001]}]
    assert not moveit.moveit_request(data, moveit.moveit_frames({}, PANDA)).notes
    region["primitives"] = [{"type": "sphere", "dimensions": [0.1]}]
    goal["orientation_constraints"][0]["absolute_z_axis_tolerance"] = 3.1
    [note] = moveit.moveit_request(data, moveit.moveit_frames({}, PANDA)).notes
    assert "ignored region of 0.1 m, tolerance of 3.1 rad" in note


@pytest.mark.parametrize("frame", ["panda_hand", "world"])
def test_objects_are_held_at_the_start(frame: str, tmp_path: Path) -> None:
    bare = asked(tmp_path, request_data()).load()
    T_hand_rod = transform(np.array([0.0, 0.0, 0.2]))
    T = bare.robot.fk(bare.start, "panda_hand") @ T_hand_rod if frame == "world" else T_hand_rod
    x, y, z, w = np.roll(quaternion_from_rotation(T[:3, :3]), -1).tolist()
    cylinder = [{"type": "cylinder", "dimensions": [0.2, 0.01]}]
    at = [{"position": T[:3, 3].tolist(), "orientation": [x, y, z, w]}]
    shape = ball(id="rod", header={"frame_id": frame}, primitives=cylinder, primitive_poses=at)
    held = {"link_name": "panda_hand", "touch_links": ["panda_link6", "no_link_of_it"], "object": shape}
    problem = asked(tmp_path, change(request_data(), ["start_state", "attached_collision_objects"], [held])).load()
    [rod] = problem.robot.attached
    assert rod.name == "rod" and rod.touch_links == ("panda_link6",)
    np.testing.assert_allclose(rod.T_link_body, T_hand_rod, atol=1e-9)
    T_world = problem_record(problem)["attached"][0]["cylinder"]  # type: ignore[index]
    np.testing.assert_allclose(T_world["center"], [0, 0, 0.2], atol=1e-9)
    for several in ("primitives", "primitive_poses"):  # Regression: of two shapes, files held only the first
        shape[several] *= 2
    problem = asked(tmp_path, change(request_data(), ["start_state", "attached_collision_objects"], [held])).load()
    refuses("rod has the shapes .*; a problem file holds only shapes of scenes, and exactly one", problem_record, problem)


def pose_request(path: list[Any], value: object) -> dict[str, Any]:
    return request_data() | {"goal_constraints": [change(pose_constraint(), path, value)]}


def test_scaling_factors_padding_and_the_velocity_of_a_start_state_are_noted() -> None:
    data: dict[str, Any] = request_data() | {"max_velocity_scaling_factor": 0.1, "max_acceleration_scaling_factor": 1.0}
    data["start_state"]["joint_state"]["velocity"] = [0.0, 0.3]
    assert {*moveit.moveit_request(data, moveit.moveit_frames({}, PANDA)).notes} == {
        "the request's max_velocity_scaling_factor 0.1 is ignored: plan with velocity_scaling=0.1",
        "start_state.joint_state.velocity [0.0, 0.3] is ignored: the motion begins at rest",
    }
    padded = [{"link_name": "panda_hand", "padding": 0.02}, {"link_name": "b", "padding": 0.0}]
    [change, ignored] = moveit.scene_robot_notes({"link_padding": padded, "is_diff": True}, PANDA)
    assert "is a difference (is_diff)" in change and ignored == "the scene's link_padding of panda_hand is ignored"


TWICE = {"name": ["a", "b", "a"], "position": [0.0, 0.5, 1.0]}


def test_wrong_requests() -> None:
    attached = ["start_state", "attached_collision_objects"]
    poses = [pose_constraint(), pose_constraint()]
    nameless = pose_request(["position_constraints", 0, "link_name"], None)
    nameless = change(nameless, ["goal_constraints", 0, "orientation_constraints", 0, "link_name"], None)
    for data, message in (
        (request_data() | {"goal_constraints": []}, "goal_constraints is empty"),
        (request_data() | {"path_constraints": {"joint_constraints": [1]}}, "path_constraints"),
        (request_data() | {"max_velocity_scaling_factor": 2}, "is 2; it must be a number from 0 to 1"),
        (change(request_data(), attached, [1]), r"attached_collision_objects\[0\] is 1; it must be a mapping"),
        (change(request_data(), attached, [{"touch_link": []}]), r"unknown field of .*\[0\]: 'touch_link'"),
        (request_data() | {"start_state": {"attached_collision_object": []}}, "unknown field of start_state"),
        (request_data() | {"start_state": {"joint_state": TWICE}}, "joint_state has a more than once"),
        (nameless, "link_name is None; it must be the name"),
        (request_data() | {"goal_constraints": poses}, "joint_constraints alone; only a single goal may be a pose"),
        (pose_request(["orientation_constraints"], []), "one position and one orientation"),
        (pose_request(["position_constraints", 0, "target_point_offset"], [0, 0, 1]), "must be zero"),
    ):
        refuses(message, moveit.moveit_request, data, moveit.moveit_frames({}, PANDA))


Z = np.array([0.0, 0.0, 1.0])


def wheels(second: str) -> tuple[str, ...]:
    """Joints above a base that stand for its wheels: two slides, the second of which has this axis, and a turn."""
    return (
        joint("to_x", "root", "x", "prismatic", xyz="0 0 0", axis="1 0 0"),
        joint("to_y", "x", "y", "prismatic", xyz="0 0 0", axis=second),
        joint("yaw", "y", "base", "continuous", xyz="0 0 0", axis="0 0 1", limits=""),
    )


PLANAR = '<joint name="drive" type="planar"><parent link="root"/><child link="base"/></joint>'
WHEELS = {
    "three joints": wheels("0 1 0"),
    "a planar joint": (PLANAR, joint("a", "base", "x", "fixed"), joint("b", "base", "y", "fixed")),
}


def wheeled(folder: Path, above: tuple[str, ...]) -> rd.Robot:
    """An arm whose base has these joints above it."""
    return read_urdf(written(folder, *(link(name, "") for name in ("root", "x", "y")), *above, TURN), base="base")


def place(data: dict[str, Any], robot: rd.Robot = PANDA) -> list[float]:
    [shape] = shapes_of(data, robot)
    assert isinstance(shape, rd.Sphere)
    return shape.center.round(9).tolist()


def at(frame: str, **more: object) -> dict[str, Any]:
    pose = {"position": [0, 0, 0], "orientation": [0, 0, 0, 1]}
    return scene_data(**ball(header={"frame_id": frame}, primitive_poses=[pose])) | more


def state(frame: str, *translations: list[float]) -> dict[str, Any]:
    transforms = [{"translation": xyz, "rotation": [0, 0, 0, 1]} for xyz in translations]
    floating = {"header": {"frame_id": frame}, "joint_names": ["virtual"], "transforms": transforms}
    return {"robot_state": {"multi_dof_joint_state": floating}}


def mounted(folder: Path, kind: str, *more: str) -> rd.Robot:
    """An arm on a stand, stored as by `robot add --base base`, but without spheres, whose fitting takes long."""
    rail = joint("rail", "stand", "base", kind, xyz="0 0 0.3", axis="1 0 0")
    file = written(folder, link("world", ""), link("stand", ""), MOUNT, rail, TURN, *more)
    write_robot_folder(read_urdf(file, base="base", tip="arm"), folder / "mounted", {})
    return read_robot_folder(folder / "mounted")


def test_poses_compose_from_the_base_outwards() -> None:
    """The base is moved to [1, 0, 0] and turned; frame, object and part of the object each have an offset and a rotation."""
    data = scene_data(**ball(header={"frame_id": "table"}, pose={"position": [0, 2, 0], "orientation": QUARTER}))
    data["robot_state"] = {"multi_dof_joint_state": {"transforms": [{"translation": [1, 0, 0], "rotation": QUARTER}]}}
    table = {"translation": [0, 0, 5], "rotation": QUARTER}
    data["fixed_frame_transforms"] = [
        {"transform": {"translation": [0, 0, 0], "rotation": [0, 0, 0, 1]}, "child_frame_id": "world"},
        {"header": {"frame_id": "world"}, "transform": table, "child_frame_id": "table"},
    ]
    turn = rotation_about(Z, np.pi / 2)
    in_object = np.array([1.0, 0, 0])
    in_world = np.array([0, 0, 5.0]) + turn @ (np.array([0, 2.0, 0]) + turn @ in_object)
    expected = turn.T @ (in_world - np.array([1.0, 0, 0]))
    np.testing.assert_allclose(place(data), expected, atol=1e-9)
    data["world"]["collision_objects"][0]["header"]["frame_id"] = "panda_link0"
    expected = np.array([0, 2.0, 0]) + turn @ in_object
    np.testing.assert_allclose(place(data), expected, atol=1e-9)


def test_scene_in_the_world_of_a_robot_whose_base_moves_there_is_refused(tmp_path: Path) -> None:
    robot = mounted(tmp_path, "prismatic")
    fixed = {"transform": {"translation": [0, 0, 0], "rotation": [0, 0, 0, 1]}, "child_frame_id": "world"}
    refuses("a joint moves base relative to world", place, at("world", fixed_frame_transforms=[fixed]), robot)
    assert place(at("base"), robot) == [0, 0, 0]


@pytest.mark.parametrize("above", WHEELS.values(), ids=WHEELS)
def test_a_scene_places_what_a_mobile_base_carries(tmp_path: Path, above: tuple[str, ...]) -> None:
    """Regression: every scene was refused for a Fetch whose URDF has joints for its wheels, since they move its base."""
    robot = wheeled(tmp_path, above)
    assert robot.root == robot.base == "base"
    assert place(at("world", **state("world", [0.5, 0, 0])), robot) == [-0.5, 0, 0]


def test_a_lift_is_no_mobile_base(tmp_path: Path) -> None:
    assert wheeled(tmp_path, wheels("0 0 1")).root == "root"


def test_scene_in_a_frame_that_the_robot_is_placed_in(tmp_path: Path) -> None:
    """In `odom`, in which multi_dof_joint_state places the root; `world` is then unknown."""
    robot = mounted(tmp_path, "fixed")
    base_in_root = np.array([1, 2, 0.8])
    expected = (rotation_about(Z, np.pi / 2).T @ (-np.array([3.0, 0, 0]) - base_in_root)).round(9).tolist()
    for frame in ("odom", "/odom", ""):
        assert place(at(frame, **state("odom", [3, 0, 0])), robot) == expected
    refuses(r"unknown frame_id of header: 'world'; known: odom, panda_link0", place, at("world", **state("odom", [3, 0, 0])))
    for named in ("world", "panda_link0", ""):
        assert place(at("world", **state(named, [3, 0, 0]))) == [-3, 0, 0]
    refuses("has 2 transforms; it must have one", place, at("world", **state("odom", [3, 0, 0], [0, 0, 0])))


def test_links_of_the_robot_are_frames_where_they_stand(tmp_path: Path) -> None:
    """Regression: `robot add --base` dropped the transform between root and base: verified motions were in collision."""
    eye = joint("eye", "base", "camera", "fixed", xyz="0 0 1")
    on = joint("on", "map", "world", "fixed", xyz="0 0 7")
    robot = mounted(tmp_path, "fixed", link("map", ""), link("camera", ""), on, eye)
    assert place(at("camera"), robot) == [0, 0, 1]
    assert place(at("base"), robot) == [0, 0, 0]
    assert place(at("world"), robot) == [-2, 1, -0.8]  # which is not the root here
    assert place(at(""), robot) == [-2, 1, -7.8]
    fixed = {"transform": {"translation": [9, 9, 9], "rotation": [0, 0, 0, 1]}, "child_frame_id": "stand"}
    assert place(at("stand", fixed_frame_transforms=[fixed]), robot) == [0, 0, -0.3]  # files cannot move links
    refuses(r"unknown frame_id of header: 'arm'; known: base, camera, map", place, at("arm"), robot)


def test_contacts_of_an_object_of_several_parts_are_not_those_of_another() -> None:
    """Regression: the second part of `a` was renamed `a_2`, and the object a_2 could be touched like it."""
    two = {key: ball()[key] * 2 for key in ("primitives", "primitive_poses")}
    data = {"world": {"collision_objects": [ball(id="a", **two), ball(id="a_2")]}}
    scene = moveit.moveit_scene(data, moveit.moveit_frames(data, PANDA), Path(), PANDA.link_names, [("a", ["panda_hand"])])
    assert [name for name, _ in scene.allowed_contacts] == ["a", "a_2"]  # the object a_2 is now a_2_2


def test_what_a_request_leaves_out_or_asks_in_vain(tmp_path: Path) -> None:
    """Regressions: fingers were not where the scene has them; tolerances and held objects without shapes were dropped."""
    start = asked(tmp_path, request_data()).load().start
    joints = request_data()["start_state"]["joint_state"]
    (tmp_path / "scene0001.yaml").write_text(yaml.safe_dump(change(scene_data(), ["robot_state"], {"joint_state": joints})))
    data = request_data() | {"start_state": {"is_diff": True}}
    (tmp_path / "request0001.yaml").write_text(yaml.safe_dump(data))
    np.testing.assert_array_equal(load_motion_bench_maker(tmp_path, PANDA)[0].load().start, start)
    data = request_data()
    data["goal_constraints"][0]["joint_constraints"][2]["tolerance_above"] = 1.5
    data["start_state"]["attached_collision_objects"] = [{"link_name": "panda_hand", "object": {"id": "cup"}}]
    cup, tolerance = moveit.moveit_request(data, moveit.moveit_frames({}, PANDA)).notes
    assert tolerance.endswith("its tolerance of 1.5 is ignored") and "panda_hand holds, has no shapes" in cup


def test_frames_are_read_as_moveit_writes_them() -> None:
    """Regression: the pose of `world` in the planning frame was dropped, and other frames of TF were refused."""
    shift = {"translation": [0, 0, 0.8], "rotation": [0, 0, 0, 1]}
    for frame, child in (("world", "panda_link0"), ("camera", "world")):
        fixed = {"header": {"frame_id": frame}, "child_frame_id": child, "transform": shift}
        assert place(at(frame, fixed_frame_transforms=[fixed])) == [0, 0, 0.8]


def test_unknown_fields_operations_and_texts_in_a_matrix_are_refused() -> None:
    """Regressions: a field path_constraint was ignored, an object to REMOVE became an obstacle, "false" allowed contact."""
    for where in ([], ["goal_constraints", 0]):
        data = change(request_data(), [*where, "path_constraint"], {})
        refuses("unknown field of .*'path_constraint'", moveit.moveit_request, data, moveit.moveit_frames(scene_data(), PANDA))
    refuses("operation is 'REMOVE'", shapes_of, scene_data(**ball(operation="REMOVE")))
    texts = {"entry_names": ["can"], "entry_values": [["false"]]}
    for part in (texts, {"default_entry_names": ["can"], "default_entry_values": []}):
        refuses("default_entry_values|must be true or false", moveit.matrix_contacts, part, ["can"], ["panda_hand"])


def test_locked_joints_stay_locked_in_a_request(tmp_path: Path) -> None:
    """Regression: a joint that the problem locks was held at its value in the request instead."""
    for name, data in (("s.json", scene_data()), ("r.json", request_data())):
        write_record(tmp_path, data, name)
    files = {"robot": "panda", "scene": "s.json", "request": "r.json", "locked": {"panda_joint7": 0.3}}
    assert rd.load_problem(write_record(tmp_path, files)).robot.locked["panda_joint7"] == 0.3


def test_joints_that_are_not_planned_stand_where_the_scene_has_them(tmp_path: Path) -> None:
    """Regression: without a request, robot_state was ignored: the other arm stood at 0, and motions into it were valid."""
    write_record(tmp_path, {"robot_state": {"joint_state": {"name": ["right_s0"], "position": [1.5]}}}, "scene.yaml")
    ends = {"start": [0, -0.5, 0, 1, 0, 1, 0], "goal": {"joints": [0.1, -0.5, 0, 1, 0, 1, 0]}}
    problem = write_record(tmp_path, {"robot": "baxter_left", "scene": "scene.yaml", **ends})
    assert rd.load_problem(problem).robot.locked["right_s0"] == 1.5
