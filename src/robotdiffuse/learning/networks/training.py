"""Training of a learned baseline on the same planned trajectories as the product's own network."""

import sys
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from robotdiffuse.errors import InputError
from robotdiffuse.learning.networks import check_network, network_class
from robotdiffuse.learning.networks.base import JointRanges
from robotdiffuse.learning.networks.checkpoint import save_baseline
from robotdiffuse.learning.settings import settings_to_json
from robotdiffuse.learning.training.batches import load_data
from robotdiffuse.learning.training.config import check_length
from robotdiffuse.learning.training.processes import Processes
from robotdiffuse.learning.training.run import TrainingRun, Validation
from robotdiffuse.learning.versions import versions
from robotdiffuse.robots import load_robot

HELD_OUT = 2000
"""Most trajectories of the split for validation that are looked at."""
VALIDATION_BATCHES = 8


@dataclass(frozen=True)
class BaselineTraining:
    """Training of a baseline's network; it runs on the CPU, for the networks are small."""

    name: str
    """Which network, see `learning.networks.NETWORKS`."""
    data: str
    """Folder of a data set of `robotdiffuse data generate`."""
    robot: str = "panda"
    """Bundled name, or path to a URDF: the robot that the data are for."""
    minutes: float | None = 40.0
    """Length of the run in wall time [min]; the learning rate reaches 0 at its end. None: by `samples`."""
    samples: int | None = None
    """Length of the run in training samples. Runs of a given length are reproducible, timed ones are not."""
    seed: int = 0
    batch: int = 128
    """Samples per step."""
    learning_rate: float = 1e-3
    """Peak, for AdamW."""
    weight_decay: float = 0.0
    warmup_steps: int = 500
    frames: int = 48
    """Frames of a trajectory, as of the network that ships."""
    turns: int = 5
    """Copies of each trajectory turned about the vertical with their scenes, if the first joint is so."""
    gradient_norm: float = 1.0
    """Gradients are scaled down to this norm."""
    average: float = 0.9995
    """Decay of the moving average of the weights; the average is what is kept."""
    bad_steps: int = 10
    """So many steps in a row with a loss that is not finite take training back to the last checkpoint."""
    threads: int = 1
    """Threads of PyTorch."""
    checkpoint_seconds: float = 120.0

    def __post_init__(self) -> None:
        check_network(self.name)
        check_length(self.samples, self.minutes)


def baseline_training(name: str, given: dict[str, Any]) -> BaselineTraining:
    """The settings of a network, and what is given beside them, which wins.

    Raises InputError for an unknown name, listing the known.
    """
    check_network(name)
    if given.get("samples") is not None:
        given = given | {"minutes": None}
    return BaselineTraining(name, **(network_class(name).training_defaults | given))


def train_baseline(settings: BaselineTraining, out: str) -> dict[str, float]:
    """Train a network with its default settings; write NAME.safetensors and NAME.json into the folder `out`.

    The same call continues a run that was interrupted. Returns `validation`, the loss on trajectories kept
    aside, `success`, what it solves of them by itself, and `samples`. Raises InputError if the data or the
    folder do not fit, and KeyboardInterrupt, after a checkpoint, on Ctrl-C.
    """
    kind, robot = network_class(settings.name), load_robot(settings.robot)
    torch.manual_seed(settings.seed)
    network = kind(JointRanges.of(robot), kind.settings_class())
    data = load_data(settings.data, robot, None, settings.frames, _print, settings.turns)
    kept, held_out = data.split(HELD_OUT)
    if not len(kept):
        raise InputError(f"data folder {settings.data} holds no trajectory for training")
    network.fit_statistics(kept)
    run = TrainingRun(
        network,
        out,
        settings,
        average=settings.average,
        weight_decay=settings.weight_decay,
        gradient_norm=settings.gradient_norm,
        bad_steps=settings.bad_steps,
        identity={"robot": robot.name, "network": repr(network.settings)},
        processes=Processes("cpu"),
    )

    def loss(rng: np.random.Generator) -> Float[Tensor, ""]:
        return network.loss(kept, settings.batch, run.fraction, rng)

    def validate() -> Validation:
        if not len(held_out):
            return Validation(float("nan"))
        rng = np.random.default_rng(7)
        network.eval()
        with torch.no_grad():
            batches = range(VALIDATION_BATCHES)
            parts = [network.loss(held_out, settings.batch, run.fraction, rng).item() for _ in batches]
            success = network.success(held_out, robot, rng)
        network.train()
        return Validation(float(np.mean(parts)), success)

    run.loop(loss, validate, settings.name)
    with run.averaged():
        held_out_loss, success = validate()
        report = {"validation": held_out_loss, "samples": float(run.at.samples)}
        if success is not None:
            report["success"] = success
        about = {
            "settings": settings_to_json(settings),
            "data": data.digest,
            "trajectories": len(data),
            "minutes": round(run.at.seconds / 60, 2),
            **report,
            **versions(),
        }
        save_baseline(settings.name, network, out, about)
    return report


def _print(text: str) -> None:
    print(text, file=sys.stderr)
