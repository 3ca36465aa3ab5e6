"""The base class of the learned baselines' networks, with the interface that trains them."""

from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float
from torch import Tensor

from robotdiffuse.learning.network import Network
from robotdiffuse.learning.robot_identity import RobotIdentity
from robotdiffuse.learning.training.batches import TrajectoryData
from robotdiffuse.robots.robot import Robot


class BaselineNetwork(Network):
    """A network that `train_baseline` trains; `settings` are of the class that NETWORKS names."""

    training_defaults: ClassVar[dict[str, Any]] = {}
    """The network's own defaults of fields of `BaselineTraining`, for example batch."""

    def __init__(self, robot: RobotIdentity, settings: Any) -> None:
        super().__init__()
        self.robot, self.settings = robot, settings
        self.dof, self.normalizer = robot.dof, robot.normalizer()

    def fit_statistics(self, data: TrajectoryData) -> None:
        """Fill buffers with statistics of the training trajectories; called before a run."""

    def loss(
        self, data: TrajectoryData, count: int, fraction: float, rng: np.random.Generator
    ) -> Float[Tensor, ""]:
        """The loss of `count` samples drawn from the data; `fraction` of the training is done, 0 to 1."""
        raise NotImplementedError

    def success(self, data: TrajectoryData, robot: Robot, rng: np.random.Generator) -> float | None:
        """Share of some held-out problems that the network solves by itself; None: not measured."""
        return None
