"""A robot and its scene from a MuJoCo model; MuJoCo executes the motion by the model's actuators."""

# MuJoCo has no types for type checkers:
# pyright: reportAttributeAccessIssue=false

from pathlib import Path

import mujoco
import numpy as np

import robotdiffuse as rd
from robotdiffuse.visualization.picture import write_picture

FILE = Path(__file__).parent / "data" / "mujoco_scene.xml"
robot = rd.load_robot(FILE)  # the bodies that actuators move; prepared on first use
model = mujoco.MjModel.from_xml_path(str(FILE))
data = mujoco.MjData(model)
mujoco.mj_resetDataKeyframe(model, data, 0)

scene = rd.Scene.from_mujoco(model, data)  # all other geoms that collide, at their present poses
problem = rd.Problem(robot, scene, start="left", goal=[0.7, 0.6, 1.2, 0.8, 0.5])
result = rd.plan(problem, time_limit=1.0)
print(result.status.value, f"{result.duration:.2f} s")

names = robot.joint_names
actuators = [model.actuator(name).id for name in names]
trajectory = result.trajectory.resample(1 / model.opt.timestep)
links = set(robot.link_names) - {"world"}
robot_geoms = {g for g in range(model.ngeom) if model.body(model.geom_bodyid[g]).name in links}
touched = set()
for q, v in zip(trajectory.positions, trajectory.velocities, strict=True):
    data.ctrl[actuators] = q + v * 200 / 4000  # kv / kp compensates the lag by the actuators' damping
    mujoco.mj_step(model, data)
    touched |= {pair for pair in map(tuple, data.contact.geom) if robot_geoms & set(pair)}
error = np.abs(data.qpos[[model.joint(name).qposadr[0] for name in names]] - trajectory.positions[-1]).max()
print(f"executed in MuJoCo: {len(touched)} contacts of the arm, {1e3 * error:.1f} mrad from the goal")
write_picture(robot, scene, result.trajectory, "13_mujoco.png")
