"""What config `paper` has learned: samples of its network compared with controls that need no network.

    python benchmarks/paper_config.py [--problems 300] [--samples 2] [--data BEFORE AFTER] [--out FOLDER]

Prints benchmarks/results/paper_config.txt. The weights are those in paper_weights, the problems those of
scene_code.py. Samples have no guidance and six denoising steps, as in the validations of the training. If
--data names the two data sets of the training, the network and the controls are also tried on the problems of
these validations, and the controls are drawn into paper_config.png beside the learning curve,
paper_config.csv. The first 5,000 motions of a data set are enough.
"""

import argparse
from collections.abc import Callable, Sequence
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
from robotdiffuse.learning.training.tasks import CHECK_STEP, planning_success
from robotdiffuse.problems.files import goal_of
from robotdiffuse.scenes.packed_scenes import PackedScenes
from robotdiffuse.scenes.scene import Scene
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
VALIDATION_SAMPLES = 4
DATA_CHANGE = 1.2
"""Training samples after which the training went on with its second data set [million]."""
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


def free(scene: Scene, motions: Float[ndarray, "count waypoints dof"]) -> Float[ndarray, "count"]:
    """1 for each motion whose checked configurations do not collide, as in the training's validations."""
    space = search_space(CollisionChecker(PANDA, scene), CHECK_STEP)
    return np.array([motions_free(space, q).all() for q in motions.astype(np.float32)], float)


def report(model: MotionNetwork, trained: int, study: Study, count: int) -> None:
    """Print the table of the network, which has seen `trained` samples, and of the controls."""
    cases = study.cases()
    scenes = PackedScenes.pack([case.problem.scene for case in cases], 2, floor=True)
    assert model.encoder is not None
    embeddings = embeddings_of("cae", model.encoder, scenes)
    rows = dict[str, list[ndarray]]()
    for name, title in EMBEDDINGS.items():
        z = np.split(embeddings[name], len(cases))
        each = partial(sampled_motions, model, count=count, hidden=name == "hidden")
        rows[title] = [each([case], own)[0] for case, own in zip(progress(cases, title), z, strict=True)]
    for title, candidates in controls(model).items():
        rows[title] = [candidates(case.problem.start, goal_of(case.problem)) for case in cases]
    table = []
    for title, motions in rows.items():
        checks = [validated(case.problem, q) for case, q in zip(cases, motions, strict=True)]
        pairs = zip(cases, checks, strict=True)
        is_free = np.array([free(case.problem.scene, check.waypoints) for case, check in pairs])
        passed = np.array([check.passed for check in checks], float)
        singles = (in_points(single(title, values)) for values in (is_free, passed))
        table.append((title, *singles, str(passed.shape[1]), in_points(passed.max(axis=1))))
    print_table(
        f"Config `paper` after {trained:,} samples, {len(cases)} held-out problems of rop: % (95 %)",
        ["row", "single: free", "single: passed", "candidates", "any passed"],
        table,
        [
            "Samples of the network: six denoising steps, no guidance.",
            "single: the first of the fixed vias, and otherwise the mean over the candidates.",
            "free: no collision of the covering spheres, checked as in the training. passed: by the",
            "validator, which checks the meshes and refuses motions with more than three sharp reversals.",
        ],
    )


def in_validation(model: MotionNetwork, data: str) -> tuple[float, dict[str, Float[ndarray, "n"]]]:
    """The share of the network's samples that are free on the problems of the validations; and for each
    control, the share of single candidates on each of these problems."""
    loaded = load_data(data, PANDA, model.encoder, model.waypoints, lambda text: None)
    _, held_out = loaded.split(MAX_VALIDATION_TRAJECTORIES)
    rng = np.random.default_rng(7)
    trained = planning_success(model, PANDA, held_out, VALIDATION_PROBLEMS, VALIDATION_SAMPLES, rng)
    assert trained is not None, "all held-out problems are trivial"
    shares: dict[str, list[ndarray]] = {title: [] for title in controls(model)}
    for row in np.flatnonzero(~held_out.trivial)[:VALIDATION_PROBLEMS].tolist():
        start, *_, goal = held_out.q[row].astype(np.float64)
        for title, candidates in controls(model).items():
            motions = candidates(start, goal)
            motions[:, 0] = start
            motions[:, -1] = goal
            shares[title].append(free(held_out.scenes.scene(row), motions))
    return trained, {title: single(title, np.array(values)) for title, values in shares.items()}


def draw(parts: Sequence[dict[str, Float[ndarray, "n"]]], file: Path) -> None:
    """Draw the share of free single samples over the training's samples, and the controls as lines.

    parts: the controls on the problems of the validations with the first and with the second data set.
    """
    curve = np.genfromtxt(RESULTS / "paper_config.csv", delimiter=",", names=True)
    curve = curve[~np.isnan(curve["success"])]
    figure = Figure(figsize=(7, 4), layout="constrained")
    axes = figure.subplots()
    axes.plot(
        curve["samples"] / 1e6, 100 * curve["success"], "o-", color="#14487f", ms=3, label="the network"
    )
    spans = (0.0, DATA_CHANGE), (DATA_CHANGE, curve["samples"][-1] / 1e6)
    for color, title in zip(("#d1495b", "#2f8f5b", "#8a94a3"), parts[0], strict=True):
        heights = [100 * part[title].mean() for part in parts]
        axes.plot(np.ravel(spans), np.repeat(heights, 2), color=color, ls="--", label=title)
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
    parser.add_argument("--samples", type=int, default=2, help="number of samples of the network per problem")
    parser.add_argument("--data", nargs=2, default=[], help="the data sets of the training, in order")
    parser.add_argument("--out", type=Path, default=Path("runs/scene_code"), help="folder of the problems")
    arguments = parse(parser, problems=1, samples=1)
    use_processor_time()
    notes, _, model = read()
    model = model.requires_grad_(False).eval()
    study = Study(arguments.out, 0, 0, 0, arguments.problems)
    print(header("numpy", "torch"))
    report(model, notes["at"]["samples"], study, arguments.samples)
    if arguments.data:
        shares, parts = zip(*(in_validation(model, data) for data in arguments.data), strict=True)
        rows = [("the network", *(f"{100 * share:.1f}" for share in shares))]
        rows += [(title, *(in_points(part[title]) for part in parts)) for title in parts[0]]
        print_table(
            f"Problems of the validations, {VALIDATION_PROBLEMS} of each data set: single, free, %",
            ["row", f"until {DATA_CHANGE} million samples", "after them"],
            rows,
        )
        draw(parts, RESULTS / "paper_config.png")


if __name__ == "__main__":
    main()
