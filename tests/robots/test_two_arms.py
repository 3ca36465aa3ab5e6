"""Two arms as one robot: planned joints, goals for one hand, plans, proofs, tools."""

from dataclasses import replace
from functools import cache
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

import robotdiffuse as rd
from helpers.example_robots import example_robot
from helpers.made_arms import chain, read_urdf, row, written
from helpers.refusals import refuses
from robotdiffuse.certificates.requirements import constraint_bounds
from robotdiffuse.collision import CollisionChecker
from robotdiffuse.collision.exact_meshes import ExactCollision
from robotdiffuse.collision.kernel_arrays import reach_ball, reach_bound
from robotdiffuse.robots.bodies import Payload, inertia_of
from robotdiffuse.robots.dynamics import Dynamics
from robotdiffuse.robots.fitting.covering_spheres import cover
from robotdiffuse.robots.inverse_kinematics import inverse_kinematics
from robotdiffuse.robots.parsing.srdf import read_srdf
from robotdiffuse.robots.robot import Robot, robot_fingerprint
from robotdiffuse.robots.robot_folder import read_robot_folder, write_robot_folder

PARTS = chain("base", ["waist"]), chain("waist_link", row("left_", 4)), chain("waist_link", row("right_", 4))


@cache
def two_arms() -> Robot:
    """Two arms of boxes covered by spheres, on a torso that a planned joint rotates."""
    robot = example_robot("two_arms")
    spheres = {link: np.concatenate([cover(part) for part in parts]) for link, parts in robot.meshes.items()}
    beside = [("pedestal", "torso")]
    for side in ("left", "right"):
        beside += pairwise(("torso", *(f"{side}_{part}" for part in ("upper", "lower", "hand"))))
    return replace(robot, spheres=spheres, allowed_collisions=frozenset(map(frozenset, beside)))


def test_both_arms_and_the_joint_that_they_share_are_planned(tmp_path: Path) -> None:
    for group in ("both", "all"):
        robot = read_urdf(written(tmp_path, *PARTS), group=group)
        assert robot.joint_names == ("waist", *row("left_", 4), *row("right_", 4))
        assert robot.tips == ("left_4_link", "right_4_link") and not robot.locked
        assert robot.parents.tolist() == [0, 1, 2, 3, 4, 1, 6, 7, 8] and robot.kernel_parents is not None
        assert robot.chain("right_2_link") == (0, 5, 6) and robot.at_end("left_4_link")
    refuses("choose one, or both as one robot", read_urdf, written(tmp_path, *PARTS))
    left = read_urdf(written(tmp_path, *PARTS), group="left")
    assert left.kernel_parents is None and left.tips == ("left_4_link",)
    held = robot.with_locked({name: 0.1 for name in row("right_", 4)})
    assert held.joint_names == left.joint_names and held.kernel_parents is None


def test_groups_of_an_srdf_may_have_several_chains(tmp_path: Path) -> None:
    (tmp_path / "made.srdf").write_text(
        """<robot name="made">
          <group name="left"><chain base_link="base" tip_link="left_4_link"/></group>
          <group name="right"><chain base_link="waist_link" tip_link="right_3_link"/></group>
          <group name="both_arms"><group name="left"/><group name="right"/></group>
          <group name="some"><joint name="right_2"/><joint name="left_1"/><joint name="left_3"/></group>
        </robot>"""
    )
    srdf = read_srdf(tmp_path / "made.srdf")
    robot = read_urdf(written(tmp_path, *PARTS), group="both_arms", srdf=srdf)
    assert robot.joint_names == ("waist", *row("left_", 4), *row("right_", 3))
    assert robot.tips == ("left_4_link", "right_3_link") and robot.locked == {"right_4": 0.0}
    robot = read_urdf(written(tmp_path, *PARTS), group="some", srdf=srdf)
    assert robot.joint_names == ("left_1", "left_3", "right_2") and robot.parents.tolist() == [0, 1, 0]
    message = "left_4_link is not below right_1, right_2, right_3 of group both_arms"
    refuses(message, read_urdf, written(tmp_path, *PARTS), group="both_arms", srdf=srdf, tip="left_4_link")


