"""Encoders of the scene: from a point cloud to a few numbers. A new one is one file and one line in
ENCODERS."""

from typing import TYPE_CHECKING

from robotdiffuse.core.registry import Entry, Registry

if TYPE_CHECKING:
    from robotdiffuse.learning.encoders.base import Encoder
    from robotdiffuse.learning.encoders.settings import EncoderSettings

_PACKAGE = "robotdiffuse.learning.encoders."
_SETTINGS = _PACKAGE + "settings:"
ENCODERS = Registry(
    "encoder",
    {
        "compression_autoencoder": Entry(
            _PACKAGE + "compression_autoencoder:CompressionAutoencoder",
            "the paper's: a perceptron on 1,400 points in a fixed order",
            _SETTINGS + "CompressionAutoencoderSettings",
            "alone",
        ),
        "point_autoencoder": Entry(
            _PACKAGE + "point_autoencoder:PointAutoencoder",
            "a perceptron on each point, pooled: any number of points in any order",
            _SETTINGS + "PointAutoencoderSettings",
            "alone",
        ),
        "pointnet": Entry(
            _PACKAGE + "pointnet:PointNet", "PointNet", _SETTINGS + "PointNetSettings", "jointly"
        ),
        "dgcnn": Entry(_PACKAGE + "dgcnn:DGCNN", "DGCNN", _SETTINGS + "DGCNNSettings", "jointly"),
        "points": Entry(
            _PACKAGE + "points:Points",
            "the points themselves, for the denoiser cross_attention",
            _SETTINGS + "PointsSettings",
            "jointly",
        ),
    },
)
"""By the name in settings and checkpoints. Two kinds: "alone" is trained with a loss of its own and then
frozen; "jointly" is a part of the planner's network, whose loss trains what weights it has, on fresh clouds
for every batch."""


def make_encoder(name: str, settings: "EncoderSettings | None" = None) -> "Encoder":
    """An untrained encoder of that name; None: with its default settings."""
    return ENCODERS.load(name)(settings or ENCODERS.defaults(name))


def encoder_name(encoder: "Encoder") -> str:
    """The name of an encoder's class in ENCODERS."""
    return next(name for name in ENCODERS if ENCODERS.load(name) is type(encoder))
