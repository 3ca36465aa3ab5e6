"""Path constraints: conditions on the pose of a link that hold along the whole motion.

Positions and directions are in the frame of the base, except where a field says otherwise.

As with shapes, the constructors check their arguments themselves: see `no_type_check` in scenes/shapes.py.
"""

from dataclasses import fields, replace
from types import NoneType
from typing import Any, ClassVar, TypeVar, get_args

import numpy as np

from robotdiffuse.core.errors import (
    MAX_COORDINATE,
    InputError,
    bounded,
    rigid_motion,
    rigid_transform,
    shown,
    vector,
)
from robotdiffuse.core.types import (
    GivenVector,
    Pose,
    PoseOrNone,
    Value,
    frozen_dataclass,
    no_type_check,
    read_only,
)

# Smallest tolerances and angles that constraints may have [m], [rad].
MIN_TOLERANCE = 1e-4
MIN_ANGLE = 1e-3
SCALAR_BOUNDS = {
    "angle": (MIN_ANGLE, np.pi, "rad"),
    "tolerance": (MIN_TOLERANCE, MAX_COORDINATE, "m"),
    "speed": (1e-4, MAX_COORDINATE, "m/s"),
}
"""Minimum, maximum and unit of each scalar field."""
DIRECTION_FIELDS = ("axis", "direction", "normal")
"""Names of the vector fields that are normalized."""
BASE_FRAME = read_only(np.eye(4))


Self = TypeVar("Self", bound="FrameConstraint")


@no_type_check
@frozen_dataclass
class FrameConstraint(Value):
    """Base of all constraints."""

    kind: ClassVar[str]
    frame: str
    """Name of the link."""

    def __post_init__(self) -> None:
        """Checks each field by its name: link, vectors, directions, scalars within their bounds, and the pose
        of the box."""
        for field in fields(self):
            name = field.name
            content: Any = getattr(self, name)
            location = f"{self.kind}.{name}"
            if name == "frame" and not isinstance(content, str):
                raise InputError(f"{location} is {shown(content)}; it must be the name of a link")
            if name in ("point", "low", "high", *DIRECTION_FIELDS):
                row = vector(self.kind, name, content, 3)
                length = float(np.linalg.norm(row))
                if name in DIRECTION_FIELDS and length < 1e-6:
                    raise InputError(f"{location} is {shown(row)}; its length must be at least 1e-6")
                content = row if name not in DIRECTION_FIELDS or abs(length - 1) < 1e-15 else row / length
            if name in SCALAR_BOUNDS and not (content is None and NoneType in get_args(field.type)):
                low, high, unit = SCALAR_BOUNDS[name]
                wanted = f"a number from {low:g} to {high:.6g} [{unit}]"
                content = float(bounded(location, content, (), low, high, wanted))
            if name == "T_base_box":
                content = BASE_FRAME if content is None else rigid_transform(location, content)
            object.__setattr__(self, name, read_only(content))

    def moved(self: Self, T: Pose) -> Self:
        """The constraint after the rigid motion T. Raises InputError unless T is rigid."""
        T = rigid_motion(T)
        after = dict[str, Any]()
        for name in ("direction", "normal", "point", "T_base_box"):
            if hasattr(self, name):
                before = getattr(self, name)
                after[name] = T @ before if before.ndim == 2 else T[:3, :3] @ before
        if "point" in after:
            after["point"] += T[:3, 3]
        return replace(self, **after)


@no_type_check
@frozen_dataclass
class AxisCone(FrameConstraint):
    """An axis of a link stays within an angle of a direction, e.g. to keep a cup upright."""

    kind: ClassVar[str] = "axis_cone"
    axis: GivenVector
    """In the link's frame, of any length."""
    direction: GivenVector
    """In the base's frame, of any length."""
    angle: float
    """Maximum angle between the axis and the direction [rad], up to pi."""


@no_type_check
@frozen_dataclass
class PositionBox(FrameConstraint):
    """The origin of a link stays in a box."""

    kind: ClassVar[str] = "position_box"
    low: GivenVector
    """Lower corner, in the frame of the box [m]."""
    high: GivenVector
    """Upper corner [m]."""
    T_base_box: PoseOrNone = None  # pyright: ignore[reportAssignmentType]
    """Pose of the box; None: the frame of the base."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (self.high - self.low >= 2 * MIN_TOLERANCE).all():
            raise InputError(
                f"{self.kind}.low is {shown(self.low)} and high {shown(self.high)}; each high must be "
                f"above its low by at least {2 * MIN_TOLERANCE:g} m"
            )


@no_type_check
@frozen_dataclass
class OnPlane(FrameConstraint):
    """The origin of a link stays on a plane."""

    kind: ClassVar[str] = "on_plane"
    point: GivenVector
    """A point of the plane [m]."""
    normal: GivenVector
    """A vector of any length."""
    tolerance: float
    """Maximum distance from the plane, on either side [m]."""


@no_type_check
@frozen_dataclass
class OnLine(FrameConstraint):
    """The origin of a link stays on an infinite line."""

    kind: ClassVar[str] = "on_line"
    point: GivenVector
    """A point of the line [m]."""
    direction: GivenVector
    """A vector of any length."""
    tolerance: float
    """Maximum distance from the line [m]."""


@no_type_check
@frozen_dataclass
class CartesianLine(FrameConstraint):
    """The origin of a link moves on the straight segment from its start position to its goal position.

    The goal must therefore determine the pose of the link. It may be a configuration, several configurations
    with the link at the same pose, or poses of links. Of these, at least one pose of this link, or of a link
    rigidly connected to it, must be without tolerances. The orientation follows the shortest rotation from
    start to goal, in proportion to the fraction of the segment traveled.
    """

    kind: ClassVar[str] = "cartesian_line"
    tolerance: float = 1e-3
    """Maximum distance from the segment [m]."""
    angle: float | None = 0.05
    """Maximum angle from the interpolated orientation [rad]; None: any orientation."""
    speed: float | None = None
    """Maximum speed of the link's origin [m/s]; None: only the limits of the joints limit the speed."""


Constraint = AxisCone | PositionBox | OnPlane | OnLine | CartesianLine
CONSTRAINTS: dict[str, type[Constraint]] = {
    constraint.kind: constraint for constraint in (AxisCone, PositionBox, OnPlane, OnLine, CartesianLine)
}
