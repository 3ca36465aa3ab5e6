"""Collision guidance: what it may change, and that it helps."""

from dataclasses import replace

import numpy as np
import pytest
from numpy import ndarray

from helpers.box_arm import box_arm
from robotdiffuse.collision import CollisionChecker
from robotdiffuse.core.errors import InputError
from robotdiffuse.learning.guidance import CollisionGuidance, GuidanceSettings
from robotdiffuse.problems.families.rop_dense import ROP_DENSE
from robotdiffuse.problems.problem import JointGoal
from robotdiffuse.robots import load_robot
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.shapes import PointCloud, Sphere

WAYPOINTS = 24
BALL = (1.02, 0.55, 0.0)


def straight(start: ndarray, goal: ndarray, waypoints: int = WAYPOINTS) -> ndarray:
    return (start + np.linspace(0, 1, waypoints)[:, None] * (goal - start)).astype(np.float32)


def swing() -> tuple[CollisionChecker, ndarray]:
    """The bent arm of boxes swings its tip into a ball in the middle; a second line stays clear of it."""
    checker = CollisionChecker(box_arm(), Scene([Sphere(BALL, 0.08)]))
    through = straight(np.array([-0.8, 0.6, 0.6]), np.array([0.8, 0.6, 0.6]))
    clear = straight(np.array([1.2, 0.2, 0.1]), np.array([2.0, 0.1, 0.4]))
    return checker, np.stack([through, clear])


def test_ends_are_held_and_free_trajectories_untouched() -> None:
    checker, lines = swing()
    before = lines.copy()
    moved, costs = CollisionGuidance(checker)(lines, 10)
    np.testing.assert_array_equal(lines, before)
    np.testing.assert_array_equal(moved[:, [0, -1]], lines[:, [0, -1]])
    np.testing.assert_array_equal(moved[1], lines[1])
    assert costs[1] == 0
    assert (moved[0, 1:-1] != lines[0, 1:-1]).any()


def test_steps_take_a_motion_out_of_collision() -> None:
    checker, lines = swing()
    guidance = CollisionGuidance(checker)
    assert not checker.free(lines[0].astype(float)).all()
    costs = [guidance(lines, steps)[1][0] for steps in (1, 5, 40)]
    assert costs[0] > costs[1] > costs[2]
    moved, _ = guidance(lines, 40)
    assert checker.free(moved[0].astype(float)).all()


def test_no_steps_change_nothing() -> None:
    checker, lines = swing()
    moved, costs = CollisionGuidance(checker)(lines, 0)
    np.testing.assert_array_equal(moved, lines)
    assert (costs == 0).all()


@pytest.mark.parametrize("waypoints", [1, 2, 3])
def test_short_trajectories(waypoints: int) -> None:
    checker, lines = swing()
    moved, _ = CollisionGuidance(checker)(lines[:, WAYPOINTS // 2 - 1 :][:, :waypoints], 3)
    assert moved.shape == (2, waypoints, 3)
    assert np.isfinite(moved).all()


def test_limits_are_kept() -> None:
    checker, lines = swing()
    limits = {"j0": (-0.9, 0.9), "j1": (0.59, 0.61), "j2": (0.59, 0.61)}
    joints = [
        replace(joint, lower=limits[joint.name][0], upper=limits[joint.name][1])
        if joint.name in limits
        else joint
        for joint in checker.robot.joints
    ]
    tight = replace(checker.robot, joints=tuple(joints))
    moved, _ = CollisionGuidance(CollisionChecker(tight, checker.scene), GuidanceSettings(margin=0.1))(
        lines[:1], 20
    )
    assert (moved <= tight.upper + 1e-6).all()
    assert (moved >= tight.lower - 1e-6).all()
    assert (moved != lines[:1]).any()


def test_random_motions_of_the_panda_get_better() -> None:
    robot, before, after, solved = load_robot("panda"), 0.0, 0.0, 0
    for seed in range(20):
        problem = ROP_DENSE.draw(robot, np.random.default_rng(seed)).problem(robot)
        assert isinstance(problem.goal, JointGoal)
        checker = CollisionChecker(robot, problem.scene)
        line = straight(problem.start, problem.goal.positions[0])[None]
        moved, _ = CollisionGuidance(checker)(line, 30)
        before += float(checker.cost_gradients(line[0].astype(float), 0.04)[0].sum())
        after += float(checker.cost_gradients(moved[0].astype(float), 0.04)[0].sum())
        solved += int(checker.free(moved[0].astype(float)).all()) - int(
            checker.free(line[0].astype(float)).all()
        )
        np.testing.assert_array_equal(moved[0, [0, -1]], line[0, [0, -1]])
        assert ((moved >= robot.lower.astype(np.float32)) & (moved <= robot.upper.astype(np.float32))).all()
    assert after < 0.5 * before
    assert solved > 0


def test_point_clouds_guide_too() -> None:
    checker, lines = swing()
    directions = np.random.default_rng(0).normal(size=(400, 3))
    surface = 0.08 * directions / np.linalg.norm(directions, axis=1, keepdims=True) + np.array(BALL)
    cloud = CollisionChecker(checker.robot, Scene([PointCloud(surface, 0.005)]))
    moved, _ = CollisionGuidance(cloud)(lines, 40)
    assert checker.free(moved[0].astype(float)).all()


@pytest.mark.parametrize(
    ("name", "value"),
    [("margin", -0.1), ("self_margin", -1.0), ("push", 0.0), ("width", 0.0), ("length", 1.5)],
)
def test_bad_settings_are_refused(name: str, value: float) -> None:
    with pytest.raises(InputError, match=f"guidance.{name} is {value}"):
        replace(GuidanceSettings(), **{name: value})
