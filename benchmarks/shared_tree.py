"""Shared-Tree Informed RRT* against OMPL's anytime planners, many goals against one, and the safety distance.

    python benchmarks/shared_tree.py [--problems 300]          needs the extra `baselines` (ompl)

Prints the report that is kept in benchmarks/results/shared_tree.txt, and draws shared_tree.png beside it:
cost over time, and clearance with and without the safety distance. Times are CPU time of one core for all
planners, as the machine may have other work. OMPL checks states and motions by our kernel, one call each.
"""

import argparse
import time
from itertools import pairwise
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from ompl import base as ob
from ompl import geometric as og
from ompl import util as ou
from report import header, print_table
from rich.progress import track
from scipy.stats import wilcoxon

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.collision.kernels import lanes
from robotdiffuse.collision.kernels.compiled import random_state
from robotdiffuse.collision.kernels.motions import Space, motions_free
from robotdiffuse.collision.motion import search_space
from robotdiffuse.generation.settings import GenerationSettings
from robotdiffuse.generation.shard_maker import draw as draw_problem
from robotdiffuse.planners.shared_tree.planner import SharedTreeSearch, SharedTreeSettings
from robotdiffuse.problems.families.rop import ROP
from robotdiffuse.problems.problem import JointGoal
from robotdiffuse.robots import load_robot

SEED = 20261121
PANDA = load_robot("panda")
RESOLUTION = 0.05
MARKS = (0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0)
"""CPU times at which costs are read [s]."""
TOUCHING = SharedTreeSettings(safety_distance=0.0, improvement=0.0, resolution=RESOLUTION)
"""As OMPL's planners: no safety distance, no end but time."""
OMPL = ("AORRTC", "InformedRRTstar")
OMPL_TIME = 1.0
Problem = tuple[CollisionChecker, np.ndarray, np.ndarray]


def one_goal(count: int) -> list[Problem]:
    """ROP problems that the straight line does not solve and one second of our search does."""
    found: list[Problem] = []
    index = 0
    while len(found) < count:
        problem = ROP.draw(PANDA, np.random.default_rng([SEED, index])).problem(PANDA)
        index += 1
        assert isinstance(problem.goal, JointGoal)
        checker = CollisionChecker(PANDA, problem.scene)
        ends = np.concatenate([problem.start[None], problem.goal.positions]).astype(np.float32)
        if motions_free(search_space(checker, RESOLUTION), ends)[0]:
            continue
        search = SharedTreeSearch(checker, ends[0], ends[1:], TOUCHING, random_state(SEED, index))
        run(search, OMPL_TIME, stop_at_first=True)
        if np.isfinite(search.cost):
            found.append((checker, ends[0], ends[1:]))
    return found


def many_goals(count: int) -> list[Problem]:
    """Problems of the data factory, half of them dense, where the line to the nearest goal is not free."""
    settings = GenerationSettings(mix={"rop": 1.0, "rop_dense": 1.0})
    found: list[Problem] = []
    index = 0
    while len(found) < count:
        drawn = draw_problem(settings, PANDA, np.random.default_rng([SEED, 1, index]))[1]
        index += 1
        checker = CollisionChecker(PANDA, drawn.scene)
        nearest = np.linalg.norm(drawn.goals - drawn.start, axis=1).argmin()
        line = np.stack([drawn.start, drawn.goals[nearest]])
        if (
            len(drawn.goals) == settings.goals
            and not motions_free(search_space(checker, RESOLUTION), line).all()
        ):
            found.append((checker, drawn.start, drawn.goals))
    return found


def run(search: SharedTreeSearch, seconds: float, stop_at_first: bool = False) -> None:
    until = time.process_time() + seconds
    search.run(lambda: time.process_time() >= until or (stop_at_first and search.cost < np.inf))


class Validity(ob.StateValidityChecker):
    def __init__(self, information: ob.SpaceInformation, space: Space) -> None:
        super().__init__(information)
        self.space, self.q = space, np.empty((1, PANDA.dof), np.float32)

    def isValid(self, state: ob.State) -> bool:
        for j in range(PANDA.dof):
            self.q[0, j] = state[j]
        return bool(lanes.free_many(self.space.robot, self.space.scene, self.q, self.space.padding)[0])


class Motions(ob.MotionValidator):
    def __init__(self, information: ob.SpaceInformation, space: Space) -> None:
        super().__init__(information)
        self.space, self.q = space, np.empty((2, PANDA.dof), np.float32)

    def checkMotion(self, a: ob.State, b: ob.State) -> bool:
        for j in range(PANDA.dof):
            self.q[0, j], self.q[1, j] = a[j], b[j]
        return bool(motions_free(self.space, self.q)[0])


