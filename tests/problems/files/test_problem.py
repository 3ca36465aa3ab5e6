"""Problems: what the constructor refuses and repairs; problem files, and all that can be wrong in them."""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, strategies as st

import robotdiffuse as rd
from helpers.commands import written
from helpers.full_disk import full_disk
from helpers.panda import PANDA
from helpers.refusals import refuses
from robotdiffuse.core.errors import OutputError
from robotdiffuse.core.transforms import rotation_about, rotation_from_rpy, transform
from robotdiffuse.problems.files import load_problems, problem_from_record, problem_record, save_problem
from robotdiffuse.robots.kinematic_tree import Joint

Z = np.array([0.0, 0.0, 1.0])
READY = [0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785]
DATA = Path(__file__).parents[2] / "files"


def crane() -> rd.Robot:
    """A revolute, a continuous and a prismatic joint."""
    joints = (
        Joint("swing", "revolute", "base", "tower", np.eye(4), Z, lower=-1.0, upper=2.0),
        Joint("spin", "continuous", "tower", "jib", np.eye(4), Z, lower=-np.pi, upper=np.pi),
        Joint("lift", "prismatic", "jib", "hook", np.eye(4), Z, lower=0.0, upper=0.5),
        Joint("bolt", "fixed", "base", "plinth", np.eye(4), Z),
    )
    return rd.Robot("crane", "base", "hook", joints)


def problem(start: Any = (0, 0, 0), goal: Any = (1, 1, 0.1)) -> rd.Problem:
    return rd.Problem(crane(), rd.Scene(), start, goal)


def test_forms_of_goals() -> None:
    one = problem([0, 0, 0], [1, 1, 0.1])
    assert one.start.dtype == np.float64 and one.start.tolist() == [0, 0, 0]
    assert isinstance(one.goal, rd.JointGoal) and one.goal.positions.tolist() == [[1, 1, 0.1]]
    for two in ([[1, 1, 0], [0, 1, 0]], np.array([[1, 1, 0], [0, 1, 0]]), rd.JointGoal([[1, 1, 0], [0, 1, 0]])):
        goal = problem(goal=two).goal
        assert isinstance(goal, rd.JointGoal) and goal.positions.tolist() == [[1, 1, 0], [0, 1, 0]]
    pose = rd.PoseGoal("hook", transform(Z, rotation_about(Z, 0.4)))
    assert problem(goal=pose).goal is pose
    assert one.notes == ()


def test_a_hair_over_a_limit_is_clamped_and_said() -> None:
    made = problem([2 + 1e-6, 0, -1e-8], [[0, 0, 0], [-1 - 9e-6, 0, 0]])
    assert made.start.tolist() == [2.0, 0.0, 0.0]
    assert isinstance(made.goal, rd.JointGoal) and made.goal.positions[1, 0] == -1.0
    assert made.notes == (
        "start: swing clamped from 2.000001 to its limit 2.0 rad",
        "start: lift clamped from -1e-08 to its limit 0.0 m",
        "goal[1]: swing clamped from -1.000009 to its limit -1.0 rad",
    )
    for beyond in (1e-5, float(np.float32(2 + 1e-5)) - 2, 9e-4):
        assert problem([2 + beyond, 0, 0]).start[0] == 2.0
    refuses(r"start: swing is 2.0011 rad; its limits are -1 to 2", problem, [2.0011, 0, 0])


@given(st.floats(-100, 100))
def test_values_of_continuous_joints_are_kept(angle: float) -> None:
    made = problem([0, angle, 0])
    assert made.start[1] == angle and made.notes == ()


def test_wrong_problems() -> None:
    refuses("start has 2 values; crane has 3 planned joints: swing, spin, lift", problem, [0, 0])
    refuses(r"goal\[0\] has 2 values", problem, goal=[[0, 0], [1, 1]])
    refuses(r"start: spin is nan; it must be a finite number .* \[rad\]", problem, [0, np.nan, 0])
    refuses(r"goal\[1\]: lift is 0.6 m; its limits are", problem, goal=[[0, 0, 0], [0, 0, 0.6]])
    refuses("start is 'home'; it must be a list of 3 numbers: swing, spin, lift", problem, "home")
    refuses("start is None", problem, None)
    refuses("unknown link in goal.frame: 'claw'", problem, goal=rd.PoseGoal("claw", np.eye(4)))
    refuses("no planned joint moves 'plinth'", problem, goal=rd.PoseGoal("plinth", np.eye(4)))
    refuses("it must be a homogeneous transform", rd.PoseGoal, "hook", np.diag([1.0, 1.0, -1.0, 1.0]))
    refuses("scene is .*; it must be a Scene", rd.Problem, crane(), [], [0], [0])


