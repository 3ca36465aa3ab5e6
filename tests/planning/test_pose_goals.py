"""Poses as goals: the nearest configuration, tolerances for arms of few joints, several goals, poses of several links."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy import ndarray

import robotdiffuse as rd
from helpers.commands import written as write_record
from helpers.made_arms import chain, read_urdf, row, written
from helpers.panda import PANDA
from helpers.refusals import refuses
from robotdiffuse.certificates.checker import check
from robotdiffuse.collision import CollisionChecker
from robotdiffuse.core.transforms import rotation_angle, rotation_from_rpy, transform
from robotdiffuse.planning import context, pose_goals
from robotdiffuse.planning.pose_goals import pose_configurations
from robotdiffuse.problems.files import problem_from_record, problem_record
from robotdiffuse.validation.tolerances import goal_error

HANDS = ("left_gripper", "right_gripper")
TABLE = rd.Box([0.75, 0.0, 0.05], [0.5, 1.2, 0.04], name="table")


@cache
def baxter() -> rd.Robot:
    return rd.load_robot("baxter")


@cache
def free() -> ndarray:
    robot = baxter()
    drawn = np.random.default_rng(4).uniform(robot.lower, robot.upper, (400, robot.dof))
    return drawn[CollisionChecker(robot, rd.Scene([TABLE])).free(drawn)]


def poses_at(robot: rd.Robot, q: ndarray, links: Sequence[str], *tolerances: Any) -> rd.PosesGoal:
    return rd.PosesGoal([rd.PoseGoal(link, robot.fk(q, link), *tolerances) for link in links])


def off(robot: rd.Robot, goal: rd.PosesGoal, q: ndarray) -> float:
    between = [np.linalg.inv(pose.T_base_frame) @ robot.fk(q, pose.frame) for pose in goal.poses]
    return max(max(float(np.linalg.norm(T[:3, 3])), rotation_angle(T[:3, :3])) for T in between)


def both_hands() -> tuple[rd.Problem, rd.PosesGoal]:
    start, there = free()[:2]
    goal = poses_at(baxter(), there, HANDS)
    return rd.Problem(baxter(), rd.Scene([TABLE]), start, goal), goal


def test_both_hands_are_brought_to_their_poses() -> None:
    problem, goal = both_hands()
    found = pose_configurations(problem, goal, np.random.default_rng(0))
    assert len(found) == 10 and max(off(baxter(), goal, q) for q in found) < 1e-5
    assert np.abs(found[:, None] - found).max(axis=2)[~np.eye(10, dtype=bool)].min() > 0.1
    result = rd.plan(problem, time_limit=20.0)
    assert result.solved, result.reason
    assert off(baxter(), goal, result.path.positions[-1]) < 1e-5
    assert check(rd.certify(problem, result.path), problem).valid
    assert rd.plan(replace(problem, goal=poses_at(baxter(), problem.start, HANDS)), time_limit=10.0).path_length < 1e-4


def test_links_that_share_a_joint_are_brought_there_together(tmp_path: Path) -> None:
    """For one arm alone, the waist may have any value; for both hands, it must have one value."""
    arms = (chain("waist_link", row(side, 6)) for side in ("left_", "right_"))
    robot = read_urdf(written(tmp_path, chain("base", ["waist"]), *arms), group="both")
    goal = poses_at(robot, np.random.default_rng(1).uniform(0.5 * robot.lower, 0.5 * robot.upper), robot.tips)
    found = pose_configurations(rd.Problem(robot, rd.Scene(), np.zeros(robot.dof), goal), goal, np.random.default_rng(0))
    assert len(found) and max(off(robot, goal, q) for q in found) < 1e-5
    assert ((found >= robot.lower) & (found <= robot.upper)).all()


def test_the_validator_names_the_hand_that_is_elsewhere() -> None:
    (problem, goal), (start, there) = both_hands(), free()[:2]
    left_only = np.where([name.startswith("left") for name in baxter().joint_names], there, start)
    assert not rd.verify(problem, rd.Path(baxter().joint_names, np.stack([start, left_only]))).valid
    error = goal_error(baxter(), goal, left_only)
    assert error is not None and error.subject == "right_gripper" and goal_error(baxter(), goal, there) is None


def test_constraints_are_kept_at_the_poses() -> None:
    """The left hand's orientation is free, but its axis must stay within 0.1 rad of upright."""
    start, there = free()[:2]
    down = transform(np.array([0.7, 0.25, 0.4]), np.diag([1.0, -1.0, -1.0]))
    left = rd.PoseGoal("left_gripper", down, None, [0.4, 0.4, np.pi])
    goal = rd.PosesGoal([left, *poses_at(baxter(), there, HANDS[1:]).poses])
    upright = rd.AxisCone("left_gripper", [0, 0, 1], [0, 0, -1], 0.1)
    problem = rd.Problem(baxter(), rd.Scene(), start, goal, constraints=[upright])
    found = pose_configurations(problem, goal, np.random.default_rng(0))
    assert len(found) and not any(goal_error(baxter(), goal, q) for q in found)
    assert min(-baxter().fk(q, "left_gripper")[2, 2] for q in found) >= np.cos(0.1)


