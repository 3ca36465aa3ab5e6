"""Trainings for tests: one that takes almost no time, a short one of a network, and what their log says."""

import csv
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from robotdiffuse.learning.training.config import TrainingSettings
from robotdiffuse.learning.training.loop import Processes, TrainingTask, Validation


class ToyTask(TrainingTask):
    """A training of a linear layer, whose loss is its sum of squares times a factor that depends on the number of the call."""

    title = "toy"

    def __init__(self, settings: TrainingSettings, factor: Callable[[int], float]) -> None:
        torch.manual_seed(0)
        self.settings = settings
        self.processes = Processes("cpu")
        self.module = torch.nn.Linear(2, 1)
        self.identity = {}
        self._factor = factor
        self._calls = 0

    def loss(self, fraction: float, rng: np.random.Generator) -> torch.Tensor:
        self._calls += 1
        return (self.module.get_parameter("weight") * self._factor(self._calls - 1)).square().sum()

    def validate(self, fraction: float) -> Validation:
        return Validation(0.0)

    def save(self, folder: Path, training: dict[str, Any]) -> None:
        """Saves nothing."""


def read_log(folder: Path) -> list[dict[str, str]]:
    """The rows of log.csv."""
    with open(folder / "log.csv") as file:
        return list(csv.DictReader(file))


def trained(network: torch.nn.Module, loss_at: Callable[[int], torch.Tensor], steps: int, rate: float) -> list[float]:
    """The loss of each step of a training; `loss_at` gives the loss for the number of a step."""
    optimizer = torch.optim.AdamW(network.parameters(), rate)
    losses = []
    for step in range(steps):
        loss = loss_at(step)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    return losses
