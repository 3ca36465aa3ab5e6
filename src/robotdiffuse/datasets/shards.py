"""Data sets on disk: the manifest, the schema of rows, shards, and rows as motions and problems.

    FOLDER/manifest.json             robot, scenes, settings and versions
    FOLDER/shard_00000.zarr/         a Zarr v3 group, one chunk per array

A shard is written under a temporary name and renamed, so that a shard with its final name is complete. The
same arrays give the same files, byte for byte. `trajectories` is not compressed, so that its file can be
mapped to memory.

Training reads rows also as rotated copies. If the first joint rotates about the base's z axis, a scene and
its motion can be rotated together about this axis: the angle is added to the first joint. Such copies need
no planning. The base link does not rotate, so copies in which the arm would touch it are left out. The floor
does not rotate either, but its corners are out of reach."""

import hashlib
import json
import os
import re
import shutil
import sys
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path as FilePath
from types import ModuleType
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, Int, Int8
from numpy import ndarray

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.core.errors import InputError, located, needs, reading, shown
from robotdiffuse.core.files import (
    JsonObject,
    file_name,
    input_file,
    parse_json,
    read_text,
    replaced_folder,
    write_atomically,
)
from robotdiffuse.core.interrupts import delay_interrupts
from robotdiffuse.core.settings import Count, Natural, Settings
from robotdiffuse.core.transforms import quaternion_from_rotation
from robotdiffuse.core.types import (
    Configurations,
    Mask,
    Path,
    Pose,
    Trajectory,
    Values,
    frozen_dataclass,
    interpolated,
)
from robotdiffuse.problems.problem import JointGoal, Problem
from robotdiffuse.robots import load_robot
from robotdiffuse.robots.robot import Robot, robot_fingerprint
from robotdiffuse.scenes.packed_scenes import PackedScenes, floor_row
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.shapes import Box

FORMAT = 1
MANIFEST = "manifest.json"


@dataclass(frozen=True)
class Manifest(Settings):
    """Robot, scenes, settings and versions of a data set."""

    robot: str
    """Name or file of the robot, as `load_robot` takes it."""
    robot_fingerprint: str
    joint_names: tuple[str, ...]
    lower: tuple[float, ...]
    """Joint limits [rad], [m] for prismatic joints."""
    upper: tuple[float, ...]
    waypoints: Count
    timing: str
    """How waypoints are spaced: "arc", evenly in joint-space length, or "time"."""
    families: dict[str, JsonObject]
    """Settings of each family of scenes. The array `family` contains indices into this mapping."""
    floors: dict[str, dict[str, list[float]] | None]
    """By family, `center` and `size` of the box on which its scenes stand [m]; None for a family without a
    floor."""
    slots: Natural
    """Largest number of obstacles in a scene, without the floor."""
    goals: Count
    """Largest number of goal configurations of a problem."""
    trajectories: Natural
    """Number of trajectories of the whole data set."""
    shard: Count
    """Number of rows of a shard."""
    settings: JsonObject
    """Settings of the generation of the data set."""
    versions: dict[str, str]

    def __post_init__(self) -> None:
        super().__post_init__()
        if not len(self.joint_names) == len(self.lower) == len(self.upper) > 0:
            raise InputError(
                f"joint_names, lower and upper have {len(self.joint_names)}, {len(self.lower)} and "
                f"{len(self.upper)} entries; they must have as many as there are joints"
            )
        if self.timing not in ("arc", "time"):
            raise InputError(f"timing is {self.timing!r}; it must be arc or time")
        if self.floors.keys() != self.families.keys():
            raise InputError(f"floors names {[*self.floors]}, but families {[*self.families]}")
        for i in range(len(self.families)):
            self.floor(i)

    @classmethod
    def of(
        cls, robot: Robot, source: str, *, floors: Mapping[str, Box | None], timing: str = "arc", **more: Any
    ) -> "Manifest":
        """The manifest of data of a robot. source: the field `robot`. floors: the floor of each family. more:
        the other fields."""
        records = {
            name: None if floor is None else {"center": floor.center.tolist(), "size": floor.size.tolist()}
            for name, floor in floors.items()
        }
        return cls(
            robot=source,
            robot_fingerprint=robot_fingerprint(robot),
            joint_names=robot.joint_names,
            lower=tuple(robot.lower.tolist()),
            upper=tuple(robot.upper.tolist()),
            timing=timing,
            floors=records,
            **more,
        )

    @property
    def dof(self) -> int:
        return len(self.joint_names)

    def floor(self, family: int) -> Box | None:
        """The floor of a family, given by its index in `families`; None if its scenes have no floor."""
        floor = self.floors[list(self.families)[family]]
        return None if floor is None else Box(**floor, name="floor")

    def check_robot(self, robot: Robot | None) -> Robot:
        """The robot of the data: the given one, or for None the one with the name in the manifest. Raises
        InputError if the data were made with another robot."""
        robot = load_robot(self.robot) if robot is None else robot
        fingerprint = robot_fingerprint(robot)
        if fingerprint != self.robot_fingerprint:
            raise InputError(
                f"the data are of the robot {self.robot} with fingerprint {self.robot_fingerprint}; "
                f"{robot.name} has {fingerprint}; use the robot of the data"
            )
        return robot


