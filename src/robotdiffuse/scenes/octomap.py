"""Reads the occupied voxels of OctoMap's binary files (.bt) and messages.

The file format: a header of text up to the line `data`, then the tree, depth first. Each inner node has two
bytes, two bits for each of its eight children: 0 unknown, 1 free, 2 occupied, 3 an inner node that follows.
Bits 0, 1 and 2 of a child's number say whether it is the upper one in x, y and z.
See OccupancyOcTreeBase::writeBinaryNode of https://github.com/OctoMap/octomap.
"""

from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.core.errors import InputError, shown
from robotdiffuse.core.input_files import read_bytes

FIRST_LINE = b"# Octomap OcTree binary file"
TREE_DEPTH = 16
"""Levels below the root; the root's edge is 2^16 voxels."""
# Values of a child's two bits.
OCCUPIED = 2
INNER = 3
MAX_VOXELS = 5_000_000


def read_octomap(file: str | Path) -> tuple[Float[ndarray, "n 3"], float]:
    """The centres of a .bt file's occupied voxels [m], and their edge [m].

    Of occupied leaves above the lowest level, the voxels at their surface. Raises InputError for a file that
    is not of this format, or damaged.
    """
    content = read_bytes(file, "octomap")
    header, found, data = content.partition(b"\ndata\n")
    if not content.startswith(FIRST_LINE) or not found:
        raise InputError(f"octomap {file} is no binary OctoMap file (.bt), as octomap_saver writes it")
    fields = dict(
        line.split(maxsplit=1)
        for line in header.decode("ascii", "replace").split("\n")
        if len(line.split()) > 1
    )
    if fields.get("id") != "OcTree":
        raise InputError(f"octomap {file} holds {shown(fields.get('id'))}; it must be an OcTree")
    try:
        edge = float(fields.get("res", ""))
        return occupied_voxels(data, edge), edge
    except ValueError as error:
        raise InputError(f"octomap {file} is damaged: {error}") from None


def cover_radius(edge: float) -> float:
    """Radius of the sphere around a voxel [m]."""
    return edge * np.sqrt(3) / 2


def occupied_voxels(data: bytes, edge: float) -> Float[ndarray, "n 3"]:
    """The centres of the occupied voxels of a tree in OctoMap's binary format [m].

    Raises InputError for data that end too soon, a tree that is too deep or has too many voxels, and an edge
    that is not positive.
    """
    if not (np.isfinite(edge) and edge > 0):
        raise InputError(f"the resolution is {edge}; it must be a positive number [m]")
    centers: list[ndarray] = []
    count = 0
    at = 0
    waiting = [(np.zeros(3), TREE_DEPTH)]  # inner nodes to read: centre and level, the next one last
    while waiting and data:
        center, level = waiting.pop()
        if at + 2 > len(data) or level == 0:
            raise InputError(
                "the tree ends too soon" if level else f"the tree is deeper than {TREE_DEPTH} levels"
            )
        bits = int.from_bytes(data[at : at + 2], "little")
        at += 2
        inner = []
        for child in range(8):
            state = (bits >> 2 * child) & 3
            upper = np.array([child & 1, child >> 1 & 1, child >> 2 & 1])
            middle = center + (upper - 0.5) * edge * 2 ** (level - 1)
            if state == INNER:
                inner.append((middle, level - 1))
            elif state == OCCUPIED:
                voxels = _shell(level - 1) * edge + middle
                count += len(voxels)
                if count > MAX_VOXELS:
                    raise InputError(f"the tree has more than {MAX_VOXELS:,} occupied voxels")
                centers.append(voxels)
        waiting += reversed(inner)
    return np.concatenate(centers) if centers else np.zeros((0, 3))


def _shell(level: int) -> Float[ndarray, "n 3"]:
    """Centres of the voxels at the surface of a cube of 2^level voxels, about its middle, in voxels."""
    n = 2**level
    if 6 * n**2 > MAX_VOXELS:
        raise InputError(f"the tree has more than {MAX_VOXELS:,} occupied voxels")
    at = np.arange(n) - (n - 1) / 2
    ends = np.unique(at[[0, -1]])
    inner = at[1:-1]
    blocks = [(ends, at, at), (inner, ends, at), (inner, inner, ends)]
    return np.concatenate([np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 3) for axes in blocks])
