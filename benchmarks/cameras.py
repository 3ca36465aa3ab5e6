"""Unknown space: motions planned on depth views and validated in the true scene; the choice of the next view.

    python benchmarks/cameras.py [--problems 300] [--views 1] [--images real] [--walls]
        [--cameras far] [--records FILE]
    python benchmarks/cameras.py --weights FOLDER ... --families shelf clutter
    python benchmarks/cameras.py --report [--odd] --records FILE
    python benchmarks/cameras.py --next-view [--problems 210] --records FILE
    python benchmarks/cameras.py --next-view --report --records FILE
    python benchmarks/cameras.py --fit --records FILE
    python benchmarks/cameras.py --times

Prints benchmarks/results/unseen.txt. Problems are held-out problems of the families, or problems of folders
of MotionBenchMaker. The straight line does not solve them, and a search in the true scene does. Cameras stand
where a person would place them, 1.4 to 1.8 m away (--cameras: near, 0.8 to 1.2 m; far, 2.4 to 3 m; overhead),
in front more often than behind. Only the floor is known without views. Every method plans with AORRTC and
has the same CPU time. A motion is free if the validator accepts path and timed motion in the true scene.
Records are kept in FILE and not made again; --report prints their tables.

--images chooses the errors of the images and camera poses, and which errors the views state: see IMAGES.
--walls puts the scene into a room; without it, rays that miss the obstacles and the floor have no return.

--weights adds the method 'predicted' with other weights of the occupancy completion network, folders of
`train completion`; such methods are named by the folder. Weights that were trained without some families are
tried on these families. --fit prints the constants RATES, from problems with even numbers, and ONE_VIEW, from
all problems, of perception/occupancy_map.py. Settings were also chosen on problems with even numbers; --odd
leaves these out of the report.
--times prints the CPU time of the network.

--next-view plans a motion from one view, and again with a second view: from the pose that `next_view`
proposes, from a random one of the poses that `next_view` can choose, and from the first camera's pose turned
by half a turn about the base.
"""

import argparse
import itertools
import time
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from common import FIRST, TIME_LIMIT, header, parse, print_table, progress, use_processor_time
from robotdiffuse.core.files import JsonLines
from robotdiffuse.core.types import PlanResult, Values
from robotdiffuse.evaluation.bench_comparisons import compare, wilson_interval
from robotdiffuse.learning.completion import (
    CameraPlaces,
    Completion,
    exported_completion,
    pack,
    predict,
)
from robotdiffuse.perception.depth_view import DepthNoise, DepthView
from robotdiffuse.perception.observed_volume import observe
from robotdiffuse.perception.occupancy_map import MIN_RISK
from robotdiffuse.perception.ray_caster import MAX_RANGE, ray_cast, voxels_within
from robotdiffuse.perception.voxel_grid import FINE
from robotdiffuse.planning import load_planner
from robotdiffuse.planning.context import PlanRequest
from robotdiffuse.planning.exploration.viewpoints import next_view, poses_around
from robotdiffuse.planning.pipeline.unknown_space import plan_with_unknown_space
from robotdiffuse.problems.families import FAMILIES
from robotdiffuse.problems.files import SEED, held_out_problem, line_length, load_problems
from robotdiffuse.problems.problem import PREDICTED, Problem
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.shapes import Box
from robotdiffuse.validation.validator import verify

LIMIT = 1.0
"""CPU time of every method on every problem [s]."""
SEARCH_LIMIT = 1.0
"""CPU time of the search that decides whether a problem can be solved in the true scene [s]."""
RING = "ring"
CAMERAS = {
    RING: CameraPlaces(distance=(1.4, 1.8), height=(0.5, 1.4), target_spread=0.1, roll=0.0),
    "near": CameraPlaces(distance=(0.8, 1.2), height=(0.3, 0.9), target_spread=0.1, roll=0.0),
    "far": CameraPlaces(distance=(2.4, 3.0), height=(0.6, 1.6), target_spread=0.1, roll=0.0),
    "overhead": CameraPlaces(distance=(0.1, 0.6), height=(1.6, 2.0), target_spread=0.1, roll=0.3),
}
SIZE = (640, 480)
METHODS = {
    "as seen": "optimistic",
    "occupied": "occupied",
    "padded": "padded",
    "predicted": PREDICTED,
}
TRUE_VOXELS = "true voxels"
"""Method `predicted` with the true occupancy of the voxels of 2 cm in place of the network's prediction."""
PREDICTED_BY = "predicted by "
"""Method `predicted` with other weights: this text and the name of the folder with the weights."""
# Number of timed calls of the network, and of calls before them.
TIMED_CALLS = 140
WARM_UP_CALLS = 7
SECOND_VIEWS = ("next_view", "random", "opposite")
UNSURE = 0.9
"""Motions planned from one view with a stated confidence below this are reported separately: they need a
second view most."""
PLANNER = load_planner("aorrtc")
Row = dict[str, Any]
RECORDED = DepthNoise(spread=0.004, correlation=1.5, missing=0.01, zeros=True)
"""Noise as in recordings of sensors: errors of neighboring pixels have a correlation of 0.8, and 0 stands for
"no return" and for "nothing in range"."""
POSE_ERROR = (0.005, float(np.radians(1.0)))
"""Error of a camera's calibration: position [m] and angle [rad]."""
POSE, NOISE, RANGE, FAR = "pose not stated", "noise not stated", "range not stated", "0 taken as far"
"""Steps of docs/how_to/real_camera.md that are skipped."""


