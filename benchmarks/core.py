"""Quality per millisecond: first motions, lengths over time, kernel, limits, timing, collisions.

    python benchmarks/core.py [--problems FOLDER --lengths FILE] [--parts first,lengths,...] [--each 25]
                              [--motions 400] [--seed 1] [--cpu]
                              [--limits 0.01,0.05,0.1,1] [--seeds 1]

Prints the report that is kept in benchmarks/results/core.txt. FOLDER holds MotionBenchMaker families (scene
and request files), FILE reference lengths, {"length": {"family/number": {"best_known": ...}}}; of families
without, the best known length is the shortest of all rows here. One thread; times are those of the process
(CPU) unless wall time is said; with --cpu limits are of CPU time too. Clearance 0, so that lengths compare
with those of planners that keep none.
"""

import argparse
import json
import os
import time
from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from numba import njit
from report import header, print_table, progress

from collision import POINTS, check_edges, checked_configurations, fastest
from problems import PANDA, Case
from robotdiffuse.collision import CollisionChecker
from robotdiffuse.collision.exact_meshes import ExactCollision
from robotdiffuse.collision.kernels.lane_collision import make_workspace, place_frames
from robotdiffuse.collision.kernels.motions import Space
from robotdiffuse.collision.kernels.simd import W, lanes_array
from robotdiffuse.collision.motions import search_space
from robotdiffuse.core.types import Path as JointPath
from robotdiffuse.evaluation.methods import planned
from robotdiffuse.evaluation.problem_sets import gather_cases
from robotdiffuse.evaluation.records import Record
from robotdiffuse.evaluation.runs import Clock, tried
from robotdiffuse.planning import context, load_planner
from robotdiffuse.planning.planner import Planner
from robotdiffuse.problems.families import FAMILIES, load_family
from robotdiffuse.problems.problem import Problem
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.shapes import Box, Cylinder, PointCloud
from robotdiffuse.scenes.surface_points import sample_surface
from robotdiffuse.trajectories.timing import TimingSettings, time_parameterize

SEED = 20261122
REPEATS = 50
"""Of each path, back and forth, in the timing of the kernel."""
RESOLUTION, POINT_RADIUS = 0.05, 0.01
"""[m]"""
JERK = 100.0
"""[rad/s³]"""
TIGHT = (0.001, 0.01, 0.05, 0.1, 1.0)


