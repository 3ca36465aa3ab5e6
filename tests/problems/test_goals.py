"""Goals with tolerances, several goals, goals relative to objects; waypoints."""

from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
from numpy import ndarray
from scipy.interpolate import CubicHermiteSpline

import robotdiffuse as rd
from helpers.commands import written
from helpers.refusals import refuses
from robotdiffuse.core.transforms import inverse, rotation_from_rpy, transform
from robotdiffuse.planning.planner import Planner
from robotdiffuse.problems.files import problem_from_record, problem_record
from robotdiffuse.validation.tolerances import goal_error

ROBOT = rd.load_robot("panda")
START = [-0.6, 0.2, 0, -2.0, 0, 2.2, 0.2]
MIDDLE = [0, -0.9, 0, -2.6, 0, 1.8, 0.2]
END = [0.6, 0.2, 0, -2.0, 0, 2.2, 0.2]
POST = rd.Cylinder([0.5, 0.0, 0.3], 0.04, 0.6, name="post")
TABLE = {"box": {"center": [0.55, 0, 0.1], "size": [0.5, 1.0, 0.2], "wxyz": [0.9, 0, 0, 0.2], "name": "table"}}
GOOD = {"robot": "panda", "scene": [TABLE], "start": START, "goal": {"joints": END}}
AHEAD = transform(np.array([0.5, 0.0, 0.35]), rotation_from_rpy(np.pi, 0.0, 0.0))
WIDE = rd.PoseGoal("panda_hand", AHEAD, [0.0, 0.35, 0.0], [0.0, 0.0, np.pi])
DOWN = transform(np.array([0.45, 0.3, 0.35]), rotation_from_rpy(np.pi, 0.0, 0.0))


def off(goal: rd.PoseGoal, xyz: Any, rpy: Any) -> bool:
    """Whether a pose that differs by xyz and rpy from that of the arm at START misses the goal, which is placed there."""
    q = np.array(START)
    T = ROBOT.fk(q, goal.frame) @ inverse(transform(np.array(xyz, float), rotation_from_rpy(*map(float, rpy))))
    return goal_error(ROBOT, rd.PoseGoal(goal.frame, T, goal.xyz_tolerance, goal.rpy_tolerance), q) is not None


def test_tolerances_are_along_the_axes_of_the_goal() -> None:
    for xyz, rpy, within, beyond in (
        ([0.1, 0.02, 0], [0, 0, np.pi], ([0.09, -0.019, 0], [0, 0, 3.0]), ([0.09, -0.021, 0], [0, 0, 3.0])),
        ([0.1, 0.02, 0], [0, 0, np.pi], ([-0.09, 0, 0], [0, 0, -2.0]), ([0, 0, 0], [0, 0.01, -2.0])),
        ([0, 0, 0], [0.1, 0.2, 0.3], ([0, 0, 0], [0.09, -0.19, 0.29]), ([0, 0, 0], [0.11, 0, 0])),
        ([0, 0, 0], [0, np.pi, 0], ([0, 0, 0], [0, 2.5, 0]), ([0, 0, 0], [0.1, 2.5, 0])),
        (None, [np.pi] * 3, ([0.005, 0, 0], [1, 2, 3]), ([0.011, 0, 0], [1, 2, 3])),
        ([1.0, 1, 1], None, ([0.5, 0.5, 0.5], [0.2, 0, 0]), ([0.5, 0, 0], [0.3, 0, 0])),
    ):
        goal = rd.PoseGoal("panda_hand", np.eye(4), xyz, rpy)
        assert not off(goal, *within) and off(goal, *beyond)


def test_a_box_of_positions_is_reached_where_its_middle_is_blocked() -> None:
    blocked = rd.Problem(ROBOT, rd.Scene([POST]), START, rd.PoseGoal("panda_hand", AHEAD))
    assert rd.plan(blocked).status is rd.Status.INVALID_GOAL
    result = rd.plan(rd.Problem(ROBOT, rd.Scene([POST]), START, WIDE), time_limit=10.0)
    assert result.path is not None, result.reason
    T = inverse(AHEAD) @ ROBOT.fk(result.path.positions[-1], "panda_hand")
    assert np.abs(T[[0, 2], 3]).max() < 1e-5 and abs(T[1, 3]) < 0.35
    assert abs(T[2, 2] - 1) < 1e-9, "upside down as asked"


