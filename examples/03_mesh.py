"""A triangle mesh as an obstacle: the hand goes in through a ring."""

import trimesh

import robotdiffuse as rd
from robotdiffuse.visualization.picture import write_picture

# From a file: trimesh.load_mesh("ring.stl"); in a problem file: {mesh: {file: ring.stl}}.
ring = trimesh.creation.annulus(r_min=0.16, r_max=0.22, height=0.08)
along_x = [0.7071, 0.0, 0.7071, 0.0]  # a quarter turn about y, wxyz
obstacle = rd.Mesh(ring.vertices, ring.faces, xyz=[0.52, 0.0, 0.55], wxyz=along_x, name="ring")

problem = rd.Problem(
    robot=rd.load_robot("panda"),
    scene=rd.Scene([obstacle]),
    start=[0.9, 0.2, 0.0, -2.0, 0.0, 2.2, 0.8],
    goal=rd.PoseGoal(
        "panda_hand",
        [[0.0, 0.0, 1.0, 0.55], [0.0, -1.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.55], [0.0, 0.0, 0.0, 1.0]],
    ),
)
result = rd.plan(problem, time_limit=10.0)
print(result.status.value, result.reason, result.scene_clearance)
write_picture(problem.robot, problem.scene, result.trajectory, "03_mesh.png")
