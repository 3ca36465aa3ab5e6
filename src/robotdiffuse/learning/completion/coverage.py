"""Where the occupancy completion network predicts, and which arms stay within."""

import numpy as np

from robotdiffuse.learning.completion.volume import REACH, SHOULDER
from robotdiffuse.robots.kinematics import link_poses
from robotdiffuse.robots.robot import Robot, once_per_robot

SAMPLES = 256
"""Random configurations: they reach within 1 cm as far as thousands do."""


@once_per_robot
def covers(robot: Robot) -> bool:
    """Whether the network predicts wherever the arm can reach, as random configurations show."""
    lower, upper = (np.clip(limit, -np.pi, np.pi) for limit in (robot.lower, robot.upper))
    if any(robot.prismatic):
        lower, upper = (
            np.where(robot.prismatic, *pair) for pair in ((robot.lower, lower), (robot.upper, upper))
        )
    q = np.random.default_rng(0).uniform(lower, upper, (SAMPLES, robot.dof))
    for link, spheres in robot.spheres.items():
        if robot.link_frame(link) == 0:
            continue
        T = link_poses(robot, q, link)
        centers = np.einsum("nij,mj->nmi", T[:, :3, :3], spheres[:, :3]) + T[:, None, :3, 3]
        if (np.linalg.norm(centers - SHOULDER, axis=2) + spheres[:, 3]).max(initial=0.0) > REACH:
            return False
    return True
