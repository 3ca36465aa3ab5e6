"""Reads point clouds from files, downsamples and crops them."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.core.errors import InputError, shortened, shown, unknown_name
from robotdiffuse.core.input_files import input_file, read_arrays
from robotdiffuse.scenes.octomap import cover_radius, read_octomap

POINT_RADIUS = 0.01
"""Radius of points, unless another is given [m]."""
MIXERS = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], np.uint64)
"""Odd numbers with many bits, by which coordinates are mixed into a hash."""


def voxel_thin(points: Float[ndarray, "n 3"], voxel: float) -> Float[ndarray, "m 3"]:
    """The first point of every occupied cell of a grid with cells `voxel` wide [m], in the original order.

    Every removed point is less than sqrt(3) * voxel away from a remaining one.
    """
    if len(points) == 0:
        return points
    cells = np.floor(points * (1 / voxel))
    cells -= cells.min(axis=0)
    extent = cells.max(axis=0) + 1
    bits = len(points).bit_length()
    if extent.prod() * 2.0**bits < 2.0**62 and extent.prod() < 2.0**53:
        # Sorting cell and point numbers packed into one integer is several times faster than np.unique.
        cell = (cells @ np.array([extent[1] * extent[2], extent[2], 1.0])).astype(np.int64)
        packed = np.sort((cell << bits) | np.arange(len(points)))
        first = np.flatnonzero(np.diff(packed >> bits, prepend=-1))
        kept = packed[first] & ((1 << bits) - 1)
    else:
        kept = np.unique(cells, axis=0, return_index=True)[1]
    return points[np.sort(kept)]


def distinct(points: Float[ndarray, "n 3"]) -> Float[ndarray, "m 3"]:
    """The points without repetitions, in the old order; the same array if there are none."""
    if len(points) == 0:
        return points
    # To sort one number for each point is ten times faster than to sort points.
    hashes = (np.ascontiguousarray(points, np.float64) + 0.0).view(np.uint64) @ MIXERS
    if len(np.unique(hashes)) == len(points):
        return points
    kept, which = np.unique(hashes, return_index=True, return_inverse=True)[1:]
    if not np.array_equal(points[kept][which], points):  # two points have one hash
        kept = np.unique(points, axis=0, return_index=True)[1]
    return points[np.sort(kept)]


def crop(points: Float[ndarray, "n 3"], center: Float[ndarray, "3"], reach: float) -> Float[ndarray, "m 3"]:
    """The points within `reach` of `center` [m]."""
    return points[((points - center) ** 2).sum(axis=1) <= reach**2]


def read_points(file: str | Path) -> tuple[Float[ndarray, "n 3"], tuple[str, ...]]:
    """The points of a .ply, .pcd, .xyz, .csv, .npy, .npz or .bt file [m], and notes on removed points.

    Points that are not finite (missing returns of a depth camera) are removed, with a note. Columns after the
    third are ignored. Raises InputError if the file is missing, empty or does not contain points.
    """
    file = Path(file)
    reader = READERS.get(file.suffix.lower())
    if reader is None:
        raise unknown_name(f"point cloud format of {file}:", file.suffix, READERS)
    if input_file(file, "point cloud file").stat().st_size == 0:
        raise InputError(f"point cloud file {file} is empty")
    try:
        points = np.asarray(reader(file), dtype=np.float64)
    except InputError:
        raise
    except Exception as error:  # the libraries raise many kinds of errors for damaged files
        raise InputError(f"point cloud file {file} cannot be read: {shortened(str(error))}") from None
    if points.size == 0:
        return np.zeros((0, 3)), (f"{file} holds no points",)
    if points.ndim != 2 or points.shape[1] < 3:
        shape = " x ".join(map(str, points.shape))
        raise InputError(f"point cloud file {file} holds an array of {shape}; it must be n x 3")
    points = np.ascontiguousarray(points[:, :3])
    finite = np.isfinite(points).all(axis=1)
    if finite.all():
        return points, ()
    removed = int((~finite).sum())
    return points[finite], (f"{file}: {removed} of {len(points)} points are not finite and were removed",)


def _read_ply(file: Path) -> ndarray:
    from trimesh.exchange.ply import load_ply

    with file.open("rb") as stream:
        fields = load_ply(stream)
    return fields.get("vertices", np.zeros((0, 3)))


def _read_text(file: Path) -> ndarray:
    """Columns of numbers, separated by commas or blanks; the first line may be a header of names."""
    with file.open(encoding="utf-8") as stream:
        first = stream.readline()
    delimiter = "," if "," in first else None
    names = [name.strip().strip('"').lower() for name in first.split(delimiter)]
    header = not _is_number(names[0])
    columns = [names.index(axis) for axis in "xyz"] if header and {"x", "y", "z"} <= {*names} else None
    if header and not file.read_text(encoding="utf-8").partition("\n")[2].strip():
        return np.zeros((0, 3))
    return np.loadtxt(file, delimiter=delimiter, skiprows=int(header), usecols=columns, ndmin=2, comments="#")


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return text.startswith("#")
    return True


def _read_npz(file: Path) -> ndarray:
    arrays = read_arrays(file)
    if "points" not in arrays and len(arrays) != 1:
        raise InputError(f"point cloud file {file} holds {shown([*arrays])}; one must be named points")
    return arrays.get("points", next(iter(arrays.values())))


def _read_pcd(file: Path) -> ndarray:
    """PCD version 0.7: https://pointclouds.org/documentation/tutorials/pcd_file_format.html"""
    content = file.read_bytes()
    header: dict[str, list[str]] = {}
    at = 0
    while "DATA" not in header:
        end = content.index(b"\n", at)
        words = content[at:end].decode("ascii").split()
        at = end + 1
        if words and not words[0].startswith("#"):
            header[words[0]] = words[1:]
    names = header["FIELDS"]
    storage = header["DATA"][0]
    counts = [int(count) for count in header.get("COUNT", ["1"] * len(names))]
    if not {"x", "y", "z"} <= {*names}:
        raise InputError(f"point cloud file {file} has the fields {shown(names)}; it must have x, y and z")
    total = int(header["POINTS"][0])
    if storage == "ascii":
        columns = [sum(counts[: names.index(axis)]) for axis in "xyz"]
        rows = content[at:].decode("ascii").splitlines()
        return np.loadtxt(rows, usecols=columns, ndmin=2, max_rows=total) if total else np.zeros((0, 3))
    if storage != "binary":
        raise InputError(f"point cloud file {file} is stored as {shown(storage)}; it must be ascii or binary")
    kinds = [f"<{kind.lower()}{size}" for kind, size in zip(header["TYPE"], header["SIZE"], strict=True)]
    # Fields are named by position: PCL writes several padding fields that are all called "_".
    record = np.dtype([(str(i), kind, (n,)) for i, (kind, n) in enumerate(zip(kinds, counts, strict=True))])
    points = np.frombuffer(content, record, count=total, offset=at)
    return np.stack([points[str(names.index(axis))][:, 0].astype(np.float64) for axis in "xyz"], axis=1)


READERS: dict[str, Callable[[Path], ndarray]] = {
    ".ply": _read_ply,
    ".pcd": _read_pcd,
    ".xyz": _read_text,
    ".csv": _read_text,
    ".npy": lambda file: read_arrays(file)[""],
    ".npz": _read_npz,
    ".bt": lambda file: read_octomap(file)[0],
}


def default_radius(file: str | Path) -> float:
    """Radius of the points of a file [m]: POINT_RADIUS, or that of the spheres around an octomap's voxels."""
    return cover_radius(read_octomap(file)[1]) if Path(file).suffix.lower() == ".bt" else POINT_RADIUS
