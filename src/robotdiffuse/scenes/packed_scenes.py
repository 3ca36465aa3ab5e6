"""Scenes of spheres and boxes, packed in arrays for data sets and for training batches."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Float32, Int, Int8
from numpy import ndarray

from robotdiffuse.core.errors import InputError
from robotdiffuse.core.types import Mask, frozen_dataclass
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.shapes import Box, Shape, Sphere

# values of `PackedScenes.kinds`; NONE is an empty row
NONE = 0
SPHERE = 1
BOX = 2
PARAMETERS = 10
"""Number of parameters of a shape; see `PackedScenes.params`."""


@frozen_dataclass
class PackedScenes:
    """n scenes of at most k spheres and boxes each, with an optional floor. Lengths are in [m].

    `surface_clouds` samples point clouds on the spheres and boxes.
    """

    kinds: Int8[ndarray, "n k"]
    """SPHERE, BOX or NONE."""
    params: Float32[ndarray, "n k 10"]
    """Parameters of a sphere: center, radius. Of a box: center, size, wxyz. Other entries are zero."""
    floors: Float[ndarray, "n 6"] | None = None
    """Center and size of each scene's floor, zeros for a scene without a floor; None if no scene has one.
    Floors do not count as obstacles: point clouds leave them out, and `turned` does not turn them."""

    def __len__(self) -> int:
        return len(self.kinds)

    def __getitem__(self, rows: slice | Int[ndarray, "m"] | Mask) -> "PackedScenes":
        floors = None if self.floors is None else self.floors[rows]
        return PackedScenes(self.kinds[rows], self.params[rows], floors)

    @staticmethod
    def pack(scenes: Sequence[Scene], slots: int, floor: bool = False) -> "PackedScenes":
        """Packs scenes, with room for `slots` shapes in each. With `floor`, the first shape of each scene is
        its floor.

        Raises InputError for shapes other than spheres and boxes, for scenes with more than `slots` shapes
        (the floor not counted), and for floors that are not boxes without rotation.
        """
        kinds = np.full((len(scenes), slots), NONE, np.int8)
        params = np.zeros((len(scenes), slots, PARAMETERS), np.float32)
        for scene, kind, row in zip(scenes, kinds, params, strict=True):
            shapes = scene.shapes[floor:]
            if len(shapes) > slots:
                raise InputError(f"the scene has {len(shapes)} shapes; there are {slots} slots")
            for i, shape in enumerate(shapes):
                row[i, :3] = getattr(shape, "center", 0)
                if isinstance(shape, Sphere):
                    kind[i] = SPHERE
                    row[i, 3] = shape.radius
                elif isinstance(shape, Box):
                    kind[i] = BOX
                    row[i, 3:6] = shape.size
                    row[i, 6:] = shape.wxyz
                else:
                    raise InputError(f"{shape.name} is a {shape.kind}; only spheres and boxes can be packed")
        floors = np.array([floor_row(s.shapes[0]) for s in scenes]).reshape(-1, 6) if floor else None
        return PackedScenes(kinds, params, floors)

    @staticmethod
    def joined(parts: Sequence["PackedScenes"]) -> "PackedScenes":
        """All scenes of several PackedScenes, in order. Either all parts or none must have `floors`."""
        kinds, params = (np.concatenate([getattr(p, name) for p in parts]) for name in ("kinds", "params"))
        floors = [p.floors for p in parts if p.floors is not None]
        return PackedScenes(kinds, params, np.concatenate(floors) if floors else None)

    def floor(self, i: int) -> Box | None:
        """The floor of scene i; None if the scene has no floor."""
        if self.floors is None or not self.floors[i].any():
            return None
        return Box(self.floors[i, :3], self.floors[i, 3:], name="floor")

    def scene(self, i: int) -> Scene:
        """Scene i, with its floor as the first shape. Values are rounded to float32, and names are lost."""
        floor = self.floor(i)
        shapes: list[Shape] = [] if floor is None else [floor]
        for kind, row in zip(self.kinds[i], self.params[i], strict=True):
            if kind == SPHERE:
                shapes.append(Sphere(row[:3], row[3]))
            elif kind == BOX:
                shapes.append(Box(row[:3], row[3:6], row[6:]))
        return Scene(shapes)

    def turned(self, angle: Float32[ndarray, "n"]) -> "PackedScenes":
        """The scenes, each turned about the z axis by its angle [rad]; floors are not turned."""
        params = self.params.copy()
        c = np.cos(angle)[:, None]
        s = np.sin(angle)[:, None]
        x = params[..., 0].copy()
        y = params[..., 1].copy()
        params[..., 0] = c * x - s * y
        params[..., 1] = s * x + c * y
        # quaternion product of the turn, (cos, 0, 0, sin) of half the angle, and the obstacle's orientation
        c = np.cos(angle / 2)[:, None]
        s = np.sin(angle / 2)[:, None]
        w, i, j, k = np.moveaxis(params[..., 6:].copy(), -1, 0)
        params[..., 6:] = np.stack([c * w - s * k, c * i - s * j, c * j + s * i, c * k + s * w], -1)
        return PackedScenes(self.kinds, params, self.floors)


def floor_row(floor: Shape | None) -> Float[ndarray, "6"]:
    """A row of `PackedScenes.floors`; zeros for None. Raises InputError unless the floor is a box without
    rotation."""
    if floor is None:
        return np.zeros(6)
    if not isinstance(floor, Box) or floor.wxyz[0] != 1:
        raise InputError(f"the floor {floor.name} is a {floor.kind}; it must be a box without rotation")
    return np.concatenate([floor.center, floor.size])
