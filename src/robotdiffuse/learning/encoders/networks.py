"""The encoders: auto-encoders that are trained alone, and networks that are trained with the planner.

Unlike the originals, PointNet and DGCNN normalize features over the channels of a point (layer norm), not
over the batch: z must not depend on the other clouds of a batch, clouds may contain ignored points, and the
moving average of the weights has no matching batch statistics.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from functools import partial
from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from numpy.random import Generator
from torch import Tensor, nn
from torch.nn import functional

from robotdiffuse.learning.encoders import (
    CompressionAutoencoderSettings,
    DGCNNSettings,
    EncoderSettings,
    PointAutoencoderSettings,
    PointNetSettings,
    PointsSettings,
)
from robotdiffuse.learning.network import SavedModule, Scalar

Cloud = Float[Tensor, "batch points 3"]
Codes = Float[Tensor, "batch code"]
Near = Bool[Tensor, "batch points"]
Features = Float[Tensor, "batch points channels"]
Pooled = Float[Tensor, "batch channels"]
Ordered = Float[Tensor, "batch cloud 3"]
Loss = tuple[Scalar, dict[str, float]]


class Encoder(SavedModule):
    """A network from a point cloud to z. The order of the points does not matter, and a cloud may be
    empty.

    A subclass defines `forward(cloud)`, which returns z, float32, of each cloud of points [m]. Points outside
    the region are ignored, so that clouds of different size can share a batch.
    """

    settings: EncoderSettings

    def __init__(self, settings: EncoderSettings) -> None:
        super().__init__()
        self.settings = settings

    def code_of_ordered(self, cloud: Cloud) -> Codes:
        """z of clouds that already have the size and order of `EncoderSettings.prepared`; for export."""
        return self(cloud)

    def near(self, cloud: Cloud) -> Near:
        """Which points count: those in the region that are not the zeros with which `surface_clouds` pads."""
        return self.settings.region.holds(cloud) & (cloud != 0).any(-1)

    def arrange(self, cloud: Cloud) -> Ordered:
        """The points of each cloud that count, in the form of `EncoderSettings.prepared`."""
        counted = zip(cloud.cpu().numpy(), self.near(cloud).cpu().numpy(), strict=True)
        ordered = [self.settings.prepared(points[near]) for points, near in counted]
        return torch.from_numpy(np.stack(ordered)).to(cloud.device)


class Autoencoder(Encoder, ABC):
    """An encoder that is trained alone, to reconstruct its input."""

    mean: Tensor
    scale: Tensor

    def __init__(self, settings: EncoderSettings) -> None:
        super().__init__(settings)
        self.register_buffer("mean", torch.zeros(settings.code))
        self.register_buffer("scale", torch.ones(settings.code))

    def forward(self, cloud: Cloud) -> Codes:
        """z of each cloud, standardized once `standardize` was called. A cloud may be empty.

        Points outside the region are ignored, so that clouds of different size can share a batch.
        """
        return (self.encode(cloud) - self.mean) / self.scale

    @abstractmethod
    def encode(self, cloud: Cloud) -> Codes:
        """z before standardization."""

    def standardize(self, codes: Codes) -> None:
        """Scale z so that each number of these codes has mean 0 and variance 1."""
        self.mean.copy_(codes.mean(0))
        self.scale.copy_(codes.std(0).clamp(min=1e-4))

    @abstractmethod
    def loss(self, cloud: Cloud, rng: Generator) -> Loss:
        """Loss of the reconstruction, and its errors by name [m]."""

    @abstractmethod
    def penalized(self) -> Iterable[Tensor]:
        """The weights theta of the paper's regularizer, lambda * sum theta^2."""


def fp32(tensor: Tensor) -> torch.autocast:
    """A context without bf16, which would round coordinates to 4 mm."""
    return torch.autocast(tensor.device.type, enabled=False)


