"""Trajectories as the rows of numbers that are diffused: normalised, relative to a base, scaled.

A trajectory is rows x of a parametrization (waypoints or spline control points), in units of the training
data's standard deviation, relative to a base: the straight line from start to goal (target `residual`), or
the mean of the data (target `absolute`, the paper's). Or rows are joint values in units of their limits, with
white noise, and nothing is taken from the data (target `limits`, as in MPD and EDMP). The first and the last
row are start and goal and are held: the paper's noise interpolation, which writes them over the ends at every
step. More waypoints at either end may be held, its prefix and suffix waypoints.
"""

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from torch import Tensor, nn

from robotdiffuse.core.errors import InputError, unknown_name
from robotdiffuse.learning.diffusion import noise_factor, white_factor
from robotdiffuse.learning.parametrization import Parametrization
from robotdiffuse.robots.normalizer import JointNormalizer

TARGETS = ("residual", "absolute", "limits")


class Between(NamedTuple):
    """What rows between a start and a goal are relative to."""

    base: Float[ndarray, "*batch rows dof"]
    """Normalised joint values that x, times its scale, is added to."""
    prefix: Float[ndarray, "*batch k dof"]
    """The first rows of x, which are held: one, the start, unless more is known."""
    suffix: Float[ndarray, "*batch m dof"]
    """The last rows of x."""


