"""What learning buys: the network against unlearned starts and a sampling planner, at equal CPU time, paired.

    python benchmarks/learning.py [--sets rop,rop_dense,partial,motion_bench_maker] [--problems 200]
        [--motion-bench-maker FOLDER] [--cases FOLDER] [--weights FOLDER]

Prints the report that is kept in benchmarks/results/learning.txt. Sets of problems:

- rop, rop_dense: held-out problems that the straight line does not solve and ten seconds of search do.
- motion_bench_maker: the folder's families, the first so many problems, of all families alike.
- partial: problems of all five families of training scenes in turn, seen by one depth camera somewhere around
  the arm, which stands at the start. Planners know the floor and points of 2 cm radius; what the camera does
  not see is not there for them. Solved means free in the whole scene.

Methods, all with the same checks, and with the straight line where what they see leaves it free:

- network: as RobotDiffuse plans, without its final search: one batch of 16 samples under guidance, refined if
  none is free, shortcuts. `as sampled`: without the shortcuts.
- bumps, as refined: the control for the latter, one batch of the line and 15 random bumps, refined.
- network, repeated: small batches of samples from few steps, refined, shortened, until time is over.
- bumps, repeated: the control. The line and 3 random bumps, refined and shortened alike; fresh bumps again.
- shared tree: the anytime planner of the data factory, of which a round is some RRT-Connect and RRT*.

Time is CPU time of this process from the ends to the shortened path, the encoder included; what all share
(tables of robot and scene) and the validator are not in it. At a mark a method has the paths that it had by then,
and answers with the shortest one that passes the validator for what it sees. Methods take turns on each problem.
"""

import argparse
from collections.abc import Sequence
from dataclasses import replace
from itertools import cycle
from pathlib import Path as File
from tempfile import TemporaryDirectory

import numpy as np
from report import WIDTH, header
from searches import as_refined, as_sampled, bumps_repeated, network, network_repeated, search, shared_tree

from problems import PANDA, SEED, Case, draw_cases, goal_of
from robotdiffuse.collision import CollisionChecker
from robotdiffuse.core.errors import InputError
from robotdiffuse.evaluation.methods import NETWORK_ALONE, searched
from robotdiffuse.evaluation.problem_sets import gather_cases
from robotdiffuse.evaluation.records import Record
from robotdiffuse.evaluation.runs import Trial, tried
from robotdiffuse.evaluation.statistics import compare
from robotdiffuse.evaluation.tables import Cell, Column, Table, show
from robotdiffuse.planning.diffusion.hybrid import RobotDiffuse
from robotdiffuse.problems.families import FAMILIES
from robotdiffuse.problems.problem import Problem
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.simulation import DepthCamera, World, point_cloud

MARKS = (0.02, 0.05, 0.1, 0.2)
"""CPU times at which methods must have an answer [s]."""
POINT_RADIUS = 0.02
"""That planners give the points of a depth camera [m]."""
CERTAIN = 1e-4
"""Least p that is put down to chance: 0.05 over the tests that are done, 384 with all sets."""
SETS = ("rop", "rop_dense", "partial", "motion_bench_maker")
METHODS = {
    "network": network,
    "network, as sampled": as_sampled,
    "bumps, as refined": as_refined,
    "network, repeated": network_repeated,
    "bumps, repeated": bumps_repeated,
    "shared tree": shared_tree,
}
PAIRS = [
    *((a, b) for a in ("network", "network, repeated") for b in ("bumps, repeated", "shared tree")),
    *(("network, as sampled", b) for b in ("bumps, as refined", "shared tree")),
]
MEASURES = {"joint_length": "length", "link_length": "link path", "bending": "bending"}

Found = dict[tuple[str, float], list[Record]]
"""By method and mark, in the order of the cases."""


