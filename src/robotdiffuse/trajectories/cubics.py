"""The cubics by which controllers interpolate between rows of a trajectory, and their extremes in closed
form.

A step leads from one row to the next. In a step of h seconds from the velocity v to the velocity w, with the
mean velocity m, the acceleration is linear in time: from (6 m - 4 v - 2 w) / h to (2 v + 4 w - 6 m) / h.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from robotdiffuse.core.kernels import inner_kernel, kernel
from robotdiffuse.core.types import (
    Configuration,
    Configurations,
    JointRows,
    JointValues,
    Trajectory,
    Values,
    for_kernels,
)


class Extremes(NamedTuple):
    """Extremes of the cubics of a motion."""

    mean: JointRows
    """Mean velocity of each step."""
    start: JointRows
    """Acceleration at the start of each step."""
    end: JointRows
    """Acceleration at the end of each step."""
    velocity: JointRows
    """The largest absolute velocity in each step."""
    acceleration: JointRows
    """The largest absolute acceleration in each step."""
    jerk: JointValues
    """The largest absolute jerk within any step."""
    chord: Values
    """For each step, an upper bound on how far the cubic leaves the straight line between its two rows, for
    the joint with the largest bound [rad] or [m]."""
    chords: JointValues
    """For each joint, a bound over all steps on how far the cubics leave these straight lines."""
    lower: Configuration
    """The least position of each joint."""
    upper: Configuration


class Cubics:
    """The cubics through the positions and velocities of a trajectory, from each of its rows to the next."""

    def __init__(self, trajectory: Trajectory) -> None:
        self.trajectory = trajectory
        self.steps: Float[ndarray, "m 1"] = np.diff(trajectory.times)[:, None]
        rows = trajectory.times, trajectory.positions, trajectory.velocities
        self.extremes = Extremes(*_extremes(*map(for_kernels, rows)))

    def states(self, step: Int[ndarray, "n"], share: Values) -> tuple[Configurations, JointRows, JointRows]:
        """Positions, velocities and accelerations within steps; `share`, from 0 to 1, is the fraction of the
        step's duration that has passed."""
        u = share[:, None]
        h = self.steps[step]
        start = self.extremes.start[step]
        end = self.extremes.end[step]
        q = self.trajectory.positions[step]
        v = self.trajectory.velocities[step]
        jerk = end - start
        return (
            q + u * h * (v + u * h * (start / 2 + u * jerk / 6)),
            v + u * h * (start + u * jerk / 2),
            start + u * jerk,
        )

    def turns(self) -> tuple[Values, Configurations]:
        """Times [s] at which a joint reverses its direction, so that its position is extreme,
        and the positions of all joints at these times."""
        if not len(self.steps):
            return self.trajectory.times[:0], self.trajectory.positions[:0]
        from scipy.interpolate import CubicHermiteSpline  # slow to import, rarely needed

        rows = self.trajectory
        motion = CubicHermiteSpline(rows.times, rows.positions, rows.velocities)
        roots = np.concatenate(motion.derivative().roots(discontinuity=False, extrapolate=False))
        times = np.unique(roots[np.isfinite(roots)])  # where a joint rests, a root is NaN
        return times, motion(times)

    def sampled(self, chord: float) -> tuple[Values, Configurations, JointValues]:
        """Times and positions of samples of the cubics, between which straight lines differ from the cubics
        by at most `chord` in each joint [rad] or [m]; and a bound of this difference for each joint.

        The samples are all rows and, where they are needed, equally spaced ones between them.
        """
        times = self.trajectory.times
        q = self.trajectory.positions
        step_bounds = self.extremes.chord
        joint_bounds = self.extremes.chords
        if step_bounds.max(initial=0.0) <= chord:
            return times, q, joint_bounds
        # if a step is divided, its bound falls with the square of the number of parts
        counts = np.ceil(np.sqrt(step_bounds / chord)).astype(int)
        counts = np.maximum(counts, 1)
        step = np.repeat(np.arange(len(counts)), counts)
        share = np.concatenate([np.arange(n) / n for n in counts])
        between = self.states(step, share)[0]
        acceleration = self.extremes.acceleration
        joint_bounds = (acceleration * (self.steps / counts[:, None]) ** 2 / 8).max(axis=0)
        at = times[step] + share * self.steps[step, 0]
        return np.append(at, times[-1]), np.concatenate([between, q[-1:]]), joint_bounds


@kernel(error_model="numpy")
def _extremes(times, q, v):
    """The fields of `Extremes`."""
    rows, dof = q.shape
    shape = rows - 1, dof
    mean = np.empty(shape)
    start = np.empty(shape)
    end = np.empty(shape)
    velocity = np.empty(shape)
    acceleration = np.empty(shape)
    jerk = np.zeros(dof)
    chord = np.zeros(rows - 1)
    chords = np.zeros(dof)
    lower = q[0].copy()
    upper = q[0].copy()
    for i in range(rows - 1):
        h = times[i + 1] - times[i]
        inverse_h = 1 / h
        for j in range(dof):
            speed = v[i, j]
            m = (q[i + 1, j] - q[i, j]) * inverse_h
            a = (6 * m - 4 * speed - 2 * v[i + 1, j]) * inverse_h
            b = (2 * speed + 4 * v[i + 1, j] - 6 * m) * inverse_h
            peak_speed = max(abs(speed), abs(v[i + 1, j]))
            if a * b < 0:  # the speed is also extreme where the acceleration is 0
                peak_speed = max(peak_speed, abs(speed + h * a * a / (2 * (a - b))))
            mean[i, j] = m
            start[i, j] = a
            end[i, j] = b
            velocity[i, j], acceleration[i, j] = peak_speed, max(abs(a), abs(b))
            jerk[j] = max(jerk[j], abs(b - a) * inverse_h)
            bend = acceleration[i, j] * h * h / 8  # bound of the distance to the straight line
            chord[i], chords[j] = max(chord[i], bend), max(chords[j], bend)
            low = min(q[i, j], q[i + 1, j])
            high = max(q[i, j], q[i + 1, j])
            # the exact range is needed only if it may exceed `lower` to `upper`
            if low - bend < lower[j] or high + bend > upper[j]:
                low, high = _range(q[i, j], speed, a, b, h, low, high)
                lower[j], upper[j] = min(lower[j], low), max(upper[j], high)
    return mean, start, end, velocity, acceleration, jerk, chord, chords, lower, upper


@inner_kernel()
def _range(q, v, a, b, h, low, high):
    """The least and the greatest position of a cubic of h seconds with the position q and velocity v at its
    start, and accelerations a at its start and b at its end.

    low, high: the smaller and the larger position of its two ends. Inside, extremes are where the velocity
    v + h (a u + (b - a) u² / 2) is 0, with u from 0 to 1.
    """
    square = a * a - 2 * (b - a) * v / h
    if square < 0:
        return low, high
    numerator = -a - np.copysign(np.sqrt(square), a)
    # both roots of the quadratic, without cancellation
    for u in (2 * v / (h * numerator), numerator / (b - a)):
        if 0 < u < 1:
            at = q + u * h * (v + u * h * (a / 2 + u * (b - a) / 6))
            low = min(low, at)
            high = max(high, at)
    return low, high
