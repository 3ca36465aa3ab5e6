"""Training of an auto-encoder of point clouds alone, and what can be read from the codes of any encoder."""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from robotdiffuse.learning.checkpoint import save_encoder
from robotdiffuse.learning.encoders import Autoencoder, Encoder, make_encoder
from robotdiffuse.learning.settings import settings_to_json
from robotdiffuse.learning.training.batches import random_scenes, scene_clouds
from robotdiffuse.learning.training.config import EncoderTraining
from robotdiffuse.learning.training.processes import Processes, on_cpu
from robotdiffuse.learning.training.run import TrainingRun, Validation
from robotdiffuse.learning.versions import versions
from robotdiffuse.scenes.packed import PackedScenes

READ, CHECKED = 2048, 512
"""Scenes that a linear read-out is fitted to, and further ones that it is judged by."""
SPOTS = np.stack(
    np.meshgrid([-0.6, -0.2, 0.2, 0.6], [-0.6, -0.2, 0.2, 0.6], [0.2, 0.5, 0.8], indexing="ij"), -1
).reshape(-1, 3)
"""Places around the arm [m] whose distance to the obstacles is read out."""
NEAR = 0.3
"""Distances are capped to plus and minus this [m]."""
RIDGE = 1e-3
"""Of the variance of a code's numbers, so that none is needed too much."""


def train_encoder(settings: EncoderTraining, out: str) -> dict[str, float]:
    """Train an auto-encoder; write encoder.safetensors and encoder.json into the folder `out`.

    The same call continues a run that was interrupted. Returns errors on fresh clouds, all in metres: those
    of the reconstruction, see the encoder's `loss`, and those of `linear_readout`. Raises InputError if the
    folder holds a different run, and KeyboardInterrupt, after a checkpoint, on Ctrl-C.
    """
    processes = Processes(settings.device)
    torch.manual_seed(settings.seed)
    module = make_encoder(settings.name, settings.encoder).to(processes.device)
    assert isinstance(module, Autoencoder)  # by EncoderTraining
    run = TrainingRun(
        module,
        out,
        settings,
        average=0.999,
        weight_decay=0.0,
        gradient_norm=1.0,
        bad_steps=10,
        identity={},
        processes=processes,
    )
    most = settings.points if module.any_size else module.settings.cloud

    def loss(rng: np.random.Generator) -> Float[Tensor, ""]:
        points = int(rng.integers(max(1, most // 8), most + 1)) if module.any_size else most
        scenes = random_scenes(settings.batch, settings.max_obstacles, rng)
        error, _ = _reconstruction(module, scenes, points, rng, processes)
        theta = torch.stack([p.square().sum() for p in module.penalised()]).sum()
        return error + settings.regularization * theta

    def judge(count: int, seed: int) -> tuple[Float[Tensor, ""], dict[str, float]]:
        rng = np.random.default_rng(seed)
        with torch.no_grad():
            scenes = random_scenes(count, settings.max_obstacles, rng)
            return _reconstruction(module, scenes, most, rng, processes)

    run.loop(loss, lambda: Validation(judge(128, 123)[0].item()), "encoder")
    if not processes.first:
        return processes.share(None)
    with run.averaged(), torch.no_grad():
        rng = np.random.default_rng(settings.seed + 1)
        scenes = random_scenes(READ, settings.max_obstacles, rng)
        report = judge(512, settings.seed + 2)[1]
        trained = on_cpu(module)
        clouds = scene_clouds(trained, scenes, rng).split(256)
        trained.standardize(torch.cat([trained.encode(part) for part in clouds]))
        report |= linear_readout(trained, settings.max_obstacles, rng)
        about = {"settings": settings_to_json(settings), "samples": run.at.samples, **report, **versions()}
        save_encoder(trained, out, about)
    return processes.share(report)


def _reconstruction(
    module: Autoencoder,
    scenes: PackedScenes,
    points: int,
    rng: np.random.Generator,
    processes: Processes,
) -> tuple[Float[Tensor, ""], dict[str, float]]:
    cloud = scene_clouds(module, scenes, rng, points).to(processes.device)
    with processes.autocast():
        return module.loss(cloud, rng)


def linear_readout(encoder: Encoder, max_obstacles: int, rng: np.random.Generator) -> dict[str, float]:
    """What of a scene stands in z in plain sight: a yardstick that is the same for all encoders.

    A linear map from z to the signed distances of fixed places around the arm to the obstacles, fitted to
    random scenes and judged by others. `readout`: its mean error [m]; `readout_of_constant`: that of the mean
    distances, with no z at all.
    """
    scenes = random_scenes(READ + CHECKED, max_obstacles, rng)
    with torch.no_grad():
        clouds = scene_clouds(encoder, scenes, rng).split(256)
        z = torch.cat([encoder(part) for part in clouds]).numpy().astype(np.float64)
    wanted = scenes.distances(SPOTS).clip(-NEAR, NEAR).astype(np.float64)
    z -= z[:READ].mean(0)
    mean = wanted[:READ].mean(0)
    gram = z[:READ].T @ z[:READ]
    ridge = max(RIDGE * np.trace(gram) / len(gram), np.finfo(np.float64).tiny)
    weights = np.linalg.solve(gram + ridge * np.eye(len(gram)), z[:READ].T @ (wanted[:READ] - mean))
    error = wanted[READ:] - mean
    return {
        "readout": float(np.abs(error - z[READ:] @ weights).mean()),
        "readout_of_constant": float(np.abs(error).mean()),
    }
