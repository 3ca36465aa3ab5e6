"""What learning buys: the network against unlearned starts and a sampling planner, at equal CPU time, paired.

    python benchmarks/learning.py [--sets rop,rop_dense,partial,motion_bench_maker] [--problems 200]
        [--motion-bench-maker FOLDER] [--cases FOLDER] [--weights FOLDER]

Prints the report that is kept in benchmarks/results/learning.txt. Sets of problems:

- rop, rop_dense: held-out problems that the straight line does not solve and ten seconds of search do.
- motion_bench_maker: the folder's families, all problems or as many as asked for, evenly spread.
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
(tables of robot and scene) and the judge are not in it. At a mark a method has the paths that it had by then,
and answers with the shortest one that passes the judge for what it sees. Methods take turns on each problem.
"""

import argparse
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import cycle
from pathlib import Path as File
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from report import header, print_table, progress
from scipy.stats import binomtest, wilcoxon

from problems import PANDA, SEED, draw_cases, goal_of
from robotdiffuse.collision import CollisionChecker
from robotdiffuse.collision.kernels.compiled import random_state
from robotdiffuse.collision.kernels.motions import motions_free, path_length
from robotdiffuse.collision.motion import search_space
from robotdiffuse.data.dataset import resample
from robotdiffuse.errors import InputError
from robotdiffuse.evaluation.metrics import Kinematics
from robotdiffuse.evaluation.trials import NETWORK_ALONE
from robotdiffuse.learning.motion_model import MotionModel
from robotdiffuse.paths.shortcut import shortcut
from robotdiffuse.planners.ends import Ends
from robotdiffuse.planners.robotdiffuse import (
    Candidates,
    RobotDiffuse,
    encode,
    unlearned_starts,
)
from robotdiffuse.planners.shared_tree.planner import SharedTreeSearch, SharedTreeSettings
from robotdiffuse.problems.families import FAMILIES
from robotdiffuse.problems.files import load_motion_bench_maker
from robotdiffuse.problems.problem import JointGoal, Problem
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.simulation import DepthCamera, World, point_cloud
from robotdiffuse.types import Path
from robotdiffuse.verify import VerifySettings, verifier

MARKS = (0.02, 0.05, 0.1, 0.2)
"""CPU times at which methods must have an answer [s]."""
BUMPS = 4
"""Unlearned starts in a batch: as many as the network's repeated batches have."""
DRAFT = {"samples": 4, "sampling_steps": 3}
"""Of the network's repeated batches."""
FRAMES = 129
"""Of the evenly spaced path that figures are taken of."""
POINT_RADIUS = 0.02
"""That planners give the points of a depth camera [m]."""
CERTAIN = 1e-4
"""Least p that is put down to chance: 0.05 over the tests that are done, 384 with all sets."""
SETS = ("rop", "rop_dense", "partial", "motion_bench_maker")


class Task(NamedTuple):
    seen: Problem
    """What planners know."""
    whole: Problem
    """What the judge goes by."""


class Arena:
    """What all methods share on a problem."""

    def __init__(self, problem: Problem, planner: RobotDiffuse, seed: int) -> None:
        assert isinstance(problem.goal, JointGoal)
        self.planner, self.seed = planner, seed
        self.rng = np.random.default_rng([SEED, 3, seed])
        self.state = random_state(SEED, seed)
        self.checker = CollisionChecker(problem.robot, problem.scene)
        self.ends = Ends(self.checker, problem.start, problem.goal.positions)
        model = planner.model(problem.robot)
        assert model is not None
        self.model: MotionModel = model
        if self.ends.reachable:
            self.start, self.goals = self.ends.rows()
            self.clearance = self.ends.kept_clearance(planner.settings.search.clearance)
            self.space = search_space(self.checker, planner.settings.resolution, self.clearance)

    def line(self) -> Float[ndarray, "2 dof"] | None:
        """The straight line, if it is free."""
        line = np.stack([self.start, self.goals[0]])
        space = search_space(self.checker, self.planner.settings.resolution)
        return line if motions_free(space, line).all() else None

    def shortened(self, found: Candidates) -> Iterator[ndarray]:
        """The shortest of the free candidates after shortcuts, as RobotDiffuse takes them."""
        settings = self.planner.settings
        for path in sorted(found.q[found.free], key=path_length)[: settings.shortened]:
            yield shortcut(self.space, path, settings.shortcuts, self.state)


Method = Callable[[Arena], Iterator[ndarray | None]]
"""Yields paths as it finds them; None where it only wants to be asked whether there is time left."""


