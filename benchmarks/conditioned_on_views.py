"""A diffusion model that is told what the completing network predicts: whether its code changes anything.

    python benchmarks/conditioned_on_views.py --data FOLDER --out FOLDER [--samples 1000000] [--motions 3000]
    python benchmarks/conditioned_on_views.py --report --out FOLDER

FOLDER of data: as for encoders_on_views.py. Killed, the same command goes on with what is missing.

The model of the config `compact` is trained on views of one depth camera, one of every motion: it has the
code of the completing auto-encoder, and clearances and gradients of the scene as the planner takes it, points
seen and voxels predicted by one of the assumptions' thresholds, the ends carved free; L_collision looks at the true
scene. So it has in training what it has in planning. Tried are batches of 16 on held-out problems that the
straight line does not solve and a search in the true scene does, in the scene predicted by the first assumption; the
validator has the true one. The controls are the code of another problem of the family, the condition hidden, the
clearances hidden, the weights that ship, which were trained on exact scenes, and smooth noise without a
network. `guided`: under collision guidance by the same predicted scene.
"""

import argparse
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import torch
from encoders_on_views import (
    CONTROL,
    FAMILIES,
    GUIDED,
    UNGUIDED,
    Free,
    cases,
    control,
    figures,
    print_apart,
    view_of,
)
from jaxtyping import Float
from numpy import ndarray
from report import header, print_table, progress

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.core.output_files import JsonLines, write_atomically
from robotdiffuse.evaluation.methods import nothing_near, validated
from robotdiffuse.learning.checkpoint import load_encoder, load_model
from robotdiffuse.learning.clearance_features import link_clearances
from robotdiffuse.learning.completion import predict
from robotdiffuse.learning.completion.samples import camera_view
from robotdiffuse.learning.encoders.base import Encoder
from robotdiffuse.learning.motion_model import MotionModel, MotionModelSettings
from robotdiffuse.learning.training.batches import TrajectoryData
from robotdiffuse.learning.training.config import PlannerTraining
from robotdiffuse.learning.training.configs import planner_training
from robotdiffuse.learning.training.planner import PlannerTrainee
from robotdiffuse.learning.training.processes import Processes
from robotdiffuse.learning.training.task import train
from robotdiffuse.learning.weights_registry import BUNDLED
from robotdiffuse.perception.depth_view import AssumedPoints, DepthView, SeenPoints
from robotdiffuse.perception.observed_volume import observe
from robotdiffuse.planning.diffusion.diffusion import encode
from robotdiffuse.planning.pipeline.unknown_space import assumptions_of, with_assumption
from robotdiffuse.problems.held_out import goal_of, held_out_problem
from robotdiffuse.problems.problem import PREDICTED, JointGoal, Problem
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.scene_arrays import PackedScenes

ENCODER = "completing_autoencoder"
KEPT_ASIDE = 200
"""Motions for validation."""
PART = 100
"""Motions that are prepared together, and kept in a file."""
RETRAINED, SHIPPED = "retrained", "as it ships"


def imagined_scene(problem: Problem, view: DepthView, goal: Float[ndarray, "dof"], assumption: int) -> Scene:
    """The scene that an assumption plans with, of what the view saw of the problem's scene; the floor is known."""
    known = Scene(problem.scene.shapes[:1])
    seen = Problem(problem.robot, known, problem.start, problem.goal, views=[view], unknown=PREDICTED)
    volume = observe(seen.views, seen.robot, seen.start)
    chosen = list(assumptions_of(seen, volume, predict(volume)))[assumption]
    return with_assumption(seen, chosen, goal[None]).scene


@dataclass(frozen=True, eq=False)
class ImaginedScenes(PackedScenes):
    """Scenes with what is predicted of each."""

    checkers: ndarray = field(default_factory=lambda: np.zeros(0, object))
    """[n] CollisionChecker."""

    def __getitem__(self, rows: Any) -> "ImaginedScenes":
        of = super().__getitem__(rows)
        return ImaginedScenes(of.kinds, of.params, of.floors, self.checkers[rows])


