"""RRT-Connect on MotionBenchMaker folders and on fresh ROP problems, on one core.

    python benchmarks/rrt_connect.py [--problems FOLDER --lengths FILE] [--rop 1000]

Prints the report that is kept in benchmarks/results/rrt_connect.txt. FOLDER holds MotionBenchMaker families
(scene and request files), FILE the reference lengths, {"length": {"family/number": {"rrtc_simplified": ...,
"best_known": ...}}}. Every motion that counts as solved passed the judge.
"""

import argparse
import json
import time
from pathlib import Path

import numpy as np
from report import header, print_table
from rich.progress import track

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.collision.exact import ExactCollision
from robotdiffuse.collision.kernels.compiled import random_state
from robotdiffuse.collision.kernels.motions import path_length
from robotdiffuse.collision.motion import search_space
from robotdiffuse.errors import InputError
from robotdiffuse.paths.shortcut import shortcut
from robotdiffuse.planners.rrt_connect import kernel
from robotdiffuse.planners.rrt_connect.planner import Ends, RRTConnect, RRTConnectSettings
from robotdiffuse.problems.families.rop import ROP, Rop
from robotdiffuse.problems.families.rop_dense import ROP_DENSE
from robotdiffuse.problems.files import load_motion_bench_maker
from robotdiffuse.problems.problem import JointGoal, Problem
from robotdiffuse.robots import load_robot

SEED = 20261122


def search_seconds(problem: Problem, settings: RRTConnectSettings) -> float:
    """CPU time of the compiled part of one call: two searches and the shortcuts [s]."""
    checker = CollisionChecker(problem.robot, problem.scene)
    assert isinstance(problem.goal, JointGoal)
    ends = Ends(checker, problem.start, problem.goal.positions)
    start, goals = ends.rows()
    clearance = ends.kept_clearance(settings.clearance)
    space, state = search_space(checker, settings.resolution, clearance), random_state(0)
    began = time.process_time()
    best = None
    for _ in range(settings.searches):
        trees = kernel.make_trees(start, goals, settings.capacity)
        path = kernel.search(space, trees, np.float32(settings.reach), 1_000_000, state)
        if best is None or path_length(path) < path_length(best):
            best = path
    shortcut(space, best, settings.shortcuts, state)
    return time.process_time() - began


def motion_bench_maker(folder: Path, lengths: dict[str, dict[str, float]]) -> None:
    rows, names = [], sorted(path.name for path in folder.iterdir() if path.is_dir())
    total: dict[str, list] = {key: [] for key in ("once", "long", "search", "plan", "simplified", "best")}
    loaded, free, spheres_free, solved, solved_long = 0, 0, 0, 0, 0
    for name in names:
        family: dict[str, list] = {key: [] for key in total}
        count = 0
        for entry in track(load_motion_bench_maker(folder / name), name, transient=True):
            try:
                problem = entry.load()
            except InputError as error:
                print(f"left out: {entry.name}: {str(error).partition(': ')[2]}")
                continue
            count += 1
            assert isinstance(problem.goal, JointGoal)
            ends = np.concatenate([problem.start[None], problem.goal.positions[:1]])
            free += not ExactCollision(problem.robot, problem.scene).collides(ends).any()
            spheres_free += CollisionChecker(problem.robot, problem.scene).free(ends).all()
            once = RRTConnect().plan(problem, 5.0)
            longer = RRTConnect(RRTConnectSettings(optimize_time=0.05)).plan(problem, 5.0)
            solved += once.solved
            solved_long += longer.solved
            if not (once.solved and longer.solved):
                print(f"not solved: {entry.name}: {once.reason}; {longer.reason}")
                continue
            family["search"].append(search_seconds(problem, RRTConnectSettings()))
            family["plan"].append(once.planning_time)
            known = lengths.get(f"{name.removesuffix('_panda')}/{entry.name[-4:]}")
            if known is not None:
                family["once"].append(once.path_length)
                family["long"].append(longer.path_length)
                family["simplified"].append(known["rrtc_simplified"])
                family["best"].append(known["best_known"])
        loaded += count
        rows.append([f"{name} ({count})", *figures(family)])
        for key, values in family.items():
            total[key] += values
    rows.append([f"all ({loaded})", *figures(total)])
    columns = ["problems", "search ms*", "plan ms", "length", "VAMP", "ratio", "50 ms", "best known", "ratio"]
    print_table("MotionBenchMaker", columns, rows)
    print(f"start and goal free: {free} by mesh, {spheres_free} by covering spheres, of {loaded} loaded")
    print(f"solved and verified: {solved} of {loaded}; with 50 ms of restarts {solved_long}")
    print("* compiled search and shortcuts, CPU time; plan: with set-up, ends and judge, wall time; medians")


def figures(data: dict[str, list]) -> list[str]:
    mean = {key: float(np.mean(values)) for key, values in data.items()}
    times = [f"{1e3 * np.median(data[key]):.2f}" for key in ("search", "plan")]
    once = [f"{mean['once']:.3f}", f"{mean['simplified']:.3f}", f"{mean['once'] / mean['simplified']:.3f}"]
    return [*times, *once, f"{mean['long']:.3f}", f"{mean['best']:.3f}", f"{mean['long'] / mean['best']:.3f}"]


def rop(count: int) -> None:
    robot, rows = load_robot("panda"), []
    ten = Rop(obstacles=(10, 10), sphere_radius=ROP_DENSE.sphere_radius, cube_side=ROP_DENSE.cube_side)
    for title, settings in (("ROP, 2 obstacles", ROP), ("ROP, 10 obstacles", ten)):
        one, ten_seconds, times = [], [], []
        for i in track(range(count), title, transient=True):
            problem = settings.draw(robot, np.random.default_rng([SEED, i])).problem(robot)
            result = RRTConnect().plan(problem, 1.0, seed=0)
            one.append(result.solved)
            times.append(result.planning_time)
            # the reference searches with another seed, and only where the first call failed
            ten_seconds.append(result.solved or RRTConnect().plan(problem, 10.0, seed=1).solved)
        rows.append(
            [
                title,
                f"{sum(one)} of {count}",
                f"{sum(ten_seconds)} of {count}",
                f"{1e3 * np.median(times):.2f} / {1e3 * np.percentile(times, 95):.2f}",
            ]
        )
    print_table("Fresh ROP problems", ["", "solved in 1 s", "solved in 10 s", "plan ms median / p95"], rows)


def main() -> None:
    parser = argparse.ArgumentParser(description="RRT-Connect on MotionBenchMaker and ROP problems.")
    parser.add_argument("--problems", type=Path, help="folder with MotionBenchMaker families")
    parser.add_argument("--lengths", type=Path, help="reference lengths (JSON)")
    parser.add_argument("--rop", type=int, default=1000, help="problems of each ROP kind (1000)")
    arguments = parser.parse_args()
    print(header("numpy", "numba", "coal"))
    if arguments.problems:
        lengths = json.loads(arguments.lengths.read_text())["length"] if arguments.lengths else {}
        motion_bench_maker(arguments.problems, lengths)
    rop(arguments.rop)


if __name__ == "__main__":
    main()
