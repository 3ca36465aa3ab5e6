"""Noise levels, the quantity that the network predicts, and the samplers.

The forward process: x_t = signal_t x_0 + noise_t n, with n a Gaussian trajectory.

Signal and noise of the levels t = 0 .. T are sqrt(alpha_bar_t) and sqrt(1 - alpha_bar_t), so that unit
variance is kept; alpha_bar follows the cosine schedule.

The noise is white over the waypoints (the paper's identity covariance), or has the covariance of the training
trajectories over the waypoints. Trajectories are smooth, so white noise hides their low frequencies only at
the very end of the schedule, and noisy trajectories look like none that a robot follows. With the data's
covariance every frequency is hidden at the same rate, and clearances along noisy trajectories carry
information.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Annotated, Any, TypeVar

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from robotdiffuse.core.errors import InputError
from robotdiffuse.core.registry import Entry, Registry
from robotdiffuse.core.settings import Bound, NotNegative, Settings, ShareBetween
from robotdiffuse.core.types import Values


@dataclass(frozen=True)
class ScheduleSettings(Settings, name="schedule"):
    """The cosine schedule (Nichol and Dhariwal 2021, eq. 17)."""

    steps: Annotated[int, Bound(least=2.0, most=100_000.0)] = 200
    """T, the number of noise levels (paper: 200)."""
    offset: NotNegative = 0.008
    """The equation's s, which makes the noise of the first levels large enough."""
    floor: ShareBetween = 1e-4
    """Smallest alpha_bar, which is the fraction of the variance that is still signal at the last level."""
    log_snr_shift: NotNegative = 0.0
    """Subtracted from the logarithm of every level's signal-to-noise ratio (Hoogeboom et al. 2023). White
    noise averages out over many waypoints: without a shift most levels hide nothing of a long motion."""


