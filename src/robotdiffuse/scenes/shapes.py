"""Obstacle shapes in the frame of the robot's base."""

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from robotdiffuse.errors import InputError
from robotdiffuse.transforms import rotation_from_quaternion, transform

IDENTITY = (1.0, 0.0, 0.0, 0.0)


def _vector(shape: str, name: str, value: object, size: int) -> ndarray:
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError(f"{shape}.{name} is {value!r}; it must be {size} numbers") from None
    if array.shape != (size,) or not np.isfinite(array).all():
        raise InputError(f"{shape}.{name} is {value!r}; it must be {size} finite numbers")
    return array


def _positive(shape: str, name: str, value: object) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float | np.number):
        raise InputError(f"{shape}.{name} is {value!r}; it must be a positive number")
    if not (np.isfinite(value) and value > 0):
        raise InputError(f"{shape}.{name} is {value!r}; it must be a positive number")
    return float(value)


def _quaternion(shape: str, value: object) -> ndarray:
    wxyz = _vector(shape, "wxyz", value, 4)
    if np.linalg.norm(wxyz) < 1e-6:
        raise InputError(f"{shape}.wxyz is {value!r}; a quaternion must not be zero")
    return wxyz / np.linalg.norm(wxyz)


class Shape:
    """Base of all obstacles. `kind` is its name in problem files."""

    kind: ClassVar[str]
    name: str


def _set(shape: Shape, **values: object) -> None:
    for key, value in values.items():
        object.__setattr__(shape, key, value)


@dataclass(frozen=True, eq=False)
class Sphere(Shape):
    center: Float[ndarray, "3"]
    radius: float
    name: str = "sphere"
    kind: ClassVar[str] = "sphere"

    def __post_init__(self) -> None:
        _set(
            self,
            center=_vector("sphere", "center", self.center, 3),
            radius=_positive("sphere", "radius", self.radius),
        )


@dataclass(frozen=True, eq=False)
class Box(Shape):
    center: Float[ndarray, "3"]
    size: Float[ndarray, "3"]
    """Full edge lengths [m]."""
    wxyz: Float[ndarray, "4"] = field(default=IDENTITY)  # type: ignore[assignment]
    name: str = "box"
    kind: ClassVar[str] = "box"

    def __post_init__(self) -> None:
        size = _vector("box", "size", self.size, 3)
        if (size <= 0).any():
            raise InputError(f"box.size is {self.size!r}; edge lengths must be positive")
        center = _vector("box", "center", self.center, 3)
        _set(self, center=center, size=size, wxyz=_quaternion("box", self.wxyz))


@dataclass(frozen=True, eq=False)
class _Axial(Shape):
    center: Float[ndarray, "3"]
    radius: float
    height: float
    wxyz: Float[ndarray, "4"] = field(default=IDENTITY)  # type: ignore[assignment]

    def __post_init__(self) -> None:
        _set(
            self,
            center=_vector(self.kind, "center", self.center, 3),
            radius=_positive(self.kind, "radius", self.radius),
            height=_positive(self.kind, "height", self.height),
            wxyz=_quaternion(self.kind, self.wxyz),
        )


@dataclass(frozen=True, eq=False)
class Cylinder(_Axial):
    """A cylinder about its own z axis, `height` long."""

    name: str = "cylinder"
    kind: ClassVar[str] = "cylinder"


@dataclass(frozen=True, eq=False)
class Capsule(_Axial):
    """A cylinder about its own z axis, `height` long, with a half sphere at each end (outside `height`)."""

    name: str = "capsule"
    kind: ClassVar[str] = "capsule"


@dataclass(frozen=True, eq=False)
class Mesh(Shape):
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
        vertices, faces = np.asarray(self.vertices, np.float64), np.asarray(self.faces, np.int64)
        if vertices.ndim != 2 or vertices.shape[1] != 3 or not np.isfinite(vertices).all():
            raise InputError(f"mesh.vertices has shape {vertices.shape}; it must be n x 3 finite numbers")
        if faces.ndim != 2 or faces.shape[1] != 3 or len(faces) == 0:
            raise InputError(f"mesh.faces has shape {faces.shape}; it must be n x 3 indices, at least one row")
        if faces.min() < 0 or faces.max() >= len(vertices):
            raise InputError(f"mesh.faces holds index {faces.max()}; there are {len(vertices)} vertices")
        _set(
            self,
            vertices=vertices,
            faces=faces,
            xyz=_vector("mesh", "xyz", self.xyz, 3),
            wxyz=_quaternion("mesh", self.wxyz),
        )

    @property
    def world_vertices(self) -> Float[ndarray, "v 3"]:
        return self.vertices @ rotation_from_quaternion(self.wxyz).T + self.xyz


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
        points = np.asarray(self.points, np.float64)
        if points.size == 0:
            points = points.reshape(0, 3)
        if points.ndim != 2 or points.shape[1] != 3:
            raise InputError(f"point_cloud.points has shape {points.shape}; it must be n x 3")
        if not np.isfinite(points).all():
            bad = int((~np.isfinite(points).all(axis=1)).sum())
            raise InputError(f"point_cloud.points holds {bad} points that are not finite; remove them")
        _set(self, points=points, point_radius=_positive("point_cloud", "point_radius", self.point_radius))


def pose(shape: Box | Cylinder | Capsule) -> Float[ndarray, "4 4"]:
    """T_base_shape of a shape with a centre and a quaternion."""
    return transform(shape.center, rotation_from_quaternion(shape.wxyz))