def try_all(cases: list[Case], wholes: Sequence[Problem], planner: RobotDiffuse, title: str) -> Found:
    """`wholes`: what is true, where the cases are what planners see."""

    def whole(trial: Trial) -> Problem:
        return wholes[trial.place]

    methods = {name: searched(search(planner, tries), MARKS, whole) for name, tries in METHODS.items()}
    found = tried(cases, methods, seeds=(3,), title=title)
    return {
        (name, mark): [record for record in records if record.time_limit == mark]
        for name, records in found.items()
        for mark in MARKS
    }


def values(records: Sequence[Record], measure: str) -> np.ndarray:
    """NaN where there is no answer."""
    return np.array([record.measures.get(measure, np.nan) for record in records])


def found_table(title: str, found: Found) -> Table:
    lengths = {key: values(records, "joint_length") for key, records in found.items()}
    shortest = np.fmin.reduce(list(lengths.values()), axis=0)
    rows: list[list[Cell]] = []
    for (name, mark), records in found.items():
        solved = np.isfinite(lengths[name, mark])
        plans = float(np.mean([record.passed or 0.0 for record in records]))
        row: list[Cell] = [name, f"{1e3 * mark:.0f}", plans, float(solved.mean())]
        if solved.any():
            ratio = lengths[name, mark][solved] / shortest[solved]
            row += [ratio.mean(), np.percentile(ratio, 95), values(records, "link_length")[solved].mean()]
            row.append(np.median(values(records, "bending")[solved]))
        rows.append(row + [None] * (8 - len(row)))
    columns = (
        "",
        "CPU ms",
        Column("has a plan", "%", ".1f", scale=100.0),
        Column("solved", "%", ".1f", scale=100.0),
        Column("length*", format=".3f"),
        Column("95th", format=".3f"),
        Column("link path, m", format=".2f"),
        Column("bending**", format=".0f"),
    )
    return Table.of(title, columns, rows)


def pairs_table(title: str, found: Found) -> tuple[Table, list[str]]:
    """The table of paired tests, and what is certain, in words."""
    rows: list[list[Cell]] = []
    words: list[str] = []
    for (a, b), mark in ((pair, mark) for pair in PAIRS for mark in MARKS):
        where = f"{title}, {1e3 * mark:.0f} ms: {a} against {b}"
        row: list[Cell] = [f"{a} / {b}", f"{1e3 * mark:.0f}"]
        for measure, name in MEASURES.items():
            pair = compare(*(values(found[method, mark], measure) for method in (a, b)))
            if measure == "joint_length":
                row += [f"{pair.a_only} / {pair.b_only}", f"{pair.p_success:.1g}"]
                if pair.p_success < CERTAIN:
                    more = "more" if pair.a_only > pair.b_only else "fewer"
                    difference = 100 * abs(pair.a_only - pair.b_only) / len(found[a, mark])
                    words.append(f"{where}: solves {more} ({difference:.1f} % of the problems)")
            row += [pair.ratio and f"{100 * (pair.ratio - 1):+.1f} %", f"{pair.p_length:.1g}"]
            if pair.ratio is not None and pair.ratio != 1 and pair.p_length < CERTAIN:
                less = "less" if pair.ratio < 1 else "more"
                words.append(f"{where}: {name} {100 * abs(pair.ratio - 1):.1f} % {less}")
        rows.append(row)
    columns = (
        "",
        "CPU ms",
        "only / only",
        "p",
        *(text for name in MEASURES.values() for text in (name, "p")),
    )
    return Table.of(f"{title}: the first against the second", columns, rows), words


