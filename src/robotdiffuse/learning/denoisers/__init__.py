"""Networks that predict the clean trajectory from a noisy one."""

from robotdiffuse.learning.denoisers.transformer import Transformer, TransformerSettings

DENOISERS = {"transformer": (Transformer, TransformerSettings)}
"""Name in checkpoints: network and its settings."""

__all__ = ["DENOISERS", "Transformer", "TransformerSettings"]
