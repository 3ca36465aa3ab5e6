"""What config `paper` has learned: samples of its network compared with controls that need no network.

    python benchmarks/paper_config.py [--problems 300] [--samples 4] [--data DATA] [--out FOLDER]

Prints benchmarks/results/paper_config.txt. The weights are those in paper_weights, the problems those of
scene_code.py. Samples have no guidance and six denoising steps, as in the validations of the training. If
--data names the data set of the training, the controls are also tried on the problems of these validations,
and drawn into paper_config.png beside the learning curve, paper_config.csv.
"""

import argparse
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure
from numpy import ndarray

from common import header, parse, print_table, progress, use_processor_time
from paper_weights.checkpoint import read
from robotdiffuse.baselines.controls import fixed_vias, smooth_noise
from robotdiffuse.collision import CollisionChecker
from robotdiffuse.collision.kernels.motions import motions_free
from robotdiffuse.collision.motions import search_space
from robotdiffuse.core.types import Configuration
from robotdiffuse.evaluation.runs import validated
from robotdiffuse.learning.motion_network import MotionNetwork
from robotdiffuse.learning.training.batches import load_data
from robotdiffuse.learning.training.loop import MAX_VALIDATION_TRAJECTORIES
from robotdiffuse.learning.training.tasks import CHECK_STEP
from robotdiffuse.problems.files import goal_of
from robotdiffuse.scenes.packed_scenes import PackedScenes
from scene_code import PANDA, WAYPOINTS, Study, embeddings_of, in_points, sampled_motions

RESULTS = Path(__file__).resolve().parent / "results"
BEST_OF = 16
"""Number of candidates of the controls, except of the mean pose."""
EMBEDDINGS = {
    "own": "the network",
    "another scene's": "the network, embedding of another scene",
    "hidden": "the network, condition hidden",
}
"""The rows of the network, by the embedding that it gets."""
VALIDATION_PROBLEMS = 100
Candidates = Callable[[Configuration, Configuration], Float[ndarray, "count waypoints dof"]]
"""Makes candidate motions from a start to a goal."""


def untrained(
    model: MotionNetwork, start: Configuration, goal: Configuration
) -> Float[ndarray, "1 waypoints dof"]:
    """The motion of a network whose output is zero: through the mean pose of the training's motions."""
    zeros = np.zeros((1, model.waypoints, model.dof), np.float32)
    return model.joints(zeros, model.reference(start[None], goal[None]))


def through_vias(start: Configuration, goal: Configuration) -> Float[ndarray, "count 3 dof"]:
    vias = fixed_vias(PANDA)[:BEST_OF]
    return np.stack([np.broadcast_to(start, vias.shape), vias, np.broadcast_to(goal, vias.shape)], axis=1)


def noise(
    rng: np.random.Generator, start: Configuration, goal: Configuration
) -> Float[ndarray, "count waypoints dof"]:
    return smooth_noise(start, goal[None], BEST_OF, WAYPOINTS, PANDA, rng)


def controls(model: MotionNetwork) -> dict[str, Candidates]:
    """The controls, by the names of their rows."""
    return {
        "no network: through the mean pose, as untrained": partial(untrained, model),
        "no network: through fixed vias": through_vias,
        "no network: smooth noise": partial(noise, np.random.default_rng(5)),
    }


def single(name: str, passed: Float[ndarray, "n count"]) -> Float[ndarray, "n"]:
    """The share of single candidates that pass: of the first via, or the mean over equal candidates."""
    return passed[:, 0] if "vias" in name else passed.mean(axis=1)


