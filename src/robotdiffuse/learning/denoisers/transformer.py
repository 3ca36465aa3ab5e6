"""The motion predictor: an encoder-only transformer that predicts the clean trajectory (paper: Method)."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from robotdiffuse.errors import InputError


@dataclass(frozen=True)
class TransformerSettings:
    width: int = 160
    """Size of a token (paper: 512)."""
    layers: int = 6
    """(paper: 8)"""
    heads: int = 5
    """Attention heads; a divisor of width."""
    hidden: int = 480
    """Size of the hidden layer of each feed-forward network."""
    patch: int = 4
    """Frames per token; a divisor of the number of frames."""

    def __post_init__(self) -> None:
        if self.width % self.heads:
            raise InputError(
                f"transformer.heads is {self.heads}; it must divide width, which is {self.width}"
            )


class Linear(nn.Linear):
    """A linear layer that takes its input in the type of its weights, so that they may be kept in bf16."""

    def forward(self, input: Tensor) -> Tensor:
        return functional.linear(input.to(self.weight.dtype), self.weight, self.bias)


class Block(nn.Module):
    """Pre-norm attention and feed-forward network.

    Attention is written out with plain matrix products in fp32: for sequences this short the fused kernel's
    backward pass takes over half of a training step on a CPU.
    """

    def __init__(self, settings: TransformerSettings) -> None:
        super().__init__()
        width = settings.width
        self.heads = settings.heads
        self.norm_attention = nn.LayerNorm(width)
        self.qkv = Linear(width, 3 * width)
        self.merge = Linear(width, width)
        self.norm_mlp = nn.LayerNorm(width)
        self.expand = Linear(width, settings.hidden)
        self.contract = Linear(settings.hidden, width)
        for layer in (self.merge, self.contract):
            nn.init.normal_(layer.weight, std=0.02 / (2 * settings.layers) ** 0.5)
            nn.init.zeros_(layer.bias)

    def forward(self, x: Float[Tensor, "batch tokens width"]) -> Float[Tensor, "batch tokens width"]:
        batch, tokens, width = x.shape
        qkv = self.qkv(self.norm_attention(x)).view(batch, tokens, 3, self.heads, -1).permute(2, 0, 3, 1, 4)
        q, k, v = qkv.to(torch.float32, memory_format=torch.contiguous_format).unbind(0)
        weights = torch.softmax((q * (width // self.heads) ** -0.5) @ k.transpose(-1, -2), dim=-1)
        x = x + self.merge((weights @ v).transpose(1, 2).reshape(batch, tokens, width))
        hidden = functional.gelu(self.expand(self.norm_mlp(x)), approximate="tanh")
        return x + self.contract(hidden)


def _positions(tokens: int, width: int) -> Float[Tensor, "tokens width"]:
    """Sinusoidal positions (Vaswani et al. 2017)."""
    angles = np.arange(tokens)[:, None] / 10_000 ** (np.arange(0, width, 2) / width)
    return torch.from_numpy(
        np.stack([np.sin(angles), np.cos(angles)], -1).reshape(tokens, -1)[:, :width]
    ).float()


class Transformer(nn.Module):
    """Tokens: patches of frames, and one token z_tk that carries the condition and the noise level.

    z_tk is also added to every other token, which spares the first layer from having to spread it.
    """

    positions: Tensor
    frequencies: Tensor

    def __init__(
        self, settings: TransformerSettings, frames: int, dof: int, features: int, condition: int
    ) -> None:
        """`features`: numbers per frame of the input; `condition`: numbers in [z, start, goal]."""
        super().__init__()
        if frames % settings.patch:
            raise InputError(f"transformer.patch is {settings.patch}; it must divide the {frames} frames")
        width = settings.width
        self.settings, self.frames, self.dof = settings, frames, dof
        self.embed = Linear(settings.patch * features, width)
        self.condition = nn.Sequential(
            Linear(condition, 2 * width), nn.GELU("tanh"), Linear(2 * width, width)
        )
        self.level = nn.Sequential(Linear(width, width), nn.GELU("tanh"), Linear(width, width))
        self.blocks = nn.ModuleList(Block(settings) for _ in range(settings.layers))
        self.norm = nn.LayerNorm(width)
        self.out = Linear(width, settings.patch * dof)
        nn.init.zeros_(self.out.weight)
        nn.init.zeros_(self.out.bias)
        self.register_buffer("positions", _positions(frames // settings.patch, width), persistent=False)
        self.register_buffer(
            "frequencies", torch.exp(torch.linspace(0.0, np.log(1_000.0), width // 2)), persistent=False
        )

    def forward(
        self,
        features: Float[Tensor, "batch frames features"],
        level: Float[Tensor, "batch"],
        condition: Float[Tensor, "batch condition"],
    ) -> Float[Tensor, "batch frames dof"]:
        """The clean trajectory. `level` is t / T in [0, 1]."""
        batch = features.shape[0]
        angles = level[:, None] * self.frequencies
        z_tk = self.condition(condition) + self.level(torch.cat([angles.sin(), angles.cos()], -1))
        patches = features.reshape(batch, self.frames // self.settings.patch, -1)
        tokens = self.embed(patches) + self.positions + z_tk[:, None]
        x = torch.cat([z_tk[:, None].to(tokens.dtype), tokens], 1)
        for block in self.blocks:
            x = block(x)
        return self.out(self.norm(x[:, 1:])).float().reshape(batch, self.frames, self.dof)
