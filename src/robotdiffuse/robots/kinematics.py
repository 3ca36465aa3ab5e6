"""Poses of links in NumPy: for what needs no gradients, nor the seconds that PyTorch takes to load."""

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.robots.robot import Robot
from robotdiffuse.transforms import rotation_about, transform

Z = np.array([0.0, 0.0, 1.0])


def link_pose(robot: Robot, q: Float[ndarray, "dof"], link: str) -> Float[ndarray, "4 4"]:
    """T_base_link at one configuration, in NumPy; InputError for an unknown link."""
    T = np.eye(4)
    for j in range(robot.link_frame(link)):
        motion = transform(Z * q[j]) if robot.prismatic[j] else transform(0 * Z, rotation_about(Z, q[j]))
        T = T @ robot.frame_offsets[j] @ motion
    return T @ robot.T_frame_link(link)


def link_origins(robot: Robot, q: Float[ndarray, "n dof"], link: str) -> Float[ndarray, "n 3"]:
    """Where a link's origin is at many configurations [m]; InputError for an unknown link."""
    T = np.broadcast_to(np.eye(4), (len(q), 4, 4))
    for j in range(robot.link_frame(link)):
        motion = np.broadcast_to(np.eye(4), (len(q), 4, 4)).copy()
        if robot.prismatic[j]:
            motion[:, 2, 3] = q[:, j]
        else:
            motion[:, 0, 0] = motion[:, 1, 1] = np.cos(q[:, j])
            motion[:, 1, 0] = np.sin(q[:, j])
            motion[:, 0, 1] = -motion[:, 1, 0]
        T = T @ robot.frame_offsets[j] @ motion
    return (T @ robot.T_frame_link(link))[:, :3, 3]
