"""Reads, downsamples and crops point clouds; reads OctoMap's binary files (.bt).

OctoMap's binary format is a header of text up to the line `data`, then the tree, depth first. Each inner node
is two bytes, with two bits for each of its eight children: 0 unknown, 1 free, 2 occupied, 3 an inner node,
which follows. Bit 0, 1 or 2 of a child's number is set if the child is in the upper half along x, y or z. See
OccupancyOcTreeBase::writeBinaryNode of https://github.com/OctoMap/octomap.
"""

import io
import math
import re
import struct
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy import ndarray

from robotdiffuse.core.errors import InputError, positive, reading, shown
from robotdiffuse.core.files import file_name, input_file, known_ending, read_array, read_bytes
from robotdiffuse.core.mesh_files import check_ply
from robotdiffuse.core.types import Points, Vector

FIRST_LINE = b"# Octomap OcTree binary file"
TREE_DEPTH = 16
"""Number of levels of the tree below the root; the edge of the root is 2^16 voxels."""
# values of a child's two bits
OCCUPIED = 2
INNER = 3
MAX_VOXELS = 5_000_000
"""Largest number of occupied voxels that are read from a tree."""


def read_octomap(file: str | Path) -> tuple[Points, float]:
    """The centers of a .bt file's occupied voxels [m], and the edge of a voxel [m].

    An occupied leaf above the lowest level is a cube of voxels, of which only the voxels at the surface are
    returned. Raises InputError for a file that is missing, not of this format or damaged, and for more than
    MAX_VOXELS occupied voxels.
    """
    content = read_bytes(file, "octomap")
    header, separator, data = content.partition(b"\ndata\n")
    if not content.startswith(FIRST_LINE) or not separator:
        raise InputError(f"octomap {file} is no binary OctoMap file (.bt), as octomap_saver writes it")
    fields = dict(
        line.split(maxsplit=1)
        for line in header.decode("ascii", "replace").split("\n")
        if len(line.split()) > 1
    )
    for word in ("id", "res"):
        if word not in fields:
            raise InputError(f"octomap {file} is damaged: its header has no value of {word}")
    if fields["id"] != "OcTree":
        raise InputError(f"octomap {file} holds {shown(fields['id'])}; it must be an OcTree")
    try:
        if not data and fields.get("size", "0") != "0":
            raise InputError("the tree ends too soon")
        edge = float(fields["res"])
        return occupied_voxels(data, edge), edge
    except ValueError as error:
        raise InputError(f"octomap {file} cannot be read: {error}") from None


def cover_radius(edge: float) -> float:
    """Radius of the sphere around a voxel with this edge [m]."""
    return edge * np.sqrt(3) / 2


def occupied_voxels(data: bytes, edge: float) -> Points:
    """The centers of the occupied voxels of a tree in OctoMap's binary format [m]. Of larger cubes, only
    the voxels at the surface are returned, as in `read_octomap`.

    Raises InputError for data that end too soon, a tree that is too deep or has too many voxels, and an edge
    that is not positive.
    """
    if not (np.isfinite(edge) and edge > 0):
        raise InputError(f"the resolution is {edge}; it must be a positive number [m]")
    centers = list[ndarray]()
    count = 0
    at = 0
    waiting = [(np.zeros(3), TREE_DEPTH)]  # stack of inner nodes to read: center and level
    while waiting and data:
        center, level = waiting.pop()
        if at + 2 > len(data) or level == 0:
            raise InputError(
                "the tree ends too soon" if level else f"the tree is deeper than {TREE_DEPTH} levels"
            )
        bits = int.from_bytes(data[at : at + 2], "little")
        at += 2
        inner_nodes = []
        for child in range(8):
            state = (bits >> 2 * child) & 3
            upper = np.array([child & 1, child >> 1 & 1, child >> 2 & 1])
            middle = center + (upper - 0.5) * edge * 2 ** (level - 1)
            if state == INNER:
                inner_nodes.append((middle, level - 1))
            elif state == OCCUPIED:
                voxels = _shell(level - 1) * edge + middle
                count += len(voxels)
                if count > MAX_VOXELS:
                    raise InputError(f"the tree has more than {MAX_VOXELS:,} occupied voxels")
                centers.append(voxels)
        waiting += reversed(inner_nodes)
    return np.concatenate(centers) if centers else np.zeros((0, 3))


