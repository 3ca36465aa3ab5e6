"""Search: time to the first motion, path lengths at equal time, overrun, timing, collisions.

    python benchmarks/planners.py [--parts first,lengths,limits,timing,collisions] [--each 25]
        [--problems FOLDER --lengths FILE] [--limits 0.01,0.05,0.1,1] [--seeds 1] [--motions 400] [--cpu]

Prints benchmarks/results/core.txt. FOLDER holds MotionBenchMaker families (scene and request files), FILE the
reference lengths {"length": {"family/number": {"best_known": ...}}}; without FILE, the best known length of a
problem is the shortest one that any planner finds in this run. One thread is used. Times are CPU times of the
process unless a table says wall time; with --cpu, time limits are of CPU time too. The clearance is 0, so
that lengths can be compared with those of planners that keep no clearance.
"""

import argparse
import json
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

from common import (
    FIRST,
    TIME_LIMIT,
    contacts_on_meshes,
    dense,
    header,
    limit_shares,
    parse,
    parts_of,
    print_table,
    progress,
    use_processor_time,
)
from robotdiffuse.collision import CollisionChecker
from robotdiffuse.core.types import LENGTH
from robotdiffuse.core.types import Path as JointPath
from robotdiffuse.evaluation.runs import Record, clocked, gather_cases, planned, run_all
from robotdiffuse.planning import load_planner
from robotdiffuse.planning.planner import Planner
from robotdiffuse.problems.families import FAMILIES, load_family
from robotdiffuse.problems.files import Case, goal_of
from robotdiffuse.problems.problem import Problem
from robotdiffuse.robots import load_robot
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.shapes import Box, Cylinder
from robotdiffuse.simulation.validator import PyBulletOracle
from robotdiffuse.trajectories.timing import TimingSettings, time_parameterize

PANDA = load_robot("panda")
SEED = 20261122
PLANNERS = ("aorrtc", "rrt_connect")
JERK = 100.0
"""Jerk limit in the part `timing` [rad/s³]."""
FIRST_CALLS = 5
"""Number of equal calls until the first motion. The least CPU time counts, since other work on the machine
only adds to it."""
OVERRUN_LIMITS = (0.001, 0.01, 0.05, 0.1, 1.0)
"""Time limits whose overrun is measured [s]."""
TIMED_PATHS = 500
MESH_STEP = 0.005
"""Largest motion of a joint between two configurations that are checked on meshes [rad]."""