def report(model: MotionNetwork, trained: int, study: Study, count: int) -> None:
    """Print the table of the network, which has seen `trained` samples, and of the controls."""
    cases = study.cases()
    scenes = PackedScenes.pack([case.problem.scene for case in cases], 2, floor=True)
    assert model.encoder is not None
    embeddings = embeddings_of("cae", model.encoder, scenes)
    passed_by_row = {}
    for name, title in EMBEDDINGS.items():
        motions = [
            sampled_motions(model, [case], embeddings[name][i : i + 1], count, hidden=name == "hidden")[0]
            for i, case in enumerate(progress(cases, title))
        ]
        passed_by_row[title] = [validated(c.problem, q).passed for c, q in zip(cases, motions, strict=True)]
    for title, candidates in controls(model).items():
        passed_by_row[title] = [
            validated(case.problem, candidates(case.problem.start, goal_of(case.problem))).passed
            for case in progress(cases, title)
        ]
    rows = []
    for title, passed in passed_by_row.items():
        values = np.array(passed, float)
        best = in_points(values.max(axis=1))
        rows.append((title, in_points(single(title, values)), str(values.shape[1]), best))
    print_table(
        f"Config `paper` after {trained:,} samples, {len(cases)} held-out problems of rop: passed, %",
        ["row", "single (95 %)", "candidates", "any of them (95 %)"],
        rows,
        [
            "Samples of the network: six denoising steps, no guidance.",
            "single: the first of the fixed vias, and otherwise the mean over the candidates.",
        ],
    )


def controls_in_validation(model: MotionNetwork, data: str) -> dict[str, Float[ndarray, "n"]]:
    """For each control, the share of single candidates that are free on each problem of the validations."""
    loaded = load_data(data, PANDA, None, WAYPOINTS, print)
    _, held_out = loaded.split(MAX_VALIDATION_TRAJECTORIES)
    free: dict[str, list[ndarray]] = {title: [] for title in controls(model)}
    for row in np.flatnonzero(~held_out.trivial)[:VALIDATION_PROBLEMS].tolist():
        start, *_, goal = held_out.q[row].astype(np.float64)
        space = search_space(CollisionChecker(PANDA, held_out.scenes.scene(row)), CHECK_STEP)
        for title, candidates in controls(model).items():
            motions = candidates(start, goal).astype(np.float32)
            motions[:, 0] = start
            motions[:, -1] = goal
            free[title].append(np.array([motions_free(space, motion).all() for motion in motions], float))
    return {title: single(title, np.array(values)) for title, values in free.items()}


def draw(shares: dict[str, Float[ndarray, "n"]], file: Path) -> None:
    """Draw the share of free single samples over the training's samples, and the controls as lines."""
    curve = np.genfromtxt(RESULTS / "paper_config.csv", delimiter=",", names=True)
    curve = curve[~np.isnan(curve["success"])]
    figure = Figure(figsize=(7, 4), layout="constrained")
    axes = figure.subplots()
    axes.plot(
        curve["samples"] / 1e6, 100 * curve["success"], "o-", color="#14487f", ms=3, label="the network"
    )
    for color, (title, values) in zip(("#d1495b", "#2f8f5b", "#8a94a3"), shares.items(), strict=True):
        axes.axhline(100 * values.mean(), color=color, ls="--", label=title)
    axes.set_xlabel("training samples [million]")
    axes.set_ylabel("single samples free [%]")
    axes.set_ylim(bottom=0)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, fontsize=8)
    figure.savefig(file, dpi=150)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--problems", type=int, default=300)
    parser.add_argument("--samples", type=int, default=4, help="number of samples of the network per problem")
    parser.add_argument("--data", help="the data set of the training")
    parser.add_argument("--out", type=Path, default=Path("runs/scene_code"), help="folder of the problems")
    arguments = parse(parser, problems=1, samples=1)
    use_processor_time()
    notes, _, model = read()
    model = model.requires_grad_(False).eval()
    study = Study(arguments.out, 0, 0, 0, arguments.problems)
    print(header("numpy", "torch"))
    report(model, notes["at"]["samples"], study, arguments.samples)
    if arguments.data is not None:
        shares = controls_in_validation(model, arguments.data)
        rows = [(title, in_points(values)) for title, values in shares.items()]
        count = len(next(iter(shares.values())))
        print_table(
            f"{count} problems of the validations in the training: free, %", ["row", "single (95 %)"], rows
        )
        draw(shares, RESULTS / "paper_config.png")


if __name__ == "__main__":
    main()
