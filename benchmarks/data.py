"""Data sets: the cost of a motion, the planners that can make them, and how fast the loader reads them.

    python benchmarks/data.py cost [--problems 1000]
    python benchmarks/data.py planners [--robots panda ur5e] [--problems 60]
    python benchmarks/data.py loader [--trajectories 20000] [--threads 1 2]

`cost` prints benchmarks/results/generation.txt: CPU time of a problem on one core, and the share of each
stage. The shares are those of a second run under the profiler, which makes Python look slower than it is
beside compiled code.

`planners` prints data_planners.txt: Shared-Tree Informed RRT* and AORRTC at equal CPU time, in scenes of ROP,
dense ROP and furniture that the straight line does not solve. Lengths are compared where both kept the same
safety distance.

`loader` prints loader.txt: trajectories a second, with point clouds made on the fly. The data set has the
form of generated ones with two families: 85 % of the scenes have two obstacles, the others 3 to 12. Times are
of one epoch of shuffled batches of 256 after a few for warming up; files are in the system's cache.
"""

import argparse
import cProfile
import itertools
import pstats
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from common import header, parse, print_table, progress
from robotdiffuse.cli.train_robot import MIX
from robotdiffuse.collision import CollisionChecker
from robotdiffuse.collision.kernels.compiled import random_state
from robotdiffuse.collision.kernels.motions import motions_free
from robotdiffuse.collision.motions import search_space
from robotdiffuse.datasets.loader import RopDataset
from robotdiffuse.datasets.manifest import Manifest, floor_record, write_manifest
from robotdiffuse.datasets.shards import SPLITS, write_shard
from robotdiffuse.generation import GenerationSettings
from robotdiffuse.generation.aorrtc_solver import AORRTCSearchSettings
from robotdiffuse.generation.shard_maker import draw, solve, with_near_goals
from robotdiffuse.generation.solvers import SEARCHES
from robotdiffuse.problems.families.family import SampledProblem
from robotdiffuse.problems.families.rop import ROP
from robotdiffuse.problems.families.rop_dense import ROP_DENSE
from robotdiffuse.robots import load_robot
from robotdiffuse.robots.fingerprint import robot_fingerprint
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene_arrays import PackedScenes

STAGES = {
    "drawing scene, start and goals (inverse kinematics)": ("shard_maker.py", "draw"),
    "search": ("shared_tree/planner.py", "run"),
    "validator": ("validator.py", "path"),
}
"""Files and functions of the profile."""
MARKS = (0.01, 0.02, 0.05, 0.1, 0.3)
"""CPU times at which the two planners are compared [s]."""
SAME_DISTANCE = 0.002
"""Distances to obstacles that differ by no more count as the same [m]."""
ENDLESS = 10**9
WAYPOINTS, SLOTS, GOALS, SHARD = 254, 12, 10, 1000
POINTS, BATCH, DENSE_SHARE = 1400, 256, 0.15
WARM_UP_BATCHES = 8


class Found(NamedTuple):
    """The path of a search at some time."""

    cpu: float
    """[s]"""
    length: float
    """[rad]; infinite without a path."""
    least: float
    """Distance to obstacles along the path [m]."""
    safety: float
    """The safety distance that was kept but near the ends [m]."""


def searched(
    settings: GenerationSettings,
    checker: CollisionChecker,
    drawn: SampledProblem,
    seed: int,
    marks: tuple[float, ...],
) -> Iterator[Found]:
    """The path of the search at these CPU times [s], and where it ends by itself."""
    began = time.process_time()
    search = SEARCHES.load(settings.planner)(
        checker, drawn.start, drawn.goals, settings.search, random_state(1, seed)
    )
    for mark in marks:
        search.run(lambda until=began + mark: time.process_time() >= until)
        spent, path = time.process_time() - began, search.path()
        if path is None:
            yield Found(spent, np.inf, np.nan, search.safety_distance)
            continue
        shares = np.linspace(0, 1, 40, dtype=np.float32)[:, None]
        along = np.concatenate([a + shares * (b - a) for a, b in pairwise(path)])
        yield Found(spent, search.cost, float(checker.link_clearances(along).min()), search.safety_distance)


def problems(settings: GenerationSettings, robot: Robot, count: int) -> Iterator[tuple[int, SampledProblem]]:
    """Random ones that the straight line does not solve."""
    number = 0
    while count > 0:
        drawn = with_near_goals(robot, draw(settings, robot, np.random.default_rng([5, number]))[1])
        space = search_space(CollisionChecker(robot, drawn.scene), settings.search.resolution)
        line = np.stack([drawn.start, drawn.goals[0]])
        number += 1
        if not motions_free(space, line).all():
            count -= 1
            yield number, drawn


