"""An encoder-decoder transformer: the condition is encoded, the waypoints attend to it (paper: Table 2)."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from robotdiffuse.core.settings import Count
from robotdiffuse.learning.denoisers.base import AttentionSettings, Denoiser
from robotdiffuse.learning.denoisers.layers import (
    Block,
    CrossBlock,
    LevelEmbedding,
    Linear,
    positions,
    start_at_zero,
    two_layers,
)


@dataclass(frozen=True)
class EncoderDecoderSettings(AttentionSettings, name="encoder_decoder"):
    width: Count = 144
    """Size of a token; even."""
    layers: Count = 4
    """Blocks of the decoder."""
    encoder_layers: Count = 2
    """Blocks of the encoder."""
    heads: Count = 4
    """Attention heads; a divisor of width."""
    hidden: Count = 432
    """Size of the hidden layer of each feed-forward network."""

    @classmethod
    def paper_size(cls) -> "EncoderDecoderSettings":
        return cls(512, 4, 4, 1024, patch=1)


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
        self.embed = Linear(settings.patch * features, width)
        self.decoder = nn.ModuleList(
            CrossBlock(width, heads, hidden, settings.layers) for _ in range(settings.layers)
        )
        self.norm = nn.LayerNorm(width)
        self.out = Linear(width, settings.patch * dof)
        start_at_zero(self.out)
        self.register_buffer("positions", positions(tokens, width), persistent=False)

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