def ompl_cost(name: str, problem: Problem, seconds: float) -> float:
    """The length of the path that an OMPL planner with its default settings ends with [rad]."""
    checker, start, goals = problem
    states, bounds = ob.RealVectorStateSpace(PANDA.dof), ob.RealVectorBounds(PANDA.dof)
    for j in range(PANDA.dof):
        bounds.setLow(j, float(PANDA.lower[j]))
        bounds.setHigh(j, float(PANDA.upper[j]))
    states.setBounds(bounds)
    information = ob.SpaceInformation(states)
    space = search_space(checker, RESOLUTION)
    validity, motions = Validity(information, space), Motions(information, space)
    information.setStateValidityChecker(validity)
    information.setMotionValidator(motions)
    information.setup()
    definition = ob.ProblemDefinition(information)
    ends = [information.allocState() for _ in range(2)]
    for state, q in zip(ends, (start, goals[0]), strict=True):
        for j in range(PANDA.dof):
            state[j] = float(q[j])
    definition.setStartAndGoalStates(*ends)
    definition.setOptimizationObjective(ob.PathLengthOptimizationObjective(information))
    planner = getattr(og, name)(information)
    planner.setProblemDefinition(definition)
    planner.setup()
    until = time.process_time() + seconds
    planner.solve(ob.PlannerTerminationCondition(lambda: time.process_time() >= until))
    path = definition.getSolutionPath()
    return float(path.length()) if path and definition.hasExactSolution() else np.inf


def optimality(count: int) -> dict[str, np.ndarray]:
    """Costs of all planners over the best of OMPL's; ours at all marks."""
    problems = one_goal(count)
    ours = np.full((count, len(MARKS)), np.inf)
    theirs = {name: np.full(count, np.inf) for name in OMPL}
    for i, problem in enumerate(track(problems, "one goal", transient=True)):
        search = SharedTreeSearch(*problem, TOUCHING, random_state(SEED, i))
        spent = 0.0
        for m, mark in enumerate(MARKS):
            began = time.process_time()
            run(search, mark - spent)
            spent += time.process_time() - began
            ours[i, m] = search.cost
        for name in OMPL:
            theirs[name][i] = ompl_cost(name, problem, OMPL_TIME)
    best = np.min(list(theirs.values()), axis=0)
    rows = [[f"OMPL {name}", f"{1e3 * OMPL_TIME:.0f}", *ratio(costs, best)] for name, costs in theirs.items()]
    rows += [["shared tree", f"{1e3 * mark:.0f}", *ratio(ours[:, m], best)] for m, mark in enumerate(MARKS)]
    columns = ["cost over the best of OMPL's", "ms", "solved", "mean", "median", "95th percentile"]
    print_table(f"One goal, {count} ROP problems that the straight line does not solve", columns, rows)
    return {"ours": ours / best[:, None]} | {name: costs / best for name, costs in theirs.items()}


def ratio(costs: np.ndarray, best: np.ndarray) -> list[str]:
    solved = np.isfinite(costs)
    shares = (costs / best)[solved & np.isfinite(best)]
    figures = (shares.mean(), np.median(shares), np.percentile(shares, 95))
    return [f"{solved.sum()}", *(f"{value:.4f}" for value in figures)]


def sharing(count: int) -> None:
    """One shared search against the best of ten single ones that share its time equally."""
    problems, rows = many_goals(count), []
    for seconds in (0.02, 0.05, 0.1):
        shared, single = np.full(count, np.inf), np.full(count, np.inf)
        for i, (checker, start, goals) in enumerate(track(problems, "many goals", transient=True)):
            search = SharedTreeSearch(checker, start, goals, TOUCHING, random_state(SEED, i))
            run(search, seconds)
            shared[i] = search.cost
            for g, goal in enumerate(goals):
                alone = SharedTreeSearch(
                    checker, start, goal[None], TOUCHING, random_state(SEED, i * 100 + g)
                )
                run(alone, seconds / len(goals))
                single[i] = min(single[i], alone.cost)
        both = np.isfinite(shared) & np.isfinite(single)
        difference = shared[both] / single[both] - 1
        half = 1.96 * difference.std(ddof=1) / np.sqrt(both.sum())
        worse = wilcoxon(shared[both], single[both], alternative="greater").pvalue
        better = wilcoxon(shared[both], single[both], alternative="less").pvalue
        rows.append(
            [
                f"{1e3 * seconds:.0f} ms",
                f"{np.isfinite(shared).sum()} / {np.isfinite(single).sum()}",
                f"{100 * difference.mean():+.2f} ± {half * 100:.2f} %",
                f"{(difference > 0.01).sum()} / {(difference < -0.01).sum()}",
                f"{worse:.2g} / {better:.2g}",
            ]
        )
    columns = ["time in all", "solved", "cost", "> 1 % worse / better", "p that worse / that better"]
    print_table(
        f"Ten goals, {count} problems: the shared tree against the best of ten searches with a tenth each",
        columns,
        rows,
    )


