"""What a motion of the data set costs, and where the time goes, on one core.

    python benchmarks/generation.py [--problems 1000]
    python benchmarks/generation.py --planners [--robots panda ur5e] [--problems 60]

Prints the report that is kept in benchmarks/results/generation.txt. The shares are those of a second run
under the profiler, which makes Python look slower than it is beside compiled code.

With --planners: the two that data can be made by, Shared-Tree Informed RRT* and AORRTC, at equal CPU time, in
scenes of ROP, dense ROP and furniture which the straight line does not solve; the report is kept in
benchmarks/results/data_planners.txt. Lengths are compared where both kept the same safety distance.
"""

import argparse
import cProfile
import pstats
import time
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from report import header, print_table
from rich.progress import track

from robotdiffuse.cli.train_robot import MIX
from robotdiffuse.collision import CollisionChecker
from robotdiffuse.collision.kernels.compiled import random_state
from robotdiffuse.collision.kernels.motions import motions_free
from robotdiffuse.collision.motions import search_space
from robotdiffuse.generation import GenerationSettings
from robotdiffuse.generation.aorrtc_solver import AORRTCSearchSettings
from robotdiffuse.generation.shard_maker import draw, solve, with_near_goals
from robotdiffuse.generation.solvers import SEARCHES
from robotdiffuse.problems.families.family import SampledProblem
from robotdiffuse.robots import load_robot
from robotdiffuse.robots.robot import Robot

STAGES = {
    "drawing scene, start and goals (inverse kinematics)": ("shard_maker.py", "draw"),
    "search": ("shared_tree/planner.py", "run"),
    "validator": ("verify.py", "path"),
}


MARKS = (0.01, 0.02, 0.05, 0.1, 0.3)
"""CPU times at which the two planners are compared [s]."""
SAME = 0.002
"""Distances to obstacles that differ by no more are the same [m]."""
ENDLESS = 10**9


class Found(NamedTuple):
    """What a search has at some time."""

    cpu: float
    """[s]"""
    length: float
    """[rad]; infinite without a path."""
    least: float
    """Distance to obstacles along the path [m]."""
    safety: float
    """The safety distance that was kept but near the ends [m]."""


def searched(
    settings: GenerationSettings,
    checker: CollisionChecker,
    drawn: SampledProblem,
    seed: int,
    marks: tuple[float, ...],
) -> Iterator[Found]:
    """What the search of the settings has after so much CPU time [s], and where it ends by itself."""
    began = time.process_time()
    search = SEARCHES.load(settings.planner)(
        checker, drawn.start, drawn.goals, settings.search, random_state(1, seed)
    )
    for mark in marks:
        search.run(lambda until=began + mark: time.process_time() >= until)
        spent, path = time.process_time() - began, search.path()
        if path is None:
            yield Found(spent, np.inf, np.nan, search.safety_distance)
            continue
        shares = np.linspace(0, 1, 40, dtype=np.float32)[:, None]
        along = np.concatenate([a + shares * (b - a) for a, b in pairwise(path)])
        yield Found(spent, search.cost, float(checker.link_clearances(along).min()), search.safety_distance)


def problems(settings: GenerationSettings, robot: Robot, count: int) -> Iterator[tuple[int, SampledProblem]]:
    """Random ones that the straight line does not solve."""
    number = 0
    while count > 0:
        drawn = with_near_goals(robot, draw(settings, robot, np.random.default_rng([5, number]))[1])
        space = search_space(CollisionChecker(robot, drawn.scene), settings.search.resolution)
        line = np.stack([drawn.start, drawn.goals[0]])
        number += 1
        if not motions_free(space, line).all():
            count -= 1
            yield number, drawn


def compare(name: str, count: int) -> None:
    """Prints how the two planners do on problems for a robot."""
    robot = load_robot(name)
    usual = GenerationSettings(robot=name, mix=MIX, target="pose", goals=1)
    paper, fast = usual.search, AORRTCSearchSettings()
    by_paper, by_fast = usual, replace(usual, planner="aorrtc", search=fast)
    endless = (
        replace(by_paper, search=replace(paper, improvement=0.0)),
        replace(by_fast, search=replace(fast, patience=ENDLESS)),
    )
    pairs: dict[str, list[tuple[Found, Found, float]]] = {}
    for number, drawn in track([*problems(usual, robot, count)], name, transient=True):
        checker = CollisionChecker(robot, drawn.scene)
        ends = np.stack([drawn.start, *drawn.goals]).astype(np.float32)
        closest = float(checker.link_clearances(ends).min())

        def found(settings: GenerationSettings, *marks: float) -> list[Found]:
            return [*searched(settings, checker, drawn, number, marks)]  # noqa: B023

        if not pairs:
            for settings in endless:
                found(settings, 2.0)  # compiles
        alone = found(by_paper, np.inf)
        rows = {f"{1e3 * mark:.0f} ms": i for i, mark in enumerate(MARKS)}
        theirs, ours = (found(settings, *MARKS) for settings in endless)
        for row, i in rows.items():
            pairs.setdefault(row, []).append((theirs[i], ours[i], closest))
        same_time = found(endless[1], alone[0].cpu)[0]
        pairs.setdefault("as the paper's ends", []).append((alone[0], same_time, closest))
        pairs.setdefault("as each ends", []).append((alone[0], found(by_fast, np.inf)[0], closest))
    rows = []
    for row, every in pairs.items():
        both = [(a, b, end) for a, b, end in every if max(a.length, b.length) < np.inf]
        ratios = np.array([b.length / a.length for a, b, _ in both if abs(b.safety - a.safety) <= SAME])
        half = 1.96 * ratios.std(ddof=1) / np.sqrt(len(ratios))
        kept = (np.mean([f[i].least >= min(0.05, f[2]) - SAME for f in both]) for i in (0, 1))
        rows.append(
            [
                row,
                " / ".join(f"{1e3 * np.mean([f[i].cpu for f in every]):.0f}" for i in (0, 1)),
                " / ".join(f"{sum(f[i].length < np.inf for f in every)}" for i in (0, 1)),
                f"{ratios.mean():.4f} ± {half:.4f}, {np.median(ratios):.4f} ({len(ratios)})",
                " / ".join(f"{100 * np.mean([f[i].safety for f in both]):.2f}" for i in (0, 1)),
                " / ".join(f"{100 * share:.0f} %" for share in kept),
            ]
        )
    columns = ["CPU time", "ms, mean", "solved", "length of AORRTC over the paper's*", "safety, cm", "kept**"]
    print_table(f"{name}: the paper's planner / AORRTC, {count} problems", columns, rows)


def main() -> None:
    parser = argparse.ArgumentParser(description="What a motion of the data set costs.")
    parser.add_argument("--problems", type=int, help="1000; with --planners 60")
    parser.add_argument("--planners", action="store_true", help="compare those that data can be made by")
    parser.add_argument("--robots", nargs="+", default=["panda", "ur5e"], help="with --planners")
    arguments = parser.parse_args()
    count = arguments.problems or (60 if arguments.planners else 1000)
    print(header("numpy", "numba"))
    if arguments.planners:
        for name in arguments.robots:
            compare(name, count)
        print("*  mean with 95 % interval, median (problems where both kept the same safety distance)")
        print("** 5 cm, or what the closer end has, all along; to 2 mm")
        return
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
