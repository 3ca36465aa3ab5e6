"""Stops along a path and the timed motions between them, forwards and back: for timings that wait or
retreat."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from robotdiffuse.core.types import Path, Trajectory
from robotdiffuse.robots.robot import Robot
from robotdiffuse.trajectories.corner_rounding import BlendedPolyline, half_widths
from robotdiffuse.trajectories.speed_limits import (
    NO_EXTRA_LIMITS,
    ExtraLimits,
    Rows,
    TimingSettings,
    time_line,
)
from robotdiffuse.trajectories.timing import rounded_corners

PATH_PARTS = 8
"""Number of parts of about equal length between stops; more take longer and gain little."""
SPEED_FACTORS = (1.0, 0.5)
"""Each motion is offered at these shares of its highest speed."""
MIN_DISTANCE = 1e-3
"""Stops closer to each other than this are merged [rad]."""


class Motion(NamedTuple):
    """A timed motion from rest at one stop to rest at another."""

    source: int
    """Index of the stop where it begins."""
    target: int
    ticks: int
    """Its duration in time steps."""
    rows: Rows


class StopGraph:
    """A graph along a path: nodes are stops where the arm may wait, edges are timed motions between them."""

    def __init__(
        self,
        robot: Robot,
        path: Path,
        valid: Callable[[Trajectory], bool],
        free: Callable[[Path], bool],
        settings: TimingSettings,
        step: float,
        keeps: Callable[[ndarray], bool] = lambda _: True,
        extra: ExtraLimits = NO_EXTRA_LIMITS,
        deviations: Float[ndarray, "n"] | None = None,
        required_stops: Sequence[int] = (),
    ) -> None:
        """Every motion lasts a whole number of time steps `step` [s].

        Corners are rounded as in `time_parameterize`, with its arguments `valid`, `free`, `keeps`, `extra`
        and `deviations`. Every motion ends at the path's rows `required_stops`; none passes through them.
        """
        self.joint_names, self.step, self._extra = path.joint_names, step, extra
        waypoints, rounded = rounded_corners(
            robot, path, valid, free, settings, keeps, extra, deviations, required_stops
        )
        self.line = BlendedPolyline(waypoints, half_widths(waypoints, rounded))
        self.stops = self._find_stops(rounded)
        """Their values of s along the path, in order."""
        self.motions = [
            motion for pair in self._pairs(rounded) for motion in self._between(robot, settings, *pair)
        ]

    def _find_stops(self, deviations: Float[ndarray, "corners"]) -> Float[ndarray, "k"]:
        """Values of s of all stops: none within a rounded corner, and every corner that is not rounded."""
        line, length = self.line, self.line.length
        corners, widths = line.knots[1:-1], line.half_widths
        found = [0.0, *corners[deviations == 0], length]
        for s in np.linspace(0.0, length, PATH_PARTS + 1)[1:-1]:
            within = np.flatnonzero(np.abs(s - corners) < widths)
            for i in within[:1]:
                s = corners[i] + np.copysign(widths[i], s - corners[i])
            if min(abs(s - other) for other in found) > MIN_DISTANCE:
                found.append(float(s))
        return np.sort(np.array(found))

    def _pairs(self, deviations: Float[ndarray, "corners"]) -> list[tuple[int, int]]:
        """Pairs of stops with no required stop, or sharp corner, between them."""
        sharp = self.line.knots[1:-1][deviations == 0]
        s = self.stops
        pairs = [(i, j) for i in range(len(s)) for j in range(i + 1, len(s))]
        return [(i, j) for i, j in pairs if not ((s[i] < sharp) & (sharp < s[j])).any()]

    def _between(self, robot: Robot, settings: TimingSettings, i: int, j: int) -> list[Motion]:
        """The motions from stop i to stop j and back, at each speed factor."""
        line, (low, high) = self.line, self.stops[[i, j]]
        inner = np.flatnonzero((line.knots > low + MIN_DISTANCE) & (line.knots < high - MIN_DISTANCE))
        ends = line(np.array([low, high]), 0)
        part = BlendedPolyline(
            np.concatenate([ends[:1], line.waypoints[inner], ends[1:]]), line.half_widths[inner - 1]
        )
        times, q, v, a = time_line(robot, part, settings, extra=self._extra)
        q = q.copy()
        q[[0, -1]] = ends
        found = []
        for factor in SPEED_FACTORS:
            ticks = max(int(np.ceil(times[-1] / factor / self.step - 1e-9)), 1)
            slower = ticks * self.step / times[-1]
            rows = times * slower, q, v / slower, a / slower**2
            back = rows[0][-1] - rows[0][::-1], q[::-1], -rows[2][::-1], rows[3][::-1]
            found += [Motion(i, j, ticks, rows), Motion(j, i, ticks, back)]
        return found

    def sample(
        self, radii: Float[ndarray, "dof"], travel: float
    ) -> tuple[Float[ndarray, "m"], Float[ndarray, "m dof"]]:
        """Values of s, and the configurations there, between which no point of the arm moves further than
        `travel` [m]. All stops are among them. `radii` as of `motion_radii`."""
        parts = []
        for low, high in zip(self.stops[:-1], self.stops[1:], strict=True):
            fine = self.line(np.linspace(low, high, 33), 0)
            way = float((np.abs(np.diff(fine, axis=0)) @ radii).sum())
            parts.append(np.linspace(low, high, max(int(np.ceil(way / travel)), 1) + 1)[:-1])
        s = np.concatenate([*parts, self.stops[-1:]])
        return s, self.line(s, 0)

    def nearest_samples(
        self, motion: Motion, configurations: Float[ndarray, "m dof"]
    ) -> Int[ndarray, "ticks"]:
        """Index of the nearest of some configurations at each tick of a motion, from its start to its end."""
        times, q = motion.rows[:2]
        ticks = self.step * np.arange(motion.ticks + 1)
        at = np.column_stack([np.interp(ticks, times, column) for column in q.T])
        return ((configurations**2).sum(axis=1) - 2 * at @ configurations.T).argmin(axis=1)

    def trajectory(self, way: list[Motion | int]) -> Trajectory:
        """Motions one after the other; an integer in `way` is a wait of one time step."""
        q = self.line(self.stops[:1], 0)
        a = way[0].rows[3][:1] if way and not isinstance(way[0], int) else 0 * q
        rows = [(np.zeros(1), q, 0 * q, a)]
        for part in way:
            if isinstance(part, int):
                q = rows[-1][1][-1:]
                times, q, v, a = np.array([self.step]), q, 0 * q, 0 * q
            else:
                times, q, v, a = (column[1:] for column in part.rows)
            rows.append((rows[-1][0][-1] + times, q, v, a))
        times, *more = (np.concatenate(column) for column in zip(*rows, strict=True))
        return Trajectory(self.joint_names, times, *more)
