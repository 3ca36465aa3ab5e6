"""Encoders of the scene, from a point cloud to a few numbers, and their settings.

Nothing here loads PyTorch, so that planning can read the settings. The networks are in `encoders.networks`.
"""

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float32
from numpy import ndarray

from robotdiffuse.core.errors import InputError
from robotdiffuse.core.registry import Entry, Registry
from robotdiffuse.core.settings import Count, Settings, Sizes
from robotdiffuse.scenes.surface_points import PANDA_REGION, VisibleRegion


@dataclass(frozen=True)
class EncoderSettings(Settings, name="encoder"):
    """Settings that every encoder has."""

    any_size: ClassVar[bool] = True
    """Whether clouds of any size work well; otherwise they should have about `cloud` points."""
    ordered: ClassVar[bool] = False
    """Whether clouds must have exactly `cloud` points, in the order of `in_order`."""
    code: Count = 96
    """Size of the scene embedding z (paper: 60, for two obstacles)."""
    cloud: Count = 512
    """Number of points of an input cloud."""
    region: VisibleRegion = PANDA_REGION
    """Points outside this region are ignored, since the arm does not reach them."""

    def prepared(self, points: Float32[ndarray, "n 3"]) -> Float32[ndarray, "m 3"]:
        """The points, which must be in the region, in the form that the exported encoder takes [m]."""
        if self.ordered:
            return in_order(points, self.cloud)
        # the exported network needs `cloud` points, with `any_size` at least one; zeros have no effect
        needed = 1 if self.any_size else self.cloud
        return np.pad(points, ((0, max(needed - len(points), 0)), (0, 0)))


CURVE_STEP = 2.0**-16
"""Coordinates are rounded to multiples of this before they are sorted along a curve [m]."""
SPREADS = (
    (32, 0x001F00000000FFFF), (16, 0x001F0000FF0000FF), (8, 0x100F00F00F00F00F),
    (4, 0x10C30C30C30C30C3), (2, 0x1249249249249249),
)  # fmt: skip
"""Shifts and masks that spread the 21 low bits of an integer to every third bit."""


def curve_keys(points: Any) -> Any:
    """Positions of points along the Z-order curve (Morton 1966), as 63-bit integers. Neighbors along the
    curve are mostly close to each other. points: array or tensor [..., 3] [m]."""
    key = 0
    for axis in range(3):
        bits = (points[..., axis] / CURVE_STEP).round() + 2**20
        bits = bits.astype(np.int64) if isinstance(bits, ndarray) else bits.long()
        bits = bits.clip(0, 2**21 - 1)
        for shift, mask in SPREADS:
            bits = (bits | (bits << shift)) & mask
        key = key | (bits << (2 - axis))
    return key


def in_order(points: Float32[ndarray, "n 3"], count: int) -> Float32[ndarray, "{count} 3"]:
    """`count` points of a cloud, sorted along the Z-order curve. A larger cloud is thinned evenly; points of
    a smaller cloud are repeated; an empty cloud gives zeros.

    `Encoder.arrange` orders batches of tensors in this way.
    """
    if not len(points):
        return np.zeros((count, 3), np.float32)
    thinned = (2 * np.arange(count) + 1) * len(points) // (2 * count)
    return points[np.argsort(curve_keys(points), kind="stable")[thinned]]


@dataclass(frozen=True)
class PointAutoencoderSettings(EncoderSettings):
    points: Sizes = (64, 128, 256)
    """Widths of the layers of the perceptron on each point."""
    hidden: Count = 384
    """Width of the layer between the pooled features and z, and of the decoder's hidden layers."""
    decoded: Count = 192
    """Number of points that the decoder reconstructs."""


@dataclass(frozen=True)
class CompressionAutoencoderSettings(EncoderSettings):
    """The paper's sizes."""

    any_size = False
    ordered = True
    code: Count = 60
    """Size of z."""
    cloud: Count = 1400
    """Number of points of an input cloud; the input has three numbers for each."""
    hidden: Sizes = (786, 512, 256)
    """Widths of the encoder's layers between the cloud and z; the decoder has the same widths in reverse
    order."""


