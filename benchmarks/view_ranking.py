"""Planning from one view: a model of P(free in the true scene | view, motion) is trained on labels from the
true scene. Does it choose better among several motions than the confidence that the package states?

    python benchmarks/view_ranking.py [--rounds 40] [--families NAME or FOLDER ...] --records FILE
    python benchmarks/view_ranking.py --report --records FILE

Prints benchmarks/results/view_ranking.txt. Problems and cameras are those of `benchmarks/cameras.py` at its
ring, one problem of each family per round. Of four problems, two are seen with ideal depth, one with white
noise, and one with correlated noise and zeros where nothing is in range. Candidate motions are made as in a
call of the planner: AORRTC's first motions with eight seeds and one converged motion, among the voxels above
the lowest threshold for which there is a motion. Three more candidates are first motions among the voxels
above CAREFUL. The validator labels each candidate in the true scene. Records are kept in FILE and not made
again; folders hold problems of MotionBenchMaker.

--report compares the motion that a call chooses with other rules and with models. Models are trained only on
problems of the families: to score other problems, on all of them; to score problems of the families, on the
four fifths of them (by number) that do not contain the problem.
"""

import argparse
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from cameras import PLANNER, Row, expected_error, is_free, known_scene, problems, views
from common import CONVERGED, FIRST, header, parse, print_table, use_processor_time
from robotdiffuse.collision.kernel_arrays import compile_scene_for
from robotdiffuse.core.files import JsonLines
from robotdiffuse.evaluation.bench_comparisons import bootstrap_interval, compare, wilson_interval
from robotdiffuse.learning.completion import predict
from robotdiffuse.perception.depth_view import DepthNoise
from robotdiffuse.perception.observed_volume import observe
from robotdiffuse.perception.occupancy_map import CARVING_MARGIN, THRESHOLDS, OccupiedVoxels, confidence
from robotdiffuse.perception.voxel_grid import COARSE, SHAPE, refined
from robotdiffuse.planning.context import PlanRequest
from robotdiffuse.planning.pipeline.unknown_space import (
    ACCEPTABLE_RISK,
    CONFIDENCE_TOLERANCE,
    MAX_FIRST_MOTIONS,
    MIN_FIRST_MOTIONS,
    NEGLIGIBLE_RISK,
    unknown_space_of,
    with_assumption,
)
from robotdiffuse.problems.families import FAMILIES
from robotdiffuse.problems.problem import PREDICTED, JointGoal, Problem

IDEAL, WHITE, CORRELATED = "ideal", "white noise", "correlated noise"
DEPTHS = {
    IDEAL: None,
    WHITE: DepthNoise(),
    CORRELATED: DepthNoise(correlation=2.0, missing=0.01, zeros=True),
}
ORDER = (IDEAL, WHITE, IDEAL, CORRELATED)
"""Kinds of depth of the problems of a family, repeated."""
SENSOR_RANGE = 6.0
"""`range` of views with zeros [m]."""
CAREFUL = 0.03
"""A threshold of occupancy below those of the package."""
CAREFUL_KIND = "careful"
CAREFUL_SEEDS = 3
AS_SEEN = 1.0
"""Threshold above which no voxel is an obstacle: motions avoid only seen points."""
# CPU time limits of a first motion, of the converged motion, and of a first motion above CAREFUL [s].
FIRST_LIMIT, CONVERGED_LIMIT, CAREFUL_LIMIT = 0.1, 0.17, 0.06
GROWN = 0.03
"""Margin around the swept space, for features [m]."""
BINS = (0.003, 0.01, 0.03, 0.06, 0.1, 0.2, 0.35, 0.5, 0.8, 1.01)
"""Edges of the bins of histograms of voxel probabilities, for features."""
FOLDS = 5
# Training of the models: hidden units, dropout, steps, batch size, learning rate and weight decay.
HIDDEN, DROPOUT, STEPS, BATCH, RATE, DECAY = 128, 0.3, 400, 256, 1e-3, 0.3
LINEAR_INPUTS = 7
"""Number of inputs of the linear model: the stated confidence, and figures of the unseen voxels that the
motion sweeps."""
STATED = "confidence"
UNSEEN_NEAR = 16
"""Index of a feature: the unseen fraction of the swept space with its margin."""
Scores = dict[int, Float[ndarray, "motions"]]
"""Scores of the motions of each record, by the record's index."""


