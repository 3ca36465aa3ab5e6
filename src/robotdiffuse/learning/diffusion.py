"""The forward process: x_t = signal_t x_0 + noise_t n, with n a Gaussian trajectory.

Signal and noise of the levels t = 0 .. T are sqrt(alpha_bar_t) and sqrt(1 - alpha_bar_t), so that unit
variance is kept; alpha_bar follows the cosine schedule.

The noise is white over the waypoints (the paper's identity covariance), or has the covariance of the training
trajectories over the waypoints. Trajectories are smooth, so white noise hides their low frequencies only at
the very end of the schedule, and noisy trajectories look like none that a robot follows. With the data's
covariance every frequency is hidden at the same rate, and clearances along noisy trajectories carry
information.
"""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from robotdiffuse.core.errors import InputError
from robotdiffuse.core.settings import Bound, NotNegative, Settings


@dataclass(frozen=True)
class ScheduleSettings(Settings, name="schedule"):
    """The cosine schedule (Nichol and Dhariwal 2021, eq. 17)."""

    steps: Annotated[int, Bound(least=2.0, most=100_000.0)] = 200
    """T, the number of noise levels (paper: 200)."""
    offset: NotNegative = 0.008
    """The equation's s: it keeps the noise of the first levels from being too small."""
    floor: Annotated[float, Bound(above=0.0, below=1.0)] = 1e-4
    """Smallest alpha_bar: the share of the variance that is still signal at the last level."""
    log_snr_shift: NotNegative = 0.0
    """Subtracted from the logarithm of every level's signal-to-noise ratio (Hoogeboom et al. 2023). White
    noise averages out over many waypoints: without a shift most levels hide nothing of a long motion."""


class NoiseSchedule:
    """Signal and noise of the levels t = 0 .. T; level 0 is the clean trajectory."""

    def __init__(self, settings: ScheduleSettings) -> None:
        self.settings = settings
        t = np.arange(settings.steps + 1) / settings.steps
        curve = np.cos((t + settings.offset) / (1 + settings.offset) * np.pi / 2) ** 2
        alpha_bar = curve / curve[0]
        alpha_bar = alpha_bar / (alpha_bar + (1 - alpha_bar) * np.exp(settings.log_snr_shift))
        alpha_bar = np.maximum(alpha_bar, settings.floor)
        self.signal: Float[ndarray, "levels"] = np.sqrt(alpha_bar)
        """Factor of the clean trajectory in x_t."""
        self.noise: Float[ndarray, "levels"] = np.sqrt(1 - alpha_bar)
        """Factor of the unit noise in x_t."""
        with np.errstate(divide="ignore"):
            self.half_log_snr: Float[ndarray, "levels"] = np.log(self.signal) - np.log(self.noise)
            """Half the logarithm of the signal-to-noise ratio; inf at level 0."""

    @property
    def steps(self) -> int:
        """T."""
        return self.settings.steps

    def weight(self, t: Int[ndarray, "n"], limit: float) -> Float[ndarray, "n"]:
        """Weight of the loss on x_0 at level t: 1 + SNR, at most `limit`.

        With 1 + SNR the network's effective target has unit variance on every level (Karras et al. 2022,
        table 1, for unit data variance); the limit is that of min-SNR weighting (Hang et al. 2023).
        """
        power = self.signal[t] ** 2 + self.noise[t] ** 2
        return power / np.maximum(self.noise[t] ** 2, power / limit)

    def sampling_levels(self, steps: int) -> Int[ndarray, "steps_and_1"]:
        """The levels that a sampler with this many steps visits, evenly spaced from T to 0.

        Raises InputError unless steps is between 1 and T.
        """
        if not 1 <= steps <= self.steps:
            raise InputError(f"sampling steps is {steps}; it must be between 1 and {self.steps}")
        return np.linspace(self.steps, 0, steps + 1).round().astype(np.int64)


def noise_factor(
    residuals: Float[ndarray, "n waypoints dof"], smooth: bool
) -> Float[ndarray, "waypoints waypoints"]:
    """The matrix L that makes noise L e of white noise e: zero at both ends, of mean variance 1 between them.

    smooth: L Lᵀ is the covariance of the residuals over the waypoints, plus a little white noise so that
    every direction has some; else L is `white_noise_factor`. residuals: scaled to unit variance.
    """
    waypoints = residuals.shape[1]
    white = white_noise_factor(waypoints)
    if not smooth:
        return white
    by_waypoint = np.moveaxis(residuals, 1, 2).reshape(-1, waypoints).astype(np.float64)
    covariance = by_waypoint.T @ by_waypoint / len(by_waypoint)
    mean_variance = np.trace(covariance) / white.sum()
    covariance = covariance / mean_variance + 1e-4 * np.eye(waypoints)
    values, vectors = np.linalg.eigh(covariance)
    root = (vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T
    return white @ root


def white_noise_factor(waypoints: int) -> Float[ndarray, "waypoints waypoints"]:
    """L of noise that is white between the first and the last waypoint, and zero at these."""
    return np.diag(np.r_[0.0, np.ones(waypoints - 2), 0.0])
