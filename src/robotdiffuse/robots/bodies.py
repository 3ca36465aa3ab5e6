"""Convex meshes, and bodies that are attached to links of a robot."""

from dataclasses import dataclass, fields
from typing import Any, Protocol, runtime_checkable

from jaxtyping import Float, Int
from numpy import ndarray

from robotdiffuse.core.bounds import Value

TOOL = "tool"
"""Default name of a tool."""


@dataclass(frozen=True, eq=False)
class ConvexMesh(Value):
    """A convex polyhedron in the frame of its link [m]."""

    vertices: Float[ndarray, "v 3"]
    faces: Int[ndarray, "f 3"]


@dataclass(frozen=True, eq=False)
class Surface(Value):
    """A triangle mesh in the frame of its link [m]; it may be open."""

    vertices: Float[ndarray, "v 3"]
    faces: Int[ndarray, "f 3"]


@runtime_checkable
class RigidShape(Protocol):
    """Interface of shapes that a robot can hold; the shapes of scenes implement it."""

    @property
    def name(self) -> str: ...

    def solid(self) -> tuple[Float[ndarray, "4 4"], tuple[ConvexMesh, ...]]:
        """The shape's pose in the frame in which it is given, and convex meshes in its own frame that contain
        it."""
        ...


@dataclass(frozen=True, eq=False)
class AttachedBody(Value):
    """A tool or held object: a body that is fixed to a link of a robot and becomes a link itself."""

    name: str
    link: str
    """Link to which the body is fixed."""
    T_link_body: Float[ndarray, "4 4"]
    shapes: tuple[RigidShape, ...] = ()
    """Shapes, posed in the frame of `link`. Without any, the body is only a frame."""
    touch_links: tuple[str, ...] = ()
    """Links that the body may touch, besides those that move with it."""
    tool: bool = False
    """Whether the body is a tool, which may become the tip."""


class BodyContent:
    """A key for caches: equal for bodies of equal content."""

    def __init__(self, body: AttachedBody) -> None:
        self.body, self._content = body, _content(body)

    def __hash__(self) -> int:
        return hash(self._content)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, BodyContent) and self._content == other._content


def _content(value: Any) -> object:
    """A hashable object that is equal for equal arrays, dataclasses and tuples of these."""
    if isinstance(value, ndarray):
        return value.shape, value.tobytes()
    if hasattr(value, "__dataclass_fields__"):
        return type(value), *(_content(getattr(value, f.name)) for f in fields(value))
    return tuple(map(_content, value)) if isinstance(value, tuple) else value
