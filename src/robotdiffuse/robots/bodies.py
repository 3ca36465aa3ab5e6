"""Rigid bodies: convex meshes, and what is fixed to a link of a robot."""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

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
class Rigid(Protocol):
    """What a robot can hold: the shapes of scenes."""

    @property
    def name(self) -> str: ...

    def solid(self) -> tuple[Float[ndarray, "4 4"], tuple[ConvexMesh, ...]]:
        """Where it stands in the frame that it is given in, and convex meshes in its own that hold it."""
        ...


@dataclass(frozen=True, eq=False)
class Attached(Value):
    """A body that is fixed to a link of a robot, itself a link of the name."""

    name: str
    link: str
    """The link that it is fixed to."""
    T_link_body: Float[ndarray, "4 4"]
    shapes: tuple[Rigid, ...] = ()
    """In the frame of `link`. None: the body is a mere frame."""
    touch_links: tuple[str, ...] = ()
    """Links that it may touch, beside those that move with it anyway."""
    tool: bool = False
