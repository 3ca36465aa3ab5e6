"""What the camera does not see: motions planned on depth views, validated in the true scene.

    python benchmarks/unseen.py [--problems 300] [--views 1] [--noise] [--records unknown.jsonl]
    python benchmarks/unseen.py --weights FOLDER ... --families shelf clutter
    python benchmarks/unseen.py --report [--odd] --records unknown.jsonl
    python benchmarks/unseen.py --fit --records unknown.jsonl
    python benchmarks/unseen.py --times

Problems are held-out ones of the families that the straight line does not solve and a search in the true
scene does. Cameras stand where a person would place them, 1.4 to 1.8 m away, in front more often than behind;
the floor is known, all else is seen. Every method plans with AORRTC, but for the one that is said to plan
with the hybrid, and the same CPU time. A motion is free if the validator finds path and timed motion valid in
the true scene. What was tried is kept in a file of records and not tried again; `--report` prints the tables
that are kept in benchmarks/results/unseen.txt, and `--fit` the constants of perception/confidence.py, from
the calibration half: problems with even numbers. Settings were chosen on them, too; `--odd` leaves them out
of the report. `--weights` adds the chain 'predicted' with other weights of the completing network, folders of
`train completion`, as methods that are named by the folder: those of a training that left families out are
tried on these families. `--times` prints what the network takes of a core.
"""

import argparse
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from report import header, print_table, progress

from robotdiffuse.core.output_files import JsonLines
from robotdiffuse.core.results import PlanResult
from robotdiffuse.evaluation.statistics import compare, wilson_interval
from robotdiffuse.learning.checkpoint import load_completion
from robotdiffuse.learning.completion import bundled, predict
from robotdiffuse.learning.completion.network import CompletionNetwork
from robotdiffuse.learning.completion.samples import CameraPlaces, pack, true_voxels
from robotdiffuse.perception.confidence import MIN_RISK, confidence
from robotdiffuse.perception.depth_view import DepthView
from robotdiffuse.perception.observed_volume import observe
from robotdiffuse.perception.ray_caster import DepthNoise, ray_cast
from robotdiffuse.planning import context, load_planner
from robotdiffuse.planning.context import PlanRequest
from robotdiffuse.planning.pipeline.unknown_space import plan_with_unknown_space
from robotdiffuse.problems.families import FAMILIES
from robotdiffuse.problems.held_out import SEED, held_out_problem, line_length
from robotdiffuse.problems.problem import PREDICTED, Problem
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.validation.validator import verify, verify_trajectory

LIMIT = 1.0
"""CPU time of every method on every problem [s]."""
SEARCH = 1.0
"""CPU time of the search that says whether a problem can be solved in the true scene [s]."""
CAMERAS = CameraPlaces(distance=(1.4, 1.8), height=(0.5, 1.4), target_spread=0.1, roll=0.0)
SIZE = (640, 480)
HYBRID = "hybrid"
"""As predicted, with `robotdiffuse` in place of AORRTC: its network is told of predicted obstacles as of seen
ones."""
METHODS = {
    "as seen": "optimistic",
    "occupied": "occupied",
    "padded": "padded",
    "predicted": PREDICTED,
    HYBRID: PREDICTED,
}
TRUE = "true voxels"
"""As predicted, with the voxels of 2 cm that obstacles fill in truth."""
BY = "predicted by "
"""As predicted, by the weights of the folder of this name."""
CALLS, WARM = 140, 7
"""That the network is timed by, and further ones before."""
PLANNER, HYBRID_PLANNER = load_planner("aorrtc"), load_planner("robotdiffuse")
Row = dict[str, Any]


class CpuClock:
    """Time limits are of CPU time here: a machine that others share gives every method the same."""

    perf_counter = staticmethod(time.process_time)


def problems(family: str, count: int, known: set[int]) -> Iterator[tuple[int, Problem]]:
    """Held-out problems that are neither trivial nor unsolved in the true scene, with their numbers; up to
    the greatest that is `known` to be so, these are all."""
    number = 0
    while count:
        if number in known or (number > max(known, default=-1) and _hard(held_out_problem(family, number))):
            yield number, held_out_problem(family, number)
            count -= 1
        number += 1