def _shell(level: int) -> Points:
    """Centers of the voxels at the surface of a cube with an edge of 2^level voxels, relative to the cube's
    middle [voxels]."""
    n = 2**level
    if 6 * n**2 > MAX_VOXELS:
        raise InputError(f"the tree has more than {MAX_VOXELS:,} occupied voxels")
    coordinates = np.arange(n) - (n - 1) / 2
    ends = np.unique(coordinates[[0, -1]])
    interior = coordinates[1:-1]
    blocks = [(ends, coordinates, coordinates), (interior, ends, coordinates), (interior, interior, ends)]
    return np.concatenate([np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 3) for axes in blocks])


UTF8 = "utf-8-sig"
"""The encoding of texts, with or without a byte order mark."""
POINT_RADIUS = 0.01
"""Default radius of points [m]."""
MAX_COLUMNS = 1000
"""Arrays with more columns are refused, since they seem to hold the points as columns."""


def grouped(numbers: ndarray) -> tuple[ndarray, ndarray]:
    """The indices that sort integers, those of equal ones in order; and where each new integer begins among
    them.

    Each integer and its index, which must fit into 62 bits together, are packed into one integer: sorting
    these is several times faster than argsort and np.unique.
    """
    bits = len(numbers).bit_length()
    packed = np.sort((numbers << bits) | np.arange(len(numbers)))
    return packed & ((1 << bits) - 1), np.flatnonzero(np.diff(packed >> bits, prepend=-1))


def voxel_thin(points: Points, voxel: float) -> Points:
    """The first point of every occupied cell of a grid with cells `voxel` wide [m], in the original order.

    Every removed point is less than sqrt(3) * voxel away from a remaining point.
    """
    voxel = positive("voxel_thin", "voxel", voxel)
    if len(points) == 0:
        return points
    cells = np.floor(points * (1 / voxel))
    cells -= cells.min(axis=0)
    extent = cells.max(axis=0) + 1
    if extent.prod() * 2.0 ** len(points).bit_length() < 2.0**62 and extent.prod() < 2.0**53:
        cell_number = (cells @ np.array([extent[1] * extent[2], extent[2], 1.0])).astype(np.int64)
        order, starts = grouped(cell_number)
        first_indices = order[starts]
    else:
        first_indices = np.unique(cells, axis=0, return_index=True)[1]
    return points[np.sort(first_indices)]


def distinct(points: Points) -> Points:
    """The points without repetitions, in the original order. If no point is repeated, the same array is
    returned."""
    order = np.lexsort(points.T)
    ordered = points[order]
    first = np.ones(len(points), bool)
    first[1:] = (ordered[1:] != ordered[:-1]).any(axis=1)
    return points if first.all() else points[np.sort(order[first])]


def crop(points: Points, center: Vector, reach: float) -> Points:
    """The points within `reach` of `center` [m]."""
    return points[((points - center) ** 2).sum(axis=1) <= reach**2]