def record(problem: Problem, family: str, number: int, depth: str) -> Row:
    """The motions of a problem seen by one view: features, labels and CPU times."""
    [view] = views(problem, family, number, 1, DEPTHS[depth])
    if depth == CORRELATED:
        view = replace(view, range=SENSOR_RANGE)
    began = time.process_time()
    known = known_scene(problem)
    partial = Problem(problem.robot, known, problem.start, problem.goal, views=[view], unknown=PREDICTED)
    volume = observe(partial.views, problem.robot, problem.start)
    predicted = predict(volume)
    unknown = unknown_space_of(partial, volume, predicted)
    spent = {"view": time.process_time() - began, FIRST: 0.0, CONVERGED: 0.0, CAREFUL_KIND: 0.0}
    assert isinstance(problem.goal, JointGoal)
    goals = problem.goal.positions
    motions = list[Row]()
    cells = predicted.reshape(SHAPE[0], 2, SHAPE[1], 2, SHAPE[2], 2)
    means, highest = cells.mean(axis=(1, 3, 5)), cells.max(axis=(1, 3, 5))
    elsewhere = ~COARSE.filled(problem.robot, (problem.start, *goals), CARVING_MARGIN + GROWN)

    def attempted(kind: str, threshold: float, assumed: Problem, request: PlanRequest) -> bool:
        began = time.process_time()
        result = PLANNER.attempt(assumed, request)
        planned = time.process_time()
        if result.path is None or result.trajectory is None:
            spent[kind] += planned - began
            return False
        crossed = unknown.crossed(result.path)
        stated = confidence(PREDICTED, crossed)
        stating = time.process_time() - planned
        p = predicted[crossed.voxels]
        swept = COARSE.swept(problem.robot, result.path, GROWN) & elsewhere
        near = swept & volume.unknown
        parts = (volume.unknown, volume.occupied, volume.lost, volume.out_of_view, volume.shadow)
        length = result.path.length
        features = [
            *(len(p), p.sum(), p.max(initial=0), _log_free(p), crossed.unseen_share, crossed.lost_share),
            *np.histogram(p, BINS)[0],
            *(swept.sum(), *((swept & part).sum() / max(swept.sum(), 1) for part in parts)),
            *(means[near].sum(), highest[near].max(initial=0), _log_free(means[near])),
            *np.histogram(highest[near], BINS)[0],
            *(length, result.trajectory.duration),
        ]
        row = {"kind": kind, "threshold": threshold, "confidence": stated, "risk": crossed.risk}
        row |= {"length": length, "time": planned - began, "stating": stating}
        motions.append(row | {"free": is_free(problem, result), "features": [float(x) for x in features]})
        return True

    def search(kind: str, threshold: float, seeds: int, limit: float) -> Problem:
        began = time.process_time()
        assumed = replace(partial, views=())
        if threshold != AS_SEEN:
            voxels = OccupiedVoxels(kind, predicted > threshold, problem.robot, known)
            assumed = with_assumption(partial, voxels, goals)
        compile_scene_for(assumed.robot, assumed.scene)
        spent[kind] += time.process_time() - began
        for seed in range(seeds):
            request = PlanRequest(limit, until=FIRST, seed=seed)
            if not attempted(kind, threshold, assumed, request) and seed == 0:
                break
        return assumed

    for threshold in (*THRESHOLDS, AS_SEEN):
        assumed = search(FIRST, threshold, MAX_FIRST_MOTIONS, FIRST_LIMIT)
        if motions:
            attempted(CONVERGED, threshold, assumed, PlanRequest(CONVERGED_LIMIT, until=CONVERGED))
            break
    search(CAREFUL_KIND, CAREFUL, CAREFUL_SEEDS, CAREFUL_LIMIT)
    p = predicted[refined(volume.unknown)]
    states = (volume.unknown, volume.occupied, volume.lost, volume.out_of_view, volume.shadow)
    returns = np.isfinite(view.depth)
    seen = [*(state.mean() for state in states), p.sum(), (p > 0.1).mean(), (p > 0.5).mean()]
    seen += [(p * (1 - p)).sum(), returns.mean(), (returns & (view.depth > 0)).mean()]
    row = {"family": family, "number": number, "depth": depth, "view": [float(x) for x in seen]}
    return row | {"spent": spent, "motions": motions}