def test_a_box_of_positions_is_reached_where_only_its_middle_is_free() -> None:
    """Projections end at the edges of the tolerances, which are blocked by obstacles here."""
    blocks = [rd.Box([0.5, side * 0.42, 0.35], [0.6, 0.4, 0.7]) for side in (-1, 1)]
    result = rd.plan(rd.Problem(ROBOT, rd.Scene(blocks), MIDDLE, WIDE), time_limit=10.0)
    assert result.path is not None, result.reason
    assert abs(ROBOT.fk(result.path.positions[-1], "panda_hand")[1, 3]) < 0.2


def stops(trajectory: rd.Trajectory, goal: ndarray) -> bool:
    there = np.abs(trajectory.positions - goal).max(axis=1) < 1e-6
    return bool((np.abs(trajectory.velocities[there]).max(axis=1) < 1e-9).any())


def test_one_motion_stops_at_waypoints_in_their_order() -> None:
    way = [MIDDLE, rd.PoseGoal("panda_hand", DOWN), START]
    problem = rd.Problem(ROBOT, rd.Scene([POST]), START, END, waypoints=way)
    result = rd.plan(problem, time_limit=10.0)
    assert result.path is not None and result.trajectory is not None, result.reason
    assert rd.verify(problem, result.path).valid and rd.verify(problem, result.trajectory).valid
    assert stops(result.trajectory, np.array(MIDDLE)) and stops(result.trajectory, np.array(END))
    assert (np.diff(result.trajectory.times) > 0).all()
    assert "4 segments" in result.reason
    other = rd.Problem(ROBOT, rd.Scene([POST]), START, END, waypoints=[way[1], way[0], END, START])
    found = rd.verify(other, result.path).violation
    assert found is not None and found.kind == "waypoint" and "waypoints[1]" in found.message


def nearest(trajectory: rd.Trajectory, goal: rd.PoseGoal | rd.JointGoal) -> float:
    """The smallest distance of the motion to a goal, on the cubics between the rows."""
    curve = CubicHermiteSpline(trajectory.times, trajectory.positions, trajectory.velocities)
    q = curve(np.linspace(0, trajectory.duration, 20_000))
    if isinstance(goal, rd.JointGoal):
        return float(np.linalg.norm(q - goal.positions[0], axis=1).min())
    return float(np.linalg.norm(ROBOT.fk(q, goal.frame)[:, :3, 3] - goal.T_base_frame[:3, 3], axis=1).min())


@pytest.mark.parametrize("blend", [0.02, 0.1, 0.5])
def test_blended_waypoints_are_passed_within_their_blend_without_a_stop(blend: float) -> None:
    way = [rd.JointGoal(MIDDLE), rd.PoseGoal("panda_hand", DOWN, [0.0] * 3)]
    stopped = rd.Problem(ROBOT, rd.Scene([POST]), START, END, waypoints=way)
    problem = replace(stopped, blend=blend)
    one, other = (rd.plan(p, time_limit=10.0).trajectory for p in (problem, stopped))
    assert one is not None and other is not None
    assert rd.verify(problem, one).valid and rd.verify(stopped, other).valid and one.duration < other.duration
    assert np.linalg.norm(one.velocities[1:-1], axis=1).min() > 1e-3
    for k, goal in enumerate(way):
        assert nearest(one, goal) <= blend + 1e-5
        closer = [0.9 * nearest(one, goal) if i == k else 0.5 for i in range(2)]
        found = rd.verify(replace(problem, blend=closer), one).violation
        assert found is not None and found.message.startswith("the motion does not pass within ")
    found = rd.verify(stopped, one).violation
    assert found is not None and found.message == "the motion does not stop at waypoints[0]"


