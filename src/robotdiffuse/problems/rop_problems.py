"""Random problems in ROP scenes: start and goal anywhere in the paper's workspace, free of collision."""

from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy import ndarray
from numpy.random import Generator

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.errors import InputError
from robotdiffuse.problems.families.rop import RopSettings, sample_scene
from robotdiffuse.problems.problem import JointGoal, Problem
from robotdiffuse.robots.kinematics import ForwardKinematics
from robotdiffuse.robots.robot import Robot

BATCH = 64
"""Configurations drawn at once; a good part of them is usable."""
BATCHES = 8
"""Draws before a scene is given up: a few leave hardly any room."""
SCENES = 100
"""Scenes given up before the settings are called impossible."""


def sample_problem(robot: Robot, settings: RopSettings, rng: Generator) -> Problem:
    """A random ROP problem; the same state of `rng` gives the same problem.

    Obstacles stay clear of the robot's base. Start and goal are uniform in the joint limits among the
    configurations that are free of collision and have the robot's tip in the settings' region. Raises
    InputError if the settings leave no such configurations.
    """
    keep_out = base_spheres(robot)
    for _ in range(SCENES):
        scene = sample_scene(settings, rng, keep_out)
        checker = CollisionChecker(robot, scene)
        ends = np.zeros((0, robot.dof))
        for _ in range(BATCHES):
            q = rng.uniform(robot.lower, robot.upper, (BATCH, robot.dof))
            q = q[tip_in_region(robot, settings, q)]
            ends = np.concatenate([ends, q[checker.free(q)] if len(q) else q])
            if len(ends) >= 2:
                return Problem(robot, scene, ends[0], JointGoal(ends[1]))
    raise InputError(
        f"no free start and goal in {SCENES} scenes; allow fewer obstacles or a wider tip region"
    )


def free_configuration(
    robot: Robot, settings: RopSettings, checker: CollisionChecker, rng: Generator
) -> Float[ndarray, "dof"] | None:
    """A configuration by the rule of `sample_problem`; None if a number of draws found none."""
    for _ in range(BATCHES):
        q = rng.uniform(robot.lower, robot.upper, (BATCH, robot.dof))
        q = q[tip_in_region(robot, settings, q)]
        q = q[checker.free(q)] if len(q) else q
        if len(q):
            return q[0]
    return None


def base_spheres(robot: Robot) -> Float[ndarray, "m 4"]:
    """Collision spheres, x y z radius, of the links that no planned joint moves, in the base frame [m]."""
    parts = [np.zeros((0, 4))]
    for link, spheres in robot.spheres.items():
        if robot.link_frame(link) == 0:
            T = robot.T_frame_link(link)
            parts.append(np.column_stack([spheres[:, :3] @ T[:3, :3].T + T[:3, 3], spheres[:, 3]]))
    return np.concatenate(parts)


def tip_in_region(robot: Robot, settings: RopSettings, q: Float[ndarray, "n dof"]) -> Bool[ndarray, "n"]:
    """Whether the origin of the robot's tip link is in the settings' region."""
    with torch.inference_mode():
        xyz = _kinematics(robot).link(torch.from_numpy(q), robot.tip)[:, :3, 3].numpy()
    low, high = np.array([settings.tip_x, settings.tip_y, settings.tip_z]).T
    return ((xyz >= low) & (xyz <= high)).all(axis=1)


@lru_cache(maxsize=8)
def _kinematics(robot: Robot) -> ForwardKinematics:
    return ForwardKinematics(robot, torch.float64)