def gather(folder: Path | None, families: Sequence[str], each: int) -> list[Case]:
    """`each` problems of each family, and of each family of MotionBenchMaker in `folder`. Problems of
    MotionBenchMaker are evenly spaced in the list of their family."""
    with TemporaryDirectory() as cache:
        cases = gather_cases([f"{name}_nontrivial" for name in families], each, Path(cache), print)
        published = [] if folder is None else gather_cases([str(folder)], None, Path(cache), print)
    for family in dict.fromkeys(case.family for case in published):
        of_family = [case for case in published if case.family == family]
        cases += of_family[:: max(len(of_family) // each, 1)][:each]
    return cases


def best_known(cases: Sequence[Case], lengths: dict, records: Sequence[Record]) -> dict[str, float]:
    """The best known length of each problem, by its name [rad]: that of `lengths`, else the shortest length
    in the records."""
    best: dict[str, float] = {}
    for case in cases:
        name = f"{case.family.removesuffix('_panda')}/{case.name[-4:]}"
        if name in lengths:
            best[case.name] = lengths[name]["best_known"]
    for record in records:
        if record.solved and record.name not in best:
            best[record.name] = min(
                r.measures["joint_length"] for r in records if r.solved and r.name == record.name
            )
    return best


def warm(name: str, cases: Sequence[Case]) -> Planner:
    """A planner whose compiled code, Coal and network are loaded."""
    planner = load_planner(name)
    planner.warm_up(cases[0].problem, TIME_LIMIT)
    return planner


def by_family(cases: Sequence[Case]) -> Iterator[tuple[str, list[Case]]]:
    for family in dict.fromkeys(case.family for case in cases):
        yield family, [case for case in cases if case.family == family]
    yield "all", list(cases)


def first(cases: Sequence[Case]) -> None:
    """Print the CPU time until aorrtc has its first path, and until its call returns, for the fastest of
    several calls."""
    method = {"aorrtc": planned(warm("aorrtc", cases), until=FIRST, clearance=0.0)}
    calls = [run_all(cases, method, limit=5.0, title="first")["aorrtc"] for _ in range(FIRST_CALLS)]
    fastest = {group[0].name: min(group, key=lambda r: r.cpu or np.inf) for group in zip(*calls, strict=True)}
    rows = []
    for family, group in by_family(cases):
        records = [fastest[case.name] for case in group]
        paths = [1e3 * r.progress[0][0] for r in records if r.progress]
        cpu = np.percentile([1e3 * (r.cpu or np.nan) for r in records], (50, 95))
        rows.append((family, sum(r.solved for r in records), len(group), np.median(paths), *cpu))
    columns = ["family", "solved", "of", "first path ms", "whole call ms", "p95"]
    print_table(
        "aorrtc until the first motion",
        columns,
        [[r[0], r[1], r[2], *(f"{x:.2f}" for x in r[3:])] for r in rows],
    )


def lengths(cases: Sequence[Case], known: dict, limits: Sequence[float], seeds: int) -> None:
    """Print path lengths at equal time limits, relative to the best known ones."""
    by_call: dict[tuple[str, float], list[Record]] = {}
    for limit in limits:
        methods = {name: planned(warm(name, cases), until=TIME_LIMIT, clearance=0.0) for name in PLANNERS}
        for name, records in run_all(cases, methods, range(seeds), limit, title=f"{limit:g} s").items():
            by_call[name, limit] = records
    best = best_known(cases, known, [record for records in by_call.values() for record in records])
    rows = []
    for family, group in by_family(cases):
        inside = {case.name for case in group}
        for name in PLANNERS:
            row = [f"{family} ({len(group)})", name]
            for limit in limits:
                records = [r for r in by_call[name, limit] if r.name in inside]
                ratios = [r.measures["joint_length"] / best[r.name] for r in records if r.solved]
                missing = len(records) - len(ratios)
                row.append(f"{np.mean(ratios):.4f}" + (f" ({missing} unsolved)" if missing else ""))
            rows.append(row)
    columns = ["family", "planner", *(f"{limit:g} s" for limit in limits)]
    notes = ("mean of the ratios to the best known length, over the solved problems; rrt_connect: restarts",)
    print_table("Length over best known at equal time", columns, rows, notes)


def limits(cases: Sequence[Case]) -> None:
    """Print how much longer calls take than their time limits."""
    rows = []
    planner = warm("aorrtc", cases)
    for limit in OVERRUN_LIMITS:
        over = []
        for case in progress(cases, f"{limit:g} s"):
            with clocked() as seconds:
                result = planner.plan(case.problem, limit, until=TIME_LIMIT, clearance=0.0, objective=LENGTH)
            over.append((1e3 * (seconds["time"] - limit), result.solved))
        late = np.array([o for o, _ in over])
        solved = sum(s for _, s in over)
        p50, p99 = np.percentile(late, (50, 99))
        rows.append((f"{1e3 * limit:g}", f"{solved} of {len(cases)}", f"{p50:.1f}", f"{p99:.1f}"))
    columns = ["limit ms", "solved", "overrun ms, median", "p99"]
    print_table("Wall time beyond the limit, validation and timing of the answer included", columns, rows)


def timing(cases: Sequence[Case], count: int = TIMED_PATHS) -> None:
    """Print how long the time parameterization takes, and the largest velocities, accelerations and jerks as
    fractions of their limits."""
    planner = load_planner("aorrtc")
    worst = [0.0, 0.0]
    times = []
    longer = []
    jerk = 0.0
    rng = np.random.default_rng(SEED)
    paths: list[JointPath] = []
    for case in progress(cases, "paths"):
        for seed in range(count // len(cases) + 1):
            result = planner.plan(case.problem, 1.0, seed, until=FIRST, clearance=0.0)
            if result.path is not None:
                paths.append(result.path)
    always: Callable[[object], bool] = lambda _: True  # noqa: E731
    for path in progress([paths[i] for i in rng.permutation(len(paths))[:count]], "timing"):
        with clocked() as seconds:
            time_parameterize(PANDA, path, always, always, TimingSettings())
        times.append(1e3 * seconds["cpu"])
        fine = time_parameterize(PANDA, path, always, always, TimingSettings(sample_time=0.001)).trajectory
        worst[0] = max(worst[0], float((np.abs(fine.velocities) / PANDA.velocity).max()))
        worst[1] = max(worst[1], float((np.abs(fine.accelerations) / PANDA.acceleration).max()))
        limited = TimingSettings(sample_time=0.001, jerk=JERK)
        gentle = time_parameterize(PANDA, path, always, always, limited).trajectory
        rates = np.diff(gentle.accelerations, axis=0) / np.diff(gentle.times)[:, None]
        jerk = max(jerk, float(np.abs(rates).max()) / JERK)
        longer.append(gentle.duration / fine.duration)
    rows = [
        ("CPU time, ms, median", f"{np.median(times):.2f}"),
        ("largest fraction of a velocity limit, rows of 1 ms", f"{worst[0]:.6f}"),
        ("largest fraction of an acceleration limit, rows of 1 ms", f"{worst[1]:.6f}"),
        (f"largest fraction of a jerk limit of {JERK:g} rad/s³, rows of 1 ms", f"{jerk:.6f}"),
        (
            "duration with jerk limit over that without, median, largest",
            f"{np.median(longer):.3f}, {max(longer):.3f}",
        ),
    ]
    print_table(f"Timing of {len(times)} paths", ["", ""], rows)


def with_thin_obstacles(problem: Problem, rng: np.random.Generator) -> Problem:
    """The problem with up to six more obstacles, plates of 1 mm thickness and rods of 2 mm diameter, at
    random places that leave start and goal free."""
    shapes = list(problem.scene.shapes)
    ends = np.stack([problem.start, goal_of(problem)])
    for _ in range(6):
        at = rng.uniform([-0.7, -0.7, 0.1], [0.7, 0.7, 1.1])
        wxyz = rng.normal(size=4)
        wxyz /= np.linalg.norm(wxyz)
        shape = Box(at, [0.3, 0.3, 0.001], wxyz) if rng.random() < 0.5 else Cylinder(at, 0.001, 0.5, wxyz)
        scene = Scene([*shapes, shape])
        if CollisionChecker(PANDA, scene).free(ends).all():
            shapes.append(shape)
    return Problem(PANDA, Scene(shapes), problem.start, problem.goal)


def collisions(motions: int, seed: int) -> None:
    """Print how many returned motions collide on meshes, how many stop on the way, and the largest
    velocities, accelerations and jerks as fractions of their limits. Half of the scenes have thin
    obstacles."""
    rng = np.random.default_rng(seed)
    families = [load_family(name) for name in FAMILIES]
    planner = load_planner("aorrtc")
    hits = [0, 0, 0]
    checked = 0
    configurations = 0
    shares = np.zeros(3)
    with PyBulletOracle(PANDA, Scene()) as oracle:
        for i in progress(range(motions), "motions"):
            family = families[i % len(families)]
            problem = family.draw(PANDA, np.random.default_rng([seed, i])).problem(PANDA)
            problem = with_thin_obstacles(problem, rng) if i % 2 else problem
            result = planner.plan(problem, 0.05, seed=i, clearance=0.0)
            if result.trajectory is None:
                continue
            q = dense(result.trajectory.positions, MESH_STEP)
            checked = checked + 1
            configurations = configurations + len(q)
            contacts = contacts_on_meshes(problem, q, tolerance=0.0, oracle=oracle)
            hits[0] += contacts.coal > 0
            hits[1] += contacts.pybullet
            hits[2] += bool(result.stops)
            shares = np.maximum(shares, limit_shares(PANDA, result.trajectory))
    rows = [(checked, configurations, *hits, *(f"{share:.5f}" for share in shares))]
    columns = ["motions", "configurations", "in collision by Coal", "by PyBullet", "with stops"]
    columns += ["velocity", "acceleration", "jerk"]
    print_table("Returned motions on meshes", columns, rows)


PARTS = ("first", "lengths", "limits", "timing", "collisions")


def main() -> None:
    parser = argparse.ArgumentParser(description="Search: times, lengths, limits, collisions.")
    parser.add_argument("--problems", type=Path, help="folder with MotionBenchMaker families")
    parser.add_argument("--lengths", type=Path, help="reference lengths (JSON)")
    parser.add_argument("--families", nargs="+", default=list(FAMILIES), help="families of problems (all)")
    parser.add_argument("--each", type=int, default=25, help="number of problems of each family (25)")
    parser.add_argument(
        "--parts", default=",".join(PARTS), help="parts of the report, separated by commas (all)"
    )
    parser.add_argument(
        "--limits",
        default="0.01,0.05,0.1,1",
        help="time limits of the comparison of lengths [s], separated by commas",
    )
    parser.add_argument(
        "--seeds", type=int, default=1, help="number of seeds for each problem, for lengths (1)"
    )
    parser.add_argument(
        "--paths", type=int, default=TIMED_PATHS, help=f"number of paths that are timed ({TIMED_PATHS})"
    )
    parser.add_argument(
        "--motions", type=int, default=400, help="number of motions that are checked on meshes (400)"
    )
    parser.add_argument(
        "--seed", type=int, default=SEED, help=f"seed of the motions that are checked ({SEED})"
    )
    parser.add_argument(
        "--cpu", action="store_true", help="time limits are CPU time, so that other work does not count"
    )
    arguments = parse(parser, families=["rop"], each=2, limits="0.05", paths=3, motions=4)
    parts = parts_of(arguments.parts, PARTS)
    known = json.loads(arguments.lengths.read_text())["length"] if arguments.lengths else {}
    print(header("numpy", "numba", "coal"))
    print(f"limits of {'CPU' if arguments.cpu else 'wall'} time")
    if arguments.cpu:
        use_processor_time()
    cases = gather(arguments.problems, arguments.families, arguments.each)
    for name in PLANNERS:
        load_planner(name).warm_up(cases[0].problem)  # compiles
    limits_of_lengths = [float(limit) for limit in arguments.limits.split(",")]
    calls: Mapping[str, Callable[[], None]] = {
        "first": partial(first, cases),
        "lengths": partial(lengths, cases, known, limits_of_lengths, arguments.seeds),
        "limits": partial(limits, cases),
        "timing": partial(timing, cases, arguments.paths),
        "collisions": partial(collisions, arguments.motions, arguments.seed),
    }
    for part in parts:
        calls[part]()


if __name__ == "__main__":
    main()
