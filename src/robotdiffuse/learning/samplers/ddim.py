"""DDIM (Song et al. 2021): deterministic, or with a share of the noise drawn afresh at every step."""

from collections.abc import Callable
from itertools import pairwise

from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.learning.diffusion import NoiseSchedule


def ddim(
    predict: Callable[[ndarray, int], ndarray],
    schedule: NoiseSchedule,
    draw_noise: Callable[[], ndarray],
    steps: int,
    eta: float = 0.0,
) -> Float[ndarray, "count ..."]:
    """Samples, [count, ...] like the noise.

    predict: (x_t, t) to the clean x_0.
    draw_noise: standard noise of the shape of the samples.
    eta: share of DDPM's fresh noise per step; 0 is deterministic, 1 is ancestral sampling.
    """
    levels = schedule.sampling_levels(steps).tolist()
    signal, noise = schedule.signal.tolist(), schedule.noise.tolist()
    x = draw_noise()
    for level, lower in pairwise(levels[:-1]):
        clean = predict(x, level)
        seen = (x - signal[level] * clean) / noise[level]
        step = max(1.0 - (signal[level] / signal[lower]) ** 2, 0.0) ** 0.5
        fresh = eta * noise[lower] / noise[level] * step
        x = signal[lower] * clean + (noise[lower] ** 2 - fresh**2) ** 0.5 * seen
        if fresh > 0:
            x = x + fresh * draw_noise()
    return predict(x, levels[-2])
