"""Repeated calls of a workspace with a moved obstacle, and goals of 20 grasp poses.

    python benchmarks/workspace.py [--calls 3000] [--grasps 30]

Prints benchmarks/results/workspace.txt. Calls: one of 12 obstacles is moved before each call, which plans
to a pose until the first motion. The overhead is the CPU time of moving the obstacle and making the problem.
Grasps: of 20 poses above a table, 10 are free and 10 blocked, in random order; the limit is 0.1 s of CPU
time.
"""

import argparse
import gc
import time
from pathlib import Path

import numpy as np
from numpy import ndarray

import robotdiffuse as rd
from common import header, parse, print_table, progress, use_processor_time

HAND = "panda_hand"
TIME_LIMIT = 0.1
FREE, BLOCKED = 10, 10


def memory() -> float:
    """Resident memory of this process [MB]."""
    gc.collect()
    pages = int(Path("/proc/self/statm").read_text(encoding="utf-8").split()[1])
    return pages * 4096 / 1e6


def moved_obstacles(calls: int) -> None:
    """Plan with a moved obstacle in each call, and print time and memory."""
    space = rd.Workspace(rd.load_robot("panda"), HAND)
    rng = np.random.default_rng(0)
    space.add(rd.Box([0.55, 0.0, -0.05], [0.8, 1.4, 0.1], name="table"))
    for k in range(10):
        space.add(rd.Box([0.3 + 0.06 * k, 0.6, 0.1], [0.04, 0.04, 0.2], name=f"post {k}"))
    space.add(rd.Sphere([0.5, 0.0, 0.5], 0.08, name="ball"))
    goal = rd.pose([0.5, 0.3, 0.4], rpy=[np.pi, 0.0, 0.0])
    overhead = []
    spent = []
    solved = 0
    sizes = []
    for call in progress(range(calls), "calls"):
        began = time.process_time()
        space.move("ball", rd.pose(rng.uniform([0.3, -0.4, 0.3], [0.6, 0.1, 0.7])))
        moving = time.process_time() - began
        began = time.process_time()
        result = space.plan(goal, "ready", until="first")
        spent.append(1e3 * (time.process_time() - began))
        began = time.process_time()
        rd.Problem(space.robot, space.scene, "ready", rd.PoseGoal(HAND, goal))
        overhead.append(1e3 * (moving + time.process_time() - began))
        solved += result.solved
        if (call + 1) % (calls // 5) == 0:
            sizes.append(memory())
    rows = [
        ("solved", f"{solved} of {calls}"),
        ("CPU time of plan, median / p95", "{:.1f} / {:.1f} ms".format(*np.percentile(spent, [50, 95]))),
        ("move and problem, median / p95", "{:.2f} / {:.2f} ms".format(*np.percentile(overhead, [50, 95]))),
        ("memory after each fifth of the calls [MB]", " / ".join(f"{size:.1f}" for size in sizes)),
    ]
    print_table("One obstacle moved before each call", ("", "Workspace"), rows)


def grasp_poses(space: rd.Workspace, rng: np.random.Generator) -> list[ndarray]:
    """Free and blocked poses in random order."""
    free: list[ndarray] = []
    blocked: list[ndarray] = []
    while len(free) < FREE or len(blocked) < BLOCKED:
        tilt = rng.uniform(-0.5, 0.5, 2)
        T = rd.pose(
            rng.uniform([0.4, 0.15, 0.1], [0.6, 0.45, 0.3]),
            rpy=[np.pi + tilt[0], tilt[1], rng.uniform(-np.pi, np.pi)],
        )
        configurations = space.ik(T)
        if len(configurations):
            (free if any(space.is_free(q) for q in configurations) else blocked).append(T)
    poses = free[:FREE] + blocked[:BLOCKED]
    return [poses[i] for i in rng.permutation(len(poses))]


def grasps(number: int) -> None:
    """Plan to any of 20 poses, for `number` sets of poses, and print a table."""
    space = rd.Workspace(rd.load_robot("panda"), HAND)
    space.add(
        rd.Box([0.55, 0.0, -0.05], [0.8, 1.4, 0.1], name="table"),
        rd.Box([0.5, 0.0, 0.15], [0.5, 0.04, 0.3], name="wall"),
        rd.Box([0.62, 0.3, 0.2], [0.04, 0.3, 0.4], name="board"),
    )
    rng = np.random.default_rng(0)
    sets = [grasp_poses(space, rng) for _ in range(number)]
    space.plan(sets[0], "ready", time_limit=1.0)
    columns = []
    for until in ("first", "converged"):
        spent = []
        solved = 0
        for poses in progress(sets, until):
            began = time.process_time()
            solved += space.plan(poses, "ready", time_limit=TIME_LIMIT, until=until).solved
            spent.append(1e3 * (time.process_time() - began))
        middle, late = np.percentile(spent, [50, 95])
        columns.append((f"{solved} of {number}", f"{middle:.1f} / {late:.1f} / {max(spent):.1f} ms"))
    rows = list(zip(("solved", "CPU time, median / p95 / most"), *columns, strict=True))
    print_table("20 grasp poses, of which 10 are blocked; limit 0.1 s", ("", "first", "converged"), rows)


def main() -> None:
    parser = argparse.ArgumentParser(description="Workspace: repeated calls, many grasp poses.")
    parser.add_argument(
        "--calls", type=int, default=3000, help="number of calls, each with a moved obstacle (3000)"
    )
    parser.add_argument("--grasps", type=int, default=30, help="number of sets of 20 grasp poses (30)")
    arguments = parse(parser, calls=5, grasps=1)
    use_processor_time()
    print(header("numba", "numpy"))
    moved_obstacles(arguments.calls)
    grasps(arguments.grasps)


if __name__ == "__main__":
    main()
