"""The robots that come with the package, in furniture and clutter: solved, how soon, how short, on meshes.

    python benchmarks/shipped_arms.py [--robots ur5e fr3 ...] [--problems 200] [--out FILE] [--processor-time]

Prints a report that is kept in benchmarks/results/shipped_arms.txt; --out is written anew as each robot ends.
With --processor-time the planners' clock is this process's own, for a machine that others use too. First
motions of `robotdiffuse` with a limit of 1 s; what that does not solve, with 10 s. The lengths stand beside
those of `aorrtc` after the same time, on every tenth problem: for robots without weights that is what batches
of smooth noise add to search. Returned motions are checked at 5 mrad by Coal and by PyBullet on the robots'
meshes. 200 problems take a robot about a minute of one core, and 11 s more for each that nothing solves.
"""

import argparse
import time
from contextlib import redirect_stdout, suppress
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from report import header, print_table, progress

from robotdiffuse.collision.exact_meshes import ExactCollision
from robotdiffuse.core.errors import InputError
from robotdiffuse.core.results import PlanResult
from robotdiffuse.planning import load_planner
from robotdiffuse.problems.families.scaled import family_for
from robotdiffuse.problems.problem import Problem
from robotdiffuse.robots import ROBOTS, load_robot
from robotdiffuse.robots.robot import Robot
from robotdiffuse.simulation.validator import PyBulletOracle

FAMILIES = ("shelf", "crate", "table", "clutter", "kitchen")
SEED = 11
"""Of the problems; no setting was chosen on them."""
SOON, LATE = 1.0, 10.0
"""Time limits [s]."""
EACH = 10
"""Of so many problems, one is planned for all of SOON, by both planners."""
STEP = 0.005
"""Between two checked configurations, the largest joint's [rad]."""


@dataclass
class Tally:
    """What was counted on one robot."""

    problems: int = 0
    soon: int = 0
    late: int = 0
    times: list[float] = field(default_factory=list)
    ratios: list[float] = field(default_factory=list)
    noise: int = 0
    odd: list[str] = field(default_factory=list)
    """What is not solved soon: the problem, and when it was."""
    configurations: int = 0
    by_coal: int = 0
    by_pybullet: int = 0


def check(problem: Problem, result: PlanResult, oracle: PyBulletOracle, tally: Tally) -> None:
    """The timed motion on the meshes."""
    assert result.trajectory is not None
    legs = pairwise(result.trajectory.positions)
    counts = [(a, b, max(int(np.ceil(np.abs(b - a).max() / STEP)), 1)) for a, b in legs]
    dense = np.concatenate([np.linspace(a, b, count) for a, b, count in counts])
    tally.configurations += len(dense)
    tally.by_coal += bool(ExactCollision(problem.robot, problem.scene).collides(dense).any())
    oracle.set_scene(problem.scene)
    tally.by_pybullet += oracle.check_frames(dense, tolerance=0.0) is not None


def some(family: str, robot: Robot, count: int) -> list[tuple[str, Problem]]:
    """So many problems of a family, with their names; fewer where its furniture rarely suits the arm."""
    rng, found = np.random.default_rng(SEED), list[tuple[str, Problem]]()
    for _ in range(2 * count):
        with suppress(InputError):  # no free ends in many scenes
            problem = family_for(family, robot).draw(robot, rng).problem(robot)
            found.append((f"{family} {len(found)}", problem))
        if len(found) == count:
            break
    return found


def tried(name: str, problems: int) -> Tally:
    robot, tally = load_robot(name), Tally()
    hybrid, search = load_planner("robotdiffuse"), load_planner("aorrtc")
    drawn = [problem for family in FAMILIES for problem in some(family, robot, problems // len(FAMILIES))]
    if not drawn:
        return tally
    for planner in (hybrid, search):
        planner.warm_up(drawn[0][1], "converged")
    with PyBulletOracle(robot, drawn[0][1].scene) as oracle:
        for i, (what, problem) in enumerate(progress(drawn, name)):
            tally.problems += 1
            result = hybrid.plan(problem, SOON, seed=i, until="first")
            tally.soon += result.solved
            if result.solved:
                tally.times.append(1e3 * result.planning_time)
            else:
                result = hybrid.plan(problem, LATE, seed=i, until="first")
                tally.odd.append(f"{what} {f'{result.planning_time:.1f} s' if result.solved else 'never'}")
            tally.late += result.solved
            if result.solved:
                check(problem, result, oracle, tally)
            if i % EACH == 0 and result.solved and result.stage != "straight_line":
                ours, theirs = (
                    p.plan(problem, SOON, seed=i, until="time_limit", clearance=0.0) for p in (hybrid, search)
                )
                if ours.path is not None and theirs.path is not None:
                    tally.ratios.append(ours.path.length / theirs.path.length)
                    tally.noise += ours.stage in ("smooth_noise", "network", "refinement")
    return tally


def report(head: str, tallies: dict[str, Tally]) -> None:
    """Print what was found so far."""
    rows, notes = [], []
    for name, of in tallies.items():
        if of.problems == 0:
            rows.append([name, "0", *["-"] * 9])
            continue
        p50, p95 = np.percentile(of.times, (50, 95))
        lengths = (
            [f"{np.mean(of.ratios):.4f}", f"{of.noise} of {len(of.ratios)}"] if of.ratios else ["-", "-"]
        )
        found = [f"{of.problems}", f"{of.soon}", f"{of.late}", f"{p50:.1f}", f"{p95:.1f}", *lengths]
        rows.append([name, *found, f"{of.configurations}", f"{of.by_coal}", f"{of.by_pybullet}"])
        if of.odd:
            notes.append(f"{name}, not within a second: {', '.join(of.odd)}")
    columns = (
        "robot",
        "problems",
        "solved in 1 s",
        "in 10 s",
        "first ms, median",
        "p95",
        "length",
        "batches'",
    )
    notes.append(
        "length: of the hybrid over that of search alone at the same second, mean; batches': how many of "
        "those answers come from batches (smooth noise; of the Panda, the network)",
    )
    print(head)
    print_table("Furniture and clutter", (*columns, "checked", "Coal", "PyBullet"), rows, notes)


def main() -> None:
    parser = argparse.ArgumentParser(description="The robots that come with the package, in furniture.")
    parser.add_argument(
        "--robots", nargs="+", choices=ROBOTS, default=list(ROBOTS), metavar="ROBOT", help="(all)"
    )
    parser.add_argument("--problems", type=int, default=200, help="for each robot (200)")
    parser.add_argument("--out", metavar="FILE", help="for what was found so far")
    parser.add_argument("--processor-time", action="store_true", help="of this process, as the clock")
    arguments = parser.parse_args()
    head, tallies = header("numpy", "numba", "coal", "pybullet"), {}
    if arguments.processor_time:
        head += "; times of the processor"
        time.perf_counter = time.process_time
    for name in arguments.robots:
        tallies[name] = tried(name, arguments.problems)
        if arguments.out:
            with open(arguments.out, "w", encoding="utf-8") as file, redirect_stdout(file):
                report(head, tallies)
    report(head, tallies)


if __name__ == "__main__":
    main()
