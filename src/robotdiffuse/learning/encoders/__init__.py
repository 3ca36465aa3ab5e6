"""Encoders of the scene: point cloud to a few numbers."""

from robotdiffuse.learning.encoders.point_autoencoder import PointAutoencoder, PointAutoencoderSettings

ENCODERS = {"point_autoencoder": (PointAutoencoder, PointAutoencoderSettings)}
"""Name in checkpoints: network and its settings."""

__all__ = ["ENCODERS", "PointAutoencoder", "PointAutoencoderSettings"]