def _log_free(p: ndarray) -> float:
    """Minus the logarithm of the probability that all voxels are free, as if they were independent."""
    return float(-np.log1p(-np.minimum(p, 0.999)).sum())


def run(arguments: argparse.Namespace) -> None:
    """Make the records that are missing, family after family in each round."""
    records = JsonLines(Path(arguments.records))
    done = {(row["family"], row["number"]) for row in records.rows}
    sources = {name: problems(name, arguments.rounds, set()) for name in arguments.families}
    for i in range(arguments.rounds):
        for family, source in sources.items():
            number, problem = next(source, (0, None))
            if problem is not None and (Path(family).name, number) not in done:
                records.append(record(problem, Path(family).name, number, ORDER[i % len(ORDER)]))


def called(row: Row) -> list[Row]:
    """The motions that a call compares; see `planning/pipeline/unknown_space.py`."""
    first = [motion for motion in row["motions"] if motion["kind"] == FIRST]
    least = np.minimum.accumulate([motion["risk"] for motion in first])
    counts = [i for i, risk in enumerate(least, 1) if risk <= _acceptable(i)]  # after which a call stops
    return first[: counts[0] if counts else None] + [m for m in row["motions"] if m["kind"] == CONVERGED]


def _acceptable(motions: int) -> float:
    return ACCEPTABLE_RISK if motions >= MIN_FIRST_MOTIONS else NEGLIGIBLE_RISK


def shortest_of_best(motions: list[Row], score: str = STATED) -> Row:
    """The motion that a call chooses: the shortest one whose score is about the highest."""
    least = max(motion[score] for motion in motions) - CONFIDENCE_TOLERANCE
    return min((m for m in motions if m[score] >= least), key=lambda motion: motion["length"])


def inputs(row: Row, motion: Row) -> list[float]:
    """The inputs of a model for one motion; the first is the log odds of the stated confidence."""
    share = float(np.clip(motion[STATED], 0.002, 0.998))
    kind = [motion["kind"] == CAREFUL_KIND, motion["kind"] == CONVERGED, motion["threshold"] > THRESHOLDS[0]]
    features = np.array(motion["features"])
    return [
        float(np.log(share / (1 - share))),
        *np.log(features + 0.01),
        *kind,
        *np.log(np.array(row["view"]) + 1e-3),
    ]


def scores(rows: list[Row], hidden: int, columns: int | None, steps: int) -> Scores:
    """Scores of motions by models that were not trained on their problem.

    hidden: units of the two hidden layers; 0: a linear model. columns: number of inputs that the model uses;
    None: all. steps: of each training.
    """
    x = [np.array([inputs(row, m)[:columns] for m in row["motions"]], np.float32) for row in rows]
    y = [np.array([m["free"] for m in row["motions"]], np.float32) for row in rows]
    of_families = [i for i, row in enumerate(rows) if row["family"] in FAMILIES]
    parts = [[i for i in of_families if rows[i]["number"] % FOLDS == fold] for fold in range(FOLDS)]
    parts.append([i for i in range(len(rows)) if i not in of_families])
    out = Scores()
    for part in parts:
        learned = [i for i in of_families if i not in part]
        if part and learned:
            weights = np.concatenate([np.full(len(y[i]), 1 / len(y[i])) for i in learned])
            training = np.concatenate([x[i] for i in learned]), np.concatenate([y[i] for i in learned])
            model = trained(*training, weights, hidden, steps)
            out |= {i: model(x[i]) for i in part}
    return out


