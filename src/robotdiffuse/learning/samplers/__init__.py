"""Samplers: from noise to clean trajectories by calls of a denoiser. A new one is one file and one line."""

from robotdiffuse.core.registry import Entry, Registry

_PACKAGE = "robotdiffuse.learning.samplers."
SAMPLERS = Registry(
    "sampler",
    {
        "ddim": Entry(_PACKAGE + "ddim:ddim", "deterministic, or with a share of fresh noise"),
        "ddpm": Entry(_PACKAGE + "ddpm:ddpm", "ancestral sampling, the paper's"),
    },
)
"""By the name in settings and checkpoints: functions, see `sampler.Sampler`."""
