"""Obstacle shapes in the frame of the robot's base.

The constructors check their arguments and raise InputError. The tests check the types of all arguments at run
time; `no_type_check` turns this off for these classes, so that the constructors' own errors are raised.
"""

import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import fields, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from numpy.typing import ArrayLike

from robotdiffuse.core.errors import (
    MAX_COORDINATE,
    MIN_SIZE,
    InputError,
    filled_text,
    form,
    numbers,
    points,
    positive,
    rigid_motion,
    shown,
    unit_quaternion,
    vector,
)
from robotdiffuse.core.mesh_files import read_triangles
from robotdiffuse.core.transforms import (
    box_around,
    placed,
    quaternion_from_rotation,
    rotation_from_quaternion,
    scaled_normals,
    transform,
)
from robotdiffuse.core.types import (
    GivenArray,
    GivenVector,
    Points,
    Pose,
    Rotation,
    Value,
    Values,
    frozen_dataclass,
    no_type_check,
    read_only,
)
from robotdiffuse.robots.bodies import ConvexMesh
from robotdiffuse.scenes.point_cloud import POINT_RADIUS, default_radius, distinct, read_points, voxel_thin

IDENTITY = (1.0, 0.0, 0.0, 0.0)
Corners = Float[ndarray, "2 3"]
"""Lower and upper corner of an axis-aligned box [m]."""


class Shape(Value, ABC):
    """Base class of all shapes of obstacles. `kind` is the name of the class in problem files.

    The constructors take all values that NumPy can convert to numbers, and raise InputError for other values.
    """

    kind: ClassVar[str]
    name: str

    @property
    @abstractmethod
    def area(self) -> float:
        """Surface area [m^2]."""

    @property
    @abstractmethod
    def bounds(self) -> Corners:
        """Lower and upper corner of an axis-aligned box around the shape [m]."""

    @property
    def T_base_shape(self) -> Pose:
        """Pose of the shape's own frame. Raises InputError for shapes without a pose, such as point
        clouds."""
        raise InputError(f"{self.name!r} is a {self.kind}, which has no pose; use another kind of shape")

    def moved(self, T: Pose) -> "Shape":
        """Move the shape.

        Args:
            T: The rigid motion, a homogeneous transform [4, 4].

        Returns:
            The shape after the motion. For a point cloud, `file` is None.

        Raises:
            InputError: For kinds of shapes that do not support motions, and unless T is rigid.
        """
        raise InputError(f"a {self.kind} cannot be moved; write it as a mesh")

    def solid(self) -> tuple[Pose, tuple[ConvexMesh, ...]]:
        """Enclose the shape in convex meshes, for a robot that holds it.

        The mesh of a box is exact; round shapes are enclosed by a polyhedron, and meshes by convex parts.

        Returns:
            T_base_shape [4, 4], and the meshes in the shape's own frame.

        Raises:
            InputError: For point clouds and height maps.
        """
        from robotdiffuse.scenes.convex_solids import SOLIDS  # imports SciPy, which few problems need

        if self.kind not in SOLIDS:
            raise InputError(
                f"{self.name!r} is a {self.kind}; it must be one of sphere, box, cylinder, capsule and mesh"
            )
        return self.T_base_shape, SOLIDS[self.kind](self)

    def __post_init__(self) -> None:
        """Checks the fields that `CHECKS` names. Raises InputError for the first wrong value."""
        for name in (field.name for field in fields(self)):  # type: ignore[arg-type]
            if name in CHECKS:
                object.__setattr__(self, name, CHECKS[name](self.kind, name, getattr(self, name)))
        super().__post_init__()


_vector = partial(vector, size=3)


def _size(kind: str, name: str, value: object) -> ndarray:
    size = _vector(kind, name, value)
    if (size < MIN_SIZE).any():
        raise InputError(
            f"{kind}.size is {shown(value)}; edge lengths must be positive, at least {MIN_SIZE:g} m"
        )
    return size


def _around(center: ndarray, half: ndarray | float) -> Corners:
    """Corners of the box around a center with half edges, or with a radius [m]."""
    return np.stack([center - half, center + half])


CHECKS: dict[str, Callable[[str, str, Any], Any]] = {
    "size": _size,
    "center": _vector,
    "xyz": _vector,
    "wxyz": lambda kind, name, value: unit_quaternion(kind, value),
    "radius": positive,
    "height": positive,
    "cell": positive,
    "points": points,
    "vertices": points,
    "point_radius": positive,
    "name": lambda kind, name, value: filled_text(f"{kind}.name", value, "a non-empty string"),
}
"""Checks of shapes' fields, by name of the field. Each check takes the shape's kind, the field's name and its
value. It returns the value to store, or raises InputError."""


