"""Training of the completing network on fresh scenes, and how good it is on scenes that are held out."""

from dataclasses import dataclass, field
from pathlib import Path as FilePath
from typing import Annotated, Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32
from numpy import ndarray
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits

from robotdiffuse.core.settings import Count, Filled, Natural, OneOf, Positive
from robotdiffuse.learning.checkpoint import save_code, save_completion
from robotdiffuse.learning.completion.network import (
    CompletionNetwork,
    CompletionSettings,
    folded,
    reachable,
    voxel_centers,
)
from robotdiffuse.learning.completion.samples import FREE, OCCUPIED, Samples, draw_samples, unpack_fine
from robotdiffuse.learning.encoders.completing_autoencoder import (
    CompletingAutoencoder,
    CompletingAutoencoderSettings,
)
from robotdiffuse.learning.training.batches import fast_bf16, random_scenes, scene_clouds
from robotdiffuse.learning.training.config import EncoderTraining, ShareBelowOne, TrainingSettings
from robotdiffuse.learning.training.loop import Validation
from robotdiffuse.learning.training.prefetch import MOST, SamplesAhead
from robotdiffuse.learning.training.processes import Processes, on_cpu
from robotdiffuse.learning.training.task import Trainee, train
from robotdiffuse.perception.observed_volume import VOXEL
from robotdiffuse.problems.families import FAMILIES
from robotdiffuse.robots import load_robot
from robotdiffuse.robots.robot import Robot

HELD_OUT = 20261122
"""Seed of the samples that are held out; training's are drawn from other seed sequences."""
VALIDATION = 4
"""Samples of each family that are looked at at every checkpoint."""
CALIBRATION = 12
"""Samples of each family that the temperature is fitted to."""
CHECKED = 24
"""Further ones of each that the trained network is validated by."""
THRESHOLD = 0.1
"""Probability above which a voxel counts as occupied in figures."""
EACH = 17
"""One voxel of so many is what the temperature is fitted to."""
FITTED = 600
"""Scenes of either kind that the components of the code are fitted to."""
BINS = 20
"""Of probabilities, for the expected calibration error."""


@dataclass(frozen=True, kw_only=True)
class CompletionTraining(TrainingSettings):
    """Training of the network that completes what cameras see."""

    robot: str = "panda"
    """Bundled name, or path to a URDF: the arm that stands in the pictures."""
    families: Annotated[tuple[Annotated[str, OneOf(FAMILIES)], ...], Filled()] = tuple(FAMILIES)
    """Of the scenes, in equal parts."""
    minutes: Positive | None = None
    samples: Count | None = 40_000
    batch: Count = 4
    learning_rate: Positive = 1e-3
    warmup_steps: Natural = 100
    average: ShareBelowOne = 0.995
    workers: Natural = 1
    """Processes that draw samples meanwhile; 0: the training does it itself."""
    network: CompletionSettings = field(default_factory=CompletionSettings)


def train_completion(settings: CompletionTraining, out: str) -> dict[str, float]:
    """Train the network; write completion.safetensors and completion.json into the folder `out`, and the
    encoder that its bottleneck is: code.safetensors and code.json.

    The same call continues a run that was interrupted. Returns the cross-entropy per voxel on scenes that are
    held out, precision and recall by family, the expected calibration error, and `samples`. Raises as
    `trainee.train`.
    """
    processes = Processes(settings.device)
    trainee = _CompletionTrainee(settings, processes)
    try:
        return train(trainee, settings, out, processes)
    finally:
        trainee.ahead.close()


