"""Equal robots are one object per process, so that derived data is computed once."""

import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np

import robotdiffuse as rd
from helpers.box_arm import box_arm
from helpers.refusals import refuses
from robotdiffuse.collision.kernel_arrays import compile_robot
from robotdiffuse.problems.files import load_problem, save_problem
from robotdiffuse.robots.robot_folder import MESH_FILE, ROBOT_FILE, write_robot_folder

LEFT = "panda_finger_joint1"
RIGHT = "panda_finger_joint2"


def test_fifty_problem_files_with_locked_joints_share_one_robot(tmp_path: Path) -> None:
    """Regression: each file made a new object, whose arrays its first plan prepared: 95 ms per plan instead of 18."""
    robot = rd.load_robot("panda", locked={LEFT: 0.035, RIGHT: 0.035})
    start = (robot.lower + robot.upper) / 2
    for i in range(50):
        scene = rd.Scene([rd.Sphere([0.6, 0.0, 0.01 * i], 0.1)])
        save_problem(rd.Problem(robot, scene, start, start + 0.1), tmp_path / f"{i}.yaml")
    for i in range(50):
        loaded = load_problem(tmp_path / f"{i}.yaml").robot
        assert loaded is robot and compile_robot(loaded) is compile_robot(robot)


def test_equal_locked_values_are_one_robot() -> None:
    panda = rd.load_robot("panda")
    both = panda.with_locked({LEFT: 0.01, RIGHT: 0.02})
    assert both is panda.with_locked({RIGHT: 0.02, LEFT: 0.01})
    assert both is panda.with_locked({LEFT: 0.01}).with_locked({RIGHT: 0.02})
    assert both is rd.load_robot("panda", locked={LEFT: 0.01, RIGHT: 0.02})
    assert both is not panda.with_locked({LEFT: 0.01, RIGHT: 0.03})
    assert both.with_locked(panda.locked) is panda is panda.with_locked({}) is rd.load_robot("panda")
    assert both.locked == {LEFT: 0.01, RIGHT: 0.02} and both.unlocked is panda
    assert replace(panda, tip="panda_link7").with_locked({LEFT: 0.01, RIGHT: 0.02}) is not both


def test_a_folder_that_changes_is_read_again(tmp_path: Path) -> None:
    arm = box_arm()
    write_robot_folder(arm, tmp_path / "arm", {"urdf": "arm.urdf"})
    first = rd.load_robot(tmp_path / "arm")
    assert rd.load_robot(str(tmp_path / "arm")) is first and first.name == arm.name
    longer = replace(arm, spheres={link: rows * 1.5 for link, rows in arm.spheres.items()})
    write_robot_folder(longer, tmp_path / "arm", {"urdf": "arm.urdf"})
    second = rd.load_robot(tmp_path / "arm")
    assert second is not first and rd.load_robot(tmp_path / "arm") is second
    link = next(iter(arm.spheres))
    np.testing.assert_allclose(second.spheres[link], 1.5 * first.spheres[link], atol=1e-5)
    text = (tmp_path / "arm" / ROBOT_FILE).read_text()
    (tmp_path / "arm" / ROBOT_FILE).write_text(text.replace(f'"name": "{arm.name}"', '"name": "other"', 1))
    assert rd.load_robot(tmp_path / "arm").name == "other"
    (tmp_path / "arm" / MESH_FILE).unlink()
    refuses(MESH_FILE, rd.load_robot, tmp_path / "arm")


def test_what_is_compiled_is_not_pickled() -> None:
    robot = rd.load_robot("panda", locked={LEFT: 0.005})
    size = len(pickle.dumps(robot))
    compile_robot(robot)
    assert len(pickle.dumps(robot)) == size
    again = pickle.loads(pickle.dumps(robot))
    assert again.locked == robot.locked and again.link_names == robot.link_names
    np.testing.assert_array_equal(compile_robot(again).spheres, compile_robot(robot).spheres)
