"""Problems: what the constructor refuses and repairs, is_free, notes on units; problem files, and what can be wrong in them."""

import json
import re
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, strategies as st

import robotdiffuse as rd
from helpers.commands import written
from helpers.full_disk import full_disk
from helpers.panda import HOME, PANDA
from helpers.refusals import refuses
from robotdiffuse.collision import CollisionChecker
from robotdiffuse.collision.exact_meshes import ExactCollision
from robotdiffuse.core.errors import OutputError
from robotdiffuse.core.transforms import inverse, rotation_about, rotation_from_rpy, transform
from robotdiffuse.perception.ray_caster import looking_at, ray_cast
from robotdiffuse.problems.files import load_problems, problem_from_record, problem_record, save_problem
from robotdiffuse.problems.units import arm_in_cloud_note, unit_notes
from robotdiffuse.robots.kinematic_tree import Joint
from robotdiffuse.scenes.shapes import Shape

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
    assert made.start.tolist() == [2.0, 0.0, 0.0] and isinstance(made.goal, rd.JointGoal) and made.goal.positions[1, 0] == -1.0
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
    assert loaded.robot.name == "panda" and loaded.robot.locked["panda_finger_joint1"] == 0.065
    assert [shape.name for shape in loaded.scene.shapes] == ["sphere", "box", "pole"] and loaded.start.tolist() == READY
    assert isinstance(loaded.goal, rd.JointGoal) and loaded.goal.positions.shape == (1, 7)
    assert rd.Problem.load(tmp_path / f"problem.{ending}").start.tolist() == READY
    [entry] = load_problems(tmp_path / f"problem.{ending}")
    assert entry.load().start.tolist() == READY
    refuses(r"index is 2; .* holds (one|1) problem", rd.load_problem, tmp_path / f"problem.{ending}", 2)


def without(name: str) -> dict[str, Any]:
    return {key: value for key, value in GOOD.items() if key != name}


def shape(**entry: object) -> dict[str, Any]:
    return GOOD | {"scene": [GOOD["scene"][0], entry]}