def trained(
    x: ndarray, y: ndarray, weights: ndarray, hidden: int, steps: int
) -> Callable[[ndarray], ndarray]:
    """Train a model of the probability that a motion is free; returns the function from inputs to it."""
    import torch
    from torch import nn

    torch.manual_seed(0)
    torch.set_num_threads(1)
    middle, spread = x.mean(axis=0), x.std(axis=0) + 1e-3

    def normal(x: ndarray) -> torch.Tensor:
        return torch.tensor((x - middle) / spread).clamp(-5, 5)

    def layer(inputs: int) -> list[nn.Module]:
        return [nn.Linear(inputs, hidden), nn.GELU(), nn.Dropout(DROPOUT)]

    layers = [*layer(x.shape[1]), *layer(hidden)] if hidden else []
    net = nn.Sequential(*layers, nn.Linear(hidden or x.shape[1], 1))
    optimizer = torch.optim.AdamW(net.parameters(), RATE if hidden else 10 * RATE, weight_decay=DECAY)
    normalized, labels, weight = normal(x), torch.tensor(y), torch.tensor(weights / weights.mean())
    for _ in range(steps):
        i = torch.randint(len(x), (BATCH,))
        loss = nn.functional.binary_cross_entropy_with_logits(net(normalized[i])[:, 0], labels[i], weight[i])
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    net.eval()
    return lambda x: torch.sigmoid(net(normal(x))[:, 0]).detach().numpy()


CALL = "a call"


def choices(models: list[str]) -> dict[str, Callable[[Row], tuple[list[Row], Row, str]]]:
    """Rules for choosing a motion, by name: functions from a record to the motions that are compared, the
    chosen motion, and the name of the score that states its confidence."""

    def by(score: str, candidates: Callable[[Row], list[Row]]) -> Callable[[Row], tuple[list[Row], Row, str]]:
        return lambda row: (candidates(row), shortest_of_best(candidates(row), score), score)

    def stated_by(score: str) -> Callable[[Row], tuple[list[Row], Row, str]]:
        return lambda row: (called(row), shortest_of_best(called(row)), score)

    def every(row: Row) -> list[Row]:
        return row["motions"]

    def least(figure: Callable[[Row], float]) -> Callable[[Row], tuple[list[Row], Row, str]]:
        return lambda row: (every(row), min(every(row), key=figure), STATED)

    return {
        CALL: by(STATED, called),
        "first motion": by(STATED, lambda row: every(row)[:1]),
        "motion of more time": by(STATED, lambda row: _of_kind(row, CONVERGED) or every(row)[:1]),
        "first motions": by(STATED, lambda row: _of_kind(row, FIRST)),
        "p > 0.03 before": by(STATED, lambda row: _of_kind(row, CAREFUL_KIND) or called(row)),
        "all": by(STATED, every),
        "all, least unseen near": least(lambda motion: motion["features"][UNSEEN_NEAR]),
        "all, least probability": least(lambda motion: motion["risk"]),
        **{f"a call, stated by {name}": stated_by(name) for name in models},
        **{f"all, by {name}": by(name, every) for name in models[1:]},
    }


def _of_kind(row: Row, kind: str) -> list[Row]:
    return [motion for motion in row["motions"] if motion["kind"] == kind]


def report(rows: list[Row], steps: int) -> None:
    """Print how well each score orders the motions of a problem, and how often the motions chosen by it are
    free."""
    solved = [row for row in rows if row["motions"]]
    print(f"{len(rows)} problems, of them {len(rows) - len(solved)} without a motion, left out")
    models = {
        "refitted confidence": scores(solved, 0, 1, steps),
        "linear model": scores(solved, 0, LINEAR_INPUTS, steps),
        "network": scores(solved, HIDDEN, None, steps),
    }
    for i, row in enumerate(solved):
        for k, motion in enumerate(row["motions"]):
            motion |= {name: float(score[i][k]) for name, score in models.items()}
    lines = []
    for name in (STATED, *models):
        losses = list[float]()
        pairs = list[float]()
        for row in solved:
            free = np.array([motion["free"] for motion in row["motions"]])
            stated = np.clip([motion[name] for motion in row["motions"]], 0.005, 0.995)
            losses.append(-np.log(np.where(free, stated, 1 - stated)).mean())
            if free.any() and not free.all():
                pairs.append(0.5 + np.sign(stated[free][:, None] - stated[~free]).mean() / 2)
        in_order = f"{100 * np.mean(pairs):.0f}" if pairs else ""
        lines.append((name, f"{np.mean(losses):.3f}", in_order, len(pairs)))
    columns = ["score", "log loss", "pairs of a problem in order, %", "problems with such pairs"]
    print_table("All motions", columns, lines)
    groups = {
        "all": solved,
        "families": [row for row in solved if row["family"] in FAMILIES],
        "MotionBenchMaker": [row for row in solved if row["family"] not in FAMILIES],
        "ideal depth": [row for row in solved if row["depth"] == IDEAL],
        "noise": [row for row in solved if row["depth"] != IDEAL],
    }
    for name, group in groups.items():
        if group:
            compared(name, group, [*models])


