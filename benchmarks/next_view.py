"""Where to look next: a second view by `next_view`, from a random pose, and from the opposite side.

    python benchmarks/next_view.py [--problems 210] [--records next_view.jsonl]
    python benchmarks/next_view.py --report --records next_view.jsonl

Problems, cameras and limits are those of `unseen.py`. From what one view shows a motion is planned; with a
second view it is planned anew, and validated in the true scene. Random poses are of those that `next_view`
chooses among; the opposite pose is that of the first camera, half a turn about the base.
"""

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import unknown
from report import header, print_table, progress

from robotdiffuse.core.output_files import JsonLines
from robotdiffuse.core.results import PlanResult
from robotdiffuse.evaluation.statistics import compare
from robotdiffuse.perception.depth_view import DepthView
from robotdiffuse.perception.ray_caster import ray_cast
from robotdiffuse.planning import context
from robotdiffuse.planning.context import PlanRequest
from robotdiffuse.planning.next_view import next_view, poses_around
from robotdiffuse.planning.pipeline.unknown_space import plan_with_unknown_space
from robotdiffuse.problems.families import FAMILIES
from robotdiffuse.problems.problem import PREDICTED, Problem
from robotdiffuse.scenes.scene import Scene

SECOND = ("next_view", "random", "opposite")
UNSURE = 0.9
"""Stated confidence of the motion of one view below which another view is most wanted."""


def run(records: str, count: int) -> None:
    context.time = unknown.CpuClock  # type: ignore[attr-defined]
    kept = JsonLines(Path(records))
    done = {(row["family"], row["number"]) for row in kept.rows}
    for family in FAMILIES:
        known = {number for of, number in done if of == family}
        some = list(unknown.problems(family, count // len(FAMILIES), known))
        for number, problem in progress(some, family):
            if (family, number) not in done:
                kept.append({"family": family, "number": number, **_tried(problem, family, number)})


def _tried(problem: Problem, family: str, number: int) -> dict[str, Any]:
    [view] = unknown.views(problem, family, number, 1, False)
    one = _planned(problem, view)
    row = {"one": unknown.is_free(problem, one[1]), "confidence": one[1].confidence}
    if one[1].path is None:
        return row
    rng = np.random.default_rng([unknown.SEED, number, 15])
    poses = poses_around()
    chosen = {
        "next_view": next_view(*one, poses).T_base_camera,
        "random": poses[rng.integers(len(poses))],
        "opposite": np.diag([-1.0, -1.0, 1.0, 1.0]) @ view.T_base_camera,
    }
    for name, T in chosen.items():
        second = ray_cast(problem.scene, T, view.intrinsics, unknown.SIZE, problem.robot, problem.start)
        result = _planned(problem, view, second)[1]
        row |= {name: unknown.is_free(problem, result), f"{name} confidence": result.confidence or 0.0}
    return row


def _planned(problem: Problem, *views: DepthView) -> tuple[Problem, PlanResult]:
    known = Scene(problem.scene.shapes[:1])
    partial = Problem(problem.robot, known, problem.start, problem.goal, views=views, unknown=PREDICTED)
    return partial, plan_with_unknown_space(unknown.PLANNER, partial, PlanRequest(unknown.LIMIT))


def report(rows: list[dict[str, Any]]) -> None:
    """Shares that are free in truth, of all motions and of those that one view leaves unsure."""
    rows = [row for row in rows if SECOND[0] in row]
    for title, some in (
        ("All", rows),
        (f"Stated confidence of one view below {UNSURE}", [r for r in rows if r["confidence"] < UNSURE]),
    ):
        if not some:
            continue
        lines = [("one view", len(some), _share(some, "one"), _share(some, "confidence"))]
        lines += [(n, len(some), _share(some, n), _share(some, f"{n} confidence")) for n in SECOND]
        print_table(title, ["second view", "problems", "free in truth, %", "stated, %"], lines)
        for other in SECOND[1:]:
            a, b = (np.array([1.0 if r[name] else np.nan for r in some]) for name in (SECOND[0], other))
            pair = compare(a, b)
            print(
                f"{SECOND[0]} alone free {pair.a_only}, {other} alone {pair.b_only}, p = {pair.p_success:.2g}"
            )
        print()


def _share(rows: list[dict[str, Any]], name: str) -> str:
    return f"{100 * np.mean([row[name] for row in rows]):.1f}"


def main() -> None:
    parser = argparse.ArgumentParser(description="A second view by next_view beside others.")
    parser.add_argument("--problems", type=int, default=210, help="(210)")
    parser.add_argument("--records", default="next_view.jsonl", help="(next_view.jsonl)")
    parser.add_argument("--report", action="store_true")
    arguments = parser.parse_args()
    if arguments.report:
        print(header("numba", "numpy", "torch"))
        report(JsonLines(Path(arguments.records)).rows)
    else:
        run(arguments.records, arguments.problems)


if __name__ == "__main__":
    main()