def compare_planners(name: str, count: int) -> None:
    """Print how the two planners do on problems for a robot."""
    robot = load_robot(name)
    usual = GenerationSettings(robot=name, mix=MIX, target="pose", goals=1)
    paper, fast = usual.search, AORRTCSearchSettings()
    by_paper, by_fast = usual, replace(usual, planner="aorrtc", search=fast)
    endless = (
        replace(by_paper, search=replace(paper, improvement=0.0)),
        replace(by_fast, search=replace(fast, patience=ENDLESS)),
    )
    pairs: dict[str, list[tuple[tuple[Found, Found], float]]] = {}
    for number, drawn in progress([*problems(usual, robot, count)], name):
        checker = CollisionChecker(robot, drawn.scene)
        ends = np.stack([drawn.start, *drawn.goals]).astype(np.float32)
        closest = float(checker.link_clearances(ends).min())

        def found(settings: GenerationSettings, *marks: float) -> list[Found]:
            return [*searched(settings, checker, drawn, number, marks)]  # noqa: B023

        if not pairs:
            for settings in endless:
                found(settings, 2.0)  # compiles
        alone = found(by_paper, np.inf)
        rows = {f"{1e3 * mark:.0f} ms": i for i, mark in enumerate(MARKS)}
        theirs, ours = (found(settings, *MARKS) for settings in endless)
        for row, i in rows.items():
            pairs.setdefault(row, []).append(((theirs[i], ours[i]), closest))
        same_time = found(endless[1], alone[0].cpu)[0]
        pairs.setdefault("as the paper's ends", []).append(((alone[0], same_time), closest))
        pairs.setdefault("as each ends", []).append(((alone[0], found(by_fast, np.inf)[0]), closest))
    rows = []
    for row, every in pairs.items():
        both = [(pair, end) for pair, end in every if max(found.length for found in pair) < np.inf]
        ratios = np.array(
            [b.length / a.length for (a, b), _ in both if abs(b.safety - a.safety) <= SAME_DISTANCE]
        )
        half = 1.96 * ratios.std(ddof=1) / np.sqrt(len(ratios))
        kept = (
            np.mean([pair[i].least >= min(0.05, end) - SAME_DISTANCE for pair, end in both]) for i in (0, 1)
        )
        rows.append(
            [
                row,
                " / ".join(f"{1e3 * np.mean([pair[i].cpu for pair, _ in every]):.0f}" for i in (0, 1)),
                " / ".join(f"{sum(pair[i].length < np.inf for pair, _ in every)}" for i in (0, 1)),
                f"{ratios.mean():.4f} ± {half:.4f}, {np.median(ratios):.4f} ({len(ratios)})",
                " / ".join(f"{100 * np.mean([pair[i].safety for pair, _ in both]):.2f}" for i in (0, 1)),
                " / ".join(f"{100 * share:.0f} %" for share in kept),
            ]
        )
    columns = ["CPU time", "ms, mean", "solved", "length of AORRTC over the paper's*", "safety, cm", "kept**"]
    print_table(f"{name}: the paper's planner / AORRTC, {count} problems", columns, rows)


def cost(count: int) -> None:
    """Print the CPU time of a problem, and the share of each stage."""
    settings, robot = GenerationSettings(), load_robot("panda")
    for number in range(5):
        solve(settings, robot, number)
    spent, trivial = np.empty(count), np.zeros(count, bool)
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
    for _batch in itertools.islice(data.batches(BATCH), WARM_UP_BATCHES):
        pass
    start = time.perf_counter()
    for _batch in data.batches(BATCH):
        pass
    return len(data) / (time.perf_counter() - start)


def loader(trajectories: int, threads_tried: list[int]) -> None:
    """Print trajectories a second."""
    cases = {
        "full": {},
        "full, sorted": {"sort_points": True},
        "partial view": {"view": "partial"},
        "partial view, sorted": {"view": "partial", "sort_points": True},
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
    parts = ("cost", "planners", "loader")
    parser.add_argument("part", choices=parts, nargs="?", default="cost", help="(cost)")
    parser.add_argument("--problems", type=int, help="(1000; of planners 60)")
    parser.add_argument("--robots", nargs="+", default=["panda", "ur5e"], help="of planners (panda ur5e)")
    parser.add_argument("--trajectories", type=int, default=20_000, help="of the loader (20000)")
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2], help="of the loader (1 2)")
    arguments = parse(parser, problems=2, robots=["panda"], trajectories=300, threads=[1])
    print(header("torch", "numpy", "numba", "zarr"))
    for part in parts if arguments.smoke else (arguments.part,):
        if part == "cost":
            cost(arguments.problems or 1000)
        elif part == "loader":
            loader(arguments.trajectories, arguments.threads)
        else:
            for name in arguments.robots:
                compare_planners(name, arguments.problems or 60)
            print("*  mean with 95 % interval, median (problems where both kept the same safety distance)")
            print("** 5 cm, or what the closer end has, all along; to 2 mm")


if __name__ == "__main__":
    main()
