"""D* Lite when an obstacle moves: repairing a search against searching anew, on one core.

    python benchmarks/replanning.py [--problems 40]

Prints the report that is kept in benchmarks/results/replanning.txt. Problems are held-out ones of ROP that
the straight line does not solve and D* Lite solves in a few seconds. Then one obstacle moves so far, in a
random direction, while the arm waits at the start. The path's cost must be that of a search anew.
"""

import argparse
import time
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from report import header, print_table

from problems import goal_of
from robotdiffuse.collision import CollisionChecker
from robotdiffuse.evaluation.problem_sets import case_file, validator
from robotdiffuse.evaluation.runs import Clock, Fields, Method, Trial, tried
from robotdiffuse.planning.baselines.lattice.planner import DStarLiteSearch, DStarLiteSettings, Outcome
from robotdiffuse.problems.problem import Problem
from robotdiffuse.scenes.scene import Scene

MOVES = 0.02, 0.05, 0.1
"""Of the obstacle [m]."""
PATIENCE = 3.0
"""CPU time of a search until it is given up [s]."""


def begun(problem: Problem) -> DStarLiteSearch:
    """A search that has not run yet."""
    checker = CollisionChecker(problem.robot, problem.scene)
    return DStarLiteSearch(checker, problem.start, goal_of(problem)[None], DStarLiteSettings())


def ran(search: DStarLiteSearch) -> tuple[float | None, float, int]:
    """Cost of the path, None without one; CPU time [s]; expansions."""
    before, until = search.expansions, time.process_time() + PATIENCE
    with Clock() as clock:
        outcome = search.run(lambda: time.process_time() > until)
    cost = search.cost if outcome is Outcome.FOUND else None
    return cost, clock.cpu, search.expansions - before


def with_one_moved(problem: Problem, distance: float, rng: np.random.Generator) -> Problem | None:
    """The same problem with an obstacle elsewhere; None if start or goal are in its way there."""
    shapes = list(problem.scene.shapes)
    i = int(rng.integers(1, len(shapes)))  # the floor stays
    way = rng.normal(size=3)
    shapes[i] = replace(shapes[i], center=shapes[i].center + distance * way / np.linalg.norm(way))
    scene = Scene(shapes)
    ends = np.stack([problem.start, goal_of(problem)])
    return replace(problem, scene=scene) if CollisionChecker(problem.robot, scene).free(ends).all() else None


def repaired(distance: float) -> Method:
    """Ratios of the repair to a search anew; none where an end is in collision, or there is no path."""

    def call(trial: Trial) -> Iterator[Fields]:
        moved = with_one_moved(trial.problem, distance, trial.rng())
        cost, seconds, expansions = (None, 0.0, 0) if moved is None else ran(begun(moved))
        found: Fields = {"status": "timeout", "time": 0.0}
        if moved is not None and cost is not None:
            search = begun(trial.problem)
            search.run()
            with Clock() as clock:
                search.update(CollisionChecker(moved.robot, moved.scene))
            again, more, expanded = ran(search)
            found |= {"status": "solved", "same": float(again == cost), "expansions": expanded / expansions}
            found["seconds"] = (clock.cpu + more) / seconds
        yield found

    return call


def main() -> None:
    parser = argparse.ArgumentParser(description="Repairs of D* Lite against searches anew.")
    parser.add_argument("--problems", type=int, default=40, help="(40)")
    arguments = parser.parse_args()
    print(header("numba", "numpy"))
    found, number = [], arguments.problems
    kept = case_file(None, "rop")
    while len(found) < arguments.problems:
        found = [
            c for c in kept.held_out("rop", number, validator) if not c.trivial and ran(begun(c.problem))[0]
        ]
        number += arguments.problems
    methods = {f"{100 * distance:g} cm": repaired(distance) for distance in MOVES}
    rows = []
    for name, records in tried(found[: arguments.problems], methods, title="obstacles moved").items():
        done = [record.measures for record in records if record.solved]
        ratios = [np.percentile([of[what] for of in done], (50, 90)) for what in ("expansions", "seconds")]
        shares = (f"{median:.2f} ({most:.2f})" for median, most in ratios)
        same = sum(of["same"] for of in done)
        rows.append((name, len(done), len(records) - len(done), f"{same:.0f}", *shares))
    columns = ["obstacle moved by", "problems", "left out", "same cost", "expansions*", "CPU time*"]
    print_table("Repair of D* Lite over a search anew", columns, rows)
    print("* median of the ratios, and the 90 % that are below. Left out: an end in collision, or no path.")


if __name__ == "__main__":
    main()
