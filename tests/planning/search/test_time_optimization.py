"""Faster motions near a path: the time falls, the ends stay, and what collides is not taken."""

import numpy as np
import pytest

import robotdiffuse as rd
from robotdiffuse.collision import CollisionChecker
from robotdiffuse.collision.kernels.motions import Space
from robotdiffuse.planning.search.time_optimization import TimeOptimization
from robotdiffuse.planning.start_goal import StartGoal
from robotdiffuse.trajectories.speed_limits import TimingSettings
from robotdiffuse.trajectories.straight_line import straight_line_time

ROBOT = rd.load_robot("panda")
LEFT = np.array([0.9, 0.3, 0.0, -1.9, 0.0, 2.2, 0.785])
RIGHT = LEFT * [-1, 1, 1, 1, 1, 1, 1]
WALL = rd.Scene([rd.Box([0.45, 0.0, 0.4], [0.3, 0.05, 0.8])])
AROUND = rd.Problem(ROBOT, WALL, LEFT, rd.JointGoal(RIGHT[None]))
DETOUR = LEFT + np.array([[0, 0, 0, 0, 0, 0, 0], [0.6, 0.4, 0, 0, 0, 0, 0], [-1.5, 1.2, 0, 0, 0, 0, 0]])
"""Joint 1 is limited by its velocity, joint 2 by its acceleration."""


def space(scene: rd.Scene, path: np.ndarray) -> Space:
    return StartGoal(CollisionChecker(ROBOT, scene), path[0], path[-1:]).space(0.05, 0.0)


def optimized(scene: rd.Scene, path: np.ndarray, turns: int) -> TimeOptimization:
    found = TimeOptimization(ROBOT, TimingSettings(), path[0], path[-1:], seed=0)
    found.offer(space(scene, path), path, "search")
    for _ in range(turns):
        found.improve(space(scene, path))
    return found


@pytest.mark.parametrize("path", [DETOUR, DETOUR[[0, 2]]], ids=["detour", "straight line"])
def test_the_slowest_joint_is_the_bound(path: np.ndarray) -> None:
    found = optimized(rd.Scene([]), path, 100)
    limits = ROBOT.velocity, ROBOT.acceleration
    alone = max(
        straight_line_time(path[0, [j]], path[-1, [j]], *(limit[[j]] for limit in limits))
        for j in range(ROBOT.dof)
    )
    best = found.best
    assert best is not None and best.time == pytest.approx(alone, rel=0.03)
    assert best.time < 0.94 * straight_line_time(path[0], path[-1], *limits)
    assert np.array_equal(best.path[[0, -1]], path[[0, -1]])


@pytest.mark.parametrize("planner", ["aorrtc", "rrt_connect", "robotdiffuse"])
def test_motions_take_less_time_and_keep_their_certificate(planner: str) -> None:
    made = rd.load_planner(planner)
    by_length = made.plan(AROUND, 60.0, objective="length")
    result = made.plan(AROUND, 60.0)
    assert result.trajectory is not None and result.stops == 0
    assert result.duration is not None and by_length.duration is not None
    assert rd.verify(AROUND, result.trajectory).valid
    assert result.duration < 0.99 * by_length.duration
    if planner != "rrt_connect":  # which returns the shorter of two paths, not the shortest
        assert by_length.path.length < result.path.length