class TrajectoryRows(nn.Module):
    """The two directions between joint values and rows, with the statistics that they need."""

    residual_scale: Tensor
    residual_mean: Tensor
    noise_factor: Tensor

    def __init__(
        self, normalizer: JointNormalizer, parametrization: Parametrization, target: str, waypoints: int
    ) -> None:
        super().__init__()
        if target not in TARGETS:
            raise unknown_name("target", target, TARGETS)
        self.normalizer, self.parametrization, self.target = normalizer, parametrization, target
        self.dof, self.rows = len(normalizer.middle), parametrization.rows
        fitted = target != "limits"
        self.register_buffer("residual_scale", torch.ones(self.dof), persistent=fitted)
        self.register_buffer("residual_mean", torch.zeros(self.dof), persistent=target == "absolute")
        white = torch.from_numpy(white_factor(self.rows).astype(np.float32))
        self.register_buffer("noise_factor", white, persistent=fitted)
        self._share = np.linspace(0.0, 1.0, waypoints, dtype=np.float32)[:, None]

    def fit_statistics(self, q: Float[ndarray, "n waypoints dof"], smooth_noise: bool) -> None:
        """Set scale, mean, and the covariance of the noise, from trajectories [rad]; none of them for the
        target `limits`."""
        if self.target == "limits":
            return
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
    def plain(self) -> bool:
        """Rows are the normalised joint values of the waypoints."""
        return self.target == "limits" and self.parametrization.themselves

    def within(self, x: Float[ndarray, "*batch rows dof"]) -> Float[ndarray, "*batch rows dof"]:
        """Predicted rows; where rows are in units of the limits, none beyond them, for the data have none."""
        return np.clip(x, -1.0, 1.0) if self.target == "limits" else x

    @property
    def _scale(self) -> ndarray:
        return self.residual_scale.numpy()

    def between(self, start: Float[ndarray, "*batch dof"], goal: Float[ndarray, "*batch dof"]) -> Between:
        """Base and held ends of trajectories from start to goal [rad]."""
        a, b = (self.normalizer.to_unit(np.asarray(q, np.float32))[..., None, :] for q in (start, goal))
        if self.target == "residual":
            base = self.parametrization.to_rows(a + (b - a) * self._share)
            zero = np.zeros((*base.shape[:-2], 1, self.dof), np.float32)
            return Between(base, zero, zero)
        mean = self.residual_mean.numpy()
        base = np.broadcast_to(mean, (*a.shape[:-2], self.rows, self.dof))
        return Between(base, (a - mean) / self._scale, (b - mean) / self._scale)

    def around(self, prefix: Float[ndarray, "k dof"], suffix: Float[ndarray, "m dof"]) -> Between:
        """Base and held rows, a batch of one, of trajectories whose first and last waypoints are known [rad].

        Raises InputError where more than start and goal are known but rows are not waypoints, or none is
        left.
        """
        k, m = len(prefix), len(suffix)
        if k + m > 2 and not self.parametrization.themselves:
            raise InputError(
                f"prefix and suffix have {k} and {m} waypoints; control points can hold 1 and 1 only"
            )
        if k + m >= self.rows:
            raise InputError(
                f"prefix and suffix have {k} and {m} waypoints; they must leave some of {self.rows} unknown"
            )
        ends = self.between(prefix[None, 0], suffix[None, -1])
        first, last = (self.normalizer.to_unit(q[None].astype(np.float32)) for q in (prefix[1:], suffix[:-1]))
        first = (first - ends.base[:, 1:k]) / self._scale
        last = (last - ends.base[:, self.rows - m : -1]) / self._scale
        return Between(
            ends.base,
            np.concatenate([ends.prefix, first], axis=1),
            np.concatenate([last, ends.suffix], axis=1),
        )

    def to_rows(
        self, q: Float[ndarray, "*batch waypoints dof"], between: Between
    ) -> Float[ndarray, "*batch rows dof"]:
        """Rows of trajectories [rad], their ends those of `between`."""
        unit = self.parametrization.to_rows(self.normalizer.to_unit(q.astype(np.float32, copy=False)))
        return self.hold((unit - between.base) / self._scale, between)

    def joints(
        self, x: Float[ndarray, "*batch rows dof"], between: Between
    ) -> Float[ndarray, "*batch waypoints dof"]:
        """Joint values of the waypoints of rows [rad]."""
        return self.normalizer.from_unit(self.parametrization.to_waypoints(between.base + x * self._scale))

    def at_sites(
        self, x: Float[ndarray, "*batch rows dof"], between: Between
    ) -> Float[ndarray, "*batch rows dof"]:
        """Normalised joint values at one place of the trajectory for each row."""
        return self.parametrization.at_sites(between.base + x * self._scale)

    def hold(
        self, x: Float[ndarray, "*batch rows dof"], between: Between
    ) -> Float[ndarray, "*batch rows dof"]:
        """Write the known rows, start and goal, over the ends (noise interpolation), in place."""
        x[..., : between.prefix.shape[-2], :] = between.prefix
        x[..., self.rows - between.suffix.shape[-2] :, :] = between.suffix
        return x

    def regression(self, between: Between, reach: float = np.inf) -> Float[ndarray, "rows rows"] | None:
        """G by which known rows move the expectation of all: x + G (known - x); None for the ends alone.

        It is cov(x, known) cov(known)^-1 for the covariance of the noise. Where that is smooth, the data's,
        x changes as trajectories do that pass through the known rows; white noise moves no other row. With a
        reach, the covariance falls off by exp(-distance / reach) over the rows, so that what is known of some
        changes little but those that are near.
        """
        known = np.r_[1 : between.prefix.shape[-2], self.rows - between.suffix.shape[-2] : self.rows - 1]
        if not len(known):
            return None
        factor = self.noise_factor.numpy().astype(np.float64)
        apart = np.abs(np.subtract.outer(np.arange(self.rows), np.arange(self.rows)))
        covariance = factor @ factor.T * np.exp(-apart / reach)
        matrix = np.zeros((self.rows, self.rows))
        matrix[:, known] = np.linalg.solve(covariance[np.ix_(known, known)], covariance[known]).T
        return matrix.astype(np.float32)

    def draw_noise(self, count: int, rng: np.random.Generator) -> Float[ndarray, "count rows dof"]:
        """Standard noise of the forward process; zero at both ends."""
        return self.noise_factor.numpy() @ rng.standard_normal((count, self.rows, self.dof), dtype=np.float32)

    def joints_at(
        self, x: Float[Tensor, "n rows dof"], base: Float[Tensor, "n rows dof"], waypoints: list[int]
    ) -> Float[Tensor, "n {len(waypoints)} dof"]:
        """Joint values [rad] of some of the waypoints, differentiable in the rows."""
        evaluate = torch.from_numpy(self.parametrization.evaluate[waypoints]).to(x.device)
        return self.normalizer.from_unit(evaluate @ (base + x * self.residual_scale))
