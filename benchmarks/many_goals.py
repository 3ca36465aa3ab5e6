"""Many motions for one scene: goals reached per second of CPU time, by the network, its control and search.

    python benchmarks/many_goals.py [--problems 10] [--goals 64] [--family rop_dense] [--cases FOLDER]
        [--weights FOLDER]

Prints the report that is kept in benchmarks/results/many_goals.txt. Scenes of held-out problems; from the
problem's start to so many goals, drawn with the tip in the family's region, that RRT-Connect reaches with a
few thousand nodes and the straight line does not. Every method gives at most one motion to each goal, and no
other where the judge, which is not timed, refuses it.

- network: 4 samples to each goal in one call, refined where none of the 4 is free, the shortest free one.
- bumps: its control, the line and 3 random bumps to each goal, refined.
- rrt_connect: a search to each goal, and 25 attempts to shorten the path.
- rrt_connect, as long: restarts and more attempts to shorten, the shortest kept, in the network's time.
"""

import argparse
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path as File
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from report import header, print_table, progress

from problems import PANDA, SEED, draw_cases
from robotdiffuse.collision import CollisionChecker
from robotdiffuse.collision.kernels.compiled import random_state
from robotdiffuse.collision.kernels.motions import Space, motions_free, path_length
from robotdiffuse.collision.motion import search_space
from robotdiffuse.evaluation.trials import NETWORK_ALONE
from robotdiffuse.paths.shortcut import shortcut
from robotdiffuse.planners.robotdiffuse import RobotDiffuse, encode, unlearned_starts
from robotdiffuse.planners.rrt_connect import kernel
from robotdiffuse.problems.families import FAMILIES, Family, load_family
from robotdiffuse.problems.families.family import uniform_configurations
from robotdiffuse.problems.problem import JointGoal, Problem
from robotdiffuse.types import Path
from robotdiffuse.verify import VerifySettings, verifier

EACH = 4
"""Starts of refinement for each goal."""
NODES = 2_000
"""Most of a search's trees."""
REACH = np.float32(1.0)
SHORTCUTS = 25


class Scene(NamedTuple):
    problem: Problem
    checker: CollisionChecker
    space: Space
    start: Float[ndarray, "dof"]
    goals: Float[ndarray, "k dof"]
    rng: np.random.Generator
    state: ndarray


Paths = list[ndarray | None]
"""One for each goal."""


def prepare(problem: Problem, family: Family, count: int, resolution: float, seed: int) -> Scene | None:
    """With goals; None if not enough of those that were drawn are worth it."""
    checker, rng = CollisionChecker(PANDA, problem.scene), np.random.default_rng([SEED, 6, seed])
    space, state = search_space(checker, resolution), random_state(SEED, seed)
    start, goals = problem.start.astype(np.float32), []
    for _ in range(8 * count):
        found = uniform_configurations(PANDA, family.region, checker, 1, rng)
        if not len(found):
            break
        goal = found[0].astype(np.float32)
        if motions_free(space, np.stack([start, goal])).all():
            continue
        if len(search(space, start, goal, state)):
            goals.append(goal)
        if len(goals) == count:
            whole = Problem(PANDA, problem.scene, problem.start, JointGoal(np.stack(goals)))
            return Scene(whole, checker, space, start, np.stack(goals), rng, state)
    return None


def search(space: Space, start: ndarray, goal: ndarray, state: ndarray) -> Float[ndarray, "n dof"]:
    """No rows if a pair of trees is full without a path."""
    return kernel.search(space, kernel.make_trees(start, goal[None], NODES), REACH, 2 * NODES, state)


def by_network(planner: RobotDiffuse, scene: Scene, _seconds: float) -> Paths:
    model = planner.model(PANDA)
    assert model is not None
    count = EACH * len(scene.goals)
    batch = RobotDiffuse(replace(planner.settings, weights=None, samples=count))
    code = encode(model, scene.checker, planner.settings.points, scene.rng)
    found = batch.sample(model, scene.checker, code, scene.start, scene.goals, scene.rng)
    return shortest_free(planner, scene, found.q, found.free)


def by_bumps(planner: RobotDiffuse, scene: Scene, _seconds: float) -> Paths:
    model = planner.model(PANDA)
    assert model is not None
    starts = [
        unlearned_starts(scene.start, goal, EACH, model.config.frames, PANDA, scene.rng)
        for goal in scene.goals
    ]
    q = np.concatenate(starts).astype(np.float32)
    return shortest_free(planner, scene, q, np.zeros(len(q), bool))


