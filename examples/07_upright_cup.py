"""A cup is carried over a wall and kept upright within 10 degrees, all along the motion."""

import numpy as np

import robotdiffuse as rd
from robotdiffuse.visualization.picture import write_picture

cup = rd.Cylinder([0.0, 0.0, 0.16], 0.03, 0.1, name="cup")  # in the frame of the hand
robot = rd.load_robot("panda").attach(cup, "panda_hand")
upright = rd.AxisCone("cup", axis=[0, 0, 1], direction=[0, 0, -1], angle=np.radians(10))
problem = rd.Problem(
    robot=robot,
    scene=rd.Scene([rd.Box([0.5, 0.0, 0.2], [0.3, 0.06, 0.4], name="wall")]),
    start=[-0.6, 0.2, 0.0, -2.0, 0.0, 2.2, 0.2],
    goal=[0.6, 0.2, 0.0, -2.0, 0.0, 2.2, 0.2],
    constraints=[upright],
)
result = rd.plan(problem, time_limit=10.0)
print(result.status.value, result.reason)
write_picture(robot, problem.scene, result.trajectory, "07_upright_cup.png")
