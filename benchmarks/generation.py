"""What a motion of the data set costs, and where the time goes, on one core.

    python benchmarks/generation.py [--problems 1000]

Prints the report that is kept in benchmarks/results/generation.txt. The shares are those of a second run
under the profiler, which makes Python look slower than it is beside compiled code.
"""

import argparse
import cProfile
import pstats
import time

import numpy as np
from report import header, print_table
from rich.progress import track

from robotdiffuse.generation import GenerationSettings
from robotdiffuse.generation.shard_maker import solve
from robotdiffuse.robots import load_robot

STAGES = {
    "drawing scene, start and goals (inverse kinematics)": ("shard_maker.py", "draw"),
    "search": ("shared_tree/planner.py", "run"),
    "judge": ("verify.py", "path"),
}


def main() -> None:
    parser = argparse.ArgumentParser(description="What a motion of the data set costs.")
    parser.add_argument("--problems", type=int, default=1000)
    count = parser.parse_args().problems
    print(header("numpy", "numba"))
    settings, robot = GenerationSettings(), load_robot("panda")
    for number in range(5):
        solve(settings, robot, number)
    spent, trivial = np.empty(count), np.zeros(count, bool)
    for i in track(range(count), transient=True):
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
    ]
    print_table("CPU time of a problem, ms", ["problems", "number", "mean", "5 %", "median", "95 %"], rows)

    profile = cProfile.Profile()
    profile.enable()
    for i in range(min(count, 300)):
        solve(settings, robot, i)
    profile.disable()
    stats = pstats.Stats(profile)
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


if __name__ == "__main__":
    main()
