"""What a sampler is: a way down the noise levels by calls of a predictor of the clean trajectory."""

from collections.abc import Callable
from typing import Protocol

from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.core.errors import InputError
from robotdiffuse.learning.diffusion import NoiseSchedule

Predict = Callable[[ndarray, int], ndarray]
"""(x_t [count, ...], t) to the predicted clean x_0. Whatever the network was trained to predict, see
`objectives`; held ends and guidance are done within."""
DrawNoise = Callable[[], ndarray]
"""Standard noise of the shape of the samples, new at every call."""


class Sampler(Protocol):
    """All samplers work on predicted clean data, call the predictor once per step, first at level T with pure
    noise, and return its prediction at the last level that they visit."""

    def __call__(
        self, predict: Predict, schedule: NoiseSchedule, draw_noise: DrawNoise, steps: int, eta: float = ...
    ) -> Float[ndarray, "count ..."]:
        """Samples, [count, ...] like the noise.

        steps: calls of the predictor, 1 to T.
        eta: share of the noise that is drawn afresh at every step, 0 to 1: 0 is the deterministic flow of
            probability, 1 the full stochastic process (ancestral sampling).
        Raises InputError for steps or eta out of range.
        """
        ...


def check_eta(eta: float) -> None:
    """Raises InputError unless eta is a share."""
    if not 0 <= eta <= 1:
        raise InputError(f"eta is {eta}; it must be between 0 and 1")
