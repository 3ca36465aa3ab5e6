"""Identifies the robot that a network's weights were trained for."""

from dataclasses import dataclass

import numpy as np

from robotdiffuse.collision.kernel_arrays import robot_groups
from robotdiffuse.core.errors import InputError, joined, shortened
from robotdiffuse.core.settings import Settings
from robotdiffuse.robots.normalizer import JointNormalizer
from robotdiffuse.robots.robot import Robot, once_per_robot

DIMENSION_TOLERANCE = 1e-3
"""Robots are the same if their dimensions [m] and entries of rotations differ by less than this."""


@dataclass(frozen=True)
class RobotIdentity(Settings):
    """The robot that weights were trained for, as checkpoints describe it."""

    source: str
    """Bundled name, or path to its URDF."""
    joint_names: tuple[str, ...]
    lower: tuple[float, ...]
    """Limits that joint values are normalised by [rad], [m] for prismatic joints. The weights serve robots
    with other limits too: validation uses the limits of the robot itself."""
    upper: tuple[float, ...]
    frame_offsets: tuple[tuple[tuple[float, ...], ...], ...]
    """`Robot.frame_offsets`, to distinguish robots with the same joint names but other dimensions."""
    links: tuple[str, ...]
    """Moving links with collision spheres, in the order of link clearances."""

    def __post_init__(self) -> None:
        super().__post_init__()
        dof = len(self.joint_names)
        for name in ("lower", "upper", "frame_offsets"):
            if len(getattr(self, name)) != dof:
                raise InputError(f"robot.{name} has {len(getattr(self, name))} entries for {dof} joints")
        if any([len(row) for row in T] != [4] * 4 for T in self.frame_offsets):
            raise InputError("robot.frame_offsets has an entry that is not 4 x 4 numbers")

    @staticmethod
    @once_per_robot
    def of(robot: Robot) -> "RobotIdentity":
        """The identity of a robot: that of its bare arm, since attached bodies change nothing about its
        joints."""
        robot = robot.arm
        return RobotIdentity(
            source=robot.source or robot.name,
            joint_names=robot.joint_names,
            lower=tuple(robot.lower.tolist()),
            upper=tuple(robot.upper.tolist()),
            frame_offsets=tuple(tuple(tuple(row) for row in T) for T in robot.frame_offsets.tolist()),
            links=tuple(link for link in robot_groups(robot) if robot.link_frame(link) > 0),
        )

    @property
    def dof(self) -> int:
        return len(self.joint_names)

    def normalizer(self) -> JointNormalizer:
        return JointNormalizer(np.array(self.lower), np.array(self.upper))

    def difference(self, robot: Robot) -> str:
        """How the robot differs from this one; "" if it is the same."""
        its = RobotIdentity.of(robot)
        if its.joint_names != self.joint_names:
            return f"joints {joined(its.joint_names)}"
        if not np.allclose(its.frame_offsets, self.frame_offsets, atol=DIMENSION_TOLERANCE):
            return "other dimensions"
        if its.links != self.links:
            return f"spheres on the links {joined(its.links)}, not {joined(self.links)}"
        return ""

    def check(self, robot: Robot, where: str) -> None:
        """Raises InputError unless the weights are for this robot. where: names the weights in the
        message."""
        other = self.difference(robot)
        if other:
            raise InputError(
                f"{where} was trained for {shortened(self.source)} with joints {joined(self.joint_names)}; "
                f"the robot {robot.name} has {other}"
            )