def one_batch(arena: Arena) -> Candidates:
    """Samples of the network, refined if none is free."""
    planner, checker = arena.planner, arena.checker
    code = encode(arena.model, checker, planner.settings.points, arena.rng)
    found = planner.sample(arena.model, checker, code, arena.start, arena.goals, arena.rng)
    return found if found.free.any() else planner.refine(checker, found.q)


def network(arena: Arena) -> Iterator[ndarray | None]:
    yield from arena.shortened(one_batch(arena))


def as_sampled(arena: Arena) -> Iterator[ndarray | None]:
    found = one_batch(arena)
    yield from found.q[found.free]


def as_refined(arena: Arena) -> Iterator[ndarray | None]:
    count, frames = arena.planner.settings.samples, arena.model.config.frames
    q = unlearned_starts(arena.start, arena.goals[0], count, frames, PANDA, arena.rng)
    found = arena.planner.refine(arena.checker, q)
    yield from found.q[found.free]


def network_repeated(arena: Arena) -> Iterator[ndarray | None]:
    checker, settings = arena.checker, arena.planner.settings
    draft = RobotDiffuse(replace(settings, weights=None, **DRAFT))
    code = encode(arena.model, checker, settings.points, arena.rng)
    while True:
        found = draft.sample(arena.model, checker, code, arena.start, arena.goals, arena.rng)
        if not found.free.all():
            found = draft.refine(checker, found.q)
        yield None
        yield from arena.shortened(found)


def bumps_repeated(arena: Arena) -> Iterator[ndarray | None]:
    frames, line = arena.model.config.frames, 0
    while True:
        q = unlearned_starts(arena.start, arena.goals[0], BUMPS + line, frames, PANDA, arena.rng)[line:]
        found = arena.planner.refine(arena.checker, q)
        line = 1  # later batches are of bumps alone: the line gives the same again
        yield None
        yield from arena.shortened(found)


def shared_tree(arena: Arena) -> Iterator[ndarray | None]:
    settings = SharedTreeSettings(
        safety_distance=arena.clearance,
        steps=1,
        improvement=0.0,
        resolution=arena.planner.settings.resolution,
    )
    search = SharedTreeSearch(arena.checker, arena.start, arena.goals, settings, arena.state)
    best = np.inf
    while not search.finished:
        search.round()
        yield search.path() if search.cost < best else None
        best = min(best, search.cost)


