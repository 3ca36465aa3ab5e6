"""Path constraints: what holds all along a motion, each of one frame of the arm.

As with shapes, the constructors check their arguments themselves: see `no_type_check` in scenes/shapes.py.
Places and directions are in the frame of the base.
"""

from dataclasses import dataclass, fields, replace
from types import NoneType
from typing import TYPE_CHECKING, Any, ClassVar, get_args, no_type_check

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from numpy.typing import ArrayLike

from robotdiffuse.core.bounds import MAX_COORDINATE, Value, numbers, read_only, rigid_transform, vector
from robotdiffuse.core.errors import InputError, shown

LEAST_TOLERANCE, LEAST_ANGLE = 1e-4, 1e-3
"""The tightest constraints [m], [rad]."""
SIZES = {
    "angle": (LEAST_ANGLE, np.pi, "rad"),
    "tolerance": (LEAST_TOLERANCE, MAX_COORDINATE, "m"),
    "speed": (1e-4, MAX_COORDINATE, "m/s"),
}
"""Fields that are sizes: least, greatest, unit."""
DIRECTIONS = ("axis", "direction", "normal")
"""Fields whose length does not matter."""
AROUND = read_only(np.eye(4))


@no_type_check
@dataclass(frozen=True, eq=False)
class AxisCone(Value):
    """An axis of a frame stays within an angle of a direction: a cup upright."""

    kind: ClassVar[str] = "axis_cone"
    frame: str
    """Name of the link."""
    axis: Float[ndarray, "3"]
    """In the link's frame; its length does not matter."""
    direction: Float[ndarray, "3"]
    """In the base's frame; neither does this one's."""
    angle: float
    """The largest angle between them [rad], up to pi."""

    def __post_init__(self) -> None:
        _check(self)

    if TYPE_CHECKING:

        def __init__(self, frame: str, axis: ArrayLike, direction: ArrayLike, angle: float) -> None: ...

    def moved(self, T: Float[ndarray, "4 4"]) -> "AxisCone":
        """After a rigid motion of the base's surroundings."""
        return replace(self, direction=T[:3, :3] @ self.direction)


@no_type_check
@dataclass(frozen=True, eq=False)
class PositionBox(Value):
    """The origin of a frame stays in a box."""

    kind: ClassVar[str] = "position_box"
    frame: str
    """Name of the link."""
    low: Float[ndarray, "3"]
    """Lower corner, in the frame of the box [m]."""
    high: Float[ndarray, "3"]
    """Upper corner [m]."""
    T_base_box: Float[ndarray, "4 4"] | None = None
    """None: the frame of the base."""

    def __post_init__(self) -> None:
        _check(self)
        if not (self.high - self.low >= 2 * LEAST_TOLERANCE).all():
            raise InputError(
                f"{self.kind}.low is {shown(self.low)} and its high {shown(self.high)}; each high must be "
                f"above its low by at least {2 * LEAST_TOLERANCE:g} m"
            )
        T = AROUND if self.T_base_box is None else rigid_transform(f"{self.kind}.T_base_box", self.T_base_box)
        object.__setattr__(self, "T_base_box", read_only(T))

    if TYPE_CHECKING:

        def __init__(
            self, frame: str, low: ArrayLike, high: ArrayLike, T_base_box: ArrayLike | None = None
        ) -> None: ...

    def moved(self, T: Float[ndarray, "4 4"]) -> "PositionBox":
        """After a rigid motion of the base's surroundings."""
        return replace(self, T_base_box=T @ self.T_base_box)


@no_type_check
@dataclass(frozen=True, eq=False)
class OnPlane(Value):
    """The origin of a frame stays on a plane."""

    kind: ClassVar[str] = "on_plane"
    frame: str
    """Name of the link."""
    point: Float[ndarray, "3"]
    """Of the plane [m]."""
    normal: Float[ndarray, "3"]
    """Its length does not matter."""
    tolerance: float
    """Largest distance from it, on either side [m]."""

    def __post_init__(self) -> None:
        _check(self)

    if TYPE_CHECKING:

        def __init__(self, frame: str, point: ArrayLike, normal: ArrayLike, tolerance: float) -> None: ...

    def moved(self, T: Float[ndarray, "4 4"]) -> "OnPlane":
        """After a rigid motion of the base's surroundings."""
        return replace(self, point=T[:3, :3] @ self.point + T[:3, 3], normal=T[:3, :3] @ self.normal)


@no_type_check
@dataclass(frozen=True, eq=False)
class OnLine(Value):
    """The origin of a frame stays on a line without ends."""

    kind: ClassVar[str] = "on_line"
    frame: str
    """Name of the link."""
    point: Float[ndarray, "3"]
    """Of the line [m]."""
    direction: Float[ndarray, "3"]
    """Its length does not matter."""
    tolerance: float
    """Largest distance from it [m]."""

    def __post_init__(self) -> None:
        _check(self)

    if TYPE_CHECKING:

        def __init__(self, frame: str, point: ArrayLike, direction: ArrayLike, tolerance: float) -> None: ...

    def moved(self, T: Float[ndarray, "4 4"]) -> "OnLine":
        """After a rigid motion of the base's surroundings."""
        return replace(self, point=T[:3, :3] @ self.point + T[:3, 3], direction=T[:3, :3] @ self.direction)


@no_type_check
@dataclass(frozen=True, eq=False)
class CartesianLine(Value):
    """The origin of a frame moves on the straight segment from where it starts to where the goal has it.

    So the goal must say one pose of the frame: one configuration, or a pose without tolerances of a link that
    moves with it. The orientation follows the shortest turn from that of the start to that of the goal, by
    the share of the segment.
    """

    kind: ClassVar[str] = "cartesian_line"
    frame: str
    """Name of the link."""
    tolerance: float = 1e-3
    """Largest distance from the segment [m]."""
    angle: float | None = 0.05
    """Largest angle from the orientation that belongs to the place [rad]; None: any orientation."""
    speed: float | None = None
    """Most speed of the frame's origin [m/s]; None: as fast as the joints can."""

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

    def moved(self, T: Float[ndarray, "4 4"]) -> "CartesianLine":
        """Itself: start and goal move."""
        return self


Constraint = AxisCone | PositionBox | OnPlane | OnLine | CartesianLine
CONSTRAINTS: dict[str, type[Constraint]] = {
    one.kind: one for one in (AxisCone, PositionBox, OnPlane, OnLine, CartesianLine)
}


def _check(constraint: Constraint) -> None:
    """Each field by its name: the frame, vectors, directions of any length, and sizes within bounds."""
    for field in fields(constraint):
        name = field.name
        given: Any = getattr(constraint, name)
        where = f"{constraint.kind}.{name}"
        if name == "frame" and not isinstance(given, str):
            raise InputError(f"{where} is {shown(given)}; it must be the name of a link")
        if name in ("point", "low", "high", *DIRECTIONS):
            row = vector(constraint.kind, name, given, 3)
            length = float(np.linalg.norm(row))
            if name in DIRECTIONS and length < 1e-6:
                raise InputError(f"{where} is {shown(row)}; it must not be zero")
            given = row if name not in DIRECTIONS or abs(length - 1) < 1e-15 else row / length
        if name in SIZES and not (given is None and NoneType in get_args(field.type)):
            least, most, unit = SIZES[name]
            value = numbers(given)
            if value is None or value.ndim != 0 or not least <= value <= most:
                raise InputError(
                    f"{where} is {shown(given)}; it must be a number from {least:g} to {most:.6g} [{unit}]"
                )
            given = float(value)
        object.__setattr__(constraint, name, read_only(given))
