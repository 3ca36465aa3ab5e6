"""Small data sets in the format of the data factory, made without planning, for tests of code that reads them."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy import ndarray
from numpy.random import Generator

from robotdiffuse.datasets.shards import Manifest, write_manifest, write_shard
from robotdiffuse.robots.robot import Robot, robot_fingerprint
from robotdiffuse.scenes.scene_arrays import BOX, SPHERE

WAYPOINTS = 254
SLOTS = 4
GOALS = 3


def manifest_of(robot: Robot, waypoints: int = WAYPOINTS, **changes: Any) -> Manifest:
    fields: dict[str, Any] = {
        "robot": robot.name,
        "robot_fingerprint": robot_fingerprint(robot),
        "joint_names": robot.joint_names,
        "lower": tuple(robot.lower.tolist()),
        "upper": tuple(robot.upper.tolist()),
        "waypoints": waypoints,
        "timing": "arc",
        "families": {"rop": {"sphere_radius": [0.25, 0.25]}},
        "floors": {"rop": {"center": [0.0, 0.0, -0.05], "size": [2.0, 2.0, 0.1]}},
        "slots": SLOTS,
        "goals": GOALS,
        "trajectories": 100,
        "shard": 50,
        "settings": {"seed": 0},
        "versions": {"robotdiffuse": "0"},
    }
    return Manifest(**fields | changes)


def random_arrays(robot: Robot, n: int, rng: Generator, waypoints: int = WAYPOINTS) -> dict[str, ndarray]:
    """Arrays of a shard: bent motions between random configurations, among spheres and boxes."""
    s = np.linspace(0, 1, waypoints)[:, None]
    ends = rng.uniform(0.6 * robot.lower, 0.6 * robot.upper, (2, n, 1, robot.dof))
    bow = rng.uniform(-0.3, 0.3, (n, 1, robot.dof)) * np.sin(np.pi * s)
    q = (ends[0] * (1 - s) + ends[1] * s + bow).astype(np.float32)
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
    return {
        "trajectories": q,
        "start": q[:, 0].copy(),
        "goals": goals,
        "goal_costs": costs,
        "goal_index": index.astype(np.int8),
        "target_pose": pose,
        "obstacle_kinds": kinds,
        "obstacle_params": params,
        "family": np.zeros(n, np.int8),
        "cost": np.ones(n, np.float32),
        "clearance": np.full(n, 0.05, np.float32),
        "end_clearance": np.full((n, 2), 0.05, np.float32),
        "safety_distance": np.full(n, 0.05, np.float32),
        "line_free": rng.random(n) < 0.3,
        "detour": np.ones(n, np.float32),
        "seed": np.arange(n, dtype=np.uint64),
    }


def write_store(folder: Path, robot: Robot, sizes: tuple[int, ...], waypoints: int = WAYPOINTS) -> Manifest:
    """Writes a manifest, and a shard of each size."""
    rng = np.random.default_rng(0)
    manifest = manifest_of(robot, waypoints)
    write_manifest(folder, manifest)
    for i, n in enumerate(sizes):
        write_shard(folder, i, random_arrays(robot, n, rng, waypoints), {"tried": n, "solved": n})
    return manifest