def _hard(problem: Problem) -> bool:
    trivial = line_length(problem, lambda of, path: verify(of, path).valid) is not None
    return not trivial and PLANNER.plan(problem, time_limit=SEARCH, until="first").solved


def views(problem: Problem, family: str, number: int, count: int, noisy: bool) -> list[DepthView]:
    """What cameras see of the problem's scene, with the arm at its start."""
    rng = np.random.default_rng([SEED, list(FAMILIES).index(family), number, 14])
    taken = []
    for _ in range(count):
        T, angle = CAMERAS.draw(problem.scene, rng)
        focal = SIZE[1] / 2 / np.tan(angle / 2)
        intrinsics = (focal, focal, (SIZE[0] - 1) / 2, (SIZE[1] - 1) / 2)
        view = ray_cast(problem.scene, T, intrinsics, SIZE, problem.robot, problem.start)
        taken.append(DepthNoise().applied(view, rng) if noisy else view)
    return taken


def tried(problem: Problem, partial: Problem, method: str, network: CompletionNetwork | None = None) -> Row:
    """What a method makes of what was seen, validated in the true scene.

    `network`: that predicts in place of the bundled one.
    """
    voxels = true_voxels(Scene(problem.scene.shapes[1:])).astype(np.float32) if method == TRUE else None
    began = time.process_time()
    if network is not None:
        voxels = predict(observe(partial.views, partial.robot, partial.start), network)
    asked = replace(partial, unknown=METHODS.get(method, PREDICTED))
    left = LIMIT if network is None else LIMIT - (time.process_time() - began)
    planner = HYBRID_PLANNER if method == HYBRID else PLANNER
    result = plan_with_unknown_space(planner, asked, PlanRequest(left), voxels)
    spent = time.process_time() - began
    return {
        "method": method,
        "solved": result.solved,
        "free": is_free(problem, result),
        "assumption": result.assumption,
        "confidence": result.confidence,
        "risk": result.swept_probability,
        "time": spent,
        "reason": result.reason,
    }


def is_free(problem: Problem, result: PlanResult) -> bool:
    """Whether the motion is one in the true scene."""
    if result.path is None or result.trajectory is None:
        return False
    return verify(problem, result.path).valid and verify_trajectory(problem, result.trajectory).valid


def run(arguments: argparse.Namespace) -> None:
    """Try what is not in the records yet."""
    networks = {BY + Path(folder).name: load_completion(folder) for folder in arguments.weights}
    methods = [*arguments.methods, *networks]
    context.time = CpuClock  # type: ignore[attr-defined]
    kept = JsonLines(Path(arguments.records))
    place = {"views": arguments.views, "noise": arguments.noise}
    done = {(r["family"], r["number"], r["method"]) for r in kept.rows if place.items() <= r.items()}
    each = arguments.problems // len(arguments.families)
    warm = True
    for family in arguments.families:
        known = {row["number"] for row in kept.rows if row["family"] == family}
        for number, problem in progress(list(problems(family, each, known)), family):
            missing = [method for method in methods if (family, number, method) not in done]
            if not missing:
                continue
            taken = views(problem, family, number, arguments.views, arguments.noise)
            known = Scene(problem.scene.shapes[:1])
            began = time.process_time()
            partial = Problem(problem.robot, known, problem.start, problem.goal, views=taken)
            spent = time.process_time() - began
            if warm:
                HYBRID_PLANNER.warm_up(problem, "short")
                tried(problem, partial, PREDICTED if PREDICTED in missing else "padded")
                warm = False
            for method in missing:
                row = tried(problem, partial, method, networks.get(method))
                kept.append({"family": family, "number": number, **place, "view_time": spent, **row})


