"""Joints of a robot: kinds, limits, and joints that mimic others."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.core.bounds import Value
from robotdiffuse.core.transforms import rotation_about, transform

MOVING_KINDS = ("revolute", "continuous", "prismatic")
CONTINUOUS_LIMIT = 3 * np.pi
"""Position limits of continuous joints in planning, plus and minus [rad]: a start lies within half a turn,
and a goal at most one turn from the start. The joints themselves have no limits."""
MIMIC_SLACK = 1e-6
"""Largest difference between a value given for a mimic joint and the value that its leader implies."""


class Mimic(NamedTuple):
    """A mimic joint's rule: its value is multiplier * (value of `joint`) + offset."""

    joint: str
    multiplier: float = 1.0
    offset: float = 0.0


@dataclass(frozen=True, eq=False)
class Joint(Value):
    """A joint of the URDF tree. Fixed joints have no meaningful limits."""

    name: str
    kind: str
    """revolute, continuous, prismatic or fixed."""
    parent: str
    child: str
    T_parent_joint: Float[ndarray, "4 4"]
    axis: Float[ndarray, "3"]
    """Unit axis in the joint frame."""
    lower: float = 0.0
    """[rad] or [m]; -`CONTINUOUS_LIMIT` for a continuous joint."""
    upper: float = 0.0
    velocity: float = 0.0
    """[rad/s] or [m/s]"""
    acceleration: float = 0.0
    jerk: float = 0.0
    mimic: Mimic | None = None
    """The joint that this one follows, if any; it is locked together with that one."""
    effort: float = 0.0
    """Largest torque [N m] or force [N]; 0 if the URDF gives none."""

    def motion(self, q: float) -> Float[ndarray, "4 4"]:
        """T_joint_child at the joint value q [rad] or [m]."""
        if self.kind == "prismatic":
            return transform(self.axis * q)
        if self.kind == "fixed":
            return np.eye(4)
        return transform(np.zeros(3), rotation_about(self.axis, q))


def with_mimics(joints: tuple[Joint, ...], locked: dict[str, float]) -> dict[str, float]:
    """The values of locked joints, including the joints that mimic them, by name [rad] or [m]."""
    by_name = {joint.name: joint for joint in joints}

    def value(name: str) -> float | None:
        mimic = by_name[name].mimic if name in by_name else None
        leader = None if mimic is None else value(mimic.joint)
        return (
            locked.get(name) if mimic is None or leader is None else mimic.multiplier * leader + mimic.offset
        )

    values = {name: value(name) for name in (*locked, *(joint.name for joint in joints if joint.mimic))}
    return {name: number for name, number in values.items() if number is not None}