def test_a_pose_out_of_reach_is_named_alone() -> None:
    start, there = free()[:2]
    far = rd.PoseGoal("left_gripper", transform(np.array([3.0, 0.0, 0.0])))
    goal = rd.PosesGoal([far, *poses_at(baxter(), there, HANDS[1:]).poses])
    result = rd.plan(rd.Problem(baxter(), rd.Scene(), start, goal), time_limit=60.0)
    assert result.status is rd.Status.UNREACHABLE_GOAL
    assert result.reason.endswith("brings left_gripper to the pose at (3.000, 0.000, 0.000) m")
    goal = rd.PoseGoal(PANDA.tip, transform(np.array([0.0, 0.0, 1.5])))
    result = rd.plan(rd.Problem(PANDA, FREE, apart(PANDA, 1)[0], goal))
    assert result.status is rd.Status.UNREACHABLE_GOAL


def test_files_keep_them(tmp_path: Path) -> None:
    pose = {"xyz": [0.7, 0.25, 0.3], "wxyz": [0.0, 1.0, 0.0, 0.0]}
    goal = {"poses": {"left_gripper": pose | {"rpy_tolerance": [0.0, 0.0, 3.1]}, "right_gripper": pose}}
    base = {"xyz": [0.1, 0.2, 0.3], "wxyz": [0.6, 0.0, 0.0, 0.8]}
    for asked in (goal, {"any": [goal]}):
        problem = rd.load_problem(write_record(tmp_path, problem_record(both_hands()[0]) | {"goal": asked, "base": base}))
        kept = problem_record(problem)
        assert problem_record(problem_from_record(kept)) == kept
        each = problem.goal.goals[0] if isinstance(problem.goal, rd.AnyGoal) else problem.goal
        assert isinstance(each, rd.PosesGoal) and [one.frame for one in each.poses] == [*goal["poses"]]
        np.testing.assert_allclose((problem.T_world_base @ each.poses[0].T_base_frame)[:3, 3], pose["xyz"])


def asked(*links: str) -> rd.Problem:
    return rd.Problem(baxter(), rd.Scene(), free()[0], rd.PosesGoal([rd.PoseGoal(link, np.eye(4)) for link in links]))


def test_what_makes_no_sense_is_one_line() -> None:
    refuses("goal.poses names 'a' twice", rd.PosesGoal, [rd.PoseGoal("a", np.eye(4))] * 2)
    refuses(r"goal.poses is \[\]; it must be a list of rd.PoseGoal, not empty", rd.PosesGoal, [])
    refuses("unknown link in goal.poses: 'middle'", asked, "left_gripper", "middle")
    refuses("goal.poses: no planned joint moves 'torso'", asked, "left_gripper", "torso")
    refuses("one rigid part; give the pose of one", asked, "left_gripper", "left_gripper_base_link")


ARMS = ("iiwa14", "gen3", "panda", "ur5e")
FREE = rd.Scene()


def apart(robot: rd.Robot, count: int, seed: int = 5) -> ndarray:
    middle = 0.5 * (robot.lower + robot.upper)
    half = 0.5 * (robot.upper - robot.lower)
    drawn = np.random.default_rng(seed).uniform(middle - 0.9 * half, middle + 0.9 * half, (60 * count, robot.dof))
    return drawn[CollisionChecker(robot, FREE).free(drawn)][:count]


