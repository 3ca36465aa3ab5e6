"""Encoders of the scene: point cloud to a few numbers. A new one is one file and one line in ENCODERS."""

from typing import TYPE_CHECKING

from robotdiffuse.core.registry import Entry, Registry

if TYPE_CHECKING:
    from robotdiffuse.learning.encoders.base import Encoder, EncoderSettings

_ROOM = "robotdiffuse.learning.encoders."
COMPLETES = "completion"
"""The kind that `train completion` trains."""
ENCODERS = Registry(
    "encoder",
    {
        "compression_autoencoder": Entry(
            _ROOM + "compression_autoencoder:CompressionAutoencoder",
            "the paper's: a perceptron on 1,400 points in a fixed order",
            "CompressionAutoencoderSettings",
            "alone",
        ),
        "point_autoencoder": Entry(
            _ROOM + "point_autoencoder:PointAutoencoder",
            "a perceptron on each point, pooled: any number of points in any order",
            "PointAutoencoderSettings",
            "alone",
        ),
        "pointnet": Entry(_ROOM + "pointnet:PointNet", "PointNet", "PointNetSettings", "jointly"),
        "dgcnn": Entry(_ROOM + "dgcnn:DGCNN", "DGCNN", "DGCNNSettings", "jointly"),
        "completing_autoencoder": Entry(
            _ROOM + "completing_autoencoder:CompletingAutoencoder",
            "the bottleneck of the network that completes what cameras see, as it comes with the package",
            "CompletingAutoencoderSettings",
            COMPLETES,
        ),
    },
)
"""By the name in settings and checkpoints. Of three kinds: trained alone, with a loss of its own, and frozen
then; jointly with the planner, by the planner's loss; or a part of the completing network, frozen."""


def make_encoder(name: str, settings: "EncoderSettings | None" = None) -> "Encoder":
    """A fresh encoder of that name; without settings, with its defaults."""
    return ENCODERS.load(name)(settings or ENCODERS.defaults(name))


def encoder_name(encoder: "Encoder") -> str:
    """Name of an encoder's kind in ENCODERS."""
    return next(name for name in ENCODERS if ENCODERS.load(name) is type(encoder))