def safety(count: int) -> dict[float, np.ndarray]:
    """Least clearance of the motions, with and without the safety distance [m]."""
    problems = one_goal(count)
    clearances: dict[float, np.ndarray] = {}
    rows = []
    for distance in (0.0, 0.05):
        settings = SharedTreeSettings(safety_distance=distance, resolution=0.02)
        found, ends, lengths = [], [], []
        for i, (checker, start, goals) in enumerate(track(problems, f"{distance} m", transient=True)):
            search = SharedTreeSearch(checker, start, goals, settings, random_state(SEED, i))
            run(search, 1.0)
            path = search.path()
            if path is None:
                continue
            steps = [
                a + np.linspace(0, 1, 40, dtype=np.float32)[:, None] * (b - a) for a, b in pairwise(path)
            ]
            found.append(checker.link_clearances(np.concatenate(steps)).min())
            ends.append(checker.link_clearances(path[[0, -1]]).min())
            lengths.append(search.cost)
        clearance, end = np.array(found), np.array(ends)
        clearances[distance] = clearance
        asked = np.minimum(0.05, end) - 0.002
        rows.append(
            [
                f"{100 * distance:.0f} cm",
                f"{len(clearance)}",
                f"{100 * np.median(clearance):.1f}",
                f"{100 * np.mean(clearance[end >= 0.05] >= 0.048):.1f} %",
                f"{100 * np.mean(clearance >= asked):.1f} %",
                f"{np.mean(lengths):.3f}",
            ]
        )
    columns = ["safety distance", "motions", "median clearance, cm", "kept*", "kept**", "mean length"]
    print_table("Node security defence", columns, rows)
    print("*  5 cm all along, where both ends have 5 cm; ** no closer than 5 cm or the closer end; to 2 mm")
    return clearances


def draw(costs: dict[str, np.ndarray], clearances: dict[float, np.ndarray], file: Path) -> None:
    figure = Figure(figsize=(11, 4.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    for axes in (left, right):
        axes.spines[["top", "right"]].set_visible(False)
    times = 1e3 * np.array(MARKS)
    ours = costs["ours"]
    left.fill_between(times, *np.percentile(ours, (10, 90), axis=0), color="#1b6ca8", alpha=0.15, lw=0)
    left.plot(times, ours.mean(axis=0), "o-", color="#1b6ca8", label="shared tree, mean and 10 to 90 %")
    for name, color in zip(OMPL, ("#d1495b", "#8d6a9f"), strict=True):
        mean = costs[name][np.isfinite(costs[name])].mean()
        left.plot(1e3 * OMPL_TIME, mean, "s", color=color, ms=8, label=f"OMPL {name}, 1 s")
    left.axhline(1.0, color="#999999", lw=0.8)
    left.set(xscale="log", xlabel="CPU time, ms", ylabel="cost over the best of OMPL's after 1 s")
    left.set_title("Cost falls with time")
    left.legend(frameon=False)
    bins = np.arange(-0.5, 15.1, 0.5)
    for distance, color in ((0.0, "#c9a227"), (0.05, "#1b6ca8")):
        label = "without" if distance == 0 else "with 5 cm of safety distance"
        right.hist(100 * clearances[distance], bins, color=color, alpha=0.6, label=label)
    right.axvline(5.0, color="#333333", lw=1, ls="--")
    right.set(xlabel="least distance to obstacles along the motion, cm", ylabel="motions")
    right.set_title("Node security defence")
    right.legend(frameon=False)
    figure.savefig(file, dpi=130)


def main() -> None:
    parser = argparse.ArgumentParser(description="Optimality, many goals, safety distance.")
    parser.add_argument("--problems", type=int, default=300, help="problems of each part (300)")
    count = parser.parse_args().problems
    ou.setLogLevel(ou.LogLevel.LOG_NONE)
    print(header("numpy", "numba", "ompl"))
    warm = SharedTreeSearch(*one_goal(1)[0], TOUCHING, random_state(0))
    run(warm, 0.1)
    costs = optimality(count)
    sharing(count)
    clearances = safety(count)
    draw(costs, clearances, Path(__file__).parent / "results" / "shared_tree.png")


if __name__ == "__main__":
    main()
