"""Whether compiled code gives bit-identical results from a cold cache, from a warm cache, and if it is loaded
in another order; and the cost of a first plan.

    python benchmarks/startup.py [--seed 0] [--only clearances,gradients]
    python benchmarks/startup.py --first-plan

The first command prints benchmarks/results/cold_cache.txt, the second the CPU time of a process that plans.

The first command runs all parts in three processes: first with an empty cache, so that the process compiles;
then twice with the cache that the first process left, in the same order of parts and in reverse. Every number
that a part returns is compared.
"""

import argparse
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy import ndarray

RUNS = ("cold", "warm", "warm, in the other order")
ROWS = 2000
"""Number of configurations that each part gets."""


def parts(seed: int) -> dict[str, Callable[[], ndarray]]:
    """Calls of compiled code that return numbers, by name."""
    import robotdiffuse as rd
    from robotdiffuse.collision.batched_clearances import packed_clearances_and_gradients
    from robotdiffuse.collision.checker import CollisionChecker
    from robotdiffuse.collision.kernel_arrays import compile_robot
    from robotdiffuse.learning.guidance import CollisionGuidance
    from robotdiffuse.robots.inverse_kinematics import inverse_kinematics
    from robotdiffuse.scenes.packed_scenes import PackedScenes
    from robotdiffuse.validation.validator import Verifier

    rng = np.random.default_rng(seed)
    robot = rd.load_robot("panda")
    q = rng.uniform(robot.lower, robot.upper, (ROWS, robot.dof))
    solids = [
        rd.Sphere([0.5, 0.3, 0.6], 0.15),
        rd.Box([0.45, 0.0, 0.2], [0.3, 0.05, 0.4]),
        rd.Cylinder([0.4, -0.4, 0.3], 0.05, 0.4),
        rd.Capsule([0.3, 0.5, 0.5], 0.05, 0.3),
    ]
    cloud = rd.PointCloud(rng.normal(size=(500, 3)) * 0.1 + [0.6, -0.3, 0.7], 0.01)
    checker = CollisionChecker(robot, rd.Scene([*solids, cloud]))
    packed = PackedScenes.pack([rd.Scene(solids[:2])] * (ROWS // 20), 4)
    batch = q.reshape(ROWS // 20, 20, robot.dof).astype(np.float32)
    left = np.array([0.9, 0.3, 0.0, -1.9, 0.0, 2.2, 0.785])
    right = left * [-1, 1, 1, 1, 1, 1, 1]
    problem = rd.Problem(robot, rd.Scene(solids[1:2]), left, right)

    def planned(name: str) -> ndarray:
        result = rd.load_planner(name).plan(problem, time_limit=60.0, seed=seed)
        assert result.path is not None and result.trajectory is not None
        return np.concatenate([result.path.positions.ravel(), result.trajectory.positions.ravel()])

    def validated() -> ndarray:
        rows = np.linspace(left, left + np.eye(7)[0] * 0.2, 5)
        short = rd.Problem(robot, problem.scene, left, rows[-1])
        report = Verifier(short).path(rd.Path(robot.joint_names, rows))
        assert report.valid
        return np.array([report.scene_clearance, report.self_clearance], np.float64)

    def reached() -> ndarray:
        goal = robot.fk(left)
        return np.asarray(inverse_kinematics(robot, robot.tip, goal, rng=np.random.default_rng(0)))

    arm = compile_robot(robot)
    return {
        "clearances": lambda: checker.link_clearances(q),
        "gradients": lambda: np.concatenate(checker.clearances_and_gradients(q, 0.3, 0.1), axis=1),
        "costs": lambda: checker.cost_gradients(q, 0.1)[1],
        "pairs of links": lambda: checker.pair_clearances(q),
        "guidance": lambda: CollisionGuidance(checker)(batch, 8),
        "clearances in training": lambda: packed_clearances_and_gradients(arm, packed, batch, 0.3)[0],
        "gradients in training": lambda: np.concatenate(
            packed_clearances_and_gradients(arm, packed, batch, 0.3, 0.1), axis=-1
        ),
        "the validator": validated,
        "inverse kinematics": reached,
        "rrt_connect": lambda: planned("rrt_connect"),
        "aorrtc": lambda: planned("aorrtc"),
    }


def work(file: str, seed: int, names: list[str]) -> None:
    """Call the parts in this order and save the numbers that they return."""
    from robotdiffuse.core.loading import compile_seconds

    known = parts(seed)
    arrays = {name: np.asarray(known[name]()) for name in names}
    np.savez(file, **arrays, seconds=np.array(compile_seconds()))  # type: ignore[arg-type]


FIRST_PLAN = """
from importlib.resources import files
import robotdiffuse as rd
from robotdiffuse.core.loading import compile_seconds, compiled, loading_seconds
problem = rd.load_problem(files("robotdiffuse") / "examples" / "shelf.yaml")
assert rd.plan(problem, time_limit=10.0, until="first").solved
assert rd.plan(problem, time_limit=10.0).solved
print(len(compiled), compile_seconds(), loading_seconds())
"""
"""Two plans by the default planner in one process."""


def first_plan() -> None:
    """Print the CPU time of a process that plans, with an empty cache and with the cache that the first
    process left."""
    from common import print_table

    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for run in RUNS[:2]:
            before = os.times()
            done = subprocess.run(
                [sys.executable, "-c", FIRST_PLAN],
                env=os.environ | {"NUMBA_CACHE_DIR": folder, "OMP_NUM_THREADS": "1"},
                check=True,
                capture_output=True,
                text=True,
            )
            after = os.times()
            spent = sum(after[2:4]) - sum(before[2:4])
            count, compiling, loading = done.stdout.split()
            rows.append([run, f"{spent:.1f}", count, f"{float(compiling):.1f}", f"{float(loading):.1f}"])
    columns = ["cache", "CPU [s]", "functions compiled", "compiling, wall [s]", "loading in all, wall [s]"]
    print_table("A process that plans the shelf", columns, rows)


def main() -> None:
    from common import header, parse, parts_of, print_table

    known = parts(0)
    parser = argparse.ArgumentParser(description="The same bits from a cold and from a warm cache.")
    parser.add_argument("--seed", type=int, default=0, help="seed (0)")
    parser.add_argument("--only", default=",".join(known), help="names of parts, separated by commas (all)")
    parser.add_argument("--first-plan", action="store_true", help="measure only the cost of a first plan")
    parser.add_argument("--work", help=argparse.SUPPRESS)
    arguments = parse(parser, only="pairs of links")
    names = parts_of(arguments.only, known)
    runs = RUNS if len(names) > 1 else RUNS[:2]
    if arguments.work:
        work(arguments.work, arguments.seed, names)
        return
    print(header("numpy", "numba", "llvmlite"), "\n")
    if arguments.first_plan:
        first_plan()
        return
    returned: dict[str, dict[str, ndarray]] = {}
    with tempfile.TemporaryDirectory() as folder:
        for i, run in enumerate(runs):
            file = str(Path(folder, f"{i}.npz"))
            order = names[::-1] if i == 2 else names
            subprocess.run(
                [
                    sys.executable,
                    __file__,
                    "--work",
                    file,
                    "--seed",
                    f"{arguments.seed}",
                    "--only",
                    ",".join(order),
                ],
                env=os.environ | {"NUMBA_CACHE_DIR": str(Path(folder, "cache"))},
                check=True,
            )
            with np.load(file) as arrays:
                returned[run] = dict(arrays)
    rows = []
    for name in names:
        first = returned[RUNS[0]][name]
        row = [name, f"{first.size:,}"]
        for run in runs[1:]:
            other = returned[run][name]
            changed = first != other if first.shape == other.shape else np.ones(1, bool)
            most = np.abs(first - other).max() if first.shape == other.shape else np.inf
            row.append(
                "the same" if not changed.any() else f"{changed.sum():,} differ, by {most:.1e} at most"
            )
        rows.append(row)
    print_table("Against the run that compiled", ["part", "numbers", *runs[1:]], rows)
    compiled = ", ".join(f"{run} {float(returned[run]['seconds']):.0f} s" for run in runs)
    print(f"\nCompiling took: {compiled}.")


if __name__ == "__main__":
    main()
