"""Whether an embedding of the whole scene helps the diffusion model: true obstacles or point clouds.

    python benchmarks/scene_code.py [--parts data,train,report] [--rows oracle,tokens] [--out FOLDER]
        [--samples 1600000] [--plot scene_code.png]

Prints benchmarks/results/scene_code.txt and draws scene_code.png. After an interruption the same command
continues; parts and rows can run at the same time. Problems and motions are of the family rop. The networks
have no clearances as inputs and are sampled without guidance, so they know the scene only by its embedding.
Rows:

- oracle: the embedding of the true obstacles (kind, center, size and turn of each), by a perceptron that sums
  over obstacles and is trained together with the denoiser;
- tokens: points of the cloud, which the waypoints attend to, in place of one vector (config `points`);
- pointnet: PointNet, trained together with the denoiser;
- cae: the paper's auto-encoder, trained alone first, then frozen.

Each network is sampled with the embedding of the problem's own scene, with that of another problem's scene,
with the mean embedding, and with a hidden condition, as in a tenth of its training. Start and goal stay
visible in the noisy motion.
"""

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Float32
from matplotlib.figure import Figure
from numpy import ndarray
from safetensors import safe_open
from safetensors.torch import save
from torch import Tensor, nn

from common import FIRST, header, parse, parts_of, print_table, progress, use_processor_time
from robotdiffuse.baselines.controls import smooth_noise
from robotdiffuse.core.files import JsonLines, write_atomically
from robotdiffuse.datasets.shards import SPLITS, read_rows, read_shard, shard_indices
from robotdiffuse.evaluation.bench_comparisons import bootstrap_interval
from robotdiffuse.evaluation.runs import case_file, validated, validator
from robotdiffuse.generation.aorrtc_solver import AORRTCSearchSettings
from robotdiffuse.generation.factory import GenerationSettings, generate
from robotdiffuse.learning.checkpoint import load_encoder
from robotdiffuse.learning.denoisers import (
    CrossAttentionSettings,
    DenoiserSettings,
    TransformerSettings,
)
from robotdiffuse.learning.diffusion import ddim
from robotdiffuse.learning.encoders import EncoderSettings, PointNetSettings, PointsSettings, make_encoder
from robotdiffuse.learning.encoders.networks import Encoder, fp32, perceptron, wave_angles
from robotdiffuse.learning.motion_network import MotionNetwork
from robotdiffuse.learning.training.batches import Batch, scene_clouds
from robotdiffuse.learning.training.config import JOINT_POINT_COLLISION, EncoderTraining, PlannerTraining
from robotdiffuse.learning.training.loop import Processes, Validation, train
from robotdiffuse.learning.training.tasks import PlannerTask, model_settings, train_encoder
from robotdiffuse.learning.weight_files import RobotIdentity
from robotdiffuse.planning.search.rrt import AORRTC
from robotdiffuse.problems.files import Case, goal_of
from robotdiffuse.problems.problem import Problem
from robotdiffuse.robots import load_robot
from robotdiffuse.scenes.packed_scenes import BOX, SPHERE, PackedScenes

PANDA = load_robot("panda")
FAMILY = "rop"
PARTS = ("data", "train", "report")
SEARCH_TIME = 3.0
"""CPU time in which a search must solve a problem for it to count as solvable [s]."""
SAMPLING_STEPS = 6
BEST_OF = 16
"""Samples for each problem in the report."""
# Number of problems on which a checkpoint is tried during training, and of samples for each problem.
CURVE_PROBLEMS = 100
CURVE_SAMPLES = 4
WAYPOINTS = 48
ERROR_LEVELS = (200, 150, 100, 50)
"""Noise levels at which predictions are compared; level 200 is pure noise."""
EMBEDDINGS = ("own", "another scene's", "mean", "hidden")
CHUNK = 256
"""Samples that go through a network together."""
DECISIVE = 10.0
"""An embedding of the scene counts as useful if the oracle's own embedding beats its mean embedding by this
[percentage points]."""


# What the networks see of a scene


