"""Training of an auto-encoder of point clouds, and a linear read-out that compares the codes of any
encoder."""

from pathlib import Path as FilePath
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from robotdiffuse.learning.checkpoint import save_network
from robotdiffuse.learning.encoders import make_encoder
from robotdiffuse.learning.encoders.networks import Autoencoder, Encoder
from robotdiffuse.learning.training.batches import random_scenes, scene_clouds
from robotdiffuse.learning.training.config import EncoderTraining
from robotdiffuse.learning.training.loop import Processes, TrainingTask, Validation, on_cpu, train
from robotdiffuse.scenes.scene_arrays import PackedScenes

# Scenes that a linear read-out is fitted to, and further ones that it is tested on.
READOUT_SCENES = 2048
TEST_SCENES = 512
READOUT_POSITIONS = np.stack(
    np.meshgrid([-0.6, -0.2, 0.2, 0.6], [-0.6, -0.2, 0.2, 0.6], [0.2, 0.5, 0.8], indexing="ij"), -1
).reshape(-1, 3)
"""Positions around the arm [m] whose distance to the obstacles is read out."""
MAX_READOUT_DISTANCE = 0.3
"""Distances are clipped to plus and minus this [m]."""
REGULARIZATION = 1e-7
"""The paper's lambda: weight of the sum of squared weights, in the unit of the reconstruction's loss."""
RELATIVE_RIDGE = 1e-3
"""Regularisation of the fit, relative to the mean variance of a code's numbers."""


def train_encoder(settings: EncoderTraining, out: str) -> dict[str, float]:
    """Train an auto-encoder; write encoder.safetensors and encoder.json into the folder `out`.

    The same call continues a run that was interrupted. Returns errors on fresh clouds [m], those of the
    reconstruction (see the encoder's `loss`) and of `linear_readout`, and `samples`. Raises as `task.train`.
    """
    return train(_EncoderTask(settings, Processes(settings.device)), out)


class _EncoderTask(TrainingTask):
    title = "encoder"
    module: Autoencoder

    def __init__(self, settings: EncoderTraining, processes: Processes) -> None:
        self.settings = settings
        self.processes = processes
        self.identity = {}
        torch.manual_seed(settings.seed)
        module = make_encoder(settings.name, settings.encoder)
        assert isinstance(module, Autoencoder)  # by EncoderTraining
        self.module = self._trained = module.to(processes.device)
        self._most = settings.points if module.settings.any_size else module.settings.cloud

    def loss(self, fraction: float, rng: np.random.Generator) -> Float[Tensor, ""]:
        settings = self.settings
        module = self.module
        most = self._most
        points = int(rng.integers(max(1, most // 8), most + 1)) if module.settings.any_size else most
        error, _ = self._reconstruction(settings.batch, points, rng)
        theta = torch.stack([p.square().sum() for p in module.penalised()]).sum()
        return error + REGULARIZATION * theta

    def validate(self, fraction: float) -> Validation:
        return Validation(self._validation(128, 123)[0].item())

    def finish(self) -> dict[str, float]:
        settings = self.settings
        rng = np.random.default_rng(settings.seed + 1)
        scenes = self._scenes(READOUT_SCENES, rng)
        report = self._validation(512, settings.seed + 2)[1]
        trained = self._trained = on_cpu(self.module)
        with torch.no_grad():
            clouds = scene_clouds(trained, scenes, rng).split(256)
            trained.standardize(torch.cat([trained.encode(part) for part in clouds]))
        return report | linear_readout(trained, self._scenes(READOUT_SCENES + TEST_SCENES, rng), rng)

    def save(self, folder: FilePath, training: dict[str, Any]) -> None:
        save_network("encoder", self._trained, folder, training)

    def _scenes(self, count: int, rng: np.random.Generator) -> PackedScenes:
        settings = self.settings
        return random_scenes(count, settings.max_obstacles, rng, rop=settings.scenes == "rop")

    def _validation(self, count: int, seed: int) -> tuple[Float[Tensor, ""], dict[str, float]]:
        with torch.no_grad():
            return self._reconstruction(count, self._most, np.random.default_rng(seed))

    def _reconstruction(
        self, count: int, points: int, rng: np.random.Generator
    ) -> tuple[Float[Tensor, ""], dict[str, float]]:
        scenes = self._scenes(count, rng)
        cloud = scene_clouds(self.module, scenes, rng, points).to(self.processes.device)
        with self.processes.autocast():
            return self.module.loss(cloud, rng)


def linear_readout(encoder: Encoder, scenes: PackedScenes, rng: np.random.Generator) -> dict[str, float]:
    """Errors of a linear read-out of z, the same measure for all encoders.

    A linear map from z to the signed distances of fixed positions around the arm to the obstacles is fitted
    to the first READOUT_SCENES and tested on the others. `readout`: its mean error [m];
    `readout_of_constant`: the error of the mean distances, without z.
    """
    with torch.no_grad():
        clouds = scene_clouds(encoder, scenes, rng).split(256)
        z = torch.cat([encoder(part) for part in clouds]).numpy().astype(np.float64)
    wanted = (
        scenes.distances(READOUT_POSITIONS)
        .clip(-MAX_READOUT_DISTANCE, MAX_READOUT_DISTANCE)
        .astype(np.float64)
    )
    z -= z[:READOUT_SCENES].mean(0)
    mean = wanted[:READOUT_SCENES].mean(0)
    gram = z[:READOUT_SCENES].T @ z[:READOUT_SCENES]
    ridge = max(RELATIVE_RIDGE * np.trace(gram) / len(gram), np.finfo(np.float64).tiny)
    weights = np.linalg.solve(
        gram + ridge * np.eye(len(gram)), z[:READOUT_SCENES].T @ (wanted[:READOUT_SCENES] - mean)
    )
    error = wanted[READOUT_SCENES:] - mean
    return {
        "readout": float(np.abs(error - z[READOUT_SCENES:] @ weights).mean()),
        "readout_of_constant": float(np.abs(error).mean()),
    }
