"""DDPM, ancestral sampling (Ho et al. 2020): the paper's sampler, with all T levels."""

from itertools import pairwise

from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.learning.diffusion import NoiseSchedule
from robotdiffuse.learning.samplers.sampler import DrawNoise, Predict, check_eta


def ddpm(
    predict: Predict,
    schedule: NoiseSchedule,
    draw_noise: DrawNoise,
    steps: int | None = None,
    eta: float = 1.0,
) -> Float[ndarray, "count ..."]:
    """See `Sampler`; None for `steps` is all T of them.

    Each x is drawn from q(x_lower | x_level, x_0) at the predicted x_0, whose variance is beta tilde (Ho et
    al. 2020, eq. 7; between any two levels, Kingma et al. 2021, eq. 25). Ancestral sampling draws all of its
    noise afresh, so `eta` changes nothing.
    """
    check_eta(eta)
    levels = schedule.sampling_levels(schedule.steps if steps is None else steps).tolist()
    signal, variance = schedule.signal.tolist(), (schedule.noise**2).tolist()
    x = draw_noise()
    for level, lower in pairwise(levels[:-1]):
        clean = predict(x, level)
        kept = signal[level] / signal[lower]
        added = max(variance[level] - kept**2 * variance[lower], 0.0)
        of_x = kept * variance[lower] / variance[level]
        of_clean = signal[lower] * added / variance[level]
        x = of_x * x + of_clean * clean + (added * variance[lower] / variance[level]) ** 0.5 * draw_noise()
    return predict(x, levels[-2])
