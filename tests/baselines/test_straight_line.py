"""The straight line: to the nearest goal alone, or to any."""

import numpy as np

import robotdiffuse as rd
from robotdiffuse.baselines.straight_line import NEAREST, StraightLine, StraightLineSettings

PANDA = rd.load_robot("panda")
START = np.array([0.9, 0.3, 0.0, -1.9, 0.0, 2.2, 0.785])
BLOCKED = np.array([-0.9, 0.3, 0.0, -1.9, 0.0, 2.2, 0.785])
FREE = np.array([2.8, 0.3, 0.0, -1.9, 0.0, 2.2, 0.785])
WALL = rd.Scene([rd.Box([0.45, 0.0, 0.4], [0.3, 0.05, 0.4], name="wall")])


def test_any_goal_is_tried_where_the_nearest_is_blocked() -> None:
    problem = rd.Problem(PANDA, WALL, START, rd.JointGoal([BLOCKED, FREE]))
    found = StraightLine().plan(problem, 5.0)
    assert found.solved and found.path is not None
    np.testing.assert_array_equal(found.path.positions, [START, FREE])
    alone = StraightLine(StraightLineSettings(goals=NEAREST)).plan(problem, 5.0)
    assert not alone.solved and alone.refused == "scene_collision"
    assert "the straight line is refused" in alone.reason