@no_type_check
@frozen_dataclass
class Sphere(Shape):
    """A ball.

    Args:
        center: x y z in the frame of the robot's base [m].
        radius: Radius [m].
        name: Name in results, commands and allowed contacts.
    """

    center: GivenVector
    radius: float
    name: str = "sphere"
    kind: ClassVar[str] = "sphere"

    @property
    def area(self) -> float:
        return 4 * np.pi * self.radius**2

    @property
    def bounds(self) -> Corners:
        return _around(self.center, self.radius)

    @property
    def T_base_shape(self) -> Pose:
        return transform(self.center)

    def moved(self, T: Pose) -> "Shape":
        """Move the sphere.

        Args:
            T: The rigid motion, a homogeneous transform [4, 4].

        Returns:
            The sphere after the motion.

        Raises:
            InputError: Unless T is rigid.
        """
        T = rigid_motion(T)
        return replace(self, center=T[:3, :3] @ self.center + T[:3, 3])


class _Posed(Shape):
    """A shape with a frame of its own."""

    origin: ClassVar[str] = "center"
    """Name of the field with the position of the shape's frame."""
    wxyz: GivenArray

    @cached_property
    def rotation(self) -> Rotation:
        return read_only(rotation_from_quaternion(self.wxyz))

    @property
    def T_base_shape(self) -> Pose:
        return transform(getattr(self, self.origin), self.rotation)

    def moved(self, T: Pose) -> "Shape":
        T = rigid_motion(T) @ self.T_base_shape
        moved: dict[str, Any] = {self.origin: T[:3, 3], "wxyz": quaternion_from_rotation(T)}
        return replace(self, **moved)  # type: ignore[type-var]


@no_type_check
@frozen_dataclass
class Box(_Posed):
    """A box of any orientation.

    Args:
        center: Middle of the box, x y z in the frame of the robot's base [m].
        size: Full edge lengths along the box's own x, y and z [m].
        wxyz: Orientation as a quaternion, scalar first; default: along the axes of the base.
        name: Name in results, commands and allowed contacts.
    """

    center: GivenVector
    size: GivenVector
    wxyz: GivenArray = IDENTITY  # type: ignore[assignment]
    name: str = "box"
    kind: ClassVar[str] = "box"

    @property
    def area(self) -> float:
        x, y, z = self.size
        return 2 * float(x * y + y * z + z * x)

    @property
    def bounds(self) -> Corners:
        return _around(self.center, np.abs(self.rotation) @ self.size / 2)


@no_type_check
@frozen_dataclass
class Cylinder(_Posed):
    """A cylinder about its own z axis.

    Args:
        center: Middle of the cylinder, x y z in the frame of the robot's base [m].
        radius: Radius [m].
        height: Height [m].
        wxyz: Orientation as a quaternion, scalar first; default: axis along z of the base.
        name: Name in results, commands and allowed contacts.
    """

    center: GivenVector
    radius: float
    height: float
    wxyz: GivenArray = IDENTITY  # type: ignore[assignment]
    name: str = "cylinder"
    kind: ClassVar[str] = "cylinder"

    @property
    def area(self) -> float:
        return 2 * np.pi * self.radius * (self.radius + self.height)

    @property
    def bounds(self) -> Corners:
        axis = self.rotation[:, 2]
        half = np.abs(axis) * self.height / 2 + self.radius * np.sqrt(np.clip(1 - axis**2, 0, None))
        return _around(self.center, half)


@no_type_check
@frozen_dataclass
class Capsule(_Posed):
    """A cylinder about its own z axis with a half sphere at each end.

    Args:
        center: Middle of the capsule, x y z in the frame of the robot's base [m].
        radius: Radius of the cylinder and the half spheres [m].
        height: Height of the cylinder, without the half spheres [m].
        wxyz: Orientation as a quaternion, scalar first; default: axis along z of the base.
        name: Name in results, commands and allowed contacts.
    """

    center: GivenVector
    radius: float
    height: float
    wxyz: GivenArray = IDENTITY  # type: ignore[assignment]
    name: str = "capsule"
    kind: ClassVar[str] = "capsule"

    @property
    def area(self) -> float:
        return 2 * np.pi * self.radius * (2 * self.radius + self.height)

    @property
    def bounds(self) -> Corners:
        return _around(self.center, np.abs(self.rotation[:, 2]) * self.height / 2 + self.radius)


