"""The checker's own cubics through the positions and velocities of a trajectory."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from robotdiffuse.core.types import Path, Trajectory


class Cubics(NamedTuple):
    """The cubics from each row to the next; their accelerations are linear in time."""

    times: Float[ndarray, "m"]
    """When each begins [s]."""
    steps: Float[ndarray, "m 1"]
    """Their durations [s]."""
    positions: Float[ndarray, "m dof"]
    """At the start of each."""
    velocities: Float[ndarray, "m dof"]
    start: Float[ndarray, "m dof"]
    """Acceleration at the start of each."""
    end: Float[ndarray, "m dof"]

    def at(
        self, row: Int[ndarray, "n"], time: Float[ndarray, "n"]
    ) -> tuple[Float[ndarray, "n dof"], Float[ndarray, "n dof"], Float[ndarray, "n dof"]]:
        """Positions, velocities and accelerations of cubics `time` seconds after they begin."""
        t, a = time[:, None], self.start[row]
        jerk = (self.end[row] - a) / self.steps[row]
        v, q = self.velocities[row], self.positions[row]
        return (
            q + t * (v + t * (a / 2 + t * jerk / 6)),
            v + t * (a + t * jerk / 2),
            a + t * jerk,
        )

    def rows(self, times: Float[ndarray, "n"]) -> Int[ndarray, "n"]:
        """The cubic at each time; at a row, the one that begins there."""
        return np.clip(np.searchsorted(self.times, times, side="right") - 1, 0, len(self.times) - 1)

    def positions_at(self, times: Float[ndarray, "n"]) -> Float[ndarray, "n dof"]:
        rows = self.rows(times)
        return self.at(rows, times - self.times[rows])[0]

    @property
    def pulls(self) -> Float[ndarray, "m dof"]:
        """The greatest absolute acceleration of each."""
        return np.maximum(np.abs(self.start), np.abs(self.end))

    @property
    def speeds(self) -> Float[ndarray, "m dof"]:
        """The greatest absolute velocity of each, which is at an end or where the acceleration is 0."""
        curve = self.end - self.start
        share = np.clip(np.divide(-self.start, curve, out=np.zeros_like(curve), where=curve != 0), 0.0, 1.0)
        inner = self.velocities + self.steps * share * (self.start + share * curve / 2)
        last = self.velocities + self.steps * (self.start + self.end) / 2
        return np.maximum(np.abs(inner), np.maximum(np.abs(self.velocities), np.abs(last)))

    @property
    def turns(self) -> Float[ndarray, "n dof"]:
        """Positions of each joint where a cubic has its extremes, or elsewhere on it if it has none."""
        v, curve = self.velocities / self.steps, self.end - self.start
        root = np.sqrt(np.maximum(self.start**2 - 2 * curve * v, 0.0))
        far = -self.start - np.where(self.start < 0, -root, root)
        shares = [
            np.divide(above, below, out=np.zeros_like(above), where=below != 0)
            for above, below in ((2 * v, far), (far, curve))
        ]
        turns = []
        for share in np.clip(shares, 0.0, 1.0):
            t = share * self.steps
            turns.append(self.positions + t * (self.velocities + t * (self.start / 2 + share * curve / 6)))
        return np.concatenate(turns)

    def deviations(self, times: Float[ndarray, "n"]) -> Float[ndarray, "n1 dof"]:
        """Upper bounds on how far each joint leaves the straight lines between its positions at these times,
        among which are those of all rows: an eighth of its greatest acceleration times the square of the
        time."""
        row, most = self.rows(times[:-1]), 0.0
        for end in (times[:-1], times[1:]):
            most = np.maximum(most, np.abs(self.at(row, end - self.times[row])[2]))
        return most * np.diff(times)[:, None] ** 2 / 8

    def jumps(self) -> Float[ndarray, "n dof"]:
        """By how much the acceleration jumps at each row; before and after the motion it is 0."""
        none = np.zeros_like(self.start[:1])
        return np.abs(np.concatenate([self.start, none]) - np.concatenate([none, self.end]))


def cubics_of(motion: Path | Trajectory) -> Cubics | None:
    """The cubics of a trajectory whose times increase; None for a path or a single row."""
    if not isinstance(motion, Trajectory) or len(motion.times) < 2:
        return None
    steps, q, v = np.diff(motion.times)[:, None], motion.positions, motion.velocities
    mean = (q[1:] - q[:-1]) / steps
    start, end = (6 * mean - 4 * v[:-1] - 2 * v[1:]) / steps, (2 * v[:-1] + 4 * v[1:] - 6 * mean) / steps
    return Cubics(motion.times[:-1], steps, q[:-1], v[:-1], start, end)
