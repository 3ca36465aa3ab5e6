from typing import Any

import numpy as np
import pytest
from scipy.optimize import linprog

import robotdiffuse as rd
from robotdiffuse.trajectories.straight_line import straight_line_time

START = np.zeros(2)
FAR, NEAR = np.array([3.0, 1.0]), np.array([0.1, -0.05])


def test_by_hand():
    one = np.ones(2)
    goals = np.stack([FAR, NEAR, START])
    expected = [3.0 + 1.0, 2 * np.sqrt(0.1), 0.0]
    assert np.allclose(straight_line_time(START, goals, one, one), expected)
    # the slowest joint at each limit decides: times 1 / v, 1 / a of the share of the way
    assert np.isclose(straight_line_time(START, FAR, np.array([6.0, 0.5]), np.array([3.0, 1.0])), 2.0 + 0.5)
    # the greatest jerk alone binds in short motions
    assert np.isclose(straight_line_time(START, NEAR, one, one, one), 4 * np.cbrt(0.05))


def test_no_jerk_limit_is_the_limit_of_great_jerk():
    one = np.ones(2)
    for goal in (FAR, NEAR):
        plain = straight_line_time(START, goal, one, one)
        for jerk in (np.full(2, 1e9), np.full(2, np.inf), np.zeros(2)):
            assert np.isclose(straight_line_time(START, goal, one, one, jerk), plain, rtol=1e-6)


@pytest.mark.parametrize("limits", [(1.0, 2.0, 5.0), (1.0, 2.0, 0.5), (9.0, 0.8, 5.0), (9.0, 9.0, 3.0), (0.2, 5.0, 1.0)])
def test_goes_exactly_the_distance(limits):
    """Compares with the largest distance that an arm can travel within this time, by a linear program in
    discrete time."""
    v, a, j = limits
    time = float(straight_line_time(np.zeros(1), np.ones(1), *(np.array([x]) for x in limits)))
    n = 200
    h = time / n
    to_a = h * np.tril(np.ones((n, n)))
    before = np.vstack([np.zeros((1, n)), to_a[:-1]])
    to_v = h * np.tril(np.ones((n, n))) @ ((to_a + before) / 2)
    to_x = h * to_v.sum(axis=0)
    rows = np.vstack([to_a, -to_a, to_v])
    most = np.concatenate([np.full(2 * n, a), np.full(n, v)])
    ends = np.stack([to_a[-1], to_v[-1]])
    best = linprog(-to_x, rows, most, ends, np.zeros(2), bounds=(-j, j))
    assert -best.fun == pytest.approx(1.0, rel=0.01)  # discrete switching times cost up to a step


def test_along_a_line_as_toppra_times_it():
    toppra: Any = pytest.importorskip("toppra")
    from toppra import algorithm, constraint

    v = np.array([1.0, 0.7])
    a = np.array([2.0, 3.0])
    for goal in (FAR, NEAR):
        path = toppra.SplineInterpolator([0.0, 1.0], np.stack([START, goal]))
        limits = [
            constraint.JointVelocityConstraint(np.stack([-v, v], axis=1)),
            constraint.JointAccelerationConstraint(np.stack([-a, a], axis=1)),
        ]
        grid = np.linspace(0.0, 1.0, 1001)
        timed = algorithm.TOPPRA(limits, path, grid, parametrizer="ParametrizeConstAccel")
        trajectory: Any = timed.compute_trajectory(0, 0)
        found = trajectory.duration
        assert straight_line_time(START, goal, v, a) == pytest.approx(found, rel=5e-3)


def test_refuses_limits_that_are_not_positive():
    with pytest.raises(rd.InputError, match="acceleration"):
        straight_line_time(START, FAR, np.ones(2), np.zeros(2))