class Images(NamedTuple):
    """Errors of images and camera poses, and which of these errors the views state."""

    noise: DepthNoise | None = None
    off: bool = False
    """Whether the stated pose of each camera is off by POSE_ERROR, in a direction and about an axis that are
    drawn once for each camera."""
    skipped: str = ""
    """The error that is not stated, or the mistake: one of POSE, NOISE, RANGE and FAR; "": none."""

    def stated(self, view: DepthView, seed: int) -> DepthView:
        """The view with an inexact pose and the errors that it states. view: with the exact pose."""
        T = view.T_base_camera.copy()
        if self.off:
            rng = np.random.default_rng([seed, view.depth.size])
            shift, axis = (v / np.linalg.norm(v) for v in rng.standard_normal((2, 3)))
            T[:3, 3] += POSE_ERROR[0] * T[:3, :3] @ shift
            T[:3, :3] @= Rotation.from_rotvec(POSE_ERROR[1] * axis).as_matrix()
        return replace(
            view,
            depth=np.where(view.depth == 0, np.inf, view.depth) if self.skipped == FAR else view.depth,
            T_base_camera=T,
            range=None if self.skipped == RANGE else view.range or MAX_RANGE,
            noise=None if self.skipped == NOISE else self.noise,
            pose_deviation=POSE_ERROR if self.off and self.skipped != POSE else (0.0, 0.0),
        )


IDEAL = "ideal"
IMAGES = {
    IDEAL: Images(),
    "white noise": Images(DepthNoise()),
    "recorded noise": Images(RECORDED),
    "off": Images(off=True),
    "real": Images(RECORDED, off=True),
    **{skipped: Images(RECORDED, True, skipped) for skipped in (POSE, NOISE, RANGE, FAR)},
}
WALL = "wall"
ROOM = 2.2
"""Distance of the walls from the base's axis [m]. Cameras of the ring stand inside and see the opposite
wall."""


def with_walls(problem: Problem) -> Problem:
    """The problem in a room."""
    ends = ((ROOM, 0.0), (-ROOM, 0.0), (0.0, ROOM), (0.0, -ROOM))
    walls = [Box((x, y, 1.0), (0.1 + 2 * abs(y), 0.1 + 2 * abs(x), 4.0), name=WALL) for x, y in ends]
    return replace(problem, scene=Scene([*problem.scene.shapes, *walls]))


def problems(family: str, count: int, known: set[int]) -> Iterator[tuple[int, Problem]]:
    """Held-out problems of a family, or problems of a folder, with their numbers. The straight line does not
    solve them, and a search in the true scene does. known: numbers of problems that are already known to
    be of this kind; up to the largest of these numbers, no other problem is tried."""
    numbered = (
        ((i, held_out_problem(family, i)) for i in itertools.count())
        if family in FAMILIES
        else ((i, entry.load()) for i, entry in enumerate(load_problems(Path(family))) if not entry.error)
    )
    last_known = max(known, default=-1)
    hard = (
        (number, problem)
        for number, problem in numbered
        if number in known or (number > last_known and _hard(problem))
    )
    yield from itertools.islice(hard, count)


def known_scene(problem: Problem) -> Scene:
    """The obstacles that are known without views: the floor."""
    return Scene([shape for shape in problem.scene.shapes if shape.name == "floor"])


def unknown_scene(problem: Problem) -> Scene:
    """The obstacles that only views show: all but the floor."""
    return Scene([shape for shape in problem.scene.shapes if shape.name != "floor"])