def obstacle_numbers(scenes: PackedScenes) -> Float32[Tensor, "n slots 9"]:
    """Nine numbers for each obstacle: whether it is a sphere, whether it is a cube, its center and half width
    [m], sine and cosine of four times its turn about the vertical, and 1 if the obstacle exists. Four times,
    since a cube looks the same after a quarter turn."""
    kinds = scenes.kinds
    params = scenes.params
    sphere = kinds == SPHERE
    box = kinds == BOX
    half = np.where(sphere, params[..., 3], params[..., 3] / 2)
    turn = np.where(box, 8 * np.arctan2(params[..., 9], params[..., 6]), 0.0)
    columns = (
        sphere,
        box,
        *np.moveaxis(params[..., :3], -1, 0),
        half,
        box * np.sin(turn),
        box * np.cos(turn),
    )
    numbers = np.stack([*columns, sphere | box], -1).astype(np.float32)
    return torch.from_numpy(numbers)


class ObstacleCode(Encoder):
    """z = MLP(sum over obstacles of MLP(numbers of the obstacle)): the order of obstacles does not matter."""

    OCTAVES = 3
    """Number of wavelengths (4 m, 2 m, 1 m) of the sines and cosines of the center, which are further
    inputs."""

    def __init__(self, settings: EncoderSettings) -> None:
        super().__init__(settings)
        self.each = nn.Sequential(perceptron(9 + 6 * self.OCTAVES, 192, 192), nn.GELU("tanh"))
        self.all = perceptron(192, 192, settings.code)

    def forward(self, cloud: Float[Tensor, "batch slots 9"]) -> Float[Tensor, "batch embedding"]:
        with fp32(cloud):
            angles = torch.cat(wave_angles(cloud[..., 2:5], self.OCTAVES), -1)
            known = torch.cat([cloud, angles.sin(), angles.cos()], -1)
            return self.all((self.each(known) * cloud[..., -1:]).sum(1))


class Row(NamedTuple):
    title: str
    encoder: str | None
    """Name of the encoder in the training settings; None: the auto-encoder that this script trains."""
    settings: EncoderSettings | None = None
    """Settings of this encoder."""
    denoiser: str = "transformer"
    denoiser_settings: DenoiserSettings = TransformerSettings(patch=8)


ROWS = {
    "oracle": Row("true obstacles, one embedding", "pointnet", PointNetSettings()),
    "tokens": Row(
        "32 points, attended to", "points", PointsSettings(), "cross_attention", CrossAttentionSettings()
    ),
    "pointnet": Row("PointNet, trained along", "pointnet", PointNetSettings()),
    "cae": Row("the paper's auto-encoder, frozen", None),
}


def with_parts_of(row: str, model: MotionNetwork) -> MotionNetwork:
    """The model with the encoder of a row that the package does not have."""
    settings = model.settings.encoder_settings
    assert settings is not None
    if row == "oracle":
        model.encoder = ObstacleCode(settings)
    return model


def seen(row: str, encoder: Encoder, scenes: PackedScenes, rng: np.random.Generator) -> Tensor:
    """The inputs of the encoder of a row, for scenes."""
    return obstacle_numbers(scenes) if row == "oracle" else scene_clouds(encoder, scenes, rng)


# Data, training