def compared(title: str, rows: list[Row], models: list[str]) -> None:
    """Print a table that compares the rules of `choices` on some problems."""
    base = np.array([_chosen_free(row) for row in rows])
    lines = []
    for name, choice in choices(models).items():
        chosen = [choice(row) for row in rows]
        free = np.array([motion["free"] for _, motion, _ in chosen])
        stated = np.array([motion[score] for _, motion, score in chosen])
        spent = [cpu_time(row, motions) for row, (motions, _, _) in zip(rows, chosen, strict=True)]
        pair = compare(np.where(free, 1.0, np.nan), np.where(base, 1.0, np.nan))
        low, high = wilson_interval(int(free.sum()), len(free))
        share = f"{100 * free.mean():.1f} ({100 * low:.0f} to {100 * high:.0f})"
        figures = (
            f"{stated.mean():.2f}",
            f"{expected_error(stated, free):.3f}",
            f"{1e3 * np.mean(spent):.0f}",
        )
        lines.append((name, share, pair.a_only, pair.b_only, f"{pair.p_success:.2g}", *figures))
    any_free = np.mean([any(motion["free"] for motion in row["motions"]) for row in rows])
    random = [np.mean([motion["free"] for motion in _of_kind(row, FIRST)]) for row in rows]
    more = 100 * (base - random)
    low, high = bootstrap_interval(more)
    gain = f"a call over a random first motion: {more.mean():+.1f} points ({low:.1f} to {high:.1f})"
    columns = ["choice", "free, %", "gained", "lost", "p", "stated", "error", "ms"]
    print_table(
        f"{title}: {len(rows)} problems; some motion is free in {100 * any_free:.1f} %", columns, lines
    )
    print(f"{gain}\n")


def _chosen_free(row: Row) -> bool:
    return shortest_of_best(called(row))["free"]


def cpu_time(row: Row, motions: list[Row]) -> float:
    """CPU time of making and comparing these motions of a record [s]."""
    kinds = {motion["kind"] for motion in motions} | {FIRST}
    motion_time = sum(motion["time"] + motion["stating"] for motion in motions)
    return row["spent"]["view"] + sum(row["spent"][kind] for kind in kinds) + motion_time


def main() -> None:
    parser = argparse.ArgumentParser(description="Choosing among motions on one view, by learned confidence.")
    parser.add_argument("--rounds", type=int, default=40, help="number of problems of each family (40)")
    parser.add_argument(
        "--families",
        nargs="+",
        default=[*FAMILIES],
        help="families, or folders of MotionBenchMaker (all families)",
    )
    parser.add_argument(
        "--records", default="view_ranking.jsonl", help="file of the records (view_ranking.jsonl)"
    )
    parser.add_argument("--report", action="store_true", help="print the tables of the records")
    parser.add_argument(
        "--steps", type=int, default=STEPS, help=f"number of steps of each training ({STEPS})"
    )
    arguments = parse(parser, rounds=2, families=["rop"], steps=4)
    print(header("numba", "numpy", "onnxruntime", "torch"))
    with TemporaryDirectory() as folder:
        if arguments.smoke:
            arguments.records = f"{folder}/records.jsonl"
        if not arguments.report:
            use_processor_time()
            run(arguments)
        if arguments.report or arguments.smoke:
            report(JsonLines(Path(arguments.records)).rows, arguments.steps)


if __name__ == "__main__":
    main()