def read_points(file: str | Path) -> tuple[Points, tuple[str, ...]]:
    """The points of a .ply, .pcd, .xyz, .csv, .npy, .npz or .bt file [m], and notes on removed points.

    Points that are not finite (missing returns of a depth camera) are removed, with a note. Columns are found
    by the names x, y and z if the file names them; otherwise, the first three are read. A file without points
    gives an empty array and a note. Raises InputError if the file is missing, has no bytes, or is not a point
    cloud.
    """
    file = file_name(file)
    reader = READERS[known_ending(file, "point cloud", READERS)]
    if input_file(file, "point cloud file").stat().st_size == 0:
        raise InputError(f"point cloud file {file} is empty")
    with reading(f"point cloud file {file}"):
        points = np.asarray(reader(file))
    if points.size == 0:
        return np.zeros((0, 3)), (f"{file} holds no points",)
    if points.dtype.kind not in "iuf" or points.ndim != 2 or not 3 <= points.shape[1] <= MAX_COLUMNS:
        shape = " x ".join(map(str, points.shape))
        raise InputError(
            f"point cloud file {file} holds {points.dtype} of {shape}; it must be numbers, n x 3"
        )
    points = np.ascontiguousarray(points[:, :3], np.float64)
    finite = np.isfinite(points).all(axis=1)
    if finite.all():
        return points, ()
    removed = int((~finite).sum())
    return points[finite], (f"{file}: {removed} of {len(points)} points are not finite and were removed",)


def _read_ply(file: Path) -> ndarray:
    from trimesh.exchange.ply import load_ply

    content = file.read_bytes()
    check_ply(content)
    return load_ply(io.BytesIO(content)).get("vertices", np.zeros((0, 3)))


def _read_text(file: Path) -> ndarray:
    """Columns of numbers, separated by commas or blanks. The first line may be a header with the names of the
    columns."""
    with file.open(encoding=UTF8) as stream:
        lines = ((number, line) for number, line in enumerate(stream) if line.strip())
        at, first = next(lines, (0, ""))
        following = ""
        for number, line in lines:
            if line.lstrip()[0] not in "#/":
                following = line
                break
            # of several comments, one may name the columns
            if first.lstrip()[0] in "#/" and {"x", "y", "z"} <= {*_names(line)}:
                at, first = number, line
    names = _names(first)
    header = False
    try:
        float(names[0] if names else "")
    except ValueError:
        header = True
    named = {"x", "y", "z"} & {*names}
    if header and len(named) < 3 and (named or len(names) > 3) and first[0] not in "#/":
        raise InputError(f"it has the columns {shown(names)}; it must have x, y and z")
    columns = [names.index(axis) for axis in "xyz"] if header and len(named) == 3 else None
    if header and not following:
        return np.zeros((0, 3))
    delimiter = _delimiter(following if header else first)
    skipped = at + int(header)
    options: dict[str, Any] = {
        "delimiter": delimiter,
        "skiprows": skipped,
        "usecols": columns,
        "ndmin": 2,
        "encoding": UTF8,
        "quotechar": '"',
    }
    try:
        return np.loadtxt(file, **options)
    except ValueError:  # slower: empty cells are missing measurements
        return np.loadtxt(file, converters=lambda text: float(text.strip() or "nan"), **options)


def _names(line: str) -> list[str]:
    return [name.strip().strip('"').lower() for name in line.lstrip("#/ ").split(_delimiter(line))]


def _delimiter(line: str) -> str | None:
    return "," if "," in line else None


