"""The surfaces of sets of voxels, as faces between two voxels of which one belongs to the set.

A face has one number: axis · voxels + the flat index of the voxel before it along that axis.
"""

import numpy as np
from jaxtyping import Bool, Int
from numpy import ndarray

from robotdiffuse.perception.occupancy_map import MAP
from robotdiffuse.visualization.style import Surface


def faces_between(
    inside: Bool[ndarray, "nx ny nz"], outside: Bool[ndarray, "nx ny nz"]
) -> tuple[Int[ndarray, "n"], Bool[ndarray, "n"]]:
    """The faces between a voxel of one set and one of another, in order, and whether the one inside comes
    first along the axis."""
    numbers, first = [], []
    for axis in range(3):
        before = [slice(None)] * 3
        after = [slice(None)] * 3
        before[axis], after[axis] = slice(None, -1), slice(1, None)
        forward = np.zeros(inside.shape, np.bool_)
        backward = forward.copy()
        forward[tuple(before)] = inside[tuple(before)] & outside[tuple(after)]
        backward[tuple(before)] = outside[tuple(before)] & inside[tuple(after)]
        found = np.flatnonzero(forward | backward)
        numbers.append(found + axis * inside.size)
        first.append(forward.reshape(-1)[found])
    return np.concatenate(numbers), np.concatenate(first)


def faces_surface(
    inside: Bool[ndarray, "nx ny nz"], outside: Bool[ndarray, "nx ny nz"], color: tuple[int, int, int]
) -> Surface:
    """The faces between two sets of voxels, of a map, as a surface in the base frame; normals
    point out of the set inside, and corners are counterclockwise as seen from there."""
    numbers, first = faces_between(inside, outside)
    axis, flat = np.divmod(numbers, inside.size)
    at = np.stack(np.unravel_index(flat, inside.shape), axis=1)
    along, across, up = (np.eye(3)[(axis + k) % 3] for k in range(3))
    corner = at + along
    vertices = np.stack([corner, corner + across, corner + across + up, corner + up], axis=1)
    normals = np.where(first[:, None], along, -along)
    one = np.array([[0, 1, 2], [0, 2, 3]])
    wound = np.where(first[:, None, None], one, one[:, ::-1])
    faces = (4 * np.arange(len(numbers))[:, None, None] + wound).reshape(-1, 3)
    vertices = vertices.reshape(-1, 3) * MAP.edge + MAP.low
    return Surface(
        vertices, normals.repeat(4, axis=0), np.tile(np.array(color) / 255.0, (len(vertices), 1)), faces
    )
