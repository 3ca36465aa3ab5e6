"""The interface of all denoisers."""

from typing import Any

from jaxtyping import Float
from torch import Tensor, nn

from robotdiffuse.errors import InputError


class Denoiser(nn.Module):
    """Predicts the clean trajectory from a noisy one, of frames or of the control points of a spline."""

    out: nn.Linear
    """The last layer. It starts at zero, so that an untrained network predicts the mean trajectory."""

    def __init__(self, settings: Any, frames: int, dof: int, features: int, condition: int) -> None:
        """settings: of the class that stands beside the denoiser in DENOISERS.
        frames: rows of a trajectory, features: numbers per row of the input.
        condition: numbers in [z, start, goal]; start and goal are the last `dof` each.
        """
        super().__init__()
        self.settings, self.frames, self.dof = settings, frames, dof

    def forward(
        self,
        features: Float[Tensor, "batch frames features"],
        level: Float[Tensor, "batch"],
        condition: Float[Tensor, "batch condition"],
    ) -> Float[Tensor, "batch frames dof"]:
        """The clean trajectory. `level` is t / T in [0, 1]."""
        raise NotImplementedError


def check_attention(kind: str, width: int, heads: int) -> None:
    """Raises InputError unless the width is even (sines and cosines) and a multiple of the heads."""
    if heads < 1 or width % heads:
        raise InputError(f"{kind}.heads is {heads}; it must divide width, which is {width}")
    if width < 2 or width % 2:
        raise InputError(f"{kind}.width is {width}; it must be even")


def check_patch(kind: str, patch: int, frames: int) -> None:
    """Raises InputError unless the frames can be cut into patches."""
    if patch < 1 or frames % patch:
        raise InputError(f"{kind}.patch is {patch}; it must divide the {frames} frames")
