"""PointNet (Qi et al. 2017, "PointNet: Deep Learning on Point Sets"), trained with the planner.

A perceptron on each point, a maximum over the points, and a perceptron on that; two small networks of the
same form first transform the coordinates and the features. Unlike the original, features are normalised over
the channels of a point (layer norm) and not over the batch: a code must not depend on the other clouds,
clouds may hold points that do not count, and averaged weights have no averaged batch statistics. There is no
dropout, and no loss that keeps the feature transform orthogonal, since the planner's loss is the only one;
the transforms start close to the identity.
"""

from itertools import pairwise

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from robotdiffuse.learning.encoders.base import Encoder, fp32, pool_max
from robotdiffuse.learning.encoders.settings import PointNetSettings


def layers(sizes: tuple[int, ...]) -> nn.Sequential:
    """Linear layer, layer norm and ReLU for each size after the first."""
    return nn.Sequential(
        *(
            part
            for a, b in pairwise(sizes)
            for part in (nn.Linear(a, b), nn.LayerNorm(b), nn.ReLU())
        )
    )  # fmt: skip


class Transform(nn.Module):
    """T-Net: a square matrix for each cloud, close to the identity at first."""

    def __init__(self, size: int, settings: PointNetSettings) -> None:
        super().__init__()
        self.size = size
        self.points = layers((size, *settings.transform))
        sizes = (settings.transform[-1], *settings.transform_head)
        self.head = layers(sizes)
        self.out = nn.Linear(sizes[-1], size * size)
        nn.init.normal_(self.out.weight, std=1e-3)
        with torch.no_grad():
            self.out.bias.copy_(torch.eye(size).flatten())

    def forward(
        self, x: Float[Tensor, "batch points size"], near: Bool[Tensor, "batch points"]
    ) -> Float[Tensor, "batch points size"]:
        matrix = self.out(self.head(pool_max(self.points(x), near)))
        return x @ matrix.view(-1, self.size, self.size).to(x.dtype)


class PointNet(Encoder):
    """z = MLP(max over points of MLP(T2 MLP(T1 point)))."""

    def __init__(self, settings: PointNetSettings) -> None:
        super().__init__(settings)
        self.turn_input = Transform(3, settings) if settings.input_transform else None
        self.first = layers((3, *settings.first))
        self.turn_features = Transform(settings.first[-1], settings) if settings.feature_transform else None
        self.second = layers((settings.first[-1], *settings.second))
        self.empty = nn.Parameter(torch.zeros(settings.second[-1]))
        sizes = (settings.second[-1], *settings.head)
        self.head = nn.Sequential(layers(sizes), nn.Linear(sizes[-1], settings.code))

    def forward(self, cloud: Float[Tensor, "batch points 3"]) -> Float[Tensor, "batch code"]:
        if cloud.shape[1] == 0:
            return self.head(self.empty.expand(len(cloud), -1)).float()
        near = self.near(cloud)
        with fp32(cloud):
            x = cloud if self.turn_input is None else self.turn_input(cloud, near)
            x = self.first(x)
        if self.turn_features is not None:
            x = self.turn_features(x, near)
        pooled = pool_max(self.second(x), near).float()
        return self.head(torch.where(near.any(1, keepdim=True), pooled, self.empty)).float()