def test_files_keep_all_tips(tmp_path: Path) -> None:
    robot = two_arms()
    write_robot_folder(robot, tmp_path / "kept", {})
    again = read_robot_folder(tmp_path / "kept")
    assert again.tips == robot.tips and again.joint_names == robot.joint_names
    assert robot_fingerprint(robot) != robot_fingerprint(replace(robot, other_tips=()))


def test_spheres_parts_and_the_arms_of_one_robot_agree() -> None:
    """What is free by spheres is free by parts; poses of Baxter's left arm are those of `baxter_left`."""
    robot = two_arms()
    rng = np.random.default_rng(0)
    q = rng.uniform(robot.lower, robot.upper, (2000, robot.dof))
    free = CollisionChecker(robot, rd.Scene()).free(q)
    hits = ExactCollision(robot, rd.Scene()).collides(q)
    assert not (free & hits).any() and 0.2 < free.mean() < (~hits).mean()
    both = rd.load_robot("baxter")
    left = rd.load_robot("baxter_left")
    assert both.dof == 14 and both.with_locked({n: 0.0 for n in both.joint_names if n[0] == "r"}).dof == 7
    q = rng.uniform(both.lower, both.upper)
    own = [both.joint_names.index(name) for name in left.joint_names]
    np.testing.assert_allclose(both.fk(q, left.tip), left.fk(q[own]), atol=1e-12)


def test_the_other_arm_keeps_its_values_in_inverse_kinematics() -> None:
    robot = two_arms()
    rng = np.random.default_rng(1)
    T = robot.fk(rng.uniform(robot.lower, robot.upper), "right_lower")
    rest = rng.uniform(robot.lower, robot.upper)
    found = inverse_kinematics(robot, "right_lower", T, 3, rng=rng, rest=rest)
    assert len(found) and len(robot.chain("right_lower")) == 3
    for one in found:
        np.testing.assert_allclose(robot.fk(one, "right_lower"), T, atol=1e-5)
        assert (one[1:4] == rest[1:4]).all()
    assert len({*found[:, 6]}) == len(found)  # the joint after the link is random


@pytest.mark.parametrize("planner", [pytest.param("rrt_connect", marks=pytest.mark.slow), "aorrtc", "robotdiffuse"])
def test_planners_move_both_arms_past_each_other(planner: str) -> None:
    robot = two_arms()
    scene = rd.Scene([rd.Sphere([0.45, 0.0, 0.75], 0.05)])
    rng = np.random.default_rng(3)
    free = np.ones(100, bool)
    while not (free[0] and free[-1]) or free.all():  # until only the straight line between the ends collides
        start, goal = rng.uniform(robot.lower, robot.upper, (2, robot.dof))
        free = CollisionChecker(robot, scene).free(np.linspace(start, goal, 100))
    problem = rd.Problem(robot, scene, start, goal)
    result = rd.load_planner(planner).plan(problem, time_limit=20.0, seed=0, until="first")
    assert result.solved, result.reason
    assert result.path is not None and rd.verify(problem, result.path).valid
    steps = np.concatenate([np.linspace(a, b, 50) for a, b in pairwise(result.path.positions)])
    assert not ExactCollision(robot, scene).collides(steps).any()


def test_what_one_arm_keeps_is_not_loosened_by_the_other() -> None:
    robot = two_arms()
    plane = rd.OnPlane("right_hand", point=[0.0, 0.0, 0.5], normal=[0.0, 0.6, 0.8], tolerance=5.0)
    ends = np.random.default_rng(7).uniform(robot.lower, robot.upper, (2, robot.dof))
    q = np.linspace(ends[0], ends[1], 12)
    problem = rd.Problem(robot=robot, scene=rd.Scene(), start=q[0], goal=rd.JointGoal(q[-1:]), constraints=[plane])
    bounds = constraint_bounds(problem, q, 0.0)[1][:, 0]
    heights = [
        abs((robot.fk(a + share * (b - a), "right_hand")[:3, 3] - plane.point) @ plane.normal)
        for a, b in pairwise(q)
        for share in np.linspace(0, 1, 9)
    ]
    assert (bounds >= np.reshape(heights, (-1, 9)).max(axis=1) - 1e-9).all()
    still = q.copy()
    still[:, 1:4] = q[0, 1:4]  # the left arm does not move
    assert robot.joint_names[1:4] == ("left_shoulder", "left_elbow", "left_wrist")
    np.testing.assert_array_equal(constraint_bounds(problem, still, 0.0)[1][:, 0], bounds)