@dataclass(frozen=True)
class Study:
    """The folders and sizes of a run of this script."""

    out: Path
    trajectories: int
    samples: int
    encoder_samples: int
    problems: int

    @property
    def data(self) -> Path:
        return self.out / "data"

    def folder(self, row: str) -> Path:
        return self.out / row

    @property
    def encoder(self) -> Path:
        return self.out / "encoder"

    def generate(self) -> None:
        """Make the motions; they keep a distance of 6 cm to obstacles where start and goal allow it."""
        search = AORRTCSearchSettings(safety_distance=0.06, patience=500, tries=500, gain=0.03)
        settings = GenerationSettings(
            trajectories=self.trajectories,
            seed=30,
            trivial_share=0.05,
            target="pose",
            goals=1,
            waypoints=WAYPOINTS,
            shard=min(1000, self.trajectories),
            planner="aorrtc",
            search=search,
        )
        generate(settings, self.data)

    def cases(self, max_count: int | None = None) -> list[Case]:
        """Held-out problems that the straight line does not solve and a search does."""
        count = self.problems if max_count is None else min(max_count, self.problems)
        return case_file(self.out / "problems", FAMILY).held_out(FAMILY, count, validator, first_length)

    def training(self, row: str) -> PlannerTraining:
        spec = ROWS[row]
        return PlannerTraining(
            encoder=str(self.encoder) if spec.encoder is None else spec.encoder,
            encoder_settings=spec.settings,
            data=str(self.data),
            minutes=None,
            samples=self.samples,
            clearance_features=False,
            condition_drop=0.1,
            losses=JOINT_POINT_COLLISION,
            turned_copies=15,
            denoiser=spec.denoiser,
            denoiser_settings=spec.denoiser_settings,
            checkpoint_seconds=300.0,
            device="cpu",
        )

    def train(self, row: str) -> None:
        if ROWS[row].encoder is None and not (self.encoder / "encoder.json").exists():
            training = EncoderTraining(
                name="compression_autoencoder", minutes=None, samples=self.encoder_samples, max_obstacles=2
            )
            train_encoder(training, str(self.encoder))
        settings = self.training(row)
        processes = Processes("cpu")
        train(SceneTask(row, self, settings, processes), str(self.folder(row)))

    def trained(self, row: str) -> tuple[MotionNetwork, int]:
        """The network with the averaged weights of the newest checkpoint, and the number of samples that its
        training saw."""
        settings = self.training(row)
        if settings.jointly:
            assert settings.encoder is not None
            encoder = make_encoder(settings.encoder, settings.encoder_settings)
        else:
            encoder = load_encoder(str(self.encoder))
        model = MotionNetwork(RobotIdentity.of(PANDA), model_settings(settings, encoder))
        model.encoder = encoder
        model = with_parts_of(row, model)
        with safe_open(self.folder(row) / "averaged.safetensors", "pt") as stored:
            model.load_state_dict({name: stored.get_tensor(name) for name in stored.keys()})  # noqa: SIM118
            return model.requires_grad_(False).eval(), int(stored.metadata()["samples"])


def first_length(problem: Problem) -> float | None:
    return AORRTC().plan(problem, SEARCH_TIME, seed=1, clearance=0.0, until=FIRST).path_length


class SceneTask(PlannerTask):
    """The training of a row, which tries the network on held-out problems at every checkpoint."""

    def __init__(self, row: str, study: Study, settings: PlannerTraining, processes: Processes) -> None:
        super().__init__(settings, processes)
        self.row = row
        self.study = study
        self.cases = study.cases(CURVE_PROBLEMS)
        with_parts_of(row, self.model)
        self.identity = {"robot": PANDA.name, "row": row}
        if row == "oracle":
            loss = self._loss
            encoded = np.zeros((1, self.model.settings.code), np.float16)  # no clouds need to be made
            self.train_data, self.validation_data = (
                replace(data, embeddings=np.broadcast_to(encoded, (len(data), encoded.shape[1])))
                for data in (self.train_data, self.validation_data)
            )

            def loss_of_oracle(batch: Batch, *rest: Any) -> Tensor:
                return loss(replace(batch, clouds=obstacle_numbers(batch.scenes)), *rest)

            self._loss = loss_of_oracle

    def validate(self, fraction: float) -> Validation:
        """Adds to the learning curve, and keeps the averaged weights."""
        samples = round(fraction * (self.settings.samples or 0))
        folder = self.study.folder(self.row)
        notes = {"samples": samples, "motions": len(self.train_data)}
        weights = {name: tensor.contiguous() for name, tensor in self.model.state_dict().items()}
        content = save(weights, metadata={"samples": str(samples)})
        write_atomically(folder / "averaged.safetensors", content, make_folder=True)
        passed_by_code = tried(self.row, self.model, self.cases, ("own", "hidden"), CURVE_SAMPLES)
        shares = {name: float(passed.mean()) for name, passed in passed_by_code.items()}
        JsonLines(folder / "curve.jsonl").append(notes | shares)
        return Validation(super().validate(fraction).loss, shares["own"])

    def success(self, rng: np.random.Generator) -> None:
        """Does nothing: `validate` measures success on held-out problems."""

    def save(self, folder: Path, training: dict[str, Any]) -> None:
        """Does nothing: `validate` saves the weights."""


