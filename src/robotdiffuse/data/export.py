"""The data set in the layout of the paper's authors, robot.npz."""

import os
from pathlib import Path as FilePath

import numpy as np

from robotdiffuse.data.manifest import read_manifest
from robotdiffuse.data.shards import check_shapes, read_shard, shard_indices
from robotdiffuse.errors import InputError
from robotdiffuse.scenes.packed import SPHERE

FRAMES, DOF = 254, 7
NAMES = ("trajectories", "start", "target_pose", "obstacle_kinds", "obstacle_params")


def export_npz(folder: str | FilePath, file: str | FilePath) -> int:
    """Write the trajectories of all scenes of exactly two spheres; returns their number.

    `x_train` [n, 254, 7]: joint values [rad]. `y_train` [n, 23]: start 7, goal that was reached 7, centres
    of the spheres 6, position of the target 3 [m]. The first 20 are what the authors' viewer sends; that
    the last three are the target's position is our reading of the 23. float32; the file is written whole or
    not at all.

    Raises InputError if there is no data set, it has no such scene or other frames or joints, or the file
    cannot be written.
    """
    manifest, file = read_manifest(folder), FilePath(file)
    if (manifest.frames, manifest.dof) != (FRAMES, DOF):
        raise InputError(
            f"{folder} has {manifest.frames} frames of {manifest.dof} joints; "
            f"robot.npz holds {FRAMES} frames of {DOF} joints"
        )
    x, y = [np.zeros((0, FRAMES, DOF), np.float32)], [np.zeros((0, 23), np.float32)]
    for index in shard_indices(folder):
        shard = read_shard(folder, index, NAMES)
        check_shapes(folder, shard, manifest)
        kinds = shard["obstacle_kinds"]
        rows = np.flatnonzero(((kinds == SPHERE).sum(1) == 2) & ((kinds != 0).sum(1) == 2))
        q, kinds = shard["trajectories"][rows], kinds[rows]
        centers = shard["obstacle_params"][rows][kinds == SPHERE, :3].reshape(-1, 6)
        x.append(q)
        y.append(np.concatenate([shard["start"][rows], q[:, -1], centers, shard["target_pose"][rows, 4:]], 1))
    x_train, y_train = np.concatenate(x), np.concatenate(y)
    if not len(x_train):
        raise InputError(f"{folder} has no scene of exactly two spheres, all that robot.npz can hold")
    fresh = file.with_name(f".{file.name}.{os.getpid()}")
    try:
        with open(fresh, "wb") as stream:
            np.savez(stream, x_train=x_train, y_train=y_train)
        os.replace(fresh, file)
    except OSError as error:
        raise InputError(f"cannot write {file}: {error.strerror or error}") from None
    finally:
        fresh.unlink(missing_ok=True)
    return len(x_train)
