"""DDPM, ancestral sampling (Ho et al. 2020): the sampler of the paper, with all T levels, of MPD and of
EDMP."""

from collections.abc import Callable
from itertools import pairwise

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from robotdiffuse.core.errors import InputError
from robotdiffuse.learning.diffusion import NoiseSchedule
from robotdiffuse.learning.samplers.sampler import DrawNoise, Predict, check_eta

MoveMean = Callable[[ndarray, int], ndarray]
"""From the mean of a step [count, ...] and the number of steps that remain to the mean that is used
instead."""


def ddpm(
    predict: Predict,
    schedule: NoiseSchedule,
    draw_noise: DrawNoise,
    steps: int | None = None,
    eta: float = 1.0,
) -> Float[ndarray, "count ..."]:
    """Samples by DDPM; arguments and errors as in `Sampler`. None for `steps`: all T.

    Ancestral sampling draws all of its noise afresh, so `eta` has no effect.
    """
    check_eta(eta)
    levels = schedule.sampling_levels(schedule.steps if steps is None else steps)
    return ancestral(predict, schedule, draw_noise, levels[:-1])


def ancestral(
    predict: Predict,
    schedule: NoiseSchedule,
    draw_noise: DrawNoise,
    levels: Int[ndarray, "steps"],
    move: MoveMean | None = None,
    noise_scale: float = 1.0,
) -> Float[ndarray, "count ..."]:
    """Samples by ancestral sampling (Ho et al. 2020, algorithm 2) at any levels; the means may be moved.

    Each x is drawn from q(x_lower | x_level, x_0) at the predicted x_0, whose variance is beta tilde (Ho et
    al. 2020, eq. 7; between any two levels, Kingma et al. 2021, eq. 25).

    levels: falling. Sampling begins with standard noise at the first and ends with the clean x_0 below the
        last.
    move: replaces the mean of a step, for example by one further down the costs of a guide (MPD, algorithm
        1).
    noise_scale: factor of the standard deviation of the noise that is added to the means (MPD: 0.5).

    Raises InputError for levels that do not fall, or that the schedule lacks.
    """
    if not len(levels) or np.any(np.diff(levels) >= 0) or not 1 <= levels[-1] <= levels[0] <= schedule.steps:
        raise InputError(f"levels is {levels.tolist()}; they must fall from at most {schedule.steps} to 1")
    pairs = list(pairwise([*levels.tolist(), 0]))
    x = draw_noise()
    for step, (level, lower) in enumerate(pairs, 1):
        clean = predict(x, level)
        mean, deviation = _posterior(schedule, level, lower, x, clean) if lower else (clean, 0.0)
        x = mean if move is None else move(mean, len(pairs) - step)
        if lower:
            x = x + noise_scale * deviation * draw_noise()
    return x


def _posterior(
    schedule: NoiseSchedule, level: int, lower: int, x: Float[ndarray, "*s"], clean: Float[ndarray, "*s"]
) -> tuple[Float[ndarray, "*s"], float]:
    """Mean and standard deviation of x at the lower level, see `ancestral`."""
    variance, variance_low = float(schedule.noise[level]) ** 2, float(schedule.noise[lower]) ** 2
    kept = float(schedule.signal[level] / schedule.signal[lower])
    added = max(variance - kept**2 * variance_low, 0.0)
    mean = kept * variance_low / variance * x + float(schedule.signal[lower]) * added / variance * clean
    return mean, (added * variance_low / variance) ** 0.5
