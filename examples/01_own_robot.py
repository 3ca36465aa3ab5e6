"""A robot from a URDF: collision spheres are fitted once (about a minute), then it plans like any other."""

from pathlib import Path

import robotdiffuse as rd
from robotdiffuse.visualization.picture import write_picture

robot = rd.load_robot(Path(__file__).parent / "data" / "arm.urdf")
print(robot)

wall = rd.Box([0.45, 0.0, 1.05], [0.1, 0.6, 0.5], name="wall")
problem = rd.Problem(robot, rd.Scene([wall]), start=[-1.2, 0.9, 0.6, 0.2], goal=[1.2, 0.9, 0.6, 0.2])
result = rd.plan(problem, time_limit=10.0)
print(result.status.value, result.reason)
write_picture(robot, problem.scene, result.trajectory, "01_own_robot.png")
