"""A decoder-only transformer: each waypoint attends to z_tk and the waypoints before it (paper: Table 2)."""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from robotdiffuse.learning.denoisers.base import Denoiser
from robotdiffuse.learning.denoisers.layers import (
    Block,
    LevelEmbedding,
    positions,
    start_at_zero,
    two_layers,
)
from robotdiffuse.learning.denoisers.settings import DecoderOnlySettings


class DecoderOnly(Denoiser):
    """Causal self attention over [z_tk, waypoints ...], after Radford et al. 2018.

    z_tk carries the condition, which includes the goal, and the noise level. It is the first token, and so
    the only one that all waypoints attend to. Waypoints are not drawn in turn: one pass predicts them all.
    """

    positions: Tensor

    def __init__(
        self, settings: DecoderOnlySettings, waypoints: int, dof: int, features: int, condition: int
    ) -> None:
        super().__init__(settings, waypoints, dof, features, condition)
        tokens, width = settings.tokens(waypoints), settings.width
        self.embed = nn.Linear(settings.patch * features, width)
        self.condition = two_layers(condition, 2 * width, width)
        self.level = LevelEmbedding(width)
        self.blocks = nn.ModuleList(
            Block(width, settings.heads, settings.hidden, settings.layers, causal=True)
            for _ in range(settings.layers)
        )
        self.norm = nn.LayerNorm(width)
        self.out = nn.Linear(width, settings.patch * dof)
        start_at_zero(self.out)
        self.register_buffer("positions", positions(np.arange(1 + tokens), width), persistent=False)

    def forward(
        self,
        features: Float[Tensor, "batch waypoints features"],
        level: Float[Tensor, "batch"],
        condition: Float[Tensor, "batch condition"],
    ) -> Float[Tensor, "batch waypoints dof"]:
        """The output for noisy trajectories; level is t / T in [0, 1]."""
        batch = features.shape[0]
        z_tk = self.condition(condition) + self.level(level)
        tokens = self.embed(features.reshape(batch, len(self.positions) - 1, -1))
        x = torch.cat([z_tk[:, None], tokens], 1) + self.positions
        for block in self.blocks:
            x = block(x)
        return self.out(self.norm(x[:, 1:])).float().reshape(batch, self.waypoints, self.dof)
