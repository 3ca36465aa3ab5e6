"""Samplers: from noise to clean trajectories by calls of a denoiser."""

from robotdiffuse.learning.samplers.ddim import ddim

SAMPLERS = {"ddim": ddim}
"""Name in checkpoints: function."""

__all__ = ["SAMPLERS", "ddim"]
