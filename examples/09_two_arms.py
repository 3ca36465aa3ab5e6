"""Both arms of a Baxter as one robot of 14 joints: a pose for each hand, and no arm meets the other."""

import numpy as np

import robotdiffuse as rd
from robotdiffuse.visualization.picture import PictureSettings, write_picture

down = [np.pi, 0.0, 0.0]  # roll, pitch, yaw
any_turn = [0.0, 0.0, np.pi]  # about the vertical
goal = rd.PosesGoal(
    [
        rd.PoseGoal("left_gripper", rd.pose([0.7, 0.25, 0.3], rpy=down), rpy_tolerance=any_turn),
        rd.PoseGoal("right_gripper", rd.pose([0.7, -0.25, 0.3], rpy=down), rpy_tolerance=any_turn),
    ]
)
left = [0.27, -1.006, 0.689, 1.449, -0.366, 1.258, 0.209]
right = [-1.479, -0.43, 1.496, 1.427, 2.007, -1.564, -2.427]
table = rd.Box([0.75, 0.0, 0.05], [0.5, 1.2, 0.04], name="table")
problem = rd.Problem(rd.load_robot("baxter"), rd.Scene([table]), left + right, goal)

result = rd.plan(problem, time_limit=10.0)
print(result.status.value, result.reason)
front = PictureSettings(azimuth=0.3)
write_picture(problem.robot, problem.scene, result.trajectory, "09_two_arms.png", settings=front)
