"""`Problem.clearance_at`: one configuration or several."""

import numpy as np
import pytest

import robotdiffuse as rd
from robotdiffuse.collision import CollisionChecker

START = [0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785]


def test_the_least_distance_at_one_configuration_or_several() -> None:
    panda = rd.load_robot("panda")
    problem = rd.Problem(panda, rd.Scene([rd.Sphere([0.5, 0.3, 0.6], 0.1)]), START, START)
    q = np.array([START, [0.6, *START[1:]]])
    checker = CollisionChecker(panda, problem.scene)
    expected = np.hstack([checker.link_clearances(q), checker.pair_clearances(q)]).min(axis=1)
    np.testing.assert_allclose(problem.clearance_at(q), expected)
    assert problem.clearance_at(START) == pytest.approx(expected[0]) and isinstance(
        problem.clearance_at(START), float
    )
    with pytest.raises(rd.InputError, match=r"q is .* it must be 7 numbers"):
        problem.clearance_at([0.0])