def table(rows: list[Row], title: str) -> None:
    """Methods on the same problems: free in truth, plans, the first assumption, times; and each family."""
    families = list(dict.fromkeys(row["family"] for row in rows))
    lines = []
    others = dict.fromkeys(row["method"] for row in rows if row["method"].startswith(BY))
    for method in [*METHODS, *others, TRUE]:
        mine = [row for row in rows if row["method"] == method]
        if not mine:
            continue
        free, solved = sum(row["free"] for row in mine), sum(row["solved"] for row in mine)
        low, high = wilson_interval(free, len(mine))
        first = [row for row in mine if row["assumption"] == FIRST_RUNGS.get(method, FIRST_IMAGINED)]
        shares = [np.mean([row["free"] for row in mine if row["family"] == family]) for family in families]
        lines.append(
            (
                method,
                len(mine),
                f"{100 * free / len(mine):.1f} ({100 * low:.0f} to {100 * high:.0f})",
                f"{100 * solved / len(mine):.0f}",
                f"{100 * free / max(solved, 1):.0f}",
                f"{100 * len(first) / len(mine):.0f}" if first else "",
                f"{100 * np.mean([row['free'] for row in first]):.0f}" if first else "",
                f"{1e3 * np.median([row['time'] for row in mine]):.0f}",
                *(f"{100 * share:.0f}" for share in shares),
            )
        )
    columns = ["%", "problems", "free in truth", "plans", "of them free"]
    columns += ["first assumption", "of it free", "ms", *families]
    print_table(title, columns, lines)
    base = {name: _free(rows, name) for name in [*METHODS, *others, TRUE]}
    pairs = [("padded", "as seen"), ("predicted", "as seen"), ("predicted", "padded"), (TRUE, "predicted")]
    pairs += [(HYBRID, "predicted")]
    pairs += [(other, of) for other in others for of in ("as seen", "padded", "predicted")]
    for a, b in pairs:
        both = base[a].keys() & base[b].keys()
        if both:
            pair = compare(*(np.array([1.0 if base[m][k] else np.nan for k in sorted(both)]) for m in (a, b)))
            gain = 100 * (pair.a_only - pair.b_only) / len(both)
            print(f"{a} over {b}: {gain:+.1f} points, p = {pair.p_success:.2g} (McNemar, exact)")
    print()


FIRST_IMAGINED = "predicted, p > 0.1"
FIRST_RUNGS = {"as seen": None, "occupied": None, "padded": "points padded by 9 cm"}
"""Of methods that predict it is FIRST_IMAGINED."""


def _free(rows: list[Row], method: str) -> dict[tuple[str, int], bool]:
    return {(row["family"], row["number"]): row["free"] for row in rows if row["method"] == method}


def calibration(rows: list[Row]) -> None:
    """Stated confidence against the share that is free, on the half that it was not fitted on."""
    for method in METHODS:
        mine = [r for r in rows if r["method"] == method and r["solved"] and r["number"] % 2]
        if not mine:
            continue
        stated = np.array([confidence(row["assumption"], row["risk"]) for row in mine])
        free = np.array([row["free"] for row in mine], float)
        lines, error = [], 0.0
        for low in np.arange(0, 1, 0.2):
            part = (stated >= low) & (stated < low + 0.2 + 1e-9 * (low > 0.7))
            if part.any():
                lines.append(
                    (
                        f"{low:.1f} to {low + 0.2:.1f}",
                        int(part.sum()),
                        f"{stated[part].mean():.2f}",
                        f"{free[part].mean():.2f}",
                    )
                )
                error += part.mean() * abs(stated[part].mean() - free[part].mean())
        print_table(
            f"Confidence of {method}, on problems with odd numbers",
            ["stated", "motions", "mean", "free"],
            lines,
        )
        print(f"expected error {error:.3f}\n")