def test_each_waypoint_has_its_own_blend_no_wider_than_is_free() -> None:
    problem = rd.Problem(ROBOT, rd.Scene([POST]), START, END, waypoints=[MIDDLE, START, MIDDLE], blend=[0, 0.1, 0])
    result = rd.plan(problem, time_limit=10.0)
    assert result.trajectory is not None and rd.verify(problem, result.trajectory).valid
    assert stops(result.trajectory, np.array(MIDDLE)) and "4 segments" in result.reason
    resting = result.trajectory.times[np.linalg.norm(result.trajectory.velocities, axis=1) <= 1e-3]
    assert len(resting) >= 4 and np.abs(resting - result.trajectory.times[[0, -1]].mean()).min() > 0.1
    wall = rd.Box(ROBOT.fk(MIDDLE, "panda_hand")[:3, 3] - [0.0, 0.0, 0.18], [0.02, 0.3, 0.1], name="wall")
    problem = rd.Problem(ROBOT, rd.Scene([wall]), START, END, waypoints=[MIDDLE], blend=1.0)
    result = rd.plan(problem, time_limit=10.0)
    assert result.trajectory is not None and rd.verify(problem, result.trajectory).valid


def test_the_leg_that_fails_is_named_and_not_repeated_for_a_configuration_in_collision() -> None:
    blocked = rd.PoseGoal("panda_hand", AHEAD)
    result = rd.plan(rd.Problem(ROBOT, rd.Scene([POST]), START, END, waypoints=[MIDDLE, blocked]), time_limit=10.0)
    assert result.status is rd.Status.INVALID_GOAL and result.reason.startswith("segment 2 of 3: all")
    # regression: after a pose, a configuration in collision was planned to with one seed after the other
    problem = rd.Problem(ROBOT, rd.Scene([rd.Sphere(ROBOT.fk(END)[:3, 3], 0.02)]), START, END, waypoints=[blocked])
    with patch.object(Planner, "attempt", autospec=True, side_effect=Planner.attempt) as attempt:
        assert rd.plan(problem, time_limit=10.0).status is rd.Status.INVALID_GOAL
    assert attempt.call_count == 2


def test_files_keep_goals_and_waypoints(tmp_path: Path) -> None:
    pose = {"frame": "panda_hand", "xyz": [0.0, 0.1, 0.3], "wxyz": [0.0, 1.0, 0.0, 0.0]}
    record = GOOD | {
        "goal": {"any": [{"pose": pose | {"relative_to": "table", "rpy_tolerance": [0, 0, 3.1]}}, {"joints": END}]},
        "waypoints": [{"joints": MIDDLE}, {"pose": pose | {"xyz_tolerance": [0.1, 0.1, 0.0]}}],
        "blend": [0.0, 0.05],
    }
    for base in ({}, {"base": {"xyz": [0.1, 0.2, 0.3], "wxyz": [0.6, 0.0, 0.0, 0.8]}}):
        problem = rd.load_problem(written(tmp_path, record | base))
        kept = problem_record(problem)
        assert problem_record(problem_from_record(kept)) == kept
        assert isinstance(problem.goal, rd.AnyGoal) and isinstance(problem.goal.goals[0], rd.PoseGoal)
        T_object_base = inverse(problem.known_scene.shapes[0].solid()[0])
        assert np.allclose((T_object_base @ problem.goal.goals[0].T_base_frame)[:3, 3], pose["xyz"])
        assert len(problem.waypoints) == 2 and problem.blend == (0.0, 0.05) and kept["blend"] == [0.0, 0.05]


POSE = {"frame": "panda_hand", "xyz": [0.4, 0, 0.4], "wxyz": [0, 1, 0, 0]}


def pose(**more: Any) -> dict[str, Any]:
    return {"goal": {"pose": POSE | more}}


