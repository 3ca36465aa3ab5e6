"""The pipeline picks the function for a problem."""

from dataclasses import replace

import numpy as np
import pytest

import robotdiffuse as rd
from robotdiffuse.perception.ray_caster import looking_at, ray_cast
from robotdiffuse.planning.planner import pipeline_for

PANDA = rd.load_robot("panda")
START = np.array([0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785])
PLAIN = rd.Problem(PANDA, rd.Scene(), START, START + 0.2)
BALL = rd.MovingObstacle(rd.Sphere([3, 0, 0], 0.1, name="ball"), velocity=[0.1, 0, 0])
MIDDLE = rd.JointGoal(START + 0.1)


def seen() -> rd.Problem:
    camera = looking_at(np.array([1.7, 0.0, 0.3]), np.array([0.0, 0.0, 0.3]))
    view = ray_cast(rd.Scene(), camera, (40.0, 40.0, 19.5, 14.5), (40, 30), PANDA, START)
    return replace(PLAIN, views=[view], unknown="padded")


@pytest.mark.parametrize(
    ("problem", "function"),
    [
        (lambda: PLAIN, "attempt"),
        (lambda: replace(PLAIN, waypoints=(MIDDLE,)), "plan_through_waypoints"),
        (lambda: replace(PLAIN, moving=(BALL,)), "plan_among_moving_obstacles"),
        (lambda: replace(PLAIN, moving=(BALL,), waypoints=(MIDDLE,)), "plan_among_moving_obstacles"),
        (lambda: replace(PLAIN, start_velocity=0.1 * np.ones(7)), "plan_from_start_velocity"),
        (seen, "plan_with_unknown_space"),
    ],
)
def test_each_problem_gets_its_function(problem, function: str) -> None:
    assert pipeline_for(problem()).__name__ == function
