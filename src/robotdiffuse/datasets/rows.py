"""Converts rows of a data set to motions and problems, and reads them for training, with rotated copies.

If the first joint rotates about the base's z axis, a scene and its motion can be rotated together about this
axis: the angle is added to the first joint. Such copies need no planning. The base link does not rotate, so
copies in which the arm would touch it are left out. The floor does not rotate either, but its corners are out
of reach.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path as FilePath
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, Int8
from numpy import ndarray

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.core.errors import InputError
from robotdiffuse.core.transforms import quaternion_from_rotation
from robotdiffuse.core.types import Configurations, Mask, Path, Pose, Trajectory, Values
from robotdiffuse.datasets.shards import (
    ARRAYS,
    SPLITS,
    Manifest,
    Shard,
    check_shapes,
    check_shard,
    existing_shards,
    read_manifest,
    read_shard,
    split_of,
)
from robotdiffuse.problems.problem import JointGoal, Problem
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.scene_arrays import PackedScenes, floor_row

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
    wxyz = quaternion_from_rotation(T_base_tip[:3, :3])
    row: dict[str, Any] = values | {
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
        raise InputError(f"family is {wrong}; the manifest has {len(names)}: {', '.join(names)}")
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


@dataclass(frozen=True, eq=False)
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
    """Index into SPLITS; -1 for copies that must not be used: those of rows that are not for training, and
    those that touch the base link."""


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
        at = np.linspace(0.0, lengths[-1], waypoints)
        for joint in range(q.shape[2]):
            out[:, joint] = np.interp(at, lengths, motion[:, joint])
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

    Returns the turned motions, the turned scenes, and which motions are free of self-collision: a motion
    could be turned into the base link. `turns_about_vertical` must hold for the robot.
    """
    first = q[:, :, 0]
    low = np.maximum(robot.lower[0] - first.min(1), -np.pi)
    high = np.minimum(robot.upper[0] - first.max(1), np.pi)
    angle = rng.uniform(np.minimum(low, 0.0), np.maximum(high, 0.0)).astype(np.float32)
    q = q.copy()
    q[:, :, 0] = np.clip(first + angle[:, None], robot.lower[0], robot.upper[0])
    free = CollisionChecker(robot, Scene([])).free(q.reshape(-1, q.shape[-1])).reshape(len(q), -1)
    return q, scenes.turned(angle), free.min(axis=1)
