"""Many motions for one scene: goals reached per second of CPU time, by the network, its control and search.

    python benchmarks/many_goals.py [--problems 10] [--goals 64] [--family rop_dense] [--cases FOLDER]
        [--weights FOLDER]

Prints the report that is kept in benchmarks/results/many_goals.txt. Scenes of held-out problems; from the
problem's start to so many goals, drawn with the tip in the family's region, that RRT-Connect reaches with a
few thousand nodes and the straight line does not. Every method gives at most one motion to each goal, and no
other where the validator, which is not timed, refuses it.

- network: 4 samples to each goal in one call, refined where none of the 4 is free, the shortest free one.
- bumps: its control, the line and 3 random bumps to each goal, refined.
- rrt_connect: a search to each goal, and 25 attempts to shorten the path.
- rrt_connect, as long: restarts and more attempts to shorten, the shortest kept, in the network's time.
"""

import argparse
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path as File

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from report import header, print_table, progress
from searches import Arena, Candidates

from problems import PANDA, Case, draw_cases
from robotdiffuse.collision.kernels.motions import motions_free, path_length
from robotdiffuse.core.types import Path
from robotdiffuse.evaluation.methods import NETWORK_ALONE
from robotdiffuse.evaluation.runs import Clock, Fields, Method, Trial, tried
from robotdiffuse.evaluation.tables import Column
from robotdiffuse.planning.diffusion.hybrid import RobotDiffuse, unlearned_starts
from robotdiffuse.planning.search import rrt_kernel
from robotdiffuse.problems.families import FAMILIES, load_family
from robotdiffuse.problems.families.family import Family, uniform_configurations
from robotdiffuse.problems.problem import JointGoal
from robotdiffuse.trajectories.simplification import shortcut
from robotdiffuse.validation.validator import VerifySettings, verifier

EACH = 4
"""Starts of refinement for each goal."""
NODES = 2_000
"""Most of a search's trees."""
RANGE = np.float32(1.0)
SHORTCUTS = 25

Paths = list[ndarray | None]
"""One for each goal."""


def with_goals(case: Case, planner: RobotDiffuse, family: Family, count: int, place: int) -> Case | None:
    """To so many goals; None if not enough of those that were drawn are worth it."""
    arena, goals = Arena(Trial(case, place, "", 6), planner), []
    start = case.problem.start.astype(np.float32)
    for _ in range(8 * count):
        found = uniform_configurations(PANDA, family.region, arena.checker, 1, arena.rng)
        if not len(found):
            break
        goal = found[0].astype(np.float32)
        if not motions_free(arena.space, np.stack([start, goal])).all() and len(search(arena, goal)):
            goals.append(goal.astype(np.float64))
        if len(goals) == count:
            return replace(case, problem=replace(case.problem, goal=JointGoal(np.stack(goals))))
    return None


def search(arena: Arena, goal: Float[ndarray, "dof"]) -> Float[ndarray, "n dof"]:
    """Shortened; no rows if a pair of trees is full without a path."""
    trees = rrt_kernel.make_trees(arena.start, goal[None], NODES)
    path = rrt_kernel.connect(arena.space, trees, RANGE, 2 * NODES, arena.state)
    return shortcut(arena.space, path, SHORTCUTS, arena.state) if len(path) else path


def by_network(arena: Arena, _seconds: float) -> Paths:
    planner = RobotDiffuse(replace(arena.planner.settings, weights=None, samples=EACH * len(arena.goals)))
    return shortest_free(arena, arena.sampled(planner, arena.code()))


def by_bumps(arena: Arena, _seconds: float) -> Paths:
    waypoints = arena.model.settings.waypoints
    starts = [unlearned_starts(arena.start, goal, EACH, waypoints, PANDA, arena.rng) for goal in arena.goals]
    q = np.concatenate(starts).astype(np.float32)
    return shortest_free(arena, Candidates(q, np.zeros(len(q), bool)))


def shortest_free(arena: Arena, found: Candidates) -> Paths:
    """Of the candidates of each goal, which are refined where none is free."""
    q, free = found.q.copy(), found.free.copy()
    goal_of = np.linalg.norm(q[:, -1, None] - arena.goals, axis=-1).argmin(axis=1)
    again = ~np.isin(goal_of, goal_of[free])
    if again.any():
        refined = arena.refined(q[again])
        q[again], free[again] = refined.q, refined.free
    of = [q[free & (goal_of == g)] for g in range(len(arena.goals))]
    return [min(candidates, key=path_length) if len(candidates) else None for candidates in of]


