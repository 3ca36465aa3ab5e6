"""Data sets of motions that were made elsewhere: `rd.write_dataset`."""

from collections.abc import Iterable, Sequence
from pathlib import Path as FilePath

import numpy as np
from jaxtyping import Float32
from numpy import ndarray
from numpy.typing import ArrayLike

from robotdiffuse import __version__
from robotdiffuse.collision import CollisionChecker
from robotdiffuse.collision.kernels.motions import motions_free
from robotdiffuse.collision.motions import search_space
from robotdiffuse.core.bounds import numbers
from robotdiffuse.core.errors import InputError, distinct, shown
from robotdiffuse.core.output_files import lock_folder
from robotdiffuse.core.types import Path, Trajectory
from robotdiffuse.datasets.manifest import MANIFEST, Manifest, floor_record, write_manifest
from robotdiffuse.datasets.motion_rows import Row, row_of
from robotdiffuse.datasets.rows import resample
from robotdiffuse.datasets.shards import SPLITS, shard_indices, split_of, write_shard
from robotdiffuse.problems.problem_fields import LIMIT_SLACK
from robotdiffuse.robots import load_robot
from robotdiffuse.robots.fingerprint import robot_fingerprint
from robotdiffuse.robots.kinematics import link_pose
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.scene_arrays import PackedScenes
from robotdiffuse.scenes.shapes import Box, Shape

ROWS_PER_SHARD = 500
FAMILY = "own"
"""Name of the family of all scenes of such a data set."""
RESOLUTION = 0.02
"""No point of the arm moves further than this between two checks of the straight line [m]."""


def write_dataset(
    paths: Iterable[Path | Trajectory | ArrayLike],
    scenes: Scene | Sequence[Scene],
    folder: str | FilePath,
    robot: Robot | str = "panda",
    waypoints: int = 254,
) -> int:
    """Make a data set of motions in an empty folder, to train on; returns their number.

    paths: joint values of each motion, n x dof [rad] or [m], in the order of the robot's planned joints; or
        paths and trajectories, of which the positions are taken. They are resampled evenly in joint space.
    scenes: the scene of each motion, of spheres and boxes; or one for all. A first box named "floor" that all
        scenes share is what the arm stands on, not an obstacle.
    robot: a Robot, or what `load_robot` takes.
    waypoints: rows of a stored motion.

    Motions are not validated: `robotdiffuse data check` does. The target is the pose of the robot's tip at
    the last waypoint. Training, validation and test are split by scene, so give many.

    Raises InputError for joint values of the wrong shape or out of limits, other shapes, a folder that holds
    data, and scenes of which none falls into the training split.
    """
    arm = robot if isinstance(robot, Robot) else load_robot(robot)
    if waypoints < 2:
        raise InputError(f"waypoints is {waypoints}; it must be at least 2")
    motions = [_positions(arm, i, path) for i, path in enumerate(paths)]
    if not motions:
        raise InputError("paths is empty; a data set has at least one motion")
    around = [scenes] * len(motions) if isinstance(scenes, Scene) else list(scenes)
    if len(around) != len(motions) or not all(isinstance(scene, Scene) for scene in around):
        raise InputError(
            f"scenes are {len(around)}; they must be one rd.Scene, or one for each of {len(motions)} paths"
        )
    floor = _shared_floor(around)
    slots = max(len(scene.shapes) for scene in around) - (floor is not None)
    packed = PackedScenes.pack(around, slots, floor is not None)
    if not (split_of(packed) == SPLITS.index("train")).any():
        raise InputError(
            "no scene falls into the training split, which takes most of them, by a hash; give more scenes"
        )
    q = np.stack([resample(motion[None].astype(np.float32), waypoints, exact=True)[0] for motion in motions])
    folder = FilePath(folder)
    with lock_folder(folder):
        if (folder / MANIFEST).exists() or shard_indices(folder):
            raise InputError(f"{folder} holds data already; write into another folder")
        for index, first in enumerate(range(0, len(q), ROWS_PER_SHARD)):
            rows = range(first, min(first + ROWS_PER_SHARD, len(q)))
            made = [measured_row(arm, around[i], packed[i : i + 1], q[i], i) for i in rows]
            arrays = {name: np.stack([row[name] for row in made]) for name in made[0]}
            write_shard(folder, index, arrays, {"tried": len(made), "solved": len(made)})
        write_manifest(folder, _manifest(arm, floor, slots, waypoints, len(q)))
    return len(q)


