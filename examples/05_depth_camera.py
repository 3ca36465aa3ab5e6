"""One depth image: a network predicts what the camera does not see, and the motion keeps clear of both."""

import numpy as np

import robotdiffuse as rd
from robotdiffuse.perception.ray_caster import looking_at, ray_cast
from robotdiffuse.planning.pipeline.unknown_space import predicted_obstacles
from robotdiffuse.visualization.picture import write_picture

robot = rd.load_robot("panda")
start = [-0.9, 0.3, 0.0, -1.8, 0.0, 2.1, 0.8]
goal = [0.9, 0.3, 0.0, -1.8, 0.0, 2.1, 0.8]
true_scene = rd.Scene([rd.Box([0.55, 0.0, 0.3], [0.4, 0.2, 0.6]), rd.Cylinder([0.6, 0.45, 0.15], 0.08, 0.3)])

# In place of a camera; a real one gives `image` [m], its intrinsics and where it stands.
T_base_camera = looking_at(np.array([1.7, 0.2, 0.9]), np.array([0.3, 0.0, 0.3]))
intrinsics = (460.0, 460.0, 319.5, 239.5)
image = ray_cast(true_scene, T_base_camera, intrinsics, (640, 480), robot, np.array(start)).depth

view = rd.DepthView(image, intrinsics, T_base_camera)
problem = rd.Problem(robot, rd.Scene(), start, goal, views=[view], unknown="predicted")
result = rd.plan(problem, time_limit=10.0)
print(result.status.value, "|", result.assumption, "| confidence", result.confidence)
print("free in the true scene:", rd.verify(rd.Problem(robot, true_scene, start, goal), result.path).valid)

seen_and_predicted = rd.Scene([*problem.scene.shapes, predicted_obstacles(problem)])
write_picture(robot, seen_and_predicted, result.trajectory, "05_depth_camera.png")