class NoiseSchedule:
    """Signal and noise of the levels t = 0 .. T; level 0 is the clean trajectory."""

    def __init__(self, settings: ScheduleSettings) -> None:
        self.steps = settings.steps
        """T."""
        t = np.arange(settings.steps + 1) / settings.steps
        curve = np.cos((t + settings.offset) / (1 + settings.offset) * np.pi / 2) ** 2
        alpha_bar = curve / curve[0]
        alpha_bar = alpha_bar / (alpha_bar + (1 - alpha_bar) * np.exp(settings.log_snr_shift))
        alpha_bar = np.maximum(alpha_bar, settings.floor)
        self.signal: Values = np.sqrt(alpha_bar)
        """Factor of the clean trajectory in x_t, by level."""
        self.noise: Values = np.sqrt(1 - alpha_bar)
        """Factor of the unit noise in x_t, by level."""
        with np.errstate(divide="ignore"):
            self.half_log_snr: Values = np.log(self.signal) - np.log(self.noise)
            """Half the logarithm of the signal-to-noise ratio; inf at level 0."""

    def weight(self, t: Int[ndarray, "n"], limit: float) -> Values:
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
    """The matrix L that turns white noise e into the noise L e of the forward process. This noise is zero at
    the first and the last waypoint, and its mean variance between them is 1.

    residuals: trajectories relative to their reference, scaled to unit variance. smooth: if true, L Lᵀ is the
    covariance of the residuals over the waypoints between these two, plus a little white noise so that it has
    full rank there; if false, L is `white_noise_factor`.
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
    """L for noise that is white between the first and the last waypoint, and zero at these two."""
    return np.diag(np.r_[0.0, np.ones(waypoints - 2), 0.0])


Array = TypeVar("Array", bound=Any)
"""Clean trajectories, noise, noisy trajectories and network outputs, all arrays or all tensors, of the shape
[..., waypoints, dof]."""


@dataclass(frozen=True)
class Objective:
    """What the network is trained to predict: the clean trajectory x_0 itself (paper, Method), or the noise n
    (Ho et al. 2020).

    Each objective is a linear function of the clean trajectory and the noise. So the clean trajectory can be
    computed from x_t and the output for it, and samplers work on clean trajectories only. The formulas are
    plain arithmetic for NumPy arrays and PyTorch tensors alike; `signal` and `noise_level` are the schedule's
    values at the levels of the trajectories, and broadcast against the trajectories.
    """

    predicts_noise: bool

    def target(self, clean: Array, noise: Array) -> Array:
        """The output that the network should have for x_t = signal * clean + noise_level * noise."""
        return noise if self.predicts_noise else clean

    def clean(self, x_t: Array, output: Array, signal: Any, noise_level: Any) -> Array:
        """The clean trajectory that follows from an output of the network for x_t."""
        return (x_t - noise_level * output) / signal if self.predicts_noise else output

    def clean_per_output(self, signal: Any, noise_level: Any) -> Any:
        """d clean / d output: factor from an error of the output to the error of the clean trajectory."""
        return -noise_level / signal if self.predicts_noise else 0 * signal + 1

    def weight(self, schedule: NoiseSchedule, t: Int[ndarray, "n"], limit: float | None) -> Values:
        """Weight of the squared error of the output at levels t >= 1, at most `limit`; None: 1 everywhere.

        It is the weight of `NoiseSchedule.weight` on x_0, converted to the output, so that objectives differ
        only in what the network outputs, not in the levels that they emphasize (Salimans and Ho 2022, section
        4; Hang et al. 2023 convert their weights in this way). For the noise, the converted weight is
        unbounded where little signal is left, so it is limited once more.
        """
        if limit is None:
            return np.ones(len(t))
        scale = self.clean_per_output(schedule.signal[t], schedule.noise[t])
        return np.minimum(schedule.weight(t, limit) * scale**2, limit)


OBJECTIVES = {"clean": Objective(predicts_noise=False), "noise": Objective(predicts_noise=True)}
"""Objectives by their name in settings."""

Samples = Float[ndarray, "count ..."]
NoiseLevels = Int[ndarray, "steps"]
Predict = Callable[[ndarray, int], ndarray]
"""A function from (x_t [count, ...], t) to the predicted clean x_0. It converts the network's output as the
objective requires, sets the first and the last waypoint to start and goal, and applies guidance."""
DrawNoise = Callable[[], ndarray]
"""A function that returns new standard noise in the shape of the samples."""
MoveMean = Callable[[ndarray, int], ndarray]
"""A function from the mean of a denoising step [count, ...] and the number of remaining steps to the mean
that is used instead."""


def ddim(
    predict: Predict, schedule: NoiseSchedule, draw_noise: DrawNoise, steps: int, eta: float = 0.0
) -> Samples:
    """Samples by DDIM (Song et al. 2021): deterministic, or with a share of fresh noise at every step.

    `predict` is called once per step, first at level T with pure noise.

    steps: calls of the predictor, 1 to T.
    eta: share of the noise that is drawn afresh at every step: 0 is the deterministic probability flow, 1 the
        full stochastic process (ancestral sampling).
    Raises InputError for steps out of range.
    """
    return reverse_process(predict, schedule, draw_noise, schedule.sampling_levels(steps)[:-1], eta=eta)


def ddpm(
    predict: Predict, schedule: NoiseSchedule, draw_noise: DrawNoise, steps: int, eta: float = 1.0
) -> Samples:
    """Samples by DDPM, ancestral sampling (Ho et al. 2020): the sampler of MPD, of EDMP and, with all T
    levels, of the paper. All noise is drawn afresh, for any `eta`."""
    return ddim(predict, schedule, draw_noise, steps, eta=1.0)


def reverse_process(
    predict: Predict,
    schedule: NoiseSchedule,
    draw_noise: DrawNoise,
    levels: NoiseLevels,
    move: MoveMean | None = None,
    noise_scale: float = 1.0,
    eta: float = 1.0,
) -> Samples:
    """Samples by denoising at the given levels (Ho et al. 2020, algorithm 2). The mean of each step may be
    moved.

    Each x at a lower level is drawn about its mean given x_level and the predicted x_0 (Song et al. 2021, eq.
    12): the noise in x is kept, except for the share that is drawn afresh (eq. 16). With eta = 1, x_lower is
    drawn from q(x_lower | x_level, x_0), whose variance is beta tilde (Ho et al. 2020, eq. 7; between any two
    levels, Kingma et al. 2021, eq. 25).

    levels: in descending order. Sampling begins with standard noise at the first level; the step from the
        last level gives the clean x_0.
    move: replaces the mean of a step, for example by a mean with lower costs (MPD, algorithm 1).
    noise_scale: factor of the standard deviation of the noise that is added to the means (MPD: 0.5).
    eta: see `ddim`.
    """
    x = draw_noise()
    remaining = len(levels)
    for level, lower in pairwise([*levels.tolist(), 0]):
        remaining -= 1
        clean = predict(x, level)
        mean, deviation = _step(x, clean, schedule, level, lower, eta) if lower else (clean, 0.0)
        x = mean if move is None else move(mean, remaining)
        if lower and eta > 0:
            x = x + noise_scale * deviation * draw_noise()
    return x


def _step(
    x: Samples, clean: Samples, schedule: NoiseSchedule, level: int, lower: int, eta: float
) -> tuple[Samples, float]:
    """Mean and standard deviation of x at the level `lower`, from x at `level` and its clean prediction."""
    signal, signal_low = schedule.signal[[level, lower]].tolist()
    noise, noise_low = schedule.noise[[level, lower]].tolist()
    forward_noise = max(noise**2 - (signal / signal_low * noise_low) ** 2, 0.0) ** 0.5
    fresh_noise = eta * noise_low / noise * forward_noise
    predicted_noise = (x - signal * clean) / noise
    return signal_low * clean + (noise_low**2 - fresh_noise**2) ** 0.5 * predicted_noise, fresh_noise


SAMPLERS = Registry(
    "sampler",
    {
        "ddim": Entry(f"{__name__}:ddim", "deterministic, or with a share of fresh noise"),
        "ddpm": Entry(f"{__name__}:ddpm", "ancestral sampling, the paper's"),
    },
)
"""Samplers by their name in settings and checkpoints; they have the arguments of `ddim`."""
