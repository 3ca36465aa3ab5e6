"""The point cloud auto-encoder ("CAE", PointEnet; paper, section Condition embedding).

The paper's encoder is a perceptron over 1,400 points in a fixed order. This one applies a perceptron to each
point and pools (Qi et al. 2017, PointNet), so that neither the order nor the number of points matters.
"""

from collections.abc import Iterable
from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Float
from numpy.random import Generator
from torch import Tensor, nn
from torch.nn import functional

from robotdiffuse.learning.encoders.base import Autoencoder, fp32, wave_angles
from robotdiffuse.learning.encoders.settings import PointAutoencoderSettings

DISTANCE_QUERIES = 96
"""Positions per cloud at which the distance field is reconstructed."""
DISTANCE_CAP = 0.5
"""Reconstructed distances are capped at this [m]."""


class PointAutoencoder(Autoencoder):
    """z = MLP(max-pool and mean-pool of MLP(point)); decoded to points and to a distance field."""

    settings: PointAutoencoderSettings

    def __init__(self, settings: PointAutoencoderSettings) -> None:
        super().__init__(settings)
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

    def encode(self, cloud: Float[Tensor, "batch points 3"]) -> Float[Tensor, "batch code"]:
        """z before standardisation."""
        empty = self.empty.expand(len(cloud), -1)
        if cloud.shape[1] == 0:
            return self.head(empty).float()
        near = self.near(cloud)[..., None]
        with fp32(cloud):
            x = functional.relu(self.points[0](self._waves(cloud)))
        for layer in list(self.points)[1:]:
            x = functional.relu(layer(x))
        x = x * near  # features are not negative, so zeros never change a maximum
        count = near.sum(1)
        pooled = torch.cat([x.amax(1).float(), x.float().sum(1) / count.clamp(min=1)], -1)
        return self.head(torch.where(count > 0, pooled, empty)).float()

    def _waves(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch waves"]:
        """Coordinates with the sines and cosines of `wave_angles`."""
        angles = wave_angles(points, self.settings.octaves)
        return torch.cat([points, *(part for a in angles for part in (a.sin(), a.cos()))], -1)

    def decode(self, code: Float[Tensor, "batch code"]) -> Float[Tensor, "batch decoded 3"]:
        """Reconstructed points [m], from z before standardisation."""
        return self.decoder(code).float().view(len(code), -1, 3)

    def distance(
        self, code: Float[Tensor, "batch code"], at: Float[Tensor, "batch queries 3"]
    ) -> Float[Tensor, "batch queries"]:
        """Reconstructed distance [m] of positions to the cloud, from z before standardisation."""
        return (
            self.query(self.query_code(code)[:, None] + self.query_point(self._waves(at))).float().squeeze(-1)
        )

    def loss(
        self, cloud: Float[Tensor, "batch points 3"], rng: Generator
    ) -> tuple[Float[Tensor, ""], dict[str, float]]:
        """Chamfer distance plus the weighted error of the distance field.

        Errors: `chamfer`, both ways added; `distance`, mean error of the distance field;
        `distance_of_constant`, that of a constant, all [m].
        """
        near = self.near(cloud)
        at = self._query_positions(cloud, rng)
        index, _ = nearest(at, cloud, near)
        truth = (at - pick(cloud, index)).norm(dim=-1).clamp(max=DISTANCE_CAP)
        truth = torch.where(near.any(1)[:, None], truth, DISTANCE_CAP)
        code = self.encode(cloud)
        guess = self.distance(code, at)
        apart = chamfer(self.decode(code), cloud, near)
        field = functional.smooth_l1_loss(guess, truth, beta=0.01)
        errors = {
            "chamfer": apart.item(),
            "distance": (guess - truth).abs().mean().item(),
            "distance_of_constant": (truth - truth.median()).abs().mean().item(),
        }
        return apart + self.settings.distance_weight * field, errors

    def _query_positions(
        self, cloud: Float[Tensor, "batch points 3"], rng: Generator
    ) -> Float[Tensor, "batch queries 3"]:
        """Positions at which the distance is reconstructed: half of them close to the surfaces."""
        batch, points, _ = cloud.shape
        low, high = np.array([-1.0, -1.0, 0.0]), np.array([1.0, 1.0, 1.3])
        positions = torch.from_numpy(rng.uniform(low, high, (batch, DISTANCE_QUERIES, 3)).astype(np.float32))
        chosen = torch.from_numpy(rng.integers(0, points, DISTANCE_QUERIES // 2))
        spread = torch.from_numpy(
            0.1 * rng.standard_normal((batch, DISTANCE_QUERIES // 2, 3), dtype=np.float32)
        )
        positions, close = positions.to(cloud.device), cloud[:, chosen] + spread.to(cloud.device)
        away = ~self.near(close)[..., None]
        return torch.cat(
            [
                torch.where(away, positions[:, : DISTANCE_QUERIES // 2], close),
                positions[:, DISTANCE_QUERIES // 2 :],
            ],
            1,
        )

    def penalised(self) -> Iterable[Tensor]:
        """All parameters."""
        return self.parameters()


def nearest(
    a: Float[Tensor, "batch n 3"], b: Float[Tensor, "batch m 3"], allowed: Tensor
) -> tuple[Tensor, Tensor]:
    """For each point of a, the index [batch n] of the nearest point of b that is allowed ([batch m] of bool);
    and for each point of b the index [batch m] of the nearest point of a.
    """
    with torch.no_grad(), fp32(a):
        b = torch.where(allowed[..., None], b, 100.0).float()
        # |a - b|^2 without |a|^2, which is constant over b, and so is needed for the reverse only
        squared = torch.baddbmm(b.square().sum(-1)[:, None], a.float(), b.mT, alpha=-2.0)
        forth = squared.argmin(2)
        return forth, squared.add_(a.float().square().sum(-1)[..., None]).argmin(1)


def pick(points: Float[Tensor, "batch n 3"], index: Tensor) -> Float[Tensor, "batch m 3"]:
    """The points with these indices [batch m]."""
    return points.gather(1, index[..., None].expand(-1, -1, 3))


def chamfer(
    decoded: Float[Tensor, "batch n 3"], cloud: Float[Tensor, "batch m 3"], near: Tensor
) -> Float[Tensor, ""]:
    """Chamfer distance [m]: root mean square distance to the nearest point of the other set, both ways.

    near: which points of the cloud count [batch m]; clouds without any are left out.
    """
    to_cloud, to_decoded = nearest(decoded, cloud, near)
    forth = (decoded - pick(cloud, to_cloud)).square().sum(-1)
    back = (cloud - pick(decoded, to_decoded)).square().sum(-1)
    filled = near.any(1)
    forth = forth.mean(1)[filled].mean()
    back = (back * near).sum() / near.sum().clamp(min=1)
    return (forth + 1e-8).sqrt() + (back + 1e-8).sqrt()
