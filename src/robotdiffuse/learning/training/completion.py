"""Training of the occupancy completion network on random scenes, and its figures on held-out scenes."""

import copy
import os
from collections.abc import Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field
from functools import partial
from typing import Annotated, Any

import numpy as np
import torch
from jaxtyping import Bool, Float32
from numpy import ndarray
from numpy.random import Generator
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits

from robotdiffuse.core.errors import InputError, shown
from robotdiffuse.core.settings import Count, Filled, Natural, OneOf, Positive, ShareBelowOne
from robotdiffuse.learning.checkpoint import load_completion
from robotdiffuse.learning.completion import (
    FREE,
    OCCUPIED,
    CompletionSettings,
    Samples,
    draw_samples,
    reachable,
    unpack_fine,
    voxel_centers,
)
from robotdiffuse.learning.completion_network import CompletionNetwork, folded
from robotdiffuse.learning.network import Scalar
from robotdiffuse.learning.training.config import TrainingSettings
from robotdiffuse.learning.training.loop import Processes, TrainingTask, Validation, train
from robotdiffuse.perception.voxel_grid import VOXEL
from robotdiffuse.problems.families import FAMILIES
from robotdiffuse.processes.workers import EndedError, NotStartedError, Workers
from robotdiffuse.robots import load_robot
from robotdiffuse.robots.robot import Robot

Floats = Float32[ndarray, "m"]
Flags = Bool[ndarray, "m"]
NICENESS = 5
"""Niceness of the workers: the training process has priority."""
BATCHES_AHEAD = 3
"""Number of batches that are drawn in advance for each worker."""
SEED_LIMIT = 2**62
"""Upper bound of the seeds of samples."""


class SamplePrefetcher:
    """Draws batches of samples in advance, in worker processes.

    The seeds of the next batches are drawn from a copy of the training's random number generator, so that a
    resumed run has the same batches. The training must use this generator for nothing else.
    """

    def __init__(self, families: Sequence[str], robot: Robot, batch: int, workers: int) -> None:
        """batch: number of samples in a batch. workers: number of worker processes; 0: `next` draws the
        samples itself."""
        self._draw = partial(draw_samples, tuple(families), robot)
        self._batch = batch
        self._count, self._workers = workers, Workers(workers, partial(os.nice, NICENESS))
        self._pending = dict[tuple[int, ...], Future[Samples]]()
        """Batches that are being drawn, by their seeds."""

    def next(self, rng: Generator) -> Samples:
        """The batch of samples with the seeds that `rng` draws."""
        if not self._count:
            return self._draw(self._seeds(rng))
        following = copy.deepcopy(rng)
        upcoming = [self._seeds(following) for _ in range(1 + BATCHES_AHEAD * self._count)]
        self._pending = {
            seeds: self._pending.get(seeds) or self._workers.submit(self._draw, seeds) for seeds in upcoming
        }
        seeds = self._seeds(rng)
        try:
            return self._pending[seeds].result()
        except NotStartedError:
            raise
        except EndedError:  # killed, perhaps by the SIGTERM after which the training stores a checkpoint
            return self._draw(seeds)

    def close(self) -> None:
        """Stop the workers."""
        self._workers.close()

    def _seeds(self, rng: Generator) -> tuple[int, ...]:
        return tuple(rng.integers(SEED_LIMIT, size=self._batch).tolist())


BUNDLED_WEIGHTS = "bundled"
"""Name of the weights that come with the package."""
HELD_OUT_SEED = 20261122
"""Seed of the held-out samples; training samples are drawn from other seed sequences."""
VALIDATION_SAMPLES = 4
"""Number of held-out samples of each family for the validation at every checkpoint."""
CALIBRATION_SAMPLES = 12
"""Number of held-out samples of each family to which the temperature is fitted."""
TEST_SAMPLES = 24
"""Number of held-out samples of each family on which the trained network is measured."""
OCCUPIED_PROBABILITY = 0.1
"""Voxels above this probability count as occupied in precision and recall."""
CALIBRATION_STRIDE = 17
"""The temperature is fitted to one voxel out of this many."""
CALIBRATION_BINS = 20
"""Number of bins of probabilities for the expected calibration error."""