def measured_row(
    robot: Robot, scene: Scene, packed: PackedScenes, q: Float32[ndarray, "waypoints dof"], number: int
) -> Row:
    """The row of a motion that was made elsewhere, by its number.

    Clearances, its length and whether the straight line is free are measured; the safety distance is unknown
    and 0.
    """
    ends = q[[0, -1]]
    checker = CollisionChecker(robot, scene)
    line = motions_free(search_space(checker, RESOLUTION), ends)
    cost = float(np.linalg.norm(np.diff(q.astype(np.float64), axis=0), axis=1).sum())
    return row_of(
        packed,
        q,
        checker.link_clearances(q).min(axis=1, initial=1.0),
        goals=q[-1:],
        goal_costs=np.array([cost]),
        goal_index=0,
        T_base_tip=link_pose(robot, q[-1].astype(np.float64), robot.tip),
        family=0,
        cost=cost,
        safety_distance=0.0,
        line_free=bool(line[0] and checker.free(ends[:1])[0]),
        seed=number,
        most_goals=1,
    )


def _positions(robot: Robot, i: int, path: object) -> ndarray:
    given = path.positions if isinstance(path, Path | Trajectory) else path
    q = numbers(given)
    if q is None or q.ndim != 2 or q.shape[1] != robot.dof or len(q) < 2:
        names = ", ".join(robot.joint_names)
        raise InputError(
            f"paths[{i}] is {shown(given)}; it must be n x {robot.dof} numbers, n at least 2: {names}"
        )
    beyond = np.maximum(robot.lower - q, q - robot.upper)
    beyond[:, robot.continuous] = 0
    if not np.isfinite(q).all() or beyond.max() > LIMIT_SLACK:
        row, j = np.unravel_index(int(np.nanargmax(np.where(np.isfinite(q), beyond, np.inf))), q.shape)
        value, lower, upper = distinct(q[row, j], robot.lower[j], robot.upper[j])
        limits = f"its limits are {lower} to {upper} [rad]"
        raise InputError(f"paths[{i}]: {robot.joint_names[j]} is {value} in row {row}; {limits}")
    return q


def _shared_floor(scenes: Sequence[Scene]) -> Box | None:
    """The floor that all scenes begin with; None if there is none."""
    firsts = [scene.shapes[0] if scene.shapes else None for scene in scenes]
    floor = firsts[0]
    if not isinstance(floor, Box) or floor.name != "floor" or floor.wxyz[0] != 1:
        return None
    same = all(isinstance(one, Box) and one.name == "floor" and _equal(one, floor) for one in firsts)
    return floor if same else None


def _equal(a: Shape, b: Shape) -> bool:
    return bool(np.array_equal(a.bounds, b.bounds))


def _manifest(robot: Robot, floor: Box | None, slots: int, waypoints: int, count: int) -> Manifest:
    return Manifest(
        robot=robot.source or robot.name,
        robot_fingerprint=robot_fingerprint(robot),
        joint_names=robot.joint_names,
        lower=tuple(robot.lower.tolist()),
        upper=tuple(robot.upper.tolist()),
        waypoints=waypoints,
        timing="arc",
        families={FAMILY: {}},
        floors={FAMILY: floor_record(floor)},
        slots=slots,
        goals=1,
        trajectories=count,
        shard=ROWS_PER_SHARD,
        settings={"imported": "write_dataset"},
        versions={"robotdiffuse": __version__},
    )
