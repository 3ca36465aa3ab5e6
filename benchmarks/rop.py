"""RobotDiffuse on held-out ROP problems: the network alone, refinement and its control, the whole planner.

    python benchmarks/rop.py [--problems 500] [--weights FOLDER]

Prints the report that is kept in benchmarks/results/rop.txt. Fresh problems are drawn until there are enough
that the straight line does not solve and ten seconds of search do; the trivial ones drawn on the way count
for the share of all problems. Everything that is called solved passed the judge; motions of the whole planner
are confirmed by PyBullet on meshes, every 0.01 rad.
"""

import argparse
import time
from typing import NamedTuple

import numpy as np
from report import header, print_table
from rich.progress import track

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.planners import rrt_connect_kernel as kernel
from robotdiffuse.planners.robotdiffuse import (
    Candidates,
    RobotDiffuse,
    RobotDiffuseSettings,
    encode,
    unlearned_starts,
)
from robotdiffuse.planners.rrt_connect import RRTConnect, random_state, search_space
from robotdiffuse.problem import JointGoal, Problem
from robotdiffuse.robots import load_robot
from robotdiffuse.rop_problems import sample_problem
from robotdiffuse.scenes.rop import ROP
from robotdiffuse.simulation.oracle import PyBulletOracle
from robotdiffuse.types import Path
from robotdiffuse.verify import VerifySettings, verifier

SEED = 20261121
"""Training data are drawn from other seed sequences."""
RUNS = 16
"""RRT-Connect runs whose shortest path is the reference length."""
SEARCH_TIME = 10.0


class Case(NamedTuple):
    problem: Problem
    trivial: bool
    reference: float
    """Length of the shortest of sixteen RRT-Connect runs with shortcutting [rad]; of the line if trivial."""


class Outcome(NamedTuple):
    solved: bool
    length: float
    seconds: float


def draw_cases(count: int) -> tuple[list[Case], int]:
    """Solvable problems, `count` non-trivial ones among them, and how many unsolved ones were left out."""
    robot, cases, unsolved, index, hard = load_robot("panda"), [], 0, 0, 0
    while hard < count:
        problem = sample_problem(robot, ROP, np.random.default_rng([SEED, index]))
        index += 1
        ends = np.stack([problem.start, goal_of(problem)])
        if verifier(problem, VerifySettings()).path(Path(robot.joint_names, ends)).valid:
            cases.append(Case(problem, True, float(np.linalg.norm(ends[1] - ends[0]))))
            continue
        if not RRTConnect().plan(problem, SEARCH_TIME, seed=1).solved:
            unsolved += 1
            continue
        cases.append(Case(problem, False, best_of_runs(problem)))
        hard += 1
        if hard % 50 == 0:
            print(f"drawn {hard} of {count}", flush=True)
    return cases, unsolved


def best_of_runs(problem: Problem) -> float:
    """Length of the shortest of some runs of RRT-Connect with shortcutting [rad]."""
    space = search_space(CollisionChecker(problem.robot, problem.scene), 0.02)
    start, goals = problem.start.astype(np.float32), goal_of(problem)[None].astype(np.float32)
    lengths, state = [], random_state(SEED)
    while len(lengths) < RUNS:
        trees = kernel.make_trees(start, goals, 20_000)
        path = kernel.search(space, trees, np.float32(1.5), 1_000_000, state)
        if len(path):
            lengths.append(float(kernel.path_length(kernel.shortcut(space, path, 120, state))))
    return min(lengths)


def goal_of(problem: Problem) -> np.ndarray:
    assert isinstance(problem.goal, JointGoal)
    return problem.goal.positions[0]


def judged(problem: Problem, q: np.ndarray) -> np.ndarray:
    """Which trajectories, taken frame by frame as they are, pass the judge."""
    judge, start, goal = verifier(problem, VerifySettings()), problem.start, goal_of(problem)
    verdicts = []
    for frames in q.astype(np.float64):
        frames[0], frames[-1] = start, goal
        verdicts.append(judge.path(Path(problem.robot.joint_names, frames)).valid)
    return np.array(verdicts)


def network_alone(planner: RobotDiffuse, cases: list[Case], title: str) -> list[str]:
    """One batch of sixteen per problem, straight from the sampler: no refinement, no search, no shortcuts."""
    single, best, lengths, seconds = [], [], [], []
    model = planner.model(cases[0].problem.robot)
    assert model is not None
    for i, case in enumerate(track(cases, title, transient=True)):
        rng, checker = (
            np.random.default_rng([SEED, 1, i]),
            CollisionChecker(case.problem.robot, case.problem.scene),
        )
        began = time.perf_counter()
        code = encode(model, checker, planner.settings.points, rng)
        q = planner.sample(model, checker, code, case.problem.start, goal_of(case.problem)[None], rng).q
        seconds.append(time.perf_counter() - began)
        passed = judged(case.problem, q)
        single.append(passed.mean())
        best.append(passed.any())
        if passed.any():
            lengths.append(min(kernel.path_length(path) for path in q[passed]) / case.reference)
    return [title, f"{np.mean(single):.1%}", f"{np.mean(best):.1%}", f"{np.mean(lengths):.3f}", ms(seconds)]