def shortest_free(planner: RobotDiffuse, scene: Scene, q: ndarray, free: ndarray) -> Paths:
    """Of the candidates of each goal, which are refined where none is free."""
    goal_of = np.linalg.norm(q[:, -1, None] - scene.goals, axis=-1).argmin(axis=1)
    reached = np.zeros(len(scene.goals), bool)
    reached[goal_of[free]] = True
    again = ~reached[goal_of]
    if again.any():
        refined = planner.refine(scene.checker, q[again])
        q, free = q.copy(), free.copy()
        q[again], free[again] = refined.q, refined.free
    paths: Paths = []
    for g in range(len(scene.goals)):
        candidates = q[free & (goal_of == g)]
        paths.append(min(candidates, key=path_length) if len(candidates) else None)
    return paths


def by_search(_planner: RobotDiffuse, scene: Scene, _seconds: float) -> Paths:
    paths: Paths = []
    for goal in scene.goals:
        path = search(scene.space, scene.start, goal, scene.state)
        paths.append(shortcut(scene.space, path, SHORTCUTS, scene.state) if len(path) else None)
    return paths


def by_long_search(_planner: RobotDiffuse, scene: Scene, seconds: float) -> Paths:
    paths: Paths = []
    began = time.process_time()
    for g, goal in enumerate(scene.goals):
        best: ndarray | None = None
        while best is None or time.process_time() - began < seconds * (g + 1) / len(scene.goals):
            path = search(scene.space, scene.start, goal, scene.state)
            if not len(path):
                break
            path = shortcut(scene.space, path, SHORTCUTS, scene.state)
            if best is None or path_length(path) < path_length(best):
                best = path
            best = shortcut(scene.space, best, SHORTCUTS, scene.state)
        paths.append(best)
    return paths


METHODS: dict[str, Callable[[RobotDiffuse, Scene, float], Paths]] = {
    "network": by_network,
    "bumps": by_bumps,
    "rrt_connect": by_search,
    "rrt_connect, as long": by_long_search,
}
"""In the order of running; they are told the CPU time that the first one took [s]."""


def passes(scene: Scene, path: ndarray | None) -> bool:
    if path is None:
        return False
    full = path.astype(np.float64)
    full[0] = scene.problem.start
    return verifier(scene.problem, VerifySettings()).path(Path(PANDA.joint_names, full)).valid


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
    family = load_family(arguments.family)
    cases = draw_cases(arguments.family, arguments.problems, arguments.cases).hard
    resolution = planner.settings.resolution
    scenes = [
        scene
        for i, case in enumerate(progress(cases, "goals"))
        if (scene := prepare(case.problem, family, arguments.goals, resolution, i)) is not None
    ]
    if not scenes:
        print("no scene leaves so many goals; ask for fewer")
        return
    for method in METHODS.values():
        method(planner, scenes[0], 0.1)  # compiles
    lengths = {name: np.full((len(scenes), arguments.goals), np.nan) for name in METHODS}
    seconds = dict.fromkeys(METHODS, 0.0)
    for i, scene in enumerate(progress(scenes, "methods")):
        spent = 0.0
        for name, method in METHODS.items():
            began = time.process_time()
            paths = method(planner, scene, spent)
            took = time.process_time() - began
            seconds[name] += took
            spent = spent or took
            for g, path in enumerate(paths):
                if path is not None and passes(scene, path):
                    lengths[name][i, g] = path_length(path)
    every = np.isfinite(np.stack(list(lengths.values()))).all(axis=0)
    rows = []
    for name, found in lengths.items():
        reached = np.isfinite(found)
        rows.append(
            [
                name,
                f"{100 * reached.mean():.1f} %",
                f"{1e3 * seconds[name] / len(scenes):.0f}",
                f"{reached.sum() / seconds[name]:.0f}",
                f"{found[every].mean():.3f}" if every.any() else "",
            ]
        )
    columns = ["", "goals reached", "CPU ms a scene", "goals per s", "length, rad*"]
    print_table(
        f"{arguments.goals} goals in one scene, {len(scenes)} scenes of {arguments.family}", columns, rows
    )
    print("* of the motions to goals that all methods reach")
    best = max(METHODS, key=lambda name: np.isfinite(lengths[name]).sum() / seconds[name])
    print(f"most goals per second: {best}")


if __name__ == "__main__":
    main()
