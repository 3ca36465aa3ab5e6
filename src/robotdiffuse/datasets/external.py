"""Data sets of motions that were made elsewhere: `rd.write_dataset`, and the layout of the paper's authors.

In the authors' robot.npz, `x_train` [n, 254, 7] holds joint values [rad]. A row of `y_train` [n, 23] holds
the start (7 numbers), the goal that was reached (7), the centers of two spheres (6) and the position of the
target (3) [m]. The authors' viewer sends only the first 20 of the 23 numbers; that the last three are the
target's position is our interpretation. Both arrays are float32.
"""

import sys
from collections.abc import Iterable, Sequence
from pathlib import Path as FilePath
from typing import Any

import numpy as np
from jaxtyping import Float32
from numpy import ndarray
from numpy.typing import ArrayLike

from robotdiffuse import __version__
from robotdiffuse.collision import CollisionChecker
from robotdiffuse.collision.kernels.motions import motions_free
from robotdiffuse.collision.motions import search_space
from robotdiffuse.core.errors import InputError, check_type, counted, joined, numbers, reading, shown
from robotdiffuse.core.files import (
    check_output,
    file_name,
    input_file,
    known_ending,
    lock_folder,
    write_atomically,
)
from robotdiffuse.core.settings import AtLeastTwo, converted
from robotdiffuse.core.types import Done, Path, Trajectory, step_lengths, unreported
from robotdiffuse.datasets.shards import (
    MANIFEST,
    SPLITS,
    Manifest,
    Row,
    check_shapes,
    existing_shards,
    read_manifest,
    read_shard,
    resample,
    row_of,
    shard_indices,
    split_of,
    write_manifest,
    write_shard,
)
from robotdiffuse.problems.families import load_family
from robotdiffuse.problems.problem import LIMIT_SLACK, checked_configuration
from robotdiffuse.robots import load_robot
from robotdiffuse.robots.robot import Robot, check_joints, robot_fingerprint
from robotdiffuse.scenes.packed_scenes import NONE, SPHERE, PackedScenes
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.shapes import Box, Sphere

ROWS_PER_SHARD = 500
FAMILY = "own"
"""Family name of all scenes of a data set written by `write_dataset`."""
RESOLUTION = 0.02
"""No point of the arm moves further than this between two checks of the straight line from start to goal
[m]."""
WAYPOINTS = 254
DOF = 7
CONDITION_NUMBERS = 23
"""Number of values of a condition (a row of `y_train`) in robot.npz."""
SPHERE_RADIUS = 0.25
"""Radius of the spheres [m], as in the authors' planner. Their loader and viewer use 0.2, which leaves a
margin of 5 cm."""
END_TOLERANCE = 1e-4
"""Largest difference between the start and the first waypoint, and between the goal and the last waypoint
[rad]."""


