"""Euler's method for flows."""

from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.learning.diffusion import NoiseSchedule
from robotdiffuse.learning.samplers.ddim import ddim
from robotdiffuse.learning.samplers.sampler import DrawNoise, Predict


def euler(
    predict: Predict, schedule: NoiseSchedule, draw_noise: DrawNoise, steps: int, eta: float = 0.0
) -> Float[ndarray, "count ..."]:
    """See `Sampler`.

    On the flow schedule, with t from 1 to 0, x_t = (1 - t) x_0 + t n and the velocity is dx/dt = n - x_0.
    The predicted x_0 makes it v = (x_t - x_0) / t, and Euler's step from t to s is

        x_s = x_t + (s - t) v = (s / t) x_t + (1 - s / t) x_0.

    DDIM keeps x_0 and the noise n = (x_t - (1 - t) x_0) / t that belongs to it, and mixes them anew:

        x_s = (1 - s) x_0 + s n = (s / t) x_t + (1 - s - s (1 - t) / t) x_0 = (s / t) x_t + (1 - s / t) x_0,

    the same rule. On other schedules DDIM is Euler's method in x / signal over noise / signal (Song et al.
    2021, eq. 14), and so is this.
    """
    return ddim(predict, schedule, draw_noise, steps, eta)
