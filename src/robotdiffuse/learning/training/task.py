"""What is trained, and the one way in which all of it is: a run, its validations, and what is kept of it."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from pathlib import Path as FilePath
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from robotdiffuse.core.errors import InputError
from robotdiffuse.learning.checkpoint import versions
from robotdiffuse.learning.encoders.base import Encoder
from robotdiffuse.learning.training.batches import TrajectoryData, load_data
from robotdiffuse.learning.training.config import MotionTraining, TrainingSettings
from robotdiffuse.learning.training.growing_data import GrowingData
from robotdiffuse.learning.training.loop import TrainingRun, Validation
from robotdiffuse.learning.training.processes import Processes
from robotdiffuse.robots.robot import Robot

HELD_OUT = 2000
"""Most trajectories of the split for validation that are looked at."""
VALIDATION_BATCHES = 8


class Trainee(ABC):
    """A network in training: its loss, its validation, and the files that it leaves."""

    title: str
    """In progress and messages."""
    module: nn.Module
    """On the device of the processes."""
    identity: dict[str, str]
    """What else than the settings must be the same when a run is resumed, e.g. the robot."""

    @abstractmethod
    def loss(self, fraction: float, rng: np.random.Generator) -> Float[Tensor, ""]:
        """The loss of a random batch; `fraction` of the training is done, 0 to 1."""

    @abstractmethod
    def validate(self, fraction: float) -> Validation:
        """By what is kept aside; the same at every call but for the weights."""

    def grow(self) -> bool:
        """After all checkpoints but the last: take in data that are new; whether there were any."""
        return False

    def finish(self) -> dict[str, float]:
        """The figures of the trained network."""
        loss, success = self.validate(1.0)
        return {"validation": loss} | ({} if success is None else {"success": success})

    def about(self) -> dict[str, Any]:
        """What the checkpoint says of the training, besides settings and figures."""
        return {}

    @abstractmethod
    def save(self, folder: FilePath, training: dict[str, Any]) -> None:
        """Write weights and their description."""


def train(trainee: Trainee, settings: TrainingSettings, out: str, processes: Processes) -> dict[str, float]:
    """Train to the end and write the files into the folder `out`; returns the figures.

    The same call continues a run that was interrupted. Where torchrun started several processes, all call
    this and get the same result, see `TrainingRun`. Raises InputError if the folder holds a different run,
    and KeyboardInterrupt, after a checkpoint, on Ctrl-C.
    """
    run = TrainingRun(trainee.module, out, settings, trainee.identity, processes)
    run.loop(
        lambda rng: trainee.loss(run.fraction, rng),
        lambda: trainee.validate(run.fraction),
        trainee.title,
        trainee.grow,
    )
    if not processes.first:
        return processes.share(None)
    with run.averaged():
        report = trainee.finish() | {"samples": float(run.at.samples)}
        minutes = round(run.at.seconds / 60, 2)
        about = trainee.about() | {"minutes": minutes} | report | versions()
        trainee.save(FilePath(out), {"settings": settings.to_json(), **about})
    return processes.share(report)


class MotionTrainee(Trainee):
    """A network that learns from planned trajectories.

    While the data factory is still filling the folder, the shards that are there are used, and new ones from
    the next checkpoint on; such a run is not reproducible, see `GrowingData`.
    """

    def __init__(
        self,
        settings: MotionTraining,
        robot: Robot,
        encoder: Encoder | None,
        processes: Processes,
        views: bool = False,
        along: Encoder | None = None,
    ) -> None:
        """encoder: the frozen one that makes codes of the scenes, if there is one. views, along: see
        `load_data`.

        Raises InputError if the data do not fit the robot, or there are none for training.
        """
        self.settings, self.robot, self.processes = settings, robot, processes

        def read(report: Callable[[str], None]) -> TrajectoryData:
            asked = settings.data, robot, encoder, settings.waypoints, report, settings.turns
            return load_data(*asked, views, along)

        self.data = GrowingData(settings.data, read, processes)
        self.kept, self.held_out = self.data.now.split(HELD_OUT)
        if not len(self.kept):
            raise InputError(f"data folder {settings.data} holds no trajectory for training")

    @abstractmethod
    def loss_of(
        self, data: TrajectoryData, fraction: float, rng: np.random.Generator, held_out: bool
    ) -> Float[Tensor, ""]:
        """The loss of a random batch of these data; `held_out`: for validation."""

    @abstractmethod
    def success(self, rng: np.random.Generator) -> float | None:
        """What the network by itself solves of some held-out problems, as a share; None: not known."""

    def loss(self, fraction: float, rng: np.random.Generator) -> Float[Tensor, ""]:
        return self.loss_of(self.kept, fraction, rng, held_out=False)

    def validate(self, fraction: float) -> Validation:
        if not len(self.held_out):
            return Validation(float("nan"))
        rng = np.random.default_rng(7)
        with torch.no_grad():
            losses = [
                self.loss_of(self.held_out, fraction, rng, held_out=True).item()
                for _ in range(VALIDATION_BATCHES)
            ]
            return Validation(float(np.mean(losses)), self.success(rng))

    def grow(self) -> bool:
        grown = self.data.grow()
        if grown:
            self.kept, self.held_out = self.data.now.split(HELD_OUT)
        return grown

    def about(self) -> dict[str, Any]:
        return {"data": self.data.now.digest, "trajectories": len(self.data.now)}
