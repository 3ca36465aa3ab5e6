"""The data set on disk: a manifest, and shards of planned trajectories as Zarr v3 groups.

    FOLDER/manifest.json             what the data are of: robot, limits, settings, versions
    FOLDER/shard_00000.zarr/         one group, one chunk per array

A shard is written beside its place and renamed, so what has its name is whole. The same arrays give the same
files, byte for byte. `trajectories` is not compressed: its chunk is a file that can be mapped into memory.
"""

import hashlib
import json
import re
import shutil
import tempfile
import zlib
from dataclasses import asdict, dataclass
from pathlib import Path as FilePath
from types import ModuleType
from typing import Any

import numpy as np
from jaxtyping import Float32, Int8
from numpy import ndarray

from robotdiffuse.errors import InputError
from robotdiffuse.files import write_atomically
from robotdiffuse.robots.fingerprint import robot_fingerprint
from robotdiffuse.robots.robot import Robot

FORMAT = 1
MANIFEST = "manifest.json"
COMPRESSION = 3
"""Zstandard's level."""

SPLITS = ("train", "validation", "test")
SPLIT_PERCENT = (90, 5, 5)

ARRAYS: dict[str, tuple[str, tuple[str | int, ...]]] = {
    "trajectories": ("<f4", ("frames", "dof")),
    "times": ("<f4", ("frames",)),
    "start": ("<f4", ("dof",)),
    "goals": ("<f4", ("goals", "dof")),
    "goal_costs": ("<f4", ("goals",)),
    "goal_index": ("|i1", ()),
    "target_pose": ("<f4", (7,)),
    "obstacle_kinds": ("|i1", ("slots",)),
    "obstacle_params": ("<f4", ("slots", 10)),
    "family": ("|i1", ()),
    "cost": ("<f4", ()),
    "clearance": ("<f4", ()),
    "end_clearance": ("<f4", (2,)),
    "safety_distance": ("<f4", ()),
    "line_free": ("|b1", ()),
    "detour": ("<f4", ()),
    "seed": ("<u8", ()),
}
"""By name: type, and shape of a row in fields of the manifest. `times` only where `timing` is "time".

Joint values [rad], times [s], lengths [m]. `trajectories` begin at `start` and end at `goals[goal_index]`,
exactly. Rows of `goals` beyond those that a problem has are NaN, and so are their `goal_costs`; the cost of a
goal that was not reached is inf. `target_pose` is wxyz_xyz of the tip in the base frame. Obstacles are as
`pack_scene` packs them, without the floor. `cost` is the joint-space length of the path [rad], `clearance` a
lower bound of its distance to obstacles [m], `end_clearance` that of start and reached goal alone,
`safety_distance` the distance that the search kept but near ends that are closer themselves [m],
`line_free` whether the straight line would have done, `detour` the cost in units of the straight line's,
`seed` the number of the problem.
"""
UNBOUNDED = {"goals", "goal_costs"}
"""Arrays that may hold NaN or inf."""

_SHARD_NAME = re.compile(r"shard_(\d{5,})\.zarr")


@dataclass(frozen=True)
class Manifest:
    """What a data set is of."""

    robot: str
    """A bundled name, or the path of a URDF."""
    robot_fingerprint: str
    joint_names: tuple[str, ...]
    lower: tuple[float, ...]
    """Limits [rad]."""
    upper: tuple[float, ...]
    frames: int
    timing: str
    """How frames are spaced: "arc", evenly in joint-space length, or "time"."""
    families: dict[str, dict[str, Any]]
    """Settings of the scenes by name, in the order of the numbers in `family`."""
    slots: int
    """Most obstacles of a scene."""
    goals: int
    """Most goal configurations of a problem."""
    trajectories: int
    """Planned in all."""
    shard: int
    """Rows per shard."""
    settings: dict[str, Any]
    """All of the generation's."""
    versions: dict[str, str]

    def __post_init__(self) -> None:
        if not len(self.joint_names) == len(self.lower) == len(self.upper) > 0:
            raise InputError(
                f"joint_names, lower and upper have {len(self.joint_names)}, {len(self.lower)} and "
                f"{len(self.upper)} entries; they must have as many as there are joints"
            )
        if self.timing not in ("arc", "time"):
            raise InputError(f"timing is {self.timing!r}; it must be arc or time")

    @property
    def dof(self) -> int:
        return len(self.joint_names)

    def check_robot(self, robot: Robot) -> None:
        """Raises InputError if the data were made with another robot."""
        found = robot_fingerprint(robot)
        if found != self.robot_fingerprint:
            raise InputError(
                f"the data are of the robot {self.robot} with fingerprint {self.robot_fingerprint}; "
                f"{robot.name} has {found}; use the robot of the data"
            )


