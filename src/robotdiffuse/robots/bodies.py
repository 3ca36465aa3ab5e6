"""Bodies of links: convex meshes, surfaces, inertias, and bodies that are attached to links."""

from dataclasses import fields
from types import NoneType
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from numpy.typing import ArrayLike

from robotdiffuse.core.errors import MAX_COORDINATE, InputError, bounded, check_type, shown, within
from robotdiffuse.core.types import (
    GivenVector,
    Points,
    Pose,
    Value,
    Vector,
    frozen_dataclass,
    no_type_check,
    read_only,
)

TOOL = "tool"
"""Default name of a tool."""
POLYGON_SIDES = 32
"""Number of sides of the polygons that stand for circles."""


@frozen_dataclass
class Surface(Value):
    """A triangle mesh in the frame of its link [m]; it may be open."""

    vertices: Points
    faces: Int[ndarray, "f 3"]

    @property
    def triangles(self) -> Float[ndarray, "f 3 3"]:
        """The corners of each face."""
        return self.vertices[self.faces]


class ConvexMesh(Surface):
    """A convex polyhedron in the frame of its link [m]."""


def polygon_around_circle(radius: float) -> Float[ndarray, "32 2"]:
    """Corners of a regular polygon around a circle about the origin [m]; it is 0.5 % wider than the
    circle."""
    angles = 2 * np.pi * np.arange(POLYGON_SIDES) / POLYGON_SIDES
    return radius / np.cos(np.pi / POLYGON_SIDES) * np.column_stack([np.cos(angles), np.sin(angles)])


@runtime_checkable
class RigidShape(Protocol):
    """Interface of shapes that a robot can hold; the shapes of scenes implement it."""

    @property
    def name(self) -> str: ...

    def solid(self) -> tuple[Pose, tuple[ConvexMesh, ...]]:
        """The pose of the shape's own frame, and convex meshes in this frame that together contain the
        shape."""
        ...


class EqualByContent(Value):
    """Base of values that are compared by their content, such as keys of caches."""

    def __hash__(self) -> int:
        return hash(_content(self))

    def __eq__(self, other: object) -> bool:
        return _content(self) == _content(other)


@frozen_dataclass
class AttachedBody(EqualByContent):
    """A tool or held object: a body that is fixed to a link of a robot and becomes a link itself."""

    name: str
    link: str
    """Link to which the body is fixed."""
    T_link_body: Pose
    shapes: tuple[RigidShape, ...] = ()
    """Shapes, given in the frame of `link`. A body without shapes is only a frame."""
    touch_links: tuple[str, ...] = ()
    """Links that the body may touch, besides those that move with it."""
    tool: bool = False
    """Whether the body is a tool, which may become the tip."""


def _content(value: Any) -> object:
    """A hashable object that is equal for equal arrays, dataclasses and tuples of these."""
    if isinstance(value, ndarray):
        return value.shape, value.tobytes()
    if hasattr(value, "__dataclass_fields__"):
        return type(value), *(_content(getattr(value, f.name)) for f in fields(value))
    return tuple(map(_content, value)) if isinstance(value, tuple) else value


SLACK = 1e-6
"""A negative principal moment of at most this size is accepted as a rounding error of the file; relative to
the largest entry of the inertia matrix."""


class Inertia(NamedTuple):
    """Mass and inertia of a link, in its frame."""

    mass: float
    """Mass [kg]."""
    com: Vector
    """Center of mass [m]."""
    moments: Float[ndarray, "3 3"]
    """Inertia matrix about the center of mass, along the frame's axes [kg m²]."""

    @property
    def values(self) -> list[float]:
        """Mass, center of mass and moments as the ten numbers that `inertia_of` takes."""
        return [self.mass, *self.com.tolist(), *self.moments[np.triu_indices(3)].tolist()]


def inertia_of(values: ArrayLike) -> Inertia:
    """An inertia from the ten numbers mass, x, y, z, ixx, ixy, ixz, iyy, iyz, izz. Raises ValueError for
    anything else, for a mass that is not positive, and for negative principal moments of inertia."""
    row = np.array(values, np.float64)
    if row.shape != (10,) or not within(row):
        raise ValueError("ten finite numbers expected")
    xx, xy, xz, yy, yz, zz = row[4:]
    moments = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    if not row[0] > 0 or float(np.linalg.eigvalsh(moments)[0]) < -SLACK * np.abs(moments).max():
        raise ValueError("a mass above 0 and moments of inertia of at least 0 expected")
    return read_only(Inertia(float(row[0]), row[1:4], moments))


@no_type_check
@frozen_dataclass
class Payload(EqualByContent):
    """A mass that a link carries; joint torques must support it in addition to the arm.

    Raises InputError for numbers that are not finite or too large, for negative mass or moments of inertia,
    for moments that no body has, and for a link that is not a name.
    """

    mass: float
    """Mass [kg]."""
    com: GivenVector = (0.0, 0.0, 0.0)  # pyright: ignore[reportAssignmentType]
    """Center of mass, in the frame of the link [m]."""
    link: str | None = None
    """Link that carries the mass; None: the robot's tip."""
    moments: GivenVector = (0.0, 0.0, 0.0)  # pyright: ignore[reportAssignmentType]
    """Moments of inertia about the center of mass, along the axes of the link's frame [kg m²]; 0 for a point
    mass."""

    def __post_init__(self) -> None:
        for name, shape, lower in (("mass", (), 0.0), ("com", (3,), -MAX_COORDINATE), ("moments", (3,), 0.0)):
            expected = "a number of kg" if name == "mass" else "3 numbers"
            wanted = f"{expected} from {lower:g} to {MAX_COORDINATE:g}"
            value = bounded(f"payload.{name}", getattr(self, name), shape, lower, MAX_COORDINATE, wanted)
            object.__setattr__(self, name, value if shape else float(value))
        if 2 * max(self.moments) > sum(self.moments) * (1 + 1e-9):
            raise InputError(
                f"payload.moments is {shown(self.moments)}; none may be larger than the other two together"
            )
        check_type("payload.link", self.link, (str, NoneType), "the name of a link")
        super().__post_init__()