def _hard(problem: Problem) -> bool:
    trivial = line_length(problem, lambda case, path: verify(case, path).valid) is not None
    return not trivial and PLANNER.plan(problem, time_limit=SEARCH_LIMIT, until=FIRST).solved


def views(
    problem: Problem, family: str, number: int, count: int, noise: DepthNoise | None, cameras: str = RING
) -> list[DepthView]:
    """Depth views of the problem's scene from random cameras, with the arm at its start."""
    source = list(FAMILIES).index(family) if family in FAMILIES else zlib.crc32(Path(family).name.encode())
    rng = np.random.default_rng([SEED, source, number, 14])
    taken = []
    inner = Scene([shape for shape in problem.scene.shapes if shape.name != WALL])
    for _ in range(count):
        T, angle = CAMERAS[cameras].draw(inner, rng)
        focal = SIZE[1] / 2 / np.tan(angle / 2)
        intrinsics = (focal, focal, (SIZE[0] - 1) / 2, (SIZE[1] - 1) / 2)
        view = ray_cast(problem.scene, T, intrinsics, SIZE, problem.robot, problem.start)
        taken.append(view if noise is None else noise.applied(view, rng))
    return taken


def plan(problem: Problem, partial: Problem, method: str, network: Completion | None = None) -> Row:
    """A record of a motion that a method plans and that is validated in the true scene.

    problem: with the true scene. partial: with the known scene and the views. network: a completion network
    in place of the bundled one.
    """
    voxels = voxels_within(unknown_scene(problem), FINE).astype(np.float32) if method == TRUE_VOXELS else None
    began = time.process_time()
    if network is not None:
        voxels = predict(observe(partial.views, partial.robot, partial.start), network)
    with_policy = replace(partial, unknown=METHODS.get(method, PREDICTED))
    time_left = LIMIT if network is None else LIMIT - (time.process_time() - began)
    result = plan_with_unknown_space(PLANNER, with_policy, PlanRequest(time_left), voxels)
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
    """Whether the motion is valid in the true scene."""
    if result.path is None or result.trajectory is None:
        return False
    return verify(problem, result.path).valid and verify(problem, result.trajectory).valid


SETTING_NAMES = ("views", "images", "walls", "cameras")
"""Arguments that a record contains, so that --report can group the records by them."""


def run(arguments: argparse.Namespace) -> None:
    """Make the records that are missing."""
    networks = {PREDICTED_BY + Path(folder).name: exported_completion(folder) for folder in arguments.weights}
    methods = [*arguments.methods, *networks]
    records = JsonLines(Path(arguments.records))
    images = IMAGES[arguments.images]
    setting = {name: vars(arguments)[name] for name in SETTING_NAMES}
    done = {(r["family"], r["number"], r["method"]) for r in records.rows if setting.items() <= r.items()}
    each = arguments.problems // len(arguments.families)
    warm = True
    for family in arguments.families:
        numbers = {row["number"] for row in records.rows if row["family"] == family}
        for number, problem in progress(list(problems(family, each, numbers)), family):
            missing = [method for method in methods if (family, number, method) not in done]
            if not missing:
                continue
            problem = with_walls(problem) if arguments.walls else problem
            taken = views(problem, family, number, arguments.views, images.noise, arguments.cameras)
            taken = [images.stated(view, number) for view in taken]
            began = time.process_time()
            partial = Problem(problem.robot, known_scene(problem), problem.start, problem.goal, views=taken)
            spent = time.process_time() - began
            if warm:
                PLANNER.warm_up(problem, TIME_LIMIT)
                plan(problem, partial, PREDICTED if PREDICTED in missing else "padded")
                warm = False
            for method in missing:
                row = plan(problem, partial, method, networks.get(method))
                records.append({"family": family, "number": number, **setting, "view_time": spent, **row})


