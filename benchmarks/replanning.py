"""D* Lite when an obstacle moves: repairing a search against searching anew, on one core.

    python benchmarks/replanning.py [--problems 40]

Prints the report that is kept in benchmarks/results/replanning.txt. Problems are held-out ones of ROP that
the straight line does not solve and D* Lite solves in a few seconds. Then one obstacle moves so far, in a
random direction, while the arm waits at the start. The path's cost must be that of a search anew.
"""

import argparse
import time
from dataclasses import replace
from itertools import count

import numpy as np
from report import header, print_table, progress

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.evaluation.problem_sets import judge
from robotdiffuse.planners.lattice.planner import DStarLiteSearch, DStarLiteSettings, Outcome
from robotdiffuse.problems.held_out import SEED, goal_of, held_out_problem, line_length
from robotdiffuse.problems.problem import Problem
from robotdiffuse.scenes.scene import Scene

MOVES = 0.02, 0.05, 0.1
"""Of the obstacle [m]."""
PATIENCE = 3.0
"""CPU time of a search until it is given up [s]."""


def search(problem: Problem) -> DStarLiteSearch:
    """A search that has not begun."""
    checker = CollisionChecker(problem.robot, problem.scene)
    return DStarLiteSearch(checker, problem.start, goal_of(problem)[None], DStarLiteSettings())


def ran(found: DStarLiteSearch) -> tuple[Outcome | None, float, int]:
    """How it ended, None if it was given up; CPU time [s]; expansions."""
    began, before = time.process_time(), found.expansions
    outcome = found.run(lambda: time.process_time() - began > PATIENCE)
    ended = None if outcome is Outcome.GOING else outcome
    return ended, time.process_time() - began, found.expansions - before


def with_one_moved(problem: Problem, distance: float, rng: np.random.Generator) -> Problem | None:
    """The same problem with an obstacle elsewhere; None if start or goal are in its way there."""
    shapes = list(problem.scene.shapes)
    i = int(rng.integers(1, len(shapes)))  # the floor stays
    way = rng.normal(size=3)
    shapes[i] = replace(shapes[i], center=shapes[i].center + distance * way / np.linalg.norm(way))
    scene = Scene(shapes)
    ends = np.stack([problem.start, goal_of(problem)])
    return replace(problem, scene=scene) if CollisionChecker(problem.robot, scene).free(ends).all() else None


def main() -> None:
    parser = argparse.ArgumentParser(description="Repairs of D* Lite against searches anew.")
    parser.add_argument("--problems", type=int, default=40, help="(40)")
    arguments = parser.parse_args()
    print(header("numba", "numpy"))
    solvable = []
    for index in count():
        problem = held_out_problem("rop", index)
        if line_length(problem, judge) is None and ran(search(problem))[0] is Outcome.FOUND:
            solvable.append(problem)
        if len(solvable) == arguments.problems:
            break
    rng, rows = np.random.default_rng(SEED), []
    for distance in MOVES:
        expanded, seconds, same, left_out = [], [], 0, 0
        for problem in progress(solvable, f"{100 * distance:g} cm"):
            moved = with_one_moved(problem, distance, rng)
            if moved is None:
                left_out += 1
                continue
            repaired, fresh = search(problem), search(moved)
            repaired.run()
            outcome, fresh_seconds, fresh_expansions = ran(fresh)
            if outcome is not Outcome.FOUND:
                left_out += 1
                continue
            began = time.process_time()
            repaired.update(CollisionChecker(moved.robot, moved.scene))
            updated = time.process_time() - began
            _, repair_seconds, repair_expansions = ran(repaired)
            same += repaired.cost == fresh.cost
            expanded.append(repair_expansions / fresh_expansions)
            seconds.append((updated + repair_seconds) / fresh_seconds)
        ratios = [np.percentile(values, (50, 90)) for values in (expanded, seconds)]
        shares = (f"{median:.2f} ({most:.2f})" for median, most in ratios)
        rows.append([f"{100 * distance:g} cm", f"{len(expanded)}", f"{left_out}", f"{same}", *shares])
    columns = ["obstacle moved by", "problems", "left out", "same cost", "expansions*", "CPU time*"]
    print_table("Repair of D* Lite over a search anew", columns, rows)
    print("* median of the ratios, and the 90 % that are below. Left out: an end in collision, or no path.")


if __name__ == "__main__":
    main()