@dataclass(frozen=True, eq=False)
class Shard:
    """Arrays of one shard, or some of them."""

    index: int
    fingerprint: str
    counts: dict[str, int]
    """How many problems were tried, solved, unsolved, thinned, refused, ..."""
    arrays: dict[str, ndarray]
    """By the names in ARRAYS."""

    def __getitem__(self, name: str) -> ndarray:
        return self.arrays[name]

    def __len__(self) -> int:
        return len(next(iter(self.arrays.values())))


def write_manifest(folder: str | FilePath, manifest: Manifest) -> None:
    """Write manifest.json, whole or not at all; makes the folder. Raises InputError if it cannot."""
    data = {"format": FORMAT, "dof": manifest.dof} | asdict(manifest)
    write_atomically(FilePath(folder) / MANIFEST, json.dumps(data, indent=1) + "\n", make_folder=True)


def read_manifest(folder: str | FilePath) -> Manifest:
    """Raises InputError if there is none, or it is damaged or of another version of the format."""
    file = FilePath(folder) / MANIFEST
    try:
        data = json.loads(file.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError(
            f"no data set: there is no {file}; make one with: robotdiffuse data generate"
        ) from None
    except OSError as error:
        raise InputError(f"cannot read {file}: {error.strerror}") from None
    except ValueError as error:
        raise InputError(f"{file} is damaged: {error}") from None
    if not isinstance(data, dict) or "format" not in data:
        raise InputError(f"{file} is no manifest of a data set: it has no format")
    _check_format(file, data["format"])
    del data["format"]
    try:
        data.pop("dof")
        for name in ("joint_names", "lower", "upper"):
            data[name] = tuple(data[name])
        return Manifest(**data)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{file} is damaged: {error}") from None


def _check_format(file: FilePath, found: object) -> None:
    if found != FORMAT:
        raise InputError(f"{file}: format is {found}; this version reads {FORMAT}")


def shard_path(folder: str | FilePath, index: int) -> FilePath:
    return FilePath(folder) / f"shard_{index:05d}.zarr"


def shard_indices(folder: str | FilePath) -> list[int]:
    """Numbers of the shards that a folder has, rising."""
    matches = (_SHARD_NAME.fullmatch(path.name) for path in FilePath(folder).glob("shard_*.zarr"))
    return sorted(int(match[1]) for match in matches if match)


def remove_leftovers(folder: str | FilePath) -> None:
    """Remove what killed runs left half-written. Only while nobody writes to the folder."""
    for path in FilePath(folder).glob(".shard_*.zarr.*"):
        shutil.rmtree(path, ignore_errors=True)
    for path in FilePath(folder).glob(f".{MANIFEST}.*"):
        path.unlink(missing_ok=True)


def _zarr() -> ModuleType:
    try:
        import zarr
    except ImportError:
        raise InputError(
            'data sets need zarr, which is not installed: pip install "robotdiffuse[data]"'
        ) from None
    return zarr


def write_shard(
    folder: str | FilePath, index: int, arrays: dict[str, ndarray], counts: dict[str, int]
) -> None:
    """Write a shard, whole or not at all, in the place of one of the same number.

    `arrays` are all of ARRAYS, but for `times` where the timing is "arc". Raises InputError if the arrays do
    not fit each other, or the shard cannot be written, as when the disk is full.
    """
    zarr, target = _zarr(), shard_path(folder, index)
    wrong = {*arrays, "times"} ^ ARRAYS.keys()
    rows = {name: len(array) for name, array in arrays.items()}
    if wrong or len(set(rows.values())) != 1:
        raise InputError(f"shard {index}: missing or unknown arrays {sorted(wrong)}, or unequal rows: {rows}")
    ready = {
        name: np.ascontiguousarray(arrays[name], ARRAYS[name][0]).reshape(arrays[name].shape)
        for name in sorted(arrays)
    }
    prints = {name: _array_fingerprint(array) for name, array in ready.items()}
    attributes = {
        "format": FORMAT,
        "index": index,
        "fingerprint": _shard_fingerprint(prints),
        "counts": {name: int(counts[name]) for name in sorted(counts)},
    }
    beside: str | None = None
    try:
        FilePath(folder).mkdir(parents=True, exist_ok=True)
        beside = tempfile.mkdtemp(prefix=f".{target.name}.", dir=folder)
        fresh, old = FilePath(beside, "new"), FilePath(beside, "old")
        group = zarr.open_group(fresh, mode="w", zarr_format=3, attributes=attributes)
        for name, array in ready.items():
            group.create_array(
                name,
                data=array,
                chunks=tuple(max(1, size) for size in array.shape),
                compressors=None if name == "trajectories" else zarr.codecs.ZstdCodec(level=COMPRESSION),
                filters=None,
                attributes={"fingerprint": prints[name]},
                # a chunk of zeros is a file too: a file that is not there is damage
                config={"write_empty_chunks": True},
            )
        if target.exists():
            target.rename(old)
        fresh.rename(target)
    except OSError as error:
        raise InputError(f"cannot write {target}: {error.strerror or error}") from None
    finally:
        if beside is not None:
            shutil.rmtree(beside, ignore_errors=True)


def _array_fingerprint(array: ndarray) -> str:
    digest = hashlib.sha256(f"{array.dtype.str} {array.shape}".encode())
    digest.update(np.ascontiguousarray(array).reshape(-1).view(np.uint8).data)
    return digest.hexdigest()[:16]


def _shard_fingerprint(prints: dict[str, str]) -> str:
    """Of the fingerprints of all arrays, in the order of their names."""
    text = json.dumps([(name, prints[name]) for name in sorted(prints)])
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def read_shard(folder: str | FilePath, index: int, names: tuple[str, ...] | None = None) -> Shard:
    """The arrays of a shard, or those named; `trajectories` mapped from the disk, read-only.

    Raises InputError, naming shard and array, where something is missing or cut short. Values are not
    checked; see `check_shard`.
    """
    path = shard_path(folder, index)
    group = _open(path)
    attributes = dict(group.attrs)
    _check_format(path, attributes.get("format"))
    if attributes.get("index") != index or not isinstance(attributes.get("counts"), dict):
        raise InputError(f"shard {path} is damaged: its attributes are not those of shard {index}")
    if names is None:
        names = tuple(name for name in ARRAYS if name != "times" or (path / name).exists())
    arrays = {name: _read_array(path, group, name) for name in names}
    rows = {name: len(array) for name, array in arrays.items()}
    if len(set(rows.values())) > 1:
        raise InputError(f"shard {path} is damaged: its arrays have unequal numbers of rows: {rows}")
    return Shard(index, str(attributes.get("fingerprint")), attributes["counts"], arrays)


_DAMAGE = (OSError, ValueError, RuntimeError, KeyError, TypeError, AttributeError)
"""What zarr and its codecs raise for files that are not as they should be."""


def _open(path: FilePath) -> Any:
    zarr = _zarr()
    if not path.is_dir():
        raise InputError(f"there is no shard {path}")
    try:
        return zarr.open_group(path, mode="r", zarr_format=3)
    except _DAMAGE as error:
        raise InputError(f"shard {path} is damaged: {_line(error)}") from None


def _read_array(path: FilePath, group: Any, name: str) -> ndarray:
    dtype, row = ARRAYS[name]
    where = f"shard {path}, array {name}"
    if not (path / name).is_dir():
        raise InputError(f"{where}: missing")
    try:
        array = group[name]
        found, ndim = array.dtype.str, len(array.shape)
        whole = array.nchunks_initialized == array.nchunks
    except _DAMAGE as error:
        raise InputError(f"{where} is damaged: {_line(error)}") from None
    if found != dtype or ndim != 1 + len(row):
        raise InputError(f"{where} is {found} with {ndim} axes; it must be {dtype} with {1 + len(row)}")
    if not whole:
        raise InputError(f"{where} is damaged: a chunk is missing")
    try:
        if name == "trajectories" and _is_one_plain_chunk(array):
            return _map(path / name, array)
        return array[...]
    except _DAMAGE as error:
        raise InputError(f"{where} is damaged: {_line(error)}") from None


def _line(error: BaseException) -> str:
    return " ".join(str(error).split()) or type(error).__name__


def _is_one_plain_chunk(array: Any) -> bool:
    """Whether the array lies in one file as it would in memory."""
    codecs = [codec.to_dict() for codec in array.metadata.codecs]
    plain = len(codecs) == 1 and codecs[0]["name"] == "bytes"
    return plain and codecs[0]["configuration"] == {"endian": "little"} and array.chunks == array.shape


def _map(path: FilePath, array: Any) -> ndarray:
    file = path / array.metadata.encode_chunk_key((0,) * array.ndim)
    size, wanted = file.stat().st_size, array.dtype.itemsize * array.size
    if size != wanted:
        raise ValueError(f"its chunk has {size:,} bytes; it must have {wanted:,}")
    return np.memmap(file, array.dtype, "r", shape=array.shape)


def check_shapes(folder: str | FilePath, shard: Shard, manifest: Manifest) -> None:
    """Raises InputError, naming shard and array, if rows are not of the shapes that the manifest says."""
    for name, array in shard.arrays.items():
        row = tuple(getattr(manifest, s) if isinstance(s, str) else s for s in ARRAYS[name][1])
        if array.shape[1:] != row:
            where = f"shard {shard_path(folder, shard.index)}, array {name}"
            raise InputError(f"{where} has rows of shape {array.shape[1:]}; the manifest says {row}")


def check_shard(folder: str | FilePath, index: int, manifest: Manifest) -> Shard:
    """Read a shard and check everything that needs no robot: shapes, types, numbers and fingerprints.

    Raises InputError, naming shard and array, for the first thing that is wrong.
    """
    shard, path = read_shard(folder, index), shard_path(folder, index)
    if ("times" in shard.arrays) != (manifest.timing == "time"):
        raise InputError(f"shard {path}, array times: it must be there only where timing is time")
    check_shapes(folder, shard, manifest)
    group, prints = _open(path), {}
    for name, array in shard.arrays.items():
        where = f"shard {path}, array {name}"
        prints[name] = _array_fingerprint(array)
        if prints[name] != group[name].attrs.get("fingerprint"):
            raise InputError(f"{where} is damaged: its fingerprint is not the one that was written")
        if name not in UNBOUNDED and not np.isfinite(array).all():
            raise InputError(f"{where} holds numbers that are not finite")
    if _shard_fingerprint(prints) != shard.fingerprint:
        raise InputError(f"shard {path} is damaged: its fingerprint is not that of its arrays")
    return shard


def split_of(kinds: Int8[ndarray, "n slots"], params: Float32[ndarray, "n slots 10"]) -> Int8[ndarray, "n"]:
    """The split of each row, as an index into SPLITS: by a hash of its scene, so that no scene is in two."""
    ends = np.cumsum(SPLIT_PERCENT)
    hashes = [zlib.crc32(p.tobytes(), zlib.crc32(k.tobytes())) for k, p in zip(kinds, params, strict=True)]
    return np.searchsorted(ends, np.array(hashes, np.int64) % 100, side="right").astype(np.int8)