OCTAVES = 4
"""A point's inputs are its coordinates, and their sines and cosines at this number of wavelengths (4 m,
2 m, ...)."""


def wave_angles(points: Float[Tensor, "*batch 3"], octaves: int = OCTAVES) -> list[Float[Tensor, "*batch 3"]]:
    """Coordinates as angles [rad] at the wavelengths 4 m, 2 m, ... From the angles' sines and cosines, even a
    small perceptron can distinguish positions."""
    return [points * (torch.pi / 2 * 2**octave) for octave in range(octaves)]


def perceptron(*sizes: int, activation: Callable[[], nn.Module] | None = None) -> nn.Sequential:
    """Linear layers from each size to the next, with activations between them; None: GELU."""
    make = activation or partial(nn.GELU, "tanh")
    parts = [part for a, b in pairwise(sizes) for part in (nn.Linear(a, b), make())]
    return nn.Sequential(*parts[:-1])


def pool_max(features: Features, near: Near) -> Pooled:
    """Maximum feature over the points that count; zeros for clouds without any."""
    best = features.masked_fill(~near[..., None], torch.finfo(features.dtype).min).amax(1)
    return best.masked_fill(~near.any(1, keepdim=True), 0.0)


def pool_mean(features: Features, near: Near) -> Pooled:
    """Mean feature over the points that count; zeros for clouds without any."""
    return (features.float() * near[..., None]).sum(1) / near.sum(1, keepdim=True).clamp(min=1)


def pool_both(features: Features, near: Near) -> Float[Tensor, "batch 2*channels"]:
    """Maximum and mean feature over the points that count."""
    return torch.cat([pool_max(features, near).float(), pool_mean(features, near)], -1)


class CompressionAutoencoder(Autoencoder):
    """The paper's compression auto-encoder (section Condition embedding); its encoder is PointEnet.

    A perceptron on 1,400 points in a fixed order, 4200 -> 786 -> 512 -> 256 -> 60, and its mirror image. The
    paper states neither the order nor the activation. Here the points are sorted along a space-filling curve,
    so that each of the 4200 inputs belongs to a small part of the surfaces. If points were sorted by x, then
    y, then z, an input's y and z could be those of any obstacle. The activation is PReLU, as in MPNet
    (Qureshi et al. 2019), whose encoder has this form and this loss.
    """

    settings: CompressionAutoencoderSettings

    def __init__(self, settings: CompressionAutoencoderSettings) -> None:
        super().__init__(settings)
        sizes = (3 * settings.cloud, *settings.hidden, settings.code)
        self.encoder = perceptron(*sizes, activation=nn.PReLU)
        self.decoder = perceptron(*sizes[::-1], activation=nn.PReLU)

    def encode(self, cloud: Cloud) -> Codes:
        with fp32(cloud):
            return self.encoder(self.arrange(cloud.float()).flatten(1))

    def code_of_ordered(self, cloud: Ordered) -> Codes:
        return (self.encoder(cloud.flatten(1)) - self.mean) / self.scale

    def decode(self, code: Codes) -> Ordered:
        """Reconstructed points [m], in the order of `arrange`, from z before standardization."""
        with fp32(code):
            return self.decoder(code.float()).view(len(code), -1, 3)

    def loss(self, cloud: Cloud, rng: Generator) -> Loss:
        """The first term of l_AE: the mean over points of the squared distance to the reconstruction [m^2].

        The equation in the paper does not define K; here it is the number of points, and i-hat is the text's
        x-hat. The error `reconstruction` is the root of the loss [m].
        """
        with fp32(cloud):
            points = self.arrange(cloud.float())
            error = (self.decode(self.encoder(points.flatten(1))) - points).square().sum(-1).mean()
        return error, {"reconstruction": error.item() ** 0.5}

    def penalized(self) -> Iterable[Tensor]:
        """The encoder's weights.

        The equation in the paper has (theta^2_ij)^2, literally a sum of fourth powers. We assume that it
        means the square of theta^e_ij, the encoder's weights, as in MPNet's equation.
        """
        return (layer.weight for layer in self.encoder if isinstance(layer, nn.Linear))