def write_dataset(
    paths: Iterable[Path | Trajectory | ArrayLike],
    scenes: Scene | Sequence[Scene],
    folder: str | FilePath,
    robot: Robot | str = "panda",
    waypoints: int = 254,
) -> int:
    """Make a data set of motions, to train on.

    Motions are not validated here; `robotdiffuse data check` validates them. The target is the pose of the
    robot's tip at the last waypoint. Training, validation and test are split by scene, so give many scenes.

    Args:
        paths: Joint values of each motion [n, dof], in the order of the robot's planned joints [rad] or [m];
            or paths and trajectories, whose positions are taken. They are resampled evenly in joint space.
        scenes: The scene of each motion, of spheres and boxes; or one scene for all motions. If all scenes
            begin with the same box, not rotated and named "floor", it counts as the floor, which
            networks do not see.
        folder: A folder without data; it is made if it does not exist.
        robot: A robot, or an argument of `load_robot`.
        waypoints: Number of waypoints of a stored motion.

    Returns:
        The number of motions.

    Raises:
        InputError: If there are no paths, if a list of scenes does not have one for each path, and if no
            scene falls into the training split; for joint values of the wrong shape or out of limits,
            obstacles that are no spheres or boxes, allowed contacts, a robot that was changed after loading,
            fewer than 2 waypoints, and a folder that holds data.

    Examples:
        >>> start, goal = [0, -0.8, 0, -2.4, 0, 1.6, 0.8], [0.5, -0.2, 0, -2, 0, 1.8, 0.8]
        >>> scenes = [rd.Scene([rd.Sphere([0.5, -0.5, z], 0.1)]) for z in (0.3, 0.6, 0.9)]
        >>> rd.write_dataset([[start, goal]] * 3, scenes, "own", "panda", waypoints=48)
        3
    """
    arm = robot if isinstance(robot, Robot) else load_robot(robot)
    waypoints = converted("waypoints", AtLeastTwo, waypoints)
    target = file_name(folder, "folder")
    source = arm.source or arm.name
    if robot_fingerprint(load_robot(source)) != robot_fingerprint(arm):
        raise InputError(
            f"robot is {arm!r}; it must be load_robot({source!r}) as it is: data sets keep no tool, no held "
            "objects and no joints locked after loading"
        )
    check_type("paths", paths, Iterable, "a list of motions")
    check_type("scenes", scenes, (Scene, list, tuple), "an rd.Scene, or a list of them")
    motions = [_positions(arm, f"paths[{i}]", path) for i, path in enumerate(paths)]
    if not motions:
        raise InputError("paths is empty; a data set has at least one motion")
    per_path = [scenes] * len(motions) if isinstance(scenes, Scene) else list(scenes)
    if len(per_path) != len(motions):
        raise InputError(
            f"scenes has {counted(len(per_path), 'entry', 'entries')}; give one rd.Scene, or one "
            f"for each of {len(motions)} paths"
        )
    for i, scene in enumerate(per_path):
        check_type(f"scenes[{i}]", scene, Scene, "an rd.Scene")
        if scene.allowed_contacts:
            touched = joined([name for name, _ in scene.allowed_contacts])
            raise InputError(
                f"scenes[{i}] has allowed_contacts with {touched}; data sets keep no allowed contacts: "
                f"leave these shapes out of the scene"
            )
    floor = _shared_floor(per_path)
    slots = max(len(scene.shapes) for scene in per_path) - (floor is not None)
    packed = PackedScenes.pack(per_path, slots, floor is not None)
    if not (split_of(packed) == SPLITS.index("train")).any():
        raise InputError(
            "no scene falls into the training split, to which a hash assigns 90 % of scenes; give more scenes"
        )
    q = np.stack([resample(motion[None].astype(np.float32), waypoints)[0] for motion in motions])
    about = {"families": {FAMILY: {}}, "floors": {FAMILY: floor}, "slots": slots}
    about["settings"] = {"imported": "write_dataset"}
    return _write(target, arm, source, per_path, q, about)


def _write(
    folder: FilePath,
    robot: Robot,
    source: str,
    scenes: Sequence[Scene],
    q: Float32[ndarray, "n waypoints dof"],
    about: dict[str, Any],
    progress: Done = unreported,
) -> int:
    """Write a data set into an empty folder; returns the number of its motions.

    source: the robot's name or URDF, for the manifest. about: further fields of the manifest.
    """
    manifest = Manifest.of(
        robot,
        source,
        waypoints=q.shape[1],
        goals=1,
        trajectories=len(q),
        shard=ROWS_PER_SHARD,
        versions={"robotdiffuse": __version__},
        **about,
    )
    packed = PackedScenes.pack(scenes, manifest.slots, manifest.floor(0) is not None)
    with lock_folder(folder):
        if (folder / MANIFEST).exists() or shard_indices(folder):
            raise InputError(f"{folder} holds data already; write into another folder")
        for index, first in enumerate(range(0, len(q), ROWS_PER_SHARD)):
            rows = range(first, min(first + ROWS_PER_SHARD, len(q)))
            measured_rows = [measured_row(robot, scenes[i], packed[i : i + 1], q[i], i) for i in rows]
            arrays = {name: np.stack([row[name] for row in measured_rows]) for name in measured_rows[0]}
            write_shard(folder, index, arrays, {"tried": len(measured_rows), "solved": len(measured_rows)})
            progress(rows.stop, len(q))
        write_manifest(folder, manifest)
    return len(q)


