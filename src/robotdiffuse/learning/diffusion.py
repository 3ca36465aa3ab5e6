"""The forward process: x_t = sqrt(alpha_bar_t) x_0 + sqrt(1 - alpha_bar_t) n, with n a Gaussian trajectory.

The noise may be white over the frames (the paper's identity covariance) or have the covariance of the
training trajectories over the frames. A trajectory is smooth, so white noise hides its low frequencies only
at the very end of the schedule, and noisy trajectories look like none that a robot follows; with the data's
covariance every frequency is hidden at the same rate, and clearances of noisy trajectories mean something.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from robotdiffuse.errors import InputError


@dataclass(frozen=True)
class ScheduleSettings:
    steps: int = 200
    """T, the number of noise levels (paper: 200)."""
    offset: float = 0.008
    """s of the cosine schedule (Nichol and Dhariwal 2021, eq. 17): the first levels are not too small."""
    floor: float = 1e-4
    """Least alpha_bar: the last level is pure noise but for this share of the variance."""

    def __post_init__(self) -> None:
        if self.steps < 2:
            raise InputError(f"schedule.steps is {self.steps}; it must be at least 2")


class NoiseSchedule:
    """alpha_bar_t of the levels t = 0 .. T; level 0 is the clean trajectory."""

    def __init__(self, settings: ScheduleSettings) -> None:
        self.settings = settings
        t = np.arange(settings.steps + 1) / settings.steps
        curve = np.cos((t + settings.offset) / (1 + settings.offset) * np.pi / 2) ** 2
        alpha_bar = np.maximum(curve / curve[0], settings.floor)
        self.signal: Float[ndarray, "levels"] = np.sqrt(alpha_bar)
        """sqrt(alpha_bar_t)"""
        self.noise: Float[ndarray, "levels"] = np.sqrt(1 - alpha_bar)
        """sqrt(1 - alpha_bar_t)"""

    @property
    def steps(self) -> int:
        return self.settings.steps

    def weight(self, t: Int[ndarray, "n"], limit: float) -> Float[ndarray, "n"]:
        """Weight of the loss on x_0 at level t: 1 + SNR, at most `limit`.

        1 + SNR is the weight that keeps the network's effective target at unit variance on every level
        (Karras et al. 2022, table 1, for unit data variance); the limit is that of min-SNR weighting
        (Hang et al. 2023).
        """
        return np.minimum(1 / np.maximum(self.noise[t] ** 2, 1 / limit), limit)

    def sampling_levels(self, steps: int) -> Int[ndarray, "steps_and_1"]:
        """The levels that a sampler of so many steps visits: from T to 0, evenly."""
        if not 1 <= steps <= self.steps:
            raise InputError(f"sampling steps is {steps}; it must be between 1 and {self.steps}")
        return np.linspace(self.steps, 0, steps + 1).round().astype(np.int64)


def noise_factor(residuals: Float[ndarray, "n frames dof"], smooth: bool) -> Float[ndarray, "frames frames"]:
    """L such that noise L e, with e white, is zero on the first and last frame, of mean variance 1 between.

    `residuals` are scaled to unit variance; for `smooth`, L Lᵀ is their covariance over the frames, with a
    little white noise so that no direction is left without noise.
    """
    frames = residuals.shape[1]
    inner = np.ones(frames)
    inner[[0, -1]] = 0.0
    if not smooth:
        return np.diag(inner)
    rows = np.moveaxis(residuals, 1, 2).reshape(-1, frames).astype(np.float64)
    covariance = rows.T @ rows / len(rows)
    mean_variance = np.trace(covariance) / inner.sum()
    covariance = covariance / mean_variance + 1e-4 * np.eye(frames)
    values, vectors = np.linalg.eigh(covariance)
    root = (vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T
    return inner[:, None] * root
