"""A planning scene and a motion plan request as MoveIt writes them, planned without MoveIt."""

from pathlib import Path

import robotdiffuse as rd
from robotdiffuse.visualization.picture import write_picture

# The problem file names both: `scene: moveit_scene.yaml` and `request: moveit_request.yaml`.
problem = rd.load_problem(Path(__file__).parent / "data" / "moveit_problem.yaml")
print([shape.name for shape in problem.scene.shapes])

result = rd.plan(problem, time_limit=10.0)
print(result.status.value, result.reason)
write_picture(problem.robot, problem.scene, result.trajectory, "02_moveit_scene.png")
