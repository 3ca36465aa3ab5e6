"""Bundled robots: spheres cover their meshes, cause few false collisions, NOTICE names them; equal robots are one object."""

import os
import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

import robotdiffuse as rd
from helpers.box_arm import box_arm
from helpers.refusals import refuses
from robotdiffuse.collision import CollisionChecker
from robotdiffuse.collision.exact_meshes import ExactCollision
from robotdiffuse.collision.kernel_arrays import compile_robot
from robotdiffuse.problems.files import load_problem, save_problem
from robotdiffuse.robots import DATA, ROBOTS, load_robot
from robotdiffuse.robots.fitting.sphere_fitting import is_inside, stacked_planes
from robotdiffuse.robots.fitting.sphere_fitting_kernel import gaps
from robotdiffuse.robots.robot_folder import MESH_FILE, ROBOT_FILE, read_source, user_robots, write_robot_folder

NOTICE = (Path(__file__).parents[2] / "NOTICE").read_text()


@pytest.mark.parametrize("name", ROBOTS)
def test_no_sampled_point_of_the_meshes_is_outside_the_spheres(name: str) -> None:
    robot = load_robot(name)
    for link, parts in robot.meshes.items():
        for k, part in enumerate(parts):
            mesh = trimesh.Trimesh(part.vertices, part.faces, process=False)
            points = np.asarray(trimesh.sample.sample_surface(mesh, 200, seed=0)[0])
            others = parts[:k] + parts[k + 1 :]
            if others:  # points inside another part are not on the surface
                points = points[~is_inside(points, stacked_planes(others), 1e-9)]
            assert (gaps(points, robot.spheres[link].copy()) <= 0).all(), link


@pytest.mark.parametrize("name", ROBOTS)
def test_what_spheres_call_free_is_free_and_little_else_is(name: str) -> None:
    """Preparation warns of more than 8 % false collisions; the standard error with 400 samples is 1.5 %."""
    robot = load_robot(name)
    scene = rd.Scene()
    q = np.random.default_rng(0).uniform(robot.lower, robot.upper, (400, robot.dof))
    by_spheres = CollisionChecker(robot, scene).free(q)
    by_meshes = ~ExactCollision(robot, scene).collides(q)
    assert not (by_spheres & ~by_meshes).any()
    assert by_meshes.mean() > 0.4 and (by_meshes & ~by_spheres).sum() < 0.12 * by_meshes.sum()


def test_a_user_without_a_home_has_bundled_robots(monkeypatch: pytest.MonkeyPatch) -> None:
    """Regression: in a container whose user has no home, names of robots raised a RuntimeError."""
    for name in ("HOME", "XDG_DATA_HOME", "ROBOTDIFFUSE_ROBOTS"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(os, "getuid", lambda: 2**31 - 2)
    assert user_robots() == Path("/.local/share/robotdiffuse/robots")
    refuses("unknown robot 'nothing'; known: baxter", load_robot, "nothing")


@pytest.mark.parametrize("name", ROBOTS)
def test_licenses_are_named(name: str) -> None:
    assert name in NOTICE.lower() and read_source(DATA / name)["license"]
    assert sum(file.stat().st_size for file in (DATA / name).iterdir()) < 1_000_000


@pytest.mark.parametrize(("name", "most"), [("fr3", [10.0] * 7), ("gen3", [5.2] * 4 + [10.0] * 3)])
def test_accelerations_are_those_that_the_maker_allows(name: str, most: list[float]) -> None:
    """Regression: those of an FR3 were up to 21 rad/s², and its controller stops motions above 10 (Franka's specification)."""
    assert (load_robot(name).acceleration <= np.array(most)).all()


def test_joints_that_turn_twice_are_drawn_without_needless_turns() -> None:
    """Regression: shelf problems were unsolvable: start and goal differed by turns of a shoulder, which the floor blocks."""
    robot = load_robot("ur5e")
    q = np.random.default_rng(0).uniform(robot.lower, robot.upper, (50, 6))
    least = robot.unwound(q)
    assert (np.abs(least) <= np.pi + 1e-9).all() and (least != q).any()
    for one, other in zip(q[:5], least[:5], strict=True):
        np.testing.assert_allclose(robot.fk(one, "tool0"), robot.fk(other, "tool0"), atol=1e-9)
    panda = load_robot("panda")
    middle = 0.5 * (panda.lower + panda.upper)
    assert np.array_equal(panda.unwound(middle), middle)


def test_a_pose_does_not_say_how_often_a_joint_turns() -> None:
    """Regression: one random problem in ten was unsolvable for a UR: only the goal one turn further can be reached."""
    robot = load_robot("ur5e")
    home = np.array([0, -1.57, 1.57, -1.57, -1.57, 0])
    start = np.array([0.5, 2.9, 0.7, 0.4, 2.7, 0.2])
    goals = robot.equivalent_configurations(home, start)
    assert np.allclose(goals[0], home + 2 * np.pi * np.array([0, 1, 0, 0, 1, 0])) and len(goals) == 6
    assert ((goals >= robot.lower) & (goals <= robot.upper)).all()
    T = robot.fk(home, "tool0")
    for q in goals:
        np.testing.assert_allclose(robot.fk(q, "tool0"), T, atol=1e-9)
    pose = rd.Problem(robot, rd.Scene([]), start, rd.PoseGoal("tool0", T))
    result = rd.load_planner("aorrtc").plan(pose, time_limit=10.0, until="first")
    assert result.solved, result.reason
    panda = load_robot("panda")
    assert np.array_equal(panda.equivalent_configurations(panda.upper, panda.lower), panda.upper[None])


LEFT, RIGHT = "panda_finger_joint1", "panda_finger_joint2"


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


def test_a_bundled_name_does_not_depend_on_the_working_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_robot_folder(replace(box_arm(), name="other"), tmp_path / "panda", {})
    monkeypatch.chdir(tmp_path)
    assert load_robot("panda").name == "panda" and load_robot("./panda").name == load_robot(Path("panda")).name == "other"