def measured_row(
    robot: Robot, scene: Scene, packed: PackedScenes, q: Float32[ndarray, "waypoints dof"], number: int
) -> Row:
    """The row of a motion that was made elsewhere. number: stands in place of the problem's seed.

    Clearances, length and whether the straight line is free are measured; the safety distance is unknown and
    set to 0.
    """
    ends = q[[0, -1]]
    checker = CollisionChecker(robot, scene)
    line = motions_free(search_space(checker, RESOLUTION), ends)
    cost = float(step_lengths(q.astype(np.float64)).sum())
    return row_of(
        packed,
        q,
        checker.link_clearances(q).min(axis=1, initial=1.0),
        q[-1:],
        np.array([cost]),
        cost,
        robot.fk(q[-1]),
        most_goals=1,
        goal_index=0,
        family=0,
        safety_distance=0.0,
        line_free=bool(line[0] and checker.free(ends[:1])[0]),
        seed=number,
    )


def _positions(robot: Robot, name: str, path: object) -> ndarray:
    positions = path
    if isinstance(path, Path | Trajectory):
        positions = path.positions
        check_joints(name, path.joint_names, robot)
    q = numbers(positions)
    if q is None or q.ndim != 2 or q.shape[1] != robot.dof or len(q) < 2:
        names = ", ".join(robot.joint_names)
        raise InputError(
            f"{name} is {shown(positions)}; it must be n x {robot.dof} numbers, n at least 2: {names}"
        )
    within = np.isfinite(q) & (robot.limit_excess(q) <= LIMIT_SLACK)
    if not within.all():
        row = int(within.min(axis=1).argmin())
        checked_configuration(robot, f"{name}, row {row}", q[row], [])
    q = np.where(robot.continuous, q, np.clip(q, robot.lower, robot.upper))
    turns = np.concatenate([robot.whole_turns(q[:1]), robot.wraps(q)])
    return q - np.cumsum(turns, axis=0)  # the input may wrap continuous joints


def _shared_floor(scenes: Sequence[Scene]) -> Box | None:
    firsts = [scene.shapes[0] if scene.shapes else None for scene in scenes]
    floor = firsts[0]
    if not isinstance(floor, Box) or floor.name != "floor" or floor.wxyz[0] != 1:
        return None
    shared = (
        isinstance(shape, Box) and shape.name == "floor" and np.array_equal(shape.bounds, floor.bounds)
        for shape in firsts
    )
    return floor if all(shared) else None


# The layout of the paper's authors


def export_npz(folder: str | FilePath, file: str | FilePath) -> tuple[int, int]:
    """Write a robot.npz, atomically, with the motions of all scenes of exactly two spheres, besides a floor.

    Returns the number of written motions and the number of motions that were left out.

    Raises InputError if there is no data set or it is damaged, if it has no such scene, if its motions do not
    have 254 waypoints of 7 joints, or if the file does not end in .npz or cannot be written.
    """
    file = check_output(file, (".npz",))
    manifest = read_manifest(folder)
    if (manifest.waypoints, manifest.dof) != (WAYPOINTS, DOF):
        raise InputError(
            f"{folder} has {manifest.waypoints} waypoints of {manifest.dof} joints; "
            f"robot.npz holds {WAYPOINTS} waypoints of {DOF} joints"
        )
    x = []
    y = []
    total = 0
    for index in existing_shards(folder):
        shard = read_shard(folder, index)
        check_shapes(folder, shard, manifest)
        total += len(shard["trajectories"])
        kinds = shard["obstacle_kinds"]
        rows = np.flatnonzero(((kinds == SPHERE).sum(1) == 2) & ((kinds != NONE).sum(1) == 2))
        q = np.asarray(shard["trajectories"][rows])
        kinds = kinds[rows]
        centers = shard["obstacle_params"][rows][kinds == SPHERE, :3].reshape(-1, 6)
        x.append(q)
        y.append(np.concatenate([shard["start"][rows], q[:, -1], centers, shard["target_pose"][rows, 4:]], 1))
    if not any(map(len, x)):
        raise InputError(f"{folder} has no scene of exactly two spheres, all that robot.npz can hold")
    x_train = np.concatenate(x)
    y_train = np.concatenate(y)
    write_atomically(file, lambda stream: np.savez(stream, x_train=x_train, y_train=y_train))
    return len(x_train), total - len(x_train)


