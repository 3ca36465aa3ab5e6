"""The network alone, refinement and its control, the whole planner: on held-out problems of each family.

    python benchmarks/network.py [--families rop,shelf] [--problems 500] [--cases FOLDER] [--weights FOLDER]

Prints the report that is kept in benchmarks/results/network.txt; FOLDER as in problems.py. Problems are not
trivial (the straight line does not solve them) and ten seconds of search do solve them. Everything that is
called solved passed the judge; motions of the whole planner are confirmed by PyBullet on meshes.
"""

import argparse
import time
from dataclasses import replace
from pathlib import Path as File
from typing import NamedTuple

import numpy as np
from report import header, print_table, progress, share

from problems import PANDA, RUNS, SEARCH_TIME, SEED, Case, Drawn, draw_cases, families_of, goal_of, judged
from robotdiffuse.collision import CollisionChecker
from robotdiffuse.collision.kernels.compiled import random_state
from robotdiffuse.collision.kernels.motions import path_length
from robotdiffuse.collision.motion import search_space
from robotdiffuse.evaluation.trials import NETWORK_ALONE, Draw, from_network, without_network
from robotdiffuse.paths.shortcut import shortcut
from robotdiffuse.planners.robotdiffuse import (
    Candidates,
    RobotDiffuse,
    RobotDiffuseSettings,
    encode,
    unlearned_starts,
)
from robotdiffuse.problems.families import FAMILIES
from robotdiffuse.problems.problem import Problem
from robotdiffuse.simulation.oracle import PyBulletOracle
from robotdiffuse.types import Path


class Outcome(NamedTuple):
    solved: bool
    length: float
    """[rad]"""
    seconds: float
    """CPU time."""


def tried(draw: Draw, cases: list[Case], title: str) -> list[str]:
    """One batch of trajectories per problem, as they are."""
    single, best, lengths, seconds = [], [], [], []
    for i, case in enumerate(progress(cases, title)):
        rng = np.random.default_rng([SEED, 1, i])
        checker = CollisionChecker(case.problem.robot, case.problem.scene)
        began = time.process_time()
        q = draw(checker, case.problem, rng)
        seconds.append(time.process_time() - began)
        passed = judged(case.problem, q)
        single.append(passed.mean())
        best.append(passed.any())
        if passed.any():
            lengths.append(min(path_length(path) for path in q[passed]) / case.reference)
    shares = [f"{100 * np.mean(single):.1f} ± {100 * half_width(single):.1f} %", share(best)]
    return [title, *shares, f"{np.mean(lengths):.3f}" if lengths else "", ms(seconds)]


def refined(planner: RobotDiffuse, case: Case, index: int, learned: bool, starts: int) -> Outcome:
    """Refinement of sampled or of unlearned trajectories, then shortcuts and the judge; no search."""
    problem, robot = case.problem, case.problem.robot
    rng, checker = np.random.default_rng([SEED, 2, index]), CollisionChecker(robot, problem.scene)
    model = planner.model(robot)
    assert model is not None
    began = time.process_time()
    if learned:
        code = encode(model, checker, planner.settings.points, rng)
        found = planner.sample(model, checker, code, problem.start, goal_of(problem)[None], rng)
        if not found.free.any():
            found = planner.refine(checker, found.q)
    else:
        q = unlearned_starts(problem.start, goal_of(problem), starts, model.config.frames, robot, rng)
        found = planner.refine(checker, q)
    return shortest(planner, problem, checker, found, began)


def shortest(
    planner: RobotDiffuse, problem: Problem, checker: CollisionChecker, found: Candidates, began: float
) -> Outcome:
    space, state = search_space(checker, planner.settings.resolution), random_state(SEED)
    paths = sorted(found.q[found.free], key=path_length)[: planner.settings.shortened]
    paths = [shortcut(space, path, planner.settings.shortcuts, state) for path in paths]
    for path in sorted(paths, key=path_length):
        if judged(problem, path[None])[0]:
            return Outcome(True, float(path_length(path)), time.process_time() - began)
    return Outcome(False, np.nan, time.process_time() - began)


def whole(planner: RobotDiffuse, case: Case, seed: int) -> tuple[Outcome, str, bool]:
    """Outcome, stage that solved it, and whether PyBullet finds a collision."""
    began = time.process_time()
    result = planner.plan(case.problem, time_limit=5.0, seed=seed)
    seconds = time.process_time() - began
    if result.path is None or result.trajectory is None or result.path_length is None:
        return Outcome(False, np.nan, seconds), "nothing", False
    moved = Path(result.trajectory.joint_names, result.trajectory.positions)
    with PyBulletOracle(case.problem.robot, case.problem.scene) as oracle:
        refuted = any(oracle.check_path(path) is not None for path in (result.path, moved))
    return Outcome(True, result.path_length, seconds), result.stage or "", refuted


