"""An encoder-decoder transformer: the condition is encoded, the waypoints attend to it (paper: Table 2)."""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from robotdiffuse.learning.denoisers.base import Denoiser
from robotdiffuse.learning.denoisers.layers import (
    Block,
    CrossBlock,
    LevelEmbedding,
    positions,
    start_at_zero,
    two_layers,
)
from robotdiffuse.learning.denoisers.settings import EncoderDecoderSettings


class EncoderDecoder(Denoiser):
    """After Vaswani et al. 2017, with norms first: the encoder takes the tokens z, start, goal and t, the
    decoder the waypoints. Attention between waypoints is not causal, since they are not drawn in turn."""

    positions: Tensor

    def __init__(
        self, settings: EncoderDecoderSettings, waypoints: int, dof: int, features: int, condition: int
    ) -> None:
        super().__init__(settings, waypoints, dof, features, condition)
        tokens = settings.tokens(waypoints)
        width, heads, hidden = settings.width, settings.heads, settings.hidden
        self.sizes = (condition - 2 * dof, dof, dof)
        self.condition = nn.ModuleList(two_layers(size, width, width) for size in self.sizes)
        self.level = LevelEmbedding(width)
        self.encoder = nn.ModuleList(
            Block(width, heads, hidden, settings.encoder_layers) for _ in range(settings.encoder_layers)
        )
        self.norm_encoded = nn.LayerNorm(width)
        self.embed = nn.Linear(settings.patch * features, width)
        self.decoder = nn.ModuleList(
            CrossBlock(width, heads, hidden, settings.layers) for _ in range(settings.layers)
        )
        self.norm = nn.LayerNorm(width)
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
        parts = zip(self.condition, condition.split(self.sizes, -1), strict=True)
        memory = torch.stack([*(embed(part) for embed, part in parts), self.level(level)], 1).float()
        for block in self.encoder:
            memory = block(memory)
        memory = self.norm_encoded(memory)
        x = self.embed(features.reshape(batch, len(self.positions), -1)) + self.positions
        for block in self.decoder:
            x = block(x, memory)
        return self.out(self.norm(x)).float().reshape(batch, self.waypoints, self.dof)
