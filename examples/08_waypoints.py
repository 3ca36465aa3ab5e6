"""Poses that the hand passes within 5 cm, without stopping, on its way to the goal."""

import numpy as np

import robotdiffuse as rd
from robotdiffuse.visualization.picture import PictureSettings, write_picture


def hand_at(x: float, y: float, z: float) -> rd.PoseGoal:
    """The hand here, pointing down."""
    return rd.PoseGoal("panda_hand", rd.pose([x, y, z], rpy=[np.pi, 0.0, 0.0]))


problem = rd.Problem(
    robot=rd.load_robot("panda"),
    scene=rd.Scene([rd.Box([0.55, 0.0, 0.1], [0.5, 1.0, 0.2], name="table")]),
    start=[-0.6, 0.2, 0.0, -2.0, 0.0, 2.2, 0.2],
    goal=hand_at(0.6, 0.35, 0.35),
    waypoints=[hand_at(0.45, -0.1, 0.55), hand_at(0.6, 0.1, 0.55), hand_at(0.4, 0.25, 0.4)],
    blend=0.05,  # 0, the default: the motion stops at each
)
result = rd.plan(problem, time_limit=20.0)
print(result.status.value, result.reason)
print(f"{result.trajectory.duration:.2f} s")
front = PictureSettings(azimuth=0.4)
write_picture(problem.robot, problem.scene, result.trajectory, "08_waypoints.png", settings=front)