# Evaluation


class Results(NamedTuple):
    samples: int
    """Number of training samples that the network saw."""
    passed: dict[str, Float[ndarray, "n count"]]
    """For each kind of embedding, which samples for each problem pass the validator."""


def tried(
    row: str, model: MotionNetwork, cases: Sequence[Case], embeddings: Sequence[str], count: int
) -> dict[str, Float[ndarray, "n count"]]:
    """For each kind of embedding, which of `count` samples for each problem pass the validator."""
    scenes = PackedScenes.pack([case.problem.scene for case in cases], 2, floor=True)
    assert model.encoder is not None
    z = embeddings_of(row, model.encoder, scenes)
    passed_by_code = {}
    for name in embeddings:
        q = sampled_motions(model, cases, z[name], count, hidden=name == "hidden")
        pairs = zip(cases, q, strict=True)
        passed_by_code[name] = np.array(
            [validated(case.problem, motions).passed for case, motions in pairs], float
        )
    return passed_by_code


def no_clearances(q: ndarray) -> ndarray:
    """The networks have no clearances as inputs."""
    return np.zeros(0, np.float32)


def embeddings_of(
    row: str, encoder: Encoder, scenes: PackedScenes
) -> dict[str, Float32[ndarray, "n embedding"]]:
    """The embedding of each scene, for each kind of EMBEDDINGS; for "hidden" it is not used."""
    with torch.no_grad():
        z = encoder(seen(row, encoder, scenes, np.random.default_rng(5))).numpy().astype(np.float32)
    return dict(zip(EMBEDDINGS, (z, np.roll(z, 1, 0), np.repeat(z.mean(0)[None], len(z), 0), z), strict=True))


