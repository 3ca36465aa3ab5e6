"""The motion predictor: an encoder-only transformer that predicts the clean trajectory (paper: Method)."""

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from torch import Tensor, nn

from robotdiffuse.learning.denoisers.base import Denoiser
from robotdiffuse.learning.denoisers.layers import (
    Block,
    LevelEmbedding,
    positions,
    start_at_zero,
    two_layers,
)
from robotdiffuse.learning.denoisers.settings import TransformerSettings


class Transformer(Denoiser):
    """Tokens: patches of waypoints, and one token z_tk that carries the condition and the noise level."""

    positions: Tensor

    def __init__(
        self, settings: TransformerSettings, waypoints: int, dof: int, features: int, condition: int
    ) -> None:
        super().__init__(settings, waypoints, dof, features, condition)
        tokens, width = settings.tokens(waypoints), settings.width
        self.embed = nn.Linear(settings.patch * features, width)
        self.condition = two_layers(condition, 2 * width, width)
        self.level = LevelEmbedding(width)
        self.blocks = nn.ModuleList(
            Block(width, settings.heads, settings.hidden, settings.layers) for _ in range(settings.layers)
        )
        self.norm = nn.LayerNorm(width)
        self.out = nn.Linear(width, settings.patch * dof)
        start_at_zero(self.out)
        self.register_buffer("positions", positions(np.arange(tokens), width), persistent=False)

    def set_positions(self, at: Float[ndarray, "tokens"]) -> None:
        """Give the tokens other positions, in waypoints; there may be another number of them."""
        self.positions = positions(at, self.settings.width).to(self.positions.device)

    def forward(
        self,
        features: Float[Tensor, "batch waypoints features"],
        level: Float[Tensor, "batch"],
        condition: Float[Tensor, "batch condition"],
    ) -> Float[Tensor, "batch waypoints dof"]:
        """The output for noisy trajectories; level is t / T in [0, 1]."""
        batch = features.shape[0]
        z_tk = self.condition(condition) + self.level(level)
        tokens = self.embed(features.reshape(batch, len(self.positions), -1)) + self.positions
        if self.settings.add_z_tk:
            tokens = tokens + z_tk[:, None]
        x = torch.cat([z_tk[:, None].to(tokens.dtype), tokens], 1)
        for block in self.blocks:
            x = block(x)
        return self.out(self.norm(x[:, 1:])).float().reshape(batch, -1, self.dof)
