"""The session: changes, validation of the motion shown, and which plans are shown."""

import re
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial

import numpy as np
import pytest

import robotdiffuse as rd
from helpers import waiting
from helpers.slow_planner import SlowPlanner
from robotdiffuse.core.registry import Entry
from robotdiffuse.core.transforms import rotation_about, transform
from robotdiffuse.drawables import own_frame
from robotdiffuse.planning import PLANNERS
from robotdiffuse.robots.kinematics import link_pose
from robotdiffuse.validation.validator import verify_trajectory
from robotdiffuse.visualization.live.session import (
    INVALID,
    NEW_OBSTACLES,
    NO_MOTION,
    VALID,
    LatestTask,
    PageOptions,
    Session,
    State,
    dimensions,
    moved_to,
    resized,
    validity,
)

START = np.array([0.0, -0.4, 0.0, -2.0, 0.0, 1.6, 0.8])
END = np.array([1.2, -0.4, 0.0, -2.0, 0.0, 1.6, 0.8])
PATIENCE = 300.0
"""Timeout [s]; a new machine compiles first."""
until = partial(waiting.state_when, patience=PATIENCE)


def settled(state: State) -> bool:
    validated = state.motion is None or (
        state.validation is not None and state.validation.version == state.version
    )
    return validated and not state.planning


@contextmanager
def started(planner: str, name: str = "lamp") -> Iterator[Session]:
    """A session with a ball above the arm."""
    scene = rd.Scene([rd.Sphere([0.0, 0.0, 1.5], 0.05, name)])
    session = Session(
        rd.Problem(rd.load_robot("panda"), scene, START, rd.JointGoal(END)), PageOptions(planner, 20.0)
    )
    session.start()
    yield session
    session.close()


@pytest.fixture
def session() -> Iterator[Session]:
    with started("aorrtc") as session:
        until(session, settled)
        yield session