def write_manifest(folder: str | FilePath, manifest: Manifest) -> None:
    """Write manifest.json atomically, making the folder. Raises InputError if it cannot be written."""
    data = {"format": FORMAT, "dof": manifest.dof} | asdict(manifest)
    write_atomically(FilePath(folder) / MANIFEST, json.dumps(data, indent=1) + "\n", make_folder=True)


def read_manifest(folder: str | FilePath) -> Manifest:
    """Read manifest.json. Raises InputError if it is missing, damaged or of another version of the format."""
    file = file_name(folder, "folder") / MANIFEST
    if not os.path.lexists(file):
        raise InputError(f"no data set: there is no {file}; make one with: robotdiffuse data generate")
    text = read_text(file)
    with located(f"{file} is damaged"):
        data = parse_json(text, MANIFEST)
    if not isinstance(data, dict) or "format" not in data:
        raise InputError(f"{file} is no manifest of a data set: it has no format")
    check_format(file, data.pop("format"))
    data.pop("dof", None)
    with reading(file), located(f"{file} is damaged"):
        return Manifest.from_json(data, MANIFEST)


def check_format(file: FilePath, found: object) -> None:
    """Raise InputError for another version of the format."""
    if found != FORMAT:
        raise InputError(f"{file}: format is {shown(found)}; this version reads {FORMAT}")


# Shards

COMPRESSION_LEVEL = 3
"""Compression level of Zstandard."""

SPLITS = ("train", "validation", "test")
SPLIT_PERCENT = (90, 5, 5)