METHODS: dict[str, Method] = {
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


class Found(NamedTuple):
    """A method's figures, a row for each problem and a column for each mark; nan where it has no answer."""

    length: Float[ndarray, "n marks"]
    """Joint-space length [rad]."""
    links: Float[ndarray, "n marks"]
    """The way of the origins of all links, the paper's length [m]."""
    bending: Float[ndarray, "n marks"]
    """Integral of |q''(u)|^2 du over u in [0, 1], over the squared length of the path."""
    answered: Float[ndarray, "n marks"]
    """1 where a path passes the judge for what the method sees, else 0."""


class Answer(NamedTuple):
    """The path that a method has at a mark; None if it has none."""

    path: ndarray | None
    free: bool
    """Whether it is free in the whole scene."""


def answers(task: Task, arena: Arena, method: Method) -> list[Answer]:
    """At each mark."""
    paths: list[tuple[float, ndarray]] = []
    began = time.process_time()
    for path in method(arena):
        spent = time.process_time() - began
        if spent > MARKS[-1]:
            break
        if path is not None:
            paths.append((spent, path))
    judge, whole = Judge(task.seen, arena), Judge(task.whole, arena)
    at_marks = []
    for mark in MARKS:
        there = sorted((path for spent, path in paths if spent <= mark), key=path_length)
        answer = next((path for path in there if judge.passes(path)), None)
        at_marks.append(Answer(answer, answer is not None and whole.passes(answer)))
    return at_marks


class Judge:
    """Remembers verdicts: marks share most of their paths."""

    def __init__(self, problem: Problem, arena: Arena) -> None:
        self.judge, self.arena = verifier(problem, VerifySettings()), arena
        self.names = problem.robot.joint_names
        self.known: dict[int, bool] = {}

    def passes(self, path: ndarray) -> bool:
        if id(path) not in self.known:
            full = self.arena.ends.complete(path)
            self.known[id(path)] = self.judge.path(Path(self.names, full)).valid
        return self.known[id(path)]


def compare(tasks: list[Task], planner: RobotDiffuse, title: str) -> dict[str, Found]:
    links = Kinematics(PANDA).link_length
    shape = len(tasks), len(MARKS)
    found = {
        name: Found(*(np.full(shape, np.nan) for _ in range(3)), answered=np.zeros(shape)) for name in METHODS
    }
    for i, task in enumerate(progress(tasks, title)):
        for name, method in METHODS.items():
            arena = Arena(task.seen, planner, i)
            if not arena.ends.reachable:
                continue
            line = arena.line()
            tried = method if line is None else lambda _arena, line=line: iter([line])
            for m, (path, free) in enumerate(answers(task, arena, tried)):
                found[name].answered[i, m] = path is not None
                if path is not None and free:
                    even = resample(path[None].astype(np.float64), FRAMES)[0]
                    length = float(path_length(path))
                    found[name].length[i, m] = length
                    found[name].links[i, m] = links(even[None])[0]
                    second = np.diff(even, 2, axis=0) * (FRAMES - 1) ** 2
                    found[name].bending[i, m] = (second**2).sum() / (FRAMES - 1) / length**2
    return found


def print_found(title: str, found: dict[str, Found]) -> None:
    shortest = np.full(len(found["network"].length), np.inf)
    for figures in found.values():
        shortest = np.fmin(shortest, np.fmin.reduce(figures.length, axis=1))
    rows = []
    for name, figures in found.items():
        for m, mark in enumerate(MARKS):
            solved = np.isfinite(figures.length[:, m])
            shares = (figures.answered[:, m], solved)
            row = [name, f"{1e3 * mark:.0f}", *(f"{100 * share.mean():.1f} %" for share in shares)]
            if solved.any():
                ratio = figures.length[solved, m] / shortest[solved]
                row += [f"{ratio.mean():.3f}", f"{np.percentile(ratio, 95):.3f}"]
                row += [
                    f"{figures.links[solved, m].mean():.2f}",
                    f"{np.median(figures.bending[solved, m]):.0f}",
                ]
            rows.append(row + [""] * (8 - len(row)))
    columns = ["", "CPU ms", "has a plan", "solved", "length*", "95th", "link path, m", "bending**"]
    print_table(title, columns, rows)


def print_pairs(title: str, found: dict[str, Found]) -> list[str]:
    """The table of paired tests; returns what is certain, in words."""
    rows, words = [], []
    for a, b in PAIRS:
        for m, mark in enumerate(MARKS):
            ours, theirs = found[a].length[:, m], found[b].length[:, m]
            both = np.isfinite(ours) & np.isfinite(theirs)
            only, other = (np.isfinite(x) & ~both for x in (ours, theirs))
            p = (
                binomtest(int(only.sum()), int(only.sum() + other.sum())).pvalue
                if (only | other).any()
                else 1.0
            )
            row = [f"{a} / {b}", f"{1e3 * mark:.0f}", f"{only.sum()} / {other.sum()}", f"{p:.1g}"]
            where = f"{title}, {1e3 * mark:.0f} ms: {a} against {b}"
            if p < CERTAIN:
                more = "more" if only.sum() > other.sum() else "fewer"
                difference = abs(only.sum() - other.sum()) / len(ours)
                words.append(f"{where}: solves {more} ({100 * difference:.1f} % of the problems)")
            for kind, name in (("length", "length"), ("links", "link path"), ("bending", "bending")):
                x, y = (getattr(found[method], kind)[both, m] for method in (a, b))
                share, p, one_way = ratio_test(x, y)
                row += ["" if share is None else f"{100 * (share - 1):+.1f} %", f"{p:.1g}"]
                if share is not None and one_way and p < CERTAIN:
                    words.append(
                        f"{where}: {name} {100 * abs(share - 1):.1f} % {'less' if share < 1 else 'more'}"
                    )
            rows.append(row)
    columns = ["", "CPU ms", "only / only", "p", "length", "p", "link path", "p", "bending", "p"]
    print_table(f"{title}: the first against the second", columns, rows)
    return words


def ratio_test(x: Float[ndarray, "n"], y: Float[ndarray, "n"]) -> tuple[float | None, float, bool]:
    """Geometric mean of x / y, p by Wilcoxon's signed ranks of its logarithms, where 1e-6 is a tie, and
    whether most of the pairs that are no tie go the way of the mean."""
    if not len(x):
        return None, 1.0, False
    # the straight line bends by rounding alone
    logs = np.log(np.maximum(x, 1e-6)) - np.log(np.maximum(y, 1e-6))
    logs[np.abs(logs) < 1e-6] = 0.0
    p = np.float64(wilcoxon(logs)[1]) if logs.any() else 1.0  # pyright: ignore[reportArgumentType]
    mean = float(logs.mean())
    one_way = bool(np.sign(logs[logs != 0]).sum() * mean > 0)
    return float(np.exp(mean)), float(p), one_way


def from_cases(family: str, count: int, folder: File | None) -> list[Task]:
    return [Task(case.problem, case.problem) for case in draw_cases(family, count, folder).hard]


def from_folder(folder: File, count: int) -> list[Task]:
    """Every problem of the families, or so many evenly spread."""
    names = sorted(path for path in folder.iterdir() if path.is_dir())
    tasks = []
    for entry in [entry for name in names for entry in load_motion_bench_maker(name)]:
        try:
            problem = entry.load()
        except InputError as error:
            print(f"left out: {entry.name}: {str(error).partition(': ')[2]}")
            continue
        tasks.append(Task(problem, problem))
    chosen = np.unique(np.linspace(0, len(tasks) - 1, min(count, len(tasks))).round().astype(int))
    return [tasks[i] for i in chosen]


def partial_views(count: int, folder: File | None) -> list[Task]:
    """What one camera sees; problems whose start or goal touches what is seen are left out."""
    each = -(-count // 3)  # of five families, as some are left out
    cases = {family: draw_cases(family, each, folder).hard for family in FAMILIES}
    tasks: list[Task] = []
    queues = {family: iter(hard) for family, hard in cases.items()}
    rng, touched = np.random.default_rng([SEED, 4]), 0
    with World(PANDA, Scene([]), look=True) as world:
        for family in cycle(FAMILIES):
            case = next(queues[family], None)
            if case is None or len(tasks) == count:
                break
            world.set_scene(case.problem.scene)
            world.place(case.problem.start)
            floor = [shape for shape in case.problem.scene.shapes if shape.name == "floor"]
            cloud = point_cloud(
                world, [around(rng)], rng, point_radius=POINT_RADIUS, without=[shape.name for shape in floor]
            )
            seen = Problem(PANDA, Scene([*floor, cloud]), case.problem.start, case.problem.goal)
            ends = np.stack([seen.start, goal_of(seen)])
            if CollisionChecker(PANDA, seen.scene).free(ends).all():
                tasks.append(Task(seen, case.problem))
            else:
                touched += 1
    print(f"partial: {len(tasks)} problems; {touched} left out as start or goal touches what is seen")
    return tasks


def around(rng: np.random.Generator) -> DepthCamera:
    """Somewhere on a ring around the arm, looking at the middle of its workspace; noise as usual."""
    angle, distance = rng.uniform(-np.pi, np.pi), rng.uniform(1.4, 1.8)
    position = (distance * float(np.cos(angle)), distance * float(np.sin(angle)), rng.uniform(0.8, 1.6))
    return DepthCamera(position=position, target=(0.0, 0.0, 0.4), noise=0.002, dropout=0.05)


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
    compare(from_cases("rop", 2, None), planner, "compiling")
    words = []
    for name in arguments.sets.split(","):
        if name == "motion_bench_maker":
            if arguments.motion_bench_maker is None:
                print("motion_bench_maker: left out; give --motion-bench-maker FOLDER")
                continue
            tasks = from_folder(arguments.motion_bench_maker, arguments.problems)
        elif name == "partial":
            tasks = partial_views(arguments.problems, arguments.cases)
        else:
            tasks = from_cases(name, arguments.problems, arguments.cases)
        found = compare(tasks, planner, name)
        print_found(f"\n== {name}, {len(tasks)} problems", found)
        words += print_pairs(name, found)
    print(
        "has a plan: it passes the judge for what the method sees; solved: it is free in the whole scene\n"
        "*  joint-space length over the shortest that any method found, mean and 95th percentile over the\n"
        "   problems that the method solved by then\n"
        f"** integral of |q''(u)|^2 du over u in [0, 1], over the squared length, of the path at {FRAMES}\n"
        "   even places, before it is timed; median; 0 is a straight line\n"
        "only / only: problems that one of the two solved, p by McNemar's exact test; length, link path and\n"
        "   bending: geometric mean of the ratios where both solved, p by Wilcoxon's signed ranks\n"
        f"\nCertain (p < {CERTAIN}):"
    )
    print("\n".join(f"- {line}" for line in words) or "- nothing")


if __name__ == "__main__":
    main()