def test_a_locked_arm_weighs_as_much_as_one_that_stands_still() -> None:
    pytest.importorskip("pinocchio", reason="the extra `dynamics` (pin) is not installed")
    body = inertia_of([1.5, 0.05, 0.02, -0.01, 0.02, 0, 0, 0.03, 0, 0.01])
    both = replace(two_arms(), inertias={link: body for link in two_arms().link_names})
    rng = np.random.default_rng(8)
    rows = np.arange(4)
    q, v, a = (np.zeros((1, both.dof)) for _ in range(3))
    q[0] = rng.uniform(both.lower, both.upper)
    v[0, rows], a[0, rows] = rng.normal(size=(2, len(rows)))
    left = both.with_locked(dict(zip(both.joint_names[4:], q[0, 4:], strict=True)))
    expected = Dynamics(left, Payload(0.0)).torques(q[:, rows], v[:, rows], a[:, rows])
    np.testing.assert_allclose(Dynamics(both, Payload(0.0)).torques(q, v, a)[:, rows], expected, atol=1e-9)


def test_a_tool_on_the_second_hand_is_its_tip_and_is_checked() -> None:
    robot = two_arms()
    armed = robot.with_tool("right_hand", np.eye(4), [rd.Box([0.15, 0, 0], [0.2, 0.02, 0.02], name="blade")])
    assert armed.tips == ("left_hand", "tool") and ("left_lower", "tool") in armed.checked_pairs()
    assert robot.with_tool("left_hand", np.eye(4)).tips == ("tool", "right_hand")
    assert robot.with_tool("torso", np.eye(4)).tips == robot.tips


def test_both_arms_reach_as_far_as_one() -> None:
    """Regression: the reach was the sum of both arms' offsets, which doubled the width of lines on the live page."""
    both, left, right = (rd.load_robot(f"baxter{arm}") for arm in ("", "_left", "_right"))
    assert both.reach == pytest.approx(max(left.reach, right.reach), rel=0.01)  # of random configurations
    assert reach_bound(both) <= max(reach_bound(left), reach_bound(right)) + 1e-9
    assert both.with_locked({n: 0.0 for n in both.joint_names if n[0] == "r"}).reach == pytest.approx(left.reach, rel=0.01)
    for robot in (both, left):
        q = np.random.default_rng(0).uniform(robot.lower, robot.upper, (50, robot.dof))
        spheres = np.concatenate([robot.placed_spheres(one) for one in q])
        far = (np.linalg.norm(spheres[:, :3], axis=1) + spheres[:, 3]).max()
        assert robot.reach < far < reach_bound(robot)
        center, radius = reach_ball(robot)
        assert (np.linalg.norm(spheres[:, :3] - center, axis=1) + spheres[:, 3]).max() < radius and radius <= reach_bound(robot)


def test_reach_is_that_of_the_arm_that_moves_and_does_not_depend_on_the_mounting() -> None:
    """Regression: the shoulder of an arm on a wall was not on its first axis; that of an arm on a torso was the torso's."""
    for robot in (two_arms(), rd.load_robot("ur5e")):
        mounted = robot.placed_in_world(rd.pose([1, 2, 3], rpy=[1.2, 0.4, -0.3]))
        assert mounted.reach == pytest.approx(robot.reach, rel=1e-9)
    held = {name: 0.0 for name in two_arms().joint_names if name.startswith("left")}
    right = replace(two_arms(), tip="right_hand", other_tips=())
    assert two_arms().with_locked(held).reach == pytest.approx(right.reach, rel=0.01)


def test_the_shoulder_of_one_joint_is_the_joint(tmp_path: Path) -> None:
    """Regression: its height counted twice."""
    assert read_urdf(written(tmp_path, chain("base", ["hinge"]))).reach == pytest.approx(0.0, abs=1e-9)
