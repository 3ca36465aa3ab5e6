"""The rows of a data set, shard after shard, with copies of them turned; and even spacing of motions."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path as FilePath

import numpy as np
from jaxtyping import Float, Float32, Int8
from numpy import ndarray

from robotdiffuse.datasets.augmentation import turned
from robotdiffuse.datasets.manifest import read_manifest
from robotdiffuse.datasets.shards import (
    SPLITS,
    Shard,
    check_shapes,
    check_shard,
    existing_shards,
    read_shard,
    scenes_of,
    split_of,
)
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene_arrays import PackedScenes

NAMES = ("trajectories", "target_pose", "obstacle_kinds", "obstacle_params", "family")
"""Arrays that are read where shards are not checked throughout."""


@dataclass(frozen=True, eq=False)
class Rows:
    """The rows of a shard, or copies of them turned about the vertical."""

    shard: Shard
    """Where the other columns are; they are of the rows as they were before the turn."""
    turn: int
    """Number of the copy; 0: the rows themselves."""
    q: Float32[ndarray, "n waypoints dof"]
    """[rad]"""
    scenes: PackedScenes
    """With their floors."""
    split: Int8[ndarray, "n"]
    """Index into SPLITS; -1 for a copy that must not be used."""


def read_rows(
    folder: str | FilePath, robot: Robot | None = None, waypoints: int | None = None, turns: int = 0
) -> Iterator[Rows]:
    """The rows of all shards, one shard after the other, each followed by its turned copies.

    robot: the one that the data are used for. waypoints: so many, evenly spaced along each path, in memory,
    of shards that are checked throughout; None: those that are stored, mapped, of which the shapes are
    checked. turns: copies, see `turned`, of the rows for training; `waypoints` and a robot must be given.

    Raises InputError, naming the shard, if there are no data, they are damaged or of another robot.
    """
    manifest = read_manifest(folder)
    if robot is not None:
        manifest.check_robot(robot)
    for index in existing_shards(folder):
        if waypoints is None:
            shard = read_shard(folder, index, NAMES)
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
    """Each motion at `waypoints` places, evenly spaced in joint-space length; the ends are kept exactly.

    exact: whether what lies between two stored waypoints is reckoned in double precision, as `numpy.interp`
    has it, and then rounded: what is stored is made so; what is read is made faster.
    """
    n, stored = q.shape[:2]
    steps = np.linalg.norm(np.diff(q, axis=1), axis=2)
    at = np.concatenate([np.zeros((n, 1)), np.cumsum(steps, axis=1, dtype=np.float64)], axis=1)
    wanted = np.linspace(0.0, at[:, -1], waypoints, axis=1)
    # rows one after the other, far apart, are one rising list
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
