"""Triangle meshes as obstacles, in the frame of the robot's base."""

from abc import abstractmethod
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, no_type_check

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from numpy.typing import ArrayLike

from robotdiffuse.core.bounds import form, numbers, points, positive, read_only, unit_quaternion, vector
from robotdiffuse.core.errors import InputError
from robotdiffuse.core.mesh_files import read_triangles
from robotdiffuse.core.transforms import quaternion_from_rotation, rotation_from_quaternion, transform
from robotdiffuse.robots.bodies import ConvexMesh
from robotdiffuse.scenes.shapes import IDENTITY, Shape, set_fields


class Triangulated(Shape):
    """A shape whose triangles are used for planning, validation, sampling and drawing."""

    @property
    @abstractmethod
    def mesh(self) -> "Mesh":
        """Triangles around the shape, in the base frame."""

    @property
    def area(self) -> float:
        return self.mesh.area

    @property
    def bounds(self) -> Float[ndarray, "2 3"]:
        return self.mesh.bounds


class PosedTriangles(Triangulated):
    """Triangles in a frame of their own, which `xyz` and `wxyz` place in the base frame."""

    xyz: Float[ndarray, "3"]
    wxyz: Float[ndarray, "4"]

    @property
    def T_base_shape(self) -> Float[ndarray, "4 4"]:
        return transform(self.xyz, rotation_from_quaternion(self.wxyz))

    def moved(self, T: Float[ndarray, "4 4"]) -> "Shape":
        T = T @ self.T_base_shape
        return replace(self, xyz=T[:3, 3], wxyz=quaternion_from_rotation(T[:3, :3]))  # type: ignore[type-var]


@no_type_check
@dataclass(frozen=True, eq=False)
class Mesh(PosedTriangles):
    """A triangle mesh. Only its surface counts for collision. `Mesh.from_file` reads one.

    vertices: n x 3, in the mesh's own frame [m].
    faces: n x 3 indices of vertices, from 0.
    xyz, wxyz: pose of the mesh's frame in the frame of the robot's base.
    name: as of Box.
    """

    vertices: Float[ndarray, "v 3"]
    """In the mesh's own frame [m]."""
    faces: Int[ndarray, "f 3"]
    xyz: Float[ndarray, "3"] = field(default=(0.0, 0.0, 0.0))  # type: ignore[assignment]
    wxyz: Float[ndarray, "4"] = field(default=IDENTITY)  # type: ignore[assignment]
    file: str | None = None
    """The file that it was read from, for writing it back."""
    name: str = "mesh"
    kind: ClassVar[str] = "mesh"

    def __post_init__(self) -> None:
        vertices = points("mesh", "vertices", self.vertices)
        faces = numbers(self.faces)
        if faces is None or faces.ndim != 2 or faces.shape[1] != 3 or len(faces) == 0:
            raise InputError(f"mesh.faces is {form(faces)}; it must be n x 3 indices, at least one row")
        if not (faces == np.floor(faces)).all() or faces.min() < 0 or faces.max() >= len(vertices):
            raise InputError(
                f"mesh.faces holds values from {faces.min():g} to {faces.max():g}; "
                f"they must be indices of the {len(vertices)} vertices"
            )
        set_fields(
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

    @classmethod
    def from_file(
        cls,
        file: str | Path,
        xyz: ArrayLike = (0.0, 0.0, 0.0),
        wxyz: ArrayLike = IDENTITY,
        scale: float = 1.0,
        name: str = "mesh",
    ) -> "Mesh":
        """The mesh of a file that trimesh reads (.stl, .obj, .ply, .dae, .glb, ...).

        Args:
            file: The file.
            xyz: Position of the file's frame in the frame of the base [m].
            wxyz: Its orientation, a quaternion.
            scale: Meters for each unit of the file: 0.001 for millimeters.
            name: Name of the obstacle, for messages and allowed contacts.

        Raises:
            InputError: For a file that cannot be read, or a scale that is not positive.
        """
        vertices, faces = read_triangles(file)
        scale = positive("mesh", "scale", scale)
        if scale == 1:
            return cls(vertices, faces, xyz, wxyz, str(Path(file).absolute()), name)
        return cls(scale * vertices, faces, xyz, wxyz, name=name)  # files of problems have no scale

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

    def _convex_meshes(self) -> tuple[ConvexMesh, ...]:
        from robotdiffuse.scenes.convex_solids import mesh_parts

        return mesh_parts(self.vertices.tobytes(), self.faces.tobytes())