DISTANCE_QUERIES = 96
"""Number of positions for each cloud at which the distance field is reconstructed."""
DISTANCE_WEIGHT = 4.0
"""Weight of the distance field's error [m] in the training loss, relative to the Chamfer distance [m]."""
DISTANCE_CAP = 0.5
"""True distances are capped at this before the reconstructed ones are compared with them [m]."""


class PointAutoencoder(Autoencoder):
    """z = MLP(max-pool and mean-pool of MLP(point)); decoded to points and to a distance field.

    The paper's encoder is a perceptron over 1,400 points in a fixed order. This one applies a perceptron to
    each point and pools (Qi et al. 2017, PointNet), so that neither the order nor the number of points
    matters.
    """

    settings: PointAutoencoderSettings

    def __init__(self, settings: PointAutoencoderSettings) -> None:
        super().__init__(settings)
        sizes = (3 + 6 * OCTAVES, *settings.points)
        self.points = nn.ModuleList(nn.Linear(a, b) for a, b in pairwise(sizes))
        pooled = 2 * sizes[-1]
        self.empty = nn.Parameter(torch.zeros(pooled))
        hidden = settings.hidden
        code = settings.code
        self.head = nn.Sequential(nn.LayerNorm(pooled), *perceptron(pooled, hidden, code))
        self.decoder = perceptron(code, hidden, hidden, 3 * settings.decoded)
        self.query_code = nn.Linear(code, 192)
        self.query_point = nn.Linear(sizes[0], 192)
        self.query = nn.Sequential(nn.GELU("tanh"), *perceptron(192, 192, 192, 1))

    def encode(self, cloud: Cloud) -> Codes:
        """z before standardization."""
        near = self.near(cloud)
        with fp32(cloud):
            x = functional.relu(self.points[0](self._waves(cloud)))
        for layer in list(self.points)[1:]:
            x = functional.relu(layer(x))
        return self.head(torch.where(near.any(1, keepdim=True), pool_both(x, near), self.empty)).float()

    def _waves(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch waves"]:
        """Coordinates with the sines and cosines of `wave_angles`."""
        angles = wave_angles(points)
        return torch.cat([points, *(part for a in angles for part in (a.sin(), a.cos()))], -1)

    def decode(self, code: Codes) -> Float[Tensor, "batch decoded 3"]:
        """Reconstructed points [m], from z before standardization."""
        return self.decoder(code).float().view(len(code), -1, 3)

    def distance(self, code: Codes, at: Float[Tensor, "batch queries 3"]) -> Float[Tensor, "batch queries"]:
        """Reconstructed distance [m] of positions to the cloud, from z before standardization."""
        return (
            self.query(self.query_code(code)[:, None] + self.query_point(self._waves(at))).float().squeeze(-1)
        )

    def loss(self, cloud: Cloud, rng: Generator) -> Loss:
        """Chamfer distance plus the weighted error of the distance field.

        Errors [m]: `chamfer`, the sum of both directions; `distance`, mean error of the distance field;
        `distance_of_constant`, mean error of a constant field.
        """
        near = self.near(cloud)
        at = self._query_positions(cloud, rng)
        index, _ = nearest(at, cloud, near)
        truth = (at - pick(cloud, index)).norm(dim=-1).clamp(max=DISTANCE_CAP)
        truth = torch.where(near.any(1)[:, None], truth, DISTANCE_CAP)
        code = self.encode(cloud)
        guess = self.distance(code, at)
        chamfer_loss = chamfer(self.decode(code), cloud, near)
        field = functional.smooth_l1_loss(guess, truth, beta=0.01)
        errors = {
            "chamfer": chamfer_loss.item(),
            "distance": (guess - truth).abs().mean().item(),
            "distance_of_constant": (truth - truth.median()).abs().mean().item(),
        }
        return chamfer_loss + DISTANCE_WEIGHT * field, errors

    def _query_positions(self, cloud: Cloud, rng: Generator) -> Float[Tensor, "batch queries 3"]:
        """Positions at which the distance is reconstructed: half of them close to the surfaces."""
        batch, points, _ = cloud.shape
        low = np.array([-1.0, -1.0, 0.0])
        high = np.array([1.0, 1.0, 1.3])
        positions = torch.from_numpy(rng.uniform(low, high, (batch, DISTANCE_QUERIES, 3)).astype(np.float32))
        positions = positions.to(cloud.device)
        half = DISTANCE_QUERIES // 2
        chosen = rng.integers(0, points, half)
        spread = torch.from_numpy(0.1 * rng.standard_normal((batch, half, 3), dtype=np.float32))
        close = cloud[:, chosen] + spread.to(cloud.device)
        positions[:, :half] = torch.where(self.near(close)[..., None], close, positions[:, :half])
        return positions

    def penalized(self) -> Iterable[Tensor]:
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
        # |a - b|^2 without |a|^2, which is constant over b, so only the reverse direction needs it
        squared = torch.baddbmm(b.square().sum(-1)[:, None], a.float(), b.mT, alpha=-2.0)
        forth = squared.argmin(2)
        return forth, squared.add_(a.float().square().sum(-1)[..., None]).argmin(1)


def pick(points: Float[Tensor, "batch n 3"], index: Tensor) -> Float[Tensor, "batch m 3"]:
    """The points with these indices [batch m]."""
    return points.gather(1, index[..., None].expand(-1, -1, 3))


def chamfer(decoded: Float[Tensor, "batch n 3"], cloud: Float[Tensor, "batch m 3"], near: Tensor) -> Scalar:
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


def layers(sizes: tuple[int, ...], activation: nn.Module | None = None) -> nn.Sequential:
    """Linear layer, layer norm and activation (None: ReLU) for each size after the first."""
    parts = [(nn.Linear(a, b), nn.LayerNorm(b), activation or nn.ReLU()) for a, b in pairwise(sizes)]
    return nn.Sequential(*(layer for part in parts for layer in part))


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
        self, x: Float[Tensor, "batch points size"], near: Near
    ) -> Float[Tensor, "batch points size"]:
        matrix = self.out(self.head(pool_max(self.points(x), near)))
        return x @ matrix.view(-1, self.size, self.size).to(x.dtype)


