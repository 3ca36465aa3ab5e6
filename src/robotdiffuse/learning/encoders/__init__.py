"""Encoders of the scene: point cloud to a few numbers."""

from robotdiffuse.learning.encoders.base import Autoencoder, Encoder, EncoderSettings
from robotdiffuse.learning.encoders.compression_autoencoder import (
    CompressionAutoencoder,
    CompressionAutoencoderSettings,
)
from robotdiffuse.learning.encoders.dgcnn import DGCNN, DGCNNSettings
from robotdiffuse.learning.encoders.point_autoencoder import PointAutoencoder, PointAutoencoderSettings
from robotdiffuse.learning.encoders.pointnet import PointNet, PointNetSettings

ENCODERS: dict[str, tuple[type[Encoder], type[EncoderSettings]]] = {
    "compression_autoencoder": (CompressionAutoencoder, CompressionAutoencoderSettings),
    "point_autoencoder": (PointAutoencoder, PointAutoencoderSettings),
    "pointnet": (PointNet, PointNetSettings),
    "dgcnn": (DGCNN, DGCNNSettings),
}
"""Name in settings and checkpoints: network and its settings."""

PAPER_SIZE: dict[str, EncoderSettings] = {
    "compression_autoencoder": CompressionAutoencoderSettings(),
    "pointnet": PointNetSettings(
        code=60,
        cloud=1024,
        first=(64, 64),
        second=(64, 128, 1024),
        transform=(64, 128, 1024),
        transform_head=(512, 256),
        head=(512, 256),
    ),
    "dgcnn": DGCNNSettings(
        code=60, cloud=1024, neighbours=20, edges=(64, 64, 128, 256), embedding=1024, head=(512, 256)
    ),
}
"""Settings of the sizes that the authors of each encoder give, with z of this paper's size."""


def make_encoder(name: str, settings: EncoderSettings | None = None) -> Encoder:
    """A fresh encoder of that name; without settings, with its defaults."""
    network, kind = ENCODERS[name]
    return network(kind() if settings is None else settings)


def encoder_name(encoder: Encoder) -> str:
    """Name of an encoder's kind in ENCODERS."""
    return next(name for name, (network, _) in ENCODERS.items() if type(encoder) is network)


__all__ = [
    "DGCNN",
    "ENCODERS",
    "PAPER_SIZE",
    "Autoencoder",
    "CompressionAutoencoder",
    "CompressionAutoencoderSettings",
    "DGCNNSettings",
    "Encoder",
    "EncoderSettings",
    "PointAutoencoder",
    "PointAutoencoderSettings",
    "PointNet",
    "PointNetSettings",
    "encoder_name",
    "make_encoder",
]