GOOD: dict[str, Any] = {
    "robot": "panda",
    "locked": {"panda_finger_joint1": 0.065, "panda_finger_joint2": 0.065},
    "scene": [
        {"sphere": {"center": [0.5, 0.3, 0.6], "radius": 0.25}},
        {"box": {"center": [0, 0.6, 0.4], "size": [0.2, 0.2, 0.2], "wxyz": [0.5, 0.5, 0.5, 0.5]}},
        {"cylinder": {"center": [0.4, -0.3, 0.2], "radius": 0.05, "height": 0.4, "name": "pole"}},
    ],
    "start": READY,
    "goal": {"joints": [1, -0.785, 0, -2.356, 0, 1.571, 0.785]},
}


@pytest.mark.parametrize("ending", ["yaml", "json", "jsonl"])
def test_problem_file(ending: str, tmp_path: Path) -> None:
    loaded = rd.load_problem(written(tmp_path, GOOD, f"problem.{ending}"))
    assert loaded.robot.name == "panda"
    assert loaded.robot.locked["panda_finger_joint1"] == 0.065
    assert [shape.name for shape in loaded.scene.shapes] == ["sphere", "box", "pole"]
    assert loaded.start.tolist() == READY
    assert isinstance(loaded.goal, rd.JointGoal) and loaded.goal.positions.shape == (1, 7)
    assert rd.Problem.load(tmp_path / f"problem.{ending}").start.tolist() == READY
    [entry] = load_problems(tmp_path / f"problem.{ending}")
    assert entry.load().start.tolist() == READY
    refuses(r"index is 2; .* holds (one|1) problem", rd.load_problem, tmp_path / f"problem.{ending}", 2)


def without(name: str) -> dict[str, Any]:
    return {key: value for key, value in GOOD.items() if key != name}


def shape(**entry: object) -> dict[str, Any]:
    return GOOD | {"scene": [GOOD["scene"][0], entry]}


WRONG: dict[str, tuple[object, str]] = {
    "no mapping": (["panda"], "problem is .* it must be a mapping with the fields robot, scene, start, goal"),
    "unknown field": (GOOD | {"strat": []}, "unknown field of problem: 'strat'; known:"),
    "no start": (without("start"), "problem has no start"),
    "no goal, no robot": (without("goal") | {"robot": None}, "problem has no goal"),
    "unknown robot": (GOOD | {"robot": "pandora"}, "unknown robot 'pandora'; known: .*panda"),
    "a goal that is a number": (GOOD | {"goal": 7.0}, "goal is 7.0; .* a configuration, .* any$"),
    "unknown locked joint": (GOOD | {"locked": {"thumb": 0}}, "unknown joint in locked 'thumb'"),
    "unknown shape": (shape(pyramid={}), r"unknown field of scene\[1\]: 'pyramid'; known: box, capsule"),
    "unknown shape field": (
        shape(sphere={"center": [0, 0, 1], "radius": 1, "color": "red"}),
        r"unknown field of scene\[1\].sphere: 'color'; known: center, name, radius",
    ),
    "shape without a field": (shape(sphere={"center": [0, 0, 1]}), r"scene\[1\].sphere has no radius"),
    "missing mesh": (shape(mesh={"file": "none.stl"}), r"scene\[1\].mesh: .*none.stl does not exist"),
    "unknown goal": (GOOD | {"goal": {"place": []}}, "unknown field of goal: 'place'; known:"),
    "two goals": (GOOD | {"goal": {"joints": READY, "pose": {}}}, "known: joints, joint_set"),
    "pose without a frame": (GOOD | {"goal": {"pose": {"xyz": [0, 0, 1], "wxyz": [1, 0, 0, 0]}}}, "has no frame"),
    "an unknown pose": (GOOD | {"goal": {"joints": "home"}}, "unknown pose in goal.joints: 'home'"),
    "a robot without poses": (without("locked") | {"robot": "iiwa14", "start": "home"}, "iiwa14 has no named pose with values"),
    "two rotations": (
        shape(box={"center": [1, 0, 0], "size": [1] * 3, "rpy": [0] * 3, "wxyz": [1] * 4}),
        r"scene\[1\].box has both wxyz and rpy; give one of them",
    ),
    "two angles": (GOOD | {"base": {"rpy": [0, 0]}}, r"base.rpy \[rad\] is \[0, 0\]; it must be 3 finite numbers"),
    "zero quaternion": (
        GOOD | {"goal": {"pose": {"frame": "panda_hand", "xyz": [0, 0, 1], "wxyz": [0, 0, 0, 0]}}},
        "goal.pose.wxyz .* must not be zero",
    ),
}


@pytest.mark.parametrize(("data", "message"), WRONG.values(), ids=WRONG)
def test_wrong_problem_files(data: object, message: str, tmp_path: Path) -> None:
    file = written(tmp_path, data)
    refuses(f"^{re.escape(str(file))}.*{message}", rd.load_problem, file)