class Trainee(PlannerTrainee):
    """The diffusion model that is told of predicted scenes."""

    def __init__(self, settings: PlannerTraining, folder: Path, motions: int) -> None:
        super().__init__(settings, Processes(settings.device))
        self.kept = self._imagined(self.kept, folder / "predicted", motions)
        self.held_out = self._imagined(self.held_out, folder / "imagined_validation", KEPT_ASIDE)
        self.clearances = lambda scenes, q: told(scenes, q, self.model.settings)

    def success(self, rng: np.random.Generator) -> None:
        return None

    def grow(self) -> bool:
        return False

    def _imagined(self, data: TrajectoryData, folder: Path, count: int) -> TrajectoryData:
        """So many motions, random ones, with what a view of each says."""
        rows = np.sort(np.random.default_rng(5).permutation(len(data))[:count])
        codes, checkers, encoder = [], np.empty(len(rows), object), load_encoder(ENCODER)
        for i in progress(range(0, len(rows), PART), "predicted scenes"):
            part = prepared(folder / f"{i}.npz", data, rows[i : i + PART], i, self.robot, encoder)
            codes.append(part["codes"])
            for k in range(len(part["codes"])):
                scene = data.scenes.scene(int(rows[i + k]))
                checkers[i + k] = CollisionChecker(self.robot, stored(part, k, scene))
        scenes = data.scenes[rows]
        predicted = ImaginedScenes(scenes.kinds, scenes.params, scenes.floors, checkers)
        return replace(
            data, q=data.q[rows], scenes=predicted, trivial=data.trivial[rows], codes=np.concatenate(codes)
        )


def told(scenes: ImaginedScenes, q: ndarray, settings: MotionModelSettings) -> ndarray:
    parts = zip(scenes.checkers, q, strict=True)
    return np.concatenate([link_clearances(checker, settings)(row[None]) for checker, row in parts])


def prepared(
    file: Path, data: TrajectoryData, rows: ndarray, seed: int, robot: Any, encoder: Encoder
) -> dict[str, ndarray]:
    """Codes and predicted obstacles of views of some motions' scenes, made once."""
    if not file.is_file():
        rng = np.random.default_rng([6, seed])
        codes, points, radii, first = [], [], [], [0]
        for row in rows.tolist():
            start, goal = data.q[row][[0, -1]].astype(np.float64)
            problem = Problem(robot, data.scenes.scene(row), start, JointGoal(goal[None]))
            view = camera_view(problem.scene, robot, start, rng)
            with torch.inference_mode():
                codes.append(encoder.of_views([view], robot, start).float().numpy())
            first.append(first[-1])
            for shape in imagined_scene(problem, view, goal, int(rng.integers(4))).shapes[1:]:
                assert isinstance(shape, SeenPoints | AssumedPoints)
                points.append(shape.points)
                radii.append(np.full(len(shape.points), shape.point_radius))
                first[-1] += len(shape.points)
        content = BytesIO()
        np.savez(
            content,
            codes=np.array(codes, np.float16),
            points=np.concatenate(points).astype(np.float32),
            radii=np.concatenate(radii).astype(np.float32),
            first=np.array(first),
        )
        write_atomically(file, content.getvalue(), make_folder=True)
    with np.load(file) as arrays:
        return dict(arrays)


def stored(part: dict[str, ndarray], k: int, scene: Scene) -> Scene:
    """The predicted scene of one of them, on the same floor."""
    own = slice(*part["first"][k : k + 2])
    points, radii = part["points"][own], part["radii"][own]
    clouds = [AssumedPoints(points[radii == radius], float(radius)) for radius in np.unique(radii)]
    return Scene([*scene.shapes[:1], *clouds])


def train_model(arguments: argparse.Namespace) -> Path:
    out = Path(arguments.out) / "model"
    if not (out / "model.json").is_file():
        given = {"data": arguments.data, "samples": arguments.samples, "views": True, "turns": 0}
        settings = planner_training("compact", given | {"encoder": ENCODER})
        trainee = Trainee(settings, Path(arguments.out), arguments.motions)
        train(trainee, settings, str(out), trainee.processes)
    return out


