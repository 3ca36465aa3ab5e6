"""Turned copies of motions: the same clearances, inside the limits, clear of the base."""

import numpy as np
import pytest

import robotdiffuse as rd
from helpers.example_robots import example_robot
from robotdiffuse.collision import CollisionChecker
from robotdiffuse.datasets.rows import turned, turns_about_vertical
from robotdiffuse.problems.families.rop import ROP_DENSE
from robotdiffuse.scenes.scene_arrays import PackedScenes


def test_turned_motions_have_the_same_clearances():
    robot = rd.load_robot("panda")
    rng = np.random.default_rng(3)
    scenes = [ROP_DENSE.scene(rng) for _ in range(6)]
    packed = PackedScenes.pack(scenes, ROP_DENSE.max_obstacles, floor=True)
    start, goal = rng.uniform(robot.lower, robot.upper, (2, 6, robot.dof))
    q = np.linspace(start, goal, 20, axis=1).astype(np.float32)
    q_turned, packed_turned, clear = turned(robot, q, packed, rng)
    np.testing.assert_array_equal(q_turned[..., 1:], q[..., 1:])
    assert (q_turned >= robot.lower.astype(np.float32)).all() and (q_turned <= robot.upper.astype(np.float32)).all()
    angle = q_turned[:, :, 0] - q[:, :, 0]
    assert np.ptp(angle, axis=1).max() < 1e-5 and np.abs(angle).max() > 0.1
    for i in range(len(packed)):
        before = CollisionChecker(robot, packed.scene(i)).link_clearances(q[i])
        after = CollisionChecker(robot, packed_turned.scene(i)).link_clearances(q_turned[i])
        np.testing.assert_allclose(after, before, atol=2e-5)
        alone = CollisionChecker(robot, rd.Scene([])).free(q_turned[i])
        assert clear[i] == alone.all()


def test_a_motion_that_uses_the_whole_range_of_the_first_joint_stays():
    robot = rd.load_robot("panda")
    q = np.linspace(robot.lower, robot.upper, 5)[None].astype(np.float32)
    same, _, _ = turned(robot, q, PackedScenes.pack([rd.Scene([])], 1), np.random.default_rng(0))
    np.testing.assert_allclose(same, q, atol=1e-6)


@pytest.mark.parametrize(("name", "vertical"), [("panda", True), ("ur5", True), ("awkward", False)])
def test_which_robots_turn(name, vertical):
    assert turns_about_vertical(example_robot(name)) is vertical