def refined(planner: RobotDiffuse, case: Case, index: int, learned: bool, starts: int) -> Outcome:
    """Refinement of sampled or of unlearned trajectories, then shortcuts and the judge; no search."""
    problem, robot = case.problem, case.problem.robot
    rng, checker = np.random.default_rng([SEED, 2, index]), CollisionChecker(robot, problem.scene)
    model = planner.model(robot)
    assert model is not None
    began = time.perf_counter()
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
    paths = sorted(found.q[found.free], key=kernel.path_length)[: planner.settings.shortened]
    paths = [kernel.shortcut(space, path, planner.settings.shortcuts, state) for path in paths]
    for path in sorted(paths, key=kernel.path_length):
        if judged(problem, path[None])[0]:
            return Outcome(True, float(kernel.path_length(path)), time.perf_counter() - began)
    return Outcome(False, np.nan, time.perf_counter() - began)


def summary(title: str, cases: list[Case], outcomes: list[Outcome]) -> list[str]:
    ratios = [o.length / c.reference for o, c in zip(outcomes, cases, strict=True) if o.solved]
    solved = np.mean([outcome.solved for outcome in outcomes])
    return [title, f"{solved:.1%}", f"{np.mean(ratios):.3f}", ms([o.seconds for o in outcomes])]


def ms(seconds: list[float]) -> str:
    return f"{1e3 * np.median(seconds):.1f} / {1e3 * np.percentile(seconds, 95):.1f}"


def main() -> None:
    parser = argparse.ArgumentParser(description="RobotDiffuse on held-out ROP problems.")
    parser.add_argument("--problems", type=int, default=500, help="non-trivial ones (500)")
    parser.add_argument("--weights", help="folder of a trained model; default: the bundled one")
    arguments = parser.parse_args()
    print(header("numpy", "numba", "torch"))
    cases, unsolved = draw_cases(arguments.problems)
    hard, trivial = [c for c in cases if not c.trivial], [c for c in cases if c.trivial]
    drawn = len(cases) + unsolved
    print(
        f"{drawn} problems drawn: {len(trivial)} solved by the straight line ({len(trivial) / drawn:.1%}), "
        f"{len(hard)} not trivial, {unsolved} that {SEARCH_TIME:.0f} s of search do not solve (left out)"
    )
    planner = RobotDiffuse(RobotDiffuseSettings(weights=arguments.weights))
    RobotDiffuse(RobotDiffuseSettings(weights=arguments.weights)).plan(hard[0].problem)  # compiles

    rows = [network_alone(planner, hard, "non-trivial")]
    rows.append(network_alone(planner, cases, "all solvable, trivial ones included"))
    unguided = RobotDiffuse(RobotDiffuseSettings(weights=arguments.weights, guidance_steps=0))
    rows.append(network_alone(unguided, hard, "non-trivial, without guidance"))
    columns = ["(a) network alone, 16 samples", "single", "best of 16", "length*", "ms median / p95"]
    print_table("", columns, rows)

    control = []
    for learned, starts, title in (
        (True, 16, "from the network's 16 samples"),
        (False, 16, "control: line and 15 random bumps"),
        (False, 64, "control: line and 63 random bumps"),
    ):
        numbered = track(list(enumerate(hard)), title, transient=True)
        outcomes = [refined(planner, case, i, learned, starts) for i, case in numbered]
        control.append(summary(title, hard, outcomes))
    print_table("", ["(b) refinement, shortcuts, judge", "solved", "length*", "ms median / p95"], control)

    outcomes, stages, refuted = [], [], 0
    for i, case in enumerate(track(hard, "whole planner", transient=True)):
        result = planner.plan(case.problem, time_limit=5.0, seed=i)
        length = np.nan if result.path_length is None else result.path_length
        outcomes.append(Outcome(result.solved, length, result.planning_time))
        stages.append(result.stage)
        if result.path is not None and result.trajectory is not None:
            moved = Path(result.trajectory.joint_names, result.trajectory.positions)
            with PyBulletOracle(case.problem.robot, case.problem.scene) as oracle:
                refuted += any(oracle.check_path(path) is not None for path in (result.path, moved))
    print_table(
        "",
        ["(c) whole planner", "solved", "length*", "ms median / p95"],
        [summary("robotdiffuse", hard, outcomes)],
    )
    print(
        "solved by "
        + ", ".join(f"{stage} {stages.count(stage) / len(stages):.1%}" for stage in sorted(set(stages)))
    )
    print(f"motions that PyBullet finds in collision: {refuted} of {sum(o.solved for o in outcomes)}")
    print(
        f"* joint-space length against the shortest of {RUNS} RRT-Connect runs with shortcuts, mean of ratios"
    )


if __name__ == "__main__":
    main()
