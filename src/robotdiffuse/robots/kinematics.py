"""Link poses in NumPy, for code that needs no gradients and should not load PyTorch."""

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.robots.kinematic_tree import KinematicTree, once_per_robot

REACH_SAMPLES = 4096
"""Random configurations for measuring the reach."""
REACH_QUANTILE = 0.99
"""Quantile of the distances of the tip, since the largest ones are rare and random."""


def link_pose(robot: KinematicTree, q: Float[ndarray, "dof"], link: str) -> Float[ndarray, "4 4"]:
    """T_base_link at one configuration; raises InputError for an unknown link."""
    return link_poses(robot, np.asarray(q)[None], link)[0]


def _motions(robot: KinematicTree, j: int, q: Float[ndarray, "n dof"]) -> Float[ndarray, "n 4 4"]:
    """The motion of planned joint j about or along its z axis, at each configuration."""
    motion = np.broadcast_to(np.eye(4), (len(q), 4, 4)).copy()
    if robot.prismatic[j]:
        motion[:, 2, 3] = q[:, j]
    else:
        motion[:, 0, 0] = motion[:, 1, 1] = np.cos(q[:, j])
        motion[:, 1, 0] = np.sin(q[:, j])
        motion[:, 0, 1] = -motion[:, 1, 0]
    return motion


def link_poses(robot: KinematicTree, q: Float[ndarray, "n dof"], link: str) -> Float[ndarray, "n 4 4"]:
    """T_base_link at a batch of configurations; raises InputError for an unknown link."""
    T = np.broadcast_to(np.eye(4), (len(q), 4, 4))
    for j in robot.chain(link):
        T = T @ robot.frame_offsets[j] @ _motions(robot, j, q)
    return T @ robot.T_frame_link(link)


def link_jacobians(robot: KinematicTree, q: Float[ndarray, "n dof"], link: str) -> Float[ndarray, "n 6 dof"]:
    """Geometric Jacobians of a link at a batch of configurations; raises InputError for an unknown link.

    Rows are linear, then angular, in the axes of the base frame; the linear ones are of the link's origin.
    """
    origins = link_origins(robot, q, link)
    J = np.zeros((len(q), 6, robot.dof))
    T = np.broadcast_to(np.eye(4), (len(q), 4, 4))
    for j in robot.chain(link):
        T = T @ robot.frame_offsets[j] @ _motions(robot, j, q)
        axis = T[:, :3, 2]
        if robot.prismatic[j]:
            J[:, :3, j] = axis
        else:
            J[:, :3, j] = np.cross(axis, origins - T[:, :3, 3])
            J[:, 3:, j] = axis
    return J


def link_origins(robot: KinematicTree, q: Float[ndarray, "n dof"], link: str) -> Float[ndarray, "n 3"]:
    """Positions of a link's origin in the base frame [m]; raises InputError for an unknown link."""
    return link_poses(robot, q, link)[:, :3, 3]


@once_per_robot
def _spheres_by_frame(robot: KinematicTree) -> list[Float[ndarray, "n 4"]]:
    """Collision spheres [x y z radius, m] by frame, in the coordinates of that frame."""
    parts: list[list[ndarray]] = [[np.zeros((0, 4))] for _ in range(robot.dof + 1)]
    for link, spheres in robot.spheres.items():
        T = robot.T_frame_link(link)
        placed = np.column_stack([spheres[:, :3] @ T[:3, :3].T + T[:3, 3], spheres[:, 3]])
        parts[robot.link_frame(link)].append(placed)
    return [np.concatenate(part) for part in parts]


def placed_spheres(robot: KinematicTree, q: Float[ndarray, "dof"]) -> Float[ndarray, "n 4"]:
    """All collision spheres at one configuration, x y z radius in the base frame [m]."""
    parts = []
    frames = [np.eye(4)]
    for j, parent in enumerate(robot.parents):
        frames.append(frames[parent] @ robot.frame_offsets[j] @ _motions(robot, j, q[None])[0])
    for T, spheres in zip(frames, _spheres_by_frame(robot), strict=True):
        parts.append(np.column_stack([spheres[:, :3] @ T[:3, :3].T + T[:3, 3], spheres[:, 3]]))
    return np.concatenate(parts)


@once_per_robot
def reach(robot: KinematicTree) -> float:
    """Distance between tip and shoulder that 99 % of the configurations do not exceed [m].

    The shoulder is the point on the first joint's axis at the height of the second joint. With several arms,
    the reach of the longest one.
    """
    q = np.random.default_rng(0).uniform(robot.lower, robot.upper, (REACH_SAMPLES, robot.dof))
    reached = []
    for tip in robot.tips:
        first = list(robot.chain(tip)[:2])
        if not first:  # all joints of this arm are locked
            continue
        offsets = robot.frame_offsets[first]
        shoulder = np.array([*offsets[0, :2, 3], (offsets[0] @ offsets[-1])[2, 3]])
        reached.append(np.linalg.norm(link_origins(robot, q, tip) - shoulder, axis=1))
    return float(np.quantile(reached, REACH_QUANTILE, axis=1).max())
