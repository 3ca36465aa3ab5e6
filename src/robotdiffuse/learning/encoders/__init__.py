"""Encoders of the scene: point cloud to a few numbers."""

from robotdiffuse.learning.encoders.base import Autoencoder, Encoder, EncoderSettings
from robotdiffuse.learning.encoders.compression_autoencoder import (
    CompressionAutoencoder,
    CompressionAutoencoderSettings,
)
from robotdiffuse.learning.encoders.dgcnn import DGCNN, DGCNNSettings
from robotdiffuse.learning.encoders.point_autoencoder import PointAutoencoder, PointAutoencoderSettings
from robotdiffuse.learning.encoders.pointnet import PointNet, PointNetSettings

ENCODERS = {
    "compression_autoencoder": (CompressionAutoencoder, CompressionAutoencoderSettings),
    "point_autoencoder": (PointAutoencoder, PointAutoencoderSettings),
    "pointnet": (PointNet, PointNetSettings),
    "dgcnn": (DGCNN, DGCNNSettings),
}
"""Name in settings and checkpoints: network and its settings."""

__all__ = [
    "DGCNN",
    "ENCODERS",
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
]