class PointNet(Encoder):
    """z = MLP(max over points of MLP(T2 MLP(T1 point))) (Qi et al. 2017, "PointNet: Deep Learning on Point
    Sets").

    Unlike the original it has no dropout, and no loss that keeps the feature transform orthogonal, since the
    planner's loss is the only one; the transforms start close to the identity.
    """

    def __init__(self, settings: PointNetSettings) -> None:
        super().__init__(settings)
        self.turn_input = Transform(3, settings)
        self.first = layers((3, *settings.first))
        self.turn_features = Transform(settings.first[-1], settings)
        self.second = layers((settings.first[-1], *settings.second))
        self.empty = nn.Parameter(torch.zeros(settings.second[-1]))
        sizes = (settings.second[-1], *settings.head)
        self.head = nn.Sequential(layers(sizes), nn.Linear(sizes[-1], settings.code))

    def forward(self, cloud: Cloud) -> Codes:
        near = self.near(cloud)
        with fp32(cloud):
            x = self.first(self.turn_input(cloud, near))
        pooled = pool_max(self.second(self.turn_features(x, near)), near).float()
        return self.head(torch.where(near.any(1, keepdim=True), pooled, self.empty)).float()


NEGATIVE_SLOPE = 0.2
"""Slope of the leaky ReLU below zero, as in the original."""
IGNORED_DISTANCE = 1e9
"""Squared distance that is assigned to points that do not count."""


