"""Encoders where they are all that a network has: the paper's Table 2 on views of one depth camera.

    python benchmarks/encoders_on_views.py --data FOLDER --out FOLDER [--samples 1000000] [--seeds 2]
    python benchmarks/encoders_on_views.py --report --out FOLDER

FOLDER of data: robotdiffuse data generate --planner aorrtc --target pose --goals 1 --trivial-share 0.1
--mix shelf=0.25,crate=0.25,table=0.25,clutter=0.25. Killed, the same command goes on with what is missing.

The diffusion model, trained and tried without clearances, is told what one camera sees of each scene, another
one of every motion: points, or by the completing auto-encoder the volume that they carve. Rows differ in the
encoder alone: the paper's and the completing one are frozen, PointNet and DGCNN are trained along. Tried are
16 samples, without guidance, on held-out problems of the four families that the straight line does not solve
and a search in the true scene does, and the validator has the true scene. The controls are the code of another
problem, the mean of all codes, which tells nothing, and smooth noise about the straight line, without a
network. `guided`: the same batch under collision guidance by what was seen.
"""

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from report import header, print_table, progress
from unknown import problems

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.core.output_files import JsonLines
from robotdiffuse.evaluation.methods import NETWORK_ALONE, validated
from robotdiffuse.evaluation.statistics import bootstrap_interval
from robotdiffuse.learning.checkpoint import load_model
from robotdiffuse.learning.completion.samples import camera_view
from robotdiffuse.learning.guidance import CollisionGuidance
from robotdiffuse.learning.motion_model import MotionModel
from robotdiffuse.learning.training.config import EncoderTraining
from robotdiffuse.learning.training.configs import planner_training
from robotdiffuse.learning.training.encoder import train_encoder
from robotdiffuse.learning.training.planner import train_planner
from robotdiffuse.perception.depth_view import DepthView
from robotdiffuse.planning.diffusion.hybrid import RobotDiffuse, RobotDiffuseSettings
from robotdiffuse.planning.diffusion.smooth_noise import smooth_noise
from robotdiffuse.problems.held_out import SEED, goal_of, held_out_problem
from robotdiffuse.problems.problem import Problem
from robotdiffuse.scenes.scene import Scene

FAMILIES = ("shelf", "crate", "table", "clutter")
PAPER = "compression_autoencoder"
ROWS = {
    "PointNet": "table2_pointnet",
    "DGCNN": "table2_dgcnn",
    "completing": "table2_completing",
    "the paper's": "table2_jpc",
}
CONTROL = "smooth noise"
TURNS = 2
"""Copies of each motion, turned about the vertical, with views of their own."""
BATCH = 16
STEPS = 12
"""Gradient steps that a guided batch takes, at the network's clean predictions or after smooth noise."""
UNGUIDED = RobotDiffuse(RobotDiffuseSettings(samples=BATCH, sampling_steps=6, guidance_steps=0))
GUIDED = RobotDiffuse(
    RobotDiffuseSettings(samples=BATCH, sampling_steps=6, guidance_steps=NETWORK_ALONE.guidance_steps)
)


def train(arguments: argparse.Namespace, row: str, seed: int) -> Path:
    """The folder of a trained row."""
    encoder, out = Path(arguments.out) / PAPER, Path(arguments.out) / f"{ROWS[row]}-{seed}"
    if row == "the paper's" and not (encoder / "encoder.json").is_file():
        train_encoder(
            EncoderTraining(name=PAPER, minutes=None, samples=arguments.encoder_samples), str(encoder)
        )
    if not (out / "model.json").is_file():
        given: dict[str, Any] = {"data": arguments.data, "samples": arguments.samples, "seed": seed}
        given |= {"views": True, "turns": TURNS, "validation_problems": 8}
        given |= {"encoder": str(encoder)} if row == "the paper's" else {}
        train_planner(planner_training(ROWS[row], given), str(out))
    return out


def cases(arguments: argparse.Namespace) -> list[tuple[str, int]]:
    """Family and number of each problem; kept, for finding them takes searches."""
    file = Path(arguments.out) / f"problems_{arguments.problems}.json"
    if not file.is_file():
        each = arguments.problems // len(FAMILIES)
        found = [[(family, number) for number, _ in problems(family, each, set())] for family in FAMILIES]
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(json.dumps([case for four in zip(*found, strict=True) for case in four]))
    return [(family, number) for family, number in json.loads(file.read_text())]


def view_of(family: str, number: int) -> DepthView:
    problem = held_out_problem(family, number)
    rng = np.random.default_rng([SEED, FAMILIES.index(family), number, 141])
    return camera_view(problem.scene, problem.robot, problem.start, rng)


def as_seen(problem: Problem, view: DepthView) -> CollisionChecker:
    """Obstacles as the camera sees them; the floor is known."""
    known = Scene(problem.scene.shapes[:1])
    seen = Problem(problem.robot, known, problem.start, problem.goal, views=[view])
    return CollisionChecker(problem.robot, seen.scene)


def sample(
    model: MotionModel,
    problem: Problem,
    code: Float[ndarray, "code"],
    seed: int,
    checker: CollisionChecker | None,
) -> Float[ndarray, "count waypoints dof"]:
    """A batch of motions; with a checker, under its guidance."""
    planner = UNGUIDED if checker is None else GUIDED
    checker = CollisionChecker(problem.robot, problem.scene) if checker is None else checker
    rng = np.random.default_rng(seed)
    return planner.draw(model, checker, code, problem.start, goal_of(problem)[None], rng)


