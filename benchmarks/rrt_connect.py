"""RRT-Connect on MotionBenchMaker folders and on fresh ROP problems, on one core.

    python benchmarks/rrt_connect.py [--problems FOLDER --lengths FILE] [--rop 1000]

Prints the report that is kept in benchmarks/results/rrt_connect.txt. FOLDER holds MotionBenchMaker families
(scene and request files), FILE the reference lengths, {"length": {"family/number": {"rrtc_simplified": ...,
"best_known": ...}}}. Every motion that counts as solved passed the judge.
"""

import argparse
import json
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from report import header, print_table

from problems import PANDA, Case, goal_of
from robotdiffuse.collision import CollisionChecker
from robotdiffuse.collision.exact import ExactCollision
from robotdiffuse.collision.kernels.compiled import random_state
from robotdiffuse.collision.kernels.motions import path_length
from robotdiffuse.collision.motion import search_space
from robotdiffuse.evaluation.methods import planned
from robotdiffuse.evaluation.problem_sets import gather_cases
from robotdiffuse.evaluation.records import Record
from robotdiffuse.evaluation.tables import Column
from robotdiffuse.evaluation.trial import Clock, Fields, Trial, tried
from robotdiffuse.paths.shortcut import shortcut
from robotdiffuse.planners.ends import Ends
from robotdiffuse.planners.rrt_connect import kernel
from robotdiffuse.planners.rrt_connect.planner import RRTConnect, RRTConnectSettings
from robotdiffuse.problems.families.rop import ROP, Rop
from robotdiffuse.problems.families.rop_dense import ROP_DENSE

SEED = 20261122
SETTINGS = RRTConnectSettings()


def compiled_part(trial: Trial) -> Iterator[Fields]:
    """Two searches and the shortcuts of one call, without set-up and judge."""
    checker = CollisionChecker(PANDA, trial.problem.scene)
    ends = Ends(checker, trial.problem.start, goal_of(trial.problem)[None])
    start, goals = ends.rows()
    clearance = ends.kept_clearance(SETTINGS.clearance)
    space, state = search_space(checker, SETTINGS.resolution, clearance), random_state(0)
    paths = []
    with Clock() as clock:
        for _ in range(SETTINGS.searches):
            trees = kernel.make_trees(start, goals, SETTINGS.capacity)
            paths.append(kernel.search(space, trees, np.float32(SETTINGS.reach), 1_000_000, state))
        shortcut(space, min(paths, key=path_length), SETTINGS.shortcuts, state)
    yield {"status": "solved", **clock.fields}


def motion_bench_maker(folder: Path, known: dict[str, dict[str, float]]) -> None:
    with TemporaryDirectory() as kept:
        cases = gather_cases([str(folder)], None, Path(kept), print)
    longer = RRTConnect(RRTConnectSettings(optimize_time=0.05))
    methods = {"once": planned(RRTConnect()), "longer": planned(longer), "search": compiled_part}
    found = tried(cases, methods, limit=5.0, title="MotionBenchMaker")
    by_name = {(name, record.name): record for name, records in found.items() for record in records}
    solved = [case for case in cases if all(by_name[name, case.name].solved for name in ("once", "longer"))]
    for case in cases:
        if case not in solved:
            print(f"not solved: {case.name}: {by_name['once', case.name].reason}")

    def figures(of: list[Case]) -> list[float]:
        def seconds(name: str, what: str) -> float:
            return float(np.median([getattr(by_name[name, case.name], what) for case in of]))

        named = [(case, known.get(f"{case.family.removesuffix('_panda')}/{case.name[-4:]}")) for case in of]
        pairs = [(case, lengths) for case, lengths in named if lengths is not None]
        once, long = (
            float(np.mean([by_name[name, c.name].joint_length or np.nan for c, _ in pairs] or [np.nan]))
            for name in ("once", "longer")
        )
        simplified, best = (
            float(np.mean([lengths[name] for _, lengths in pairs] or [np.nan]))
            for name in ("rrtc_simplified", "best_known")
        )
        times = seconds("search", "cpu"), seconds("once", "time")
        return [*times, once, simplified, once / simplified, long, best, long / best]

    families = sorted({case.family for case in solved})
    by_family = [(family, [case for case in solved if case.family == family]) for family in families]
    rows = [(f"{family} ({len(of)})", *figures(of)) for family, of in by_family]
    rows.append((f"all ({len(solved)})", *figures(solved)))
    ms = (Column(name, "ms", ".2f", scale=1e3) for name in ("search*", "plan"))
    names = ("length", "VAMP", "ratio", "50 ms", "best known", "ratio")
    print_table("MotionBenchMaker", ["problems", *ms, *(Column(name, "", ".3f") for name in names)], rows)
    ends = [(case.problem, np.stack([case.problem.start, goal_of(case.problem)])) for case in cases]
    free = sum(not ExactCollision(PANDA, problem.scene).collides(q).any() for problem, q in ends)
    spheres = sum(CollisionChecker(PANDA, problem.scene).free(q).all() for problem, q in ends)
    print(f"start and goal free: {free} by mesh, {spheres} by covering spheres, of {len(cases)} loaded")
    once, longer = (sum(record.solved for record in found[name]) for name in ("once", "longer"))
    print(f"solved and verified: {once} of {len(cases)}; with 50 ms of restarts {longer}")
    print("* compiled search and shortcuts, CPU time; plan: with set-up, ends and judge, wall time; medians")


def rop(count: int) -> None:
    ten = Rop(obstacles=(10, 10), sphere_radius=ROP_DENSE.sphere_radius, cube_side=ROP_DENSE.cube_side)
    rows = []
    for title, family in (("ROP, 2 obstacles", ROP), ("ROP, 10 obstacles", ten)):
        drawn = (family.draw(PANDA, np.random.default_rng([SEED, i])).problem(PANDA) for i in range(count))
        cases = [Case(f"{title}/{i}", title, problem, False) for i, problem in enumerate(drawn)]

        def solved(of: list[Case], limit: float, seed: int, title: str = title) -> list[Record]:
            return tried(of, {title: planned(RRTConnect())}, (seed,), limit, title=title)[title]

        first = solved(cases, 1.0, 0)
        # the reference searches with another seed, and only where the first call failed
        failed = [case for case, record in zip(cases, first, strict=True) if not record.solved]
        later = sum(record.solved for record in solved(failed, 10.0, 1))
        times = 1e3 * np.percentile([record.time for record in first], (50, 95))
        in_one, plan = count - len(failed), f"{times[0]:.2f} / {times[1]:.2f}"
        rows.append((title, f"{in_one} of {count}", f"{in_one + later} of {count}", plan))
    print_table("Fresh ROP problems", ["", "solved in 1 s", "solved in 10 s", "plan ms median / p95"], rows)


def main() -> None:
    parser = argparse.ArgumentParser(description="RRT-Connect on MotionBenchMaker and ROP problems.")
    parser.add_argument("--problems", type=Path, help="folder with MotionBenchMaker families")
    parser.add_argument("--lengths", type=Path, help="reference lengths (JSON)")
    parser.add_argument("--rop", type=int, default=1000, help="problems of each ROP kind (1000)")
    arguments = parser.parse_args()
    print(header("numpy", "numba", "coal"))
    if arguments.problems:
        lengths = json.loads(arguments.lengths.read_text())["length"] if arguments.lengths else {}
        motion_bench_maker(arguments.problems, lengths)
    rop(arguments.rop)


if __name__ == "__main__":
    main()
