"""The interface of samplers, which go down the noise levels by calls of a predictor of the clean
trajectory."""

from collections.abc import Callable
from typing import Protocol

from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.core.errors import InputError
from robotdiffuse.learning.diffusion import NoiseSchedule

Predict = Callable[[ndarray, int], ndarray]
"""From (x_t [count, ...], t) to the predicted clean x_0. It converts the network's output (see `objectives`),
holds the ends and applies guidance."""
DrawNoise = Callable[[], ndarray]
"""Returns fresh standard noise of the shape of the samples."""


class Sampler(Protocol):
    """A function that calls the predictor once per step, first at level T with pure noise, and returns its
    prediction at the last level that it visits."""

    def __call__(
        self, predict: Predict, schedule: NoiseSchedule, draw_noise: DrawNoise, steps: int, eta: float = ...
    ) -> Float[ndarray, "count ..."]:
        """Samples, [count, ...] like the noise.

        steps: calls of the predictor, 1 to T.
        eta: share of the noise that is drawn afresh at every step: 0 is the deterministic probability flow, 1
            the full stochastic process (ancestral sampling).
        Raises InputError for steps or eta out of range.
        """
        ...


def check_eta(eta: float) -> None:
    """Raises InputError unless eta is between 0 and 1."""
    if not 0 <= eta <= 1:
        raise InputError(f"eta is {eta}; it must be between 0 and 1")
