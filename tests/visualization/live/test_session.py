"""The session: changes, validation of the motion shown, and which plans are shown."""

import re
import threading
from collections.abc import Iterator
from functools import partial

import numpy as np
import pytest

from helpers import waiting
from helpers.slow_planner import SlowPlanner
from robotdiffuse.core.errors import InputError
from robotdiffuse.core.registry import Entry
from robotdiffuse.core.transforms import rotation_about, transform
from robotdiffuse.core.types import Status
from robotdiffuse.drawables import own_frame
from robotdiffuse.planning import PLANNERS
from robotdiffuse.problems.goals import AnyGoal, JointGoal, PoseGoal
from robotdiffuse.problems.problem import Problem
from robotdiffuse.robots import load_robot
from robotdiffuse.robots.kinematics import link_pose
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.shapes import Box, Mesh, PointCloud, Sphere
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


def a_problem(shapes: tuple = ()) -> Problem:
    return Problem(load_robot("panda"), Scene(shapes), START, JointGoal(END))


@pytest.fixture
def session() -> Iterator[Session]:
    session = Session(a_problem((Sphere([0.0, 0.0, 1.5], 0.05, "lamp"),)), PageOptions("aorrtc", 20.0))
    session.start()
    until(session, settled)
    yield session
    session.close()


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
    assert [stage for stage, _ in state.seconds] == [
        "first path",
        "planning",
        "timing",
        "validating again",
    ]


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
    assert state.answer is not None and state.answer.status is Status.INVALID_GOAL
    shown = validity(state)
    assert shown.kind == INVALID
    assert "no new plan: invalid_goal: the goal is in collision" in shown.lines[-1]


def test_no_motion_at_all() -> None:
    session = Session(a_problem((Sphere(link_pose(load_robot("panda"), END, "panda_hand")[:3, 3], 0.1),)))
    session.set_options(planner="aorrtc")
    shown = validity(until(session, lambda state: state.answer))
    assert shown.kind == NO_MOTION and shown.lines[0].startswith("invalid_goal")
    session.close()


def test_the_target_is_dragged(session: Session) -> None:
    T = session.state.goal_pose.copy()
    T[2, 3] += 0.1
    session.move_goal(T)
    goal = session.state.problem.goal
    assert isinstance(goal, PoseGoal) and goal.frame == session.state.goal_frame
    state = until(session, lambda state: settled(state) and _stands(state, T))
    assert state.answer is not None and state.answer.solved and validity(state).kind == VALID


def _stands(state: State, T: np.ndarray) -> bool:
    """Whether the configuration shown for the goal reaches it."""
    q = state.goal_configuration
    robot = state.problem.robot
    return q is not None and np.allclose(link_pose(robot, q, state.goal_frame), T, atol=1e-5)


def test_a_target_out_of_reach(session: Session) -> None:
    session.move_goal(transform(np.array([3.0, 0.0, 0.5])))
    state = until(session, lambda state: settled(state) and state.goal_configuration is None)
    assert state.answer is not None and state.answer.status is Status.UNREACHABLE_GOAL
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
    with pytest.raises(InputError, match="limits"):
        session.set_start(START + 10)
    with pytest.raises(InputError, match="unknown planner 'best'"):
        session.set_options(planner="best")
    with pytest.raises(InputError, match="time_limit"):
        session.set_options(time_limit=0.0)
    after = session.state
    assert after.problem is before.problem and after.version == before.version


def test_obstacles_are_added_resized_and_deleted(session: Session) -> None:
    name = session.add_obstacle("box", np.array([0.5, -0.5, 0.2]))
    assert session.add_obstacle("box", np.array([0.5, -0.6, 0.2])) == "box_2"
    session.change_obstacle(name, lambda shape: resized(shape, "size y", 0.5))
    box = session.state.obstacles[name]
    assert isinstance(box, Box) and box.size.tolist() == [0.16, 0.5, 0.16]
    session.change_obstacle(name, lambda _: None)
    assert [shape.name for shape in session.state.problem.scene.shapes] == ["lamp", "box_2"]
    with pytest.raises(InputError, match="unknown obstacle 'box'; known: box_2, lamp"):
        session.change_obstacle(name, lambda _: None)
    with pytest.raises(InputError, match="known: box, capsule, cylinder, sphere"):
        session.add_obstacle("torus", np.zeros(3))


