"""The interface of all encoders of the scene."""

from abc import ABC, abstractmethod
from collections.abc import Iterable

import torch
from jaxtyping import Bool, Float
from numpy.random import Generator
from torch import Tensor, nn

from robotdiffuse.datasets.surface_clouds import sort_points
from robotdiffuse.learning.encoders.settings import EncoderSettings, curve_keys
from robotdiffuse.learning.max_pool import max_pool


class Encoder(nn.Module, ABC):
    """A network from a point cloud to z. The order of the points does not matter, and a cloud may be
    empty."""

    settings: EncoderSettings
    center: Tensor

    def __init__(self, settings: EncoderSettings) -> None:
        super().__init__()
        self.settings = settings
        self.register_buffer("center", torch.tensor(settings.region.center), persistent=False)

    @abstractmethod
    def forward(self, cloud: Float[Tensor, "batch points 3"]) -> Float[Tensor, "batch code"]:
        """z of each cloud [m], float32.

        Points outside the region are ignored, so that clouds of different size can share a batch.
        """

    def code_of_ordered(self, cloud: Float[Tensor, "batch points 3"]) -> Float[Tensor, "batch code"]:
        """z of clouds that already have the size and order that the settings ask for; for export."""
        return self(cloud)

    def near(self, cloud: Float[Tensor, "batch points 3"]) -> Bool[Tensor, "batch points"]:
        """The points that count: those in the region, without the zeros that `surface_clouds` pads with."""
        region = self.settings.region
        inside = (cloud - self.center).square().sum(-1) < region.reach**2
        return inside & (cloud[..., 2] > region.floor) & (cloud != 0).any(-1)

    def arrange(self, cloud: Float[Tensor, "batch points 3"]) -> Float[Tensor, "batch cloud 3"]:
        """`settings.cloud` points, sorted by x, then y, then z, or along a curve.

        More points are thinned evenly in that order, fewer are repeated, and an empty cloud becomes zeros.
        Without a curve, clouds of that size by `surface_clouds(..., ordered=True)` stay as they are, up to
        rounding.
        """
        batch, points, _ = cloud.shape
        wanted = self.settings.cloud
        if points == 0:
            return cloud.new_zeros(batch, wanted, 3)
        near = self.near(cloud)
        counted = cloud * near[..., None]
        if self.settings.along_curve:
            order = curve_keys(counted).argsort(stable=True, dim=1)
            ordered = counted.gather(1, order[..., None].expand(-1, -1, 3))
        else:
            coordinates = list(counted.unbind(-1))
            sort_points(coordinates)
            ordered = torch.stack(coordinates, -1)
        # points that do not count are zeros now: move them behind the others, which keep their order
        filled = (ordered != 0).any(-1)
        ordered = ordered.gather(1, (~filled).byte().argsort(stable=True, dim=1)[..., None].expand(-1, -1, 3))
        at = (torch.arange(wanted, device=cloud.device) * 2 + 1) * filled.sum(1, keepdim=True)
        index = at.div(2 * wanted, rounding_mode="floor")
        return ordered.gather(1, index[..., None].expand(-1, -1, 3))


class Autoencoder(Encoder):
    """An encoder that is trained alone, to reconstruct its input."""

    mean: Tensor
    scale: Tensor

    def __init__(self, settings: EncoderSettings) -> None:
        super().__init__(settings)
        self.register_buffer("mean", torch.zeros(settings.code))
        self.register_buffer("scale", torch.ones(settings.code))

    def forward(self, cloud: Float[Tensor, "batch points 3"]) -> Float[Tensor, "batch code"]:
        """z of each cloud, standardised once `standardize` was called. A cloud may be empty.

        Points outside the region are ignored, so that clouds of different size can share a batch.
        """
        return (self.encode(cloud) - self.mean) / self.scale

    @abstractmethod
    def encode(self, cloud: Float[Tensor, "batch points 3"]) -> Float[Tensor, "batch code"]:
        """z before standardisation."""

    def standardize(self, codes: Float[Tensor, "batch code"]) -> None:
        """Scale z so that each number of these codes has mean 0 and variance 1."""
        self.mean.copy_(codes.mean(0))
        self.scale.copy_(codes.std(0).clamp(min=1e-4))

    @abstractmethod
    def loss(
        self, cloud: Float[Tensor, "batch points 3"], rng: Generator
    ) -> tuple[Float[Tensor, ""], dict[str, float]]:
        """Loss of the reconstruction, and its errors by name [m]."""

    @abstractmethod
    def penalised(self) -> Iterable[Tensor]:
        """The weights theta of the paper's regulariser, lambda * sum theta^2."""


def fp32(tensor: Tensor) -> torch.autocast:
    """A context without bf16, which would round coordinates to 4 mm."""
    return torch.autocast(tensor.device.type, enabled=False)


def wave_angles(points: Float[Tensor, "*batch 3"], octaves: int) -> list[Float[Tensor, "*batch 3"]]:
    """Coordinates as angles at the wavelengths 4 m, 2 m, ...: with their sines and cosines a small perceptron
    distinguishes positions."""
    return [points * (torch.pi / 2 * 2**octave) for octave in range(octaves)]


def pool_max(
    features: Float[Tensor, "batch points channels"], near: Bool[Tensor, "batch points"]
) -> Float[Tensor, "batch channels"]:
    """Maximum feature over the points that count; zeros for clouds without any."""
    low = torch.finfo(features.dtype).min
    best = max_pool(features.masked_fill(~near[..., None], low))
    return best.masked_fill(~near.any(1, keepdim=True), 0.0)


def pool_mean(
    features: Float[Tensor, "batch points channels"], near: Bool[Tensor, "batch points"]
) -> Float[Tensor, "batch channels"]:
    """Mean feature over the points that count; zeros for clouds without any."""
    return (features.float() * near[..., None]).sum(1) / near.sum(1, keepdim=True).clamp(min=1)
