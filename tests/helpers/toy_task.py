"""A training that takes almost no time."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from robotdiffuse.learning.training.config import TrainingSettings
from robotdiffuse.learning.training.loop import Processes, TrainingTask, Validation


class ToyTask(TrainingTask):
    """A linear layer. The loss is the sum of its squared weights times a factor, which depends on the number of the call."""

    title = "toy"

    def __init__(self, settings: TrainingSettings, factor: Callable[[int], float]) -> None:
        torch.manual_seed(0)
        self.settings = settings
        self.processes = Processes("cpu")
        self.module = torch.nn.Linear(2, 1)
        self.identity = {}
        self._factor = factor
        self._calls = 0

    def loss(self, fraction: float, rng: np.random.Generator) -> Tensor:
        self._calls += 1
        return (self.module.get_parameter("weight") * self._factor(self._calls - 1)).square().sum()

    def validate(self, fraction: float) -> Validation:
        return Validation(0.0)

    def save(self, folder: Path, training: dict[str, Any]) -> None:
        """Saves nothing."""
