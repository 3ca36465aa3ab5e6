"""DGCNN (Wang et al. 2019, "Dynamic Graph CNN for Learning on Point Clouds"), trained with the planner.

Each layer joins every point with its nearest neighbours, in the space of that layer's own input, and takes
the maximum over the edges of h(x_i, x_j - x_i). The original's h is a linear layer, batch norm and leaky
ReLU. Here the norm is over the channels of a point (pointnet.py says why) and comes after the maximum.
Without a norm on the edges, the maximum commutes with the rest: with h = W [x_i, x_j - x_i] = (A - B) x_i +
B x_j, it is over B x_j alone, and the layer costs two matrix products per point instead of one per edge.
"""

from itertools import pairwise

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor, nn
from torch.nn import functional

from robotdiffuse.learning.encoders.base import Encoder, fp32, pool_max, pool_mean
from robotdiffuse.learning.encoders.settings import DGCNNSettings
from robotdiffuse.learning.max_pool import max_pool

NEGATIVE_SLOPE = 0.2
"""Slope of the leaky ReLU below zero, as in the original."""
IGNORED_DISTANCE = 1e9
"""Squared distance that is given to points that do not count."""


def neighbours(
    x: Float[Tensor, "batch points channels"], near: Bool[Tensor, "batch points"], count: int
) -> Int64[Tensor, "batch points neighbours"]:
    """Indices of each point's `count` nearest neighbours, itself included; where there are fewer, itself
    again."""
    with torch.no_grad(), fp32(x):
        x = x.detach().float()
        squared = x.square().sum(-1)
        # |a - b|^2 without |a|^2, which is the same for all neighbours of a
        apart = torch.baddbmm(squared[:, None], x, x.mT, alpha=-2.0)
        apart = apart.masked_fill(~near[:, None], IGNORED_DISTANCE)
        found = apart.topk(min(count, x.shape[1]), dim=-1, largest=False, sorted=False)
        itself = torch.arange(x.shape[1], device=x.device)[:, None]
        return torch.where(found.values < IGNORED_DISTANCE, found.indices, itself)


class EdgeConvolution(nn.Module):
    """max over neighbours j of h(x_i, x_j - x_i)."""

    def __init__(self, channels: int, out: int, count: int) -> None:
        super().__init__()
        self.count = count
        self.own = nn.Linear(channels, out)
        self.other = nn.Linear(channels, out, bias=False)
        self.norm = nn.LayerNorm(out)

    def forward(
        self, x: Float[Tensor, "batch points channels"], near: Bool[Tensor, "batch points"]
    ) -> Float[Tensor, "batch points out"]:
        index = neighbours(x, near, self.count)
        other = self.other(x)
        offset = other.shape[1] * torch.arange(len(other), device=x.device)[:, None, None]
        joined = other.flatten(0, 1)[(index + offset).flatten(0, 1)]
        pooled = max_pool(joined).view_as(other)
        return functional.leaky_relu(self.norm(self.own(x) + pooled), NEGATIVE_SLOPE)


class DGCNN(Encoder):
    """z = MLP(max-pool and mean-pool of MLP(outputs of all edge convolutions))."""

    def __init__(self, settings: DGCNNSettings) -> None:
        super().__init__(settings)
        self.edges = nn.ModuleList(
            EdgeConvolution(a, b, settings.neighbours) for a, b in pairwise((3, *settings.edges))
        )
        self.embed = nn.Sequential(
            nn.Linear(sum(settings.edges), settings.embedding),
            nn.LayerNorm(settings.embedding),
            nn.LeakyReLU(NEGATIVE_SLOPE),
        )
        sizes = (2 * settings.embedding, *settings.head)
        self.empty = nn.Parameter(torch.zeros(sizes[0]))
        head = [(nn.Linear(a, b), nn.LayerNorm(b), nn.LeakyReLU(NEGATIVE_SLOPE)) for a, b in pairwise(sizes)]
        self.head = nn.Sequential(
            *(part for parts in head for part in parts), nn.Linear(sizes[-1], settings.code)
        )

    def forward(self, cloud: Float[Tensor, "batch points 3"]) -> Float[Tensor, "batch code"]:
        if cloud.shape[1] == 0:
            return self.head(self.empty.expand(len(cloud), -1)).float()
        near = self.near(cloud)
        found: list[Tensor] = []
        with fp32(cloud):
            found.append(self.edges[0](cloud, near))
        for layer in list(self.edges)[1:]:
            found.append(layer(found[-1], near))
        x = self.embed(torch.cat(found, -1))
        pooled = torch.cat([pool_max(x, near).float(), pool_mean(x, near)], -1)
        return self.head(torch.where(near.any(1, keepdim=True), pooled, self.empty)).float()
