"""Detects mobile bases in a URDF."""

from collections.abc import Sequence

import numpy as np

from robotdiffuse.robots.joints import Joint

ROTATING_KINDS = ("revolute", "continuous")
RIGHT_ANGLE_TOLERANCE = 1e-3
"""Largest absolute cosine of an angle that counts as a right angle."""


def moves_in_a_plane(joints: Sequence[Joint]) -> bool:
    """Whether a chain of joints moves in a plane, as a base on wheels: two perpendicular prismatic joints,
    and a rotation about the axis perpendicular to both."""
    moving = [joint for joint in joints if joint.kind != "fixed"]
    if sorted(joint.kind in ROTATING_KINDS for joint in moving) != [False, False, True]:
        return False
    R = np.eye(3)
    axes = []
    for joint in joints:
        R = R @ joint.T_parent_joint[:3, :3]
        if joint.kind != "fixed":
            axes.append(R @ joint.axis)
    return bool(np.abs(np.array(axes) @ np.transpose(axes) - np.eye(3)).max() < RIGHT_ANGLE_TOLERANCE)
