"""An arm's weights against what needs none: is its network worth shipping?

    python benchmarks/arm_weights.py [--robot ur5e] [--weights FOLDER] [--problems 40] [--families shelf ...]

Prints a report that is kept in benchmarks/results/weights_ROBOT.txt. FOLDER as `train planner --robot` leaves
it; without, the weights at hand. The control is smooth noise, which the planner `robotdiffuse` has in place
of a network: the noise of the diffusion model in closed form, after 40 guidance steps. Problems are held out
by their seed, in the size of the arm; the straight line does not solve them, and a second of search does.

(a) single samples and best of a batch of 16, by the validator, with the CPU time of a batch; then the share of
    problems that batches alone solve within so much CPU time, drawn until one sample is free;
(b) the whole planner with either, the same seed and time limits in turns: length over that of search alone.
"""

import argparse
import time
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from numpy import ndarray
from report import header, print_table, progress

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.collision.kernels.motions import motions_free
from robotdiffuse.collision.motions import search_space
from robotdiffuse.core.errors import InputError
from robotdiffuse.core.types import Path
from robotdiffuse.planning import load_planner
from robotdiffuse.planning.diffusion.hybrid import WAYPOINTS, RobotDiffuse, RobotDiffuseSettings
from robotdiffuse.planning.diffusion.smooth_noise import smooth_noise
from robotdiffuse.planning.learned import nearest_goals
from robotdiffuse.planning.start_goal import StartGoal
from robotdiffuse.problems.families.scaled import family_for
from robotdiffuse.problems.problem import JointGoal, Problem
from robotdiffuse.robots import load_robot
from robotdiffuse.robots.robot import Robot
from robotdiffuse.validation.validator import verifier

FAMILIES = ("shelf", "crate", "table", "clutter", "kitchen")
SEED = 2026
"""Of the problems; no data set is made with it."""
RESOLUTION = 0.02
SOLVABLE = 1.0
"""Time in which search solves a problem, or it is left out [s]."""
MARKS = (0.025, 0.05, 0.1, 0.2)
"""CPU times of batches alone [s]."""
LIMITS = (0.1, 1.0)
"""Of the whole planner [s]."""
WARM = 3
"""Problems that each method sees before it is timed."""

Batch = Callable[[], ndarray]
"""Draws 16 trajectories."""


class Tried(NamedTuple):
    """Batches of one method on one problem."""

    free: ndarray
    """Which samples of the first batch pass the validator."""
    cpu: float
    """Of the first batch [s]."""
    solved_at: float
    """CPU time after which a batch had a free sample [s]; infinite if not within the last mark."""


def problems(robot: Robot, family: str, count: int) -> Iterator[Problem]:
    """Held-out ones that are neither trivial nor, for a second of search, unsolvable."""
    of, number, found, search = family_for(family, robot), 0, 0, load_planner("aorrtc")
    while found < count:
        problem = of.draw(robot, np.random.default_rng([SEED, number])).problem(robot)
        number += 1
        assert isinstance(problem.goal, JointGoal)
        space = search_space(CollisionChecker(robot, problem.scene), RESOLUTION)
        goals = problem.goal.positions.astype(np.float32)
        lines = (np.stack([problem.start.astype(np.float32), goal]) for goal in goals)
        if any(motions_free(space, line).all() for line in lines):
            continue
        if search.plan(problem, SOLVABLE, until="first").solved:
            found += 1
            yield problem


def batches(learned: RobotDiffuse, problem: Problem, seed: int) -> dict[str, Batch]:
    """Either method on a problem; what is done once, as the cloud's code, is in the first batch."""
    robot, rng = problem.robot, np.random.default_rng(seed)
    assert isinstance(problem.goal, JointGoal)
    checker = CollisionChecker(robot, problem.scene)
    start_goal = StartGoal(checker, problem.start, problem.goal.positions)
    start, goals = start_goal.rows()
    model, count, codes = learned.model(robot), learned.settings.samples, list[ndarray | None]()
    assert model is not None

    def network() -> ndarray:
        if not codes:
            codes.append(learned.code(model, checker, rng))
        return learned.draw(model, checker, codes[0], start, goals, rng)

    def noise() -> ndarray:
        near = nearest_goals(start, goals, count)
        return learned.refine(checker, smooth_noise(start, near, count, WAYPOINTS, robot, rng))

    def complete(draw: Batch) -> Batch:
        return lambda: np.array([start_goal.complete(q) for q in draw()])

    return {"network": complete(network), "smooth noise": complete(noise)}


