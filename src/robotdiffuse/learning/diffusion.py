"""The forward process: x_t = signal_t x_0 + noise_t n, with n a Gaussian trajectory.

A schedule gives signal and noise of the levels t = 0 .. T. For `cosine` and `linear` they are
sqrt(alpha_bar_t) and sqrt(1 - alpha_bar_t), so that unit variance stays; `flow` is the straight line from the
data to the noise.

The noise may be white over the waypoints (the paper's identity covariance) or have the covariance of the
training trajectories over the waypoints. A trajectory is smooth, so white noise hides its low frequencies
only at the very end of the schedule, and noisy trajectories look like none that a robot follows; with the
data's covariance every frequency is hidden at the same rate, and clearances of noisy trajectories mean
something.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from robotdiffuse.core.errors import InputError
from robotdiffuse.core.settings import Bound, NotNegative, OneOf, Settings

Levels = tuple[Float[ndarray, "levels"], Float[ndarray, "levels"]]
"""Signal and noise of the levels 0 .. T."""

LINEAR_BETAS = (1e-4, 0.02)
"""Variance that the first and last of LINEAR_STEPS steps add (Ho et al. 2020)."""
LINEAR_STEPS = 1000


def cosine(settings: "ScheduleSettings") -> Levels:
    """Nichol and Dhariwal 2021, eq. 17."""
    t = np.arange(settings.steps + 1) / settings.steps
    curve = np.cos((t + settings.offset) / (1 + settings.offset) * np.pi / 2) ** 2
    alpha_bar = np.maximum(curve / curve[0], settings.floor)
    return np.sqrt(alpha_bar), np.sqrt(1 - alpha_bar)


def linear(settings: "ScheduleSettings") -> Levels:
    """Betas that grow evenly (Ho et al. 2020), scaled by 1000 / T so that any T ends at as little signal."""
    betas = np.linspace(*LINEAR_BETAS, settings.steps) * (LINEAR_STEPS / settings.steps)
    alpha_bar = np.concatenate([[1.0], np.cumprod(1 - betas)])
    return np.sqrt(alpha_bar), np.sqrt(1 - alpha_bar)


def flow(settings: "ScheduleSettings") -> Levels:
    """x_t = (1 - t/T) x_0 + t/T n: rectified flow, flow matching (Lipman et al. 2023; Liu et al. 2023)."""
    t = np.arange(settings.steps + 1) / settings.steps
    return 1 - t, t


SCHEDULES: dict[str, Callable[["ScheduleSettings"], Levels]] = {
    "cosine": cosine,
    "linear": linear,
    "flow": flow,
}
"""Name in ScheduleSettings.kind: function."""


@dataclass(frozen=True)
class ScheduleSettings(Settings, name="schedule"):
    steps: Annotated[int, Bound(least=2.0, most=100_000.0)] = 200
    """T, the number of noise levels (paper: 200)."""
    offset: NotNegative = 0.008
    """s of the cosine schedule (Nichol and Dhariwal 2021, eq. 17): the first levels are not too small."""
    floor: Annotated[float, Bound(above=0.0, below=1.0)] = 1e-4
    """Least alpha_bar of the cosine schedule: the last level is noise but for this share of the variance."""
    kind: Annotated[str, OneOf(SCHEDULES)] = "cosine"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.kind == "linear" and self.steps <= LINEAR_STEPS * LINEAR_BETAS[1]:
            raise InputError(
                f"schedule.steps is {self.steps}; the linear schedule needs more than "
                f"{LINEAR_STEPS * LINEAR_BETAS[1]:.0f}, or its last step would leave no signal"
            )


class NoiseSchedule:
    """Signal and noise of the levels t = 0 .. T; level 0 is the clean trajectory."""

    def __init__(self, settings: ScheduleSettings) -> None:
        self.settings = settings
        signal, noise = SCHEDULES[settings.kind](settings)
        self.signal: Float[ndarray, "levels"] = signal
        """Factor of the clean trajectory in x_t."""
        self.noise: Float[ndarray, "levels"] = noise
        """Factor of the unit noise in x_t."""
        with np.errstate(divide="ignore"):
            self.half_log_snr: Float[ndarray, "levels"] = np.log(signal) - np.log(noise)
            """lambda_t = log(signal / noise); inf at level 0, and -inf where a flow ends."""

    @property
    def steps(self) -> int:
        return self.settings.steps

    def weight(self, t: Int[ndarray, "n"], limit: float) -> Float[ndarray, "n"]:
        """Weight of the loss on x_0 at level t: 1 + SNR, at most `limit`.

        1 + SNR is the weight that keeps the network's effective target at unit variance on every level
        (Karras et al. 2022, table 1, for unit data variance); the limit is that of min-SNR weighting
        (Hang et al. 2023).
        """
        power = self.signal[t] ** 2 + self.noise[t] ** 2
        return power / np.maximum(self.noise[t] ** 2, power / limit)

    def sampling_levels(self, steps: int) -> Int[ndarray, "steps_and_1"]:
        """The levels that a sampler of so many steps visits: from T to 0, evenly."""
        if not 1 <= steps <= self.steps:
            raise InputError(f"sampling steps is {steps}; it must be between 1 and {self.steps}")
        return np.linspace(self.steps, 0, steps + 1).round().astype(np.int64)


def noise_factor(
    residuals: Float[ndarray, "n waypoints dof"], smooth: bool
) -> Float[ndarray, "waypoints waypoints"]:
    """L such that noise L e, with e white, is zero on the first and last waypoint, of mean variance 1
    between.

    `residuals` are scaled to unit variance; for `smooth`, L Lᵀ is their covariance over the waypoints, with a
    little white noise so that no direction is left without noise.
    """
    waypoints = residuals.shape[1]
    white = white_factor(waypoints)
    if not smooth:
        return white
    rows = np.moveaxis(residuals, 1, 2).reshape(-1, waypoints).astype(np.float64)
    covariance = rows.T @ rows / len(rows)
    mean_variance = np.trace(covariance) / white.sum()
    covariance = covariance / mean_variance + 1e-4 * np.eye(waypoints)
    values, vectors = np.linalg.eigh(covariance)
    root = (vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T
    return white @ root


def white_factor(waypoints: int) -> Float[ndarray, "waypoints waypoints"]:
    """The same for noise that is white over the waypoints between the first and the last."""
    return np.diag(np.r_[0.0, np.ones(waypoints - 2), 0.0])
