"""DDIM (Song et al. 2021): deterministic, or with a share of fresh noise at every step."""

from itertools import pairwise

from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.learning.diffusion import NoiseSchedule
from robotdiffuse.learning.samplers.sampler import DrawNoise, Predict, check_eta


def ddim(
    predict: Predict, schedule: NoiseSchedule, draw_noise: DrawNoise, steps: int, eta: float = 0.0
) -> Float[ndarray, "count ..."]:
    """Samples by DDIM; arguments and errors as in `Sampler`."""
    check_eta(eta)
    levels = schedule.sampling_levels(steps).tolist()
    x = draw_noise()
    for level, lower in pairwise(levels[:-1]):
        x = _step(x, predict(x, level), schedule, level, lower, draw_noise, eta)
    return predict(x, levels[-2])


def _step(
    x: Float[ndarray, "count ..."],
    clean: Float[ndarray, "count ..."],
    schedule: NoiseSchedule,
    level: int,
    lower: int,
    draw_noise: DrawNoise,
    eta: float,
) -> Float[ndarray, "count ..."]:
    """x at the level `lower`, from x at `level` and its clean prediction (Song et al. 2021, eq. 12).

    The noise found in x is kept, except for the share that is drawn afresh (eq. 16).
    """
    signal, noise = float(schedule.signal[level]), float(schedule.noise[level])
    signal_low, noise_low = float(schedule.signal[lower]), float(schedule.noise[lower])
    found = (x - signal * clean) / noise
    added = max(noise**2 - (signal / signal_low * noise_low) ** 2, 0.0) ** 0.5
    fresh = eta * noise_low / noise * added
    x = signal_low * clean + (noise_low**2 - fresh**2) ** 0.5 * found
    return x + fresh * draw_noise() if fresh > 0 else x
