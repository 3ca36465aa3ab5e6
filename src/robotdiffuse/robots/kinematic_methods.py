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
    """Forward kinematics: the pose of a link in the frame of the base.

    Args:
        robot: The robot.
        q: A configuration [dof], or several [n, dof], of the planned joints [rad] or [m].
        link: Name of the link; None: the tip of the robot.

    Returns:
        T_base_link [4, 4], or [n, 4, 4].

    Raises:
        InputError: For an unknown link, or q of the wrong shape.

    Examples:
        >>> rd.load_robot("panda").fk([0, -0.785, 0, -2.356, 0, 1.571, 0.785])[:3, 3].round(2).tolist()
        [0.31, 0.0, 0.59]
    """
    rows = configurations(robot, q)
    T = link_poses(robot, np.atleast_2d(rows), robot.tip if link is None else link)
    return T[0] if rows.ndim == 1 else T


def jacobian(robot: Robot, q: ArrayLike, link: str | None = None) -> ndarray:
    """Geometric Jacobian of a link.

    Its linear, then its angular velocity, for each unit of a joint's velocity. Both are in the axes of the
    base; the
    linear velocity is that of the link's origin.

    Args:
        robot: The robot.
        q: A configuration [dof], or several [n, dof], of the planned joints [rad] or [m].
        link: Name of the link; None: the tip of the robot.

    Returns:
        A matrix [6, dof], or [n, 6, dof].

    Raises:
        InputError: For an unknown link, or q of the wrong shape.
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
    """Inverse kinematics: configurations within the joint limits that bring a link to a pose.

    They may collide: see `Problem.is_free`.

    Args:
        robot: The robot.
        pose: T_base_link [4, 4].
        link: Name of the link; None: the tip of the robot.
        count: Largest number of configurations.
        near: A configuration [dof]; results are sorted by their distance from it.
        seed: Seed of the random starts.

    Returns:
        Distinct configurations [k, dof]; no rows if the pose was not reached.

    Raises:
        InputError: For an unknown link, and for a pose that is not rigid.

    Examples:
        >>> robot = rd.load_robot("panda")
        >>> robot.ik(rd.pose([0.5, 0.1, 0.4], rpy=[3.1416, 0, 0]), count=3).shape
        (3, 7)
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