def tried(problem: Problem, draw: Batch) -> Tried:
    validator, names = verifier(problem), problem.robot.joint_names
    first, cpu, spent, solved = None, 0.0, 0.0, np.inf
    while spent < MARKS[-1] and not np.isfinite(solved):
        began = time.process_time()
        q = draw()
        spent += time.process_time() - began
        free = np.array([validator.path(Path(names, path)).valid for path in q])
        if first is None:
            first, cpu = free, spent
        if free.any():
            solved = spent
    assert first is not None
    return Tried(first, cpu, solved)


def alone(learned: RobotDiffuse, every: dict[str, list[Problem]]) -> None:
    rows = []
    for family, drawn in every.items():
        of: dict[str, list[Tried]] = {}
        for i, problem in enumerate(progress(drawn, family)):
            for name, draw in batches(learned, problem, i).items():
                if i == 0:
                    for _ in range(WARM):
                        draw()
                of.setdefault(name, []).append(tried(problem, draw))
        for name, found in of.items():
            solved = [f"{np.mean([t.solved_at <= mark for t in found]):.0%}" for mark in MARKS]
            rows.append(
                [
                    family,
                    name,
                    f"{np.mean([t.free for t in found]):.1%}",
                    f"{np.mean([t.free.any() for t in found]):.0%}",
                    f"{1e3 * np.median([t.cpu for t in found]):.0f}",
                    *solved,
                ]
            )
    marks = (f"in {1e3 * mark:.0f} ms" for mark in MARKS)
    columns = ("family", "batches of", "single", "best of 16", "batch, CPU ms", *marks)
    print_table("(a) batches alone; in N ms: problems solved in so much CPU time", columns, rows)


def whole(learned: RobotDiffuse, every: dict[str, list[Problem]]) -> None:
    unlearned, search = RobotDiffuse(), load_planner("aorrtc")
    unlearned.network_name = "none"  # no weights have that name, so it has smooth noise
    planners = {"search": search, "smooth noise": unlearned, "network": learned}
    rows = []
    for family, drawn in every.items():
        for planner in planners.values():
            planner.warm_up(drawn[0])
            for problem in drawn[:WARM]:
                planner.plan(problem, LIMITS[-1], until="time_limit")
        for limit in LIMITS:
            lengths = {name: np.full(len(drawn), np.inf) for name in planners}
            by_batch = dict.fromkeys(planners, 0)
            for i, problem in enumerate(progress(drawn, f"{family}, {limit} s")):
                turn = list(planners)[i % 3 :] + list(planners)[: i % 3]
                for name in turn:
                    result = planners[name].plan(problem, limit, seed=i, until="time_limit")
                    if result.path is not None:
                        lengths[name][i] = result.path.length
                        by_batch[name] += result.stage in ("network", "refinement", "smooth_noise")
            all_solved = np.all([np.isfinite(of) for of in lengths.values()], axis=0)
            for name in ("smooth noise", "network"):
                ratios = (lengths[name] / lengths["search"])[all_solved]
                half = 1.96 * ratios.std(ddof=1) / np.sqrt(len(ratios))
                solved = f"{np.isfinite(lengths[name]).sum()} of {len(drawn)}"
                figures = [f"{ratios.mean():.4f} ± {half:.4f}", f"{by_batch[name]}"]
                rows.append([family, f"{1e3 * limit:.0f}", name, solved, *figures])
    columns = ("family", "limit, ms", "batches of", "solved", "length over search's", "by batches")
    print_table("(b) the whole planner; by batches: answers that come from them", columns, rows)


def main() -> None:
    parser = argparse.ArgumentParser(description="An arm's weights against smooth noise.")
    parser.add_argument("--robot", default="panda", help="(panda)")
    parser.add_argument("--weights", metavar="FOLDER", help="of a trained model; default: those at hand")
    parser.add_argument("--problems", type=int, default=40, help="of each family (40)")
    parser.add_argument("--families", nargs="+", default=list(FAMILIES), help=" ".join(FAMILIES))
    parser.add_argument("--parts", default="a,b", help="of the report (a,b)")
    arguments = parser.parse_args()
    robot = load_robot(arguments.robot)
    learned = RobotDiffuse(RobotDiffuseSettings(weights=arguments.weights))
    if learned.model(robot) is None:
        raise InputError(f"there are no weights for {robot.name}; name a folder with --weights")
    learned.wanted = True
    print(header("numpy", "numba", "torch"))
    print(f"{robot.name}, weights: {arguments.weights or 'those at hand'}")
    every = {name: [*problems(robot, name, arguments.problems)] for name in arguments.families}
    for part, show in (("a", alone), ("b", whole)):
        if part in arguments.parts.split(","):
            show(learned, every)


if __name__ == "__main__":
    main()