@dataclass(frozen=True, kw_only=True)
class CompletionTraining(TrainingSettings):
    """Settings of the training of the completion network."""

    robot: str = "panda"
    """Name or file of the arm in the views, as `load_robot` takes it."""
    families: Annotated[tuple[Annotated[str, OneOf(FAMILIES)], ...], Filled()] = tuple(FAMILIES)
    """Families of the scenes, with equal shares."""
    weights: str | None = None
    """Folder with the initial weights; "bundled": the weights that come with the package; None: random
    weights."""
    minutes: Positive | None = None
    samples: Count | None = 40_000
    batch: Count = 4
    learning_rate: Positive = 1e-3
    warmup_steps: Natural = 100
    average: ShareBelowOne = 0.995
    workers: Natural = 1
    """Number of worker processes that draw samples; 0: the training process draws them."""
    network: CompletionSettings = field(default_factory=CompletionSettings)


def train_completion(settings: CompletionTraining, out: str) -> dict[str, float]:
    """Train the network; write completion.safetensors, .onnx and .json into the folder `out`.

    The same call continues a run that was interrupted. Returns, on held-out scenes, the cross-entropy per
    voxel (`validation`) and the fitted temperature; precision, recall, average precision and expected
    calibration error of each family; the expected calibration error over all families of the training; and
    the number of training samples (`samples`).

    Raises the errors of `loop.train` and `Processes`, and InputError for an unusable robot and for weights
    of a network with other settings.
    """
    task = CompletionTask(settings, Processes(settings.device))
    try:
        return train(task, out)
    finally:
        task.prefetcher.close()


class CompletionTask(TrainingTask):
    """The training of the completion network."""

    title = "completion"
    module: CompletionNetwork

    def __init__(self, settings: CompletionTraining, processes: Processes) -> None:
        self.settings = settings
        self.processes = processes
        self.identity = {}
        self.robot = load_robot(settings.robot)
        torch.manual_seed(settings.seed)
        self.module = self._initial(settings).to(processes.device)
        self.prefetcher = SamplePrefetcher(settings.families, self.robot, settings.batch, settings.workers)
        self._reachable, self._above = reachable(), voxel_centers()[..., 2] > VOXEL / 2
        self._validation_samples = self._held_out(settings.families, 0, VALIDATION_SAMPLES)

    def _initial(self, settings: CompletionTraining) -> CompletionNetwork:
        """The network that training begins with."""
        network = CompletionNetwork(settings.network)
        if settings.weights is not None:
            pretrained = load_completion(None if settings.weights == BUNDLED_WEIGHTS else settings.weights)
            if pretrained.settings != settings.network:
                raise InputError(
                    f"weights {settings.weights}: their network has {shown(pretrained.settings.to_json())}; "
                    f"the training's network has {shown(settings.network.to_json())}"
                )
            network.load_state_dict(pretrained.state_dict())
        return network

    def loss(self, fraction: float, rng: Generator) -> Scalar:
        return self._loss(self.prefetcher.next(rng))

    def validate(self, fraction: float) -> Validation:
        with torch.no_grad():
            parts = [self._loss(part).item() for part in _split(self._validation_samples)]
        return Validation(float(np.mean(parts)))

    def finish(self) -> dict[str, float]:
        families = self.settings.families
        loss = self.validate(1.0).loss
        logits, truth, _ = self._predictions(
            self._held_out(families, VALIDATION_SAMPLES, CALIBRATION_SAMPLES)
        )
        with torch.no_grad():
            self.module.temperature.fill_(
                fitted_temperature(logits[::CALIBRATION_STRIDE], truth[::CALIBRATION_STRIDE])
            )
        temperature = float(self.module.temperature)
        report = {"validation": loss, "temperature": temperature}
        all_p = []
        all_truth = []
        for name in FAMILIES:
            held_out = self._held_out((name,), VALIDATION_SAMPLES + CALIBRATION_SAMPLES, TEST_SAMPLES)
            logits, truth, unknown = self._predictions(held_out)
            p = 1 / (1 + np.exp(-logits[unknown] / temperature))
            truth = truth[unknown]
            predicted_occupied = p > OCCUPIED_PROBABILITY
            true_positives = float((predicted_occupied & truth).sum())
            report[f"precision {name}"] = true_positives / max(1.0, float(predicted_occupied.sum()))
            report[f"recall {name}"] = true_positives / max(1.0, float(truth.sum()))
            report[f"average precision {name}"] = average_precision(p, truth)
            report[f"calibration error {name}"] = calibration_error(p, truth)
            if name in families:
                all_p.append(p)
                all_truth.append(truth)
        p = np.concatenate(all_p)
        truth = np.concatenate(all_truth)
        report["calibration error"] = calibration_error(p, truth)
        return report

    def _held_out(self, families: tuple[str, ...], first: int, count: int) -> Samples:
        """`count` held-out samples of each family, beginning with sample number `first`."""
        parts = []
        for name in families:
            rng = np.random.default_rng([HELD_OUT_SEED, list(FAMILIES).index(name)])
            seeds = rng.integers(SEED_LIMIT, size=first + count)[first:]
            parts.append(draw_samples((name,), self.robot, seeds.tolist()))
        return Samples(*map(np.concatenate, zip(*parts, strict=True)))

    def _logits_and_truth(self, samples: Samples) -> tuple[Tensor, Tensor, Tensor]:
        """Logits [m 8] and truth [m 8] of the fine voxels that the network predicts, and the indices [m] of
        their coarse voxels: those within the arm's reach that no view observed free."""
        predicted = ((samples.seen & FREE) == 0) & self._reachable
        indices = folded(torch.from_numpy(predicted)).reshape(-1).nonzero()[:, 0]
        truth = folded(torch.from_numpy(samples.truth)).reshape(-1)[indices].numpy()
        device = self.processes.device
        with self.processes.autocast():
            seen, depth_behind = (torch.from_numpy(a).to(device) for a in (samples.seen, samples.behind))
            logits = self.module(seen, depth_behind)
        rows = logits.reshape(-1, 8).index_select(0, indices.to(device))
        return rows.float(), torch.from_numpy(unpack_fine(truth)).to(device), indices

    def _loss(self, samples: Samples) -> Scalar:
        logits, truth, _ = self._logits_and_truth(samples)
        return binary_cross_entropy_with_logits(logits, truth.float())

    def _predictions(self, samples: Samples) -> tuple[Floats, Flags, Flags]:
        """Logits and truth of the predicted fine voxels, and which of these are unknown and above the
        ground."""
        predictions = list[tuple[ndarray, ndarray, ndarray]]()
        for part in _split(samples):
            hidden = ((part.seen & OCCUPIED) == 0) & self._above
            with torch.no_grad():
                logits, truth, indices = self._logits_and_truth(part)
            unknown = folded(torch.from_numpy(hidden)).reshape(-1)[indices].numpy().repeat(8)
            predictions.append((logits.cpu().numpy().ravel(), truth.cpu().numpy().ravel(), unknown))
        logits, truth, unknown = map(np.concatenate, zip(*predictions, strict=True))
        return logits, truth, unknown