class _CompletionTrainee(Trainee):
    title = "completion"
    module: CompletionNetwork

    def __init__(self, settings: CompletionTraining, processes: Processes) -> None:
        self.settings, self.processes = settings, processes
        self.identity = {}
        self.robot = load_robot(settings.robot)
        torch.manual_seed(settings.seed)
        self.module = self._trained = CompletionNetwork(settings.network).to(processes.device)
        self.ahead = SamplesAhead(settings.families, self.robot, settings.batch, settings.workers)
        self._reachable, self._above = reachable(), voxel_centers()[..., 2] > VOXEL / 2
        self._kept = self._held_out(settings.families, 0, VALIDATION)
        self._figures: dict[str, Any] = {}

    def loss(self, fraction: float, rng: np.random.Generator) -> Float[Tensor, ""]:
        return self._loss(self.ahead.next(rng))

    def validate(self, fraction: float) -> Validation:
        with torch.no_grad():
            parts = [self._loss(part).item() for part in _split(self._kept)]
        return Validation(float(np.mean(parts)))

    def finish(self) -> dict[str, float]:
        network = self._trained = on_cpu(self.module)
        families = self.settings.families
        loss = self.validate(1.0).loss
        logits, truth, _ = self._answers(self._held_out(families, VALIDATION, CALIBRATION))
        with torch.no_grad():
            network.temperature.fill_(fitted_temperature(logits[::EACH], truth[::EACH]))
        report = {"validation": loss, "temperature": float(network.temperature)}
        all_p, all_truth = [], []
        for name in FAMILIES:
            held_out = self._held_out((name,), VALIDATION + CALIBRATION, CHECKED)
            logits, truth, unknown = self._answers(held_out)
            p = 1 / (1 + np.exp(-logits / float(network.temperature)))
            p, truth = p[unknown], truth[unknown]
            called = p > THRESHOLD
            right = float((called & truth).sum())
            report[f"precision {name}"] = right / max(1.0, float(called.sum()))
            report[f"recall {name}"] = right / max(1.0, float(truth.sum()))
            report[f"average precision {name}"] = average_precision(p, truth)
            report[f"calibration error {name}"] = calibration_error(p, truth)
            if name in families:
                all_p.append(p)
                all_truth.append(truth)
        p, truth = np.concatenate(all_p), np.concatenate(all_truth)
        report["calibration error"] = calibration_error(p, truth)
        self._figures = {"reliability": reliability(p, truth)}
        self._code = fitted_code(network, families, self.robot)
        return report

    def about(self) -> dict[str, Any]:
        return self._figures

    def save(self, folder: FilePath, training: dict[str, Any]) -> None:
        save_completion(self._trained, folder, training)
        save_code(self._code, folder)

    def _held_out(self, families: tuple[str, ...], first: int, count: int) -> Samples:
        """So many samples of each family, from this number on."""
        parts = []
        for name in families:
            place = list(FAMILIES).index(name)
            rng = np.random.default_rng([HELD_OUT, place])
            seeds = rng.integers(MOST, size=first + count)[first:]
            parts.append(draw_samples((name,), self.robot, seeds.tolist()))
        return Samples(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))

    def _counts(self, samples: Samples) -> Bool[ndarray, "n 56 56 32"]:
        """Which voxels are asked about: those that are not seen free, within the arm's reach."""
        return ((samples.seen & FREE) == 0) & self._reachable

    def _rows(self, samples: Samples, counts: Bool[ndarray, "n 56 56 32"]) -> tuple[Tensor, Tensor, Tensor]:
        """Logits [m 8] and truth [m 8] of the voxels that count, and the order that they come in [m]."""
        counted = folded(torch.from_numpy(counts)).reshape(-1).nonzero()[:, 0]
        truth = folded(torch.from_numpy(samples.truth)).reshape(-1)[counted].numpy()
        device = self.processes.device
        with self.processes.autocast():
            seen, behind = (torch.from_numpy(a).to(device) for a in (samples.seen, samples.behind))
            logits = self.module(seen, behind)
        rows = logits.reshape(-1, 8).index_select(0, counted.to(device))
        return rows.float(), torch.from_numpy(unpack_fine(truth)).to(device), counted

    def _loss(self, samples: Samples) -> Float[Tensor, ""]:
        logits, truth, _ = self._rows(samples, self._counts(samples))
        return binary_cross_entropy_with_logits(logits, truth.float())

    def _answers(
        self, samples: Samples
    ) -> tuple[Float32[ndarray, "m"], Bool[ndarray, "m"], Bool[ndarray, "m"]]:
        """Logits and truth of the voxels that are asked about; which of them are unknown and above ground."""
        found: list[tuple[ndarray, ndarray, ndarray]] = []
        for part in _split(samples):
            hidden = ((part.seen & OCCUPIED) == 0) & self._above
            with torch.no_grad():
                logits, truth, counted = self._rows(part, self._counts(part))
            unknown = folded(torch.from_numpy(hidden)).reshape(-1)[counted].numpy().repeat(8)
            found.append((logits.cpu().numpy().ravel(), truth.cpu().numpy().ravel(), unknown))
        logits, truth, unknown = (np.concatenate(parts) for parts in zip(*found, strict=True))
        return logits, truth, unknown


