"""The numbers that are diffused: the waypoints of a trajectory, normalised, relative to a reference, scaled.

With the targets `residual` and `absolute`, x is in units of the training data's standard deviation and
relative to the straight line from start to goal (residual), or to the mean of the data (absolute, the
paper's). With the target `limits`, x is the joint values in units of their limits, the noise is white, and
nothing is taken from the data, as in MPD and EDMP. The first and the last waypoint are start and goal: they
are written over the ends of x at every step (the paper's noise interpolation).
"""

from abc import ABC, abstractmethod
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.core.errors import unknown_name
from robotdiffuse.learning.diffusion import white_noise_factor
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


class Statistics(NamedTuple):
    """What a representation takes from the training data; float32."""

    residual_scale: Float[ndarray, "dof"]
    """Standard deviation of the trajectories about their reference, in units of the joint limits."""
    residual_mean: Float[ndarray, "dof"]
    """Their mean, for the target `absolute`; else zero."""
    noise_factor: Float[ndarray, "waypoints waypoints"]
    """The matrix that makes noise of white noise, see `diffusion.noise_factor`."""

    @staticmethod
    def without_data(waypoints: int, dof: int) -> "Statistics":
        """Those of the target `limits`, and of the others before training."""
        white = white_noise_factor(waypoints).astype(np.float32)
        return Statistics(np.ones(dof, np.float32), np.zeros(dof, np.float32), white)


class TrajectoryRepresentation(ABC):
    """Converts between joint values and x."""

    def __init__(self, normalizer: JointNormalizer, target: str, waypoints: int) -> None:
        if target not in TARGETS:
            raise unknown_name("target", target, TARGETS)
        self.normalizer, self.target, self.waypoints = normalizer, target, waypoints
        self.dof = len(normalizer.middle)
        self._fractions = np.linspace(0.0, 1.0, waypoints, dtype=np.float32)[:, None]

    @property
    @abstractmethod
    def statistics(self) -> Statistics:
        """The statistics of the training data."""

    @property
    def is_unit_joints(self) -> bool:
        """Whether x is the normalised joint values themselves."""
        return self.target == "limits"

    def clipped(self, x: Float[ndarray, "*batch waypoints dof"]) -> Float[ndarray, "*batch waypoints dof"]:
        """A predicted x within the joint limits where x is in units of them; other targets: x as it is."""
        return np.clip(x, -1.0, 1.0) if self.is_unit_joints else x

    def reference(self, start: Float[ndarray, "*batch dof"], goal: Float[ndarray, "*batch dof"]) -> Reference:
        """The reference of trajectories from start to goal [rad]."""
        a, b = (self.normalizer.to_unit(np.asarray(q, np.float32))[..., None, :] for q in (start, goal))
        if self.target == "residual":
            base = a + (b - a) * self._fractions
            zero = np.zeros((*base.shape[:-2], 1, self.dof), np.float32)
            return Reference(base, zero, zero)
        scale, mean = self.statistics[:2]
        base = np.broadcast_to(mean, (*a.shape[:-2], self.waypoints, self.dof))
        return Reference(base, (a - mean) / scale, (b - mean) / scale)

    def normalize(
        self, q: Float[ndarray, "*batch waypoints dof"], reference: Reference
    ) -> Float[ndarray, "*batch waypoints dof"]:
        """x of trajectories [rad]; its ends are those of the reference."""
        unit = self.normalizer.to_unit(q.astype(np.float32, copy=False))
        return self.hold_ends((unit - reference.base) / self.statistics.residual_scale, reference)

    def joints(
        self, x: Float[ndarray, "*batch waypoints dof"], reference: Reference
    ) -> Float[ndarray, "*batch waypoints dof"]:
        """Joint values of x [rad]."""
        return self.normalizer.from_unit(self.unit_joints(x, reference))

    def unit_joints(
        self, x: Float[ndarray, "*batch waypoints dof"], reference: Reference
    ) -> Float[ndarray, "*batch waypoints dof"]:
        """Joint values of x in units of their limits."""
        return reference.base + x * self.statistics.residual_scale

    def hold_ends(
        self, x: Float[ndarray, "*batch waypoints dof"], reference: Reference
    ) -> Float[ndarray, "*batch waypoints dof"]:
        """Write start and goal over the ends of x, in place (noise interpolation). Returns x."""
        x[..., :1, :], x[..., -1:, :] = reference.start, reference.goal
        return x

    def draw_noise(self, count: int, rng: np.random.Generator) -> Float[ndarray, "count waypoints dof"]:
        """Standard noise of the forward process; zero at both ends."""
        white = rng.standard_normal((count, self.waypoints, self.dof), dtype=np.float32)
        return self.statistics.noise_factor @ white
