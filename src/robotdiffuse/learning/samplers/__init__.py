"""Samplers: from noise to clean trajectories by calls of a denoiser. A new one is one file and one line."""

from robotdiffuse.core.registry import Entry, Registry

_ROOM = "robotdiffuse.learning.samplers."
SAMPLERS = Registry(
    "sampler",
    {
        "ddim": Entry(_ROOM + "ddim:ddim", "deterministic, or with a share of the noise drawn afresh"),
        "ddpm": Entry(_ROOM + "ddpm:ddpm", "ancestral sampling, the paper's"),
        "dpm_solver": Entry(_ROOM + "dpm_solver:dpm_solver", "DPM-Solver++(2M), of second order"),
        "euler": Entry(_ROOM + "ddim:ddim", "Euler's method for flows, which is DDIM"),
    },
)
"""By the name in settings and checkpoints: functions, see `sampler.Sampler`."""
