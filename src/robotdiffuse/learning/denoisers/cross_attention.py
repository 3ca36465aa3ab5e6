"""A transformer whose waypoints attend to points of the scene, in place of one vector for the whole scene."""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from robotdiffuse.learning.denoisers.base import Denoiser
from robotdiffuse.learning.denoisers.layers import (
    CrossBlock,
    LevelEmbedding,
    positions,
    start_at_zero,
    two_layers,
)
from robotdiffuse.learning.denoisers.settings import CrossAttentionSettings
from robotdiffuse.learning.encoders.base import wave_angles

OCTAVES = 4
"""Wavelengths of the sines and cosines of a point's coordinates that are inputs too; see `wave_angles`."""


class CrossAttention(Denoiser):
    """Tokens: patches of waypoints, and one that carries start, goal and noise level. Each block lets them
    attend to each other, then to the points of the condition (encoder `points`)."""

    positions: Tensor

    def __init__(
        self, settings: CrossAttentionSettings, waypoints: int, dof: int, features: int, condition: int
    ) -> None:
        super().__init__(settings, waypoints, dof, features, condition)
        tokens, width = settings.tokens(waypoints), settings.width
        self.embed = nn.Linear(settings.patch * features, width)
        self.ends = two_layers(2 * dof, 2 * width, width)
        self.points = two_layers(3 + 6 * OCTAVES, width, width)
        self.level = LevelEmbedding(width)
        self.blocks = nn.ModuleList(
            CrossBlock(width, settings.heads, settings.hidden, settings.layers)
            for _ in range(settings.layers)
        )
        self.norm_points, self.norm = nn.LayerNorm(width), nn.LayerNorm(width)
        self.out = nn.Linear(width, settings.patch * dof)
        start_at_zero(self.out)
        self.register_buffer("positions", positions(np.arange(tokens), width), persistent=False)

    def forward(
        self,
        features: Float[Tensor, "batch waypoints features"],
        level: Float[Tensor, "batch"],
        condition: Float[Tensor, "batch condition"],
    ) -> Float[Tensor, "batch waypoints dof"]:
        """The output for noisy trajectories; level is t / T in [0, 1]."""
        batch = features.shape[0]
        points = condition[:, : -2 * self.dof].reshape(batch, -1, 3)
        angles = torch.cat(wave_angles(points, OCTAVES), -1)
        known = torch.cat([points, angles.sin(), angles.cos()], -1)
        memory = self.norm_points(self.points(known))
        z_tk = self.ends(condition[:, -2 * self.dof :]) + self.level(level)
        tokens = self.embed(features.reshape(batch, len(self.positions), -1)) + self.positions
        x = torch.cat([z_tk[:, None].to(tokens.dtype), tokens + z_tk[:, None]], 1)
        for block in self.blocks:
            x = block(x, memory)
        return self.out(self.norm(x[:, 1:])).float().reshape(batch, self.waypoints, self.dof)
