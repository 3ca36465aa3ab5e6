"""The numbers that are diffused: the waypoints of a trajectory, normalised, relative to a reference, scaled.

With the targets `residual` and `absolute`, x is in units of the training data's standard deviation and
relative to the straight line from start to goal (residual), or to the mean of the data (absolute, the
paper's). With the target `limits`, x is the joint values in units of their limits, the noise is white, and
nothing is taken from the data, as in MPD and EDMP. The first and the last waypoint are start and goal: they
are written over the ends of x at every step (the paper's noise interpolation).
"""

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from torch import Tensor, nn

from robotdiffuse.core.errors import unknown_name
from robotdiffuse.learning.diffusion import noise_factor, white_noise_factor
from robotdiffuse.robots.normalizer import JointNormalizer

TARGETS = ("residual", "absolute", "limits")


class Reference(NamedTuple):
    """The trajectory that x is relative to, and the ends of x that stay fixed."""

    base: Float[ndarray, "*batch waypoints dof"]
    """Normalised joint values; the trajectory is `base + scale * x`."""
    start: Float[ndarray, "*batch 1 dof"]
    """The first waypoint of x."""
    goal: Float[ndarray, "*batch 1 dof"]
    """The last waypoint of x."""


class TrajectoryRepresentation(nn.Module):
    """Converts between joint values and x, and holds the statistics of the data that this takes."""

    residual_scale: Tensor
    residual_mean: Tensor
    noise_factor: Tensor

    def __init__(self, normalizer: JointNormalizer, target: str, waypoints: int) -> None:
        super().__init__()
        if target not in TARGETS:
            raise unknown_name("target", target, TARGETS)
        self.normalizer, self.target, self.waypoints = normalizer, target, waypoints
        self.dof = len(normalizer.middle)
        fitted = target != "limits"
        self.register_buffer("residual_scale", torch.ones(self.dof), persistent=fitted)
        self.register_buffer("residual_mean", torch.zeros(self.dof), persistent=target == "absolute")
        white = torch.from_numpy(white_noise_factor(waypoints).astype(np.float32))
        self.register_buffer("noise_factor", white, persistent=fitted)
        self._fractions = np.linspace(0.0, 1.0, waypoints, dtype=np.float32)[:, None]

    def fit_statistics(self, q: Float[ndarray, "n waypoints dof"], smooth_noise: bool) -> None:
        """Set scale, mean and covariance of the noise from trajectories [rad].

        The target `limits` has no such statistics: nothing happens.
        """
        if self.target == "limits":
            return
        self.residual_scale.fill_(1.0)
        self.residual_mean.fill_(0.0)
        if self.target == "absolute":
            x = self.normalize(q, self.reference(q[:, 0], q[:, -1]))
            self.residual_mean.copy_(torch.from_numpy(x[:, 1:-1].mean((0, 1))))
        x = self.normalize(q, self.reference(q[:, 0], q[:, -1]))
        scale = np.maximum(np.sqrt((x[:, 1:-1] ** 2).mean((0, 1))), 1e-4)
        self.residual_scale.copy_(torch.from_numpy(scale))
        self.noise_factor.copy_(torch.from_numpy(noise_factor(x / scale, smooth_noise)))

    @property
    def is_unit_joints(self) -> bool:
        """Whether x is the normalised joint values themselves."""
        return self.target == "limits"

    def clipped(self, x: Float[ndarray, "*batch waypoints dof"]) -> Float[ndarray, "*batch waypoints dof"]:
        """A predicted x within the joint limits where x is in units of them; other targets: x as it is."""
        return np.clip(x, -1.0, 1.0) if self.is_unit_joints else x

    @property
    def _scale(self) -> ndarray:
        return self.residual_scale.numpy()

    def reference(self, start: Float[ndarray, "*batch dof"], goal: Float[ndarray, "*batch dof"]) -> Reference:
        """The reference of trajectories from start to goal [rad]."""
        a, b = (self.normalizer.to_unit(np.asarray(q, np.float32))[..., None, :] for q in (start, goal))
        if self.target == "residual":
            base = a + (b - a) * self._fractions
            zero = np.zeros((*base.shape[:-2], 1, self.dof), np.float32)
            return Reference(base, zero, zero)
        mean = self.residual_mean.numpy()
        base = np.broadcast_to(mean, (*a.shape[:-2], self.waypoints, self.dof))
        return Reference(base, (a - mean) / self._scale, (b - mean) / self._scale)

    def normalize(
        self, q: Float[ndarray, "*batch waypoints dof"], reference: Reference
    ) -> Float[ndarray, "*batch waypoints dof"]:
        """x of trajectories [rad]; its ends are those of the reference."""
        unit = self.normalizer.to_unit(q.astype(np.float32, copy=False))
        return self.hold_ends((unit - reference.base) / self._scale, reference)

    def joints(
        self, x: Float[ndarray, "*batch waypoints dof"], reference: Reference
    ) -> Float[ndarray, "*batch waypoints dof"]:
        """Joint values of x [rad]."""
        return self.normalizer.from_unit(self.unit_joints(x, reference))

    def unit_joints(
        self, x: Float[ndarray, "*batch waypoints dof"], reference: Reference
    ) -> Float[ndarray, "*batch waypoints dof"]:
        """Joint values of x in units of their limits."""
        return reference.base + x * self._scale

    def hold_ends(
        self, x: Float[ndarray, "*batch waypoints dof"], reference: Reference
    ) -> Float[ndarray, "*batch waypoints dof"]:
        """Write start and goal over the ends of x, in place (noise interpolation). Returns x."""
        x[..., :1, :], x[..., -1:, :] = reference.start, reference.goal
        return x

    def draw_noise(self, count: int, rng: np.random.Generator) -> Float[ndarray, "count waypoints dof"]:
        """Standard noise of the forward process; zero at both ends."""
        white = rng.standard_normal((count, self.waypoints, self.dof), dtype=np.float32)
        return self.noise_factor.numpy() @ white

    def joints_at(
        self,
        x: Float[Tensor, "n waypoints dof"],
        base: Float[Tensor, "n waypoints dof"],
        at: list[int],
    ) -> Float[Tensor, "n {len(at)} dof"]:
        """Joint values [rad] of the waypoints with these indices, differentiable in x."""
        return self.normalizer.from_unit(base[:, at] + x[:, at] * self.residual_scale)
