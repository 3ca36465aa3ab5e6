"""The cubics of a trajectory, which controllers execute between its rows, and their extremes in closed form.

With the mean velocity m of a step of h seconds, and b and e by which the velocities at its ends exceed m, the
velocity at the share u of the step is m + (1 - u)(1 - 3u) b - u (2 - 3u) e. Its derivative, the acceleration,
is linear in time.
"""

from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from robotdiffuse.core.types import Trajectory


class CubicStates(NamedTuple):
    """Positions, velocities and accelerations on the cubics."""

    positions: Float[ndarray, "n dof"]
    velocities: Float[ndarray, "n dof"]
    accelerations: Float[ndarray, "n dof"]


class Cubics:
    """The cubics through the positions and velocities of a trajectory, from each of its rows to the next."""

    def __init__(self, trajectory: Trajectory) -> None:
        q, v = trajectory.positions, trajectory.velocities
        self.trajectory = trajectory
        self.steps: Float[ndarray, "m 1"] = np.diff(trajectory.times)[:, None]
        self.mean: Float[ndarray, "m dof"] = (q[1:] - q[:-1]) / self.steps
        self.first: Float[ndarray, "m dof"] = v[:-1] - self.mean
        """Velocity at the start of each step, less the mean velocity."""
        self.last: Float[ndarray, "m dof"] = v[1:] - self.mean
        """The same at the end of each step."""

    @cached_property
    def accelerations(self) -> tuple[Float[ndarray, "m dof"], Float[ndarray, "m dof"]]:
        """Accelerations at the start and at the end of each step, between which they are linear."""
        start = -(4 * self.first + 2 * self.last) / self.steps
        end = (2 * self.first + 4 * self.last) / self.steps
        return start, end

    @cached_property
    def peak_accelerations(self) -> Float[ndarray, "m dof"]:
        """The largest absolute acceleration of each step."""
        start, end = self.accelerations
        return np.maximum(np.abs(start), np.abs(end))

    @property
    def peak_velocities(self) -> Float[ndarray, "m dof"]:
        """The largest absolute velocity of each step, at an end or where the acceleration is 0."""
        v = self.trajectory.velocities
        start, end = self.accelerations
        ends = np.maximum(np.abs(v[:-1]), np.abs(v[1:]))
        share = np.divide(start, start - end, out=np.zeros_like(start), where=start * end < 0)
        return np.maximum(ends, np.abs(v[:-1] + self.steps * start * share / 2))

    @property
    def peak_jerks(self) -> Float[ndarray, "dof"]:
        """The largest jerk of each joint within the steps."""
        start, end = self.accelerations
        return (np.abs(end - start) / self.steps).max(axis=0, initial=0.0)

    @cached_property
    def chords(self) -> Float[ndarray, "m dof"]:
        """Upper bound on how far each cubic leaves the straight line between its rows [rad] or [m]."""
        return self.peak_accelerations * self.steps**2 / 8

    def states(self, step: Int[ndarray, "n"], share: Float[ndarray, "n"]) -> CubicStates:
        """States at shares of steps."""
        u, h = share[:, None], self.steps[step]
        mean, first, last = self.mean[step], self.first[step], self.last[step]
        start, end = (side[step] for side in self.accelerations)
        off = h * (u * (1 - u) ** 2 * first - u**2 * (1 - u) * last)
        return CubicStates(
            self.trajectory.positions[step] + u * h * mean + off,
            mean + (1 - u) * (1 - 3 * u) * first - u * (2 - 3 * u) * last,
            (1 - u) * start + u * end,
        )

    def turns(
        self, among: Bool[ndarray, "m dof"]
    ) -> tuple[Float[ndarray, "k"], Float[ndarray, "k dof"]]:
        """Times within the marked steps at which the marked joints are at rest, where their positions are
        extreme, and the positions of all joints there."""
        step, j = np.nonzero(among)
        b, e, v = self.first[step, j], self.last[step, j], self.trajectory.velocities[step, j]
        # the roots of v - 2 half u + curve u², of which each form gives one accurately
        half, curve = 2 * b + e, 3 * (b + e)
        root = np.sqrt(np.maximum(half**2 - curve * v, 0.0))
        far = half + np.copysign(root, half)
        with np.errstate(divide="ignore", invalid="ignore"):
            shares = np.concatenate([v / far, far / curve])
        steps = np.tile(step, 2)
        inside = (shares > 0) & (shares < 1)
        steps, shares = steps[inside], shares[inside]
        order = np.argsort(steps + shares)
        steps, shares = steps[order], shares[order]
        times = self.trajectory.times[steps] + shares * self.steps[steps, 0]
        return times, self.states(steps, shares).positions

    def sampled(
        self, chord: float
    ) -> tuple[Float[ndarray, "n"], Float[ndarray, "n dof"], Float[ndarray, "dof"]]:
        """Times and positions of the rows and of added rows on the cubics, such that straight lines between
        them leave the cubics by at most `chord`; and by how much they do, for each joint [rad] or [m]."""
        times, q = self.trajectory.times, self.trajectory.positions
        counts = np.ceil(np.sqrt(self.chords.max(axis=1, initial=0.0) / chord)).astype(int)
        if (counts <= 1).all():
            return times, q, self.chords.max(axis=0, initial=0.0)
        counts = np.maximum(counts, 1)
        step = np.repeat(np.arange(len(counts)), counts)
        share = np.concatenate([np.arange(n) / n for n in counts])
        between = self.states(step, share).positions
        off = (self.chords / counts[:, None] ** 2).max(axis=0)
        at = times[step] + share * self.steps[step, 0]
        return np.append(at, times[-1]), np.concatenate([between, q[-1:]]), off
