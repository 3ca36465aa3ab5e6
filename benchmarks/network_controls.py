"""How motions of the network differ from those of search.

    python benchmarks/network_controls.py [--families rop,shelf] [--problems 60] [--cases FOLDER]

Prints the last table of benchmarks/results/network_controls.txt. It compares the collision-free ones of 16
samples of `diffusion` with 16 first paths of `aorrtc`, with different seeds. All motions are resampled to the
same number of waypoints, evenly spaced in arc length. Problems are held out; the straight line does not solve
them, and ten seconds of search do.

apart: the root mean square distance of two motions in joint space, at equal fractions of their lengths, as
the mean over all pairs. classes: number of different ways to pass the obstacles; the tip passes each obstacle
on one of four sides (left, right, above, below, as seen along the line from the tip's start to its end). The
other columns are the smoothness of the motion that each planner returns.
"""

import argparse
from collections.abc import Iterator, Sequence
from itertools import combinations
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from common import (
    FIRST,
    draw_hard_cases,
    header,
    parse,
    parts_of,
    print_table,
    use_processor_time,
)
from robotdiffuse.collision import CollisionChecker
from robotdiffuse.core.tables import Figure
from robotdiffuse.evaluation.runs import (
    Fields,
    Method,
    Record,
    Run,
    fields_of,
    from_network,
    run_all,
    validated,
)
from robotdiffuse.planning.diffusion import Diffusion, DiffusionSettings
from robotdiffuse.planning.search.rrt import AORRTC
from robotdiffuse.problems.families import FAMILIES
from robotdiffuse.problems.files import Case
from robotdiffuse.problems.problem import Problem
from robotdiffuse.robots import load_robot
from robotdiffuse.scenes.shapes import Box, Cylinder, Sphere

PANDA = load_robot("panda")
PLANNER_LIMIT = 20.0
"""Time limit of calls; both planners end earlier by themselves [s]."""
MOTIONS = 16
WAYPOINTS = 48
SMOOTHNESS = ("turning", "jerk", "duration")
"""Metrics of the motions that both planners return."""


COLUMNS = ("paths", "apart", "classes", *SMOOTHNESS)
"""Figures in the table of diversity."""


def even(path: Float[ndarray, "n dof"]) -> Float[ndarray, "waypoints dof"]:
    """The path at WAYPOINTS places even in arc length."""
    lengths = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    places = np.linspace(0.0, lengths[-1], WAYPOINTS)
    return np.stack([np.interp(places, lengths, column) for column in path.T], axis=1)


def sides(problem: Problem, path: Float[ndarray, "waypoints dof"]) -> tuple[int, ...]:
    """The side on which the tip passes each obstacle: 0 left, 1 right, 2 above, 3 below."""
    tip = problem.robot.fk(path)[:, :3, 3]
    along = tip[-1] - tip[0]
    along = along / max(float(np.linalg.norm(along)), 1e-9)
    left = np.cross([0.0, 0.0, 1.0], along)
    left = left / np.linalg.norm(left) if np.linalg.norm(left) > 1e-6 else np.array([0.0, 1.0, 0.0])
    axes = np.stack([left, np.cross(along, left)])
    passed = []
    for shape in problem.scene.shapes:
        if shape.name != "floor" and isinstance(shape, Sphere | Box | Cylinder):
            center = shape.center
            away = axes @ (tip[np.linalg.norm(tip - center, axis=1).argmin()] - center)
            axis = int(np.abs(away).argmax())
            passed.append(2 * axis + int(away[axis] < 0))
    return tuple(passed)


def spread(problem: Problem, paths: Sequence[ndarray]) -> Fields:
    """How much motions of one problem differ."""
    resampled = [even(path) for path in paths]
    apart = [float(np.sqrt(((a - b) ** 2).sum(1).mean())) for a, b in combinations(resampled, 2)]
    classes = float(len({sides(problem, q) for q in resampled}))
    measures: Fields = {"paths": float(len(resampled)), "classes": classes}
    return measures | ({"apart": float(np.mean(apart))} if apart else {})


def of_network(planner: Diffusion) -> Method:
    """The free samples of a batch, and the motion that the planner returns."""
    draw = from_network(planner)

    def call(run: Run) -> Iterator[Fields]:
        q = draw(run, CollisionChecker(PANDA, run.problem.scene))
        free = list(q[validated(run.problem, q).passed])
        result = planner.plan(run.problem, run.limit, seed=run.index)
        yield fields_of(result, PANDA) | spread(run.problem, free)

    return call


def of_search(planner: AORRTC) -> Method:
    """First paths with different seeds, and the motion that the planner returns."""

    def call(run: Run) -> Iterator[Fields]:
        results = [
            planner.plan(run.problem, run.limit, seed=1000 * run.index + k, until=FIRST)
            for k in range(MOTIONS)
        ]
        result = planner.plan(run.problem, run.limit, seed=run.index)
        paths = [r.path.positions for r in results if r.path is not None]
        yield fields_of(result, PANDA) | spread(run.problem, paths)

    return call


def report_diversity(cases_of: dict[str, list[Case]]) -> None:
    """Print how motions of `diffusion` and of search differ among themselves, and how smooth they are."""
    network = Diffusion(DiffusionSettings(samples=MOTIONS))
    search = AORRTC()
    for planner in (network, search):
        planner.warm_up(next(iter(cases_of.values()))[0].problem)
    methods = {"diffusion": of_network(network), "aorrtc": of_search(search)}
    rows = []
    for family, cases in cases_of.items():
        records_of = run_all(cases, methods, limit=PLANNER_LIMIT, title=f"{family}, diversity")
        # only problems on which both planners have several motions
        common = [
            i
            for i in range(len(cases))
            if all("apart" in records[i].measures for records in records_of.values())
        ]
        for name, records in records_of.items():
            compared = [records[i] for i in common]
            rows.append((family, name, len(compared), *(_mean(compared, key) for key in COLUMNS)))
    print_table(
        f"Diversity of {MOTIONS} motions and smoothness of the returned one, means over problems",
        ["family", "planner", "problems", *(key.replace("_", " ") for key in COLUMNS)],
        rows,
    )


def _mean(records: Sequence[Record], key: str) -> Figure | None:
    values = np.array([r.measures[key] for r in records if key in r.measures])
    if len(values) < 2:
        return None
    half = 1.96 * values.std(ddof=1) / len(values) ** 0.5
    return Figure(f"{values.mean():.2f} ± {half:.2f}", float(values.mean()))


def main() -> None:
    parser = argparse.ArgumentParser(description="How motions of the network differ from those of search.")
    parser.add_argument("--families", default="rop,rop_dense,shelf,crate,table", help="families of problems")
    parser.add_argument("--problems", type=int, default=60, help="number of problems of each family (60)")
    parser.add_argument("--cases", type=Path, help="folder that caches which problems are drawn")
    arguments = parse(parser, families="rop", problems=2)
    families = parts_of(arguments.families, FAMILIES)
    use_processor_time()
    print(header("numpy", "numba", "onnxruntime"))
    cases_of = {name: draw_hard_cases(name, arguments.problems, arguments.cases) for name in families}
    report_diversity(cases_of)


if __name__ == "__main__":
    main()