def followed(robot: rd.Robot, start: ndarray, shift: ndarray) -> ndarray | None:
    """The nearest configuration after the tip has moved straight by `shift`; None out of reach or near a singularity."""
    q = start.copy()
    T = robot.fk(q)
    target = T.copy()
    for k in range(1, 21):
        target[:3, 3] = T[:3, 3] + k / 20 * shift
        for _ in range(4):
            now = robot.fk(q)
            turn = target[:3, :3] @ now[:3, :3].T
            skew = 0.5 * (turn - turn.T)
            error = np.concatenate([target[:3, 3] - now[:3, 3], [skew[2, 1], skew[0, 2], skew[1, 0]]])
            J = robot.jacobian(q)
            if np.linalg.svd(J, compute_uv=False)[-1] < 0.03:
                return None
            q = q + np.linalg.pinv(J) @ error
    inside = ((q >= robot.lower) & (q <= robot.upper)) | robot.continuous
    line = start + np.linspace(0, 1, 50)[:, None] * (q - start)
    return q if inside.all() and CollisionChecker(robot, FREE).free(line).all() else None


@pytest.mark.parametrize("arm", ARMS)
def test_a_pose_where_the_hand_is_costs_no_motion(arm: str) -> None:
    """Regression: an iiwa14 moved by 3.2 rad."""
    robot = rd.load_robot(arm)
    for k, start in enumerate(apart(robot, 2)):
        start = start + 2 * np.pi * np.where(robot.continuous, k, 0)
        here = rd.PoseGoal(robot.tip, robot.fk(start))
        for goal in (here, rd.PoseGoal(robot.tip, here.T_base_frame, [0.01] * 3, [0.1, 0.1, np.pi])):
            assert rd.plan(rd.Problem(robot, FREE, start, goal), 5.0).path.length < 0.0001


@pytest.mark.parametrize("arm", ARMS)
def test_a_pose_nearby_is_reached_by_the_nearest_configuration(arm: str) -> None:
    """As the only goal, after a waypoint, as one of several goals, and along a straight line."""
    robot = rd.load_robot(arm)
    rng = np.random.default_rng(2)
    for start in apart(robot, 12):
        shift = rng.normal(size=3)
        shift *= 0.05 / np.linalg.norm(shift)
        there = followed(robot, start, shift)
        if there is None:
            continue
        T = robot.fk(start)
        goal = rd.PoseGoal(robot.tip, transform(T[:3, 3] + shift, T[:3, :3]))
        far = rd.PoseGoal(robot.tip, robot.fk(apart(robot, 1, seed=9)[0]))
        longest = 1.1 * float(np.linalg.norm(there - start))
        for problem in (
            rd.Problem(robot, FREE, start, goal),
            rd.Problem(robot, FREE, start, goal, waypoints=[rd.PoseGoal(robot.tip, T)]),
            rd.Problem(robot, FREE, start, rd.AnyGoal((far, goal))),
            rd.Problem(robot, FREE, start, goal, constraints=[rd.CartesianLine(robot.tip)]),
        ):
            result = rd.plan(problem, 10.0)
            assert result.solved, result.reason
            assert result.path.length <= longest and result.goal_index == (1 if isinstance(problem.goal, rd.AnyGoal) else 0)
        return
    raise AssertionError("no starts")


def four_joints(folder: Path) -> rd.Robot:
    robot = read_urdf(written(folder, chain("base", ["turn", "lift", "bend", "wrist"])), tip="wrist_link")
    balls = {link: np.array([[0.0, 0.0, 0.0, 0.045]]) for link in robot.meshes}
    neighbors = frozenset(frozenset((joint.parent, joint.child)) for joint in robot.joints)
    return replace(robot, spheres=balls, allowed_collisions=neighbors)


@pytest.mark.parametrize("arm", ["so101", "four joints"])
@pytest.mark.parametrize("kind", ["any orientation", "±0.5 rad", "1 mm off"])
def test_arms_of_few_joints_reach_poses_with_tolerances(arm: str, kind: str, tmp_path: Path) -> None:
    """Regression: 0 of 15 poses were reached, since poses drawn within the tolerances need six joints."""
    robot = rd.load_robot("so101") if arm == "so101" else four_joints(tmp_path)
    rng = np.random.default_rng(1)
    rpy = {"any orientation": [np.pi] * 3, "±0.5 rad": [0.5] * 3, "1 mm off": None}[kind]
    solved = 0
    for there in apart(robot, 8):
        T = robot.fk(there)
        if rpy is None:
            direction = rng.normal(size=3)
            T = transform(T[:3, 3] + 1e-3 * direction / np.linalg.norm(direction), T[:3, :3])
        else:
            T = T @ transform(np.zeros(3), rotation_from_rpy(*rng.uniform(-0.4, 0.4, 3)))
        goal = rd.PoseGoal(robot.tip, T, None, rpy)
        result = rd.plan(rd.Problem(robot, FREE, apart(robot, 1)[0], goal), 10.0, until="first")
        solved += result.solved
        if result.path is not None and rpy is None:
            off = np.linalg.norm(robot.fk(result.path.positions[-1])[:3, 3] - T[:3, 3])
            assert off < 4e-3, "near the pose, not at the edge of what the validator accepts"
            assert any("no configuration reaches the goal pose exactly" in note for note in result.notes)
    assert solved >= 7