def _read_pcd(file: Path) -> ndarray:
    """PCD version 0.7: https://pointclouds.org/documentation/tutorials/pcd_file_format.html"""
    content = file.read_bytes()
    match = re.search(rb"^DATA[ \t]+\S[^\n]*(\n|\Z)", content, re.MULTILINE)
    at = match.end() if match else 0
    lines = map(str.split, content[:at].decode("ascii").splitlines())
    header = {words[0]: words[1:] for words in lines if words}
    names = header["FIELDS"]
    storage = header["DATA"][0]
    counts = [int(count) for count in header.get("COUNT", ["1"] * len(names))]
    if not {"x", "y", "z"} <= {*names}:
        raise InputError(f"it has the fields {shown(names)}; it must have x, y and z")
    total = int(header["POINTS"][0])
    sides = [int(header[side][0]) for side in ("WIDTH", "HEIGHT") if header.get(side)]
    if total < 0 or (sides and math.prod(sides) != total):
        size = " x ".join(map(str, sides))
        raise InputError(f"it has {total} POINTS; it must be WIDTH x HEIGHT, {size}")
    if storage == "ascii":
        places = [sum(counts[: names.index(axis)]) for axis in "xyz"]
        rows = [row for row in content[at:].decode("ascii").splitlines() if row.strip()]
        if len(rows) != total:
            raise InputError(f"it holds {len(rows)} of its {total} points")
        return np.loadtxt(rows, usecols=places, ndmin=2, comments=None) if total else np.zeros((0, 3))
    if storage not in ("binary", "binary_compressed"):
        advice = "it must be ascii, binary or binary_compressed"
        raise InputError(f"it is stored as {shown(storage)}; {advice}")
    fields = zip(header["TYPE"], header["SIZE"], counts, strict=True)
    # Fields are named by position: PCL writes several padding fields that are all called "_".
    record = np.dtype([(str(i), f"<{kind.lower()}{size}", (n,)) for i, (kind, size, n) in enumerate(fields)])
    places = [names.index(axis) for axis in "xyz"]
    if storage == "binary":
        points = np.frombuffer(content, record, total, at)
        columns = [points[str(i)] for i in places]
    else:  # all values of one field, then all of the next
        packed, size = struct.unpack_from("<II", content, at)
        if size != total * record.itemsize:
            needed = f"{total:,} points take {total * record.itemsize:,}"
            raise InputError(f"it unpacks to {size:,} bytes; its {needed}")
        unpacked = lzf_unpacked(content[at + 8 : at + 8 + packed], size)
        offsets = total * np.cumsum([0, *(record[i].itemsize for i in range(len(names)))])
        columns = [np.frombuffer(unpacked, record[i], total, offsets[i]) for i in places]
    return np.stack([column[:, 0] for column in columns], axis=1)


def lzf_unpacked(packed: bytes, size: int) -> bytes:
    """Unpacks data that LibLZF packed; `size` is the unpacked size [bytes].
    https://oldhome.schmorp.de/marc/liblzf.html

    Raises ValueError if the unpacked size differs or the data repeat bytes from before the beginning, and
    IndexError if they end within a repetition. Unpacking stops when the size is exceeded.
    """
    out = bytearray()
    at = 0
    while at < len(packed) and len(out) <= size:
        control = packed[at]
        at += 1
        if control < 32:  # the next control + 1 bytes are literal: they are copied
            out += packed[at : at + control + 1]
            at += control + 1
            continue
        # a repetition of earlier output: its length, and how far back it starts
        length = (control >> 5) + 2
        if length == 9:
            length += packed[at]
            at += 1
        start = len(out) - 1 - ((control & 31) << 8 | packed[at])
        at += 1
        repeated = out[max(start, 0) : start + length]
        if start < 0:
            raise ValueError("the packed data repeat bytes from before the beginning")
        out += (repeated * -(-length // len(repeated)))[:length]
    if len(out) != size:
        raise ValueError(f"the packed data do not unpack to {size:,} bytes")
    return bytes(out)


READERS: dict[str, Callable[[Path], ndarray]] = {
    ".ply": _read_ply,
    ".pcd": _read_pcd,
    ".xyz": _read_text,
    ".csv": _read_text,
    **dict.fromkeys((".npy", ".npz"), partial(read_array, name="points")),
    ".bt": lambda file: read_octomap(file)[0],
}


def default_radius(file: str | Path, scale: float = 1.0) -> float:
    """Default radius of the points of a file [m]: POINT_RADIUS, or for an octomap the radius of the sphere
    around a voxel. `scale`: meters for each unit of the octomap."""
    return scale * cover_radius(read_octomap(file)[1]) if Path(file).suffix.lower() == ".bt" else POINT_RADIUS
