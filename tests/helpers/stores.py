"""Small data sets in the format of the data factory, made without planning: random arrays, straight motions with records."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy import ndarray
from numpy.random import Generator

from robotdiffuse import Box, Robot, Scene, Sphere
from robotdiffuse.collision import CollisionChecker
from robotdiffuse.datasets.shards import Manifest, write_manifest, write_shard
from robotdiffuse.robots.robot import robot_fingerprint
from robotdiffuse.scenes.packed_scenes import BOX, SPHERE, PackedScenes

WAYPOINTS = 254
SLOTS = 4
GOALS = 3
FAMILIES = ("rop", "rop_dense")


def manifest_of(robot: Robot, waypoints: int = WAYPOINTS, **changes: Any) -> Manifest:
    fields: dict[str, Any] = {"robot": robot.name, "robot_fingerprint": robot_fingerprint(robot)}
    fields |= {"joint_names": robot.joint_names, "lower": tuple(robot.lower.tolist()), "upper": tuple(robot.upper.tolist())}
    fields |= {"waypoints": waypoints, "timing": "arc", "slots": SLOTS, "goals": GOALS, "trajectories": 100, "shard": 50}
    fields |= {"families": {"rop": {"sphere_radius": [0.25, 0.25]}}}
    fields |= {"floors": {"rop": {"center": [0.0, 0.0, -0.05], "size": [2.0, 2.0, 0.1]}}}
    fields |= {"settings": {"seed": 0}, "versions": {"robotdiffuse": "0"}}
    return Manifest(**fields | changes)


def random_arrays(robot: Robot, n: int, rng: Generator, waypoints: int = WAYPOINTS) -> dict[str, ndarray]:
    """Arrays of a shard: bent motions between random configurations, among spheres and boxes."""
    s = np.linspace(0, 1, waypoints)[:, None]
    ends = rng.uniform(0.6 * robot.lower, 0.6 * robot.upper, (2, n, 1, robot.dof))
    q = (ends[0] * (1 - s) + ends[1] * s + rng.uniform(-0.3, 0.3, (n, 1, robot.dof)) * np.sin(np.pi * s)).astype(np.float32)
    goals = np.full((n, GOALS, robot.dof), np.nan, np.float32)
    index = rng.integers(0, GOALS - 1, n)
    goals[:, : GOALS - 1] = rng.uniform(robot.lower, robot.upper, (n, GOALS - 1, robot.dof))
    goals[np.arange(n), index] = q[:, -1]
    costs = np.where(np.isnan(goals[..., 0]), np.nan, np.inf).astype(np.float32)
    costs[np.arange(n), index] = 1.0
    kinds = rng.integers(SPHERE, BOX + 1, (n, SLOTS)).astype(np.int8)
    kinds[:, 2:] = 0
    params = np.zeros((n, SLOTS, 10), np.float32)
    params[..., :3] = rng.uniform([-1, -1, 0.1], 1, (n, SLOTS, 3))
    params[..., 3] = np.where(kinds == SPHERE, 0.25, 0.2)
    params[kinds == BOX, 4:7] = 0.2, 0.2, 1.0
    params[kinds == 0] = 0
    pose = rng.uniform(-1, 1, (n, 7)).astype(np.float32)
    pose[:, :4] = [1, 0, 0, 0]
    near, one = np.full((n, 2), 0.05, np.float32), np.ones(n, np.float32)
    arrays: dict[str, ndarray] = {"trajectories": q, "start": q[:, 0].copy(), "target_pose": pose}
    arrays |= {"goals": goals, "goal_costs": costs, "goal_index": index.astype(np.int8)}
    arrays |= {"obstacle_kinds": kinds, "obstacle_params": params, "family": np.zeros(n, np.int8)}
    arrays |= {"clearance": near[:, 0].copy(), "end_clearance": near, "safety_distance": near[:, 0].copy()}
    arrays |= {"cost": one, "detour": one.copy(), "line_free": rng.random(n) < 0.3, "seed": np.arange(n, dtype=np.uint64)}
    return arrays


def write_store(folder: Path, robot: Robot, sizes: tuple[int, ...], waypoints: int = WAYPOINTS) -> Manifest:
    """Writes a manifest, and a shard of each size."""
    rng = np.random.default_rng(0)
    manifest = manifest_of(robot, waypoints)
    write_manifest(folder, manifest)
    for i, n in enumerate(sizes):
        write_shard(folder, i, random_arrays(robot, n, rng, waypoints), {"tried": n, "solved": n})
    return manifest


def line(start: ndarray, goal: ndarray, waypoints: int = 20) -> ndarray:
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
    at = CollisionChecker(robot, scene).link_clearances
    row: dict[str, Any] = {"trajectories": q, "start": q[0], "target_pose": np.array([1.0, 0, 0, 0, 0.3, 0, 0.5])}
    row |= {"goals": goals, "goal_costs": costs, "goal_index": np.array(0), "seed": np.array(7)}
    row |= {"obstacle_kinds": packed.kinds[0], "obstacle_params": packed.params[0], "family": np.array(family)}
    row |= {"clearance": at(q).min(initial=1.0), "end_clearance": at(q[[0, -1]]).min(axis=1, initial=1.0)}
    row |= {"safety_distance": np.array(0.05 if family == 0 else 0.04), "line_free": np.array(line_free)}
    return row | {"cost": length, "detour": length / np.linalg.norm(q[-1].astype(np.float64) - q[0])}


def write_motions(folder: Path, robot: Robot, rows: list[dict], shard: int = 100, waypoints: int = 20) -> Manifest:
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
