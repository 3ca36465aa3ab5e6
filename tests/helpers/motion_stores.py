"""Small data sets of straight motions with correct records, for tests of code that validates or shows data."""

from pathlib import Path

import numpy as np
from numpy import ndarray

from helpers.stores import GOALS, SLOTS, manifest_of
from robotdiffuse.collision import CollisionChecker
from robotdiffuse.datasets.shards import Manifest, write_manifest, write_shard
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.scene_arrays import PackedScenes
from robotdiffuse.scenes.shapes import Box, Sphere

WAYPOINTS = 20
FAMILIES = ("rop", "rop_dense")


def line(start: ndarray, goal: ndarray, waypoints: int = WAYPOINTS) -> ndarray:
    s = np.linspace(0, 1, waypoints)[:, None]
    return ((1 - s) * start + s * goal).astype(np.float32)


def record(robot: Robot, scene: Scene, q: ndarray, family: int = 0, line_free: bool = True) -> dict[str, ndarray]:
    """The row of a motion. The last goal is missing, and the second one was not reached."""
    goals = np.full((GOALS, robot.dof), np.nan)
    costs = np.full(GOALS, np.nan)
    goals[0] = q[-1]
    goals[1] = q[-1] + 0.1
    length = np.linalg.norm(np.diff(q.astype(np.float64), axis=0), axis=1).sum()
    costs[:2] = length, np.inf
    packed = PackedScenes.pack([scene], SLOTS)
    return {
        "trajectories": q,
        "start": q[0],
        "goals": goals,
        "goal_costs": costs,
        "goal_index": np.array(0),
        "target_pose": np.array([1.0, 0, 0, 0, 0.3, 0, 0.5]),
        "obstacle_kinds": packed.kinds[0],
        "obstacle_params": packed.params[0],
        "family": np.array(family),
        "cost": length,
        "clearance": CollisionChecker(robot, scene).link_clearances(q).min(initial=1.0),
        "end_clearance": CollisionChecker(robot, scene).link_clearances(q[[0, -1]]).min(axis=1, initial=1.0),
        "safety_distance": np.array(0.05 if family == 0 else 0.04),
        "line_free": np.array(line_free),
        "detour": length / np.linalg.norm(q[-1].astype(np.float64) - q[0]),
        "seed": np.array(7),
    }


def write_motions(
    folder: Path, robot: Robot, rows: list[dict[str, ndarray]], shard: int = 100, waypoints: int = WAYPOINTS
) -> Manifest:
    """Writes a data set of these rows without a floor, with this number of rows in a shard."""
    of = {"families": {name: {} for name in FAMILIES}, "floors": dict.fromkeys(FAMILIES)}
    manifest = manifest_of(robot, waypoints, trajectories=len(rows), shard=shard, **of)
    write_manifest(folder, manifest)
    for i in range(0, len(rows), shard):
        part = rows[i : i + shard]
        counts = {"tried": len(part) + 2, "solved": len(part), "unsolved": 1, "refused": 0, "thinned": 1}
        write_shard(folder, i // shard, {name: np.stack([r[name] for r in part]) for name in part[0]}, counts)
    return manifest


def random_motions(robot: Robot, n: int) -> list[dict[str, ndarray]]:
    """Short straight motions among obstacles that are out of reach, alternately of both families."""
    rng = np.random.default_rng(0)
    rows = []
    for i in range(n):
        start = robot.lower + (robot.upper - robot.lower) * rng.uniform(0.45, 0.55, robot.dof)
        q = line(start, start + rng.uniform(-0.2, 0.2, robot.dof))
        x, y, z = rng.uniform([2.0, -1.0, 0.1], [3.0, 1.0, 1.0])
        shapes = [Sphere([x, y, z], 0.25), Box([-x, y, z], [0.2, 0.2, 0.2])]
        rows.append(record(robot, Scene(shapes[: 1 + i % 2]), q, family=i % 2, line_free=i % 3 > 0))
    return rows
