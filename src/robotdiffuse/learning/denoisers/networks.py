"""The denoisers: one transformer over the tokens of a trajectory, with variants, and a temporal U-Net.

The residual stream is fp32; under autocast the linear layers are bf16.
"""

from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Real
from numpy import ndarray
from torch import Tensor, nn
from torch.nn import functional

from robotdiffuse.learning.denoisers import (
    AttentionSettings,
    EncoderDecoderSettings,
    TransformerSettings,
    UNetSettings,
)
from robotdiffuse.learning.encoders.networks import OCTAVES, perceptron, wave_angles

MAX_UNFUSED_TOKENS = 96
"""On a CPU, attention in fp32 uses PyTorch's fused kernel above this number of tokens; in bf16 never. No
limit suits all rows of this table: the fused kernel was faster at 13, 66 and 255 tokens, slower at 31 and 97.

Times of a forward and a backward pass [ms], torch 2.13, one thread:

| batch, heads x size | tokens | unfused bf16 | unfused fp32 | fused fp32 |
|---------------------|--------|--------------|--------------|------------|
| 64, 4 x 128         |     31 |         13   |         30   |       34   |
| 64, 4 x 128         |     66 |         29   |         76   |       56   |
| 64, 4 x 128         |     97 |         49   |         93   |      121   |
| 64, 4 x 128         |    255 |        274   |        813   |      480   |
| 128, 5 x 32         |     13 |          4.5 |          8.8 |        8.1 |
"""


Features = Float[Tensor, "batch waypoints features"]
Levels = Float[Tensor, "batch"]
Conditions = Float[Tensor, "batch condition"]
Trajectories = Float[Tensor, "batch waypoints dof"]
Tokens = Float[Tensor, "batch tokens width"]