def table(rows: list[Row], title: str) -> None:
    """Print a table of the methods on the same problems: motions free in the true scene, plans found, the
    assumption used, times, and motions free in each family."""
    families = list(dict.fromkeys(row["family"] for row in rows))
    lines = []
    others = dict.fromkeys(row["method"] for row in rows if row["method"].startswith(PREDICTED_BY))
    for method in [*METHODS, *others, TRUE_VOXELS]:
        of_method = [row for row in rows if row["method"] == method]
        if not of_method:
            continue
        free = sum(row["free"] for row in of_method)
        solved = sum(row["solved"] for row in of_method)
        low, high = wilson_interval(free, len(of_method))
        first = [
            row for row in of_method if row["assumption"] == FIRST_ASSUMPTIONS.get(method, FIRST_PREDICTED)
        ]
        shares = [
            np.mean([row["free"] for row in of_method if row["family"] == family]) for family in families
        ]
        lines.append(
            (
                method,
                len(of_method),
                f"{100 * free / len(of_method):.1f} ({100 * low:.0f} to {100 * high:.0f})",
                f"{100 * solved / len(of_method):.0f}",
                f"{100 * free / max(solved, 1):.0f}",
                f"{100 * len(first) / len(of_method):.0f}" if first else "",
                f"{100 * np.mean([row['free'] for row in first]):.0f}" if first else "",
                f"{1e3 * np.median([row['time'] for row in of_method]):.0f}",
                *(f"{100 * share:.0f}" for share in shares),
            )
        )
    columns = ["%", "problems", "free in the true scene", "plans", "of plans free"]
    columns += ["first assumption", "of these free", "ms", *(Path(family).name for family in families)]
    print_table(title, columns, lines)
    free_by_method = {name: _free(rows, name) for name in [*METHODS, *others, TRUE_VOXELS]}
    pairs = [
        ("padded", "as seen"),
        ("predicted", "as seen"),
        ("predicted", "padded"),
        (TRUE_VOXELS, "predicted"),
    ]
    pairs += [(other, baseline) for other in others for baseline in ("as seen", "padded", "predicted")]
    for a, b in pairs:
        common = free_by_method[a].keys() & free_by_method[b].keys()
        if common:
            pair = compare(
                *(np.array([1.0 if free_by_method[m][k] else np.nan for k in sorted(common)]) for m in (a, b))
            )
            gain = 100 * (pair.a_only - pair.b_only) / len(common)
            print(f"{a} over {b}: {gain:+.1f} points, p = {pair.p_success:.2g} (McNemar, exact)")
    print()


FIRST_PREDICTED = "predicted, p > 0.1"
FIRST_ASSUMPTIONS = {"as seen": None, "occupied": None, "padded": "points padded by 9 cm"}
"""First assumption of each method without a network; for the other methods it is FIRST_PREDICTED."""


def _free(rows: list[Row], method: str) -> dict[tuple[str, int], bool]:
    return {(row["family"], row["number"]): row["free"] for row in rows if row["method"] == method}


def calibration(rows: list[Row], source: str) -> None:
    """Print the stated confidence against the fraction of motions that are free, for each method.

    source: the source of the problems, for the title.
    """
    for method in METHODS:
        planned = [row for row in rows if row["method"] == method and row["solved"]]
        if not planned:
            continue
        stated = np.array([row["confidence"] for row in planned])
        free = np.array([row["free"] for row in planned], float)
        lines = [
            (f"{i / 5:.1f} to {(i + 1) / 5:.1f}", count, f"{confidence:.2f}", f"{rate:.2f}")
            for i, count, confidence, rate in fifths(stated, free)
        ]
        print_table(f"Confidence of {method}, {source}", ["stated", "motions", "mean", "free"], lines)
        whole = f"{len(planned)} motions, {stated.mean():.2f} stated, {free.mean():.2f} free"
        print(f"{whole}, expected error {expected_error(stated, free):.3f}\n")


def fifths(stated: Values, free: Values) -> list[tuple[int, int, float, float]]:
    """For each fifth of the range of confidences that has motions: its index, the number of its motions,
    their mean stated confidence, and the fraction of them that is free."""
    fifth = np.minimum(5 * stated, 4).astype(int)
    return [
        (i, int((fifth == i).sum()), float(stated[fifth == i].mean()), float(free[fifth == i].mean()))
        for i in np.unique(fifth).tolist()
    ]


def expected_error(stated: Values, free: Values) -> float:
    """The expected calibration error over fifths."""
    errors = [count * abs(confidence - rate) for _, count, confidence, rate in fifths(stated, free)]
    return sum(errors) / len(stated)