def main() -> None:
    parser = argparse.ArgumentParser(description="Planning on depth views, validated in the true scene.")
    parser.add_argument("--problems", type=int, default=300, help="(300)")
    parser.add_argument("--families", nargs="+", default=list(FAMILIES), help="(all)")
    every = [*METHODS, TRUE]
    parser.add_argument("--methods", nargs="+", default=every, choices=every, metavar="NAME", help="(all)")
    parser.add_argument("--views", type=int, default=1, help="(1)")
    parser.add_argument("--noise", action="store_true")
    parser.add_argument(
        "--weights", nargs="*", default=[], metavar="FOLDER", help="of the completing network"
    )
    parser.add_argument("--records", default="unknown.jsonl", help="(unknown.jsonl)")
    parser.add_argument("--report", action="store_true")
    parser.add_argument("--odd", action="store_true", help="report problems with odd numbers alone")
    parser.add_argument("--fit", action="store_true")
    parser.add_argument("--times", action="store_true")
    arguments = parser.parse_args()
    if arguments.times:
        print(header("torch"))
        times(arguments.families)
    elif arguments.fit:
        fit(JsonLines(Path(arguments.records)).rows)
    elif arguments.report:
        print(header("numba", "numpy", "torch"))
        rows = JsonLines(Path(arguments.records)).rows
        report([row for row in rows if row["number"] % 2 or not arguments.odd])
    else:
        run(arguments)


def report(rows: list[Row]) -> None:
    places = dict.fromkeys((row["views"], row["noise"]) for row in rows)
    for count, noisy in places:
        some = [row for row in rows if (row["views"], row["noise"]) == (count, noisy)]
        table(some, f"{count} {'noisy ' if noisy else ''}view{'s' if count > 1 else ''}")
        if (count, noisy) == (1, False):
            calibration(some)
    spent = [row["view_time"] for row in rows]
    print(f"From views to the problem's scene: {1e3 * np.median(spent):.0f} ms of CPU time (median)")


def times(families: list[str]) -> None:
    """CPU time of the completing network, from a packed volume to probabilities, on one thread."""
    volumes = []
    for family in families:
        problem = held_out_problem(family, 0)
        seen = observe(views(problem, family, 0, 1, False), problem.robot, problem.start)
        volumes.append([torch.from_numpy(array)[None] for array in pack(seen)])
    torch.set_num_threads(1)
    spent = {"fp32": list[float](), "bf16": list[float]()}
    for i in range(CALLS + WARM):
        for name, taken in spent.items():
            with torch.inference_mode(), torch.autocast("cpu", torch.bfloat16, enabled=name == "bf16"):
                began = time.process_time()
                bundled().probabilities(*volumes[i % len(volumes)])
                taken.append(time.process_time() - began)
    for name, taken in spent.items():
        least, median = 1e3 * min(taken[WARM:]), 1e3 * np.median(taken[WARM:])
        print(
            f"network in {name}: {median:.1f} ms of CPU time in the median, {least:.1f} at least, of {CALLS}"
        )


def fit(rows: list[Row]) -> None:
    """Print RATES and BY_RISK of perception/confidence.py."""
    rows = [r for r in rows if r["solved"] and r["number"] % 2 == 0 and r["views"] == 1 and not r["noise"]]
    plain = [row for row in rows if row["risk"] is None]
    for assumption in dict.fromkeys(row["assumption"] for row in plain):
        free = [row["free"] for row in plain if row["assumption"] == assumption]
        print(f'RATES "{assumption}": {(sum(free) + 1) / (len(free) + 2):.2f} of {len(free)}')
    for seen in (False, True):
        some = [r for r in rows if r["method"] == "predicted" and (r["assumption"] == "as seen") == seen]
        if some:
            free, risk = (np.array([row[name] for row in some], float) for name in ("free", "risk"))
            print(
                "BY_RISK",
                "as seen" if seen else "predicted",
                _logistic(np.log(np.maximum(risk, MIN_RISK)), free),
            )


def _logistic(x: Float[ndarray, "n"], y: Float[ndarray, "n"]) -> tuple[float, float]:
    """Log odds at 0 and their slope, which is not let above 0; with a prior of one motion of either kind."""
    from scipy.optimize import minimize

    def loss(w: ndarray) -> float:
        odds = w[0] + w[1] * x
        prior = np.logaddexp(0, -w[0]) + np.logaddexp(0, w[0])
        return float(np.logaddexp(0, np.where(y > 0, -odds, odds)).sum() + prior)

    found = minimize(loss, np.zeros(2), bounds=[(None, None), (None, 0.0)]).x
    return round(float(found[0]), 2), round(float(found[1]), 2)


if __name__ == "__main__":
    main()
