"""Trajectories as the rows of numbers that are diffused: normalised, relative to a base, scaled.

A trajectory is rows x of a parametrization (frames or spline control points), in units of the training data's
standard deviation, relative to a base: the straight line from start to goal (target `residual`), or the mean
of the data (target `absolute`, the paper's). The first and the last row are start and goal and are held: the
paper's noise interpolation, which writes them over the ends at every step.
"""

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from torch import Tensor, nn

from robotdiffuse.errors import unknown_name
from robotdiffuse.learning.diffusion import noise_factor
from robotdiffuse.learning.normalizer import JointNormalizer
from robotdiffuse.learning.parametrization import Parametrization

TARGETS = ("residual", "absolute")


class Between(NamedTuple):
    """What rows between a start and a goal are relative to."""

    base: Float[ndarray, "*batch rows dof"]
    """Normalised joint values that x, times its scale, is added to."""
    ends: Float[ndarray, "*batch 2 dof"]
    """The first and the last row of x."""


class TrajectoryRows(nn.Module):
    """The two directions between joint values and rows, with the statistics that they need."""

    residual_scale: Tensor
    residual_mean: Tensor
    noise_factor: Tensor

    def __init__(
        self, normalizer: JointNormalizer, parametrization: Parametrization, target: str, frames: int
    ) -> None:
        super().__init__()
        if target not in TARGETS:
            raise unknown_name("target", target, TARGETS)
        self.normalizer, self.parametrization, self.target = normalizer, parametrization, target
        self.dof, self.rows = len(normalizer.middle), parametrization.rows
        self.register_buffer("residual_scale", torch.ones(self.dof))
        self.register_buffer("residual_mean", torch.zeros(self.dof), persistent=target == "absolute")
        self.register_buffer("noise_factor", torch.eye(self.rows))
        self._share = np.linspace(0.0, 1.0, frames, dtype=np.float32)[:, None]

    def fit_statistics(self, q: Float[ndarray, "n frames dof"], smooth_noise: bool) -> None:
        """Set scale, mean, and the covariance of the noise, from trajectories [rad]."""
        self.residual_scale.fill_(1.0)
        self.residual_mean.fill_(0.0)
        if self.target == "absolute":
            rows = self.to_rows(q, self.between(q[:, 0], q[:, -1]))
            self.residual_mean.copy_(torch.from_numpy(rows[:, 1:-1].mean((0, 1))))
        rows = self.to_rows(q, self.between(q[:, 0], q[:, -1]))
        scale = np.maximum(np.sqrt((rows[:, 1:-1] ** 2).mean((0, 1))), 1e-4)
        self.residual_scale.copy_(torch.from_numpy(scale))
        self.noise_factor.copy_(torch.from_numpy(noise_factor(rows / scale, smooth_noise)))

    @property
    def _scale(self) -> ndarray:
        return self.residual_scale.numpy()

    def between(self, start: Float[ndarray, "*batch dof"], goal: Float[ndarray, "*batch dof"]) -> Between:
        """Base and held ends of trajectories from start to goal [rad]."""
        a, b = (self.normalizer.to_unit(np.asarray(q, np.float32))[..., None, :] for q in (start, goal))
        if self.target == "residual":
            base = self.parametrization.to_rows(a + (b - a) * self._share)
            return Between(base, np.zeros((*base.shape[:-2], 2, self.dof), np.float32))
        mean = self.residual_mean.numpy()
        base = np.broadcast_to(mean, (*a.shape[:-2], self.rows, self.dof))
        return Between(base, (np.concatenate([a, b], axis=-2) - mean) / self._scale)

    def to_rows(
        self, q: Float[ndarray, "*batch frames dof"], between: Between
    ) -> Float[ndarray, "*batch rows dof"]:
        """Rows of trajectories [rad], their ends those of `between`."""
        unit = self.parametrization.to_rows(self.normalizer.to_unit(q.astype(np.float32, copy=False)))
        return self.hold((unit - between.base) / self._scale, between)

    def joints(
        self, x: Float[ndarray, "*batch rows dof"], between: Between
    ) -> Float[ndarray, "*batch frames dof"]:
        """Joint values of the frames of rows [rad]."""
        return self.normalizer.from_unit(self.parametrization.to_frames(between.base + x * self._scale))

    def at_sites(
        self, x: Float[ndarray, "*batch rows dof"], between: Between
    ) -> Float[ndarray, "*batch rows dof"]:
        """Normalised joint values at one place of the trajectory for each row."""
        return self.parametrization.at_sites(between.base + x * self._scale)

    def hold(
        self, x: Float[ndarray, "*batch rows dof"], between: Between
    ) -> Float[ndarray, "*batch rows dof"]:
        """Write start and goal over the ends (noise interpolation), in place."""
        x[..., 0, :] = between.ends[..., 0, :]
        x[..., -1, :] = between.ends[..., 1, :]
        return x

    def draw_noise(self, count: int, rng: np.random.Generator) -> Float[ndarray, "count rows dof"]:
        """Standard noise of the forward process; zero at both ends."""
        return self.noise_factor.numpy() @ rng.standard_normal((count, self.rows, self.dof), dtype=np.float32)

    def joints_at(
        self, x: Float[Tensor, "n rows dof"], base: Float[Tensor, "n rows dof"], frames: list[int]
    ) -> Float[Tensor, "n {len(frames)} dof"]:
        """Joint values [rad] of some of the frames, differentiable in the rows."""
        evaluate = torch.from_numpy(self.parametrization.evaluate[frames]).to(x.device)
        unit = evaluate @ (base + x * self.residual_scale)
        middle, half_range = (
            torch.from_numpy(a).to(x.device) for a in (self.normalizer.middle, self.normalizer.half_range)
        )
        return unit * half_range + middle