def report(rows: list[Row]) -> None:
    """Print the tables for each combination of number of views, images, walls and cameras."""
    settings = dict.fromkeys(tuple(row[name] for name in SETTING_NAMES) for row in rows)
    for setting in settings:
        with_setting = [row for row in rows if tuple(row[name] for name in SETTING_NAMES) == setting]
        count, images, walls, cameras = setting
        title = f"views: {count}, images: {images}, {'a room' if walls else 'no walls'}, cameras: {cameras}"
        for own_families in (True, False):
            chosen = [row for row in with_setting if (row["family"] in FAMILIES) == own_families]
            if chosen:
                table(chosen, f"{'Families' if own_families else 'Other problems'}, {title}")
                calibration(chosen, "families" if own_families else "other problems")
    spent = [row["view_time"] for row in rows]
    print(f"From views to the problem's scene: {1e3 * np.median(spent):.0f} ms of CPU time (median)")


def times(families: list[str], calls: int = TIMED_CALLS) -> None:
    """Print the CPU time of the completion network, from a packed volume to probabilities, on one thread."""
    volumes = []
    for family in families:
        problem = held_out_problem(family, 0)
        seen = observe(views(problem, family, 0, 1, None), problem.robot, problem.start)
        volumes.append(pack(seen))
    network = exported_completion()
    spent = list[float]()
    for i in range(calls + WARM_UP_CALLS):
        began = time.process_time()
        network(*volumes[i % len(volumes)])
        spent.append(time.process_time() - began)
    least = 1e3 * min(spent[WARM_UP_CALLS:])
    median = 1e3 * np.median(spent[WARM_UP_CALLS:])
    print(f"network: {median:.1f} ms of CPU time (median), {least:.1f} least, {calls} calls")


def fit(rows: list[Row]) -> None:
    """Print the constants RATES and ONE_VIEW of perception/occupancy_map.py."""
    rows = [row for row in rows if row["solved"] and row["views"] == 1]
    predicted = [row for row in rows if row["method"] == PREDICTED]
    log_risk = np.log(np.maximum([row["risk"] for row in predicted], MIN_RISK))
    free = np.array([row["free"] for row in predicted])

    def loss(curve: Float[ndarray, "2"]) -> float:
        odds = curve[0] + curve[1] * log_risk
        return float((np.logaddexp(0, odds) - free * odds).sum())

    if predicted:
        print("ONE_VIEW:", minimize(loss, np.zeros(2)).x.round(2), f"of {len(predicted)}")
    plain = [row for row in rows if row["risk"] is None and row["images"] == IDEAL and not row["walls"]]
    plain = [row for row in plain if row["number"] % 2 == 0]
    for assumption in dict.fromkeys(row["assumption"] for row in plain):
        free = [row["free"] for row in plain if row["assumption"] == assumption]
        print(f'RATES "{assumption}": {(sum(free) + 1) / (len(free) + 2):.2f} of {len(free)}')