@no_type_check
@frozen_dataclass
class PointCloud(Shape):
    """A point cloud; each point is a small sphere. The cloud may be empty. `PointCloud.from_file` reads a
    file.

    Args:
        points: The points [n, 3] in the frame of the robot's base [m].
        point_radius: Radius of the sphere around each point [m].
        file: The file that the cloud was read from. A saved problem refers to this file if it still
            holds these points.
        name: Name in results, commands and allowed contacts.
    """

    points: GivenArray
    point_radius: float = POINT_RADIUS
    file: str | None = None
    name: str = "point_cloud"
    kind: ClassVar[str] = "point_cloud"

    @classmethod
    def from_file(
        cls,
        file: str | Path,
        point_radius: float | None = None,
        scale: float = 1.0,
        name: str = "point_cloud",
    ) -> "PointCloud":
        """Read a point cloud from a file.

        Points that are not finite are left out, with a warning.

        Args:
            file: A .ply, .pcd, .xyz, .csv, .npy or .npz file, or the occupied voxels of an octomap (.bt), in
                the frame of the base.
            point_radius: Radius of the sphere around each point [m]; None: 1 cm; for an octomap, the radius
                of the sphere around a voxel, multiplied by `scale`.
            scale: Meters for each unit of the file: 0.001 for millimeters.
            name: Name of the obstacle, for messages and allowed contacts.

        Returns:
            The cloud.

        Raises:
            InputError: For a file that cannot be read, or a scale or point_radius that is not positive.
        """
        points, notes = read_points(file)
        for note in notes:
            warnings.warn(note, stacklevel=2)
        scale = positive("point_cloud", "scale", scale)
        point_radius = default_radius(file, scale) if point_radius is None else point_radius
        # a scaled cloud has no `file`, since problem files cannot state its scale
        source = str(Path(file).absolute()) if scale == 1 else None
        return cls(scale * points, point_radius, source, name)

    @cached_property
    def distinct_points(self) -> Points:
        """The points without repetitions, since repeated points would slow down Coal's distances."""
        return distinct(self.points)

    @cached_property
    def area(self) -> float:
        """An estimate [m^2]: the area of one face for each occupied cell of a grid, with cells as wide as a
        point."""
        width = 2 * self.point_radius
        return len(voxel_thin(self.points, width)) * width**2

    @cached_property
    def bounds(self) -> Corners:
        if len(self.points) == 0:
            return read_only(np.zeros((2, 3)))
        low, high = box_around(self.points)
        return read_only(np.stack([low - self.point_radius, high + self.point_radius]))

    def moved(self, T: Pose) -> "Shape":
        """Move the points.

        Args:
            T: The rigid motion, a homogeneous transform [4, 4].

        Returns:
            The cloud after the motion, without its `file`.

        Raises:
            InputError: Unless T is rigid.
        """
        return replace(self, points=placed(rigid_motion(T), self.points), file=None)


class Triangulated(Shape):
    """A shape that is represented by triangles in planning, validation, sampling and drawing."""

    @property
    @abstractmethod
    def mesh(self) -> "Mesh":
        """The shape's triangles."""

    @property
    def area(self) -> float:
        return float(self.mesh.face_areas.sum())

    @property
    def bounds(self) -> Corners:
        return box_around(self.mesh.world_vertices)


