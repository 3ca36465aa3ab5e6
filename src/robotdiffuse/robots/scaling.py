"""The reach of an arm, and arms scaled in size."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.robots.joints import Joint
from robotdiffuse.robots.kinematics import link_origins
from robotdiffuse.robots.robot import Robot, once_per_robot

SAMPLES = 4096
"""Random configurations for measuring the reach."""
REACH_QUANTILE = 0.99
"""Quantile of the distances of the tip, since the largest ones are rare and random."""


@once_per_robot
def reach(robot: Robot) -> float:
    """Distance between tip and shoulder that 99 % of the configurations do not exceed [m].

    The shoulder is the point on the first joint's axis at the height of the second joint. With several arms,
    the reach of the longest one.
    """
    q = np.random.default_rng(0).uniform(robot.lower, robot.upper, (SAMPLES, robot.dof))
    reached = []
    for tip in robot.tips:
        first = list(robot.chain(tip)[:2])
        if not first:  # all joints of this arm are locked
            continue
        offsets = robot.frame_offsets[first]
        shoulder = np.array([*offsets[0, :2, 3], (offsets[0] @ offsets[-1])[2, 3]])
        reached.append(np.linalg.norm(link_origins(robot, q, tip) - shoulder, axis=1))
    return float(np.quantile(reached, REACH_QUANTILE, axis=1).max())


def scaled(robot: Robot, scale: float) -> Robot:
    """The arm without attached bodies, scaled by a factor with its spheres and meshes; angular limits
    stay."""
    arm = robot.arm
    prismatic = {joint.name for joint in arm.joints if joint.kind == "prismatic"}

    def sized(joint: Joint) -> Joint:
        by = scale if joint.name in prismatic else 1.0
        limits = {name: by * getattr(joint, name) for name in ("lower", "upper")}
        return replace(joint, T_parent_joint=_moved(joint.T_parent_joint, scale), **limits)

    return replace(
        arm,
        joints=tuple(map(sized, arm.joints)),
        spheres={link: scale * rows for link, rows in arm.spheres.items()},
        meshes={
            link: tuple(replace(mesh, vertices=scale * mesh.vertices) for mesh in meshes)
            for link, meshes in arm.meshes.items()
        },
        locked={name: (scale if name in prismatic else 1.0) * value for name, value in arm.locked.items()},
        above={link: _moved(T, scale) for link, T in arm.above.items()},
    )


def _moved(T: Float[ndarray, "4 4"], scale: float) -> Float[ndarray, "4 4"]:
    found = T.copy()
    found[:3, 3] *= scale
    return found
