"""What the network is trained to predict: the clean trajectory (the paper's) or the noise.

Each is a linear function of the clean trajectory and the noise. So the clean trajectory can be computed from
any of them, and samplers work on clean trajectories only. The formulas are plain arithmetic for NumPy arrays
and PyTorch tensors alike; `signal` and `noise_level` are the schedule's values at the levels of the
trajectories, and broadcast against these.
"""

from abc import ABC, abstractmethod
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from robotdiffuse.core.registry import Entry, Registry
from robotdiffuse.learning.diffusion import NoiseSchedule

Array = TypeVar("Array", bound=Any)
"""Clean trajectories, noise, noisy trajectories and network outputs, all arrays or all tensors, of the shape
[..., waypoints, dof]."""


class Objective(ABC):
    """The relation between the network's output and the clean trajectory."""

    @abstractmethod
    def target(self, clean: Array, noise: Array, signal: Any, noise_level: Any) -> Array:
        """The output that the network is trained towards for x_t = signal clean + noise_level noise."""

    @abstractmethod
    def clean(self, x_t: Array, output: Array, signal: Any, noise_level: Any) -> Array:
        """The clean trajectory that an output of the network for x_t stands for."""

    @abstractmethod
    def clean_per_output(self, signal: Any, noise_level: Any) -> Any:
        """d clean / d output: how an error of the output scales into the clean trajectory."""

    def weight(
        self, schedule: NoiseSchedule, t: Int[ndarray, "n"], limit: float | None
    ) -> Float[ndarray, "n"]:
        """Weight of the squared error of the output at levels t >= 1, at most `limit`; None: 1 everywhere.

        The weight of `NoiseSchedule.weight` on x_0, converted to the output, so that objectives differ in
        what the network outputs and not in the levels that they emphasise (Salimans and Ho 2022, section 4;
        Hang et al. 2023, who convert their weights in the same way). For the noise the converted weight is
        unbounded where little signal is left, so it is limited once more.
        """
        if limit is None:
            return np.ones(len(t))
        scale = self.clean_per_output(schedule.signal[t], schedule.noise[t])
        return np.minimum(schedule.weight(t, limit) * scale**2, limit)


class CleanObjective(Objective):
    """Predicts x_0 itself (paper, Method)."""

    def target(self, clean: Array, noise: Array, signal: Any, noise_level: Any) -> Array:
        return clean

    def clean(self, x_t: Array, output: Array, signal: Any, noise_level: Any) -> Array:
        return output

    def clean_per_output(self, signal: Any, noise_level: Any) -> Any:
        return 0 * signal + 1


class NoiseObjective(Objective):
    """Predicts the noise n (Ho et al. 2020)."""

    def target(self, clean: Array, noise: Array, signal: Any, noise_level: Any) -> Array:
        return noise

    def clean(self, x_t: Array, output: Array, signal: Any, noise_level: Any) -> Array:
        return (x_t - noise_level * output) / signal

    def clean_per_output(self, signal: Any, noise_level: Any) -> Any:
        return -noise_level / signal


_MODULE = "robotdiffuse.learning.objectives:"
OBJECTIVES = Registry(
    "objective",
    {
        "clean": Entry(_MODULE + "CleanObjective", "the clean trajectory, the paper's"),
        "noise": Entry(_MODULE + "NoiseObjective", "the noise"),
    },
)
"""By the name in settings. A new one is a class and a line here."""