def batches(
    model: MotionModel,
    own: Float[ndarray, "code"],
    another: Float[ndarray, "code"],
    problem: Problem,
    checker: CollisionChecker,
    seed: int,
) -> Iterator[tuple[str, Float[ndarray, "n waypoints dof"]]]:
    """What a model makes of an predicted scene, under each control."""
    start, goals, nothing = problem.start, goal_of(problem)[None], nothing_near(model)
    controls = {
        "own": (own, None),
        "another": (another, None),
        "condition hidden": (None, None),
        "clearances hidden": (own, nothing),
        "both hidden": (None, nothing),
    }
    for name, (code, clearances) in controls.items():
        for ending, planner in (("", UNGUIDED), (", guided", GUIDED)):
            rng = np.random.default_rng(seed)
            yield name + ending, planner.draw(model, checker, code, start, goals, rng, clearances)


def run(arguments: argparse.Namespace) -> None:
    kept = JsonLines(Path(arguments.out) / "records.jsonl")
    done = {(row["model"], row["family"], row["number"]) for row in kept.rows}
    models = {RETRAINED: load_model(train_model(arguments)), SHIPPED: load_model(BUNDLED / "panda")}
    encoder, todo = models[RETRAINED].encoder, cases(arguments)
    assert encoder is not None
    codes: dict[str, list[ndarray]] = {name: [] for name in models}
    checkers = list[CollisionChecker]()
    for case in progress(todo, "predicted scenes"):
        problem, view = held_out_problem(*case), view_of(*case)
        predicted = imagined_scene(problem, view, goal_of(problem), 0)
        checkers.append(CollisionChecker(problem.robot, predicted))
        with torch.inference_mode():
            codes[RETRAINED].append(encoder.of_views([view], problem.robot, problem.start).float().numpy())
        points = UNGUIDED.settings.points
        codes[SHIPPED].append(encode(models[SHIPPED], checkers[-1], points, np.random.default_rng(0)))
    for i, case in enumerate(progress(todo, "problems")):
        problem, checker, other = held_out_problem(*case), checkers[i], (i + len(FAMILIES)) % len(todo)
        for name in (*models, CONTROL):
            if (name, *case) in done:
                continue
            if name == CONTROL:
                tried = control(problem, checker, case[1])
            else:
                pair = codes[name][i], codes[name][other]
                tried = dict(batches(models[name], *pair, problem, checker, case[1]))
            passed = {which: float(validated(problem, q).passed.mean()) for which, q in tried.items()}
            kept.append({"model": name, "family": case[0], "number": case[1], "passed": passed})


def report(arguments: argparse.Namespace) -> None:
    free = dict[tuple[str, str], Free]()
    for row in JsonLines(Path(arguments.out) / "records.jsonl").rows:
        for which, passed in row["passed"].items():
            free.setdefault((row["model"], which), {})[row["family"], row["number"]] = [passed]
    of = sorted(free, key=lambda of: [RETRAINED, SHIPPED, CONTROL].index(of[0]))
    count = len(free[of[0]])
    print(header("numpy", "torch"))
    print_table(
        f"{arguments.samples:,} training samples, {arguments.motions:,} motions, problems: {count}",
        ["model", "told", "single free, % (95 %)", "best, %", *FAMILIES],
        [(*name, *figures(free[name])) for name in of],
    )
    for name in (RETRAINED, SHIPPED):
        for other in ("another", "condition hidden", "clearances hidden"):
            for ending in ("", ", guided"):
                what = f"{name}{ending}: as told less {other}"
                print_apart(what, free[name, "own" + ending], free[name, other + ending])


def main() -> None:
    parser = argparse.ArgumentParser(
        description="A diffusion model told of predicted scenes, and its controls."
    )
    parser.add_argument("--data", help="data set of motions")
    parser.add_argument("--out", required=True, help="folder for the network and records")
    parser.add_argument("--samples", type=int, default=1_000_000, help="of the training (1,000,000)")
    parser.add_argument("--motions", type=int, default=3000, help="that are trained on, 4 MB each (3,000)")
    parser.add_argument("--problems", type=int, default=200, help="(200)")
    parser.add_argument("--report", action="store_true")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    if not arguments.report:
        if arguments.data is None:
            parser.error("--data is needed but for --report")
        run(arguments)
    report(arguments)


if __name__ == "__main__":
    main()
