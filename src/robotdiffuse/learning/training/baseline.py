"""Training of a learned baseline's network on the same planned trajectories as the diffusion model."""

from pathlib import Path as FilePath
from typing import Any, ClassVar

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from robotdiffuse.core.errors import InputError
from robotdiffuse.learning.checkpoint import save_network
from robotdiffuse.learning.network import Network
from robotdiffuse.learning.training.batches import TrajectoryData
from robotdiffuse.learning.training.config import BaselineTraining
from robotdiffuse.learning.training.loop import MotionTask, Processes, Validation, train
from robotdiffuse.learning.weight_files import NETWORKS, RobotIdentity
from robotdiffuse.robots import load_robot


class BaselineNetwork(Network):
    """A network that `train_baseline` trains; `settings` are of the class that NETWORKS names."""

    training_defaults: ClassVar[dict[str, Any]] = {}
    """The network's own defaults of fields of `BaselineTraining`, for example batch."""

    def __init__(self, robot: RobotIdentity, settings: Any) -> None:
        super().__init__()
        self.robot = robot
        self.settings = settings
        self.dof, self.normalizer = robot.dof, robot.normalizer()

    def fit_statistics(self, data: TrajectoryData) -> None:
        """Fill buffers with statistics of the training trajectories; called before a run."""

    def loss(
        self, data: TrajectoryData, count: int, fraction: float, rng: np.random.Generator
    ) -> Float[Tensor, ""]:
        """The loss of `count` samples drawn from the data; `fraction` of the training is done, 0 to 1."""
        raise NotImplementedError


def baseline_training(name: str, given: dict[str, Any]) -> BaselineTraining:
    """The training settings of a baseline's network, with the given changes.

    Raises InputError for an unknown name, listing the known ones, and for a network that is no baseline.
    """
    kind = NETWORKS.load(name)
    if not issubclass(kind, BaselineNetwork):
        raise InputError(f"{name} is no baseline; train it: robotdiffuse train {NETWORKS[name].kind}")
    if given.get("samples") is not None:
        given = given | {"minutes": None}
    return BaselineTraining(name=name, **(kind.training_defaults | given))


def train_baseline(settings: BaselineTraining, out: str) -> dict[str, float]:
    """Train a network with its default settings; write NAME.safetensors and NAME.json into the folder `out`.

    The same call continues a run that was interrupted. Returns `validation`, the loss on held-out
    trajectories, and `samples`.
    Raises as `task.train`, and InputError if the data do not fit.
    """
    return train(_BaselineTask(settings, Processes(settings.device)), out)


class _BaselineTask(MotionTask):
    module: BaselineNetwork

    def __init__(self, settings: BaselineTraining, processes: Processes) -> None:
        self.title, robot = settings.name, load_robot(settings.robot)
        torch.manual_seed(settings.seed)
        kind = NETWORKS.load(settings.name)
        own = NETWORKS.defaults(settings.name)
        self.module = kind(RobotIdentity.of(robot), own)
        super().__init__(settings, robot, None, processes)
        self.module.fit_statistics(self.train_data)
        self.identity = {"robot": robot.name, "network": repr(own)}

    def loss_of(
        self, data: TrajectoryData, fraction: float, rng: np.random.Generator, validating: bool
    ) -> Float[Tensor, ""]:
        return self.module.loss(data, self.settings.batch, fraction, rng)

    def validate(self, fraction: float) -> Validation:
        self.module.eval()
        validation = super().validate(fraction)
        self.module.train()
        return validation

    def save(self, folder: FilePath, training: dict[str, Any]) -> None:
        save_network(self.title, self.module, folder, training)
