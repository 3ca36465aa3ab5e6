"""Obstacle shapes in the frame of the robot's base.

The constructors check their arguments and say what is wrong, so run-time type checks (tests switch them on)
are kept off these classes by `no_type_check`.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, ClassVar, no_type_check

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from numpy.typing import ArrayLike

from robotdiffuse.core.bounds import (
    MIN_SIZE,
    Value,
    form,
    numbers,
    points,
    positive,
    read_only,
    unit_quaternion,
    vector,
)
from robotdiffuse.core.errors import InputError, shown
from robotdiffuse.core.transforms import rotation_from_quaternion, transform
from robotdiffuse.robots.bodies import ConvexMesh
from robotdiffuse.scenes.point_cloud import distinct, voxel_thin

IDENTITY = (1.0, 0.0, 0.0, 0.0)


class Shape(Value, ABC):
    """Base of all obstacles. `kind` is its name in problem files.

    The constructors take anything that NumPy reads as numbers and raise InputError for the rest.
    """

    kind: ClassVar[str]
    name: str

    @property
    @abstractmethod
    def area(self) -> float:
        """Surface [m^2]."""

    @property
    @abstractmethod
    def bounds(self) -> Float[ndarray, "2 3"]:
        """Least and greatest corner of an axis-aligned box that holds the shape [m]."""

    def moved(self, T: Float[ndarray, "4 4"]) -> "Shape":
        """The shape after a rigid motion."""
        from robotdiffuse.scenes.shape_transforms import moved

        return moved(self, T)

    def solid(self) -> tuple[Float[ndarray, "4 4"], tuple[ConvexMesh, ...]]:
        """Where it stands, and convex meshes in its own frame that hold it, for a robot that holds it."""
        from robotdiffuse.scenes.convex_solids import solid

        return solid(self)


class Triangulated(Shape):
    """A shape that is planned around, validated, sampled and drawn as its triangles: a mesh, or a new shape."""

    @property
    @abstractmethod
    def mesh(self) -> "Mesh":
        """Around the shape, in the base frame."""

    @property
    def area(self) -> float:
        return self.mesh.area

    @property
    def bounds(self) -> Float[ndarray, "2 3"]:
        return self.mesh.bounds


def _set(shape: Shape, **values: object) -> None:
    if not isinstance(shape.name, str) or not shape.name:
        raise InputError(f"{shape.kind}.name is {shown(shape.name)}; it must be a text, not empty")
    for key, value in values.items():
        object.__setattr__(shape, key, read_only(value))


@no_type_check
@dataclass(frozen=True, eq=False)
class Sphere(Shape):
    center: Float[ndarray, "3"]
    radius: float
    name: str = "sphere"
    kind: ClassVar[str] = "sphere"

    def __post_init__(self) -> None:
        _set(
            self,
            center=vector("sphere", "center", self.center, 3),
            radius=positive("sphere", "radius", self.radius),
        )

    if TYPE_CHECKING:

        def __init__(self, center: ArrayLike, radius: float, name: str = "sphere") -> None: ...

    @property
    def area(self) -> float:
        return 4 * np.pi * self.radius**2

    @property
    def bounds(self) -> Float[ndarray, "2 3"]:
        return np.stack([self.center - self.radius, self.center + self.radius])


@no_type_check
@dataclass(frozen=True, eq=False)
class Box(Shape):
    center: Float[ndarray, "3"]
    size: Float[ndarray, "3"]
    """Full edge lengths [m]."""
    wxyz: Float[ndarray, "4"] = field(default=IDENTITY)  # type: ignore[assignment]
    name: str = "box"
    kind: ClassVar[str] = "box"

    def __post_init__(self) -> None:
        size = vector("box", "size", self.size, 3)
        if (size < MIN_SIZE).any():
            raise InputError(
                f"box.size is {shown(self.size)}; edge lengths must be positive, at least {MIN_SIZE:g} m"
            )
        center = vector("box", "center", self.center, 3)
        _set(self, center=center, size=size, wxyz=unit_quaternion("box", self.wxyz))

    if TYPE_CHECKING:

        def __init__(
            self, center: ArrayLike, size: ArrayLike, wxyz: ArrayLike = IDENTITY, name: str = "box"
        ) -> None: ...

    @cached_property
    def rotation(self) -> Float[ndarray, "3 3"]:
        return read_only(rotation_from_quaternion(self.wxyz))

    @property
    def area(self) -> float:
        x, y, z = self.size
        return 2 * float(x * y + y * z + z * x)

    @property
    def bounds(self) -> Float[ndarray, "2 3"]:
        half = np.abs(self.rotation) @ self.size / 2
        return np.stack([self.center - half, self.center + half])


@no_type_check
@dataclass(frozen=True, eq=False)
class _Axial(Shape):
    center: Float[ndarray, "3"]
    radius: float
    height: float
    wxyz: Float[ndarray, "4"] = field(default=IDENTITY)  # type: ignore[assignment]

    def __post_init__(self) -> None:
        _set(
            self,
            center=vector(self.kind, "center", self.center, 3),
            radius=positive(self.kind, "radius", self.radius),
            height=positive(self.kind, "height", self.height),
            wxyz=unit_quaternion(self.kind, self.wxyz),
        )

    @cached_property
    def rotation(self) -> Float[ndarray, "3 3"]:
        return read_only(rotation_from_quaternion(self.wxyz))


@no_type_check
@dataclass(frozen=True, eq=False)
class Cylinder(_Axial):
    """A cylinder about its own z axis, `height` long."""

    name: str = "cylinder"
    kind: ClassVar[str] = "cylinder"

    if TYPE_CHECKING:

        def __init__(
            self,
            center: ArrayLike,
            radius: float,
            height: float,
            wxyz: ArrayLike = IDENTITY,
            name: str = "cylinder",
        ) -> None: ...

    @property
    def area(self) -> float:
        return 2 * np.pi * self.radius * (self.radius + self.height)

    @property
    def bounds(self) -> Float[ndarray, "2 3"]:
        axis = self.rotation[:, 2]
        half = np.abs(axis) * self.height / 2 + self.radius * np.sqrt(np.clip(1 - axis**2, 0, None))
        return np.stack([self.center - half, self.center + half])


@no_type_check
@dataclass(frozen=True, eq=False)
class Capsule(_Axial):
    """A cylinder about its own z axis, `height` long, with a half sphere at each end (outside `height`)."""

    name: str = "capsule"
    kind: ClassVar[str] = "capsule"

    if TYPE_CHECKING:

        def __init__(
            self,
            center: ArrayLike,
            radius: float,
            height: float,
            wxyz: ArrayLike = IDENTITY,
            name: str = "capsule",
        ) -> None: ...

    @property
    def area(self) -> float:
        return 2 * np.pi * self.radius * (2 * self.radius + self.height)

    @property
    def bounds(self) -> Float[ndarray, "2 3"]:
        half = np.abs(self.rotation[:, 2]) * self.height / 2 + self.radius
        return np.stack([self.center - half, self.center + half])


@no_type_check
@dataclass(frozen=True, eq=False)
class Mesh(Triangulated):
    """A triangle mesh; for collision, its surface."""

    vertices: Float[ndarray, "v 3"]
    """In the mesh's own frame [m]."""
    faces: Int[ndarray, "f 3"]
    xyz: Float[ndarray, "3"] = field(default=(0.0, 0.0, 0.0))  # type: ignore[assignment]
    wxyz: Float[ndarray, "4"] = field(default=IDENTITY)  # type: ignore[assignment]
    file: str | None = None
    """Where it was read from, for writing it back."""
    name: str = "mesh"
    kind: ClassVar[str] = "mesh"

    def __post_init__(self) -> None:
        vertices, faces = points("mesh", "vertices", self.vertices), numbers(self.faces)
        if faces is None or faces.ndim != 2 or faces.shape[1] != 3 or len(faces) == 0:
            raise InputError(f"mesh.faces is {form(faces)}; it must be n x 3 indices, at least one row")
        if not (faces == np.floor(faces)).all() or faces.min() < 0 or faces.max() >= len(vertices):
            raise InputError(
                f"mesh.faces holds values from {faces.min():g} to {faces.max():g}; "
                f"they must be indices of the {len(vertices)} vertices"
            )
        _set(
            self,
            vertices=vertices,
            faces=faces.astype(np.int64),
            xyz=vector("mesh", "xyz", self.xyz, 3),
            wxyz=unit_quaternion("mesh", self.wxyz),
        )

    if TYPE_CHECKING:

        def __init__(
            self,
            vertices: ArrayLike,
            faces: ArrayLike,
            xyz: ArrayLike = (0.0, 0.0, 0.0),
            wxyz: ArrayLike = IDENTITY,
            file: str | None = None,
            name: str = "mesh",
        ) -> None: ...

    @property
    def mesh(self) -> "Mesh":
        return self

    @cached_property
    def world_vertices(self) -> Float[ndarray, "v 3"]:
        return read_only(self.vertices @ rotation_from_quaternion(self.wxyz).T + self.xyz)

    @cached_property
    def face_areas(self) -> Float[ndarray, "f"]:
        a, b, c = np.moveaxis(self.vertices[self.faces], 1, 0)
        return read_only(np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2)

    @property
    def area(self) -> float:
        return float(self.face_areas.sum())

    @property
    def bounds(self) -> Float[ndarray, "2 3"]:
        return np.stack([self.world_vertices.min(axis=0), self.world_vertices.max(axis=0)])


