"""A pose for each of several links: configurations that bring all of them there, verdicts, files."""

from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from numpy import ndarray

import robotdiffuse as rd
from helpers.made_arms import chain, row, written
from helpers.urdfs import read_urdf
from robotdiffuse.certificates.checker import check
from robotdiffuse.collision import CollisionChecker
from robotdiffuse.core.errors import InputError
from robotdiffuse.core.transforms import rotation_angle, transform
from robotdiffuse.core.types import Path as JointPath
from robotdiffuse.core.types import Status
from robotdiffuse.planning.pose_goals import pose_configurations
from robotdiffuse.problems.files import load_problem, problem_from_record, problem_record
from robotdiffuse.problems.goals import PoseGoal, PosesGoal
from robotdiffuse.robots.kinematics import link_pose
from robotdiffuse.robots.robot import Robot
from robotdiffuse.validation.tolerances import goal_error
from robotdiffuse.validation.validator import verify

HANDS = ("left_gripper", "right_gripper")
TABLE = rd.Box([0.75, 0.0, 0.05], [0.5, 1.2, 0.04], name="table")


@cache
def baxter() -> Robot:
    return rd.load_robot("baxter")


@cache
def free() -> ndarray:
    """Configurations that are free over the table."""
    robot, rng = baxter(), np.random.default_rng(4)
    drawn = rng.uniform(robot.lower, robot.upper, (400, robot.dof))
    return drawn[CollisionChecker(robot, rd.Scene([TABLE])).free(drawn)]


def poses_at(robot: Robot, q: ndarray, links: Sequence[str], *tolerances: Any) -> PosesGoal:
    return PosesGoal([PoseGoal(link, link_pose(robot, q, link), *tolerances) for link in links])


def off(robot: Robot, goal: PosesGoal, q: ndarray) -> float:
    """The most that any link is off its pose [m], [rad]."""
    between = [np.linalg.inv(pose.T_base_frame) @ link_pose(robot, q, pose.frame) for pose in goal.poses]
    return max(max(float(np.linalg.norm(T[:3, 3])), rotation_angle(T[:3, :3])) for T in between)


def both_hands() -> tuple[rd.Problem, PosesGoal]:
    start, there = free()[:2]
    goal = poses_at(baxter(), there, HANDS)
    return rd.Problem(baxter(), rd.Scene([TABLE]), start, goal), goal


def test_both_hands_are_brought_to_their_poses() -> None:
    problem, goal = both_hands()
    found = pose_configurations(problem, goal, np.random.default_rng(0))
    assert len(found) == 10
    assert max(off(baxter(), goal, q) for q in found) < 1e-5
    apart = np.abs(found[:, None] - found).max(axis=2)
    assert apart[~np.eye(10, dtype=bool)].min() > 0.1
    result = rd.plan(problem, time_limit=20.0)
    assert result.path is not None, result.reason
    assert off(baxter(), goal, result.path.positions[-1]) < 1e-5
    assert check(rd.certify(problem, result.path), problem).valid


def test_links_that_share_a_joint_are_brought_there_together(tmp_path: Path) -> None:
    """Each arm alone turns the waist as it likes; both hands need one value of it."""
    parts = (
        chain("base", ["waist"]),
        chain("waist_link", row("left_", 6)),
        chain("waist_link", row("right_", 6)),
    )
    robot = read_urdf(written(tmp_path, *parts), group="both")
    there = np.random.default_rng(1).uniform(0.5 * robot.lower, 0.5 * robot.upper)
    goal = poses_at(robot, there, robot.tips)
    problem = rd.Problem(robot, rd.Scene(), np.zeros(robot.dof), goal)
    found = pose_configurations(problem, goal, np.random.default_rng(0))
    assert len(found) and max(off(robot, goal, q) for q in found) < 1e-5
    assert ((found >= robot.lower) & (found <= robot.upper)).all()


def test_tolerances_of_each_pose_are_used_and_validated() -> None:
    start, there = free()[:2]
    goal = poses_at(baxter(), there, HANDS, [0.05, 0.05, 0.0], [0.0, 0.0, np.pi])
    problem = rd.Problem(baxter(), rd.Scene([TABLE]), start, goal)
    found = pose_configurations(problem, goal, np.random.default_rng(0))
    assert len(found) == 10 and not any(goal_error(baxter(), goal, q) for q in found)
    assert max(off(baxter(), goal, q) for q in found) > 0.1, "not the very poses alone"


def test_the_validator_names_the_hand_that_is_elsewhere() -> None:
    (problem, goal), (start, there) = both_hands(), free()[:2]
    left_only = np.where([name.startswith("left") for name in baxter().joint_names], there, start)
    found = verify(problem, JointPath(baxter().joint_names, np.stack([start, left_only]))).violation
    assert found is not None
    error = goal_error(baxter(), goal, left_only)
    assert error is not None and error.subject == "right_gripper"
    assert goal_error(baxter(), goal, there) is None