WRONG = {
    "object": (pose(relative_to="shelf"), "unknown object in goal.pose.relative_to: 'shelf'; known: table"),
    "tolerance": (pose(xyz_tolerance=[0.1]), "goal.xyz_tolerance is .*; it must be 3 numbers from 0"),
    "relative to a list": (pose(relative_to=[]), r"unknown object in goal.pose.relative_to: \[\]; known"),
    "tolerance in degrees": (pose(rpy_tolerance=[0, 0, 5]), r"it must be 3 numbers from 0 to 3.2 \[rad\]"),
    "any": ({"goal": {"any": [{"pose": POSE}, {"joint": END}]}}, r"unknown field of goal.any\[1\]: 'joint'"),
    "waypoints": ({"waypoints": {"joints": END}}, "waypoints is .*; it must be a list of goals"),
    "blend": ({"blend": 0.1}, "blend is 0.1; there are no waypoints"),
    "blends": ({"waypoints": [{"joints": END}], "blend": [0.1, 0.1]}, r"blend is \[0.1, 0.1\]; it must be one"),
    "little blend": ({"waypoints": [{"joints": END}], "blend": 1e-9}, "blend is 1e-09; .*from 0.001 to 10"),
}


@pytest.mark.parametrize(("extra", "message"), WRONG.values(), ids=WRONG)
def test_wrong_goals_are_one_line(extra: dict[str, Any], message: str, tmp_path: Path) -> None:
    refuses(message, rd.load_problem, written(tmp_path, GOOD | extra))


def test_poses_are_drawn_on_as_long_as_none_is_free() -> None:
    """The goal is a line of 10 m, of which 3 % can be reached and are free, so 20 draws usually miss that part."""
    block = rd.Box([0.65, 0.325, 0.5], [0.7, 1.35, 1.0], name="block")
    narrow = rd.PoseGoal("panda_hand", AHEAD, [0.0, 5.0, 0.0], [0.0, 0.0, np.pi])
    result = rd.plan(rd.Problem(ROBOT, rd.Scene([block]), [-1.5, 0.2, 0, -2.0, 0, 2.2, 0.2], narrow), time_limit=60.0, seed=5)
    assert result.path is not None, result.reason
    assert ROBOT.fk(result.path.positions[-1], "panda_hand")[1, 3] < -0.35


class Series:
    """Numbers with labels, which NumPy does not see, as in pandas."""

    def __init__(self, numbers: dict[Any, float]) -> None:
        self.keys, self.numbers = numbers.keys, numbers

    def __getitem__(self, label: Any) -> float:
        return self.numbers[label]

    __array__ = lambda self, *_, **__: np.array([*self.numbers.values()])  # noqa: E731


def test_labels_of_numbers_clearances_of_numpy_and_any_of_any_of_goals() -> None:
    labelled = dict(zip(ROBOT.joint_names, END, strict=True))
    for goal in (dict(reversed(labelled.items())), dict(enumerate(END))):
        problem = rd.Problem(ROBOT, rd.Scene(), START, Series(goal), clearance=np.float32(0.25))  # type: ignore[arg-type]
        assert {"goal": {"joints": END}, "clearance": 0.25}.items() <= problem_record(problem).items()
    refuses("unknown joint in goal: 'time'", rd.Problem, ROBOT, rd.Scene(), START, Series(labelled | {"time": 0.0}))
    one, two, three = (rd.JointGoal(np.full(7, x)) for x in (0.1, 0.2, 0.3))
    assert rd.AnyGoal((one, rd.AnyGoal((two, three)))).goals == (one, two, three)  # type: ignore


def test_poses_of_few_decimals_can_be_moved_by_a_base_of_few_decimals() -> None:
    T = rd.pose([0.3, 0.1, 0.2], wxyz=[0.9, 0.2, 0.3, 0.1]).round(4)
    box = rd.MovingObstacle(rd.Box([0.5, 0, 0], [0.1] * 3), times=[0, 1], poses=[rd.pose([0.5, 0, 0])] * 2)
    goal = rd.PoseGoal("panda_hand", T)
    problem = rd.Problem.in_world(T, rd.load_robot("panda"), rd.Scene(), "ready", goal, moving=[box])
    np.testing.assert_allclose(problem.goal.T_base_frame, np.eye(4), atol=1e-3)  # type: ignore[union-attr]
