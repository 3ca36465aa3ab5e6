"""Problem files loaded one by one against problems that share a robot: what a plan costs, in one run.

    python benchmarks/load_one_by_one.py [--problems 50] [--repeats 5]

Prints the report that is kept in benchmarks/results/load_one_by_one.txt. The files hold fingers at values, as
problems of MotionBenchMaker do. Every problem is planned both ways in turn, in an order that alternates:
loaded from its file just before, and made with a robot that all problems have in common.
"""

import argparse
import time
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from report import header, print_table, progress

from robotdiffuse.planning import load_planner
from robotdiffuse.problems.files import save_problem
from robotdiffuse.problems.held_out import held_out_problem
from robotdiffuse.problems.problem import Problem
from robotdiffuse.robots import load_robot

FINGERS = {"panda_finger_joint1": 0.035, "panda_finger_joint2": 0.035}


def main() -> None:
    parser = argparse.ArgumentParser(description="Problem files loaded one by one against a shared robot.")
    parser.add_argument("--problems", type=int, default=50, help="(50)")
    parser.add_argument("--repeats", type=int, default=5, help="of every problem (5)")
    arguments = parser.parse_args()
    print(header("numpy", "numba"))
    planner, robot = load_planner("rrt_connect"), load_robot("panda", locked=FINGERS)
    with TemporaryDirectory() as folder:
        files, shared = [], []
        for number in range(arguments.problems):
            drawn = held_out_problem("rop", number)
            shared.append(Problem(robot, drawn.scene, drawn.start, drawn.goal))
            files.append(Path(folder) / f"{number}.yaml")
            save_problem(shared[-1], files[-1])
        planner.plan(Problem.load(files[0]))  # compiles
        took = {"loaded one by one": [], "shared robot": []}
        for turn, i in progress(
            [(t, i) for t in range(arguments.repeats) for i in range(len(files))], "plan"
        ):
            given = {"loaded one by one": Problem.load(files[i]), "shared robot": shared[i]}
            for way in sorted(given, reverse=turn % 2 == 0):
                began = time.perf_counter()
                planner.plan(given[way], time_limit=1.0, seed=turn)
                took[way].append(time.perf_counter() - began)
    medians = {way: float(np.median(seconds)) for way, seconds in took.items()}
    rows = [[way, f"{1e3 * medians[way]:.2f}", f"{1e3 * np.percentile(took[way], 95):.2f}"] for way in took]
    print_table(f"rrt_connect, {len(files)} problem files", ["", "plan ms, median", "95 %"], rows)
    print(f"ratio of the medians: {medians['loaded one by one'] / medians['shared robot']:.3f}")


if __name__ == "__main__":
    main()
