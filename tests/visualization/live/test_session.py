"""The session: changes, validation of the motion shown, which plans are shown; the first problem, uploads, saved files."""

import json
import re
import threading
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest

import robotdiffuse as rd
from helpers.planners import SlowPlanner
from helpers.refusals import refuses
from helpers.waiting import state_when, until
from robotdiffuse import load_robot
from robotdiffuse.core.registry import Entry
from robotdiffuse.core.transforms import rotation_about, transform
from robotdiffuse.drawables import own_frame
from robotdiffuse.planning import PLANNERS
from robotdiffuse.problems.files import problem_record
from robotdiffuse.visualization.live import session as live
from robotdiffuse.visualization.live.session import first_problem, problem_for, problem_text, uploaded_problem

START = np.array([0.0, -0.4, 0.0, -2.0, 0.0, 1.6, 0.8])
END = np.array([1.2, -0.4, 0.0, -2.0, 0.0, 1.6, 0.8])


def settled(state: live.State) -> bool:
    validated = state.motion is None or (state.validation is not None and state.validation.version == state.version)
    return validated and not state.planning


@contextmanager
def started(planner: str, name: str = "lamp") -> Iterator[live.Session]:
    """A session with a ball above the arm."""
    scene = rd.Scene([rd.Sphere([0.0, 0.0, 1.5], 0.05, name)])
    session = live.Session(rd.Problem(rd.load_robot("panda"), scene, START, rd.JointGoal(END)), live.PageOptions(planner, 20.0))
    session.start()
    yield session
    session.close()


@pytest.fixture
def session() -> Iterator[live.Session]:
    with started("aorrtc") as session:
        state_when(session, settled)
        yield session


