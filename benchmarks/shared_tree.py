"""Shared-Tree Informed RRT* against OMPL's anytime planners, many goals against one, and the safety distance.

    python benchmarks/shared_tree.py [--problems 300]          needs the extra `baselines` (ompl)

Prints the report that is kept in benchmarks/results/shared_tree.txt, and draws shared_tree.png beside it:
cost over time, and clearance with and without the safety distance. Planners take turns on each problem, each
with a second of wall time, OMPL's over our kernel; searches of the shared tree alone are read in CPU time.
"""

import argparse
import time
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from report import header, print_table
from scipy.stats import wilcoxon

from problems import PANDA, SEED, Case, goal_of
from robotdiffuse.collision import CollisionChecker
from robotdiffuse.collision.kernels.compiled import random_state
from robotdiffuse.collision.kernels.motions import motions_free
from robotdiffuse.collision.motions import search_space
from robotdiffuse.evaluation.methods import planned
from robotdiffuse.evaluation.runs import Fields, Method, Trial, tried
from robotdiffuse.evaluation.tables import Column
from robotdiffuse.generation.settings import GenerationSettings
from robotdiffuse.generation.shard_maker import draw as draw_problem
from robotdiffuse.planning import load_planner
from robotdiffuse.planning.search.shared_tree.planner import SharedTreeSearch, SharedTreeSettings
from robotdiffuse.problems.families.rop import ROP
from robotdiffuse.problems.problem import JointGoal, Problem

RESOLUTION = 0.05
MARKS = (0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0)
"""CPU times at which costs are read [s]."""
TOUCHING = SharedTreeSettings(safety_distance=0.0, improvement=0.0, resolution=RESOLUTION)
"""As OMPL's planners: no safety distance, no end but time."""
OMPL = {"OMPL AORRTC": "ompl_aorrtc", "OMPL Informed RRT*": "ompl_informed_rrt_star"}
SHARES = (0.02, 0.05, 0.1)
"""Times of ten goals together [s]."""


def search_of(problem: Problem, settings: SharedTreeSettings, *seed: int) -> SharedTreeSearch:
    assert isinstance(problem.goal, JointGoal)
    ends = problem.start.astype(np.float32), problem.goal.positions.astype(np.float32)
    checker = CollisionChecker(PANDA, problem.scene)
    return SharedTreeSearch(checker, *ends, settings, random_state(SEED, *seed))


def run(search: SharedTreeSearch, seconds: float, stop_at_first: bool = False) -> None:
    until = time.process_time() + seconds
    search.run(lambda: time.process_time() >= until or (stop_at_first and search.cost < np.inf))


def costs(marks: tuple[float, ...], settings: SharedTreeSettings = TOUCHING) -> Method:
    """What the search has after each CPU time [s]."""

    def call(trial: Trial) -> Iterator[Fields]:
        search, spent = search_of(trial.problem, settings, trial.place), 0.0
        for mark in marks:
            began = time.process_time()
            run(search, mark - spent)
            spent += time.process_time() - began
            yield answer(search.cost) | {"time_limit": mark, "time": spent, "cpu": spent}

    return call


def answer(cost: float) -> Fields:
    return {"status": "solved", "joint_length": cost} if cost < np.inf else {"status": "no_path"}


def best_of_singles(seconds: float) -> Method:
    """Searches to each goal alone, which share the time."""

    def call(trial: Trial) -> Iterator[Fields]:
        assert isinstance(trial.problem.goal, JointGoal)
        best, goals = np.inf, trial.problem.goal.positions
        for g, goal in enumerate(goals):
            problem = Problem(PANDA, trial.problem.scene, trial.problem.start, JointGoal(goal[None]))
            search = search_of(problem, TOUCHING, trial.place * 100 + g)
            run(search, seconds / len(goals))
            best = min(best, search.cost)
        yield answer(best) | {"time": seconds}

    return call


def clearance(settings: SharedTreeSettings) -> Method:
    """Least clearance to the obstacles along the path, and of its closer end [m]."""

    def call(trial: Trial) -> Iterator[Fields]:
        search = search_of(trial.problem, settings, trial.place)
        checker = CollisionChecker(PANDA, trial.problem.scene)
        run(search, 1.0)
        path, found = search.path(), answer(search.cost) | {"time": 1.0}
        if path is not None:
            shares = np.linspace(0, 1, 40, dtype=np.float32)[:, None]
            along = np.concatenate([a + shares * (b - a) for a, b in pairwise(path)])
            found["least"] = float(checker.link_clearances(along).min())
            found["end"] = float(checker.link_clearances(path[[0, -1]]).min())
        yield found

    return call


def one_goal(count: int) -> list[Case]:
    """ROP problems that the straight line does not solve and one second of our search does."""
    found: list[Case] = []
    index = 0
    while len(found) < count:
        problem = ROP.draw(PANDA, np.random.default_rng([SEED, index])).problem(PANDA)
        index += 1
        space = search_space(CollisionChecker(PANDA, problem.scene), RESOLUTION)
        if motions_free(space, np.stack([problem.start, goal_of(problem)]).astype(np.float32))[0]:
            continue
        search = search_of(problem, TOUCHING, index)
        run(search, MARKS[-1], stop_at_first=True)
        if np.isfinite(search.cost):
            found.append(Case(f"rop/{index}", "rop", problem, False))
    return found


