"""Scenes of spheres and boxes as arrays: what data sets hold, and what training reads many of at once."""

import numpy as np
from jaxtyping import Float32, Int8
from numpy import ndarray

from robotdiffuse.errors import InputError
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.shapes import Box, Shape, Sphere

NONE, SPHERE, BOX = 0, 1, 2
"""Kinds of packed shapes. Parameters of a sphere: center, radius; of a box: center, size, wxyz."""
PARAMETERS = 10


def pack_scene(scene: Scene, slots: int) -> tuple[Int8[ndarray, "k"], Float32[ndarray, "k 10"]]:
    """A scene of spheres and boxes as two arrays of `slots` rows: kinds, and parameters in float32.

    Kind 1 is a sphere: center, radius; 2 a box: center, size, wxyz; 0 an empty row; rows are filled up with
    zeros. Raises InputError for other shapes and if there are more shapes than slots.
    """
    if len(scene.shapes) > slots:
        raise InputError(f"the scene has {len(scene.shapes)} shapes; there are {slots} slots")
    kinds, params = np.full(slots, NONE, np.int8), np.zeros((slots, PARAMETERS), np.float32)
    for i, shape in enumerate(scene.shapes):
        params[i, :3] = getattr(shape, "center", 0)
        if isinstance(shape, Sphere):
            kinds[i], params[i, 3] = SPHERE, shape.radius
        elif isinstance(shape, Box):
            kinds[i], params[i, 3:6], params[i, 6:] = BOX, shape.size, shape.wxyz
        else:
            raise InputError(f"{shape.name} is a {shape.kind}; only spheres and boxes can be packed")
    return kinds, params


def unpack_scene(kinds: Int8[ndarray, "k"], params: Float32[ndarray, "k 10"]) -> Scene:
    """The scene of `pack_scene`, exact up to float32; names are lost."""
    shapes: list[Shape] = []
    for kind, row in zip(kinds, params, strict=True):
        if kind == SPHERE:
            shapes.append(Sphere(row[:3], row[3]))
        elif kind == BOX:
            shapes.append(Box(row[:3], row[3:6], row[6:]))
    return Scene(shapes)