def neighbors(x: Features, near: Near, count: int) -> Int64[Tensor, "batch points neighbors"]:
    """Indices of each point's `count` nearest neighbors, itself included; where there are fewer, itself
    again."""
    with torch.no_grad(), fp32(x):
        x = x.detach().float()
        squared = x.square().sum(-1)
        # |a - b|^2 without |a|^2, which is the same for all neighbors of a
        squared_distances = torch.baddbmm(squared[:, None], x, x.mT, alpha=-2.0)
        squared_distances = squared_distances.masked_fill(~near[:, None], IGNORED_DISTANCE)
        closest = squared_distances.topk(min(count, x.shape[1]), dim=-1, largest=False, sorted=False)
        itself = torch.arange(x.shape[1], device=x.device)[:, None]
        return torch.where(closest.values < IGNORED_DISTANCE, closest.indices, itself)


class EdgeConvolution(nn.Module):
    """max over neighbors j of h(x_i, x_j - x_i).

    The original's h is a linear layer, batch norm and leaky ReLU. Here the norm comes after the maximum, so h
    is linear: h = W [x_i, x_j - x_i] = (A - B) x_i + B x_j. Only B x_j depends on the neighbor, so the
    maximum is over B x_j, and the layer costs two matrix products per point instead of one per edge.
    """

    def __init__(self, channels: int, out: int, count: int) -> None:
        super().__init__()
        self.count = count
        self.own = nn.Linear(channels, out)
        self.other = nn.Linear(channels, out, bias=False)
        self.norm = nn.LayerNorm(out)

    def forward(self, x: Features, near: Near) -> Float[Tensor, "batch points out"]:
        index = neighbors(x, near, self.count)
        neighbor_features = self.other(x)
        offset = (
            neighbor_features.shape[1] * torch.arange(len(neighbor_features), device=x.device)[:, None, None]
        )
        joined = neighbor_features.flatten(0, 1)[(index + offset).flatten(0, 1)]
        pooled = joined.amax(1).view_as(neighbor_features)
        return functional.leaky_relu(self.norm(self.own(x) + pooled), NEGATIVE_SLOPE)


class DGCNN(Encoder):
    """z = MLP(max-pool and mean-pool of MLP(outputs of all edge convolutions)).

    After Wang et al. 2019, "Dynamic Graph CNN for Learning on Point Clouds": each layer joins every point
    with its nearest neighbors, in the space of that layer's own input.
    """

    def __init__(self, settings: DGCNNSettings) -> None:
        super().__init__(settings)
        self.edges = nn.ModuleList(
            EdgeConvolution(a, b, settings.neighbors) for a, b in pairwise((3, *settings.edges))
        )
        activation = nn.LeakyReLU(NEGATIVE_SLOPE)
        self.embed = layers((sum(settings.edges), settings.embedding), activation)
        sizes = (2 * settings.embedding, *settings.head)
        self.empty = nn.Parameter(torch.zeros(sizes[0]))
        self.head = nn.Sequential(*layers(sizes, activation), nn.Linear(sizes[-1], settings.code))

    def forward(self, cloud: Cloud) -> Codes:
        near = self.near(cloud)
        first, *further_layers = self.edges
        with fp32(cloud):
            features = [first(cloud, near)]
        for layer in further_layers:
            features.append(layer(features[-1], near))
        x = self.embed(torch.cat(features, -1))
        return self.head(torch.where(near.any(1, keepdim=True), pool_both(x, near), self.empty)).float()


class Points(Encoder):
    """z = the coordinates of all points [m]. It has no weights."""

    settings: PointsSettings

    def forward(self, cloud: Cloud) -> Codes:
        with fp32(cloud):
            return self.code_of_ordered(self.arrange(cloud.float()))

    def code_of_ordered(self, cloud: Ordered) -> Codes:
        return cloud.flatten(1)