def many_goals(count: int) -> list[Case]:
    """Problems of the data factory, half of them dense, where the line to the nearest goal is not free."""
    settings = GenerationSettings(mix={"rop": 1.0, "rop_dense": 1.0})
    found: list[Case] = []
    index = 0
    while len(found) < count:
        drawn = draw_problem(settings, PANDA, np.random.default_rng([SEED, 1, index]))[1]
        index += 1
        space = search_space(CollisionChecker(PANDA, drawn.scene), RESOLUTION)
        nearest = np.linalg.norm(drawn.goals - drawn.start, axis=1).argmin()
        line = np.stack([drawn.start, drawn.goals[nearest]])
        if len(drawn.goals) == settings.goals and not motions_free(space, line).all():
            problem = Problem(PANDA, drawn.scene, drawn.start.astype(np.float64), JointGoal(drawn.goals))
            found.append(Case(f"{index}", "rop", problem, False))
    return found


def optimality(cases: list[Case]) -> dict[str, np.ndarray]:
    """Costs over the best of OMPL's; ours at all marks."""
    methods = {title: planned(load_planner(name)) for title, name in OMPL.items()}
    found = tried(cases, methods | {"shared tree": costs(MARKS)}, limit=MARKS[-1], title="one goal")
    of = {
        (name, mark): np.array([r.joint_length or np.inf for r in found[name] if r.time_limit == mark])
        for name, marks in ((*((title, MARKS[-1:]) for title in OMPL), ("shared tree", MARKS)))
        for mark in marks
    }
    best = np.min([of[title, MARKS[-1]] for title in OMPL], axis=0)
    rows = []
    for (name, mark), lengths in of.items():
        ratios = (lengths / best)[np.isfinite(lengths) & np.isfinite(best)]
        figures = float(ratios.mean()), *np.percentile(ratios, (50, 95)).tolist()
        rows.append((name, f"{1e3 * mark:.0f}", int(np.isfinite(lengths).sum()), *figures))
    names = (Column(name, "", ".4f") for name in ("mean", "median", "95th percentile"))
    title = f"One goal, {len(cases)} ROP problems that the straight line does not solve"
    print_table(title, ["cost over the best of OMPL's", "ms", "solved", *names], rows)
    ours = np.stack([of["shared tree", mark] / best for mark in MARKS], axis=1)
    return {"ours": ours} | {title: of[title, MARKS[-1]] / best for title in OMPL}


def sharing(cases: list[Case]) -> None:
    """One shared search against the best of ten single ones that share its time equally."""
    methods: dict[str, Method] = {}
    for seconds in SHARES:
        methods |= {f"shared {seconds}": costs((seconds,)), f"single {seconds}": best_of_singles(seconds)}
    found, rows = tried(cases, methods, title="many goals"), []
    for seconds in SHARES:
        shared, single = (
            np.array([record.joint_length or np.inf for record in found[f"{name} {seconds}"]])
            for name in ("shared", "single")
        )
        both = np.isfinite(shared) & np.isfinite(single)
        difference = shared[both] / single[both] - 1
        half = 1.96 * difference.std(ddof=1) / np.sqrt(both.sum())
        worse, better = (
            float(wilcoxon(shared[both], single[both], alternative=how)[1])  # pyright: ignore
            for how in ("greater", "less")
        )
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
    title = f"Ten goals, {len(cases)} problems: shared tree against the best of ten searches, a tenth each"
    print_table(title, columns, rows)


def safety(cases: list[Case]) -> dict[float, np.ndarray]:
    """Least clearance of the motions, with and without the safety distance [m]."""
    of = {d: SharedTreeSettings(safety_distance=d, resolution=0.02) for d in (0.0, 0.05)}
    methods = {f"{100 * d:.0f} cm": clearance(settings) for d, settings in of.items()}
    clearances, rows = {}, []
    for (name, records), distance in zip(tried(cases, methods, title="safety").items(), of, strict=True):
        done = [record.measures for record in records if record.solved]
        least, end, length = (np.array([m[what] for m in done]) for what in ("least", "end", "joint_length"))
        clearances[distance] = least
        rows.append(
            [
                name,
                f"{len(done)}",
                f"{100 * np.median(least):.1f}",
                f"{100 * np.mean(least[end >= 0.05] >= 0.048):.1f} %",
                f"{100 * np.mean(least >= np.minimum(0.05, end) - 0.002):.1f} %",
                f"{length.mean():.3f}",
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
    times, ours = 1e3 * np.array(MARKS), costs["ours"]
    left.fill_between(times, *np.percentile(ours, (10, 90), axis=0), color="#1b6ca8", alpha=0.15, lw=0)
    left.plot(times, ours.mean(axis=0), "o-", color="#1b6ca8", label="shared tree, mean and 10 to 90 %")
    for name, color in zip(OMPL, ("#d1495b", "#8d6a9f"), strict=True):
        mean = costs[name][np.isfinite(costs[name])].mean()
        left.plot(1e3 * MARKS[-1], mean, "s", color=color, ms=8, label=f"{name}, 1 s")
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
    results = Path(__file__).parent / "results"
    parser.add_argument("--plot", type=Path, default=results / "shared_tree.png", help="where the plot goes")
    arguments = parser.parse_args()
    print(header("numpy", "numba", "ompl"))
    cases = one_goal(arguments.problems)
    tried(cases[:1], {"": costs((0.1,)), "ompl": planned(load_planner("ompl_aorrtc"))}, limit=0.1)  # compiles
    ratios = optimality(cases)
    sharing(many_goals(arguments.problems))
    draw(ratios, safety(cases), arguments.plot)


if __name__ == "__main__":
    main()
