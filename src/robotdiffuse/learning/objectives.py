"""What the network is trained to predict: the clean trajectory (as in the paper), the noise or a velocity.

Each is a linear function of the clean trajectory and the noise, so a prediction of any of them is one of all,
and samplers see clean trajectories only. All of it is plain arithmetic, for NumPy arrays and PyTorch tensors;
`signal` and `noise_level` are the schedule's at the levels of the trajectories, and broadcast against them.
"""

from abc import ABC, abstractmethod
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from torch import Tensor

from robotdiffuse.core.errors import InputError
from robotdiffuse.core.registry import Entry, Registry
from robotdiffuse.learning.diffusion import NoiseSchedule

Array = TypeVar("Array", ndarray, Tensor)
"""Clean, noise, noisy trajectories and network outputs are all of one kind and shape, [..., waypoints,
dof]."""


class Objective(ABC):
    @abstractmethod
    def target(self, clean: Array, noise: Array, signal: Any, noise_level: Any) -> Array:
        """What the network is to output for x_t = signal clean + noise_level noise."""

    @abstractmethod
    def clean(self, x_t: Array, output: Array, signal: Any, noise_level: Any) -> Array:
        """The clean trajectory that belongs to x_t and an output of the network."""

    @abstractmethod
    def clean_per_output(self, signal: Any, noise_level: Any) -> Any:
        """d clean / d output: what an error of the output does to the clean trajectory."""

    def weight(
        self, schedule: NoiseSchedule, t: Int[ndarray, "n"], limit: float | None
    ) -> Float[ndarray, "n"]:
        """Weight of the squared error of the output at levels t >= 1, at most `limit`; 1 for None.

        It is the weight that makes the loss the same as `NoiseSchedule.weight` makes it for x_0, so that
        objectives differ in what the network outputs and not in the levels that they care for (Salimans and
        Ho 2022, section 4; Hang et al. 2023, who convert their weights so). For the noise that weight is
        without bound where little signal is left, hence the limit once more.
        """
        if limit is None:
            return np.ones(len(t))
        scale = self.clean_per_output(schedule.signal[t], schedule.noise[t])
        return np.minimum(schedule.weight(t, limit) * scale**2, limit)


class CleanObjective(Objective):
    """x_0 itself (paper, Method)."""

    def target(self, clean: Array, noise: Array, signal: Any, noise_level: Any) -> Array:
        return clean

    def clean(self, x_t: Array, output: Array, signal: Any, noise_level: Any) -> Array:
        return output

    def clean_per_output(self, signal: Any, noise_level: Any) -> Any:
        return 0 * signal + 1


class NoiseObjective(Objective):
    """The noise n (Ho et al. 2020). Needs a schedule with some signal left at the last level."""

    def target(self, clean: Array, noise: Array, signal: Any, noise_level: Any) -> Array:
        return noise

    def clean(self, x_t: Array, output: Array, signal: Any, noise_level: Any) -> Array:
        return (x_t - noise_level * output) / signal

    def clean_per_output(self, signal: Any, noise_level: Any) -> Any:
        return -noise_level / signal


class VelocityObjective(Objective):
    """n - x_0, on the flow schedule the velocity dx/dt (Lipman et al. 2023, eq. 23 with t reversed).

    On any other schedule it is the same difference, well defined on all levels. It is not the `v` of Salimans
    and Ho 2022, which is signal n - noise_level x_0.
    """

    def target(self, clean: Array, noise: Array, signal: Any, noise_level: Any) -> Array:
        return noise - clean

    def clean(self, x_t: Array, output: Array, signal: Any, noise_level: Any) -> Array:
        return (x_t - noise_level * output) / (signal + noise_level)

    def clean_per_output(self, signal: Any, noise_level: Any) -> Any:
        return -noise_level / (signal + noise_level)


_HERE = "robotdiffuse.learning.objectives:"
OBJECTIVES = Registry(
    "objective",
    {
        "clean": Entry(_HERE + "CleanObjective", "the clean trajectory, the paper's"),
        "noise": Entry(_HERE + "NoiseObjective", "the noise"),
        "velocity": Entry(_HERE + "VelocityObjective", "the noise less the clean trajectory"),
    },
)
"""By the name in settings. A new one is a class and a line here."""


def objective_for(name: str, schedule: NoiseSchedule) -> Objective:
    """The objective of this name. Raises InputError if it is unknown or cannot be used with the schedule."""
    objective: Objective = OBJECTIVES.make(name)
    if name == "noise" and schedule.signal[-1] == 0:
        raise InputError(
            f"objective is 'noise' and schedule.kind is {schedule.settings.kind!r}, whose last level "
            "has no signal to tell from the noise; choose 'clean' or 'velocity', or another schedule"
        )
    return objective
