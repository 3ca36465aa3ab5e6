"""Path constraints: conditions on the pose of a link that hold along the whole motion.

As with shapes, the constructors check their arguments themselves: see `no_type_check` in scenes/shapes.py.
Positions and directions are in the frame of the base.
"""

from dataclasses import dataclass, fields, replace
from types import NoneType
from typing import TYPE_CHECKING, Any, ClassVar, get_args, no_type_check

import numpy as np
from numpy.typing import ArrayLike

from robotdiffuse.core.bounds import MAX_COORDINATE, Value, numbers, read_only, rigid_transform, vector
from robotdiffuse.core.errors import InputError, shown
from robotdiffuse.core.types import Pose, Vector

MIN_TOLERANCE, MIN_ANGLE = 1e-4, 1e-3
"""Tolerances of the tightest constraints [m], [rad]."""
SCALAR_BOUNDS = {
    "angle": (MIN_ANGLE, np.pi, "rad"),
    "tolerance": (MIN_TOLERANCE, MAX_COORDINATE, "m"),
    "speed": (1e-4, MAX_COORDINATE, "m/s"),
}
"""Scalar fields: minimum, maximum, unit."""
DIRECTION_FIELDS = ("axis", "direction", "normal")
"""Vector fields that are normalised."""
BASE_FRAME = read_only(np.eye(4))


@no_type_check
@dataclass(frozen=True, eq=False)
class AxisCone(Value):
    """An axis of a link stays within an angle of a direction, e.g. to keep a cup upright."""

    kind: ClassVar[str] = "axis_cone"
    frame: str
    """Name of the link."""
    axis: Vector
    """In the link's frame, of any length."""
    direction: Vector
    """In the base's frame, of any length."""
    angle: float
    """Maximum angle between the axis and the direction [rad], up to pi."""

    def __post_init__(self) -> None:
        _check(self)

    if TYPE_CHECKING:

        def __init__(self, frame: str, axis: ArrayLike, direction: ArrayLike, angle: float) -> None: ...

    def moved(self, T: Pose) -> "AxisCone":
        """The constraint after the rigid motion T."""
        return replace(self, direction=T[:3, :3] @ self.direction)


@no_type_check
@dataclass(frozen=True, eq=False)
class PositionBox(Value):
    """The origin of a link stays in a box."""

    kind: ClassVar[str] = "position_box"
    frame: str
    """Name of the link."""
    low: Vector
    """Lower corner, in the frame of the box [m]."""
    high: Vector
    """Upper corner [m]."""
    T_base_box: Pose | None = None
    """Pose of the box; None: the frame of the base."""

    def __post_init__(self) -> None:
        _check(self)
        if not (self.high - self.low >= 2 * MIN_TOLERANCE).all():
            raise InputError(
                f"{self.kind}.low is {shown(self.low)} and high {shown(self.high)}; each high must be "
                f"above its low by at least {2 * MIN_TOLERANCE:g} m"
            )
        T = (
            BASE_FRAME
            if self.T_base_box is None
            else rigid_transform(f"{self.kind}.T_base_box", self.T_base_box)
        )
        object.__setattr__(self, "T_base_box", read_only(T))

    if TYPE_CHECKING:

        def __init__(
            self, frame: str, low: ArrayLike, high: ArrayLike, T_base_box: ArrayLike | None = None
        ) -> None: ...

    def moved(self, T: Pose) -> "PositionBox":
        """The constraint after the rigid motion T."""
        return replace(self, T_base_box=T @ self.T_base_box)