def test_constraints_are_kept_at_the_poses() -> None:
    """The left hand's orientation is free, but its axis is to stay upright within 0.1 rad."""
    start, there = free()[:2]
    right = link_pose(baxter(), there, "right_gripper")
    down = transform(np.array([0.7, 0.25, 0.4]), np.diag([1.0, -1.0, -1.0]))
    goal = PosesGoal(
        [PoseGoal("left_gripper", down, None, [0.4, 0.4, np.pi]), PoseGoal("right_gripper", right)]
    )
    upright = rd.AxisCone("left_gripper", [0, 0, 1], [0, 0, -1], 0.1)
    problem = rd.Problem(baxter(), rd.Scene(), start, goal, constraints=[upright])
    found = pose_configurations(problem, goal, np.random.default_rng(0))
    assert len(found) and not any(goal_error(baxter(), goal, q) for q in found)
    assert min(-link_pose(baxter(), q, "left_gripper")[2, 2] for q in found) >= np.cos(0.1)


def test_a_pose_out_of_reach_is_named_alone() -> None:
    start, there = free()[:2]
    far = PoseGoal("left_gripper", transform(np.array([3.0, 0.0, 0.0])))
    goal = PosesGoal([far, *poses_at(baxter(), there, HANDS[1:]).poses])
    result = rd.plan(rd.Problem(baxter(), rd.Scene(), start, goal))
    assert result.status is Status.UNREACHABLE_GOAL
    assert result.reason.endswith("brings left_gripper to the pose at (3.000, 0.000, 0.000) m")


def test_files_keep_them(tmp_path: Path) -> None:
    pose = {"xyz": [0.7, 0.25, 0.3], "wxyz": [0.0, 1.0, 0.0, 0.0]}
    goal = {"poses": {"left_gripper": pose | {"rpy_tolerance": [0.0, 0.0, 3.1]}, "right_gripper": pose}}
    for field in ("goal", "any"):
        record = problem_record(both_hands()[0]) | {"goal": goal if field == "goal" else {"any": [goal]}}
        record["base"] = {"xyz": [0.1, 0.2, 0.3], "wxyz": [0.6, 0.0, 0.0, 0.8]}
        file = tmp_path / "problem.yaml"
        file.write_text(yaml.safe_dump(record))
        problem = load_problem(file)
        kept = problem_record(problem)
        assert problem_record(problem_from_record(kept)) == kept
        each = problem.goal.goals[0] if isinstance(problem.goal, rd.AnyGoal) else problem.goal
        assert isinstance(each, PosesGoal) and [one.frame for one in each.poses] == [*goal["poses"]]
        T_world_base = problem.T_world_base
        np.testing.assert_allclose((T_world_base @ each.poses[0].T_base_frame)[:3, 3], pose["xyz"])


T = np.eye(4)
WRONG: dict[str, tuple[Any, str]] = {
    "twice": (lambda: PosesGoal([PoseGoal("a", T), PoseGoal("a", T)]), "goal.poses names 'a' twice"),
    "none": (lambda: PosesGoal([]), r"goal.poses is \[\]; it must be a list of rd.PoseGoal"),
    "unknown": (
        lambda: asked("left_gripper", "middle_gripper"),
        "unknown link in goal.poses: 'middle_gripper'",
    ),
    "still": (lambda: asked("left_gripper", "torso"), "goal.poses: no planned joint moves 'torso'"),
    "one part": (
        lambda: asked("left_gripper", "left_gripper_base_link"),
        "goal.poses: left_gripper and left_gripper_base_link are one rigid part; give the pose of one",
    ),
}


def asked(*links: str) -> rd.Problem:
    return rd.Problem(baxter(), rd.Scene(), free()[0], PosesGoal([PoseGoal(link, T) for link in links]))


@pytest.mark.parametrize("case", WRONG)
def test_what_makes_no_sense_is_one_line(case: str) -> None:
    make, message = WRONG[case]
    with pytest.raises(InputError, match=message) as refused:
        make()
    assert "\n" not in str(refused.value)


def test_a_link_twice_in_a_file_is_one_line(tmp_path: Path) -> None:
    file = tmp_path / "problem.yaml"
    pose = "{xyz: [0, 0, 0], wxyz: [1, 0, 0, 0]}"
    file.write_text(f"robot: baxter\ngoal: {{poses: {{left_gripper: {pose}, left_gripper: {pose}}}}}\n")
    with pytest.raises(InputError, match="left_gripper appears twice in line 2"):
        load_problem(file)