def sampled_motions(
    model: MotionNetwork, cases: Sequence[Case], z: Float32[ndarray, "n embedding"], count: int, hidden: bool
) -> Float[ndarray, "n count waypoints dof"]:
    """Samples for each problem with its embedding, or with the condition hidden."""
    rng = np.random.default_rng(11)
    motions = []
    each = max(CHUNK // count, 1)
    starts, goals = (
        np.array([end(case.problem) for case in cases]) for end in (lambda problem: problem.start, goal_of)
    )
    for i in range(0, len(cases), each):
        start, goal, embedding = (np.repeat(part[i : i + each], count, 0) for part in (starts, goals, z))
        reference = model.reference(start, goal)
        condition = model.condition(embedding, start, goal)
        predict = model.predictor(reference, condition, no_clearances, 0.0 if hidden else 1.0)
        x = ddim(predict, model.schedule, partial(model.draw_noise, len(start), rng), SAMPLING_STEPS)
        q = np.clip(model.joints(x, reference), PANDA.lower, PANDA.upper)
        motions.append(q.reshape(-1, count, *q.shape[1:]))
    return np.concatenate(motions)


def results(row: str, study: Study, cases: Sequence[Case], embeddings: Sequence[str]) -> Results:
    """The results of the newest checkpoint with each embedding. They are cached in the folder of the row."""
    model, samples = study.trained(row)
    passed_by_code = {}
    for name in embeddings:
        file = study.folder(row) / "tried" / f"{samples}_{len(cases)}_{EMBEDDINGS.index(name)}.npy"
        if not file.exists():
            file.parent.mkdir(exist_ok=True)
            np.save(file, tried(row, model, cases, [name], BEST_OF)[name])
        passed_by_code[name] = np.load(file)
    return Results(samples, passed_by_code)


def errors(row: str, study: Study) -> list[tuple[str, ...]]:
    """Rows of the table of errors: the squared error of predicted motions, for each noise level and
    embedding."""
    model, _ = study.trained(row)
    q, scenes = validation_motions(study.data)
    assert model.encoder is not None
    z = embeddings_of(row, model.encoder, scenes)
    reference = model.reference(q[:, 0], q[:, -1])
    clean = model.normalize(q, reference)
    rows = []
    for level in ERROR_LEVELS:
        noise = model.draw_noise(len(q), np.random.default_rng(1))
        signal, deviation = (float(levels[level]) for levels in (model.schedule.signal, model.schedule.noise))
        noisy = (signal * clean + deviation * noise).astype(np.float32)
        squared_errors = []
        for name, embedding in z.items():
            condition = model.condition(embedding, q[:, 0], q[:, -1])
            predict = model.predictor(reference, condition, no_clearances, 0.0 if name == "hidden" else 1.0)
            squared_errors.append(f"{np.square(predict(noisy, level) - clean)[:, 1:-1].mean():.3f}")
        rows.append((f"{ROWS[row].title}: level {level}", *squared_errors))
    return rows


def validation_motions(data: Path) -> tuple[Float32[ndarray, "n waypoints dof"], PackedScenes]:
    """Motions of scenes that no training saw; the straight line is not free."""
    motions = []
    scenes = []
    for rows in read_rows(data, PANDA, WAYPOINTS):
        chosen = (rows.split != SPLITS.index("train")) & ~rows.shard["line_free"]
        motions.append(rows.q[chosen])
        scenes.append(rows.scenes[chosen])
    return np.concatenate(motions), PackedScenes.joined(scenes)


def without_network(cases: Sequence[Case]) -> Float[ndarray, "n count"]:
    """Which samples of smooth noise about the straight line pass."""
    rng = np.random.default_rng(5)
    passed = []
    for case in progress(cases, "smooth noise"):
        ends = case.problem.start, goal_of(case.problem)[None]
        passed.append(validated(case.problem, smooth_noise(*ends, BEST_OF, WAYPOINTS, PANDA, rng)).passed)
    return np.array(passed, float)


def in_points(values: Float[ndarray, "n"], sign: str = "") -> str:
    """A mean in per cent, or a difference in percentage points, with its 95 % interval over problems."""
    low, high = (100 * x for x in bootstrap_interval(values))
    return f"{100 * values.mean():{sign}.1f} ({low:{sign}.1f} to {high:{sign}.1f})"


def report(study: Study, rows: Sequence[str], plot: Path) -> None:
    """Print the tables and draw the learning curves of the rows that have a checkpoint."""
    rows = [row for row in rows if (study.folder(row) / "averaged.safetensors").exists()]
    cases = study.cases()
    table = []
    worth = []
    conclusion = ""
    for row in progress(rows, "networks"):
        samples, passed_by_code = results(row, study, cases, EMBEDDINGS)
        for name, passed in passed_by_code.items():
            single = passed.mean(1)
            best = passed.max(1)
            table.append((f"{ROWS[row].title}: {name}", f"{samples:,}", in_points(single), in_points(best)))
        own_code = passed_by_code["own"]
        mean_code = passed_by_code["mean"]
        for name in EMBEDDINGS[1:]:
            less = (
                own_code.mean(1) - passed_by_code[name].mean(1),
                own_code.max(1) - passed_by_code[name].max(1),
            )
            worth.append((f"{ROWS[row].title}: over {name}", *(in_points(part, "+") for part in less)))
        if row == "oracle":
            points = 100 * float(own_code.mean() - mean_code.mean())
            verdict = "can matter" if points >= DECISIVE else "is the bottleneck so far, not its encoder"
            over = in_points(own_code.mean(1) - mean_code.mean(1), "+")
            conclusion = (
                f"After {samples:,} training samples the oracle's own embedding is worth {over} percentage "
                f"points of single samples over the mean embedding of the same network: an embedding of the "
                f"whole scene {verdict}."
            )
    noise = without_network(cases)
    table.append(("no network: smooth noise", "", in_points(noise.mean(1)), in_points(noise.max(1))))
    print_table(
        f"{len(cases)} held-out problems of {FAMILY}, {BEST_OF} samples each, no guidance: passed, %",
        ["network: embedding", "training samples", "single (95 %)", f"best of {BEST_OF} (95 %)"],
        table,
    )
    print_table(
        "The own embedding over others in the same network, paired, percentage points",
        ["network", "single (95 %)", f"best of {BEST_OF} (95 %)"],
        worth,
        (conclusion,) if conclusion else (),
    )
    print_table(
        "Error of predicted motions of unseen scenes: squared, in units of the motions' variance",
        ["network: noise level", *EMBEDDINGS],
        [line for row in rows for line in errors(row, study)],
    )
    curves = {row: curve(study, row) for row in rows}
    print_table(
        f"Learning curves: single samples that pass, %, on {min(CURVE_PROBLEMS, len(cases))} of the problems",
        ["network", "training samples", "own embedding", "hidden"],
        [
            (ROWS[row].title, f"{at['samples']:,}", f"{100 * at['own']:.1f}", f"{100 * at['hidden']:.1f}")
            for row, points in curves.items()
            for at in points
        ],
    )
    draw(curves, plot)


def curve(study: Study, row: str) -> list[dict[str, Any]]:
    """The learning curve of a row, by training samples. If an interruption led to two entries for one number
    of samples, the later one counts."""
    by_samples = {at["samples"]: at for at in JsonLines(study.folder(row) / "curve.jsonl").rows}
    return [by_samples[samples] for samples in sorted(by_samples)]


COLORS = ("#14487f", "#d1495b", "#3f7fc4", "#8a94a3")


def draw(curves: dict[str, list[dict[str, Any]]], file: Path) -> None:
    """Draw single-sample success over training samples."""
    figure = Figure(figsize=(7, 4), layout="constrained")
    axes = figure.subplots()
    for color, (row, points) in zip(COLORS, curves.items(), strict=False):
        samples = [point["samples"] / 1e3 for point in points]
        for name, line in (("own", "o-"), ("hidden", "--")):
            values = [100 * point[name] for point in points]
            label = f"{ROWS[row].title}" if name == "own" else f"{ROWS[row].title}, hidden"
            axes.plot(samples, values, line, color=color, label=label, ms=3)
    axes.set_xlabel("training samples [thousand]")
    axes.set_ylabel("single samples that pass [%]")
    axes.set_ylim(bottom=0)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, fontsize=8)
    figure.savefig(file, dpi=150)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--parts", default=",".join(PARTS))
    parser.add_argument("--rows", default=",".join(ROWS))
    parser.add_argument(
        "--out", type=Path, default=Path("runs/scene_code"), help="folder that keeps data and networks"
    )
    parser.add_argument("--trajectories", type=int, default=140_000, help="number of motions to make")
    parser.add_argument("--samples", type=int, default=1_600_000, help="number of samples of each training")
    parser.add_argument(
        "--encoder-samples", type=int, default=1_000_000, help="number of clouds for the auto-encoder"
    )
    parser.add_argument("--problems", type=int, default=300)
    parser.add_argument("--plot", type=Path, default=Path("scene_code.png"))
    arguments = parse(parser, rows="oracle,cae", trajectories=16, samples=64, encoder_samples=64, problems=1)
    use_processor_time()
    parts = parts_of(arguments.parts, PARTS)
    rows = parts_of(arguments.rows, ROWS)
    sizes = arguments.trajectories, arguments.samples, arguments.encoder_samples, arguments.problems
    study = Study(arguments.out, *sizes)
    if "data" in parts:
        study.generate()
    if "train" in parts:
        for row in rows:
            study.train(row)
    if "report" in parts:
        print(header("numpy", "torch"))
        motions = sum(len(read_shard(study.data, i, ("family",))) for i in shard_indices(study.data))
        print(f"{motions:,} motions, each in a scene of its own")
        report(study, rows, arguments.plot)


if __name__ == "__main__":
    main()
