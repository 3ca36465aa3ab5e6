"""A parcel is taken from a table, carried over a wall as a part of the arm, and put down beyond it."""

import numpy as np

import robotdiffuse as rd
from robotdiffuse.visualization.picture import PictureSettings, write_picture

start = np.array([-0.6, 0.2, 0.0, -2.0, 0.0, 2.2, 0.2])
goal = np.array([0.6, 0.2, 0.0, -2.0, 0.0, 2.2, 0.2])
table = rd.Box([0.55, 0.0, 0.0], [0.5, 1.2, 0.2], name="table")
wall = rd.Box([0.5, 0.0, 0.25], [0.3, 0.04, 0.3], name="wall")
parcel = rd.Box([0.487, -0.334, 0.18], [0.06, 0.06, 0.15], name="parcel")
scene = rd.Scene([table, wall, parcel])

# Where the arm is at `start`, its hand takes the parcel.
scene, robot = scene.attach("parcel", rd.load_robot("panda"), start, link="panda_hand")
problem = rd.Problem(robot, scene, start, goal)
result = rd.plan(problem, time_limit=10.0)
print(result.status.value, result.reason)
front = PictureSettings(azimuth=0.5)
write_picture(robot, scene, result.trajectory, "06_held_object.png", settings=front)

scene, robot = scene.detach("parcel", robot, goal)
print([shape.name for shape in scene.shapes])
