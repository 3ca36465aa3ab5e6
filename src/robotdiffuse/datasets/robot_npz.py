"""Export and import of robot.npz, the data layout of the paper's authors.

`x_train` [n, 254, 7]: joint values [rad]. `y_train` [n, 23]: start 7, goal that was reached 7, centres of two
spheres 6, position of the target 3 [m]. The authors' viewer sends the first 20; that the last three are the
target's position is our interpretation of the 23. float32.
"""

import os
import sys
from collections.abc import Callable
from pathlib import Path as FilePath

import numpy as np
from jaxtyping import Float32
from numpy import ndarray

from robotdiffuse import __version__
from robotdiffuse.core.errors import InputError, shortened
from robotdiffuse.core.input_files import input_file
from robotdiffuse.core.output_files import lock_folder, write_error
from robotdiffuse.datasets.manifest import MANIFEST, Manifest, floor_record, read_manifest, write_manifest
from robotdiffuse.datasets.motion_rows import Row
from robotdiffuse.datasets.own_motions import measured_row
from robotdiffuse.datasets.shards import check_shapes, read_shard, shard_indices, write_shard
from robotdiffuse.problems.families import load_family
from robotdiffuse.robots import load_robot
from robotdiffuse.robots.fingerprint import robot_fingerprint
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.scene_arrays import NONE, SPHERE, PackedScenes
from robotdiffuse.scenes.shapes import Sphere

WAYPOINTS, DOF, CONDITION_NUMBERS = 254, 7, 23
ROWS_PER_SHARD = 500
SPHERE_RADIUS = 0.25
"""[m]; that of the authors' planner. Their loader and viewer use 0.2, which leaves a margin of 5 cm."""
END_TOLERANCE = 1e-4
"""Largest difference of start and goal from the first and last waypoint [rad]."""
ARRAYS_READ = ("trajectories", "start", "target_pose", "obstacle_kinds", "obstacle_params")


def export_npz(folder: str | FilePath, file: str | FilePath) -> tuple[int, int]:
    """Write the trajectories of all scenes with exactly two spheres, atomically.

    Returns their number, and the number of those that were left out.

    Raises InputError if there is no data set, it has no such scene, other numbers of waypoints or joints, or
    the file cannot be written.
    """
    manifest, file = read_manifest(folder), FilePath(file)
    if (manifest.waypoints, manifest.dof) != (WAYPOINTS, DOF):
        raise InputError(
            f"{folder} has {manifest.waypoints} waypoints of {manifest.dof} joints; "
            f"robot.npz holds {WAYPOINTS} waypoints of {DOF} joints"
        )
    x, y = [np.zeros((0, WAYPOINTS, DOF), np.float32)], [np.zeros((0, CONDITION_NUMBERS), np.float32)]
    total = 0
    for index in shard_indices(folder):
        shard = read_shard(folder, index, ARRAYS_READ)
        check_shapes(folder, shard, manifest)
        total += len(shard["trajectories"])
        kinds = shard["obstacle_kinds"]
        rows = np.flatnonzero(((kinds == SPHERE).sum(1) == 2) & ((kinds != NONE).sum(1) == 2))
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
        raise write_error(file, error) from None
    finally:
        fresh.unlink(missing_ok=True)
    return len(x_train), total - len(x_train)


