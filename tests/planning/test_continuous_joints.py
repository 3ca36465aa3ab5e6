"""Continuous joints: values that differ by a whole turn are equal, and motions take the short way."""

from dataclasses import replace
from pathlib import Path as FilePath

import numpy as np
import pytest

import robotdiffuse as rd
from helpers.box_arm import box_arm
from helpers.refusals import refuses
from robotdiffuse.interop.recorded_motion import RecordedMotion, motion_of_robot
from robotdiffuse.robots.kinematic_tree import CONTINUOUS_LIMIT
from robotdiffuse.robots.parsing.urdf import with_limits
from robotdiffuse.robots.robot_folder import read_robot_folder, write_robot_folder

TURNING = {"kind": "continuous", "lower": -CONTINUOUS_LIMIT, "upper": CONTINUOUS_LIMIT}
JOINTS = tuple(replace(j, **TURNING) if j.name in ("j0", "j2") else j for j in box_arm().joints)
ARM = replace(box_arm(), joints=JOINTS)
POST = rd.Scene([rd.Box([-0.7, 0.0, 0.0], [0.4, 0.05, 0.2], name="post")])
"""Where the stretched arm points at half a turn."""


def planned(planner: str, start: list[float], goal: object, scene: rd.Scene | None = None, **more: object) -> rd.Path:
    problem = rd.Problem(ARM, scene or rd.Scene(), start, goal)  # type: ignore[arg-type]
    result = rd.load_planner(planner).plan(problem, time_limit=60.0, **more)  # type: ignore[arg-type]
    assert result.solved, result.reason
    assert rd.verify(problem, result.path).valid and rd.verify(problem, result.trajectory).valid
    assert np.array_equal(result.path.positions[0], problem.start)
    assert np.abs(np.diff(result.trajectory.positions, axis=0)).max() < 0.05  # no jump: 2 rad/s at rows of 10 ms
    return result.path


@pytest.mark.parametrize(
    ("planner", "turns"), [("rrt_connect", 0), ("aorrtc", -5), ("robotdiffuse", 1), ("shared_tree_rrt_star", 1)]
)
def test_from_3_to_minus_3_is_a_short_way(planner: str, turns: int) -> None:
    """Regression: the way was 6 rad, in place of 0.28 rad across half a turn; the start may have whole turns."""
    start = 3.0 + 2 * np.pi * turns
    path = planned(planner, [start, 0.0, 0.0], [-3.0, 0.0, 0.0])
    assert path.length == pytest.approx(2 * np.pi - 6, abs=1e-6)
    assert path.positions[-1, 0] == pytest.approx(start + 2 * np.pi - 6)


def test_a_pose_is_reached_across_half_a_turn_and_the_long_way_where_something_blocks_the_short_one() -> None:
    assert planned("aorrtc", [2.9, 0.5, 0.2], rd.PoseGoal("tip", ARM.fk([-2.9, 0.5, 0.2], "tip"))).length < 0.6
    path = planned("aorrtc", [2.8, 0.0, 0.0], [-2.8, 0.0, 0.0], POST)
    assert path.positions[-1, 0] == pytest.approx(-2.8) and path.length > 5.5


def test_values_wrapped_to_half_a_turn_are_no_motion_but_those_of_a_file_are_unwrapped() -> None:
    """Regression: a path with wrapped values was valid, the long way round; with times, its rows turned at 1571 rad/s."""
    problem = rd.Problem(ARM, rd.Scene(), [3.0, 0.0, 0.0], [-3.0, 0.0, 0.0])
    motion = rd.load_planner("aorrtc").plan(problem).trajectory
    wrapped = (motion.positions + np.pi) % (2 * np.pi) - np.pi
    for rows in (rd.Path(ARM.joint_names, wrapped), replace(motion, positions=wrapped)):
        violation = rd.verify(problem, rows).violation
        assert violation.kind == "jump" and violation.subject == "j0"
        assert "unwrap" in violation.message
    for times in (None, motion.times):
        velocities = None if times is None else motion.velocities
        read = motion_of_robot(RecordedMotion(ARM.joint_names, wrapped, times, velocities), ARM)
        assert isinstance(read.motion, rd.Path if times is None else rd.Trajectory)
        assert read.notes[0] == "values of j0 jump by whole turns; they were unwrapped"
        assert np.allclose(read.motion.positions, motion.positions)
        assert rd.verify(problem, read.motion).valid


def test_images_of_a_goal() -> None:
    start = np.array([3.0, 1.0, -0.2])
    nearest, first, last = ARM.turned_both_ways(np.array([-3.0 - 4 * np.pi, -1.0, 0.2]), start, ARM.continuous)
    np.testing.assert_allclose(nearest, [2 * np.pi - 3, -1.0, 0.2])
    np.testing.assert_allclose(first, [-3.0, -1.0, 0.2])
    np.testing.assert_allclose(last, [2 * np.pi - 3, -1.0, 0.2 - 2 * np.pi])
    assert len(box_arm().turned_both_ways(start, start, box_arm().continuous)) == 1
    assert (np.abs([nearest, first, last]) <= CONTINUOUS_LIMIT).all()


def test_elbows_that_cannot_fold_through_reach_a_goal_on_the_other_side() -> None:
    """Regression: if two elbows on continuous joints had to turn back by way of zero, no goal let both do so: no path."""
    start = np.array([3.0, 1.0, 3.0])
    rows = ARM.turned_both_ways(-start, start, ARM.continuous)
    np.testing.assert_allclose(rows[[0, -1]], np.stack([np.array([2 * np.pi - 3, -1.0, 2 * np.pi - 3]), -start]))
    assert len(rows) == 4


def test_limits_of_a_continuous_joint(tmp_path: FilePath) -> None:
    """Limits make it revolute, as the validator checks none of continuous ones; in robot folders it has those of planning."""
    assert rd.Problem(ARM, rd.Scene(), [50.0, 0.0, 0.0], [0.0, 0.0, 0.0]).start[0] == 50.0
    narrow = with_limits(ARM, {"j0": {"lower": -1.0}})
    assert (narrow.planned_joints[0].kind, narrow.lower[0], narrow.upper[0]) == ("revolute", -1.0, np.pi)
    refuses("j0 is 50 rad; its limits are -1", rd.Problem, narrow, rd.Scene(), [50.0, 0.0, 0.0], [0.0, 0.0, 0.0])
    joints = tuple(replace(j, lower=-np.pi, upper=np.pi) if j.name == "j0" else j for j in ARM.joints)
    write_robot_folder(replace(ARM, joints=joints), tmp_path, {})
    robot = read_robot_folder(tmp_path)
    assert robot.planned_joints[0].kind == "continuous" and robot.upper[0] == CONTINUOUS_LIMIT