def test_another_robot_takes_the_motion_away(session: Session) -> None:
    ur5 = load_robot("ur5")
    start = np.array([0.0, -1.2, 1.2, 0.0, 0.5, 0.0])
    goals = AnyGoal((JointGoal(start + 0.2), JointGoal(start - 0.2)))
    session.open(Problem(ur5, Scene(), start, goals))
    assert session.state.motion is None and session.state.validation is None
    assert validity(until(session, settled)).kind == VALID


@pytest.fixture
def slow(monkeypatch: pytest.MonkeyPatch) -> type[SlowPlanner]:
    monkeypatch.setitem(PLANNERS, "slow", Entry("helpers.slow_planner:SlowPlanner", "waits"))
    SlowPlanner.calls.clear()
    return SlowPlanner


def test_the_latest_request_wins(slow: type[SlowPlanner]) -> None:
    session = Session(a_problem((Sphere([0.0, 0.0, 1.5], 0.05, "lamp"),)), PageOptions("slow", 20.0))
    session.start()
    waiting.until(lambda: slow.calls, PATIENCE)
    for height in (1.6, 1.7, 1.8):
        session.change_obstacle(
            "lamp", lambda shape, z=height: moved_to(shape, transform(np.array([0.0, 0.0, z])))
        )
    for _ in range(2):
        slow.go.release()
    state = until(session, settled)
    assert [round(float(problem.scene.shapes[0].bounds.mean(axis=0)[2]), 6) for problem in slow.calls] == [
        1.5,
        1.8,
    ]
    assert state.answer is not None and state.answer.solved
    session.close()


def test_an_overtaken_plan_is_dropped_if_it_is_no_longer_free(slow: type[SlowPlanner]) -> None:
    session = Session(a_problem((Sphere([0.0, 0.0, 1.5], 0.05, "lamp"),)), PageOptions("slow", 20.0))
    session.start()
    waiting.until(lambda: slow.calls, PATIENCE)
    middle = link_pose(session.state.problem.robot, 0.5 * (START + END), "panda_hand")
    session.change_obstacle("lamp", lambda shape: moved_to(shape, transform(middle[:3, 3])))
    slow.go.release()

    def called_again() -> bool:
        assert session.state.motion is None
        return len(slow.calls) == 2

    waiting.until(called_again, PATIENCE)
    slow.go.release()
    assert validity(until(session, settled)).kind == VALID
    session.close()


def test_a_plan_for_a_robot_that_has_gone_is_dropped(slow: type[SlowPlanner]) -> None:
    session = Session(a_problem(), PageOptions("slow", 20.0))
    session.start()
    waiting.until(lambda: slow.calls, PATIENCE)
    start = np.array([0.0, -1.2, 1.2, 0.0, 0.5, 0.0])
    session.open(Problem(load_robot("ur5"), Scene(), start, JointGoal(start + 0.2)))
    for _ in range(2):
        slow.go.release()
    state = until(session, lambda state: settled(state) and state.motion)
    assert state.motion is not None and state.motion.robot == "ur5"
    session.close()


def test_a_planner_that_breaks_costs_one_plan(slow: type[SlowPlanner]) -> None:
    session = Session(a_problem((Sphere([0.0, 0.0, 1.5], 0.05, "broken"),)), PageOptions("slow", 20.0))
    session.start()
    shown = validity(until(session, settled))
    assert shown.kind == NO_MOTION and shown.lines == ("slow failed: RuntimeError: no such luck",)
    session.set_options(planner="aorrtc")
    assert validity(until(session, lambda state: settled(state) and state.motion)).kind == VALID
    session.close()


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


def test_latest_drops_what_was_not_begun() -> None:
    done = []
    begun = threading.Event()
    go = threading.Event()

    def do(work: int) -> None:
        begun.set()
        go.wait()
        done.append(work)

    latest = LatestTask(do, "test")
    latest.submit(1)
    begun.wait()
    for work in (2, 3, 4):
        latest.submit(work)
    go.set()
    waiting.until(lambda: done == [1, 4], PATIENCE)
    latest.close()


CORNERS = np.array([[0.0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1]])


@pytest.mark.parametrize(
    "shape",
    [
        *(
            NEW_OBSTACLES[kind](np.array([0.1, 0.2, 0.3]), 0.08)
            for kind in ("sphere", "box", "cylinder", "capsule")
        ),
        Mesh(CORNERS, [[0, 1, 2], [0, 1, 3]], xyz=(0.1, 0, 0)),
        PointCloud(CORNERS),
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
        with pytest.raises(InputError, match=f"{name} of {shape.name} is 0 m; it must be 0.01 to 2 m"):
            resized(shape, name, 0.0)