@no_type_check
@dataclass(frozen=True, eq=False)
class PointCloud(Shape):
    """Points, each of them a small sphere. May be empty."""

    points: Float[ndarray, "n 3"]
    point_radius: float = 0.01
    """[m]"""
    file: str | None = None
    name: str = "point_cloud"
    kind: ClassVar[str] = "point_cloud"

    def __post_init__(self) -> None:
        _set(
            self,
            points=points("point_cloud", "points", self.points),
            point_radius=positive("point_cloud", "point_radius", self.point_radius),
        )

    if TYPE_CHECKING:

        def __init__(
            self,
            points: ArrayLike,
            point_radius: float = 0.01,
            file: str | None = None,
            name: str = "point_cloud",
        ) -> None: ...

    @cached_property
    def distinct_points(self) -> Float[ndarray, "m 3"]:
        """Without repetitions, each of which takes as long as a point of its own in Coal's tree."""
        return distinct(self.points)

    @cached_property
    def area(self) -> float:
        """An estimate: one face of each cell, as wide as a point, that holds a point [m^2]."""
        width = 2 * self.point_radius
        return len(voxel_thin(self.points, width)) * width**2

    @cached_property
    def bounds(self) -> Float[ndarray, "2 3"]:
        if len(self.points) == 0:
            return read_only(np.zeros((2, 3)))
        low, high = self.points.min(axis=0), self.points.max(axis=0)
        return read_only(np.stack([low - self.point_radius, high + self.point_radius]))


def pose(shape: Box | Cylinder | Capsule) -> Float[ndarray, "4 4"]:
    """T_base_shape of a shape with a centre and a quaternion."""
    return transform(shape.center, shape.rotation)
