"""What every encoder of the scene has in common."""

from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32
from numpy import ndarray
from numpy.random import Generator
from torch import Tensor, nn

from robotdiffuse.core.settings import Count, Settings
from robotdiffuse.learning.max_pool import greatest
from robotdiffuse.perception.depth_view import DepthView
from robotdiffuse.perception.seen_points import seen_points
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.surface_points import PANDA_REGION, VisibleRegion


@dataclass(frozen=True)
class EncoderSettings(Settings, name="encoder"):
    """What training and planning need to know of any encoder."""

    code: Count = 96
    """Size of z (paper: 60, for two obstacles)."""
    cloud: Count = 512
    """Points of the clouds that it is given."""
    region: VisibleRegion = PANDA_REGION
    """Points outside do not count: the arm gets nowhere near them. A large reach: whole surfaces."""

    @classmethod
    def paper_size(cls) -> "EncoderSettings":
        """The sizes that the authors of this encoder give, with z of this paper's size."""
        return cls(code=60)


class Encoder(nn.Module, ABC):
    """Point cloud to z. The order of the points never matters to `forward`, and a cloud may hold none."""

    any_size: ClassVar[bool] = True
    """Clouds of any size serve it well; otherwise they should be of about `settings.cloud` points."""
    settings: EncoderSettings
    center: Tensor

    def __init__(self, settings: EncoderSettings) -> None:
        super().__init__()
        self.settings = settings
        self.register_buffer("center", torch.tensor(settings.region.center), persistent=False)

    @abstractmethod
    def forward(self, cloud: Float[Tensor, "batch points 3"]) -> Float[Tensor, "batch code"]:
        """z of each cloud [m], float32.

        Points outside the region do not count, so that clouds of different size may share a batch.
        """

    def of_views(
        self, views: Sequence[DepthView], robot: Robot, start: Float[ndarray, "dof"]
    ) -> Float[Tensor, "code"]:
        """z of what depth views saw, the arm at `start` where they do not say."""
        return self(torch.from_numpy(self.told_points(views, robot, start))[None])[0]

    def told_points(
        self, views: Sequence[DepthView], robot: Robot, start: Float[ndarray, "dof"]
    ) -> Float32[ndarray, "n 3"]:
        """The points of depth views that count [m]: at most `settings.cloud` of those seen in the region."""
        points = seen_points(views, robot, start)
        points = points[self.settings.region.holds(points)]
        most = min(len(points), self.settings.cloud)
        return points[(np.arange(most) * 2 + 1) * len(points) // (2 * max(most, 1))]

    def near(self, cloud: Float[Tensor, "batch points 3"]) -> Bool[Tensor, "batch points"]:
        """Which points count: those in the region, and no zeros, which `surface_clouds` fills up with."""
        region = self.settings.region
        inside = (cloud - self.center).square().sum(-1) < region.reach**2
        return inside & (cloud[..., 2] > region.floor) & (cloud != 0).any(-1)


class Autoencoder(Encoder):
    """An encoder that is trained alone, to reconstruct what it encodes."""

    mean: Tensor
    scale: Tensor

    def __init__(self, settings: EncoderSettings) -> None:
        super().__init__(settings)
        self.register_buffer("mean", torch.zeros(settings.code))
        self.register_buffer("scale", torch.ones(settings.code))

    def forward(self, cloud: Float[Tensor, "batch points 3"]) -> Float[Tensor, "batch code"]:
        """z of each cloud; standardised once `standardize` was called. A cloud may hold no point at all.

        Points outside the region do not count, so that clouds of different size may share a batch.
        """
        return (self.encode(cloud) - self.mean) / self.scale

    @abstractmethod
    def encode(self, cloud: Float[Tensor, "batch points 3"]) -> Float[Tensor, "batch code"]:
        """z before standardisation."""

    def standardize(self, codes: Float[Tensor, "batch code"]) -> None:
        """Scale z so that these codes have mean 0 and variance 1 in every place."""
        self.mean.copy_(codes.mean(0))
        self.scale.copy_(codes.std(0).clamp(min=1e-4))

    @abstractmethod
    def loss(
        self, cloud: Float[Tensor, "batch points 3"], rng: Generator
    ) -> tuple[Float[Tensor, ""], dict[str, float]]:
        """Loss of the reconstruction, and its errors by name, in metres."""

    @abstractmethod
    def penalised(self) -> Iterable[Tensor]:
        """The weights theta of the paper's regulariser, lambda * sum theta^2."""


def fp32(tensor: Tensor) -> torch.autocast:
    """No bf16 within: it would round coordinates to 4 mm."""
    return torch.autocast(tensor.device.type, enabled=False)


def pool_max(
    features: Float[Tensor, "batch points channels"], near: Bool[Tensor, "batch points"]
) -> Float[Tensor, "batch channels"]:
    """Greatest feature over the points that count; zeros where none does."""
    low = torch.finfo(features.dtype).min
    best = greatest(features.masked_fill(~near[..., None], low))
    return best.masked_fill(~near.any(1, keepdim=True), 0.0)


def pool_mean(
    features: Float[Tensor, "batch points channels"], near: Bool[Tensor, "batch points"]
) -> Float[Tensor, "batch channels"]:
    """Mean feature over the points that count; zeros where none does."""
    return (features.float() * near[..., None]).sum(1) / near.sum(1, keepdim=True).clamp(min=1)