def test_the_badge_turns_red_at_once_and_green_with_the_new_plan(session: live.Session) -> None:
    """An obstacle is placed at the hand halfway through a motion that was planned, validated and certified."""
    state = session.state
    first = state.motion
    assert first is not None and first.trajectory is not None and first is state.answer
    shown = live.validity(state)
    assert shown.kind == live.VALID and "clearance at least" in shown.headline
    assert [stage for stage, _ in state.seconds] == ["first path", "planning", "timing", "validating again"]
    session.set_options(follow=False)
    q = first.trajectory.positions[len(first.trajectory.times) // 2]
    hand = transform(state.problem.robot.fk(q, "panda_hand")[:3, 3])
    session.change_obstacle("lamp", lambda shape: live.moved_to(shape, hand))
    state = state_when(session, settled)
    assert state.motion is first and state.answer is None
    shown = live.validity(state)
    assert re.fullmatch(r"collides: panda_\w+ is \d+\.\d [cm]m inside lamp", shown.headline)
    assert re.fullmatch(r"at \d\.\d\d s of \d\.\d\d s", shown.lines[0])
    session.set_options(follow=True)
    state = state_when(session, lambda state: settled(state) and state.motion is not first)
    assert live.validity(state).kind == live.VALID
    assert state.motion is not None and state.motion.trajectory is not None
    assert rd.verify(state.problem, state.motion.trajectory).valid


def test_why_there_is_no_plan(session: live.Session) -> None:
    hand = session.state.problem.robot.fk(END, "panda_hand")
    session.change_obstacle("lamp", lambda shape: live.moved_to(shape, transform(hand[:3, 3])))
    state = state_when(session, settled)
    assert state.answer is not None and state.answer.status is rd.Status.INVALID_GOAL
    shown = live.validity(state)
    assert shown.kind == live.INVALID and "no new plan: invalid_goal: the goal is in collision" in shown.lines[-1]


def test_the_target_is_dragged(session: live.Session) -> None:
    T = session.state.goal_pose.copy()
    T[2, 3] += 0.1
    session.move_goal(T)
    goal = session.state.problem.goal
    assert isinstance(goal, rd.PoseGoal) and goal.frame == session.state.goal_frame

    def stands(state: live.State) -> bool:
        q = state.goal_configuration
        return q is not None and np.allclose(state.problem.robot.fk(q, state.goal_frame), T, atol=1e-5)

    state = state_when(session, lambda state: settled(state) and stands(state))
    assert state.answer is not None and state.answer.solved and live.validity(state).kind == live.VALID


def test_the_start_is_dragged_by_its_tip_and_stays_near(session: live.Session) -> None:
    robot = session.state.problem.robot
    T = robot.fk(START)
    T[0, 3] -= 0.02
    session.move_start(T)
    state = state_when(session, lambda state: not np.array_equal(state.problem.start, START))
    assert np.abs(state.problem.start - START).max() < 0.3
    np.testing.assert_allclose(robot.fk(state.problem.start), T, atol=1e-5)
    assert live.validity(state_when(session, settled)).kind == live.VALID


def test_what_is_wrong_leaves_the_session_as_it_was(session: live.Session) -> None:
    before = session.state
    refuses("limits", session.set_start, START + 10)
    refuses("unknown planner 'best'", session.set_options, planner="best")
    refuses("time_limit", session.set_options, time_limit=0.0)
    after = session.state
    assert after.problem is before.problem and after.version == before.version


def test_obstacles_are_added_resized_and_deleted(session: live.Session) -> None:
    name = session.add_obstacle("box")
    assert session.add_obstacle("box") == "box_2"
    session.change_obstacle(name, lambda shape: live.resized(shape, "size y", 0.5))
    box = session.state.obstacles[name]
    assert isinstance(box, rd.Box) and box.size.tolist() == [0.16, 0.5, 0.16]
    session.change_obstacle(name, lambda _: None)
    assert [shape.name for shape in session.state.problem.scene.shapes] == ["lamp", "box_2"]
    refuses("unknown obstacle 'box'; known: box_2, lamp", session.change_obstacle, name, lambda _: None)
    refuses("known: box, capsule, cylinder, sphere", session.add_obstacle, "torus")


@pytest.fixture
def slow(monkeypatch: pytest.MonkeyPatch) -> Iterator[live.Session]:
    """A session whose planner has been called and waits for the test."""
    monkeypatch.setitem(PLANNERS, "slow", Entry("helpers.planners:SlowPlanner", "waits"))
    SlowPlanner.calls.clear()
    with started("slow") as session:
        until(lambda: SlowPlanner.calls)
        yield session


def test_the_latest_request_wins(slow: live.Session) -> None:
    for height in (1.6, 1.7, 1.8):
        T = transform(np.array([0.0, 0.0, height]))
        slow.change_obstacle("lamp", lambda shape, T=T: live.moved_to(shape, T))
    SlowPlanner.go.release(2)
    state = state_when(slow, settled)
    heights = [problem.scene.shapes[0].bounds.mean(axis=0)[2] for problem in SlowPlanner.calls]
    assert heights == pytest.approx([1.5, 1.8]) and state.answer is not None and state.answer.solved


def test_an_overtaken_plan_is_dropped_if_it_is_no_longer_free(slow: live.Session) -> None:
    middle = slow.state.problem.robot.fk(0.5 * (START + END), "panda_hand")
    slow.change_obstacle("lamp", lambda shape: live.moved_to(shape, transform(middle[:3, 3])))
    SlowPlanner.go.release()

    def called_again() -> bool:
        assert slow.state.motion is None
        return len(SlowPlanner.calls) == 2

    until(called_again)
    SlowPlanner.go.release()
    assert live.validity(state_when(slow, settled)).kind == live.VALID


def test_a_plan_for_a_robot_that_has_gone_is_dropped(slow: live.Session) -> None:
    start = np.array([0.0, -1.2, 1.2, 0.0, 0.5, 0.0])
    slow.open(rd.Problem(rd.load_robot("ur5"), rd.Scene(), start, rd.JointGoal(start + 0.2)))
    SlowPlanner.go.release(2)
    state = state_when(slow, lambda state: settled(state) and state.motion)
    assert state.motion is not None and state.motion.robot == "ur5"


def test_a_planner_that_breaks_costs_one_plan(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(PLANNERS, "slow", Entry("helpers.planners:SlowPlanner", "waits"))
    with started("slow", "broken") as session:
        shown = live.validity(state_when(session, settled))
        assert shown.kind == live.NO_MOTION and shown.lines == ("slow failed: RuntimeError: no such luck",)
        session.set_options(planner="aorrtc")
        assert live.validity(state_when(session, lambda state: settled(state) and state.motion)).kind == live.VALID


def test_latest_goes_on_after_an_error(caplog: pytest.LogCaptureFixture) -> None:
    done = threading.Event()
    latest = live.LatestTask[int](lambda divisor: done.set() if 1 / divisor else None, "test")
    latest.submit(0)
    until(lambda: "ZeroDivisionError" in caplog.text)
    latest.submit(1)
    assert done.wait(300.0)
    latest.close()


CORNERS = np.array([[0.0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1]])


@pytest.mark.parametrize(
    "shape",
    [
        *(live.NEW_OBSTACLES[kind](np.array([0.1, 0.2, 0.3]), 0.08) for kind in ("sphere", "box", "cylinder", "capsule")),
        rd.Mesh(CORNERS, [[0, 1, 2], [0, 1, 3]], xyz=(0.1, 0, 0)),
        rd.HeightMap(np.eye(3), 0.1, wxyz=(0.6, 0, 0, 0.8)),
        rd.PointCloud(CORNERS),
    ],
    ids=lambda shape: shape.kind,
)
def test_shapes_go_where_their_handles_are_put(shape) -> None:
    T = transform(np.array([0.5, -0.2, 0.7]), rotation_about(np.array([0.6, 0.0, 0.8]), 1.0))
    turned = shape.kind not in ("sphere", "point_cloud")
    np.testing.assert_allclose(own_frame(live.moved_to(shape, T)), T if turned else transform(T[:3, 3]), atol=1e-12)
    for name, value in live.dimensions(shape).items():
        assert live.dimensions(live.resized(shape, name, value + 0.1)) == {**live.dimensions(shape), name: value + 0.1}
        refuses(r"must be", live.resized, shape, name, 0.0)


DEMO = first_problem(None, None)


def test_problems_go_out_and_come_back() -> None:
    for text, name in ((problem_text(DEMO), "p.yaml"), (json.dumps(problem_record(DEMO)).encode(), "p.json")):
        assert problem_record(uploaded_problem(text, name, DEMO.robot)) == problem_record(DEMO), name


@pytest.mark.parametrize("name", ["panda", "so101", "ur10"])
def test_every_arm_has_a_first_problem(name: str) -> None:
    assert problem_for(load_robot(name)).robot.name == name


GOOD = """robot: panda
scene: []
start: [0, 0, 0, -1.5, 0, 1.5, 0]
goal: {joints: [1, 0, 0, -1.5, 0, 1.5, 0]}
"""
VIEWS = "views: [{cloud: x.ply, camera: {xyz: [1, 0, 1], wxyz: [0, 1, 0, 0]}}]\n"


@pytest.mark.parametrize(
    ("text", "wrong"),
    [
        (GOOD.replace("panda", "pandora"), "unknown robot 'pandora'; known: "),
        (GOOD.replace("panda", "/etc/robot.urdf"), "unknown robot '/etc/robot.urdf'; known: "),
        (GOOD.replace("panda", "[panda]"), r"unknown robot \['panda'\]; known: "),
        (GOOD.replace("panda", "null"), "unknown robot 'None'; known: .*panda"),
        (GOOD.replace("[]", "secret.yaml"), "secret.yaml is a file, and files are not read here"),
        (GOOD.replace("[]", "[{mesh: {file: /etc/passwd}}]"), "/etc/passwd is a file, and files are not"),
        (GOOD + VIEWS, "x.ply is a file, and files are not read here"),
        (GOOD + "attached: [{link: panda_hand, mesh: {file: x.stl}}]\n", "x.stl is a file, and files are not read here"),
        (GOOD.replace("-1.5", "9"), "start: panda_joint4 is 9 rad; its limits are"),
        ("robot: panda\nscene: []\nrequest: x.yaml\n", "x.yaml is a file, and files are not read here"),
        (GOOD.replace("start", "begin"), "unknown field of problem: 'begin'"),
        ("[1, 2", "p.yaml.*"),
        ("", "problem is None"),
    ],
)
def test_what_is_wrong_with_an_uploaded_problem_is_one_line(text: str, wrong: str) -> None:
    assert refuses(wrong, uploaded_problem, text.encode(), "p.yaml", DEMO.robot).startswith("p.yaml")


def test_a_problem_and_a_robot_at_once_and_uploads_that_are_no_text_or_too_long() -> None:
    refuses(r"p\.yaml is not UTF-8 text", uploaded_problem, b"\xff\xfe", "p.yaml", DEMO.robot)
    refuses("at most 5000000 are read", uploaded_problem, b" " * 5_000_001, "p.yaml", DEMO.robot)
    refuses(r"p\.yaml names its robot; give a problem or --robot ur5, not both", first_problem, "p.yaml", "ur5")
