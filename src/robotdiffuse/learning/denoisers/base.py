"""The interface of all denoisers."""

from abc import ABC, abstractmethod
from typing import Any

from jaxtyping import Float
from torch import Tensor, nn


class Denoiser(nn.Module, ABC):
    """A network from a noisy trajectory to the output that the model's objective defines."""

    out: nn.Linear
    """The last layer. It starts at zero, so that an untrained network predicts the mean trajectory."""

    def __init__(self, settings: Any, waypoints: int, dof: int, features: int, condition: int) -> None:
        """settings: of the class that DENOISERS names for the denoiser.
        features: inputs per waypoint.
        condition: numbers in [z, start, goal]; start and goal are the last two times `dof`.
        """
        super().__init__()
        self.settings, self.waypoints, self.dof = settings, waypoints, dof

    @abstractmethod
    def forward(
        self,
        features: Float[Tensor, "batch waypoints features"],
        level: Float[Tensor, "batch"],
        condition: Float[Tensor, "batch condition"],
    ) -> Float[Tensor, "batch waypoints dof"]:
        """The output for noisy trajectories; level is t / T in [0, 1]."""
