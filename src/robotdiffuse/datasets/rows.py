"""Reading the rows of a data set, with turned copies; and resampling motions evenly."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path as FilePath

import numpy as np
from jaxtyping import Float, Float32, Int8
from numpy import ndarray

from robotdiffuse.datasets.augmentation import turned
from robotdiffuse.datasets.manifest import read_manifest
from robotdiffuse.datasets.motion_rows import scenes_of
from robotdiffuse.datasets.shards import (
    SPLITS,
    Shard,
    check_shapes,
    check_shard,
    existing_shards,
    read_shard,
    split_of,
)
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene_arrays import PackedScenes

ARRAYS_READ = ("trajectories", "target_pose", "obstacle_kinds", "obstacle_params", "family")
"""Arrays that are read from shards that are not fully checked."""


@dataclass(frozen=True, eq=False)
class Rows:
    """The rows of a shard, or copies turned about the vertical."""

    shard: Shard
    """The shard with the other arrays; these are not turned."""
    turn: int
    """Number of the copy; 0 for the rows themselves."""
    q: Float32[ndarray, "n waypoints dof"]
    """[rad]"""
    scenes: PackedScenes
    """The scenes with their floors."""
    split: Int8[ndarray, "n"]
    """Index into SPLITS; -1 for copies that must not be used."""


def read_rows(
    folder: str | FilePath, robot: Robot | None = None, waypoints: int | None = None, turns: int = 0
) -> Iterator[Rows]:
    """Read the rows of all shards, each shard followed by its turned copies.

    robot: the robot that the data are used for.
    waypoints: resample to so many, evenly spaced along each path, in memory; shards are then fully checked.
        None: the stored ones, mapped to memory; only their shapes are checked.
    turns: copies of the training rows, see `turned`; these need `waypoints` and a robot.

    Raises InputError, naming the shard, if data are missing, damaged or of another robot.
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
        stored, scenes = shard["trajectories"].view(ndarray), scenes_of(manifest, shard)
        split = split_of(scenes)
        yield Rows(shard, 0, stored if waypoints is None else resample(stored, waypoints), scenes, split)
        for turn in range(1, turns + 1):
            assert robot is not None and waypoints is not None
            rng = np.random.default_rng([int(shard.fingerprint, 16), turn])
            q, around, clear = turned(robot, stored, scenes, rng)
            usable = (split == SPLITS.index("train")) & clear
            even = np.zeros((len(q), waypoints, q.shape[2]), np.float32)
            even[usable] = resample(q[usable], waypoints)
            yield Rows(shard, turn, even, around, np.where(usable, split, -1).astype(np.int8))


def resample(
    q: Float[ndarray, "n stored dof"], waypoints: int, exact: bool = False
) -> Float[ndarray, "n {waypoints} dof"]:
    """Resample each motion to `waypoints` places evenly spaced in joint-space length; the ends are kept
    exactly.

    exact: whether to interpolate in double precision, as `numpy.interp`, and round then. Stored data are made
    so; reading uses the faster way.
    """
    n, stored = q.shape[:2]
    steps = np.linalg.norm(np.diff(q, axis=1), axis=2)
    at = np.concatenate([np.zeros((n, 1)), np.cumsum(steps, axis=1, dtype=np.float64)], axis=1)
    wanted = np.linspace(0.0, at[:, -1], waypoints, axis=1)
    # offsets make the rows one ascending list, for a single search
    row = 2.0 * at.max(initial=0.0) * np.arange(n)[:, None]
    after = np.searchsorted((at + row).reshape(-1), (wanted + row).reshape(-1), side="right")
    after = np.clip(after.reshape(n, waypoints) - np.arange(n)[:, None] * stored, 1, stored - 1)
    low, high = (np.take_along_axis(at, i, 1)[..., None] for i in (after - 1, after))
    below, above = (np.take_along_axis(q, i[..., None], 1) for i in (after - 1, after))
    into, long = wanted[..., None] - low, np.maximum(high - low, np.finfo(np.float64).tiny)
    if exact:
        even = ((above.astype(np.float64) - below) / long * into + below).astype(q.dtype)
    else:
        even = below + (into / long).clip(0, 1).astype(q.dtype) * (above - below)
    even[:, 0], even[:, -1] = q[:, 0], q[:, -1]
    return even