def run_next_view(records: str, families: list[str], count: int) -> None:
    """Make the missing records of second views."""
    file = JsonLines(Path(records))
    done = {(row["family"], row["number"]) for row in file.rows}
    for family in families:
        numbers = {number for name, number in done if name == family}
        drawn = list(problems(family, count // len(families), numbers))
        for number, problem in progress(drawn, family):
            if (family, number) not in done:
                row = {"family": family, "number": number}
                file.append(row | plan_with_second_views(problem, family, number))


def plan_with_second_views(problem: Problem, family: str, number: int) -> Row:
    """A record of the motion planned from one view, and of the motions with each second view."""
    [view] = views(problem, family, number, 1, None)
    partial, first = _plan_on(problem, view)
    row: Row = {"one": is_free(problem, first), "confidence": first.confidence}
    if first.path is None:
        return row
    rng = np.random.default_rng([SEED, number, 15])
    poses = poses_around()
    chosen = {
        "next_view": next_view(partial, first, poses).T_base_camera,
        "random": poses[rng.integers(len(poses))],
        "opposite": np.diag([-1.0, -1.0, 1.0, 1.0]) @ view.T_base_camera,
    }
    for name, T in chosen.items():
        second = ray_cast(problem.scene, T, view.intrinsics, SIZE, problem.robot, problem.start)
        result = _plan_on(problem, view, second)[1]
        row |= {name: is_free(problem, result), f"{name} confidence": result.confidence or 0.0}
    return row


def _plan_on(problem: Problem, *seen: DepthView) -> tuple[Problem, PlanResult]:
    known = known_scene(problem)
    partial = Problem(problem.robot, known, problem.start, problem.goal, views=seen, unknown=PREDICTED)
    return partial, plan_with_unknown_space(PLANNER, partial, PlanRequest(LIMIT))


def report_next_view(rows: list[Row]) -> None:
    """Print the fraction of motions that are free in the true scene, for all problems and for those whose
    motion from one view has a confidence below UNSURE."""
    rows = [row for row in rows if SECOND_VIEWS[0] in row]
    unsure = [row for row in rows if row["confidence"] < UNSURE]
    for title, chosen in (("All", rows), (f"Stated confidence of one view below {UNSURE}", unsure)):
        if not chosen:
            continue

        def share(name: str, chosen: list[Row] = chosen) -> str:
            return f"{100 * np.mean([row[name] for row in chosen]):.1f}"

        lines = [("one view", len(chosen), share("one"), share("confidence"))]
        lines += [(name, len(chosen), share(name), share(f"{name} confidence")) for name in SECOND_VIEWS]
        print_table(title, ["second view", "problems", "free in the true scene, %", "stated, %"], lines)
        proposed = np.array([1.0 if row[SECOND_VIEWS[0]] else np.nan for row in chosen])
        for other in SECOND_VIEWS[1:]:
            pair = compare(proposed, np.array([1.0 if row[other] else np.nan for row in chosen]))
            print(
                f"next_view alone free {pair.a_only}, {other} alone {pair.b_only}, p = {pair.p_success:.2g}"
            )
        print()


def add_options(parser: argparse.ArgumentParser, count: int, methods: Sequence[str], records: str) -> None:
    """Add the options that this script and `exploring.py` have, with these defaults."""
    parser.add_argument(
        "--problems",
        type=int,
        default=count,
        help=f"number of problems, of all families together ({count})",
    )
    parser.add_argument(
        "--families",
        nargs="+",
        default=list(FAMILIES),
        help="families, or folders of MotionBenchMaker (all families)",
    )
    parser.add_argument(
        "--methods",
        nargs="+",
        default=methods,
        choices=methods,
        metavar="NAME",
        help="methods to compare (all)",
    )
    parser.add_argument(
        "--images",
        default=IDEAL,
        choices=IMAGES,
        metavar="NAME",
        help="errors of images and poses, by name (ideal)",
    )
    parser.add_argument("--walls", action="store_true", help="put a room around the scene")
    parser.add_argument("--records", default=records, help=f"file of the records ({records})")
    parser.add_argument("--report", action="store_true", help="only print the tables of the records")


def main() -> None:
    parser = argparse.ArgumentParser(description="Planning on depth views, validated in the true scene.")
    add_options(parser, 300, [*METHODS, TRUE_VOXELS], "unknown_space.jsonl")
    parser.add_argument("--views", type=int, default=1, help="number of views (1)")
    parser.add_argument("--cameras", default=RING, choices=CAMERAS, help="places of the cameras (ring)")
    parser.add_argument(
        "--weights", nargs="*", default=[], metavar="FOLDER", help="folders of weights of completion networks"
    )
    parser.add_argument("--next-view", action="store_true", help="plan with second views")
    parser.add_argument("--odd", action="store_true", help="report only problems with odd numbers")
    parser.add_argument("--fit", action="store_true", help="print the constants of the stated confidence")
    parser.add_argument("--times", action="store_true", help="print the time of the network")
    arguments = parse(parser, problems=1, families=["rop"], methods=["as seen", "predicted"])
    if arguments.smoke:
        smoke(arguments)
    elif arguments.times:
        print(header("onnxruntime"))
        times(arguments.families)
    elif arguments.fit:
        fit(JsonLines(Path(arguments.records)).rows)
    elif arguments.report:
        print(header("numba", "numpy", "onnxruntime"))
        rows = JsonLines(Path(arguments.records)).rows
        if arguments.next_view:
            report_next_view(rows)
        else:
            report([row for row in rows if row["number"] % 2 or not arguments.odd])
    else:
        use_processor_time()
        if arguments.next_view:
            run_next_view(arguments.records, arguments.families, arguments.problems)
        else:
            run(arguments)


def smoke(arguments: argparse.Namespace) -> None:
    """Run every part on one problem."""
    print(header("numba", "numpy", "onnxruntime"))
    use_processor_time()
    with TemporaryDirectory() as folder:
        arguments.records = f"{folder}/records.jsonl"
        run(arguments)
        rows = JsonLines(Path(arguments.records)).rows
        report(rows)
        fit([row | {"number": 0} for row in rows])
        run_next_view(f"{folder}/second.jsonl", arguments.families, 1)
        report_next_view(JsonLines(Path(folder) / "second.jsonl").rows)
    times(arguments.families, 1)


if __name__ == "__main__":
    main()