@no_type_check
@frozen_dataclass
class Mesh(_Posed, Triangulated):
    """A triangle mesh. Only its surface is checked for collision, not the space inside. `Mesh.from_file`
    reads a file.

    Args:
        vertices: Vertices [n, 3] in the mesh's own frame [m].
        faces: Indices of vertices [n, 3], from 0.
        xyz: Position of the mesh's frame in the frame of the robot's base [m].
        wxyz: Orientation of the mesh's frame as a quaternion, scalar first.
        file: The file that the mesh was read from. A saved problem refers to this file if it still
            holds this mesh.
        name: Name in results, commands and allowed contacts.
    """

    vertices: GivenArray
    faces: GivenArray
    xyz: GivenVector = (0.0, 0.0, 0.0)  # type: ignore[assignment]
    wxyz: GivenArray = IDENTITY  # type: ignore[assignment]
    file: str | None = None
    name: str = "mesh"
    kind: ClassVar[str] = "mesh"
    origin: ClassVar[str] = "xyz"

    def __post_init__(self) -> None:
        super().__post_init__()
        faces = numbers(self.faces)
        if faces is None or faces.ndim != 2 or faces.shape[1] != 3 or len(faces) == 0:
            raise InputError(f"mesh.faces is {form(faces)}; it must be n x 3 indices, at least one row")
        if not (faces == np.floor(faces)).all() or faces.min() < 0 or faces.max() >= len(self.vertices):
            raise InputError(
                f"mesh.faces holds values from {faces.min():g} to {faces.max():g}; "
                f"they must be integer indices of the {len(self.vertices)} vertices"
            )
        object.__setattr__(self, "faces", read_only(faces.astype(np.int64)))

    @classmethod
    def from_file(
        cls,
        file: str | Path,
        xyz: ArrayLike = (0.0, 0.0, 0.0),
        wxyz: ArrayLike = IDENTITY,
        scale: float = 1.0,
        name: str = "mesh",
    ) -> "Mesh":
        """Read a mesh from a .dae, .glb, .gltf, .obj, .off, .ply or .stl file.

        Args:
            file: The file.
            xyz: Position of the file's frame in the frame of the base [m].
            wxyz: Orientation of the file's frame, a quaternion.
            scale: Meters for each unit of the file: 0.001 for millimeters. The <unit> of a .dae file is
                applied before, so 1 is right for such a file.
            name: Name of the obstacle, for messages and allowed contacts.

        Returns:
            The mesh, of all parts of the file.

        Raises:
            InputError: For a file that cannot be read, a scale that is not positive, and an xyz or wxyz that
                is no position or quaternion.
        """
        vertices, faces = read_triangles(file)
        scale = positive("mesh", "scale", scale)
        # a scaled mesh has no `file`, since problem files cannot state its scale
        source = str(Path(file).absolute()) if scale == 1 else None
        return cls(scale * vertices, faces, xyz, wxyz, source, name)

    @property
    def mesh(self) -> "Mesh":
        return self

    @cached_property
    def world_vertices(self) -> Points:
        """The vertices in the frame of the robot's base [m]."""
        return read_only(self.vertices @ self.rotation.T + self.xyz)

    @cached_property
    def face_areas(self) -> Values:
        return read_only(np.linalg.norm(scaled_normals(self.vertices[self.faces]), axis=1) / 2)


@no_type_check
@frozen_dataclass
class HeightMap(_Posed, Triangulated):
    """Terrain: heights at the points of a grid, joined by triangles. Only this surface is checked for
    collision.

    Args:
        heights: Heights along z [m], with rows along y and columns along x [rows, columns]. Cells with a
            height that is not a number are holes.
        cell: Distance between neighboring points of the grid [m].
        xyz: Position of the height map's frame in the frame of the robot's base [m]. The origin of the height
            map's frame is the first point of the grid, at height 0.
        wxyz: Orientation of the height map's frame as a quaternion, scalar first.
        file: The file that the heights were read from. A saved problem refers to this file if it still
            holds these heights.
        name: Name in results, commands and allowed contacts.
    """

    heights: GivenArray
    cell: float
    xyz: GivenVector = (0.0, 0.0, 0.0)  # type: ignore[assignment]
    wxyz: GivenArray = IDENTITY  # type: ignore[assignment]
    file: str | None = None
    name: str = "height_map"
    kind: ClassVar[str] = "height_map"
    origin: ClassVar[str] = "xyz"

    def __post_init__(self) -> None:
        heights = numbers(self.heights)
        if heights is None or heights.ndim != 2 or min(heights.shape) < 2:
            raise InputError(
                f"height_map.heights is {form(heights)}; it must be rows x columns, at least 2 x 2"
            )
        largest = np.nanmax(np.abs(heights), initial=0.0)
        if largest > MAX_COORDINATE:
            raise InputError(
                f"height_map.heights has a number of size {largest:g}; "
                f"all must be within ±{MAX_COORDINATE:g} m"
            )
        object.__setattr__(self, "heights", heights)
        super().__post_init__()
        if not len(self._faces):
            raise InputError("height_map.heights has no cell with heights at all four corners")

    @cached_property
    def _faces(self) -> ndarray:
        index = np.arange(self.heights.size).reshape(self.heights.shape)
        corners = [index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]]
        cells = np.stack(corners, axis=-1).reshape(-1, 4)
        cells = cells[~np.isnan(self.heights.ravel()[cells]).any(axis=1)]
        return np.concatenate([cells[:, [0, 1, 3]], cells[:, [0, 3, 2]]])

    @cached_property
    def mesh(self) -> Mesh:
        y, x = np.indices(self.heights.shape) * self.cell
        vertices = np.stack([x, y, np.nan_to_num(self.heights)], axis=-1).reshape(-1, 3)
        used, faces = np.unique(self._faces, return_inverse=True)
        return Mesh(vertices[used], faces, self.xyz, self.wxyz, name=self.name)
