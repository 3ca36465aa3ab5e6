"""Data sets: the cost of a motion, and how fast the loader reads them.

    python benchmarks/data.py cost [--problems 1000]
    python benchmarks/data.py loader [--trajectories 20000] [--threads 1 2]

`cost` prints benchmarks/results/generation.txt: CPU time of a problem on one core, and the fraction of each
stage. The fractions come from a second run under the profiler, which overstates the time of Python code
against that of compiled code.

`loader` prints loader.txt: trajectories per second, with point clouds made on the fly. The data set looks
like a generated one with two families: 85 % of the scenes have two obstacles, the others 3 to 12. One epoch
of shuffled batches of 256 is timed, after a few batches for warming up; files are in the system's cache.
"""

import argparse
import cProfile
import itertools
import pstats
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch

from common import header, parse, print_table, progress
from robotdiffuse.datasets.loader import RopDataset
from robotdiffuse.datasets.shards import SPLITS, Manifest, write_manifest, write_shard
from robotdiffuse.generation import GenerationSettings
from robotdiffuse.generation.factory import solve
from robotdiffuse.problems.families.rop import ROP, ROP_DENSE
from robotdiffuse.robots import load_robot
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.packed_scenes import PackedScenes

STAGES = {
    "drawing scene, start and goals (inverse kinematics)": ("factory.py", "draw"),
    "search": ("search/shared_tree.py", "run"),
    "validator": ("validator.py", "path"),
}
"""For each stage, the file and the function whose cumulative time the profile reports."""
WAYPOINTS = 254
SLOTS = 12
GOALS = 10
SHARD = 1000
POINTS = 1400
BATCH = 256
DENSE_SHARE = 0.15
WARM_UP_BATCHES = 8


def cost(count: int) -> None:
    """Print the CPU time of a problem, and the fraction of each stage."""
    settings = GenerationSettings()
    robot = load_robot("panda")
    for number in range(5):
        solve(settings, robot, number)
    spent = np.empty(count)
    trivial = np.zeros(count, bool)
    for i in progress(range(count), "problems"):
        began = time.process_time()
        row = solve(settings, robot, i)
        spent[i] = 1e3 * (time.process_time() - began)
        trivial[i] = not isinstance(row, str) and bool(row["line_free"])
    rows = [
        [
            name,
            f"{chosen.sum()}",
            *(f"{value:.1f}" for value in (part.mean(), *np.percentile(part, (5, 50, 95)))),
        ]
        for name, chosen in (("all", trivial | True), ("the line is free", trivial), ("it is not", ~trivial))
        for part in (spent[chosen],)
        if len(part)
    ]
    print_table("CPU time of a problem, ms", ["problems", "number", "mean", "5 %", "median", "95 %"], rows)

    profile = cProfile.Profile()
    profile.enable()
    for i in range(min(count, 300)):
        solve(settings, robot, i)
    profile.disable()
    stats: Any = pstats.Stats(profile)  # its fields are not in the type stubs
    whole = stats.total_tt
    shares = {
        name: max(
            (
                times[3]
                for (path, _, called), times in stats.stats.items()
                if path.endswith(file) and called == function
            ),
            default=0.0,
        )
        / whole
        for name, (file, function) in STAGES.items()
    }
    shares["setting up, waypoints, records"] = 1 - sum(shares.values())
    print_table(
        "Where it goes", ["stage", "share"], [[name, f"{100 * x:.0f} %"] for name, x in shares.items()]
    )


def write_store(folder: str, robot: Robot, trajectories: int) -> None:
    """Write a data set of straight lines between random configurations in random scenes."""
    families = ("rop", "rop_dense")
    manifest = Manifest.of(
        robot,
        robot.name,
        waypoints=WAYPOINTS,
        families={name: {} for name in families},
        floors=dict.fromkeys(families, ROP.floor),
        slots=SLOTS,
        goals=GOALS,
        trajectories=trajectories,
        shard=SHARD,
        settings={},
        versions={},
    )
    write_manifest(folder, manifest)
    rng = np.random.default_rng(0)
    s = np.linspace(0, 1, WAYPOINTS, dtype=np.float32)[:, None]
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
    """Trajectories per second, over one epoch."""
    for _batch in itertools.islice(data.batches(BATCH), WARM_UP_BATCHES):
        pass
    start = time.perf_counter()
    for _batch in data.batches(BATCH):
        pass
    return len(data) / (time.perf_counter() - start)


def loader(trajectories: int, threads_tried: list[int]) -> None:
    """Print trajectories per second, for each number of threads."""
    cases = {
        "full": {},
        "full, sorted": {"sort_points": True},
    }
    with tempfile.TemporaryDirectory() as folder:
        write_store(folder, load_robot("panda"), trajectories)
        size = sum(path.stat().st_size for path in Path(folder).rglob("*") if path.is_file())
        start = time.perf_counter()
        count = len(RopDataset(folder, SPLITS[0]))
        opened = time.perf_counter() - start
        print(
            f"{trajectories:,} trajectories of {WAYPOINTS} waypoints, {size / 1e6:.0f} MB; opened in "
            f"{opened:.2f} s; split for training: {count:,}; clouds of {POINTS:,} points; batches of {BATCH}"
        )
        rows = []
        for name, how in cases.items():
            row = [name]
            for threads in threads_tried:
                torch.set_num_threads(threads)
                row.append(f"{rate(RopDataset(folder, points=POINTS, **how)):,.0f}")
            rows.append(row)
    columns = ["clouds", *(f"{n} thread{'s' * (n > 1)}" for n in threads_tried)]
    print_table("trajectories a second", columns, rows)


def main() -> None:
    parser = argparse.ArgumentParser(description="Making data sets, and reading them.")
    parser.add_argument(
        "part", choices=("cost", "loader"), nargs="?", default="cost", help="what to measure (cost)"
    )
    parser.add_argument("--problems", type=int, default=1000, help="number of problems, for cost (1000)")
    parser.add_argument(
        "--trajectories", type=int, default=20_000, help="number of trajectories, for loader (20000)"
    )
    parser.add_argument(
        "--threads", type=int, nargs="+", default=[1, 2], help="numbers of threads, for loader (1 2)"
    )
    arguments = parse(parser, problems=2, trajectories=300, threads=[1])
    print(header("torch", "numpy", "numba", "zarr"))
    if arguments.part == "cost" or arguments.smoke:
        cost(arguments.problems)
    if arguments.part == "loader" or arguments.smoke:
        loader(arguments.trajectories, arguments.threads)


if __name__ == "__main__":
    main()
