"""Bases, tools and held objects in problems and their files; confirmed by PyBullet in the world's frame."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import robotdiffuse as rd
from helpers.commands import written
from helpers.refusals import refuses
from robotdiffuse.collision.exact_meshes import ExactCollision
from robotdiffuse.core.transforms import inverse, rotation_about, transform
from robotdiffuse.problems.files import problem_from_record, problem_record, save_problem
from robotdiffuse.scenes.shapes import Shape

START = [-0.6, 0.2, 0.0, -2.0, 0.0, 2.2, 0.2]
GOAL = [0.6, 0.2, 0.0, -2.0, 0.0, 2.2, 0.2]
WALL = {"box": {"center": [0.5, 0.0, 0.25], "size": [0.3, 0.06, 0.3], "name": "wall"}}
CUP = {"link": "panda_hand", "cylinder": {"center": [0, 0, 0.16], "radius": 0.03, "height": 0.12, "name": "cup"}}
PLAIN: dict[str, Any] = {"robot": "panda", "scene": [WALL], "start": START, "goal": {"joints": GOAL}}
TOOL = {
    "link": "panda_hand",
    "xyz": [0.0, 0.0, 0.2],
    "shapes": [{"box": {"center": [0, 0, 0.14], "size": [0.03, 0.03, 0.12]}}],
    "touch_links": ["panda_link6"],
}
T_WORLD_BASE = transform(np.array([1.0, -2.0, 0.5]), rotation_about(np.array([0.6, 0.0, 0.8]), 2.0))
SHAPES: list[Shape] = [
    rd.Sphere([0.5, 0.5, 0.5], 0.1),
    rd.Box([0.4, 0.0, 0.1], [0.3, 0.2, 0.1], [0.9, 0.1, 0.2, 0.3]),
    rd.Cylinder([0.3, -0.5, 0.2], 0.05, 0.4, [0.5, 0.5, 0.5, -0.5]),
    rd.Capsule([-0.5, 0.2, 0.5], 0.05, 0.3, [0.9, 0.1, 0.0, 0.0]),
    rd.Mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], [0.5, 0.6, 0]),
    rd.PointCloud([[0.5, 0.1, 0.9], [0.4, 0.2, 0.8]]),
]


@pytest.mark.parametrize("extra", [{"attached": [CUP]}, {"tool": TOOL}, {"tool": TOOL, "attached": [CUP | {"link": "tool"}]}])
def test_files_keep_tools_and_objects(extra: dict[str, Any], tmp_path: Path) -> None:
    problem = rd.load_problem(written(tmp_path, PLAIN | extra))
    save_problem(problem, tmp_path / "again.json")
    again = rd.load_problem(tmp_path / "again.json")
    assert again.robot is problem.robot, "the same content is the same robot"
    assert {key: problem_record(again)[key] for key in extra} == {key: problem_record(problem)[key] for key in extra}


def test_a_goal_may_name_the_tool_and_what_is_held(tmp_path: Path) -> None:
    for frame, extra in (("tool", {"tool": TOOL}), ("cup", {"attached": [CUP]})):
        goal = {"pose": {"frame": frame, "xyz": [0.45, 0.3, 0.3], "wxyz": [0.0, 1.0, 0.0, 0.0]}}
        problem = rd.load_problem(written(tmp_path, PLAIN | extra | {"goal": goal}))
        result = rd.plan(problem, time_limit=10.0)
        assert result.path is not None, result.reason
        assert np.allclose(problem.robot.fk(result.path.positions[-1], frame)[:3, 3], [0.45, 0.3, 0.3], atol=1e-4)


def test_base_moves_scene_goal_and_views_into_the_bases_frame() -> None:
    robot = rd.load_robot("panda")
    view = rd.DepthView(np.full((4, 4), 5.0), (4, 4, 2, 2), T_WORLD_BASE)
    goal = rd.PoseGoal("panda_hand", T_WORLD_BASE @ robot.fk(GOAL, "panda_hand"))
    problem = rd.Problem.in_world(T_WORLD_BASE, robot, rd.Scene(SHAPES).moved(T_WORLD_BASE), START, goal, views=[view])
    assert isinstance(problem.goal, rd.PoseGoal)
    assert np.allclose(problem.goal.T_base_frame, robot.fk(GOAL, "panda_hand"))
    assert np.allclose(problem.views[0].T_base_camera, np.eye(4))
    for given, moved in zip(SHAPES, problem.known_scene.shapes, strict=True):
        assert np.allclose(given.bounds, moved.bounds, atol=1e-9)


def test_distances_are_the_same_in_the_world() -> None:
    robot = rd.load_robot("panda").attach(rd.Sphere([0, 0, 0.15], 0.04, name="ball"), "panda_hand")
    scene = rd.Scene(SHAPES)
    problem = rd.Problem.in_world(T_WORLD_BASE, robot, scene.moved(T_WORLD_BASE), START, GOAL)
    standing, world = problem.robot_and_scene_in_world()
    q = np.array(START)
    here = ExactCollision(robot, scene).link_distances(q)
    for there in (ExactCollision(robot, problem.scene), ExactCollision(standing, world)):
        assert np.allclose([d.distance for d in here], [d.distance for d in there.link_distances(q)], atol=1e-6)
    assert np.allclose(inverse(standing.fk(q, "panda_hand")) @ T_WORLD_BASE @ robot.fk(q, "panda_hand"), np.eye(4), atol=1e-12)


def test_files_in_the_world_come_back_as_they_were_read(tmp_path: Path) -> None:
    base = {"xyz": [0.3, -0.2, 0.7], "wxyz": [0.8, 0.0, 0.0, 0.6]}
    record = PLAIN | {
        "base": base,
        "scene": [WALL | {}, {"sphere": {"center": [0.1, 0.2, 1.4], "radius": 0.1}}],
        "goal": {"pose": {"frame": "panda_hand", "xyz": [0.4, 0.3, 1.1], "wxyz": [0.0, 1.0, 0.0, 0.0]}},
    }
    problem = rd.load_problem(written(tmp_path, record))
    again = problem_record(problem_from_record(problem_record(problem)))
    assert again == problem_record(problem)
    assert again["base"] == base and again["goal"] == record["goal"]
    assert again["scene"][1] == record["scene"][1]  # type: ignore[index]
    assert np.allclose(
        problem.scene.shapes[1].bounds.mean(0), [-0.2, 0.4, 0.7] @ np.array([[0.28, -0.96, 0], [0.96, 0.28, 0], [0, 0, 1]])
    )


def test_pybullet_sees_no_contact_where_the_robot_stands_in_the_world() -> None:
    pytest.importorskip("pybullet")
    from robotdiffuse.simulation.validator import PyBulletOracle

    T = transform(np.array([0.5, 0.2, 1.5]), rotation_about(np.array([1.0, 0.0, 0.0]), np.pi))
    robot = rd.load_robot("panda").attach(rd.Box([0, 0, 0.16], [0.05, 0.05, 0.12], name="cup"), "panda_hand")
    wall = rd.Box([0.5, 0.0, 0.25], [0.3, 0.06, 0.3], name="wall").moved(T)
    problem = rd.Problem.in_world(T, robot, rd.Scene([wall]), START, GOAL)
    result = rd.plan(problem, time_limit=10.0)
    assert result.path is not None, result.reason
    standing, _ = problem.robot_and_scene_in_world()
    with PyBulletOracle(standing, rd.Scene([wall])) as oracle:
        assert oracle.check_path(result.path) is None
        contact = oracle.check_path(rd.Path(robot.joint_names, np.array([START, GOAL])))
        assert contact is not None and {contact.link, contact.other} <= {"cup", "wall", "panda_hand"}


WRONG = {
    "base of MoveIt": ({"base": {}, "scene": "scene.yaml"}, "base cannot be combined with MoveIt files"),
    "base": ({"base": {"euler": [0, 0, 0]}}, "unknown field of base: .euler.; known: rpy, wxyz, xyz"),
    "tool link": ({"tool": {"xyz": [0, 0, 0]}}, "tool has no link"),
    "unknown tool link": ({"tool": {"link": "hand"}}, "unknown link in tool.link: 'hand'"),
    "attached nothing": ({"attached": {}}, "attached is {}; it must be a list of objects"),
    "contacts in a list": ({"allowed_contacts": []}, "allowed_contacts is \\[\\]; it must be a mapping of obstacles"),
    "degrees": ({"base": {"rpy": [0, 0, 90]}}, r"base.rpy \[rad\] is \[0, 0, 90\]; .* within ±6.3"),
    "cloud as a ball": (
        {"scene": [{"sphere": {"center": [1, 0, 0], "radius": 0.1, "file": "a.ply"}}]},
        "unknown field of scene.*: 'file'",
    ),
    "attached": ({"attached": CUP}, "attached is .*; it must be a list of objects"),
    "no link": ({"attached": [WALL]}, r"attached\[0\] is .*; it must be a shape with its link"),
    "fixed link": ({"attached": [CUP | {"link": "panda_link0"}]}, r"attached\[0\]: attached.link: no"),
    "twice": ({"attached": [CUP, CUP]}, r"attached\[1\]: attached.name is 'cup'"),
}  # fmt: skip


@pytest.mark.parametrize(("extra", "message"), WRONG.values(), ids=WRONG)
def test_wrong_equipment_is_one_line(extra: dict[str, Any], message: str, tmp_path: Path) -> None:
    refuses(message, rd.load_problem, written(tmp_path, PLAIN | extra))


def test_a_second_shape_of_one_name_is_noted(tmp_path: Path) -> None:
    problem = rd.load_problem(written(tmp_path, PLAIN | {"scene": [WALL, WALL]}))
    assert problem.notes == ("scene[1]: an earlier shape is named wall too; this one is wall_2",)
