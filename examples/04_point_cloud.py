"""A point cloud as an obstacle: each point is a small sphere, and no mesh is made of it."""

import numpy as np

import robotdiffuse as rd
from robotdiffuse.scenes.point_cloud import voxel_thin
from robotdiffuse.visualization.picture import PictureSettings, write_picture

# In place of a scan: points on a vase. From a file: robotdiffuse.scenes.point_cloud.read_points("cloud.ply")
rng = np.random.default_rng(0)
height, angle = rng.uniform(0.0, 0.75, 20_000), rng.uniform(0.0, 2 * np.pi, 20_000)
radius = 0.12 + 0.05 * np.sin(9 * height)
vase = np.column_stack([0.5 + radius * np.cos(angle), radius * np.sin(angle), height])
cloud = rd.PointCloud(voxel_thin(vase, voxel=0.02), point_radius=0.012, name="vase")

problem = rd.Problem(
    robot=rd.load_robot("panda"),
    scene=rd.Scene([cloud]),
    start=[-0.9, 0.3, 0.0, -1.9, 0.0, 2.2, 0.8],
    goal=[0.9, 0.3, 0.0, -1.9, 0.0, 2.2, 0.8],
    clearance=0.02,
)
result = rd.plan(problem, time_limit=10.0)
print(result.status.value, result.reason, f"{result.scene_clearance:.3f} m from {len(cloud.points)} points")
front = PictureSettings(azimuth=0.5)
write_picture(problem.robot, problem.scene, result.trajectory, "04_point_cloud.png", settings=front)