def import_npz(
    file: str | FilePath,
    folder: str | FilePath,
    robot: str = "panda",
    radius: float = SPHERE_RADIUS,
    progress: Done = unreported,
) -> int:
    """Make a data set in an empty folder from a robot.npz; returns the number of its motions.

    Scenes are ROP's floor and two spheres of this radius [m]. Motions are not validated here; `robotdiffuse
    data check` validates them. Clearances, lengths and whether the straight line is free are measured. The
    target is the pose of the robot's tip at the last waypoint; the file's targets are not used, since the
    authors' arm has no hand. The safety distance is unknown and set to 0. `progress` is called with the
    number of motions that are done and the number of all.

    Raises InputError if the file is no robot.npz, joint values are out of limits, the robot has other than 7
    joints, the radius is not positive, or the folder holds data or cannot be written.
    """
    arm = load_robot(robot)
    folder = FilePath(folder)
    if arm.dof != DOF:
        raise InputError(f"{arm.name} has {arm.dof} joints; robot.npz holds {DOF}")
    if not radius > 0:
        raise InputError(f"radius is {radius}; it must be positive")
    stored, centers = _read(file)
    motions = [_positions(arm, f"{file}: x_train[{i}]", motion) for i, motion in enumerate(stored)]
    floor = load_family("rop").floor
    assert floor is not None
    scenes = [Scene([floor, *(Sphere(center, radius) for center in pair)]) for pair in centers]
    about = {
        "families": {"rop": {"kinds": ["sphere"], "sphere_radius": [radius, radius]}},
        "floors": {"rop": floor},
        "slots": 2,
        "settings": {"imported": FilePath(file).name, "radius": radius},
    }
    return _write(folder, arm, robot, scenes, np.array(motions, np.float32), about, progress)


def _read(file: str | FilePath) -> tuple[Float32[ndarray, "n 254 7"], Float32[ndarray, "n 2 3"]]:
    """The motions, and the centers of the two spheres of each."""
    row_shapes = {"x_train": (WAYPOINTS, DOF), "y_train": (CONDITION_NUMBERS,)}
    known_ending(file, "data set", (".npz",))
    input_file(file, largest=sys.maxsize)
    with reading(file), np.load(file, allow_pickle=False) as stored:
        x, y = (np.asarray(stored[name], np.float32) for name in row_shapes)
    for (name, row), array in zip(row_shapes.items(), (x, y), strict=True):
        if array.shape != (*x.shape[:1], *row) or not len(x):
            shape = " x ".join(map(str, ("n", *row)))
            raise InputError(f"{file}: {name} has shape {array.shape}; it must be {shape}, with n at least 1")
        if not np.isfinite(array).all():
            raise InputError(f"{file}: {name} holds numbers that are not finite")
    ends = ("start", "first", y[:, :DOF], x[:, 0]), ("goal", "last", y[:, DOF : 2 * DOF], x[:, -1])
    for name, end, stated, actual in ends:
        difference = np.abs(stated - actual).max(axis=1)
        if difference.max() > END_TOLERANCE:
            raise InputError(
                f"{file}: row {difference.argmax()} has a {name} that differs from its {end} waypoint by "
                f"{difference.max():.3g} rad; they must be the same"
            )
    return x, y[:, 2 * DOF : 2 * DOF + 6].reshape(-1, 2, 3)