def control(problem: Problem, checker: CollisionChecker, seed: int) -> dict[str, ndarray]:
    """A batch of smooth noise, and the same under guidance by what the checker knows."""
    rng, goal = np.random.default_rng(seed), goal_of(problem)
    q = smooth_noise(problem.start, goal[None], BATCH, 48, problem.robot, rng).astype(np.float64)
    return {"none": q, "none, guided": CollisionGuidance(checker, NETWORK_ALONE.guidance)(q, STEPS)[0]}


def run(arguments: argparse.Namespace) -> None:
    kept = JsonLines(Path(arguments.out) / "records.jsonl")
    done = {(r["row"], r["seed"], r["code"], r["family"], r["number"]) for r in kept.rows}
    places = {row: [train(arguments, row, seed) for seed in range(arguments.seeds)] for row in ROWS}
    todo, views = cases(arguments), {}

    def keep(row: str, seed: int, code: str, case: tuple[str, int], passed: float, hit: float) -> None:
        where = {"row": row, "seed": seed, "code": code, "family": case[0], "number": case[1]}
        kept.append({**where, "passed": passed, "collided": hit, "samples": arguments.samples})

    for case in progress(todo, "views"):
        views[case] = view_of(*case)
    for case in progress(todo, CONTROL):
        if all((CONTROL, 0, code, *case) in done for code in ("none", "none, guided")):
            continue
        problem = held_out_problem(*case)
        for code, q in control(problem, as_seen(problem, views[case]), case[1]).items():
            if (CONTROL, 0, code, *case) in done:
                continue
            verdict = validated(problem, q)
            keep(CONTROL, 0, code, case, float(verdict.passed.mean()), float(verdict.hit.mean()))
    for row, folders in places.items():
        for seed, folder in enumerate(folders):
            model = load_model(folder)
            encoder = model.encoder
            assert encoder is not None
            with torch.inference_mode():
                own = [
                    encoder.of_views([views[case]], problem.robot, problem.start).numpy()
                    for case, problem in ((case, held_out_problem(*case)) for case in todo)
                ]
            for i, case in enumerate(progress(todo, f"{row} {seed}")):
                problem = held_out_problem(*case)
                # another problem of the same family: they take turns
                codes = {
                    "own": own[i],
                    "another": own[(i + len(FAMILIES)) % len(todo)],
                    "mean": np.mean(own, axis=0),
                }
                for code, z in (codes | {"own, guided": own[i]}).items():
                    if (row, seed, code, *case) in done:
                        continue
                    checker = as_seen(problem, views[case]) if "guided" in code else None
                    verdict = validated(problem, sample(model, problem, z, case[1], checker))
                    keep(row, seed, code, case, float(verdict.passed.mean()), float(verdict.hit.mean()))


Free = dict[tuple[str, int], list[float]]
"""Family and number of each problem: the share of free samples of each training."""


def figures(free: Free) -> tuple[str, ...]:
    """Single samples with their interval, problems with a free one, and single samples of each family [%]."""
    single = np.array([np.mean(shares) for shares in free.values()])
    low, high = (100 * x for x in bootstrap_interval(single))
    best = 100 * np.mean([share > 0 for shares in free.values() for share in shares])
    of = [[shares for case, shares in free.items() if case[0] == family] for family in FAMILIES]
    families = (f"{100 * np.mean(shares):.1f}" if shares else "–" for shares in of)
    return (f"{100 * single.mean():.1f} ({low:.1f} to {high:.1f})", f"{best:.1f}", *families)


def print_apart(what: str, free: Free, other: Free) -> None:
    """By how much the same problems differ."""
    apart = np.array([np.mean(shares) - np.mean(other[case]) for case, shares in free.items()])
    low, high = (100 * x for x in bootstrap_interval(apart))
    print(f"{what} {100 * apart.mean():+.1f} points ({low:+.1f} to {high:+.1f})")


def report(out: str) -> None:
    rows = JsonLines(Path(out) / "records.jsonl").rows
    sizes = ", ".join(f"{size:,}" for size in sorted({row["samples"] for row in rows}))
    free = dict[tuple[str, str], Free]()
    collided = dict[tuple[str, str], list[float]]()
    for row in rows:
        of = row["row"], row["code"]
        free.setdefault(of, {}).setdefault((row["family"], row["number"]), []).append(row["passed"])
        collided.setdefault(of, []).append(row["collided"])
    of = sorted(free, key=lambda of: [*ROWS, CONTROL].index(of[0]))
    print(header("numpy", "torch"))
    print_table(
        f"{sizes} training samples a row, problems: {len(free[of[0]])}",
        ["encoder", "code", "runs", "single free, % (95 %)", "best, %", *FAMILIES, "collided, %"],
        [
            (
                *name,
                len(collided[name]) // len(free[name]),
                *figures(free[name]),
                f"{100 * np.mean(collided[name]):.1f}",
            )
            for name in of
        ],
    )
    for name in dict.fromkeys(row for row, _ in of if row != CONTROL):
        for other in ("another", "mean"):
            print_apart(f"{name}: own code less {other}", free[name, "own"], free[name, other])


def main() -> None:
    parser = argparse.ArgumentParser(description="Encoders on views of one depth camera.")
    parser.add_argument("--data", help="data set of motions")
    parser.add_argument("--out", required=True, help="folder for networks and records")
    parser.add_argument("--samples", type=int, default=1_000_000, help="of each row's training (1,000,000)")
    parser.add_argument("--encoder-samples", type=int, default=150_000, help="of the paper's (150,000)")
    parser.add_argument("--seeds", type=int, default=2, help="trainings of each row (2)")
    parser.add_argument("--problems", type=int, default=200, help="(200)")
    parser.add_argument("--report", action="store_true")
    arguments = parser.parse_args()
    if not arguments.report:
        if arguments.data is None:
            parser.error("--data is needed but for --report")
        torch.set_num_threads(1)
        run(arguments)
    report(arguments.out)


if __name__ == "__main__":
    main()
