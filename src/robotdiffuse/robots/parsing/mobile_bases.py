"""Mobile bases in a URDF: what a scene places where it places the robot."""

from collections.abc import Sequence

import numpy as np

from robotdiffuse.robots.joints import Joint

SLIDE, TURN = "prismatic", ("revolute", "continuous")
STRAIGHT = 1e-3
"""What the cosine of a right angle may be."""


def moves_in_a_plane(joints: Sequence[Joint]) -> bool:
    """Whether joints, each on the one before, are two slides across each other and a turn about what stands
    upright on both: a base on wheels."""
    moving = [joint for joint in joints if joint.kind != "fixed"]
    if sorted(joint.kind in TURN for joint in moving) != [False, False, True]:
        return False
    R, axes = np.eye(3), []
    for joint in joints:
        R = R @ joint.T_parent_joint[:3, :3]
        if joint.kind != "fixed":
            axes.append(R @ joint.axis)
    return bool(np.abs(np.array(axes) @ np.transpose(axes) - np.eye(3)).max() < STRAIGHT)