def summary(title: str, cases: list[Case], outcomes: list[Outcome]) -> list[str]:
    ratios = [o.length / c.reference for o, c in zip(outcomes, cases, strict=True) if o.solved]
    length = f"{np.mean(ratios):.3f}" if ratios else ""
    return [title, share([outcome.solved for outcome in outcomes]), length, ms([o.seconds for o in outcomes])]


def half_width(values: list[float]) -> float:
    """Half of the 95 % interval of a mean."""
    return 1.96 * float(np.std(values)) / np.sqrt(len(values))


def ms(seconds: list[float]) -> str:
    return f"{1e3 * np.median(seconds):.1f} / {1e3 * np.percentile(seconds, 95):.1f}"


def report(family: str, drawn: Drawn, weights: str | None) -> None:
    hard, count = drawn.hard, len(drawn.cases) + drawn.unsolved
    trivial = len(drawn.cases) - len(hard)
    print(
        f"\n== {family}: {count} problems drawn: {trivial} solved by the straight line "
        f"({trivial / count:.1%}), {len(hard)} not trivial, {drawn.unsolved} that {SEARCH_TIME:.0f} s of "
        "search do not solve (left out)",
        flush=True,
    )
    planner = RobotDiffuse(replace(NETWORK_ALONE, weights=weights))
    whole_planner = RobotDiffuse(RobotDiffuseSettings(weights=weights))
    unguided = RobotDiffuse(replace(NETWORK_ALONE, weights=weights, guidance_steps=0))
    model = planner.model(PANDA)
    assert model is not None
    frames = model.config.frames
    rows = [
        tried(from_network(planner.settings), hard, "guided"),
        tried(from_network(unguided.settings), hard, "without guidance"),
        tried(without_network(planner.settings, frames), hard, "control: guidance of line and bumps"),
    ]
    if trivial:
        rows.append(tried(from_network(planner.settings), drawn.cases, "guided, trivial ones too"))
    print_table(
        "", ["(a) network alone, 16 samples", "single", "best of 16", "length*", "CPU ms median / p95"], rows
    )
    control = []
    for learned, starts, title in (
        (True, 16, "from the network's 16 samples"),
        (False, 16, "control: line and 15 random bumps"),
        (False, 64, "control: line and 63 random bumps"),
    ):
        numbered = progress(list(enumerate(hard)), title)
        outcomes = [refined(planner, case, i, learned, starts) for i, case in numbered]
        control.append(summary(title, hard, outcomes))
    print_table("", ["(b) refinement, shortcuts, judge", "solved", "length*", "CPU ms median / p95"], control)

    numbered = progress(list(enumerate(hard)), "whole planner")
    outcomes, stages, refuted = zip(*(whole(whole_planner, case, i) for i, case in numbered), strict=True)
    rows = [summary("robotdiffuse", hard, list(outcomes))]
    print_table("", ["(c) whole planner", "solved", "length*", "CPU ms median / p95"], rows)
    parts = [f"{stage} {stages.count(stage) / len(stages):.1%}" for stage in sorted(set(stages))]
    print("solved by " + ", ".join(parts))
    print(f"motions that PyBullet finds in collision: {sum(refuted)} of {sum(o.solved for o in outcomes)}")


def main() -> None:
    parser = argparse.ArgumentParser(description="RobotDiffuse on held-out problems.")
    parser.add_argument("--families", type=families_of, default=list(FAMILIES), help="all of them")
    parser.add_argument("--problems", type=int, default=500, help="non-trivial ones of each family (500)")
    parser.add_argument("--cases", type=File, help="folder that keeps what is known of the problems")
    parser.add_argument("--weights", help="folder of a trained model; default: the bundled one")
    arguments = parser.parse_args()
    print(header("numpy", "numba", "torch"))
    print(f"weights: {arguments.weights or 'the bundled ones'}")
    warm = draw_cases("rop", 1).hard[0].problem
    RobotDiffuse(RobotDiffuseSettings(weights=arguments.weights)).plan(warm)  # compiles
    for family in arguments.families:
        report(family, draw_cases(family, arguments.problems, arguments.cases), arguments.weights)
    print(
        f"\n* joint-space length against the shortest of {RUNS + 1} RRT-Connect runs with shortcuts, mean of "
        "ratios\nShares with 95 % intervals; times are CPU time, as the machine may do other work."
    )


if __name__ == "__main__":
    main()