def test_lines_of_problems(tmp_path: Path) -> None:
    file = tmp_path / "many.jsonl"
    lines = [json.dumps(GOOD | {"start": [0.1 * i, *READY[1:]]}) for i in range(3)]
    file.write_text(lines[0] + "\n\n" + "\n".join(lines[1:]) + "\n")
    entries = load_problems(file)
    assert [entry.name for entry in entries] == ["many:1", "many:3", "many:4"]
    assert [entry.load().start[0] for entry in entries] == [0, 0.1, 0.2]
    assert entries[0].load().robot is entries[2].load().robot
    assert rd.load_problem(file, 1).start[0] == 0.1
    refuses(r"index is 3; .* holds 3 problems", rd.load_problem, file, 3)
    file.write_text(lines[0] + '\n{"robot": 3')
    refuses(r"many\.jsonl, line 2 is not valid JSON", load_problems, file)
    file.write_text(lines[0] + "\n" + json.dumps(GOOD | {"start": []}) + "\n")
    refuses(r"many\.jsonl, line 2: start has 0 values", load_problems, file)


def full_problem(goal: Any) -> rd.Problem:
    rng = np.random.default_rng(0)
    ball = rd.Sphere(rng.normal(size=3), 1 / 3)
    shapes = [
        ball,
        ball,
        rd.Box(rng.normal(size=3), [0.1, 1e-7, 1e4], rng.normal(size=4), name="on off: {no}"),
        rd.Cylinder(rng.normal(size=3), 0.1, 1 / 7, rng.normal(size=4)),
        rd.Capsule(rng.normal(size=3), 0.1, 1 / 7),
        rd.Mesh(rng.normal(size=(4, 3)), [[0, 1, 2], [0, 1, 3]], wxyz=rng.normal(size=4)),
        rd.PointCloud(rng.normal(size=(20, 3)), 0.003),
        rd.PointCloud([]),
    ]
    robot = rd.load_robot("panda", locked={"panda_finger_joint1": 0.01})
    start = rng.uniform(robot.lower, robot.upper)
    return rd.Problem(robot, rd.Scene(shapes), start, goal if goal is not None else robot.lower)


@pytest.mark.parametrize("ending", ["yaml", "yml", "json", "jsonl"])
@pytest.mark.parametrize("goal", [None, [READY, READY]], ids=["joints", "set"])
def test_saved_problems_are_read_back_exactly(ending: str, goal: Any, tmp_path: Path) -> None:
    saved = full_problem(goal)
    file = tmp_path / f"problem.{ending}"
    save_problem(saved, file)
    for back in (rd.load_problem(file), problem_from_record(problem_record(saved))):
        assert (back.start == saved.start).all()
        assert isinstance(back.goal, rd.JointGoal) and isinstance(saved.goal, rd.JointGoal)
        assert (back.goal.positions == saved.goal.positions).all()
        assert back.robot.locked == saved.robot.locked and back.notes == ()
        for one, other in zip(back.scene.shapes, saved.scene.shapes, strict=True):
            assert type(one) is type(other)
            for field in vars(other):
                assert np.array_equal(getattr(one, field), getattr(other, field)), (one.name, field)
    assert [file.name for file in tmp_path.iterdir()] == [file.name], "no part of a file is left behind"


def test_lines_are_appended(tmp_path: Path) -> None:
    for i in range(3):
        save_problem(full_problem([0.1 * i, *READY[1:]]), tmp_path / "many.jsonl")
    goals = [entry.load().goal for entry in load_problems(tmp_path / "many.jsonl")]
    assert [goal.positions[0, 0] for goal in goals if isinstance(goal, rd.JointGoal)] == [0, 0.1, 0.2]


def test_a_line_that_the_disk_has_no_room_for_leaves_the_file_as_it_was(tmp_path: Path) -> None:
    file = tmp_path / "many.jsonl"
    save_problem(full_problem(None), file)
    size = file.stat().st_size
    with full_disk(size + 100), pytest.raises(OutputError, match=r"many\.jsonl cannot be written: File too large$"):
        save_problem(full_problem(None), file)
    assert file.stat().st_size == size
    save_problem(full_problem(None), file)
    assert len(load_problems(file)) == 2


def test_places_that_cannot_be_written_to(tmp_path: Path) -> None:
    made = full_problem(None)
    (tmp_path / "folder.json").mkdir()
    for file in (tmp_path / "none" / "a.yaml", tmp_path / "none" / "a.jsonl", tmp_path / "folder.json"):
        refuses("cannot be written", save_problem, made, file)
    refuses("problem file format", save_problem, made, tmp_path / "a.txt")
    refuses("'crane' is neither bundled nor read from a file", problem_record, problem())
    assert problem_record(problem(), robot="crane.urdf")["robot"] == "crane.urdf"