class LevelEmbedding(nn.Sequential):
    """The noise level t / T as `width` numbers: sines and cosines, then a feed-forward network."""

    frequencies: Tensor

    def __init__(self, width: int) -> None:
        super().__init__(*perceptron(width, width, width))
        self.register_buffer(
            "frequencies", torch.exp(torch.linspace(0.0, np.log(1_000.0), width // 2)), persistent=False
        )

    def forward(self, input: Float[Tensor, "batch"]) -> Float[Tensor, "batch width"]:
        angles = input[:, None] * self.frequencies
        return super().forward(torch.cat([angles.sin(), angles.cos()], -1))


def positions(at: Real[ndarray, "tokens"], width: int) -> Float[Tensor, "tokens width"]:
    """Sinusoidal codes of positions (Vaswani et al. 2017)."""
    angles = at[:, None] / 10_000 ** (np.arange(0, width, 2) / width)
    return torch.from_numpy(
        np.stack([np.sin(angles), np.cos(angles)], -1).reshape(len(at), -1)[:, :width]
    ).float()


def split_heads(x: Tensor, parts: int, heads: int) -> tuple[Tensor, ...]:
    """[batch, tokens, parts * width] split into `parts` tensors [batch, heads, tokens, width / heads]."""
    batch, tokens, _ = x.shape
    x = x.view(batch, tokens, parts, heads, -1).permute(2, 0, 3, 1, 4)
    return x.contiguous().unbind(0)


def attend(
    q: Float[Tensor, "batch heads tokens size"],
    k: Float[Tensor, "batch heads others size"],
    v: Float[Tensor, "batch heads others size"],
    causal: bool = False,
) -> Float[Tensor, "batch tokens width"]:
    """Attention of tokens to others; causal: each token attends only to itself and the tokens before it.

    On a CPU, bf16 and short sequences use plain matrix products, and long sequences in fp32 the fused
    kernel. GPUs always use the fused kernel. MAX_UNFUSED_TOKENS has the times of both on a CPU.
    """
    batch, heads, tokens, size = q.shape
    plain = q.dtype == torch.bfloat16 or k.shape[2] <= MAX_UNFUSED_TOKENS
    if q.is_cuda or not plain:
        mixed = functional.scaled_dot_product_attention(q, k, v, is_causal=causal)
    else:
        scores = (q * size**-0.5) @ k.transpose(-1, -2)
        if causal:
            later = torch.ones(tokens, tokens, dtype=torch.bool, device=q.device).triu(1)
            scores = scores.masked_fill(later, -torch.inf)
        # padding to a multiple of 16 makes softmax over few tokens eight times as fast
        padded = functional.pad(scores, (0, -scores.shape[-1] % 16), value=-torch.inf)
        mixed = torch.softmax(padded, dim=-1)[..., : scores.shape[-1]] @ v
    return mixed.transpose(1, 2).reshape(batch, tokens, heads * size)


def start_small(layer: nn.Linear, layers: int) -> None:
    """Initialize the last layer of a residual branch; `layers`: number of residual blocks in a row."""
    nn.init.normal_(layer.weight, std=0.02 / (2 * layers) ** 0.5)
    nn.init.zeros_(layer.bias)


def start_at_zero(layer: nn.Linear) -> None:
    """Initialize the last layer of a network to zero."""
    nn.init.zeros_(layer.weight)
    nn.init.zeros_(layer.bias)


class Denoiser(nn.Module):
    """A network from a noisy trajectory to the output that the model's objective defines. A subclass defines
    `forward`, see `TrajectoryTransformer.forward`."""

    out: nn.Linear
    """The last layer. It starts at zero, so that an untrained network outputs zeros, which stand for the
    reference trajectory if the objective is `clean`."""

    def __init__(self, settings: Any, waypoints: int, dof: int, features: int, condition: int) -> None:
        """settings: of the class that DENOISERS names for the denoiser.
        features: inputs per waypoint.
        condition: size of [z, start, goal]. z is the scene's embedding, or its points if `settings.points`.
            Start and goal have `dof` numbers each.
        """
        super().__init__()
        self.settings = settings
        self.waypoints = waypoints
        self.dof = dof


class Block(nn.Module):
    """A transformer block: pre-norm self attention and feed-forward network."""

    def __init__(
        self, width: int, heads: int, hidden: int, layers: int, causal: bool = False, cross: bool = False
    ) -> None:
        """layers: number of blocks in a row; the more, the smaller the initial weights of each.
        cross: whether the tokens also attend to other tokens: those of an encoder (the decoder of Vaswani et
            al. 2017), or those of the scene's points.
        """
        super().__init__()
        self.heads = heads
        self.causal = causal
        self.norm_attention = nn.LayerNorm(width)
        self.qkv = nn.Linear(width, 3 * width)
        self.merge = nn.Linear(width, width)
        self.norm_mlp = nn.LayerNorm(width)
        self.expand = nn.Linear(width, hidden)
        self.contract = nn.Linear(hidden, width)
        last = [self.merge, self.contract]
        if cross:
            self.norm_cross = nn.LayerNorm(width)
            self.query = nn.Linear(width, width)
            self.key_value = nn.Linear(width, 2 * width)
            self.merge_cross = nn.Linear(width, width)
            last.append(self.merge_cross)
        for layer in last:
            start_small(layer, layers)

    def forward(
        self,
        x: Tokens,
        memory: Float[Tensor, "batch others width"] | None = None,
    ) -> Tokens:
        """memory: the other tokens, if `cross`."""
        q, k, v = split_heads(self.qkv(self.norm_attention(x)), 3, self.heads)
        x = x + self.merge(attend(q, k, v, self.causal))
        if memory is not None:
            (q,) = split_heads(self.query(self.norm_cross(x)), 1, self.heads)
            k, v = split_heads(self.key_value(memory), 2, self.heads)
            x = x + self.merge_cross(attend(q, k, v))
        return x + self.contract(functional.gelu(self.expand(self.norm_mlp(x))))


class TrajectoryTransformer(Denoiser):
    """A transformer whose tokens are patches of waypoints. A further token, z_tk, carries the condition (z,
    the embedding of the scene; start; goal) and the noise level t. The class of its settings selects the
    variant:

    - Encoder-only (the paper's motion predictor): z_tk is before the tokens of the waypoints. It may also be
      added to every other token.
    - Decoder-only (paper, Table 2; Radford et al. 2018): as encoder-only, with causal attention. z_tk is the
      first token, so all waypoints attend to it. One pass predicts all waypoints.
    - With points: z_tk carries start, goal and level, and is added to every other token; each block also
      attends to the points of the scene.
    - Encoder-decoder (paper, Table 2; Vaswani et al. 2017, with norms first): the encoder takes the tokens z,
      start, goal and t, and each block attends to the encoder's output. There is no z_tk.
    """

    positions: Tensor

    def __init__(
        self, settings: AttentionSettings, waypoints: int, dof: int, features: int, condition: int
    ) -> None:
        super().__init__(settings, waypoints, dof, features, condition)
        width = settings.width
        self.sizes = (condition - 2 * dof, dof, dof)
        self.encoded = isinstance(settings, EncoderDecoderSettings)
        self.adds_z_tk = settings.points or (isinstance(settings, TransformerSettings) and settings.add_z_tk)
        self.embed = nn.Linear(settings.patch * features, width)
        if isinstance(settings, EncoderDecoderSettings):
            self.condition = nn.ModuleList(perceptron(size, width, width) for size in self.sizes)
            self.encoder = self._blocks(settings.encoder_layers)
            self.norm_encoded = nn.LayerNorm(width)
        elif settings.points:
            self.ends = perceptron(2 * dof, 2 * width, width)
            self.points = perceptron(3 + 6 * OCTAVES, width, width)
            self.norm_points = nn.LayerNorm(width)
        else:
            self.condition = perceptron(condition, 2 * width, width)
        self.level = LevelEmbedding(width)
        self.blocks = self._blocks(settings.layers, settings.causal, self.encoded or settings.points)
        self.norm = nn.LayerNorm(width)
        self.out = nn.Linear(width, settings.patch * dof)
        start_at_zero(self.out)
        tokens = np.arange(settings.tokens(waypoints))
        self.register_buffer("positions", positions(tokens, width), persistent=False)

    def _blocks(self, count: int, causal: bool = False, cross: bool = False) -> nn.ModuleList:
        sizes = self.settings.width, self.settings.heads, self.settings.hidden
        return nn.ModuleList(Block(*sizes, count, causal, cross) for _ in range(count))

    def set_positions(self, at: Float[ndarray, "tokens"]) -> None:
        """Give the tokens other positions [waypoints]. Patches must have one waypoint. The number of tokens
        may change."""
        self.positions = positions(at, self.settings.width).to(self.positions.device)

    def forward(
        self,
        features: Features,
        level: Levels,
        condition: Conditions,
    ) -> Trajectories:
        """The output for noisy trajectories; level is t / T in [0, 1]."""
        batch = features.shape[0]
        count = len(self.positions)
        x = self.embed(features.reshape(batch, count, -1)) + self.positions
        z_tk = memory = None
        if self.encoded:
            memory = self._encoded(condition, level)
        elif self.settings.points:
            memory = self._points(condition[:, : -2 * self.dof].reshape(batch, -1, 3))
            z_tk = self.ends(condition[:, -2 * self.dof :]) + self.level(level)
        else:
            z_tk = self.condition(condition) + self.level(level)
        if z_tk is not None:
            z_tk = z_tk[:, None]
            waypoints = x + z_tk if self.adds_z_tk else x
            x = torch.cat([z_tk.to(x.dtype), waypoints], 1)
        for block in self.blocks:
            x = block(x, memory)
        return self.out(self.norm(x[:, -count:])).float().reshape(batch, -1, self.dof)

    def _encoded(self, condition: Conditions, level: Levels) -> Float[Tensor, "batch 4 width"]:
        """The encoder's output for the tokens z, start, goal and t."""
        parts = zip(self.condition, condition.split(self.sizes, -1), strict=True)
        memory = torch.stack([*(embed(part) for embed, part in parts), self.level(level)], 1).float()
        for block in self.encoder:
            memory = block(memory)
        return self.norm_encoded(memory)

    def _points(self, points: Float[Tensor, "batch points 3"]) -> Float[Tensor, "batch points width"]:
        """Tokens of the scene's points [m]."""
        angles = torch.cat(wave_angles(points), -1)
        return self.norm_points(self.points(torch.cat([points, angles.sin(), angles.cos()], -1)))


class Convolution(nn.Linear):
    """Convolution over the waypoints, with zeros beyond the ends. Weight: [outputs, kernel * inputs]."""

    def __init__(self, inputs: int, outputs: int, kernel: int) -> None:
        super().__init__(kernel * inputs, outputs)
        self.kernel = kernel

    def forward(
        self, input: Float[Tensor, "batch waypoints inputs"]
    ) -> Float[Tensor, "batch waypoints outputs"]:
        weight = self.weight.unflatten(1, (self.kernel, -1)).mT
        return functional.conv1d(input.mT, weight, self.bias, padding=self.kernel // 2).mT


class ResidualBlock(nn.Module):
    """Two convolutions; between them the condition scales and shifts the channels (FiLM, Perez et al.
    2018)."""

    def __init__(self, inputs: int, outputs: int, kernel: int, condition: int, blocks: int) -> None:
        """blocks: number of residual blocks in a row."""
        super().__init__()
        self.norm_first, self.norm_second = nn.LayerNorm(inputs), nn.LayerNorm(outputs)
        self.first = Convolution(inputs, outputs, kernel)
        self.second = Convolution(outputs, outputs, kernel)
        self.film = nn.Linear(condition, 2 * outputs)
        self.skip = nn.Linear(inputs, outputs) if inputs != outputs else nn.Identity()
        start_small(self.second, blocks)

    def forward(
        self, x: Float[Tensor, "batch waypoints inputs"], condition: Conditions
    ) -> Float[Tensor, "batch waypoints outputs"]:
        scale, shift = self.film(condition)[:, None].float().chunk(2, -1)
        hidden = self.norm_second(self.first(functional.silu(self.norm_first(x))).float())
        hidden = functional.silu(hidden * (1 + scale) + shift)
        return self.skip(x).float() + self.second(hidden)


class UNet(Denoiser):
    """After Janner et al. 2022 and Carvalho et al. 2023 (MPD), with layer norms over the channels.

    Each resolution except the coarsest has two residual blocks on the way down and two on the way up. The
    first one on the way up also gets this resolution's features from the way down. The coarsest has two
    blocks. If the number of waypoints cannot be halved often enough, the last waypoint is repeated, and the
    result is cut.
    """

    def __init__(
        self, settings: UNetSettings, waypoints: int, dof: int, features: int, condition: int
    ) -> None:
        super().__init__(settings, waypoints, dof, features, condition)
        widths = [settings.width * multiple for multiple in settings.multiples]
        halvings = len(widths) - 1
        token = settings.condition_width
        self.padding = -waypoints % 2**halvings

        def blocks(inputs: int, outputs: int) -> nn.ModuleList:
            count = 2 * (2 * halvings + 1)
            first = ResidualBlock(inputs, outputs, settings.kernel, token, count)
            return nn.ModuleList([first, ResidualBlock(outputs, outputs, settings.kernel, token, count)])

        self.condition = perceptron(condition, 2 * token, token)
        self.level = LevelEmbedding(token)
        self.embed = nn.Linear(features, widths[0])
        self.down = nn.ModuleList(blocks(width, width) for width in widths[:-1])
        self.halving = nn.ModuleList(nn.Linear(2 * widths[i], widths[i + 1]) for i in range(halvings))
        self.middle = blocks(widths[-1], widths[-1])
        self.doubling = nn.ModuleList(nn.Linear(widths[i + 1], 2 * widths[i]) for i in range(halvings))
        self.up = nn.ModuleList(blocks(2 * width, width) for width in widths[:-1])
        self.norm = nn.LayerNorm(widths[0])
        self.out = nn.Linear(widths[0], dof)
        start_at_zero(self.out)

    def forward(
        self,
        features: Features,
        level: Levels,
        condition: Conditions,
    ) -> Trajectories:
        """The output for noisy trajectories; level is t / T in [0, 1]."""
        token = functional.silu(self.condition(condition) + self.level(level))
        if self.padding:
            features = torch.cat([features, features[:, -1:].expand(-1, self.padding, -1)], 1)
        x = self.embed(features).float()
        skips = list[Tensor]()
        for blocks, halve in zip(self.down, self.halving, strict=True):
            x = _through(blocks, x, token)
            skips.append(x)
            # two neighboring waypoints become one with the features of both
            x = halve(x.reshape(x.shape[0], x.shape[1] // 2, -1)).float()
        x = _through(self.middle, x, token)
        for blocks, double, before in zip(
            reversed(self.up), reversed(self.doubling), reversed(skips), strict=True
        ):
            x = double(x).float().reshape(before.shape)
            x = _through(blocks, torch.cat([x, before], -1), token)
        return self.out(self.norm(x[:, : self.waypoints])).float()


def _through(blocks: nn.Module, x: Tensor, token: Tensor) -> Tensor:
    for block in blocks.children():
        x = block(x, token)
    return x
