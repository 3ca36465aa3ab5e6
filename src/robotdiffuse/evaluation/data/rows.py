"""Rows of a data set as problems and motions again."""

from collections.abc import Iterator
from pathlib import Path as FilePath

import numpy as np
from jaxtyping import Int
from numpy import ndarray

from robotdiffuse.data.shards import Manifest, Shard, read_shard, shard_indices
from robotdiffuse.errors import InputError
from robotdiffuse.problems.families import load_family
from robotdiffuse.problems.problem import JointGoal, Problem
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.packed import unpack_scene
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.shapes import Box
from robotdiffuse.types import Path, Trajectory


def family_names(manifest: Manifest) -> tuple[str, ...]:
    """Names of the families, in the order of the numbers in `family`."""
    return tuple(manifest.families)


def family_floor(manifest: Manifest, family: int) -> Box | None:
    """The floor of a family's scenes; None if they have none.

    ROP's floors had settings of their own once. Raises InputError for a family that is not known.
    """
    names = family_names(manifest)
    if not 0 <= family < len(names):
        raise InputError(f"family is {family}; the manifest has {len(names)}: {', '.join(names)}")
    name, settings = names[family], manifest.families[names[family]]
    if not settings.get("floor", True):
        return None
    if "floor_size" in settings:
        size, thickness = settings["floor_size"], settings["floor_thickness"]
        return Box((0.0, 0.0, -thickness / 2), (size, size, thickness), name="floor")
    return load_family(name).floor


def scene_of(manifest: Manifest, shard: Shard, row: int) -> Scene:
    """The scene of a row: the family's floor first, if it has one, then the obstacles."""
    floor = family_floor(manifest, int(shard["family"][row]))
    obstacles = unpack_scene(shard["obstacle_kinds"][row], shard["obstacle_params"][row]).shapes
    return Scene([*([] if floor is None else [floor]), *obstacles])


def problem_of(manifest: Manifest, robot: Robot, shard: Shard, row: int) -> Problem:
    """The problem that a row solves, with all its goal configurations.

    Raises InputError if the row makes no problem, such as a start out of limits.
    """
    goals = np.asarray(shard["goals"][row], np.float64)
    goals = goals[~np.isnan(goals).any(axis=1)]
    start = np.asarray(shard["start"][row], np.float64)
    return Problem(robot, scene_of(manifest, shard, row), start, JointGoal(goals))


def path_of(robot: Robot, shard: Shard, row: int) -> Path:
    """The frames of a row as a path."""
    return Path(robot.joint_names, np.asarray(shard["trajectories"][row], np.float64))


def motion_of(robot: Robot, shard: Shard, row: int) -> Path | Trajectory:
    """The frames of a row as they move: timed, with rates by differences, where the data have times."""
    path = path_of(robot, shard, row)
    times = np.asarray(shard.arrays.get("times", ()), np.float64)
    if not len(times) or not (np.diff(times[row]) > 0).all():
        return path
    velocities = np.gradient(path.positions, times[row], axis=0)
    accelerations = np.gradient(velocities, times[row], axis=0)
    return Trajectory(robot.joint_names, times[row], path.positions, velocities, accelerations)


def pick_rows(sizes: dict[int, int], count: int | None, seed: int) -> dict[int, Int[ndarray, "n"]]:
    """Random rows without repetition, all where `count` is None, from shards of these sizes by number."""
    total, first, picked = sum(sizes.values()), 0, {}
    if count is None or count >= total:
        rows = np.arange(total)
    else:
        rows = np.sort(np.random.default_rng(seed).choice(total, count, replace=False))
    for index, size in sizes.items():
        picked[index] = rows[(rows >= first) & (rows < first + size)] - first
        first += size
    return picked


def random_rows(folder: str | FilePath, count: int, seed: int) -> Iterator[tuple[Shard, Int[ndarray, "n"]]]:
    """The shards that random rows are from, with these rows. Raises InputError for a damaged shard."""
    sizes = {index: len(read_shard(folder, index, ("family",))) for index in shard_indices(folder)}
    for index, rows in pick_rows(sizes, count, seed).items():
        if len(rows):
            yield read_shard(folder, index), rows
