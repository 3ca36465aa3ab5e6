"""Link poses in NumPy, for code that needs no gradients and should not load PyTorch."""

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.core.transforms import moved_spheres
from robotdiffuse.core.types import Configuration, Configurations, Points, Pose, Poses, Spheres
from robotdiffuse.robots.kinematic_tree import KinematicTree, once_per_robot

REACH_SAMPLES = 4096
"""Number of random configurations at which the reach is measured."""
REACH_QUANTILE = 0.99
"""The reach is this quantile of the tip's distances from the shoulder, since the very largest distances are
rare and vary with the sample."""


def link_pose(robot: KinematicTree, q: Configuration, link: str) -> Pose:
    """T_base_link at one configuration; raises InputError for an unknown link."""
    return link_poses(robot, np.asarray(q)[None], link)[0]


def _motions(robot: KinematicTree, j: int, q: Configurations) -> Poses:
    """The motion of planned joint j at each configuration: a rotation about z, or a translation along z."""
    motion = np.tile(np.eye(4), (len(q), 1, 1))
    if robot.prismatic[j]:
        motion[:, 2, 3] = q[:, j]
    else:
        motion[:, 0, 0] = motion[:, 1, 1] = np.cos(q[:, j])
        motion[:, 1, 0] = np.sin(q[:, j])
        motion[:, 0, 1] = -motion[:, 1, 0]
    return motion


def _frames(robot: KinematicTree, q: Configurations) -> list[Poses]:
    """Poses T_base_frame [n, 4, 4] of all frames."""
    frames = [np.tile(np.eye(4), (len(q), 1, 1))]
    for j, parent in enumerate(robot.parents):
        frames.append(frames[parent] @ robot.frame_offsets[j] @ _motions(robot, j, q))
    return frames


def link_poses(robot: KinematicTree, q: Configurations, link: str) -> Poses:
    """T_base_link at a batch of configurations; raises InputError for an unknown link."""
    return _frames(robot, q)[robot.link_frame(link)] @ robot.T_frame_link(link)


def link_jacobians(robot: KinematicTree, q: Configurations, link: str) -> Float[ndarray, "n 6 dof"]:
    """Geometric Jacobians of a link at a batch of configurations; raises InputError for an unknown link.

    The first three rows are the linear velocity of the link's origin, the last three the angular velocity,
    both in the axes of the base frame and per unit of joint velocity.
    """
    frames = _frames(robot, q)
    origins = (frames[robot.link_frame(link)] @ robot.T_frame_link(link))[:, :3, 3]
    chain = list(robot.chain(link))
    slides = np.array(robot.prismatic)[chain, None, None]
    T = np.array(frames)[1:][chain]
    axes = T[..., :3, 2]
    J = np.zeros((len(q), 6, robot.dof))
    J[:, :3, chain] = np.where(slides, axes, np.cross(axes, origins - T[..., :3, 3])).transpose(1, 2, 0)
    J[:, 3:, chain] = np.where(slides, 0.0, axes).transpose(1, 2, 0)
    return J


def link_origins(robot: KinematicTree, q: Configurations, link: str) -> Points:
    """Positions of a link's origin in the base frame [m]; raises InputError for an unknown link."""
    return link_poses(robot, q, link)[:, :3, 3]


def placed_spheres(robot: KinematicTree, q: Configuration) -> Spheres:
    """All collision spheres at one configuration, x y z radius in the base frame [m]."""
    frames = _frames(robot, q[None])
    parts = [np.zeros((0, 4))]
    for link, spheres in robot.spheres.items():
        T = frames[robot.link_frame(link)][0] @ robot.T_frame_link(link)
        parts.append(moved_spheres(T, spheres))
    return np.concatenate(parts)


@once_per_robot
def reach(robot: KinematicTree) -> float:
    """Distance between tip and shoulder that 99 % of the configurations do not exceed [m].

    The shoulder is the point on the first joint's axis at the height of the second joint, or of the first if
    it is the only one. With several arms, the largest reach of an arm is returned.
    """
    q = np.random.default_rng(0).uniform(robot.lower, robot.upper, (REACH_SAMPLES, robot.dof))
    reached = []
    for tip in robot.tips:
        first = list(robot.chain(tip)[:2])
        if not first:  # all joints of this arm are locked
            continue
        offsets = robot.frame_offsets[first]
        second = offsets[0] @ offsets[1] if len(first) > 1 else offsets[0]
        shoulder = np.array([*offsets[0, :2, 3], second[2, 3]])
        reached.append(np.linalg.norm(link_origins(robot, q, tip) - shoulder, axis=1))
    return float(np.quantile(reached, REACH_QUANTILE, axis=1).max())
