"""Rigid bodies: convex meshes, and what is fixed to a link of a robot."""

from dataclasses import dataclass, fields
from typing import Any, Protocol, runtime_checkable

from jaxtyping import Float, Int
from numpy import ndarray

from robotdiffuse.core.bounds import Value

TOOL = "tool"
"""Name of a tool that is given none."""


@dataclass(frozen=True, eq=False)
class ConvexMesh(Value):
    """A convex polyhedron in the frame of its link [m]."""

    vertices: Float[ndarray, "v 3"]
    faces: Int[ndarray, "f 3"]


@runtime_checkable
class RigidShape(Protocol):
    """What a robot can hold: the shapes of scenes."""

    @property
    def name(self) -> str: ...

    def solid(self) -> tuple[Float[ndarray, "4 4"], tuple[ConvexMesh, ...]]:
        """Where it stands in the frame that it is given in, and convex meshes in its own that hold it."""
        ...


@dataclass(frozen=True, eq=False)
class AttachedBody(Value):
    """A body that is fixed to a link of a robot, itself a link of the name."""

    name: str
    link: str
    """The link that it is fixed to."""
    T_link_body: Float[ndarray, "4 4"]
    shapes: tuple[RigidShape, ...] = ()
    """In the frame of `link`. None: the body is a mere frame."""
    touch_links: tuple[str, ...] = ()
    """Links that it may touch, beside those that move with it anyway."""
    tool: bool = False


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