@dataclass(frozen=True)
class PointsSettings(EncoderSettings, name="points"):
    any_size = False
    ordered = True
    code: Count = 96
    """Size of z: three numbers for each point."""
    cloud: Count = 32
    """Number of points of an input cloud."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.code != 3 * self.cloud:
            raise InputError(f"points.code is {self.code}; it must be three times cloud, {3 * self.cloud}")


@dataclass(frozen=True)
class PointNetSettings(EncoderSettings):
    """Sizes for training on a CPU; the original's are in parentheses."""

    cloud: Count = 256
    """Number of points of an input cloud (in the paper of the encoder: 1024)."""
    first: Sizes = (32, 32)
    """Widths of the layers on each point before the feature transform (64, 64)."""
    second: Sizes = (32, 64, 192)
    """Widths of the layers on each point after the feature transform (64, 128, 1024)."""
    transform: Sizes = (16, 32, 64)
    """Widths of the layers on each point within a transform's network (64, 128, 1024)."""
    transform_head: tuple[Count, ...] = (32,)
    """Widths of the layers of a transform's network after the maximum (512, 256)."""
    head: tuple[Count, ...] = (192,)
    """Widths of the layers between the maximum and z (512, 256)."""


@dataclass(frozen=True)
class DGCNNSettings(EncoderSettings):
    """Sizes for training on a CPU; the original's are in parentheses."""

    any_size = False  # distances to neighbors depend on the density of the cloud
    cloud: Count = 128
    """Number of points of an input cloud (in the paper of the encoder: 1024)."""
    neighbors: Count = 8
    """Number of nearest points to which each point is joined (20)."""
    edges: Sizes = (32, 32, 64)
    """Widths of the layers of edge convolution (64, 64, 128, 256)."""
    embedding: Count = 192
    """Number of features of a point before pooling, from the outputs of all edge convolutions (1024)."""
    head: tuple[Count, ...] = (192,)
    """Widths of the layers between the pooled features and z (512, 256)."""


_NETWORKS = "robotdiffuse.learning.encoders.networks"
ENCODERS = Registry(
    "encoder",
    {
        "compression_autoencoder": Entry(
            f"{_NETWORKS}:CompressionAutoencoder",
            "the paper's: a perceptron on 1,400 points in a fixed order",
            f"{__name__}:CompressionAutoencoderSettings",
            "alone",
        ),
        "point_autoencoder": Entry(
            f"{_NETWORKS}:PointAutoencoder",
            "a perceptron on each point, pooled: any number of points in any order",
            f"{__name__}:PointAutoencoderSettings",
            "alone",
        ),
        "pointnet": Entry(f"{_NETWORKS}:PointNet", "PointNet", f"{__name__}:PointNetSettings", "jointly"),
        "dgcnn": Entry(f"{_NETWORKS}:DGCNN", "DGCNN", f"{__name__}:DGCNNSettings", "jointly"),
        "points": Entry(
            f"{_NETWORKS}:Points",
            "the points themselves, for the denoiser cross_attention",
            f"{__name__}:PointsSettings",
            "jointly",
        ),
    },
)
"""Encoders by their name in settings and checkpoints. There are two kinds. An encoder of kind "alone" is
trained with its own loss and then frozen. An encoder of kind "jointly" is a part of the planner's network and
is trained with the planner's loss, on new clouds in every batch."""


def make_encoder(name: str, settings: EncoderSettings | None = None) -> Any:
    """An untrained encoder of this name. If `settings` is None, it has the encoder's defaults."""
    return ENCODERS.load(name)(settings or ENCODERS.defaults(name))


def encoder_name(encoder: object) -> str:
    """The name of an encoder's class in ENCODERS."""
    return next(name for name in ENCODERS if ENCODERS.load(name) is type(encoder))
