"""The loader: trajectories a second, with point clouds made on the fly, on this machine's CPU.

    python benchmarks/loader.py [--trajectories 20000] [--threads 1 2]

Prints the report that is kept in benchmarks/results/loader.txt. The data set is made up, in the form of the
data factory's with its two families: 85 % of the scenes have two obstacles, the others 3 to 12. Times are of
one epoch of shuffled batches of 256, after some for warming up; files are in the system's cache.
"""

import argparse
import itertools
import tempfile
import time
from pathlib import Path

import numpy as np
import torch
from report import header, print_table

from robotdiffuse.datasets.loader import RopDataset
from robotdiffuse.datasets.manifest import Manifest, floor_record, write_manifest
from robotdiffuse.datasets.shards import SPLITS, write_shard
from robotdiffuse.problems.families.rop import ROP
from robotdiffuse.problems.families.rop_dense import ROP_DENSE
from robotdiffuse.robots import load_robot
from robotdiffuse.robots.fingerprint import robot_fingerprint
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene_arrays import PackedScenes

WAYPOINTS, SLOTS, GOALS, SHARD = 254, 12, 10, 1000
POINTS, BATCH, DENSE_SHARE = 1400, 256, 0.15
WARM_UP = 8
TARGET = 20_000
"""Trajectories a second that issue 3 asks for on two cores, clouds included."""


def write_store(folder: str, robot: Robot, trajectories: int) -> None:
    """Straight lines between random configurations in random scenes."""
    manifest = Manifest(
        robot=robot.name,
        robot_fingerprint=robot_fingerprint(robot),
        joint_names=robot.joint_names,
        lower=tuple(robot.lower.tolist()),
        upper=tuple(robot.upper.tolist()),
        waypoints=WAYPOINTS,
        timing="arc",
        families={"rop": {}, "rop_dense": {}},
        floors=dict.fromkeys(("rop", "rop_dense"), floor_record(ROP.floor)),
        slots=SLOTS,
        goals=GOALS,
        trajectories=trajectories,
        shard=SHARD,
        settings={},
        versions={},
    )
    write_manifest(folder, manifest)
    rng, s = np.random.default_rng(0), np.linspace(0, 1, WAYPOINTS, dtype=np.float32)[:, None]
    for index in range(-(-trajectories // SHARD)):
        n = min(SHARD, trajectories - index * SHARD)
        ends = rng.uniform(robot.lower, robot.upper, (2, n, robot.dof)).astype(np.float32)
        dense = rng.random(n) < DENSE_SHARE
        scenes = [(ROP_DENSE if d else ROP).scene(rng) for d in dense]
        packed = PackedScenes.pack(scenes, SLOTS, floor=True)
        goals = np.repeat(ends[1][:, None], GOALS, axis=1)
        arrays = {
            "trajectories": ends[0][:, None] * (1 - s) + ends[1][:, None] * s,
            "start": ends[0],
            "goals": goals,
            "goal_costs": np.zeros((n, GOALS)),
            "goal_index": np.zeros(n),
            "target_pose": np.zeros((n, 7)),
            "obstacle_kinds": packed.kinds,
            "obstacle_params": packed.params,
            "family": dense,
            "end_clearance": np.zeros((n, 2)),
            **{name: np.zeros(n) for name in ("cost", "clearance", "safety_distance", "line_free", "detour")},
            "seed": np.arange(n),
        }
        write_shard(folder, index, arrays, {})


def rate(data: RopDataset) -> float:
    """Trajectories a second, over one epoch."""
    for _batch in itertools.islice(data.batches(BATCH), WARM_UP):
        pass
    start = time.perf_counter()
    for _batch in data.batches(BATCH):
        pass
    return len(data) / (time.perf_counter() - start)


def main() -> None:
    parser = argparse.ArgumentParser(description="Trajectories a second that the loader gives, with clouds.")
    parser.add_argument("--trajectories", type=int, default=20_000)
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    options = parser.parse_args()
    print(header("torch", "numpy", "zarr"))
    cases = {
        "full": {},
        "full, sorted": {"sort_points": True},
        "partial view": {"view": "partial"},
        "partial view, sorted": {"view": "partial", "sort_points": True},
    }
    with tempfile.TemporaryDirectory() as folder:
        write_store(folder, load_robot("panda"), options.trajectories)
        size = sum(path.stat().st_size for path in Path(folder).rglob("*") if path.is_file())
        start = time.perf_counter()
        count = len(RopDataset(folder, SPLITS[0]))
        opened = time.perf_counter() - start
        print(
            f"{options.trajectories:,} trajectories of {WAYPOINTS} waypoints, {size / 1e6:.0f} MB; opened in "
            f"{opened:.2f} s; split for training: {count:,}; clouds of {POINTS:,} points; batches of {BATCH}"
        )
        rows = []
        for name, how in cases.items():
            row = [name]
            for threads in options.threads:
                torch.set_num_threads(threads)
                row.append(f"{rate(RopDataset(folder, points=POINTS, **how)):,.0f}")
            rows.append(row)
    columns = ["clouds", *(f"{n} thread{'s' * (n > 1)}" for n in options.threads)]
    print_table(f"trajectories a second (asked for on 2 cores: {TARGET:,})", columns, rows)


if __name__ == "__main__":
    main()
