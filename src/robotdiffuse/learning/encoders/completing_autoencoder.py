"""The bottleneck of the network that completes what cameras see, as an encoder of the scene.

Nothing is trained for it: features at the bottleneck, 25,088 numbers, are reduced to z by two linear layers
that hold principal components, first of the features of all cells alike, then of all that is left. They are
fitted to scenes, half of them known as whole clouds and half by views (`fit`).

What it is told: of depth views the observed volume, as when it completes (`of_views`). Of a cloud, as of an
exact scene, the voxels of 4 cm that hold points are occupied, and all others unknown: not free, for nobody
said so. Given enough points of the surfaces the network then fills in what they enclose.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from jaxtyping import Float, UInt8
from numpy import ndarray
from torch import Tensor, nn

from robotdiffuse.core.errors import InputError
from robotdiffuse.core.settings import Count
from robotdiffuse.learning.completion.network import CompletionNetwork, CompletionSettings
from robotdiffuse.learning.completion.samples import OCCUPIED, pack
from robotdiffuse.learning.encoders.base import Encoder, EncoderSettings, fp32
from robotdiffuse.perception.depth_view import DepthView
from robotdiffuse.perception.observed_volume import LOW, SHAPE, VOXEL, observe
from robotdiffuse.robots.robot import Robot

SHARE = 8
"""A cell of the bottleneck has so many voxels along each edge."""
CELLS = SHAPE[0] // SHARE * (SHAPE[1] // SHARE) * (SHAPE[2] // SHARE)
PART = 8
"""Volumes that are done at once, in little memory."""
LEAST = 1e-6
"""Components of less variance than this, or than this share of the first one's, are taken to have it."""


@dataclass(frozen=True)
class CompletingAutoencoderSettings(EncoderSettings):
    cloud: Count = 2048
    """Points of a cloud: enough that few voxels on surfaces hold none."""
    kept: Count = 16
    """Features of each cell that z is made of."""
    network: CompletionSettings = field(default_factory=CompletionSettings)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.kept > self.network.channels[-1]:
            most = self.network.channels[-1]
            raise InputError(f"kept is {self.kept}; the bottleneck has {most} features in a cell, no more")
        if self.code > CELLS * self.kept:
            raise InputError(
                f"code is {self.code}; it must be at most {CELLS} times kept, {CELLS * self.kept}"
            )


class CompletingAutoencoder(Encoder):
    """z = principal components of the completing network's bottleneck, each of variance 1."""

    any_size = False
    settings: CompletingAutoencoderSettings

    def __init__(self, settings: CompletingAutoencoderSettings) -> None:
        super().__init__(settings)
        self.network = CompletionNetwork(settings.network)
        self.components = nn.Sequential(
            nn.Linear(settings.network.channels[-1], settings.kept),
            nn.Flatten(),
            nn.Linear(CELLS * settings.kept, settings.code),
        )
        self.requires_grad_(False)

    def forward(self, cloud: Float[Tensor, "batch points 3"]) -> Float[Tensor, "batch code"]:
        """z of each cloud [m]; points outside the region do not count."""
        seen = self.volume(cloud)
        return self.of_volumes(seen, torch.zeros_like(seen))

    def of_views(
        self, views: Sequence[DepthView], robot: Robot, start: Float[ndarray, "dof"]
    ) -> Float[Tensor, "code"]:
        """z of the volume that depth views observed together, see `perception.observed_volume.observe`."""
        seen, behind = (torch.from_numpy(a)[None] for a in pack(observe(views, robot, start)))
        return self.of_volumes(seen, behind)[0]

    def of_volumes(
        self, seen: UInt8[Tensor, "n 56 56 32"], behind: UInt8[Tensor, "n 56 56 32"]
    ) -> Float[Tensor, "n code"]:
        """z of volumes as `completion.samples.pack` packs them."""
        features = self.bottleneck(seen, behind)
        with fp32(features):
            return self.components(features.float())

    def bottleneck(
        self, seen: UInt8[Tensor, "n 56 56 32"], behind: UInt8[Tensor, "n 56 56 32"]
    ) -> Float[Tensor, "n 7 7 4 features"]:
        """The completing network's, of volumes."""
        network = self.network
        parts = zip(seen.split(PART), behind.split(PART), strict=True)
        codes = [network.code(network.features(*part))[0] for part in parts]
        return torch.cat(codes).permute(0, 2, 3, 4, 1)

    def volume(self, cloud: Float[Tensor, "batch points 3"]) -> UInt8[Tensor, "batch 56 56 32"]:
        """OCCUPIED where points are; of all else nothing is known."""
        place = ((cloud.float() - cloud.new_tensor(LOW)) / VOXEL).floor().long()
        shape = torch.tensor(SHAPE, device=cloud.device)
        counts = self.near(cloud) & (place >= 0).all(-1) & (place < shape).all(-1)
        index = (place[..., 0] * SHAPE[1] + place[..., 1]) * SHAPE[2] + place[..., 2]
        nowhere = math.prod(SHAPE)
        seen = torch.zeros(len(cloud), nowhere + 1, dtype=torch.uint8, device=cloud.device)
        seen.scatter_(1, torch.where(counts, index, nowhere), OCCUPIED)
        return seen[:, :nowhere].reshape(-1, *SHAPE)

    def fit(self, features: Float[Tensor, "n 7 7 4 features"]) -> None:
        """Take the principal components of these bottlenecks, of many more scenes than z has numbers."""
        reduce, flatten, project = self.components
        _principal_components(reduce, features.flatten(0, -2))
        _principal_components(project, flatten(reduce(features)), unit_variance=True)


def _principal_components(
    layer: nn.Module, x: Float[Tensor, "n features"], unit_variance: bool = False
) -> None:
    """Make a linear layer give the first principal components of these rows."""
    assert isinstance(layer, nn.Linear)
    x = x.double()
    mean = x.mean(0)
    variances, directions = torch.linalg.eigh((x - mean).T @ (x - mean) / len(x))
    weight = directions.T.flip(0)[: layer.out_features]
    if unit_variance:
        first = variances.flip(0)[: layer.out_features]
        weight = weight / first.clamp(min=max(LEAST * first[0].item(), LEAST)).sqrt()[:, None]
    weight = weight.half().double()  # as files keep it, so that the bias fits
    layer.weight.copy_(weight)
    layer.bias.copy_(-(weight @ mean))