def partial_views(count: int, folder: File | None) -> tuple[list[Case], list[Problem]]:
    """What one camera sees, and what is true, without problems whose ends touch what is seen."""
    each = -(-count // 3)  # of five families, as some are left out
    queues = {family: iter(draw_cases(family, each, folder).hard) for family in FAMILIES}
    seen: list[Case] = []
    wholes: list[Problem] = []
    rng, touched = np.random.default_rng([SEED, 4]), 0
    with World(PANDA, Scene([]), visuals=True) as world:
        for family in cycle(FAMILIES):
            case = next(queues[family], None)
            if case is None or len(seen) == count:
                break
            problem = case.problem
            world.set_scene(problem.scene)
            world.place(problem.start)
            floor = [shape for shape in problem.scene.shapes if shape.name == "floor"]
            cloud = point_cloud(
                world, [around(rng)], rng, point_radius=POINT_RADIUS, without=[shape.name for shape in floor]
            )
            view = Problem(PANDA, Scene([*floor, cloud]), problem.start, problem.goal)
            ends = np.stack([view.start, goal_of(view)])
            if CollisionChecker(PANDA, view.scene).free(ends).all():
                seen.append(replace(case, problem=view))
                wholes.append(problem)
            else:
                touched += 1
    print(f"partial: {len(seen)} problems; {touched} left out as start or goal touches what is seen")
    return seen, wholes


def around(rng: np.random.Generator) -> DepthCamera:
    """Somewhere on a ring around the arm, looking at the middle of its workspace; noise as usual."""
    angle, distance = rng.uniform(-np.pi, np.pi), rng.uniform(1.4, 1.8)
    position = (distance * float(np.cos(angle)), distance * float(np.sin(angle)), rng.uniform(0.8, 1.6))
    return DepthCamera(position=position, target=(0.0, 0.0, 0.4), noise=0.002, dropout=0.05)


def cases_of(name: str, arguments: argparse.Namespace) -> tuple[list[Case], list[Problem]]:
    if name == "partial":
        return partial_views(arguments.problems, arguments.cases)
    if name == "motion_bench_maker":
        with TemporaryDirectory() as folder:
            place = str(arguments.motion_bench_maker)
            cases = gather_cases([place], arguments.problems, File(folder), print)
    else:
        cases = draw_cases(name, arguments.problems, arguments.cases).hard
    return cases, [case.problem for case in cases]


def main() -> None:
    parser = argparse.ArgumentParser(description="What learning buys, at equal CPU time.")
    parser.add_argument("--sets", default=",".join(SETS), help=f"of {', '.join(SETS)} (all)")
    parser.add_argument("--problems", type=int, default=200, help="of each set (200)")
    parser.add_argument("--motion-bench-maker", type=File, help="folder with MotionBenchMaker families")
    parser.add_argument("--cases", type=File, help="folder that keeps what is known of the problems")
    parser.add_argument("--weights", help="folder of a trained model; default: the bundled one")
    arguments = parser.parse_args()
    for name in arguments.sets.split(","):
        if name not in (*SETS, *FAMILIES):
            raise InputError(f"--sets has {name!r}; known: {', '.join((*SETS, *FAMILIES))}")
    print(header("numpy", "numba", "torch", "scipy"))
    print(f"weights: {arguments.weights or 'the bundled ones'}")
    planner = RobotDiffuse(replace(NETWORK_ALONE, weights=arguments.weights))
    first = draw_cases("rop", 2).hard
    try_all(first, [case.problem for case in first], planner, "compiling")
    words = []
    for name in arguments.sets.split(","):
        if name == "motion_bench_maker" and arguments.motion_bench_maker is None:
            print("motion_bench_maker: left out; give --motion-bench-maker FOLDER")
            continue
        cases, wholes = cases_of(name, arguments)
        found = try_all(cases, wholes, planner, name)
        pairs, certain = pairs_table(name, found)
        show(found_table(f"\n== {name}, {len(cases)} problems", found), pairs, width=WIDTH)
        words += certain
    print(
        "has a plan: it passes the validator for what the method sees; solved: it is free in the whole scene\n"
        "*  joint-space length over the shortest that any method found, mean and 95th percentile over the\n"
        "   problems that the method solved by then\n"
        "** integral of |q''(u)|^2 du over u in [0, 1], over the squared length, of the path before it is\n"
        "   timed; median; 0 is a straight line\n"
        "only / only: problems that one of the two solved, p by McNemar's exact test; length, link path and\n"
        "   bending: median of the ratios where both solved, p by Wilcoxon's signed ranks\n"
        f"\nCertain (p < {CERTAIN}):"
    )
    print("\n".join(f"- {line}" for line in words) or "- nothing")


if __name__ == "__main__":
    main()