def _split(samples: Samples) -> list[Samples]:
    """The samples in batches of at most four."""
    return [Samples(*(array[i : i + 4] for array in samples)) for i in range(0, len(samples.seen), 4)]


def fitted_temperature(logits: Floats, truth: Flags) -> float:
    """The temperature by which logits are divided so that their cross-entropy is smallest (Guo et al.
    2017)."""
    from scipy.optimize import minimize_scalar

    sign = np.where(truth, -1.0, 1.0).astype(np.float32)

    def loss(log_t: float) -> float:
        return float(np.logaddexp(0, sign * logits * np.float32(np.exp(-log_t))).mean())

    optimum: Any = minimize_scalar(loss, bounds=(-1.5, 1.5), method="bounded")
    return float(np.exp(optimum.x))


def calibration_error(p: Floats, truth: Flags) -> float:
    """Expected calibration error: the mean over the voxels of |mean predicted probability - share of occupied
    voxels|, both taken over the voxel's bin."""
    bins = np.minimum((p * CALIBRATION_BINS).astype(int), CALIBRATION_BINS - 1)
    errors = np.bincount(bins, p.astype(np.float64) - truth, CALIBRATION_BINS)
    return float(np.abs(errors).sum() / max(1, len(p)))


def average_precision(p: Floats, truth: Flags) -> float:
    """Mean precision over all thresholds, weighted by the gain in recall."""
    order = np.argsort(-p, kind="stable")
    hits = np.cumsum(truth[order])
    precision = hits / np.arange(1, len(hits) + 1)
    return float(precision[truth[order]].mean()) if truth.any() else 0.0
