"""The interface of all denoisers."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

from jaxtyping import Float
from torch import Tensor, nn

from robotdiffuse.core.errors import InputError
from robotdiffuse.core.settings import Count, Settings


@dataclass(frozen=True)
class DenoiserSettings(Settings):
    """Settings of a denoiser."""

    @classmethod
    def paper_size(cls) -> "DenoiserSettings":
        """Settings of about the size of the paper's network: 8 layers of width 512 and a token per
        waypoint."""
        return cls()


@dataclass(frozen=True)
class AttentionSettings(DenoiserSettings):
    """Settings of all transformers.

    The paper states neither the number of heads nor the size of the hidden layer: `paper_size` has those of
    the network that the paper follows, the motion diffusion model of Tevet et al. 2023.
    """

    width: Count = 160
    """Size of a token; even (paper: 512)."""
    layers: Count = 6
    """Number of blocks (paper: 8)."""
    heads: Count = 5
    """Attention heads; a divisor of width."""
    hidden: Count = 480
    """Size of the hidden layer of each feed-forward network."""
    patch: Count = 4
    """Waypoints per token; a divisor of the number of waypoints (paper: 1)."""

    def __post_init__(self) -> None:
        super().__post_init__()
        kind = self.settings_name
        if self.width % self.heads:
            raise InputError(f"{kind}.heads is {self.heads}; it must divide width, which is {self.width}")
        if self.width % 2:  # sines and cosines
            raise InputError(f"{kind}.width is {self.width}; it must be even")

    @classmethod
    def paper_size(cls) -> "AttentionSettings":
        return cls(512, 8, 4, 1024, patch=1)

    def tokens(self, waypoints: int) -> int:
        """The number of patches. Raises InputError unless the waypoints can be divided into patches."""
        if waypoints % self.patch:
            raise InputError(
                f"{self.settings_name}.patch is {self.patch}; it must divide the {waypoints} waypoints"
            )
        return waypoints // self.patch


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