NO_TURN = {"frame": "panda_hand", "xyz": [0, 0, 1], "wxyz": [0, 0, 0, 0]}
WRONG: dict[str, tuple[object, str]] = {
    "no mapping": (["panda"], "problem is .* it must be a mapping with the fields robot, scene, start, goal"),
    "unknown field": (GOOD | {"strat": []}, "unknown field of problem: 'strat'; known:"),
    "no start": (without("start"), "problem has no start"),
    "no goal, no robot": (without("goal") | {"robot": None}, "problem has no goal"),
    "unknown robot": (GOOD | {"robot": "pandora"}, "unknown robot 'pandora'; known: .*panda"),
    "a goal that is a number": (GOOD | {"goal": 7.0}, "goal is 7.0; .* a configuration, .* any$"),
    "unknown locked joint": (GOOD | {"locked": {"thumb": 0}}, "unknown joint in locked 'thumb'"),
    "unknown shape": (shape(pyramid={}), r"unknown field of scene\[1\]: 'pyramid'; known: box, capsule"),
    "unknown shape field": (shape(sphere={"color": "red"}), r"scene\[1\].sphere: 'color'; known: center, name, radius"),
    "shape without a field": (shape(sphere={"center": [0, 0, 1]}), r"scene\[1\].sphere has no radius"),
    "missing mesh": (shape(mesh={"file": "none.stl"}), r"scene\[1\].mesh: .*none.stl does not exist"),
    "unknown goal": (GOOD | {"goal": {"place": []}}, "unknown field of goal: 'place'; known:"),
    "two goals": (GOOD | {"goal": {"joints": READY, "pose": {}}}, "known: joints, joint_set"),
    "pose without a frame": (GOOD | {"goal": {"pose": {"xyz": [0, 0, 1], "wxyz": [1, 0, 0, 0]}}}, "has no frame"),
    "an unknown pose": (GOOD | {"goal": {"joints": "home"}}, "unknown pose in goal.joints: 'home'"),
    "a robot without poses": (without("locked") | {"robot": "iiwa14", "start": "home"}, "iiwa14 has no named pose with values"),
    "two rotations": (shape(box={"rpy": [0] * 3, "wxyz": [1] * 4}), r"scene\[1\].box has both wxyz and rpy; give one of them"),
    "two angles": (GOOD | {"base": {"rpy": [0, 0]}}, r"base.rpy \[rad\] is \[0, 0\]; it must be 3 finite numbers"),
    "zero quaternion": (GOOD | {"goal": {"pose": NO_TURN}}, "goal.pose.wxyz .* must not be zero"),
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
    assert [entry.load().start[0] for entry in entries] == [0, 0.1, 0.2] and entries[0].load().robot is entries[2].load().robot
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


@pytest.mark.parametrize(("goal", "rows"), [(NAMED, 1), ([NAMED, NAMED], 2), ("ready", 1), ({"joints": "ready"}, 1)])
def test_goals_are_given_as_in_python(goal: object, rows: int) -> None:
    problem = problem_from_record(BASIC | {"goal": goal})
    assert isinstance(problem.goal, rd.JointGoal)
    np.testing.assert_allclose(problem.goal.positions, [NAMED] * rows)
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


Q = np.array([0.0, 0.3, 0, -1.8, 0, 2.1, 0.8])
HAND = PANDA.fk(Q, "panda_hand")[:3, 3]
PROBLEM = rd.Problem(PANDA, rd.Scene([rd.Sphere(HAND, 0.05, "ball")]), "ready", "extended")


def test_the_reason_names_links_and_obstacle_or_the_limit_and_a_wrong_shape_is_an_error() -> None:
    for q in ("ready", PANDA.poses["ready"].values(), Q * [-1, 1, 1, 1, 1, 1, 1] + [1, 0, 0, 0, 0, 0, 0]):
        state = PROBLEM.is_free(q if isinstance(q, str) else list(q))
        assert state and state.reason == "" and state.links == ()
    state = PROBLEM.is_free(Q)
    assert not state and state.reason.startswith("panda_hand is ") and state.reason.endswith("inside ball")
    assert state.links[0] == "panda_hand"
    state = rd.Problem(PANDA, rd.Scene(), Q, Q).is_free([0, 0, 0, -3.0, 0, 0, 0])
    assert not state and "overlap" in state.reason and len(state.links) >= 2
    assert PROBLEM.is_free([9.0, *Q[1:]]).reason.startswith("panda_joint1 is 9 rad; its limits are")
    refuses("q has 2 values", PROBLEM.is_free, [1, 2])
    refuses("unknown pose in q: 'home'; known: extended, ready", PROBLEM.is_free, "home")


def test_it_agrees_with_the_validator() -> None:
    scene = rd.Scene([rd.Box([0.5, 0, 0.4], [0.3, 0.6, 0.05]), rd.Sphere([-0.3, 0.3, 0.6], 0.2)])
    states = []
    for q in np.random.default_rng(0).uniform(PANDA.lower, PANDA.upper, (60, 7)):
        problem = rd.Problem(PANDA, scene, q, q)
        report = rd.verify(problem, rd.Path(PANDA.joint_names, q[None]))
        states.append(bool(problem.is_free(q)))
        assert states[-1] == report.valid, report.violation
    assert 5 < sum(states) < 55


def test_the_least_distance_at_one_configuration_or_several() -> None:
    q = np.array([Q, [0.6, *Q[1:]]])
    checker = CollisionChecker(PANDA, PROBLEM.scene)
    expected = np.hstack([checker.link_clearances(q), checker.pair_clearances(q)]).min(axis=1)
    np.testing.assert_allclose(PROBLEM.clearance_at(q), expected)
    one = PROBLEM.clearance_at(Q.tolist())
    assert isinstance(one, float) and one == pytest.approx(expected[0])
    refuses(r"q is .* it must be 7 numbers", PROBLEM.clearance_at, [0.0])


TO = [0.4, -0.7, 0.0, -2.3, 0.0, 1.571, 0.785]


@cache
def seen() -> rd.DepthView:
    """A depth view of a box beside the arm, from a camera in front of the arm."""
    camera = looking_at(np.array([1.7, 0.0, 0.6]), np.array([0.4, 0.0, 0.3]))
    lens = (75.0, 75.0, 39.5, 29.5)
    return ray_cast(rd.Scene([rd.Box([0.0, -0.8, 0.3], [0.2, 0.2, 0.6])]), camera, lens, (80, 60), PANDA, HOME)


CUBE = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
FACES = [[0, 1, 3], [0, 3, 2], [4, 5, 7], [4, 7, 6], [0, 1, 5], [0, 5, 4]]


def _notes(*shapes: rd.Box | rd.Mesh | rd.PointCloud | rd.Sphere, **options: object) -> tuple[str, ...]:
    return unit_notes(rd.Problem(PANDA, rd.Scene(shapes), HOME, TO, **options))  # type: ignore[arg-type]


def test_obstacles_in_millimeters_are_noted_and_those_in_meters_are_not() -> None:
    for shape, text in (
        (rd.Mesh(200 * CUBE + [500, 300, 600], FACES), "mesh is 200 m long"),
        (rd.PointCloud(1600 * CUBE - 800), "point_cloud is 1600 m long"),
        (rd.Sphere([0, 5, 0], 0.2), "beyond the arm's reach of"),
    ):
        [note] = _notes(shape)
        assert note.startswith("check the units") and text in note and "millimeters" in note
    floor = rd.Box([0, 0, -0.6], [30, 30, 1], name="floor")
    assert _notes() == _notes(floor) == _notes(rd.Sphere([0.5, 0.3, 0.6], 0.1), rd.Sphere([0, 9, 0], 0.1)) == ()
    assert _notes(rd.PointCloud(CUBE), rd.PointCloud(np.zeros((0, 3)))) == ()
    [note] = _notes(rd.PointCloud(np.zeros((0, 3))), rd.Sphere([0, 5, 0], 0.2, name="ball"))
    assert "the obstacle ball is beyond" in note, "it named the empty cloud"


def test_depths_in_millimeters_and_intrinsics_of_another_size_are_noted() -> None:
    assert _notes(views=[seen()]) == ()
    wrong = [rd.DepthView(1000 * seen().depth, seen().intrinsics, seen().T_base_camera)]
    [note] = _notes(views=wrong)
    assert "depths of views[0] begin at" in note and "millimeters" in note
    problem = rd.Problem(PANDA, rd.Scene(), HOME, TO, views=wrong, unknown="padded")
    assert rd.load_planner("aorrtc").plan(problem).notes.count(note) == 1
    # Regression: without the arm in the image, nothing told that intrinsics were those before the image was resized.
    for factor in (0.5, 2.0):
        [note] = _notes(views=[replace(seen(), intrinsics=tuple(factor * np.array(seen().intrinsics)))])
        assert note.startswith("check the intrinsics of views[0]: cx and cy") and "(60, 80) pixels" in note


def test_what_views_see_in_reach_is_no_scene_beyond_it() -> None:
    problem = rd.Problem(PANDA, rd.Scene([rd.Sphere([0, 5, 0], 0.2)]), HOME, TO, views=[seen()], unknown="padded")
    notes = rd.load_planner("aorrtc").plan(problem).notes
    assert all(note.startswith("compiled for") for note in notes), notes


def test_a_cloud_that_the_arm_stands_in_is_noted() -> None:
    scene = rd.Scene([rd.PointCloud(np.random.default_rng(0).uniform(-0.5, 0.8, (3000, 3)), name="scan")])
    result = rd.load_planner("aorrtc").plan(rd.Problem(PANDA, scene, HOME, TO), time_limit=60.0)
    assert result.status is rd.Status.INVALID_START
    assert "points of scan are within the arm" in result.notes[0] and "millimeters" in result.notes[0]
    assert arm_in_cloud_note(PANDA, rd.Scene([rd.PointCloud(CUBE + 2)]), HOME) == ""


START = [-0.6, 0.2, 0.0, -2.0, 0.0, 2.2, 0.2]
GOAL = [0.6, 0.2, 0.0, -2.0, 0.0, 2.2, 0.2]
WALL = {"box": {"center": [0.5, 0.0, 0.25], "size": [0.3, 0.06, 0.3], "name": "wall"}}
CUP = {"link": "panda_hand", "cylinder": {"center": [0, 0, 0.16], "radius": 0.03, "height": 0.12, "name": "cup"}}
PLAIN: dict[str, Any] = {"robot": "panda", "scene": [WALL], "start": START, "goal": {"joints": GOAL}}
FINGER = {"box": {"center": [0, 0, 0.14], "size": [0.03, 0.03, 0.12]}}
TOOL = {"link": "panda_hand", "xyz": [0.0, 0.0, 0.2], "shapes": [FINGER], "touch_links": ["panda_link6"]}
T_WORLD_BASE = transform(np.array([1.0, -2.0, 0.5]), rotation_about(np.array([0.6, 0.0, 0.8]), 2.0))
WORLD_SHAPES: list[Shape] = [
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
    problem = rd.Problem.in_world(T_WORLD_BASE, robot, rd.Scene(WORLD_SHAPES).moved(T_WORLD_BASE), START, goal, views=[view])
    assert isinstance(problem.goal, rd.PoseGoal) and np.allclose(problem.goal.T_base_frame, robot.fk(GOAL, "panda_hand"))
    assert np.allclose(problem.views[0].T_base_camera, np.eye(4))
    for shape, moved in zip(WORLD_SHAPES, problem.known_scene.shapes, strict=True):
        assert np.allclose(shape.bounds, moved.bounds, atol=1e-9)


def test_distances_are_the_same_in_the_world() -> None:
    robot = rd.load_robot("panda").attach(rd.Sphere([0, 0, 0.15], 0.04, name="ball"), "panda_hand")
    scene = rd.Scene(WORLD_SHAPES)
    problem = rd.Problem.in_world(T_WORLD_BASE, robot, scene.moved(T_WORLD_BASE), START, GOAL)
    standing, world = problem.robot_and_scene_in_world()
    q = np.array(START)
    here = [d.distance for d in ExactCollision(robot, scene).distances(q) if d.other not in robot.link_names]
    for there in (ExactCollision(robot, problem.scene), ExactCollision(standing, world)):
        found = [d.distance for d in there.distances(q) if d.other not in standing.link_names]
        assert np.allclose(here, found, atol=1e-6)
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
    assert again == problem_record(problem) and again["base"] == base and again["goal"] == record["goal"]
    assert again["scene"][1] == record["scene"][1]  # type: ignore[index]
    turn = np.array([[0.28, -0.96, 0], [0.96, 0.28, 0], [0, 0, 1]])
    assert np.allclose(problem.scene.shapes[1].bounds.mean(0), [-0.2, 0.4, 0.7] @ turn)


def test_pybullet_sees_no_contact_where_the_robot_stands_in_the_world() -> None:
    oracle = pytest.importorskip("robotdiffuse.simulation.validator")
    T = transform(np.array([0.5, 0.2, 1.5]), rotation_about(np.array([1.0, 0.0, 0.0]), np.pi))
    robot = rd.load_robot("panda").attach(rd.Box([0, 0, 0.16], [0.05, 0.05, 0.12], name="cup"), "panda_hand")
    wall = rd.Box([0.5, 0.0, 0.25], [0.3, 0.06, 0.3], name="wall").moved(T)
    problem = rd.Problem.in_world(T, robot, rd.Scene([wall]), START, GOAL)
    result = rd.plan(problem, time_limit=10.0)
    assert result.path is not None, result.reason
    standing, _ = problem.robot_and_scene_in_world()
    with oracle.PyBulletOracle(standing, rd.Scene([wall])) as bullet:
        assert bullet.check_path(result.path) is None
        contact = bullet.check_path(rd.Path(robot.joint_names, np.array([START, GOAL])))
        assert contact is not None and {contact.link, contact.other} <= {"cup", "wall", "panda_hand"}


WRONG_EQUIPMENT = {
    "base of MoveIt": ({"base": {}, "scene": "scene.yaml"}, "base cannot be combined with MoveIt files"),
    "base": ({"base": {"euler": [0, 0, 0]}}, "unknown field of base: .euler.; known: rpy, wxyz, xyz"),
    "tool link": ({"tool": {"xyz": [0, 0, 0]}}, "tool has no link"),
    "unknown tool link": ({"tool": {"link": "hand"}}, "unknown link in tool.link: 'hand'"),
    "attached nothing": ({"attached": {}}, "attached is {}; it must be a list of objects"),
    "contacts in a list": ({"allowed_contacts": []}, "allowed_contacts is \\[\\]; it must be a mapping of obstacles"),
    "degrees": ({"base": {"rpy": [0, 0, 90]}}, r"base.rpy \[rad\] is \[0, 0, 90\]; .* within ±6.3"),
    "cloud as a ball": ({"scene": [{"sphere": {"radius": 0.1, "file": "a.ply"}}]}, "unknown field of scene.*: 'file'"),
    "attached": ({"attached": CUP}, "attached is .*; it must be a list of objects"),
    "no link": ({"attached": [WALL]}, r"attached\[0\] is .*; it must be a shape with its link"),
    "fixed link": ({"attached": [CUP | {"link": "panda_link0"}]}, r"attached\[0\]: attached.link: no"),
    "twice": ({"attached": [CUP, CUP]}, r"attached\[1\]: attached.name is 'cup'"),
}  # fmt: skip


@pytest.mark.parametrize(("extra", "message"), WRONG_EQUIPMENT.values(), ids=WRONG_EQUIPMENT)
def test_wrong_equipment_is_one_line(extra: dict[str, Any], message: str, tmp_path: Path) -> None:
    refuses(message, rd.load_problem, written(tmp_path, PLAIN | extra))


def test_a_robot_may_have_the_name_of_a_file() -> None:
    """Regression: a KeyError for robots of a server that were loaded from files."""
    assert problem_from_record(PLAIN | {"robot": "arm.urdf"}, {"arm.urdf": PANDA}).robot is PANDA


def test_a_robot_that_was_changed_is_not_saved_by_its_name() -> None:
    """Regression: a robot placed in the world was read again where it had stood before."""
    placed = PANDA.placed_in_world(transform(Z))
    slow = replace(PANDA, joints=tuple(replace(j, velocity=j.velocity / 2) for j in PANDA.joints))
    for robot in (placed, slow):
        refuses("robot was changed", problem_record, rd.Problem(robot, rd.Scene(), HOME, HOME))


def test_a_second_shape_of_one_name_is_noted(tmp_path: Path) -> None:
    problem = rd.load_problem(written(tmp_path, PLAIN | {"scene": [WALL, WALL]}))
    assert problem.notes == ("scene[1]: an earlier shape is named wall too; this one is wall_2",)


def test_holes_tools_on_held_objects_and_lines_without_an_end_are_saved_and_read_again(tmp_path: Path) -> None:
    """Regressions: NaN is no JSON; the tool was read before the object that holds it; two problems were on one line."""
    terrain = rd.HeightMap([[0, 0, 0], [0, 0, np.nan]], 0.1, [0.5, 0.5, -0.2])
    robot = PANDA.attach(rd.Sphere([0, 0, 0.12], 0.02, name="gripper"), "panda_hand").with_tool("gripper", rd.pose([0, 0, 0.1]))
    problem = rd.Problem(robot, rd.Scene([terrain]), "ready", "extended")
    file = tmp_path / "problems.jsonl"
    save_problem(problem, file)
    file.write_text(file.read_text().rstrip())
    save_problem(problem, file)
    for case in load_problems(file):
        assert [body.name for body in case.load().robot.attached] == ["gripper", "tool"]
        np.testing.assert_array_equal(case.load().scene.shapes[0].heights, terrain.heights)  # type: ignore[attr-defined]
