"""Batches of the hybrid planner for drawing."""

import numpy as np
import pytest

from robotdiffuse import InputError, JointGoal, Problem, Scene, Sphere, load_robot
from robotdiffuse.collision import CollisionChecker
from robotdiffuse.planning.hybrid import draw_candidates

START, END = np.array([-1.2, 0.6, 0, -1.6, 0, 2.2, 0.785]), np.array([1.4, 0.5, 0, -1.5, 0, 2.0, 0.785])


def test_the_network_s_batch_from_start_to_goal_with_clearances() -> None:
    problem = Problem(load_robot("panda"), Scene([Sphere([0.5, 0.3, 0.6], 0.25)]), START, JointGoal(END))
    drawn = draw_candidates(problem, seed=1)
    assert drawn.source == "network" and drawn.positions.shape[2] == 7
    np.testing.assert_allclose(drawn.positions[:, 0], np.tile(START, (len(drawn.positions), 1)), atol=1e-5)
    np.testing.assert_allclose(drawn.positions[:, -1], np.tile(END, (len(drawn.positions), 1)), atol=1e-5)
    checker = CollisionChecker(problem.robot, problem.scene)
    for q, clearance in zip(drawn.positions, drawn.clearances, strict=True):
        assert clearance <= checker.link_clearances(q).min() + 1e-6
    np.testing.assert_array_equal(draw_candidates(problem, seed=1).positions, drawn.positions)


def test_nothing_is_drawn_from_a_start_in_collision() -> None:
    problem = Problem(load_robot("panda"), Scene([Sphere([0.3, -0.4, 0.4], 0.4)]), START, JointGoal(END))
    with pytest.raises(InputError, match="nothing can be drawn: the start is in collision"):
        draw_candidates(problem)