def cases_of(folder: Path | None, each: int) -> list[Case]:
    """So many problems of each family, evenly spread over MotionBenchMaker's."""
    with TemporaryDirectory() as kept:
        own = gather_cases([f"{name}_nontrivial" for name in FAMILIES], each, Path(kept), print)
        given = [] if folder is None else gather_cases([str(folder)], None, Path(kept), print)
    families = dict.fromkeys(case.family for case in given)
    for family in families:
        of = [case for case in given if case.family == family]
        own += of[:: max(len(of) // each, 1)][:each]
    return own


def best_known(cases: Sequence[Case], lengths: dict, found: Sequence[Record]) -> dict[str, float]:
    """Shortest lengths by the name of the problem [rad]: the given ones, where there are none those found."""
    best: dict[str, float] = {}
    for case in cases:
        name = f"{case.family.removesuffix('_panda')}/{case.name[-4:]}"
        if name in lengths:
            best[case.name] = lengths[name]["best_known"]
    for record in found:
        if record.solved and record.name not in best:
            best[record.name] = min(
                r.measures["joint_length"] for r in found if r.solved and r.name == record.name
            )
    return best


def warm(name: str, cases: Sequence[Case]) -> Planner:
    """A planner whose compiled code, Coal and network are loaded."""
    planner = load_planner(name)
    planner.warm_up(cases[0].problem, "short")
    return planner


def by_family(cases: Sequence[Case]) -> Iterator[tuple[str, list[Case]]]:
    for family in dict.fromkeys(case.family for case in cases):
        yield family, [case for case in cases if case.family == family]
    yield "all", list(cases)


def first(cases: Sequence[Case], _lengths: dict) -> None:
    method = {"aorrtc": planned(warm("aorrtc", cases), until="first", clearance=0.0)}
    found = {r.name: r for r in tried(cases, method, limit=5.0, title="first")["aorrtc"]}
    rows = []
    for family, of in by_family(cases):
        records = [found[case.name] for case in of]
        paths = [1e3 * r.progress[0][0] for r in records if r.progress]
        cpu = np.percentile([1e3 * (r.cpu or np.nan) for r in records], (50, 95))
        rows.append((family, sum(r.solved for r in records), len(of), np.median(paths), *cpu))
    columns = ["family", "solved", "of", "first path ms", "whole call ms", "p95"]
    print_table(
        "aorrtc until the first motion",
        columns,
        [[r[0], r[1], r[2], *(f"{x:.2f}" for x in r[3:])] for r in rows],
    )


def lengths(cases: Sequence[Case], known: dict, limits: Sequence[float], seeds: int) -> None:
    names = ("aorrtc", "robotdiffuse", "rrt_connect")
    found: dict[tuple[str, float], list[Record]] = {}
    for limit in limits:
        methods = {name: planned(warm(name, cases), until="limit", clearance=0.0) for name in names}
        for name, records in tried(cases, methods, range(seeds), limit, title=f"{limit:g} s").items():
            found[name, limit] = records
    best = best_known(cases, known, [record for records in found.values() for record in records])
    rows = []
    for family, of in by_family(cases):
        inside = {case.name for case in of}
        for name in names:
            row = [f"{family} ({len(of)})", name]
            for limit in limits:
                records = [r for r in found[name, limit] if r.name in inside]
                ratios = [r.measures["joint_length"] / best[r.name] for r in records if r.solved]
                missing = len(records) - len(ratios)
                row.append(f"{np.mean(ratios):.4f}" + (f" ({missing} unsolved)" if missing else ""))
            stages = [r.stage for r in found[name, limits[-1]] if r.name in inside and r.solved]
            share = sum(stage in ("network", "refinement") for stage in stages) / max(len(stages), 1)
            rows.append([*row, f"{100 * share:.0f} %"])
    columns = ["family", "planner", *(f"{limit:g} s" for limit in limits), "network's in the last"]
    notes = ("mean of lengths over the best known one of the solved; rrt_connect: restarts",)
    print_table("Length over best known at equal time", columns, rows, notes)


@njit
def place_along(space, starts, ends, counts):
    """The kinematics of a check of these edges, in so many blocks each."""
    work, block = make_workspace(space.robot, space.scene), lanes_array(starts.shape[1], 1)
    for i in range(len(starts)):
        for j in range(starts.shape[1]):
            block[j, :] = np.float32(0.5) * (starts[i, j] + ends[i, j])
        for _ in range(counts[i] // W):
            place_frames(space.robot, block, work.frames, work.centres)
    return work.centres[0, 0]


def free_edges(path: np.ndarray, space: Space) -> tuple[np.ndarray, np.ndarray]:
    """The edges of a path that are free there and back, in both directions, many times."""
    starts, ends = np.concatenate([path[:-1], path[1:]]), np.concatenate([path[1:], path[:-1]])
    free = check_edges(space, starts, ends)
    free &= np.roll(free, len(path) - 1)
    return np.tile(starts[free], (REPEATS, 1)), np.tile(ends[free], (REPEATS, 1))


def kernel(cases: Sequence[Case], _lengths: dict) -> None:
    """Along the free edges of aorrtc's paths, at the resolution that searches use."""
    planner, rows, rng = load_planner("aorrtc"), [], np.random.default_rng(SEED)
    bare = search_space(CollisionChecker(PANDA, Scene()), RESOLUTION)
    for family, of in by_family(cases):
        if family == "all":
            continue
        spent, checked = np.zeros(4), np.zeros(2)
        for case in of[:20]:
            path = planner.plan(case.problem, 1.0, until="first", clearance=0.0).path
            if path is None:
                continue
            cloud = PointCloud(sample_surface(case.problem.scene, POINTS, rng), POINT_RADIUS)
            for k, scene in enumerate((case.problem.scene, Scene([cloud]))):
                space = search_space(CollisionChecker(PANDA, scene), RESOLUTION)
                starts, ends = free_edges(path.positions.astype(np.float32), space)
                if not len(starts):
                    continue
                counts = checked_configurations(space, starts, ends)
                checked[k] += counts.sum()
                spent[2 + k] += fastest(lambda a=starts, b=ends, s=space: check_edges(s, a, b))
                if k == 0:
                    spent[0] += fastest(lambda a=starts, b=ends, n=counts: place_along(bare, a, b, n))
                    spent[1] += fastest(lambda a=starts, b=ends: check_edges(bare, a, b))
        kinematics, itself, total = 1e9 * spent[:3] / max(checked[0], 1)
        parts = (kinematics, itself - kinematics, total - itself, total, 1e9 * spent[3] / max(checked[1], 1))
        rows.append((family, *(f"{ns:.0f}" for ns in parts)))
    columns = ["family", "kinematics", "self", "scene", "total", f"total, cloud of {POINTS:,}"]
    note = (
        f"ns a configuration, the fastest of some passes; cloud: on the obstacles, {1e3 * POINT_RADIUS:g} mm"
    )
    print_table("Collision check along edges that are free", columns, rows, (note,))


def limits(cases: Sequence[Case], _lengths: dict) -> None:
    rows = []
    for name in ("aorrtc", "robotdiffuse"):
        planner = warm(name, cases)
        for limit in TIGHT:
            over = []
            for case in progress(cases, f"{name} {limit:g} s"):
                with Clock() as clock:
                    result = planner.plan(case.problem, limit, until="limit", clearance=0.0)
                over.append((1e3 * (clock.wall - limit), result.solved))
            late = np.array([o for o, _ in over])
            solved = sum(s for _, s in over)
            p50, p99 = np.percentile(late, (50, 99))
            rows.append((name, f"{1e3 * limit:g}", f"{solved} of {len(cases)}", f"{p50:.1f}", f"{p99:.1f}"))
    columns = ["planner", "limit ms", "solved", "overrun ms, median", "p99"]
    print_table(
        "Wall time beyond the limit, the certificate and timing of the answer included", columns, rows
    )


def timing(cases: Sequence[Case], _lengths: dict) -> None:
    planner, worst, times = load_planner("aorrtc"), [0.0, 0.0], []
    longer, jerk = [], 0.0
    rng = np.random.default_rng(SEED)
    paths: list[JointPath] = []
    for case in progress(cases, "paths"):
        for seed in range(500 // len(cases) + 1):
            result = planner.plan(case.problem, 1.0, seed, until="first", clearance=0.0)
            if result.path is not None:
                paths.append(result.path)
    always: Callable[[object], bool] = lambda _: True  # noqa: E731
    for path in progress([paths[i] for i in rng.permutation(len(paths))[:500]], "timing"):
        with Clock() as clock:
            time_parameterize(PANDA, path, always, always, TimingSettings())
        times.append(1e3 * clock.cpu)
        fine = time_parameterize(PANDA, path, always, always, TimingSettings(sample_time=0.001))
        worst[0] = max(worst[0], float((np.abs(fine.velocities) / PANDA.velocity).max()))
        worst[1] = max(worst[1], float((np.abs(fine.accelerations) / PANDA.acceleration).max()))
        limited = TimingSettings(sample_time=0.001, jerk=JERK)
        gentle = time_parameterize(PANDA, path, always, always, limited)
        rates = np.diff(gentle.accelerations, axis=0) / np.diff(gentle.times)[:, None]
        jerk = max(jerk, float(np.abs(rates).max()) / JERK)
        longer.append(gentle.duration / fine.duration)
    rows = [
        ("CPU time, ms, median", f"{np.median(times):.2f}"),
        ("greatest share of a velocity limit at 1 ms", f"{worst[0]:.6f}"),
        ("greatest share of an acceleration limit at 1 ms", f"{worst[1]:.6f}"),
        (f"greatest share of a jerk limit of {JERK:g} rad/s³ at 1 ms", f"{jerk:.6f}"),
        ("duration with it over that without, median, most", f"{np.median(longer):.3f}, {max(longer):.3f}"),
    ]
    print_table(f"Timing of {len(times)} paths", ["", ""], rows)


def thin(problem: Problem, rng: np.random.Generator) -> Problem:
    """With plates of 1 mm and rods of 2 mm across at random places, as far as the ends stay free."""
    shapes = list(problem.scene.shapes)
    ends = np.concatenate([problem.start[None], problem.goal.positions])  # type: ignore[union-attr]
    for _ in range(6):
        at, wxyz = rng.uniform([-0.7, -0.7, 0.1], [0.7, 0.7, 1.1]), rng.normal(size=4)
        wxyz /= np.linalg.norm(wxyz)
        shape = Box(at, [0.3, 0.3, 0.001], wxyz) if rng.random() < 0.5 else Cylinder(at, 0.001, 0.5, wxyz)
        scene = Scene([*shapes, shape])
        if CollisionChecker(PANDA, scene).free(ends).all():
            shapes.append(shape)
    return Problem(PANDA, Scene(shapes), problem.start, problem.goal)


def steps(a: np.ndarray, b: np.ndarray) -> int:
    return max(int(np.ceil(np.abs(b - a).max() / 0.005)), 1)


def collisions(_cases: Sequence[Case], _known: dict, motions: int, seed: int) -> None:
    """Motions checked on meshes every 5 mrad by Coal and by PyBullet, half of them in scenes with thin
    things."""
    from robotdiffuse.simulation.validator import PyBulletOracle

    rng, rows = np.random.default_rng(seed), []
    families = [load_family(name) for name in FAMILIES]
    for name in ("aorrtc", "robotdiffuse"):
        planner, hits, checked, looked = load_planner(name), [0, 0], 0, 0
        for i in progress(range(motions // 2), name):
            problem = families[i % len(families)].draw(PANDA, np.random.default_rng([seed, i])).problem(PANDA)
            problem = thin(problem, rng) if i % 2 else problem
            result = planner.plan(problem, 0.05, seed=i, clearance=0.0)
            if result.trajectory is None:
                continue
            legs = pairwise(result.trajectory.positions)
            dense = np.concatenate([np.linspace(a, b, steps(a, b)) for a, b in legs])
            checked, looked = checked + 1, looked + len(dense)
            hits[0] += bool(ExactCollision(PANDA, problem.scene).collides(dense).any())
            with PyBulletOracle(PANDA, problem.scene) as oracle:
                hits[1] += oracle.check_frames(dense, tolerance=0.0) is not None
        rows.append((name, checked, looked, *hits))
    columns = ["planner", "motions", "configurations", "in collision by Coal", "by PyBullet"]
    print_table("Returned motions on meshes", columns, rows)


PARTS = {part.__name__: part for part in (first, lengths, kernel, limits, timing, collisions)}


def main() -> None:
    parser = argparse.ArgumentParser(description="Quality per millisecond.")
    parser.add_argument("--problems", type=Path, help="folder with MotionBenchMaker families")
    parser.add_argument("--lengths", type=Path, help="reference lengths (JSON)")
    parser.add_argument("--each", type=int, default=25, help="problems of each family (25)")
    parser.add_argument("--parts", default=",".join(PARTS), help="of the report, parted by commas (all)")
    parser.add_argument("--limits", default="0.01,0.05,0.1,1", help="for lengths, in s, parted by commas")
    parser.add_argument("--seeds", type=int, default=1, help="of each problem, for lengths (1)")
    parser.add_argument("--motions", type=int, default=400, help="that are checked on meshes (400)")
    parser.add_argument("--seed", type=int, default=SEED, help=f"of the scenes of these ({SEED})")
    parser.add_argument("--cpu", action="store_true", help="limits of CPU time, where other work runs beside")
    arguments = parser.parse_args()
    known = json.loads(arguments.lengths.read_text())["length"] if arguments.lengths else {}
    print(header("numpy", "numba", "coal"))
    print(f"limits of {'CPU' if arguments.cpu else 'wall'} time")
    if arguments.cpu:
        context.time = SimpleNamespace(perf_counter=time.process_time)  # type: ignore[assignment]
    cases = cases_of(arguments.problems, arguments.each)
    for name in ("aorrtc", "robotdiffuse", "rrt_connect"):
        load_planner(name).warm_up(cases[0].problem)  # compiles
    asked = [float(limit) for limit in arguments.limits.split(",")]
    more = {"collisions": (arguments.motions, arguments.seed), "lengths": (asked, arguments.seeds)}
    for part in arguments.parts.split(","):
        PARTS[part](cases, known, *more.get(part, ()))


if __name__ == "__main__":
    main()
