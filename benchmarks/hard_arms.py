"""Hard problems of arms without weights: what the default planner and its own search solve in the same time.

    python benchmarks/hard_arms.py [--robots baxter_left ...] [--problems 32] [--processor-time]

Hard is a problem of furniture or clutter that `aorrtc` does not solve within SELECTION_LIMIT with the seed
of the selection; those that nothing solves within the longest limit are among them. Prints a report that is
kept in benchmarks/results/hard_arms.txt. With --processor-time the planners' clock is this process's own, for
a machine that others use too.
"""

import argparse
from contextlib import suppress

import numpy as np

from common import header, parse, print_table, progress, use_processor_time
from robotdiffuse.core.errors import InputError
from robotdiffuse.planning import load_planner
from robotdiffuse.problems.families.scaled import family_for
from robotdiffuse.problems.problem import Problem
from robotdiffuse.robots import ROBOTS, load_robot

FAMILIES = ("shelf", "crate", "table", "clutter", "kitchen")
PLANNERS = ("robotdiffuse", "aorrtc")
# Seeds of the problems, and of the calls that select the hard ones.
SEED = 23
SELECTION = 9_000
SELECTION_LIMIT = 0.15
"""Time limit of the calls that select the hard ones [s]."""


def hard_ones(name: str, count: int) -> list[Problem]:
    """The first `count` problems that are not solved soon, of the families in turn."""
    robot = load_robot(name)
    rng = np.random.default_rng(SEED)
    search = load_planner("aorrtc")
    found = list[Problem]()
    drawn = 0
    while len(found) < count:
        family = FAMILIES[drawn % len(FAMILIES)]
        drawn += 1
        with suppress(InputError):  # many scenes have no free start and goal
            problem = family_for(family, robot).draw(robot, rng).problem(robot)
            if drawn == 1 or not found:
                search.warm_up(problem)
            if not search.plan(problem, SELECTION_LIMIT, seed=SELECTION, until="first").solved:
                found.append(problem)
    print(f"{name}: {count} hard problems among {drawn} draws", flush=True)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description="Hard problems of arms without weights.")
    parser.add_argument("--robots", nargs="+", choices=ROBOTS, default=["baxter_left", "baxter_right"])
    parser.add_argument("--problems", type=int, default=32, help="for each robot (32)")
    parser.add_argument("--limits", nargs="+", type=float, default=[1.0, 4.0], help="[s] (1 4)")
    parser.add_argument("--processor-time", action="store_true", help="of this process, as the clock")
    arguments = parse(parser, robots=["baxter_right"], problems=1, limits=[0.2], processor_time=True)
    head = header("numpy", "numba")
    if arguments.processor_time:
        head += "; times of the processor"
        use_processor_time()
    rows = []
    for name in arguments.robots:
        problems = hard_ones(name, arguments.problems)
        planners = {planner: load_planner(planner) for planner in PLANNERS}
        for planner in planners.values():
            planner.warm_up(problems[0])
        at: dict[str, list[float]] = {planner: [] for planner in PLANNERS}
        longest = max(arguments.limits)
        for i, problem in enumerate(progress(problems, name)):
            for label, planner in planners.items():
                result = planner.plan(problem, longest, seed=i, until="first")
                at[label].append(result.planning_time if result.solved else np.inf)
        for label, times in at.items():
            counts = [str(sum(took <= limit for took in times)) for limit in arguments.limits]
            other = at[PLANNERS[PLANNERS.index(label) - 1]]
            alone = sum(mine < np.inf == its for mine, its in zip(times, other, strict=True))
            rows.append([name, label, str(len(times)), *counts, str(alone)])
    print(head)
    columns = ("robot", "planner", "problems", *(f"in {limit:g} s" for limit in arguments.limits), "alone")
    notes = ["alone: solved within the longest limit by this planner, and not by the other"]
    print_table("Hard problems, first motions", columns, rows, notes)


if __name__ == "__main__":
    main()