def fitted_code(network: CompletionNetwork, families: tuple[str, ...], robot: Robot) -> CompletingAutoencoder:
    """The encoder that the bottleneck of a trained network is, its components fitted to FITTED scenes that
    views saw a part of, and to as many that are known as clouds."""
    kept = min(CompletingAutoencoderSettings.kept, network.settings.channels[-1])
    encoder = CompletingAutoencoder(CompletingAutoencoderSettings(kept=kept, network=network.settings)).eval()
    encoder.network = network
    rng = np.random.default_rng([HELD_OUT, len(FAMILIES)])
    views = draw_samples(families, robot, rng.integers(MOST, size=FITTED).tolist())
    scenes = random_scenes(FITTED, EncoderTraining.max_obstacles, rng)
    clouds = encoder.volume(scene_clouds(encoder, scenes, rng))
    volumes = torch.cat([torch.from_numpy(views.seen), clouds])
    behind = torch.cat([torch.from_numpy(views.behind), torch.zeros_like(clouds)])
    with torch.no_grad():
        with torch.autocast("cpu", torch.bfloat16, enabled=fast_bf16()):
            features = encoder.bottleneck(volumes, behind)
        encoder.fit(features.float())
    return encoder


def _split(samples: Samples, size: int = 4) -> list[Samples]:
    return [Samples(*(array[i : i + size] for array in samples)) for i in range(0, len(samples.seen), size)]


def fitted_temperature(logits: Float32[ndarray, "m"], truth: Bool[ndarray, "m"]) -> float:
    """What logits are divided by so that their cross-entropy is least (Guo et al. 2017)."""
    from scipy.optimize import minimize_scalar

    sign = np.where(truth, -1.0, 1.0).astype(np.float32)

    def loss(log_t: float) -> float:
        return float(np.logaddexp(0, sign * logits * np.float32(np.exp(-log_t))).mean())

    found: Any = minimize_scalar(loss, bounds=(-1.5, 1.5), method="bounded")
    return float(np.exp(found.x))


def reliability(p: Float32[ndarray, "m"], truth: Bool[ndarray, "m"]) -> list[list[float]]:
    """By bin of the stated probability: its mean, the share that is true, and how many voxels."""
    which = np.minimum((p * BINS).astype(int), BINS - 1)
    count = np.bincount(which, minlength=BINS)
    stated, found = (np.bincount(which, values, BINS) / np.maximum(count, 1) for values in (p, truth))
    rows = zip(stated.tolist(), found.tolist(), count.tolist(), strict=True)
    return [[round(a, 4), round(b, 4), float(n)] for a, b, n in rows]


def calibration_error(p: Float32[ndarray, "m"], truth: Bool[ndarray, "m"]) -> float:
    """Expected difference between the stated probability and the share that is true, over the bins."""
    rows = np.array(reliability(p, truth))
    return float((np.abs(rows[:, 0] - rows[:, 1]) * rows[:, 2]).sum() / max(1.0, rows[:, 2].sum()))


def average_precision(p: Float32[ndarray, "m"], truth: Bool[ndarray, "m"]) -> float:
    """Mean precision over all thresholds, each weighted by what it adds to the recall."""
    order = np.argsort(-p, kind="stable")
    hits = np.cumsum(truth[order])
    precision = hits / np.arange(1, len(hits) + 1)
    return float(precision[truth[order]].mean()) if truth.any() else 0.0