def in_the_way(session: Session) -> np.ndarray:
    """T_base_handle of a sphere at the hand halfway through the motion shown."""
    motion = session.state.motion
    assert motion is not None and motion.trajectory is not None
    q = motion.trajectory.positions[len(motion.trajectory.times) // 2]
    return transform(link_pose(session.state.problem.robot, q, "panda_hand")[:3, 3])


def test_a_motion_is_planned_validated_and_certified(session: Session) -> None:
    state = session.state
    assert state.motion is not None and state.motion.solved and state.motion is state.answer
    assert state.validation is not None and state.validation.report.valid
    shown = validity(state)
    assert shown.kind == VALID and "clearance at least" in shown.headline
    assert [stage for stage, _ in state.seconds] == ["first path", "planning", "timing", "validating again"]


def test_the_badge_turns_red_at_once_and_green_with_the_new_plan(session: Session) -> None:
    session.set_options(follow=False)
    first = until(session, settled).motion
    session.change_obstacle("lamp", lambda shape: moved_to(shape, in_the_way(session)))
    state = until(session, settled)
    assert state.motion is first and state.answer is None
    shown = validity(state)
    assert re.fullmatch(r"collides: panda_\w+ is \d+\.\d [cm]m inside lamp", shown.headline)
    assert re.fullmatch(r"at \d\.\d\d s of \d\.\d\d s", shown.lines[0])
    session.set_options(follow=True)
    state = until(session, lambda state: settled(state) and state.motion is not first)
    assert validity(state).kind == VALID
    assert state.motion is not None and state.motion.trajectory is not None
    assert verify_trajectory(state.problem, state.motion.trajectory).valid


def test_why_there_is_no_plan(session: Session) -> None:
    hand = link_pose(session.state.problem.robot, END, "panda_hand")
    session.change_obstacle("lamp", lambda shape: moved_to(shape, transform(hand[:3, 3])))
    state = until(session, settled)
    assert state.answer is not None and state.answer.status is rd.Status.INVALID_GOAL
    shown = validity(state)
    assert shown.kind == INVALID
    assert "no new plan: invalid_goal: the goal is in collision" in shown.lines[-1]


def test_the_target_is_dragged(session: Session) -> None:
    T = session.state.goal_pose.copy()
    T[2, 3] += 0.1
    session.move_goal(T)
    goal = session.state.problem.goal
    assert isinstance(goal, rd.PoseGoal) and goal.frame == session.state.goal_frame

    def stands(state: State) -> bool:
        q = state.goal_configuration
        robot = state.problem.robot
        return q is not None and np.allclose(link_pose(robot, q, state.goal_frame), T, atol=1e-5)

    state = until(session, lambda state: settled(state) and stands(state))
    assert state.answer is not None and state.answer.solved and validity(state).kind == VALID


def test_a_target_out_of_reach(session: Session) -> None:
    session.move_goal(transform(np.array([3.0, 0.0, 0.5])))
    state = until(session, lambda state: settled(state) and state.goal_configuration is None)
    assert state.answer is not None and state.answer.status is rd.Status.UNREACHABLE_GOAL
    assert validity(state).kind == INVALID  # the motion still ends where the goal was


def test_the_start_is_dragged_by_its_tip_and_stays_near(session: Session) -> None:
    robot = session.state.problem.robot
    T = link_pose(robot, START, robot.tip)
    T[0, 3] -= 0.02
    session.move_start(T)
    state = until(session, lambda state: not np.array_equal(state.problem.start, START))
    assert np.abs(state.problem.start - START).max() < 0.3
    np.testing.assert_allclose(link_pose(robot, state.problem.start, robot.tip), T, atol=1e-5)
    assert validity(until(session, settled)).kind == VALID


def test_what_is_wrong_leaves_the_session_as_it_was(session: Session) -> None:
    before = session.state
    with pytest.raises(rd.InputError, match="limits"):
        session.set_start(START + 10)
    with pytest.raises(rd.InputError, match="unknown planner 'best'"):
        session.set_options(planner="best")
    with pytest.raises(rd.InputError, match="time_limit"):
        session.set_options(time_limit=0.0)
    after = session.state
    assert after.problem is before.problem and after.version == before.version


def test_obstacles_are_added_resized_and_deleted(session: Session) -> None:
    name = session.add_obstacle("box", np.array([0.5, -0.5, 0.2]))
    assert session.add_obstacle("box", np.array([0.5, -0.6, 0.2])) == "box_2"
    session.change_obstacle(name, lambda shape: resized(shape, "size y", 0.5))
    box = session.state.obstacles[name]
    assert isinstance(box, rd.Box) and box.size.tolist() == [0.16, 0.5, 0.16]
    session.change_obstacle(name, lambda _: None)
    assert [shape.name for shape in session.state.problem.scene.shapes] == ["lamp", "box_2"]
    with pytest.raises(rd.InputError, match="unknown obstacle 'box'; known: box_2, lamp"):
        session.change_obstacle(name, lambda _: None)
    with pytest.raises(rd.InputError, match="known: box, capsule, cylinder, sphere"):
        session.add_obstacle("torus", np.zeros(3))


def test_another_robot_takes_the_motion_away(session: Session) -> None:
    ur5 = rd.load_robot("ur5")
    start = np.array([0.0, -1.2, 1.2, 0.0, 0.5, 0.0])
    goals = rd.AnyGoal((rd.JointGoal(start + 0.2), rd.JointGoal(start - 0.2)))
    session.open(rd.Problem(ur5, rd.Scene(), start, goals))
    assert session.state.motion is None and session.state.validation is None
    assert validity(until(session, settled)).kind == VALID


@pytest.fixture
def slow(monkeypatch: pytest.MonkeyPatch) -> Iterator[Session]:
    """A session whose planner waits for the test, and was called."""
    monkeypatch.setitem(PLANNERS, "slow", Entry("helpers.slow_planner:SlowPlanner", "waits"))
    SlowPlanner.calls.clear()
    with started("slow") as session:
        waiting.until(lambda: SlowPlanner.calls, PATIENCE)
        yield session


def test_the_latest_request_wins(slow: Session) -> None:
    for height in (1.6, 1.7, 1.8):
        T = transform(np.array([0.0, 0.0, height]))
        slow.change_obstacle("lamp", lambda shape, T=T: moved_to(shape, T))
    for _ in range(2):
        SlowPlanner.go.release()
    state = until(slow, settled)
    heights = [problem.scene.shapes[0].bounds.mean(axis=0)[2] for problem in SlowPlanner.calls]
    assert heights == pytest.approx([1.5, 1.8]) and state.answer is not None and state.answer.solved


def test_an_overtaken_plan_is_dropped_if_it_is_no_longer_free(slow: Session) -> None:
    middle = link_pose(slow.state.problem.robot, 0.5 * (START + END), "panda_hand")
    slow.change_obstacle("lamp", lambda shape: moved_to(shape, transform(middle[:3, 3])))
    SlowPlanner.go.release()

    def called_again() -> bool:
        assert slow.state.motion is None
        return len(SlowPlanner.calls) == 2

    waiting.until(called_again, PATIENCE)
    SlowPlanner.go.release()
    assert validity(until(slow, settled)).kind == VALID


def test_a_plan_for_a_robot_that_has_gone_is_dropped(slow: Session) -> None:
    start = np.array([0.0, -1.2, 1.2, 0.0, 0.5, 0.0])
    slow.open(rd.Problem(rd.load_robot("ur5"), rd.Scene(), start, rd.JointGoal(start + 0.2)))
    for _ in range(2):
        SlowPlanner.go.release()
    state = until(slow, lambda state: settled(state) and state.motion)
    assert state.motion is not None and state.motion.robot == "ur5"


def test_a_planner_that_breaks_costs_one_plan(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(PLANNERS, "slow", Entry("helpers.slow_planner:SlowPlanner", "waits"))
    with started("slow", "broken") as session:
        shown = validity(until(session, settled))
        assert shown.kind == NO_MOTION and shown.lines == ("slow failed: RuntimeError: no such luck",)
        session.set_options(planner="aorrtc")
        assert validity(until(session, lambda state: settled(state) and state.motion)).kind == VALID


def test_latest_goes_on_after_an_error(caplog: pytest.LogCaptureFixture) -> None:
    done = threading.Event()

    def do(divisor: int) -> None:
        if 1 / divisor:
            done.set()

    latest = LatestTask(do, "test")
    latest.submit(0)
    waiting.until(lambda: "ZeroDivisionError" in caplog.text, PATIENCE)
    latest.submit(1)
    assert done.wait(PATIENCE)
    latest.close()


CORNERS = np.array([[0.0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1]])


@pytest.mark.parametrize(
    "shape",
    [
        *(
            NEW_OBSTACLES[kind](np.array([0.1, 0.2, 0.3]), 0.08)
            for kind in ("sphere", "box", "cylinder", "capsule")
        ),
        rd.Mesh(CORNERS, [[0, 1, 2], [0, 1, 3]], xyz=(0.1, 0, 0)),
        rd.PointCloud(CORNERS),
    ],
    ids=lambda shape: shape.kind,
)
def test_shapes_go_where_their_handles_are_put(shape) -> None:
    T = transform(np.array([0.5, -0.2, 0.7]), rotation_about(np.array([0.6, 0.0, 0.8]), 1.0))
    at = own_frame(moved_to(shape, T))
    turned = shape.kind not in ("sphere", "point_cloud")
    np.testing.assert_allclose(at, T if turned else transform(T[:3, 3]), atol=1e-12)
    for name, value in dimensions(shape).items():
        assert dimensions(resized(shape, name, value + 0.1)) == {**dimensions(shape), name: value + 0.1}
        with pytest.raises(rd.InputError, match=f"{name} of {shape.name} is 0 m; it must be 0.01 to 2 m"):
            resized(shape, name, 0.0)
