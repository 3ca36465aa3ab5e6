"""A post crosses the path: the arm waits or retreats, and the motion is certified for every moment.

The picture shows the one post every half second.
"""

import numpy as np

import robotdiffuse as rd
from robotdiffuse.visualization.picture import PictureSettings, write_picture

post = rd.Cylinder([0.42, 0.25, 0.35], 0.06, 0.6, name="post")  # where it stands at time 0
table = rd.Box([0.55, 0.0, 0.0], [0.7, 1.6, 0.1], name="table")
problem = rd.Problem(
    robot=rd.load_robot("panda"),
    scene=rd.Scene([table]),
    start=[-0.9, 0.3, 0.0, -2.0, 0.0, 2.3, 0.8],
    goal=[0.9, 0.3, 0.0, -2.0, 0.0, 2.3, 0.8],
    moving=[rd.MovingObstacle(post, velocity=[0.25, -0.1, 0.0])],  # [m/s]
)
result = rd.plan(problem, time_limit=10.0)
print(result.status.value, result.reason)
print(f"{result.trajectory.duration:.2f} s")

posts = [problem.moving[0].at(time) for time in np.arange(0.0, result.trajectory.duration, 0.5)]
scene = rd.Scene([table, *posts])
front = PictureSettings(azimuth=1.1)
write_picture(problem.robot, scene, result.trajectory, "10_moving_obstacles.png", settings=front)
