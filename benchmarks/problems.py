"""Held-out problems of the families of training scenes, with reference lengths, drawn once and remembered.

    python benchmarks/problems.py --cases FOLDER [--families rop,shelf] [--problems 500] [--search-time 10]

A problem counts if RRT-Connect solves it within a time; what it cannot solve costs all of that time, which
makes drawing slow. FOLDER keeps one file per family, a line for each number that a problem is drawn from, and
is read by the benchmarks; drawing stops and goes on at any line.
"""

import argparse
import itertools
import json
import time
from collections.abc import Iterator
from pathlib import Path as File
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray
from rich.console import Console
from rich.progress import Progress

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.collision.kernels.compiled import random_state
from robotdiffuse.collision.kernels.motions import path_length
from robotdiffuse.collision.motion import search_space
from robotdiffuse.errors import InputError
from robotdiffuse.evaluation import trials
from robotdiffuse.evaluation.bench.problem_sets import family_problem, line_solves
from robotdiffuse.evaluation.trials import SEARCH_TIME, SEED, goal_of
from robotdiffuse.paths.shortcut import shortcut
from robotdiffuse.planners.rrt_connect import kernel
from robotdiffuse.planners.rrt_connect.planner import RRTConnect
from robotdiffuse.problems.families import FAMILIES
from robotdiffuse.problems.problem import Problem
from robotdiffuse.robots import load_robot

RUNS = 16
"""RRT-Connect runs after the one that decides; the shortest path of all is the reference length."""
PANDA = load_robot("panda")


class Case(NamedTuple):
    problem: Problem
    trivial: bool
    """Whether the straight line passes the judge."""
    reference: float
    """Length of the shortest of some RRT-Connect runs with shortcutting [rad]; of the line if trivial."""


class Drawn(NamedTuple):
    cases: list[Case]
    """In the order of drawing, trivial ones among them."""
    unsolved: int
    """Problems that were left out."""

    @property
    def hard(self) -> list[Case]:
        return [case for case in self.cases if not case.trivial]


def draw_cases(
    family: str, count: int, folder: File | None = None, search_time: float = SEARCH_TIME
) -> Drawn:
    """Solvable problems, `count` non-trivial ones among them; a folder keeps what is known of them."""
    cases: list[Case] = []
    hard = unsolved = 0
    with Progress(transient=True, console=Console(stderr=True)) as progress:
        task = progress.add_task(f"problems of {family}", total=count)
        for index, reference, trivial in _judged(family, folder, search_time):
            if reference is None:
                unsolved += 1
                continue
            cases.append(Case(family_problem(family, index), trivial, reference))
            hard += not trivial
            progress.update(task, completed=hard)
            if hard == count:
                break
    return Drawn(cases, unsolved)


def _judged(family: str, folder: File | None, search_time: float) -> Iterator[tuple[int, float | None, bool]]:
    """Number, reference length (None: not solved in time) and whether it is trivial: known ones, then new."""
    file = folder / f"{family}_{search_time:g}s.jsonl" if folder else None
    lines = file.read_text().splitlines() if file and file.exists() else []
    known = {case["index"]: case for case in map(json.loads, lines)}
    for index in itertools.count():
        if index not in known:
            reference, trivial = _reference(family_problem(family, index), search_time)
            known[index] = {"index": index, "reference": reference, "trivial": trivial}
            if file:
                file.parent.mkdir(parents=True, exist_ok=True)
                with file.open("a") as stream:
                    stream.write(json.dumps(known[index]) + "\n")
        yield index, known[index]["reference"], known[index]["trivial"]


def _reference(problem: Problem, search_time: float) -> tuple[float | None, bool]:
    if line_solves(problem):
        return float(np.linalg.norm(goal_of(problem) - problem.start)), True
    found = RRTConnect().plan(problem, search_time, seed=1)
    if found.path_length is None:
        return None, False
    return min(found.path_length, shortest_of_runs(problem, search_time)), False


def shortest_of_runs(problem: Problem, search_time: float) -> float:
    """Length of the shortest of some runs of RRT-Connect with shortcutting, begun within a time [rad]."""
    space = search_space(CollisionChecker(problem.robot, problem.scene), 0.02)
    start, goals = problem.start.astype(np.float32), goal_of(problem)[None].astype(np.float32)
    lengths, state, until = [np.inf], random_state(SEED), time.perf_counter() + search_time
    while len(lengths) <= RUNS and time.perf_counter() < until:
        trees = kernel.make_trees(start, goals, 20_000)
        path = kernel.search(space, trees, np.float32(1.5), 1_000_000, state)
        if len(path):
            lengths.append(float(path_length(shortcut(space, path, 120, state))))
    return min(lengths)


def judged(problem: Problem, q: Float[ndarray, "count frames dof"]) -> Bool[ndarray, "count"]:
    """Which trajectories, taken frame by frame as they are, pass the judge."""
    return trials.judged(problem, q)[0]


def families_of(text: str) -> list[str]:
    """Names parted by commas, for a command line; InputError for one that is unknown."""
    names = text.split(",")
    for name in names:
        if name not in FAMILIES:
            raise InputError(f"--families has {name!r}; known: {', '.join(FAMILIES)}")
    return names


def main() -> None:
    parser = argparse.ArgumentParser(description="Draw held-out problems for the benchmarks.")
    parser.add_argument("--cases", type=File, required=True, help="folder that keeps what is known of them")
    parser.add_argument("--families", type=families_of, default=list(FAMILIES), help="all of them")
    parser.add_argument("--problems", type=int, default=500, help="non-trivial ones of each (500)")
    parser.add_argument("--search-time", type=float, default=SEARCH_TIME, help="[s] (10)")
    arguments = parser.parse_args()
    for family in arguments.families:
        drawn = draw_cases(family, arguments.problems, arguments.cases, arguments.search_time)
        print(f"{family}: {len(drawn.hard)} not trivial of {len(drawn.cases) + drawn.unsolved} drawn")


if __name__ == "__main__":
    main()
