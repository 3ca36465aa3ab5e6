"""Conversion between motions and rows of a shard."""

import numpy as np
from jaxtyping import Float, Float32
from numpy import ndarray

from robotdiffuse.core.errors import InputError
from robotdiffuse.core.transforms import quaternion_from_rotation
from robotdiffuse.core.types import Path, Trajectory
from robotdiffuse.datasets.manifest import Manifest
from robotdiffuse.datasets.shards import Shard
from robotdiffuse.problems.problem import JointGoal, Problem
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene_arrays import PackedScenes, floor_row

Row = dict[str, ndarray | np.generic]
"""One row of each of ARRAYS."""


def row_of(
    scene: PackedScenes,
    q: Float32[ndarray, "waypoints dof"],
    clearances: Float[ndarray, "waypoints"],
    goals: Float[ndarray, "k dof"],
    goal_costs: Float[ndarray, "k"],
    goal_index: int,
    T_base_tip: Float[ndarray, "4 4"],
    family: int,
    cost: float,
    safety_distance: float,
    line_free: bool,
    seed: int,
    most_goals: int,
    times: Float[ndarray, "waypoints"] | None = None,
) -> Row:
    """The row of a motion q in a packed scene.

    clearances: of the waypoints [m].
    T_base_tip: the target.
    most_goals: rows for goals.

    The other arguments are the values of the arrays of their names.
    """
    missing = [(0, most_goals - len(goals)), (0, 0)]
    straight = float(np.linalg.norm(q[-1].astype(np.float64) - q[0]))
    wxyz = quaternion_from_rotation(T_base_tip[:3, :3])
    row: Row = {
        "trajectories": q,
        "start": q[0],
        "goals": np.pad(goals.astype(np.float32), missing, constant_values=np.nan),
        "goal_costs": np.pad(goal_costs.astype(np.float32), missing[0], constant_values=np.nan),
        "goal_index": np.int8(goal_index),
        "target_pose": np.concatenate([wxyz, T_base_tip[:3, 3]]).astype(np.float32),
        "obstacle_kinds": scene.kinds[0],
        "obstacle_params": scene.params[0],
        "family": np.int8(family),
        "cost": np.float32(cost),
        "clearance": np.float32(clearances.min()),
        "end_clearance": clearances[[0, -1]].astype(np.float32),
        "safety_distance": np.float32(safety_distance),
        "line_free": np.bool_(line_free),
        "detour": np.float32(cost / max(straight, 1e-9)),
        "seed": np.uint64(seed),
    }
    if times is not None:
        row["times"] = times.astype(np.float32)
    return row


def scenes_of(manifest: Manifest, shard: Shard, rows: slice = slice(None)) -> PackedScenes:
    """The scenes of some rows, with the floors of their families.

    Raises InputError for a family that the manifest does not have.
    """
    family, names = shard["family"][rows], list(manifest.families)
    if len(family) and not 0 <= family.min() <= family.max() < len(names):
        wrong = family[(family < 0) | (family >= len(names))][0]
        raise InputError(f"family is {wrong}; the manifest has {len(names)}: {', '.join(names)}")
    floors = np.array([floor_row(manifest.floor(i)) for i in range(len(names))]).reshape(-1, 6)
    return PackedScenes(shard["obstacle_kinds"][rows], shard["obstacle_params"][rows], floors[family])


def problem_of(manifest: Manifest, robot: Robot, shard: Shard, row: int) -> Problem:
    """The problem that a row solves, with all its goal configurations.

    Raises InputError if the row is no valid problem, as with a start outside the limits.
    """
    goals = np.asarray(shard["goals"][row], np.float64)
    goals = goals[~np.isnan(goals).any(axis=1)]
    start = np.asarray(shard["start"][row], np.float64)
    scene = scenes_of(manifest, shard, slice(row, row + 1)).scene(0)
    return Problem(robot, scene, start, JointGoal(goals))


def path_of(robot: Robot, shard: Shard, row: int) -> Path:
    """The waypoints of a row as a path."""
    return Path(robot.joint_names, np.asarray(shard["trajectories"][row], np.float64))


def motion_of(robot: Robot, shard: Shard, row: int) -> Path | Trajectory:
    """The motion of a row: a trajectory, its rates by finite differences, if the data have times, else a
    path."""
    path = path_of(robot, shard, row)
    times = np.asarray(shard.arrays.get("times", ()), np.float64)
    if not len(times) or not (np.diff(times[row]) > 0).all():
        return path
    velocities = np.gradient(path.positions, times[row], axis=0)
    accelerations = np.gradient(velocities, times[row], axis=0)
    return Trajectory(robot.joint_names, times[row], path.positions, velocities, accelerations)