ARRAYS: dict[str, tuple[str, tuple[str | int, ...]]] = {
    "trajectories": ("<f4", ("waypoints", "dof")),
    "times": ("<f4", ("waypoints",)),
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
"""Type and row shape of each array; names in shapes are fields of the manifest. `times` exists only if
`timing` is "time".

Joint values are in [rad] or, for prismatic joints, [m]; times in [s], lengths in [m].

- `trajectories` begin exactly at `start` and end exactly at `goals[goal_index]`.
- `goals`, `goal_costs`: unused rows are NaN; the cost of a goal that was not reached is inf.
- `target_pose`: wxyz_xyz of the tip in the base frame.
- `obstacle_kinds`, `obstacle_params`: as in `PackedScenes`, without the floor.
- `cost`: joint-space length of the path [rad].
- `clearance`: lower bound of the waypoints' distance to obstacles [m]; `end_clearance`: of the start and of
  the reached goal.
- `safety_distance`: distance to obstacles that the search kept, except near a start or goal that is closer.
- `line_free`: whether the straight line from start to the reached goal is free.
- `detour`: the cost divided by the length of this straight line.
- `seed`: the number of the problem.
"""
UNBOUNDED = {"goals", "goal_costs"}
"""Arrays that may hold NaN or inf."""

Arrays = dict[str, ndarray]
Counts = dict[str, int]
_SHARD_NAME = re.compile(r"shard_(\d{5,})\.zarr")


@frozen_dataclass
class Shard:
    """One shard, with all arrays or some of them."""

    index: int
    fingerprint: str
    counts: Counts
    """Numbers of problems: all that were `tried`, and by outcome: `solved`, `unsolved`, `refused`, `thinned`
    (trivial ones that were left out), ..."""
    arrays: Arrays
    """Arrays by their names in ARRAYS."""

    def __getitem__(self, name: str) -> ndarray:
        return self.arrays[name]

    def __len__(self) -> int:
        return len(next(iter(self.arrays.values())))


def shard_path(folder: str | FilePath, index: int) -> FilePath:
    return FilePath(folder) / f"shard_{index:05d}.zarr"


def shard_indices(folder: str | FilePath) -> list[int]:
    """Indices of the shards in a folder, in ascending order."""
    matches = (_SHARD_NAME.fullmatch(path.name) for path in FilePath(folder).glob("shard_*.zarr"))
    return sorted(int(match[1]) for match in matches if match)


def existing_shards(folder: str | FilePath) -> list[int]:
    """The result of `shard_indices`. Raises InputError if the folder has no shards."""
    indices = shard_indices(folder)
    if not indices:
        raise InputError(
            f"{folder} holds no shards; make some with: robotdiffuse data generate --out {folder}"
        )
    return indices


def remove_leftovers(folder: str | FilePath) -> None:
    """Remove incomplete shards of killed runs. Call it only while no process writes to the folder."""
    for path in FilePath(folder).glob(".shard_*.zarr.*"):
        shutil.rmtree(path, ignore_errors=True)


def _zarr() -> ModuleType:
    with needs("zarr", "data"):
        import zarr
    return zarr


# Ctrl-C within a call of zarr leaves coroutines behind, which warn at the exit
@delay_interrupts()
def write_shard(folder: str | FilePath, index: int, arrays: Arrays, counts: Counts) -> None:
    """Write a shard atomically; an existing shard of this index is replaced.

    arrays: all arrays of ARRAYS, without `times` if the timing is "arc". Raises InputError if the arrays do
    not match, or if the shard cannot be written (OutputError if the disk is full).
    """
    zarr = _zarr()
    target = shard_path(folder, index)
    wrong = {*arrays, "times"} ^ ARRAYS.keys()
    if wrong:
        raise InputError(f"shard {index}: arrays are missing or unknown: {sorted(wrong)}")
    rows = {name: len(array) for name, array in arrays.items()}
    if len(set(rows.values())) != 1:
        raise InputError(f"shard {index}: unequal rows: {rows}; all arrays must have the same number")
    converted = {name: np.ascontiguousarray(arrays[name], ARRAYS[name][0]) for name in sorted(arrays)}
    attributes = {
        "format": FORMAT,
        "index": index,
        "fingerprint": _fingerprint(converted),
        "counts": dict(sorted(counts.items())),
    }
    # first in memory: zarr's threads would write on after the error of a full disk
    files = dict[str, Any]()
    group = zarr.open_group(files, mode="w", zarr_format=3, attributes=attributes)
    for name, array in converted.items():
        group.create_array(
            name,
            data=array,
            chunks=tuple(max(1, size) for size in array.shape),
            compressors=None if name == "trajectories" else zarr.codecs.ZstdCodec(level=COMPRESSION_LEVEL),
            filters=None,
            # write chunks of zeros too, so that a missing file means damage
            config={"write_empty_chunks": True},
        )
    with replaced_folder(target) as new_folder:
        for name, content in files.items():
            file = new_folder / name
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_bytes(content.to_bytes())


def _fingerprint(arrays: Arrays) -> str:
    """A hash of the hashes of the arrays, in the order of their names."""
    fingerprints = []
    for name, array in sorted(arrays.items()):
        digest = hashlib.sha256(f"{array.dtype.str} {array.shape}".encode() + array.tobytes())
        fingerprints.append((name, digest.hexdigest()[:16]))
    return hashlib.sha256(json.dumps(fingerprints).encode()).hexdigest()[:16]


@delay_interrupts()
def read_shard(folder: str | FilePath, index: int, names: tuple[str, ...] | None = None) -> Shard:
    """Read a shard, or the named arrays of it; `trajectories` is mapped from the disk, read-only.

    Raises InputError, naming the shard, for missing or damaged data and for another version of the format.
    Values are not checked; see `check_shard`.
    """
    path = shard_path(folder, index)
    group = _open(path)
    attributes = dict(group.attrs)
    check_format(path, attributes.get("format"))
    if attributes.get("index") != index or not isinstance(attributes.get("counts"), dict):
        raise InputError(f"shard {path} is damaged: its attributes are not those of shard {index}")
    if names is None:
        names = tuple(name for name in ARRAYS if name != "times" or (path / name).exists())
    arrays = {name: _read_array(path, group, name) for name in names}
    rows = {name: len(array) for name, array in arrays.items()}
    if len(set(rows.values())) > 1:
        raise InputError(f"shard {path} is damaged: its arrays have unequal numbers of rows: {rows}")
    return Shard(index, str(attributes.get("fingerprint")), attributes["counts"], arrays)


def _open(path: FilePath) -> Any:
    zarr = _zarr()
    if not path.is_dir():
        raise InputError(f"there is no shard {path}")
    for file in path.rglob("*"):
        if not file.is_dir():
            input_file(file, largest=sys.maxsize)
    with reading(f"shard {path}"):
        return zarr.open_group(path, mode="r", zarr_format=3)


def _read_array(path: FilePath, group: Any, name: str) -> ndarray:
    dtype, row = ARRAYS[name]
    location = f"shard {path}, array {name}"
    if not (path / name).is_dir():
        raise InputError(f"{location}: missing")
    with reading(location):
        array = group[name]
        actual = (array.dtype.str, array.ndim)
        expected = (dtype, 1 + len(row))
        if actual != expected:
            raise InputError(
                f"{location} is {actual[0]} with {actual[1]} axes; it must be {dtype} with {expected[1]}"
            )
        if not array.size:
            return array[...]
        chunk = path / name / array.metadata.encode_chunk_key((0,) * array.ndim)
        # zarr reads missing chunks as zeros
        if array.chunks != array.shape or not chunk.is_file():
            raise InputError(f"{location} is damaged: a chunk is missing")
        if name != "trajectories":
            return array[...]
        size = chunk.stat().st_size
        if size != array.nbytes:
            raise InputError(f"{location} is damaged: its chunk has {size:,} bytes, not {array.nbytes:,}")
        return np.memmap(chunk, dtype, "r", shape=array.shape)


def check_shapes(folder: str | FilePath, shard: Shard, manifest: Manifest) -> None:
    """Raise InputError, naming shard and array, if rows do not have the shapes of the manifest."""
    for name, array in shard.arrays.items():
        row = tuple(getattr(manifest, s) if isinstance(s, str) else s for s in ARRAYS[name][1])
        if array.shape[1:] != row:
            location = f"shard {shard_path(folder, shard.index)}, array {name}"
            raise InputError(f"{location} has rows of shape {array.shape[1:]}; the manifest says {row}")


def check_shard(folder: str | FilePath, index: int, manifest: Manifest) -> Shard:
    """Read a shard and check shapes, types, finite numbers and the fingerprint. Whether the values of
    `family` and `goal_index` are valid indices is not checked.

    Raises InputError for the first defect. It names the shard and, unless only the fingerprint is wrong, the
    array.
    """
    shard = read_shard(folder, index)
    path = shard_path(folder, index)
    if ("times" in shard.arrays) != (manifest.timing == "time"):
        raise InputError(f"shard {path}, array times: it must exist if timing is time, and only then")
    check_shapes(folder, shard, manifest)
    for name, array in shard.arrays.items():
        if name not in UNBOUNDED and not np.isfinite(array).all():
            raise InputError(f"shard {path}, array {name} holds numbers that are not finite")
    if _fingerprint(shard.arrays) != shard.fingerprint:
        raise InputError(f"shard {path} is damaged: its fingerprint is not that of its arrays")
    return shard


def split_of(scenes: PackedScenes) -> Int8[ndarray, "n"]:
    """The split of each row as an index into SPLITS, by a hash of its scene, so that no scene is in two
    splits."""
    ends = np.cumsum(SPLIT_PERCENT)
    rows = zip(scenes.kinds, scenes.params, strict=True)
    hashes = [zlib.crc32(params.tobytes(), zlib.crc32(kinds.tobytes())) for kinds, params in rows]
    return np.searchsorted(ends, np.array(hashes, np.int64) % 100, side="right").astype(np.int8)


def pick_rows(sizes: dict[int, int], count: int | None, seed: int) -> dict[int, Int[ndarray, "n"]]:
    """`count` random rows of a data set, without repetition; all rows if `count` is None.

    sizes: number of rows of each shard, by its index. Returns the rows of each shard, by its index.
    """
    ends = np.cumsum([0, *sizes.values()])
    total = int(ends[-1])
    rows = np.arange(total)
    if count is not None and count < total:
        rows = np.sort(np.random.default_rng(seed).choice(total, count, replace=False))
    parts = np.split(rows, np.searchsorted(rows, ends[1:-1])) if sizes else []
    return {index: part - first for index, part, first in zip(sizes, parts, ends, strict=False)}


def random_rows(folder: str | FilePath, count: int, seed: int) -> Iterator[tuple[Shard, Int[ndarray, "n"]]]:
    """Yields shards with random rows of each, `count` rows in all, or all rows if there are fewer. Raises
    InputError for a damaged shard."""
    sizes = {index: len(read_shard(folder, index, ("family",))) for index in shard_indices(folder)}
    for index, rows in pick_rows(sizes, count, seed).items():
        if len(rows):
            yield read_shard(folder, index), rows


Row = dict[str, ndarray]
"""A row of a shard: the row of each array, by its name in `shards.ARRAYS`."""


def row_of(
    scene: PackedScenes,
    q: Float32[ndarray, "waypoints dof"],
    clearances: Values,
    goals: Configurations,
    goal_costs: Values,
    cost: float,
    T_base_tip: Pose,
    most_goals: int,
    **values: Any,
) -> Row:
    """The row of a motion q in a packed scene.

    clearances: clearance of each waypoint [m].
    T_base_tip: the target.
    most_goals: number of goals that a row of the data set has room for; unused entries are NaN.
    values: the other arrays, by their names.

    `goals`, `goal_costs` and `cost` are the values of the arrays with these names, see `shards.ARRAYS`.
    """
    padding = [(0, most_goals - len(goals)), (0, 0)]
    straight = float(np.linalg.norm(q[-1].astype(np.float64) - q[0]))
    wxyz = quaternion_from_rotation(T_base_tip)
    row: JsonObject = values | {
        "trajectories": q,
        "start": q[0],
        "goals": np.pad(goals, padding, constant_values=np.nan),
        "goal_costs": np.pad(goal_costs, padding[0], constant_values=np.nan),
        "target_pose": np.concatenate([wxyz, T_base_tip[:3, 3]]),
        "obstacle_kinds": scene.kinds[0],
        "obstacle_params": scene.params[0],
        "cost": cost,
        "clearance": clearances.min(),
        "end_clearance": clearances[[0, -1]],
        "detour": cost / max(straight, 1e-9),
    }
    return {name: np.asarray(value, ARRAYS[name][0]) for name, value in row.items()}


def scenes_of(manifest: Manifest, shard: Shard, rows: slice = slice(None)) -> PackedScenes:
    """The scenes of some rows, with the floors of their families.

    Raises InputError if a row's family is not in the manifest.
    """
    family = shard["family"][rows]
    names = list(manifest.families)
    if len(family) and not 0 <= family.min() <= family.max() < len(names):
        wrong = family[(family < 0) | (family >= len(names))][0]
        known_families = f"the manifest has {len(names)}: {', '.join(names)}"
        raise InputError(f"shard {shard.index}: family is {wrong}; {known_families}")
    floors = np.array([floor_row(manifest.floor(i)) for i in range(len(names))]).reshape(-1, 6)
    return PackedScenes(shard["obstacle_kinds"][rows], shard["obstacle_params"][rows], floors[family])


def problem_of(manifest: Manifest, robot: Robot, shard: Shard, row: int) -> Problem:
    """The problem that a row solves, with all its goal configurations.

    Raises InputError if the row is not a valid problem, for example if its start is outside the limits.
    """
    goals = shard["goals"][row]
    goals = goals[~np.isnan(goals).any(axis=1)]
    scene = scenes_of(manifest, shard, slice(row, row + 1)).scene(0)
    return Problem(robot, scene, shard["start"][row], JointGoal(goals))


def path_of(robot: Robot, shard: Shard, row: int) -> Path:
    """The waypoints of a row as a path."""
    return Path(robot.joint_names, np.asarray(shard["trajectories"][row], np.float64))


def motion_of(robot: Robot, shard: Shard, row: int) -> Path | Trajectory:
    """The motion of a row: a path, or, if the row has times that increase, a trajectory with velocities and
    accelerations by finite differences."""
    path = path_of(robot, shard, row)
    times = np.asarray(shard.arrays.get("times", ()), np.float64)
    if not len(times) or not (np.diff(times[row]) > 0).all():
        return path
    velocities = np.gradient(path.positions, times[row], axis=0)
    accelerations = np.gradient(velocities, times[row], axis=0)
    return Trajectory(robot.joint_names, times[row], path.positions, velocities, accelerations)


# Training

ARRAYS_READ = ("trajectories", "target_pose", "obstacle_kinds", "obstacle_params", "family")
"""Names of the arrays that `read_rows` reads if it does not check whole shards."""


@frozen_dataclass
class Rows:
    """The rows of a shard, or copies turned about the vertical."""

    shard: Shard
    """The shard that the rows come from; its arrays are never turned."""
    turn: int
    """Number of the turned copy; 0 for the rows as they are in the shard."""
    q: Float32[ndarray, "n waypoints dof"]
    """Joint values of the waypoints [rad], [m] for prismatic joints."""
    scenes: PackedScenes
    """The scenes with their floors."""
    split: Int8[ndarray, "n"]
    """Index into SPLITS. -1 for turned copies that must not be used: copies of rows that are not for
    training, and copies in which the arm collides with itself, such as with the base link."""


def read_rows(
    folder: str | FilePath, robot: Robot | None = None, waypoints: int | None = None, turns: int = 0
) -> Iterator[Rows]:
    """Read the rows of all shards, each shard followed by its turned copies.

    robot: the robot that the data are used for.
    waypoints: number of waypoints to which each motion is resampled, see `resample`; shards are then fully
        checked. None: the stored waypoints, mapped to memory; only their shapes are checked.
    turns: number of turned copies of the training rows, see `turned`; above 0, `waypoints` and `robot` are
        needed.

    Raises InputError if data are missing, damaged or of another robot.
    """
    manifest = read_manifest(folder)
    if robot is not None:
        manifest.check_robot(robot)
    for index in existing_shards(folder):
        if waypoints is None:
            shard = read_shard(folder, index, ARRAYS_READ)
            check_shapes(folder, shard, manifest)
        else:
            shard = check_shard(folder, index, manifest)
        stored = shard["trajectories"].view(ndarray)
        scenes = scenes_of(manifest, shard)
        split = split_of(scenes)
        yield Rows(shard, 0, stored if waypoints is None else resample(stored, waypoints), scenes, split)
        for turn in range(1, turns + 1):
            assert robot is not None and waypoints is not None
            rng = np.random.default_rng([int(shard.fingerprint, 16), turn])
            q, turned_scenes, clear = turned(robot, stored, scenes, rng)
            usable = (split == SPLITS.index("train")) & clear
            resampled = np.zeros((len(q), waypoints, q.shape[2]), np.float32)
            resampled[usable] = resample(q[usable], waypoints)
            yield Rows(shard, turn, resampled, turned_scenes, np.where(usable, split, -1).astype(np.int8))


def resample(q: Float[ndarray, "n stored dof"], waypoints: int) -> Float[ndarray, "n {waypoints} dof"]:
    """Resample each motion to `waypoints` waypoints, evenly spaced in joint-space length; the first and the
    last are kept exactly.
    """
    steps = np.linalg.norm(np.diff(q, axis=1, prepend=q[:, :1]), axis=2)
    resampled = np.empty((len(q), waypoints, q.shape[2]), q.dtype)
    for motion, lengths, out in zip(q, np.cumsum(steps, axis=1, dtype=np.float64), resampled, strict=True):
        out[:] = interpolated(np.linspace(0.0, lengths[-1], waypoints), lengths, motion)
    resampled[:, 0] = q[:, 0]
    resampled[:, -1] = q[:, -1]
    return resampled


def turns_about_vertical(robot: Robot) -> bool:
    """Whether the first joint rotates about the z axis of the base and moves all other links."""
    T_base_joint = robot.frame_offsets[0]
    on_axis = np.allclose(T_base_joint[:2, 3], 0.0, atol=1e-6) and bool(robot.moved_by[1:, 0].all())
    return not robot.prismatic[0] and on_axis and bool(np.isclose(T_base_joint[2, 2], 1.0, atol=1e-9))


def turned(
    robot: Robot,
    q: Float32[ndarray, "n waypoints dof"],
    scenes: PackedScenes,
    rng: np.random.Generator,
) -> tuple[Float32[ndarray, "n waypoints dof"], PackedScenes, Mask]:
    """Turn each motion and its scene by a random angle of at most pi, uniform within the limits of the first
    joint.

    Returns the turned motions, the turned scenes, and which motions are free of self-collision: after the
    turn, the arm may touch the base link. `turns_about_vertical` must hold for the robot.
    """
    first = q[:, :, 0]
    low = np.maximum(robot.lower[0] - first.min(1), -np.pi)
    high = np.minimum(robot.upper[0] - first.max(1), np.pi)
    angle = rng.uniform(np.minimum(low, 0.0), np.maximum(high, 0.0)).astype(np.float32)
    q = q.copy()
    q[:, :, 0] = np.clip(first + angle[:, None], robot.lower[0], robot.upper[0])
    free = CollisionChecker(robot, Scene([])).free(q.reshape(-1, q.shape[-1])).reshape(len(q), -1)
    return q, scenes.turned(angle), free.min(axis=1)