def many_grasps() -> tuple[rd.Problem, ndarray]:
    q = apart(PANDA, 40)
    balls = [rd.Sphere(PANDA.fk(row)[:3, 3], 0.05) for row in q[1:11]]
    q_free = q[11:][CollisionChecker(PANDA, rd.Scene(balls)).free(q[11:])][:10]
    goals = [rd.PoseGoal(PANDA.tip, PANDA.fk(row)) for row in (*q[1:11], *q_free)]
    return rd.Problem(PANDA, rd.Scene(balls), q[0], rd.AnyGoal(tuple(goals))), q_free


def tried(monkeypatch: pytest.MonkeyPatch, seconds: float) -> list[ndarray]:
    """The configurations of each goal that was tried. Each trial takes `seconds` on a clock of the test."""
    found = []
    clock = [0.0]
    each_pose = pose_goals.each_pose

    def counted(*given: Any) -> Iterator[ndarray]:
        for configurations in each_pose(*given):
            found.append(configurations)
            clock[0] += seconds
            yield configurations

    monkeypatch.setattr(pose_goals, "each_pose", counted)
    monkeypatch.setattr(context.time, "perf_counter", lambda: clock[0])
    return found


def test_of_several_goals_each_is_tried_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Regression: for blocked goals, inverse kinematics made all of its attempts before the search began."""
    goals = tried(monkeypatch, 0.0)
    monkeypatch.setattr(pose_goals, "at_pose", lambda *_: pytest.fail("a goal is tried again"))
    problem, q_free = many_grasps()
    assert isinstance(problem.goal, rd.AnyGoal) and len(problem.goal.goals) == 20 and len(q_free) == 10
    result = rd.plan(problem, 20.0, until="first")
    assert result.goal_index is not None and result.goal_index >= 10 and len(goals) == 20
    assert goal_error(problem.robot, problem.goal.goals[result.goal_index], result.path.positions[-1]) is None
    assert np.array_equal(rd.plan(problem, 20.0, until="first").path.positions, result.path.positions)


def test_of_several_goals_no_more_are_tried_late(monkeypatch: pytest.MonkeyPatch) -> None:
    """After half of the time limit, the search begins with the free configurations found by then."""
    goals = tried(monkeypatch, 0.1)
    problem, _ = many_grasps()
    assert isinstance(problem.goal, rd.AnyGoal)
    result = rd.plan(replace(problem, goal=rd.AnyGoal(problem.goal.goals[::-1])), 1.0, until="first")
    assert result.solved and 5 <= len(goals) <= 7
    monkeypatch.undo()
    result = rd.plan(replace(problem, goal=rd.AnyGoal(problem.goal.goals[:2])), 20.0)
    assert result.status is rd.Status.INVALID_GOAL
    assert result.reason.startswith("none of 2 goals can be reached, the first: all ")


def test_the_goal_index_names_the_goal_that_is_reached() -> None:
    start, near, far = apart(PANDA, 3)
    for goal, index in (([far, start], 1), (rd.AnyGoal((rd.JointGoal([far, near]), rd.JointGoal(start))), 1), (start, 0)):
        assert rd.plan(rd.Problem(PANDA, FREE, start, goal)).goal_index == index
    # poses 2 mm apart: both are within the validator's centimeter
    T = PANDA.fk(near)
    goals = rd.AnyGoal((rd.PoseGoal(PANDA.tip, transform(T[:3, 3] + [0.002, 0, 0], T[:3, :3])), rd.PoseGoal(PANDA.tip, T)))
    result = rd.plan(rd.Problem(PANDA, FREE, start, goals))
    assert result.goal_index is not None
    reached = goals.goals[result.goal_index]
    assert isinstance(reached, rd.PoseGoal) and np.abs(PANDA.fk(result.path.positions[-1]) - reached.T_base_frame).max() < 1e-4
