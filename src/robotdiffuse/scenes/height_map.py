"""HeightMap: terrain as a grid of heights."""

from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, ClassVar, no_type_check

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from numpy.typing import ArrayLike

from robotdiffuse.core.bounds import MAX_COORDINATE, form, numbers, positive, unit_quaternion, vector
from robotdiffuse.core.errors import InputError
from robotdiffuse.scenes.mesh import Mesh, PosedTriangles
from robotdiffuse.scenes.shapes import IDENTITY, set_fields


@no_type_check
@dataclass(frozen=True, eq=False)
class HeightMap(PosedTriangles):
    """Terrain: heights at the points of a grid, joined by triangles. Only this surface counts for collision.

    heights: rows along y, columns along x, above `xyz` along z [m]; cells with a height that is not a number
        are holes.
    cell: distance between neighbouring points [m].
    xyz, wxyz: pose of the first height's point at height 0 in the frame of the robot's base.
    name: as of Box.
    """

    heights: Float[ndarray, "rows columns"]
    cell: float
    xyz: Float[ndarray, "3"] = field(default=(0.0, 0.0, 0.0))  # type: ignore[assignment]
    wxyz: Float[ndarray, "4"] = field(default=IDENTITY)  # type: ignore[assignment]
    file: str | None = None
    """The file that it was read from, for writing it back."""
    name: str = "height_map"
    kind: ClassVar[str] = "height_map"

    def __post_init__(self) -> None:
        heights = numbers(self.heights)
        if heights is None or heights.ndim != 2 or min(heights.shape) < 2:
            raise InputError(
                f"height_map.heights is {form(heights)}; it must be rows x columns, at least 2 x 2"
            )
        known = np.abs(heights[~np.isnan(heights)])
        if not (known <= MAX_COORDINATE).all():
            raise InputError(f"height_map.heights has numbers that are not within ±{MAX_COORDINATE:g} m")
        set_fields(
            self,
            heights=heights,
            cell=positive("height_map", "cell", self.cell),
            xyz=vector("height_map", "xyz", self.xyz, 3),
            wxyz=unit_quaternion("height_map", self.wxyz),
        )
        if not len(self._faces):
            raise InputError("height_map.heights has no cell of four heights")

    if TYPE_CHECKING:

        def __init__(
            self,
            heights: ArrayLike,
            cell: float,
            xyz: ArrayLike = (0.0, 0.0, 0.0),
            wxyz: ArrayLike = IDENTITY,
            file: str | None = None,
            name: str = "height_map",
        ) -> None: ...

    @property
    def _faces(self) -> ndarray:
        rows, columns = self.heights.shape
        corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
        whole = ~np.isnan(self.heights)
        whole = (whole[:-1, :-1] & whole[1:, :-1] & whole[:-1, 1:] & whole[1:, 1:]).ravel()
        a = corner[whole]
        b = a + 1
        c = a + columns
        d = a + columns + 1
        return np.concatenate([np.column_stack([a, b, d]), np.column_stack([a, d, c])])

    @cached_property
    def mesh(self) -> Mesh:
        rows, columns = self.heights.shape
        y, x = np.meshgrid(np.arange(rows) * self.cell, np.arange(columns) * self.cell, indexing="ij")
        vertices = np.stack([x, y, np.nan_to_num(self.heights)], axis=-1).reshape(-1, 3)
        used, faces = np.unique(self._faces, return_inverse=True)
        return Mesh(vertices[used], faces.reshape(-1, 3), self.xyz, self.wxyz, name=self.name)