def test_files_are_looked_up_from_the_problem(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "clouds").mkdir()
    np.save(tmp_path / "clouds" / "a.npy", [[0.5, 0, 0.2], [np.nan, 0, 0]])
    entry = {"point_cloud": {"file": "clouds/a.npy", "point_radius": 0.02}}
    monkeypatch.chdir("/")
    loaded = rd.load_problem(written(tmp_path, GOOD | {"scene": [entry]}))
    assert len(loaded.notes) == 1 and "1 of 2 points are not finite" in loaded.notes[0]
    save_problem(loaded, tmp_path / "again.json")
    assert json.loads((tmp_path / "again.json").read_text())["scene"] == [entry]
    assert problem_from_record(problem_record(loaded)).scene.shapes[0].area == loaded.scene.shapes[0].area


def test_moveit_files_in_a_problem(tmp_path: Path) -> None:
    scene, request = (str(DATA / "motion_bench_maker" / f"{name}0001.yaml") for name in ("scene", "request"))
    loaded = rd.load_problem(written(tmp_path, GOOD | {"scene": scene}))
    assert [shape.name for shape in loaded.scene.shapes] == ["can", "board"]
    refuses(r"(start|goal) cannot be combined with request", rd.load_problem, written(tmp_path, GOOD | {"request": request}))


CAMERA = {"xyz": [0] * 3, "wxyz": [1, 0, 0, 0]}


def test_records_of_others_name_no_files_that_are_read_and_have_the_robots_that_are_given() -> None:
    good = {"robot": "panda", "scene": [], "start": READY, "goal": {"joints": READY}}
    for changed in (
        {"scene": "scene.yaml"},
        {"scene": [{"mesh": {"file": "shelf.stl"}}]},
        {"scene": [{"point_cloud": {"file": "/etc/passwd.csv"}}]},
        {"tool": {"link": "panda_hand", "shapes": [{"mesh": {"file": "tool.stl"}}]}},
        {"attached": [{"link": "panda_hand", "mesh": {"file": "cup.stl"}}]},
        {"views": [{"depth": "a.png", "intrinsics": [1, 1, 0, 0], "camera": CAMERA}]},
        {"views": [{"cloud": "a.ply", "camera": CAMERA}]},
    ):
        refuses("is a file, and files are not read here", problem_from_record, good | changed, {"panda": PANDA})
    record = {"robot": "panda", "scene": [], "request": "/etc/passwd"}
    refuses("files are not read here", problem_from_record, record, {"panda": PANDA})
    for robot in ("ur5", "panda/robot.json", "../panda", "/etc/passwd", "a.urdf", 1, None):
        refuses(r"unknown robot .*; known: panda", problem_from_record, good | {"robot": robot}, {"panda": PANDA})


NAMED = [0.0, -np.pi / 4, 0.0, -0.75 * np.pi, 0.0, np.pi / 2, np.pi / 4]
BASIC = {"robot": "panda", "scene": [], "start": "ready", "goal": [0.0] * 3 + [-1.0] + [0.0] + [1.0, 0.0]}


@pytest.mark.parametrize(
    ("goal", "rows"), [(NAMED, [NAMED]), ([NAMED, NAMED], [NAMED, NAMED]), ("ready", [NAMED]), ({"joints": "ready"}, [NAMED])]
)
def test_goals_are_given_as_in_python(goal: object, rows: list[list[float]]) -> None:
    problem = problem_from_record(BASIC | {"goal": goal})
    assert isinstance(problem.goal, rd.JointGoal)
    np.testing.assert_allclose(problem.goal.positions, rows)
    np.testing.assert_allclose(problem.start, NAMED)
    assert np.array_equal(rd.Problem(problem.robot, rd.Scene(), "ready", "ready").start, problem.start)


def test_roll_pitch_yaw_are_in_the_order_of_urdfs() -> None:
    """Also in the goals of a list, any of which may be reached."""
    pose = {"pose": {"frame": "panda_hand", "xyz": [0.5, 0, 0.4], "rpy": [np.pi, 0, 0]}}
    goal = problem_from_record(BASIC | {"goal": [pose, "ready"]}).goal
    assert isinstance(goal, rd.AnyGoal)
    np.testing.assert_allclose(goal.goals[0].T_base_frame[:3, :3], np.diag([1, -1, -1]), atol=1e-12)  # type: ignore[union-attr]
    box = {"center": [0.9, 0, 0], "size": [0.1, 0.2, 0.3], "rpy": [0.1, 0.2, 0.3]}
    [shape] = problem_from_record(BASIC | {"scene": [{"box": box}]}).scene.shapes
    np.testing.assert_allclose(shape.T_base_shape[:3, :3], rotation_from_rpy(0.1, 0.2, 0.3), atol=1e-12)
