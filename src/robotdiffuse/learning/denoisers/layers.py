"""Layers shared by the denoisers. The residual stream is fp32; under autocast the linear layers are bf16."""

import numpy as np
import torch
from jaxtyping import Float, Real
from numpy import ndarray
from torch import Tensor, nn
from torch.nn import functional

MAX_UNFUSED_TOKENS = 96
"""Up to this number of tokens, attention in fp32 on a CPU does without the fused kernel; in bf16 always.
Measured with torch 2.13 on one thread, forward and backward [ms], unfused in bf16, unfused in fp32, fused in
fp32. Batch 64, 4 heads of 128 numbers: 31 tokens 13, 30 and 34; 66 tokens 29, 76 and 56; 97 tokens 49, 93 and
121; 255 tokens 274, 813 and 480. Batch 128, 5 heads of 32 numbers: 13 tokens 4.5, 8.8 and 8.1."""


def two_layers(inputs: int, hidden: int, outputs: int) -> nn.Sequential:
    """A feed-forward network with one hidden layer."""
    return nn.Sequential(nn.Linear(inputs, hidden), nn.GELU("tanh"), nn.Linear(hidden, outputs))


class LevelEmbedding(nn.Sequential):
    """The noise level t / T as `width` numbers: sines and cosines, then a feed-forward network."""

    frequencies: Tensor

    def __init__(self, width: int) -> None:
        super().__init__(*two_layers(width, width, width))
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
    """Attention of tokens to others; causal: each token only to those up to itself.

    Plain matrix products serve bf16 and short sequences on a CPU, where the fused kernel is slower; the fused
    kernel serves the others and GPUs.
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
        # padded to a multiple of 16, softmax over few tokens is eight times as fast
        padded = functional.pad(scores, (0, -scores.shape[-1] % 16), value=-torch.inf)
        mixed = torch.softmax(padded, dim=-1)[..., : scores.shape[-1]] @ v
    return mixed.transpose(1, 2).reshape(batch, tokens, heads * size)


class Block(nn.Module):
    """A transformer block: pre-norm self attention and feed-forward network."""

    def __init__(self, width: int, heads: int, hidden: int, layers: int, causal: bool = False) -> None:
        """layers: number of blocks in a row; the more, the smaller the initial weights of each."""
        super().__init__()
        self.heads, self.causal = heads, causal
        self.norm_attention = nn.LayerNorm(width)
        self.qkv = nn.Linear(width, 3 * width)
        self.merge = nn.Linear(width, width)
        self.norm_mlp = nn.LayerNorm(width)
        self.expand = nn.Linear(width, hidden)
        self.contract = nn.Linear(hidden, width)
        for layer in (self.merge, self.contract):
            start_small(layer, layers)

    def attention(self, x: Float[Tensor, "batch tokens width"]) -> Float[Tensor, "batch tokens width"]:
        q, k, v = split_heads(self.qkv(self.norm_attention(x)), 3, self.heads)
        return x + self.merge(attend(q, k, v, self.causal))

    def feed_forward(self, x: Float[Tensor, "batch tokens width"]) -> Float[Tensor, "batch tokens width"]:
        hidden = functional.gelu(self.expand(self.norm_mlp(x)))
        return x + self.contract(hidden)

    def forward(self, x: Float[Tensor, "batch tokens width"]) -> Float[Tensor, "batch tokens width"]:
        return self.feed_forward(self.attention(x))


class CrossBlock(Block):
    """A block with attention to the tokens of an encoder in between (the decoder of Vaswani et al. 2017)."""

    def __init__(self, width: int, heads: int, hidden: int, layers: int) -> None:
        super().__init__(width, heads, hidden, layers)
        self.norm_cross = nn.LayerNorm(width)
        self.query = nn.Linear(width, width)
        self.key_value = nn.Linear(width, 2 * width)
        self.merge_cross = nn.Linear(width, width)
        start_small(self.merge_cross, layers)

    def forward(
        self, x: Float[Tensor, "batch tokens width"], memory: Float[Tensor, "batch others width"]
    ) -> Float[Tensor, "batch tokens width"]:
        x = self.attention(x)
        (q,) = split_heads(self.query(self.norm_cross(x)), 1, self.heads)
        k, v = split_heads(self.key_value(memory), 2, self.heads)
        x = x + self.merge_cross(attend(q, k, v))
        return self.feed_forward(x)


def start_small(layer: nn.Linear, layers: int) -> None:
    """Initialise the last layer of a residual branch, one of `layers` in a row."""
    nn.init.normal_(layer.weight, std=0.02 / (2 * layers) ** 0.5)
    nn.init.zeros_(layer.bias)


def start_at_zero(layer: nn.Linear) -> None:
    """Initialise the last layer of a network to zero."""
    nn.init.zeros_(layer.weight)
    nn.init.zeros_(layer.bias)
