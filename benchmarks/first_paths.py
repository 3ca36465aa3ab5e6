"""The tail of the first path: CPU time of AORRTC's search until it has one, and the path's length.

    python benchmarks/first_paths.py [--sets shelf baxter:shelf FOLDER ...] [--problems 100] [--seeds 2]

Prints benchmarks/results/first_paths.txt. A set is a family (for the Panda), ROBOT:FAMILY, or a folder of
MotionBenchMaker. Problems are left out if the search cannot use their start or goal, or if a straight line
solves them. Only the search is timed, not inverse kinematics, validation and timing.
"""

import argparse
import time
from collections.abc import Iterator
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import numpy as np

from common import header, parse, print_table
from robotdiffuse.collision import CollisionChecker
from robotdiffuse.core.errors import InputError
from robotdiffuse.planning.context import DEFAULT_CLEARANCE
from robotdiffuse.planning.search.rrt import AnytimeSearch, SearchSettings, usual_clearances
from robotdiffuse.planning.start_goal import StartGoal
from robotdiffuse.problems.families.scaled import family_for
from robotdiffuse.problems.files import load_problems
from robotdiffuse.problems.problem import JointGoal, Problem
from robotdiffuse.robots import load_robot

FAMILIES = ("rop", "rop_dense", "shelf", "crate", "table", "clutter", "kitchen", "cabinet")
OTHER_ARMS = ("ur5e:shelf", "so101:shelf", "baxter_left:shelf", "baxter:shelf", "baxter:table")
SEED = 5
"""Seed of the problems."""
LIMIT = 1.0
"""CPU time after which a search ends [s]."""


class FirstPath(NamedTuple):
    seconds: float
    """CPU time; LIMIT without a path."""
    length: float
    """[rad]; infinite without a path."""


def problems(name: str) -> Iterator[Problem]:
    """The problems of a set."""
    folder = Path(name)
    if folder.is_dir():
        yield from (entry.load() for entry in load_problems(folder) if not entry.error)
        return
    robot_name, _, family = name.rpartition(":")
    robot = load_robot(robot_name or "panda")
    rng = np.random.default_rng(SEED)
    while True:
        with suppress(InputError):  # in some scenes, no free start and goal are found
            yield family_for(family, robot).draw(robot, rng).problem(robot)


def first_path(problem: Problem, seed: int) -> FirstPath | None:
    """Search until there is a path, or for LIMIT. None if the start or the goals cannot be used, or if a
    straight line is free."""
    assert isinstance(problem.goal, JointGoal)
    checker = CollisionChecker(problem.robot, problem.scene)
    start_goal = StartGoal(checker, problem.start, problem.goal.positions)
    if start_goal.start_lead is None or not start_goal.goals:
        return None
    began = time.process_time()
    search = AnytimeSearch(
        start_goal,
        SearchSettings(),
        "aorrtc",
        seed,
        usual_clearances(DEFAULT_CLEARANCE),
        stop=lambda: time.process_time() > began + LIMIT,
    )
    solved = search.first()
    seconds = time.process_time() - began
    if search.work == 0:
        return None
    return FirstPath(seconds if solved else LIMIT, float(search.length))


def main() -> None:
    parser = argparse.ArgumentParser(description="CPU time until a search has its first path.")
    parser.add_argument("--sets", nargs="+", default=[*FAMILIES, *OTHER_ARMS], help="families or folders")
    parser.add_argument("--problems", type=int, default=100, help="number of problems of each set (100)")
    parser.add_argument("--seeds", type=int, default=2, help="number of searches of each problem (2)")
    arguments = parse(parser, sets=["shelf"], problems=2, seeds=1)
    print(header("numba", "numpy"))
    rows = []
    for name in arguments.sets:
        drawn = list(islice(problems(name), arguments.problems))
        first_path(drawn[0], 0)  # compiles
        paths = [first_path(problem, seed) for problem in drawn for seed in range(arguments.seeds)]
        paths = [path for path in paths if path is not None]
        seconds = np.array([path.seconds for path in paths])
        late = int((seconds >= LIMIT).sum())
        lengths = [path.length for path in paths if np.isfinite(path.length)]
        times = [f"{1e3 * at:.2f}" for at in np.percentile(seconds, (50, 90, 95, 99))]
        rows.append((Path(name).name, len(paths), late, *times, f"{np.mean(lengths):.3f}"))
    columns = ("set", "searches", f"none in {LIMIT:g} s", "median ms", "p90", "p95", "p99", "mean length rad")
    print_table("First paths", columns, rows)


if __name__ == "__main__":
    main()
