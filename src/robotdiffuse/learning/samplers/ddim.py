"""DDIM (Song et al. 2021): deterministic, or with a share of the noise drawn afresh at every step.

It is Euler's method for flows too. On the flow schedule, with t from 1 to 0, x_t = (1 - t) x_0 + t n and the
velocity is dx/dt = n - x_0. The predicted x_0 makes it v = (x_t - x_0) / t, and Euler's step from t to s is

    x_s = x_t + (s - t) v = (s / t) x_t + (1 - s / t) x_0.

DDIM keeps x_0 and the noise n = (x_t - (1 - t) x_0) / t that belongs to it, and mixes them anew:

    x_s = (1 - s) x_0 + s n = (s / t) x_t + (1 - s - s (1 - t) / t) x_0 = (s / t) x_t + (1 - s / t) x_0,

the same rule. On other schedules DDIM is Euler's method in x / signal over noise / signal (eq. 14 there).
"""

from itertools import pairwise

from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.learning.diffusion import NoiseSchedule
from robotdiffuse.learning.samplers.sampler import DrawNoise, Predict, check_eta


def ddim(
    predict: Predict, schedule: NoiseSchedule, draw_noise: DrawNoise, steps: int, eta: float = 0.0
) -> Float[ndarray, "count ..."]:
    """See `Sampler`."""
    check_eta(eta)
    levels = schedule.sampling_levels(steps).tolist()
    x = draw_noise()
    for level, lower in pairwise(levels[:-1]):
        x = ddim_step(x, predict(x, level), schedule, level, lower, draw_noise, eta)
    return predict(x, levels[-2])


def ddim_step(
    x: Float[ndarray, "count ..."],
    clean: Float[ndarray, "count ..."],
    schedule: NoiseSchedule,
    level: int,
    lower: int,
    draw_noise: DrawNoise,
    eta: float,
) -> Float[ndarray, "count ..."]:
    """x at the level `lower` from x at `level` and its clean prediction (Song et al. 2021, eq. 12).

    The noise seen in x is kept, but for the share that is drawn afresh: eq. 16 there, written so that it
    also holds for schedules that do not keep the variance (flows).
    """
    signal, noise = float(schedule.signal[level]), float(schedule.noise[level])
    signal_low, noise_low = float(schedule.signal[lower]), float(schedule.noise[lower])
    seen = (x - signal * clean) / noise
    added = max(noise**2 - (signal / signal_low * noise_low) ** 2, 0.0) ** 0.5
    fresh = eta * noise_low / noise * added
    x = signal_low * clean + (noise_low**2 - fresh**2) ** 0.5 * seen
    return x + fresh * draw_noise() if fresh > 0 else x
