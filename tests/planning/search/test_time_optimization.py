"""Faster motions near a path: shorter durations, the same start and goal, no collisions."""

import numpy as np
import pytest

import robotdiffuse as rd
from helpers.panda import LEFT, PANDA, RIGHT
from robotdiffuse.collision import CollisionChecker
from robotdiffuse.planning.search.time_optimization import TimeOptimization
from robotdiffuse.planning.start_goal import StartGoal
from robotdiffuse.trajectories.speed_limits import TimingSettings
from robotdiffuse.trajectories.straight_line import straight_line_time

AROUND = rd.Problem(PANDA, rd.Scene([rd.Box([0.45, 0.0, 0.4], [0.3, 0.05, 0.8])]), LEFT, RIGHT)
DETOUR = LEFT + np.array([[0, 0, 0, 0, 0, 0, 0], [0.6, 0.4, 0, 0, 0, 0, 0], [-1.5, 1.2, 0, 0, 0, 0, 0]])
"""Joint 1 is limited by its velocity, joint 2 by its acceleration."""


@pytest.mark.parametrize("path", [DETOUR, DETOUR[[0, 2]]], ids=["detour", "straight line"])
def test_the_slowest_joint_is_the_bound(path: np.ndarray) -> None:
    ends = path[0], path[-1:]
    space = StartGoal(CollisionChecker(PANDA, rd.Scene()), *ends).space(0.05, 0.0)
    found = TimeOptimization(PANDA, TimingSettings(), *ends, seed=0)
    found.offer(space, path, "search")
    for _ in range(100):
        found.improve(space)
    limits = PANDA.velocity, PANDA.acceleration
    alone = max(straight_line_time(path[0, [j]], path[-1, [j]], *(limit[[j]] for limit in limits)) for j in range(PANDA.dof))
    best = found.best
    assert best is not None and best.time == pytest.approx(alone, rel=0.03)
    assert best.time < 0.94 * straight_line_time(path[0], path[-1], *limits)
    assert np.array_equal(best.path[[0, -1]], path[[0, -1]])


@pytest.mark.parametrize("planner", ["aorrtc", "rrt_connect", "robotdiffuse"])
def test_motions_take_less_time_and_keep_their_certificate(planner: str) -> None:
    made = rd.load_planner(planner)
    by_length = made.plan(AROUND, 60.0, objective="length")
    result = made.plan(AROUND, 60.0)
    assert result.stops == 0 and rd.verify(AROUND, result.trajectory).valid
    assert result.duration < 0.99 * by_length.duration
    if planner != "rrt_connect":  # which returns the shorter of two paths, not the shortest
        assert by_length.path.length < result.path.length
