"""PointNet++ without normalisation layers, as MPiNets uses it: set abstraction, then all points at once.

C. Qi et al., "PointNet++: Deep hierarchical feature learning on point sets in a metric space", NeurIPS 2017.
Around each centre the nearest points of the ball are taken; the authors take the first in the cloud's order.
"""

from itertools import pairwise
from typing import Any

import torch
from jaxtyping import Float, Int64
from torch import Tensor, nn

from robotdiffuse.learning.max_pool import max_pool
from robotdiffuse.learning.networks.point_groups import group_points


class _LinearReLU(torch.autograd.Function):
    """relu(x W^T + b), whose gradient for b is a matrix product: PyTorch's sum over bf16 rows is slow on
    CPUs."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        y = torch.addmm(bias, x, weight.t()).relu_()
        ctx.save_for_backward(x, weight, y)
        return y

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, Tensor, Tensor]:
        x, weight, y = ctx.saved_tensors
        g = torch.ops.aten.threshold_backward(gradients[0], y, 0)
        back = g @ weight if ctx.needs_input_grad[0] else None
        return back, g.t() @ x, (g.new_ones(1, len(g)) @ g)[0]


class PooledLayers(nn.Module):
    """Linear layers with ReLUs on each point by itself, then the maximum over a group's points."""

    def __init__(self, channels: int, widths: tuple[int, ...]) -> None:
        super().__init__()
        *first, last = pairwise((channels, *widths))
        self.layers = nn.ModuleList(nn.Linear(*sizes) for sizes in first)
        self.last = nn.Linear(*last)

    def forward(self, x: Float[Tensor, "*groups points channels"]) -> Float[Tensor, "*groups width"]:
        rows = x.reshape(-1, x.shape[-1])
        for layer in self.layers:
            weight, bias = (parameter.to(x.dtype) for parameter in layer.parameters())
            rows = _LinearReLU.apply(rows, weight, bias)
        # the last bias and ReLU do not change which point has the maximum
        rows = rows @ self.last.weight.to(x.dtype).t()
        best = max_pool(rows.view(-1, x.shape[-2], self.last.out_features))
        return (best + self.last.bias.to(x.dtype)).relu().view(*x.shape[:-2], -1)


class SetAbstraction(nn.Module):
    """Selects some of the points, with features computed from the points around each."""

    def __init__(
        self, channels: int, widths: tuple[int, ...], centres: int, neighbours: int, radius: float
    ) -> None:
        """`channels` of each point's features; `widths` of the layers; `radius` of the balls [m]."""
        super().__init__()
        self.centres, self.neighbours, self.radius = centres, neighbours, radius
        self.layers = PooledLayers(3 + channels, widths)

    def forward(
        self, points: Float[Tensor, "b n 3"], features: Float[Tensor, "b n channels"]
    ) -> tuple[Float[Tensor, "b m 3"], Float[Tensor, "b m width"]]:
        """The centres and their features; points and centres in [m]."""
        found = group_points(points.detach().numpy(), self.centres, self.neighbours, self.radius)
        centres, around = (torch.from_numpy(part) for part in found)
        at = _rows(points, centres)
        offsets = (_rows(points, around) - at[:, :, None]) / self.radius
        grouped = torch.cat([offsets.to(features.dtype), _rows(features, around)], -1)
        return at, self.layers(grouped)


class GroupAll(nn.Module):
    """Computes features of all points together."""

    def __init__(self, channels: int, widths: tuple[int, ...]) -> None:
        super().__init__()
        self.layers = PooledLayers(3 + channels, widths)

    def forward(
        self, points: Float[Tensor, "b n 3"], features: Float[Tensor, "b n channels"]
    ) -> Float[Tensor, "b width"]:
        return self.layers(torch.cat([points.to(features.dtype), features], -1))


def _rows(values: Float[Tensor, "b n c"], at: Int64[Tensor, "b *m"]) -> Float[Tensor, "b *m c"]:
    """The rows of each cloud with the indices `at`."""
    b, n, c = values.shape
    first = torch.arange(0, b * n, n).view(b, *[1] * (at.dim() - 1))
    return values.reshape(b * n, c).index_select(0, (at + first).reshape(-1)).view(*at.shape, c)
