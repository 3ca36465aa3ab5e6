"""Samplers: from noise to clean trajectories by calls of a denoiser."""

from robotdiffuse.learning.samplers.ddim import ddim
from robotdiffuse.learning.samplers.ddpm import ddpm
from robotdiffuse.learning.samplers.dpm_solver import dpm_solver
from robotdiffuse.learning.samplers.euler import euler
from robotdiffuse.learning.samplers.sampler import DrawNoise, Predict, Sampler

SAMPLERS: dict[str, Sampler] = {
    "ddim": ddim,
    "ddpm": ddpm,
    "dpm_solver": dpm_solver,
    "euler": euler,
}
"""Name in checkpoints: function."""

__all__ = ["SAMPLERS", "DrawNoise", "Predict", "Sampler", "ddim", "ddpm", "dpm_solver", "euler"]
