"""A recorded exploration, for tests of what shows or reads one."""

from functools import cache

import numpy as np

import robotdiffuse as rd
from helpers.panda import HOME, PANDA
from robotdiffuse.planning.exploration.simulated import Event, RecordedExplorer, camera_beside, explore, wrist_camera

BEYOND = np.array([-1.2, 0.5, 0.0, -1.8, 0.0, 2.3, 0.785])
FLOOR = rd.Box((0, 0, -0.06), (6, 6, 0.1), name="floor")
WALL = rd.Box((0.45, -0.2, 0.3), (0.5, 0.02, 0.6), name="wall")
ZONE = ((-0.36, -0.36, 0.0), (0.36, 0.36, 0.7))


@cache
def recorded() -> tuple[rd.Problem, RecordedExplorer, list[Event]]:
    """A Panda explores its way from one side of a wall to the other, with at most two looks."""
    problem = rd.Problem(PANDA, rd.Scene([FLOOR, WALL]), HOME, BEYOND)
    settings = rd.ExplorerSettings(time_limit=1.0, look_attempts=2, max_views=2)
    explorer = RecordedExplorer(PANDA, [wrist_camera(PANDA)], rd.Scene([FLOOR]), ZONE, settings)
    explorer.observe(camera_beside(problem, None, 0))
    return problem, explorer, list(explore(problem, explorer))
