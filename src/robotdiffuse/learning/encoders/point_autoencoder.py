"""The point cloud auto-encoder ("CAE", PointEnet; paper, section Condition embedding).

The paper's encoder is a perceptron over 1,400 points in a fixed order. This one applies a perceptron to each
point and pools (Qi et al. 2017, PointNet), so that neither the order nor the number of points matters.
"""

from dataclasses import dataclass
from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from robotdiffuse.errors import InputError
from robotdiffuse.scenes.sampling import PANDA_REGION, VisibleRegion


@dataclass(frozen=True)
class PointAutoencoderSettings:
    code: int = 96
    """Size of z (paper: 60, for two obstacles)."""
    points: tuple[int, ...] = (64, 128, 256)
    """Layers of the perceptron on each point."""
    octaves: int = 4
    """Sines and cosines of the coordinates that a point comes with, of wavelengths 4 m, 2 m, ..."""
    hidden: int = 384
    """Layer between the pooled features and z, and in the decoder."""
    decoded: int = 192
    """Points that the decoder reconstructs."""
    region: VisibleRegion = PANDA_REGION
    """Points outside do not count: the arm gets nowhere near them."""

    def __post_init__(self) -> None:
        if not self.points or min(self.points) < 1:
            raise InputError(f"encoder.points is {self.points}; it must be the sizes of one layer or more")


class PointAutoencoder(nn.Module):
    """z = MLP(max-pool and mean-pool of MLP(point)); decoded to points and to a distance field."""

    center: Tensor
    mean: Tensor
    scale: Tensor

    def __init__(self, settings: PointAutoencoderSettings) -> None:
        super().__init__()
        self.settings = settings
        sizes = (3 + 6 * settings.octaves, *settings.points)
        self.points = nn.ModuleList(nn.Linear(a, b) for a, b in pairwise(sizes))
        self.empty = nn.Parameter(torch.zeros(2 * sizes[-1]))
        hidden, code = settings.hidden, settings.code
        self.head = nn.Sequential(
            nn.LayerNorm(2 * sizes[-1]), nn.Linear(2 * sizes[-1], hidden), nn.GELU("tanh"),
            nn.Linear(hidden, code),
        )  # fmt: skip
        self.decoder = nn.Sequential(
            nn.Linear(code, hidden), nn.GELU("tanh"), nn.Linear(hidden, hidden), nn.GELU("tanh"),
            nn.Linear(hidden, 3 * settings.decoded),
        )  # fmt: skip
        self.query_code = nn.Linear(code, 192)
        self.query_point = nn.Linear(sizes[0], 192)
        self.query = nn.Sequential(
            nn.GELU("tanh"), nn.Linear(192, 192), nn.GELU("tanh"), nn.Linear(192, 192), nn.GELU("tanh"),
            nn.Linear(192, 1),
        )  # fmt: skip
        self.register_buffer("center", torch.tensor(settings.region.center), persistent=False)
        self.register_buffer("mean", torch.zeros(code))
        self.register_buffer("scale", torch.ones(code))

    def near(self, cloud: Float[Tensor, "batch points 3"]) -> Tensor:
        """Which points count, [batch points] of bool: those in the region."""
        region = self.settings.region
        return ((cloud - self.center).square().sum(-1) < region.reach**2) & (cloud[..., 2] > region.floor)

    def forward(self, cloud: Float[Tensor, "batch points 3"]) -> Float[Tensor, "batch code"]:
        """z of each cloud; standardised once `standardize` was called. A cloud may hold no point at all.

        Points outside the region do not count, so that clouds of different size may share a batch.
        """
        return (self.encode(cloud) - self.mean) / self.scale

    def encode(self, cloud: Float[Tensor, "batch points 3"]) -> Float[Tensor, "batch code"]:
        """z before standardisation."""
        empty = self.empty.expand(len(cloud), -1)
        if cloud.shape[1] == 0:
            return self.head(empty).float()
        near = self.near(cloud)[..., None]
        with torch.autocast(cloud.device.type, enabled=False):  # bf16 would round coordinates to 4 mm
            x = functional.relu(self.points[0](self._waves(cloud)))
        for layer in list(self.points)[1:]:
            x = functional.relu(layer(x))
        x = x * near  # features are not negative, so a zero loses every maximum
        count = near.sum(1)
        pooled = torch.cat([x.amax(1).float(), x.float().sum(1) / count.clamp(min=1)], -1)
        return self.head(torch.where(count > 0, pooled, empty)).float()

    def _waves(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch waves"]:
        """Coordinates with their sines and cosines, which let a small perceptron tell places apart."""
        angles = [points * (torch.pi / 2 * 2**octave) for octave in range(self.settings.octaves)]
        return torch.cat([points, *(part for a in angles for part in (a.sin(), a.cos()))], -1)

    def decode(self, code: Float[Tensor, "batch code"]) -> Float[Tensor, "batch decoded 3"]:
        """Reconstructed points [m], from z before standardisation."""
        return self.decoder(code).float().view(len(code), -1, 3)

    def distance(
        self, code: Float[Tensor, "batch code"], at: Float[Tensor, "batch queries 3"]
    ) -> Float[Tensor, "batch queries"]:
        """Reconstructed distance [m] of places to the cloud, from z before standardisation."""
        return (
            self.query(self.query_code(code)[:, None] + self.query_point(self._waves(at))).float().squeeze(-1)
        )

    def standardize(self, codes: Float[Tensor, "batch code"]) -> None:
        """Scale z so that these codes have mean 0 and variance 1 in every place."""
        self.mean.copy_(codes.mean(0))
        self.scale.copy_(codes.std(0).clamp(min=1e-4))


def nearest(
    a: Float[Tensor, "batch n 3"], b: Float[Tensor, "batch m 3"], allowed: Tensor
) -> tuple[Tensor, Tensor]:
    """Index [batch n] of the nearest point of `b` that is allowed ([batch m] of bool), and the reverse.

    The reverse [batch m] is the index of the nearest point of `a` to each of `b`.
    """
    with torch.no_grad():
        b = torch.where(allowed[..., None], b, 100.0).float()
        # |a - b|^2 without its constant |a|^2, which is added for the reverse only.
        squared = torch.baddbmm(b.square().sum(-1)[:, None], a.float(), b.mT, alpha=-2.0)
        forth = squared.argmin(2)
        return forth, squared.add_(a.float().square().sum(-1)[..., None]).argmin(1)


def pick(points: Float[Tensor, "batch n 3"], index: Tensor) -> Float[Tensor, "batch m 3"]:
    """Points [batch m] by index."""
    return points.gather(1, index[..., None].expand(-1, -1, 3))


def chamfer(
    decoded: Float[Tensor, "batch n 3"], cloud: Float[Tensor, "batch m 3"], near: Tensor
) -> Float[Tensor, ""]:
    """Chamfer distance [m]: root mean square distance to the nearest point of the other set, both ways.

    `near` [batch m] says which points of the cloud count; clouds without any are left out.
    """
    to_cloud, to_decoded = nearest(decoded, cloud, near)
    forth = (decoded - pick(cloud, to_cloud)).square().sum(-1)
    back = (cloud - pick(decoded, to_decoded)).square().sum(-1)
    filled = near.any(1)
    forth = forth.mean(1)[filled].mean()
    back = (back * near).sum() / near.sum().clamp(min=1)
    return (forth + 1e-8).sqrt() + (back + 1e-8).sqrt()