def by_search(arena: Arena, _seconds: float) -> Paths:
    return [path if len(path) else None for path in (search(arena, goal) for goal in arena.goals)]


def by_long_search(arena: Arena, seconds: float) -> Paths:
    paths: Paths = []
    began = time.process_time()
    for g, goal in enumerate(arena.goals):
        best: ndarray | None = None
        while best is None or time.process_time() - began < seconds * (g + 1) / len(arena.goals):
            path = search(arena, goal)
            if not len(path):
                break
            best = path if best is None else min(path, best, key=path_length)
            best = shortcut(arena.space, best, SHORTCUTS, arena.state)
        paths.append(best)
    return paths


METHODS: dict[str, Callable[[Arena, float], Paths]] = {
    "network": by_network,
    "bumps": by_bumps,
    "rrt_connect": by_search,
    "rrt_connect, as long": by_long_search,
}
"""In the order of running; they are told the CPU time that the first one took [s]."""


def method(name: str, planner: RobotDiffuse, first_took: dict[int, float]) -> Method:
    """A record for each goal, with an equal share of the time."""

    def call(trial: Trial) -> Iterator[Fields]:
        arena, names = Arena(trial, planner), PANDA.joint_names
        validator = verifier(trial.problem, VerifySettings())
        with Clock() as clock:
            paths = METHODS[name](arena, first_took.get(trial.place, 0.1))
        first_took.setdefault(trial.place, clock.cpu)
        for g, path in enumerate(paths):
            passed = path is not None and validator.path(Path(names, arena.ends.complete(path))).valid
            about = {"name": f"{trial.case.name}#{g}", "time": clock.wall, "cpu": clock.cpu / len(paths)}
            length = {"joint_length": float(path_length(path))} if passed else {}
            yield about | length | {"status": "solved" if passed else "no_path"}

    return call


def main() -> None:
    parser = argparse.ArgumentParser(description="Many motions for one scene.")
    parser.add_argument("--problems", type=int, default=10, help="scenes (10)")
    parser.add_argument("--goals", type=int, default=64, help="of each scene (64)")
    parser.add_argument("--family", default="rop_dense", choices=list(FAMILIES), help="of scenes (rop_dense)")
    parser.add_argument("--cases", type=File, help="folder that keeps what is known of the problems")
    parser.add_argument("--weights", help="folder of a trained model; default: the bundled one")
    arguments = parser.parse_args()
    print(header("numpy", "numba", "torch"))
    print(f"weights: {arguments.weights or 'the bundled ones'}")
    planner = RobotDiffuse(replace(NETWORK_ALONE, weights=arguments.weights))
    family, count = load_family(arguments.family), arguments.goals
    drawn = enumerate(draw_cases(arguments.family, arguments.problems, arguments.cases).hard)
    found = [with_goals(case, planner, family, count, i) for i, case in progress(list(drawn), "goals")]
    cases = [case for case in found if case is not None]
    if not cases:
        print("no scene leaves so many goals; ask for fewer")
        return
    tried(cases[:1], {name: method(name, planner, {0: 0.1}) for name in METHODS}, title="compiling")
    took: dict[int, float] = {}
    records = tried(cases, {name: method(name, planner, took) for name in METHODS}, seeds=(6,))
    lengths = {name: np.array([r.joint_length or np.nan for r in of]) for name, of in records.items()}
    every = np.isfinite(np.stack(list(lengths.values()))).all(axis=0)
    rows = []
    for name, of in records.items():
        reached, seconds = np.isfinite(lengths[name]), sum(record.cpu or 0.0 for record in of)
        length = float(lengths[name][every].mean()) if every.any() else None
        rate = float(reached.sum() / seconds)
        rows.append((name, float(reached.mean()), seconds / len(cases), rate, length))
    columns = (
        "",
        Column("goals reached", "%", ".1f", "more", scale=100.0),
        Column("CPU ms a scene", "", ".0f", scale=1000.0),
        Column("goals per s", "", ".0f", "more"),
        Column("length, rad*", "", ".3f", "less"),
    )
    title = f"{arguments.goals} goals in one scene, {len(cases)} scenes of {arguments.family}"
    print_table(title, columns, rows, ["* of the motions to goals that all methods reach"])
    print(f"most goals per second: {max(rows, key=lambda row: row[3])[0]}")


if __name__ == "__main__":
    main()
