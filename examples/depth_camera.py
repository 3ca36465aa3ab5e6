"""Plan on what depth cameras see of a scene, and validator the motion by the scene itself (needs PyBullet).

What no camera sees is not there for the planner: the back of the ball, what the arm hides, what is out of
view. With one camera the motion is likely to run through the unknown half of the ball; with two it is free.
"""

import numpy as np

import robotdiffuse as rd
from robotdiffuse.simulation import DepthCamera, World, point_cloud, replay

robot = rd.load_robot("panda")
scene = rd.Scene([rd.Box([0.55, 0.0, 0.3], [0.2, 0.2, 0.6]), rd.Sphere([0.45, -0.05, 0.95], 0.12)])
start = np.array([-1.0, 0.3, 0.0, -1.8, 0.0, 2.1, 0.8])
goal = np.array([1.0, 0.3, 0.0, -1.8, 0.0, 2.1, 0.8])
cameras = [
    DepthCamera(position=(1.6, 0.6, 1.2), target=(0.4, 0.0, 0.4), noise=0.002, dropout=0.05),
    DepthCamera(position=(0.2, -1.4, 1.2), target=(0.4, 0.0, 0.4), noise=0.002, dropout=0.05),
]

with World(robot, scene, visuals=True) as world:
    world.place(start)
    for count in (1, 2):
        cloud = point_cloud(world, cameras[:count], np.random.default_rng(0), point_radius=0.02)
        problem = rd.Problem(robot, rd.Scene([cloud]), start, goal)
        result = rd.plan(problem, time_limit=2.0)
        print(f"{count} camera(s), {len(cloud.points)} points: {result.status.value}, {result.reason}")
        if result.trajectory is None or result.path is None:
            continue
        report = rd.verify(rd.Problem(robot, scene, start, goal), result.path)
        run = replay(robot, scene, result.trajectory)
        touched = ", ".join(f"{contact.link} touches {contact.other}" for contact in run.contacts)
        print(f"  in the whole scene: {report.violation.message if report.violation else 'free'}")
        print(f"  in simulation: {touched or 'free'}; the tip is at most {run.tip_errors.max():.4f} m off")