@no_type_check
@dataclass(frozen=True, eq=False)
class OnPlane(Value):
    """The origin of a link stays on a plane."""

    kind: ClassVar[str] = "on_plane"
    frame: str
    """Name of the link."""
    point: Vector
    """A point of the plane [m]."""
    normal: Vector
    """Of any length."""
    tolerance: float
    """Maximum distance from the plane, on either side [m]."""

    def __post_init__(self) -> None:
        _check(self)

    if TYPE_CHECKING:

        def __init__(self, frame: str, point: ArrayLike, normal: ArrayLike, tolerance: float) -> None: ...

    def moved(self, T: Pose) -> "OnPlane":
        """The constraint after the rigid motion T."""
        return replace(self, point=T[:3, :3] @ self.point + T[:3, 3], normal=T[:3, :3] @ self.normal)


@no_type_check
@dataclass(frozen=True, eq=False)
class OnLine(Value):
    """The origin of a link stays on an infinite line."""

    kind: ClassVar[str] = "on_line"
    frame: str
    """Name of the link."""
    point: Vector
    """A point of the line [m]."""
    direction: Vector
    """Of any length."""
    tolerance: float
    """Maximum distance from the line [m]."""

    def __post_init__(self) -> None:
        _check(self)

    if TYPE_CHECKING:

        def __init__(self, frame: str, point: ArrayLike, direction: ArrayLike, tolerance: float) -> None: ...

    def moved(self, T: Pose) -> "OnLine":
        """The constraint after the rigid motion T."""
        return replace(self, point=T[:3, :3] @ self.point + T[:3, 3], direction=T[:3, :3] @ self.direction)


@no_type_check
@dataclass(frozen=True, eq=False)
class CartesianLine(Value):
    """The origin of a link moves on the straight segment from its start position to its goal position.

    The goal must therefore determine the pose of the link: one configuration, or a pose without tolerances of
    a link that is rigidly connected to it. The orientation follows the shortest rotation from start to goal,
    in proportion to the fraction of the segment travelled.
    """

    kind: ClassVar[str] = "cartesian_line"
    frame: str
    """Name of the link."""
    tolerance: float = 1e-3
    """Maximum distance from the segment [m]."""
    angle: float | None = 0.05
    """Maximum angle from the interpolated orientation [rad]; None: any orientation."""
    speed: float | None = None
    """Maximum speed of the link's origin [m/s]; None: limited by the joints alone."""

    def __post_init__(self) -> None:
        _check(self)

    if TYPE_CHECKING:

        def __init__(
            self,
            frame: str,
            tolerance: float = 1e-3,
            angle: float | None = 0.05,
            speed: float | None = None,
        ) -> None: ...

    def moved(self, T: Pose) -> "CartesianLine":
        """The constraint itself, which start and goal determine."""
        return self


Constraint = AxisCone | PositionBox | OnPlane | OnLine | CartesianLine
CONSTRAINTS: dict[str, type[Constraint]] = {
    one.kind: one for one in (AxisCone, PositionBox, OnPlane, OnLine, CartesianLine)
}


def _check(constraint: Constraint) -> None:
    """Checks each field by its name: link, vectors, directions, and scalars within their bounds."""
    for field in fields(constraint):
        name = field.name
        given: Any = getattr(constraint, name)
        where = f"{constraint.kind}.{name}"
        if name == "frame" and not isinstance(given, str):
            raise InputError(f"{where} is {shown(given)}; it must be the name of a link")
        if name in ("point", "low", "high", *DIRECTION_FIELDS):
            row = vector(constraint.kind, name, given, 3)
            length = float(np.linalg.norm(row))
            if name in DIRECTION_FIELDS and length < 1e-6:
                raise InputError(f"{where} is {shown(row)}; it must not be zero")
            given = row if name not in DIRECTION_FIELDS or abs(length - 1) < 1e-15 else row / length
        if name in SCALAR_BOUNDS and not (given is None and NoneType in get_args(field.type)):
            low, high, unit = SCALAR_BOUNDS[name]
            value = numbers(given)
            if value is None or value.ndim != 0 or not low <= value <= high:
                raise InputError(
                    f"{where} is {shown(given)}; it must be a number from {low:g} to {high:.6g} [{unit}]"
                )
            given = float(value)
        object.__setattr__(constraint, name, read_only(given))