def import_npz(
    file: str | FilePath,
    folder: str | FilePath,
    robot: str = "panda",
    radius: float = SPHERE_RADIUS,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> int:
    """Make a data set from a robot.npz in an empty folder; returns the number of its motions.

    Scenes are two spheres of this radius [m] on ROP's floor. Motions are not validated; `robotdiffuse data
    check` does. Clearances, lengths and whether the straight line is free are measured. The target is the
    pose of the robot's tip at the last waypoint: the target in the file is that of the authors' arm, which
    has no hand. The safety distance is unknown and set to 0. `progress` is called with the numbers of motions
    done and in all.

    Raises InputError if the file is no robot.npz, or the folder holds data or cannot be written.
    """
    arm, folder = load_robot(robot), FilePath(folder)
    if arm.dof != DOF:
        raise InputError(f"{arm.name} has {arm.dof} joints; robot.npz holds {DOF}")
    if not radius > 0:
        raise InputError(f"radius is {radius}; it must be positive")
    q, centers = _read(file)
    manifest = Manifest(
        robot=robot,
        robot_fingerprint=robot_fingerprint(arm),
        joint_names=arm.joint_names,
        lower=tuple(arm.lower.tolist()),
        upper=tuple(arm.upper.tolist()),
        waypoints=WAYPOINTS,
        timing="arc",
        families={"rop": {"kinds": ["sphere"], "sphere_radius": [radius, radius]}},
        floors={"rop": floor_record(load_family("rop").floor)},
        slots=2,
        goals=1,
        trajectories=len(q),
        shard=ROWS_PER_SHARD,
        settings={"imported": FilePath(file).name, "radius": radius},
        versions={"robotdiffuse": __version__},
    )
    with lock_folder(folder):
        if (folder / MANIFEST).exists() or shard_indices(folder):
            raise InputError(f"{folder} holds data already; import into another folder")
        for index, first in enumerate(range(0, len(q), ROWS_PER_SHARD)):
            rows = range(first, min(first + ROWS_PER_SHARD, len(q)))
            made = [_row(arm, manifest, q[i], centers[i], radius, i) for i in rows]
            arrays = {name: np.stack([row[name] for row in made]) for name in made[0]}
            write_shard(folder, index, arrays, {"tried": len(made), "solved": len(made)})
            progress(rows.stop, len(q))
        write_manifest(folder, manifest)
    return len(q)


def _row(
    robot: Robot,
    manifest: Manifest,
    q: Float32[ndarray, "waypoints dof"],
    centers: Float32[ndarray, "2 3"],
    radius: float,
    number: int,
) -> Row:
    floor = manifest.floor(0)
    assert floor is not None
    scene = Scene([floor, *(Sphere(center, radius) for center in centers)])
    return measured_row(robot, scene, PackedScenes.pack([scene], manifest.slots, floor=True), q, number)


def _read(file: str | FilePath) -> tuple[Float32[ndarray, "n 254 7"], Float32[ndarray, "n 2 3"]]:
    """The motions, and the centres of the two spheres of each."""
    wanted = {"x_train": (WAYPOINTS, DOF), "y_train": (CONDITION_NUMBERS,)}
    input_file(file, largest=sys.maxsize)
    try:
        with np.load(file, allow_pickle=False) as stored:
            x, y = (np.asarray(stored[name], np.float32) for name in wanted)
    except OSError as error:
        raise InputError(f"cannot read {file}: {error.strerror or error}") from None
    except Exception as error:  # NumPy, zipfile and Python's tokenizer raise many types of exceptions
        raise InputError(f"{file} is no robot.npz: {shortened(str(error))}") from None
    for (name, row), array in zip(wanted.items(), (x, y), strict=True):
        if array.shape != (len(x), *row) or not len(x):
            shape = " x ".join(map(str, ("n", *row)))
            raise InputError(f"{file}: {name} has shape {array.shape}; it must be {shape}, with n at least 1")
        if not np.isfinite(array).all():
            raise InputError(f"{file}: {name} holds numbers that are not finite")
    for name, stated, found in (("start", y[:, :DOF], x[:, 0]), ("goal", y[:, DOF : 2 * DOF], x[:, -1])):
        off = np.abs(stated - found).max(axis=1)
        if off.max() > END_TOLERANCE:
            end = "first" if name == "start" else "last"
            raise InputError(
                f"{file}: row {off.argmax()} has a {name} that differs from its {end} waypoint by "
                f"{off.max():.3g} rad; they must be the same"
            )
    return x, y[:, 2 * DOF : 2 * DOF + 6].reshape(-1, 2, 3)
