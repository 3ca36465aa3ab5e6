"""Training tasks, and the one function that runs them all: `train`."""

import sys
from abc import ABC, abstractmethod
from pathlib import Path as FilePath
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from robotdiffuse.core.errors import InputError
from robotdiffuse.learning import need_packages
from robotdiffuse.learning.checkpoint import versions
from robotdiffuse.learning.encoders.networks import Encoder
from robotdiffuse.learning.network import EXPORT_PACKAGES
from robotdiffuse.learning.training.batches import TrajectoryData, load_data
from robotdiffuse.learning.training.config import MotionTraining, TrainingSettings
from robotdiffuse.learning.training.loop import TrainingRun, Validation
from robotdiffuse.learning.training.processes import Processes
from robotdiffuse.robots.robot import Robot

MAX_VALIDATION_TRAJECTORIES = 2000
"""Largest number of trajectories of the validation split that are used."""
VALIDATION_BATCHES = 8
"""Batches of these in a validation."""


class TrainingTask(ABC):
    """A network in training: its loss, its validation, and the files that it leaves."""

    title: str
    """Name in progress and messages."""
    module: nn.Module
    """The network, on the device of the processes."""
    identity: dict[str, str]
    """What must be the same when a run is resumed besides the settings, for example the robot."""

    @abstractmethod
    def loss(self, fraction: float, rng: np.random.Generator) -> Float[Tensor, ""]:
        """The loss of a random batch; `fraction` of the training is done, 0 to 1."""

    @abstractmethod
    def validate(self, fraction: float) -> Validation:
        """Figures on held-out data, which are the same data at every call."""

    def finish(self) -> dict[str, float]:
        """The figures of the trained network."""
        loss, success = self.validate(1.0)
        return {"validation": loss} | ({} if success is None else {"success": success})

    def about(self) -> dict[str, Any]:
        """What the checkpoint says about the training, besides settings and figures."""
        return {}

    @abstractmethod
    def save(self, folder: FilePath, training: dict[str, Any]) -> None:
        """Write the weights and their description."""


def train(task: TrainingTask, settings: TrainingSettings, out: str, processes: Processes) -> dict[str, float]:
    """Train to the end and write the files into the folder `out`; returns the figures.

    The same call continues a run that was interrupted. If torchrun started several processes, all call this
    and get the same result, see `TrainingRun`. Raises InputError if the folder holds a different run, and
    KeyboardInterrupt, after a checkpoint, on Ctrl-C.
    """
    need_packages("training", *EXPORT_PACKAGES)  # now, and not after hours of training
    run = TrainingRun(task.module, out, settings, task.identity, processes)
    run.loop(lambda rng: task.loss(run.fraction, rng), lambda: task.validate(run.fraction), task.title)
    if not processes.first:
        return processes.share(None)
    with run.averaged():
        report = task.finish() | {"samples": float(run.at.samples)}
        minutes = round(run.at.seconds / 60, 2)
        about = task.about() | {"minutes": minutes} | report | versions()
        task.save(FilePath(out), {"settings": settings.to_json(), **about})
    return processes.share(report)


class MotionTask(TrainingTask):
    """The training of a network on planned trajectories."""

    def __init__(
        self, settings: MotionTraining, robot: Robot, encoder: Encoder | None, processes: Processes
    ) -> None:
        """encoder: the frozen encoder that computes the codes of the scenes, if there is one.

        Raises InputError if the data do not fit the robot, or there are none for training.
        """
        self.settings, self.robot, self.processes = settings, robot, processes
        # the first process caches the codes of the scenes for the others
        with processes.first_goes_first():
            self.data = load_data(
                settings.data, robot, encoder, settings.waypoints, self._report, settings.turned_copies
            )
        self.train_data, self.validation_data = self.data.split(MAX_VALIDATION_TRAJECTORIES)
        if not len(self.train_data):
            raise InputError(f"data folder {settings.data} holds no trajectory for training")

    def _report(self, text: str) -> None:
        if self.processes.first:
            print(text, file=sys.stderr)

    @abstractmethod
    def loss_of(
        self, data: TrajectoryData, fraction: float, rng: np.random.Generator, validating: bool
    ) -> Float[Tensor, ""]:
        """The loss of a random batch of these data."""

    @abstractmethod
    def success(self, rng: np.random.Generator) -> float | None:
        """Share of some held-out problems that the network solves by itself; None: not measured."""

    def loss(self, fraction: float, rng: np.random.Generator) -> Float[Tensor, ""]:
        return self.loss_of(self.train_data, fraction, rng, validating=False)

    def validate(self, fraction: float) -> Validation:
        if not len(self.validation_data):
            return Validation(float("nan"))
        rng = np.random.default_rng(7)
        with torch.no_grad():
            losses = [
                self.loss_of(self.validation_data, fraction, rng, validating=True).item()
                for _ in range(VALIDATION_BATCHES)
            ]
            return Validation(float(np.mean(losses)), self.success(rng))

    def about(self) -> dict[str, Any]:
        return {"data": self.data.digest, "trajectories": len(self.data)}
