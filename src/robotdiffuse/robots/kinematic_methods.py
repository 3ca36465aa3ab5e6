"""Forward and inverse kinematics of a robot: its methods `fk`, `jacobian` and `ik`."""

from typing import cast

import numpy as np
from numpy import ndarray
from numpy.typing import ArrayLike

from robotdiffuse.core.bounds import numbers, within
from robotdiffuse.core.errors import InputError, shown
from robotdiffuse.robots.kinematics import link_jacobians, link_poses
from robotdiffuse.robots.robot import Robot


def fk(robot: Robot, q: ArrayLike, link: str | None = None) -> ndarray:
    """Forward kinematics: the pose of a link in the base frame, T_base_link.

    q: a configuration [dof], or several [n, dof], of the planned joints [rad] or [m].
    link: name of the link; None: the robot's tip.

    Returns a matrix [4, 4], or [n, 4, 4]. Raises InputError for an unknown link or q of the wrong shape.
    """
    rows = configurations(robot, q)
    T = link_poses(robot, np.atleast_2d(rows), robot.tip if link is None else link)
    return T[0] if rows.ndim == 1 else T


def jacobian(robot: Robot, q: ArrayLike, link: str | None = None) -> ndarray:
    """Geometric Jacobian of a link: linear, then angular velocity, per unit of each joint's velocity.

    Both in the axes of the base frame; the linear one is of the link's origin [m/rad]. Arguments as of
    `fk`. Returns a matrix [6, dof], or [n, 6, dof].
    """
    rows = configurations(robot, q)
    J = link_jacobians(robot, np.atleast_2d(rows), robot.tip if link is None else link)
    return J[0] if rows.ndim == 1 else J


def ik(
    robot: Robot,
    pose: ArrayLike,
    link: str | None = None,
    *,
    count: int = 10,
    near: ArrayLike | None = None,
    seed: int = 0,
) -> ndarray:
    """Inverse kinematics: distinct configurations within the joint limits that bring a link to a pose.

    pose: T_base_link [4, 4].
    link: name of the link; None: the robot's tip.
    count: largest number of configurations.
    near: a configuration [dof]; results are sorted by their distance from it.
    seed: of the random start configurations.

    Returns configurations [k, dof]: no rows if the pose was not reached. They may collide: see
    `Problem.clearance_at`. Raises InputError for an unknown link and for a pose that is not rigid.
    """
    from robotdiffuse.robots.inverse_kinematics import inverse_kinematics  # compiled code

    rng = np.random.default_rng(seed)
    frame = robot.tip if link is None else link
    seeded = None if near is None else configurations(robot, near)
    return inverse_kinematics(robot, frame, cast(ndarray, pose), count, rng=rng, near=seeded)


def configurations(robot: Robot, q: ArrayLike) -> ndarray:
    """A configuration [dof], or several [n, dof]. Raises InputError for anything else."""
    rows = numbers(q)
    if rows is None or rows.ndim not in (1, 2) or rows.shape[-1] != robot.dof or not within(rows):
        names = ", ".join(robot.joint_names)
        raise InputError(f"q is {shown(q)}; it must be {robot.dof} numbers, or rows of them: {names}")
    return rows
