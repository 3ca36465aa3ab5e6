"""Joints of MoveIt files that the robot has, lacks, or holds elsewhere."""

from pathlib import Path

import pytest
import yaml

from helpers.moveit_files import MOUNTED, change
from helpers.urdfs import read_urdf
from robotdiffuse import InputError, load_problem, load_robot
from robotdiffuse.core.input_files import read_yaml
from robotdiffuse.problems.files import load_motion_bench_maker
from robotdiffuse.problems.moveit import moveit_frames, object_shapes, read_moveit_scene, scene_robot_notes

UR5_JOINTS = [
    *("shoulder_pan_joint", "shoulder_lift_joint", "elbow_joint"),
    *("wrist_1_joint", "wrist_2_joint", "wrist_3_joint"),
]


def ur5_files(folder: Path, model: str, more: list[str]) -> Path:
    """A problem file of `ur5`, beside a MoveIt scene and request of a robot with further joints."""
    names = [*UR5_JOINTS, *more]
    zeros = [0.0] * (6 + len(more))
    here = {"joint_state": {"name": names, "position": zeros}}
    here["multi_dof_joint_state"] = {"joint_names": ["virtual_joint"]}
    goal = [{"joint_name": name, "position": 0.1} for name in UR5_JOINTS]
    scene = {"robot_model_name": model, "robot_state": here, "world": {}}
    request = {"start_state": here, "goal_constraints": [{"joint_constraints": goal}]}
    problem = {"robot": "ur5", "scene": "scene0001.yaml", "request": "request0001.yaml"}
    for name, data in {"scene0001": scene, "request0001": request, "problem": problem}.items():
        (folder / f"{name}.yaml").write_text(yaml.safe_dump(data))
    return folder / "problem.yaml"


def test_files_of_another_robot_are_refused_by_its_joints(tmp_path: Path) -> None:
    """A UR5 on the table took scenes of one on a stand with a gripper: 224 of 238 motions met something."""
    file = ur5_files(tmp_path, "ur5_robotiq85", ["gripper_finger1_joint"])
    with pytest.raises(InputError) as raised:
        load_problem(file)
    text = str(raised.value)
    assert (
        "robot_state.joint_state has values of gripper_finger1_joint, movable joints that ur5 lacks" in text
    )
    assert "robot_model_name is ur5_robotiq85" in text and "its own are shoulder_pan_joint, " in text
    with pytest.raises(InputError, match=r"scene0001.yaml: .* gripper_finger1_joint"):
        read_moveit_scene(tmp_path / "scene0001.yaml", load_robot("ur5"))
    [entry] = load_motion_bench_maker(tmp_path, load_robot("ur5"))
    assert "gripper_finger1_joint" in entry.error
    scene = read_yaml(tmp_path / "scene0001.yaml")
    assert isinstance(scene, dict)
    del scene["robot_state"]["joint_state"]
    (tmp_path / "scene0001.yaml").write_text(yaml.safe_dump(scene))
    with pytest.raises(InputError, match=r"start_state.joint_state has values of gripper_finger1_joint"):
        load_problem(file)


def test_joints_that_the_robot_lacks_can_be_ignored(tmp_path: Path) -> None:
    file = ur5_files(tmp_path, "ur5_robotiq85", ["gripper_finger1_joint"])
    notes = load_problem(file, ignore_joints=True).notes
    assert "the scene's robot_model_name is ur5_robotiq85; planned for ur5" in notes
    assert "start_state.joint_state: ignored gripper_finger1_joint, which ur5 lacks" in notes
    [entry] = load_motion_bench_maker(tmp_path, load_robot("ur5"), ignore_joints=True)
    assert entry.load().notes == notes
    read_moveit_scene(tmp_path / "scene0001.yaml", load_robot("ur5"), ignore_joints=True)


def test_another_model_name_with_known_joints_is_a_note(tmp_path: Path) -> None:
    notes = load_problem(ur5_files(tmp_path, "ur5_lab", [])).notes
    assert notes == ("the scene's robot_model_name is ur5_lab; planned for ur5",)
    assert load_problem(ur5_files(tmp_path, "ur5", [])).notes == ()


def test_fixed_joints_of_the_robot_are_known_where_they_stand(tmp_path: Path) -> None:
    fixed = next(joint.name for joint in load_robot("ur5").joints if joint.kind == "fixed")
    file = ur5_files(tmp_path, "ur5", [fixed])
    assert load_problem(file).notes == ()
    request = read_yaml(tmp_path / "request0001.yaml")
    change(request, ["start_state", "joint_state", "position", 6], 0.3)  # type: ignore[arg-type]
    (tmp_path / "request0001.yaml").write_text(yaml.safe_dump(request))
    with pytest.raises(InputError, match=f"has values of {fixed}, movable joints that ur5 lacks"):
        load_problem(file)


def test_a_mimic_joint_elsewhere_than_its_master_puts_it_is_a_note(tmp_path: Path) -> None:
    fingers = """<link name="left"/><link name="right"/>
      <joint name="grip" type="prismatic"><parent link="arm"/><child link="left"/><axis xyz="0 1 0"/>
        <limit lower="0" upper="0.04" velocity="1" effort="1"/></joint>
      <joint name="follow" type="prismatic"><parent link="arm"/><child link="right"/><axis xyz="0 1 0"/>
        <limit lower="0" upper="0.04" velocity="1" effort="1"/><mimic joint="grip"/></joint></robot>"""
    (tmp_path / "arm.urdf").write_text(MOUNTED.format(kind="fixed").replace("</robot>", fingers))
    robot = read_urdf(tmp_path / "arm.urdf", base="base", tip="arm")
    here = {"joint_state": {"name": ["turn", "grip", "follow"], "position": [0, 0.03, 0.01]}}
    goal = {"joint_constraints": [{"joint_name": "turn", "position": 0.1}]}
    (tmp_path / "scene0001.yaml").write_text("{}")
    request = {"start_state": here, "goal_constraints": [goal]}
    (tmp_path / "request0001.yaml").write_text(yaml.safe_dump(request))
    [entry] = load_motion_bench_maker(tmp_path, robot)
    assert entry.load().notes == ("start_state: follow is 0.01; planned at 0.03, which grip implies",)


def test_padding_and_scale_of_links_are_noted() -> None:
    data = {
        "link_padding": [
            {"link_name": "panda_hand", "padding": 0.02},
            {"link_name": "b", "padding": 0.0},
        ],
        "link_scale": [{"link_name": "panda_hand", "scale": 1.1}, {"link_name": "other", "scale": 1.0}],
    }
    assert scene_robot_notes(data, load_robot("panda")) == (
        "the scene's link_padding of panda_hand is ignored",
        "the scene's link_scale of panda_hand is ignored",
    )


def test_an_object_of_too_many_planes_is_one_line() -> None:
    planes = [{"coef": [0, 0, 1, 1]}] * 100_000
    with pytest.raises(InputError, match="has 100,000 planes; at most 1,000"):
        object_shapes({"id": "a", "planes": planes}, moveit_frames({}), Path())
