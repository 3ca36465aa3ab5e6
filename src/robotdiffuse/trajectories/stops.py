"""Motions from rest to rest between places of one path, to and fro, for timings that wait and draw back."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from robotdiffuse.core.types import Path, Trajectory
from robotdiffuse.robots.robot import Robot
from robotdiffuse.trajectories.corner_rounding import BlendedPolyline, half_widths
from robotdiffuse.trajectories.speed_limits import NOTHING, Beside, Rows, TimingSettings, timed_piece
from robotdiffuse.trajectories.timing import rounded_corners

PLACES = 8
"""Parts of about equal length that a path is cut into; more take longer and gain little."""
PACES = (1.0, 0.5)
"""Of the motions, as shares of the fastest."""
APART = 1e-3
"""Places nearer to each other than this are one [rad]."""


class Motion(NamedTuple):
    """From one place to another, both numbered."""

    source: int
    target: int
    ticks: int
    """Steps of the clock that it takes."""
    rows: Rows


class Rests:
    """The places of a path where the arm may rest, and the motions between them."""

    def __init__(
        self,
        robot: Robot,
        path: Path,
        valid: Callable[[Trajectory], bool],
        free: Callable[[Path], bool],
        settings: TimingSettings,
        step: float,
        keeps: Callable[[ndarray], bool] = lambda _: True,
        beside: Beside = NOTHING,
        stops: Sequence[int] = (),
    ) -> None:
        """Every motion lasts a whole number of steps [s]. Corners are rounded where the path that is timed
        without further stops is `valid` then; `free`, `keeps` and `beside` as in `time_parameterize`. No
        motion goes through the path's rows `stops`: there it ends, and another begins."""
        self.joint_names, self.step, self._beside = path.joint_names, step, beside
        waypoints, deviations = rounded_corners(robot, path, valid, free, settings, keeps, beside, stops)
        self.line = BlendedPolyline(waypoints, half_widths(waypoints, deviations))
        self.places = self._places(deviations)
        self.motions = [
            motion for pair in self._pairs(deviations) for motion in self._between(robot, settings, *pair)
        ]

    def _places(self, deviations: Float[ndarray, "corners"]) -> Float[ndarray, "k"]:
        """Outside of rounded corners, so that lines of the polyline begin and end there; stops are places."""
        line, length = self.line, self.line.length
        corners, widths = line.knots[1:-1], line.half_widths
        found = [0.0, *corners[deviations == 0], length]
        for s in np.linspace(0.0, length, PLACES + 1)[1:-1]:
            within = np.flatnonzero(np.abs(s - corners) < widths)
            for i in within[:1]:
                s = corners[i] + np.copysign(widths[i], s - corners[i])
            if min(abs(s - other) for other in found) > APART:
                found.append(float(s))
        return np.sort(np.array(found))

    def _pairs(self, deviations: Float[ndarray, "corners"]) -> list[tuple[int, int]]:
        """Places with no stop between them."""
        stops = self.line.knots[1:-1][deviations == 0]
        s = self.places
        pairs = [(i, j) for i in range(len(s)) for j in range(i + 1, len(s))]
        return [(i, j) for i, j in pairs if not ((s[i] < stops) & (stops < s[j])).any()]

    def _between(self, robot: Robot, settings: TimingSettings, i: int, j: int) -> list[Motion]:
        """There and back, at each pace."""
        line, (low, high) = self.line, self.places[[i, j]]
        inner = np.flatnonzero((line.knots > low + APART) & (line.knots < high - APART))
        ends = line(np.array([low, high]), 0)
        part = BlendedPolyline(
            np.concatenate([ends[:1], line.waypoints[inner], ends[1:]]), line.half_widths[inner - 1]
        )
        times, q, v, a = timed_piece(robot, part, settings, beside=self._beside)
        q = q.copy()
        q[[0, -1]] = ends
        found = []
        for pace in PACES:
            ticks = max(int(np.ceil(times[-1] / pace / self.step - 1e-9)), 1)
            slower = ticks * self.step / times[-1]
            rows = times * slower, q, v / slower, a / slower**2
            back = rows[0][-1] - rows[0][::-1], q[::-1], -rows[2][::-1], rows[3][::-1]
            found += [Motion(i, j, ticks, rows), Motion(j, i, ticks, back)]
        return found

    def spaced(
        self, levers: Float[ndarray, "dof"], travel: float
    ) -> tuple[Float[ndarray, "m"], Float[ndarray, "m dof"]]:
        """Values of s that hold the places, and the configurations there, between which no point of the arm
        moves further than `travel` [m]; `levers` as of `motion_radii`."""
        parts = []
        for low, high in zip(self.places[:-1], self.places[1:], strict=True):
            fine = self.line(np.linspace(low, high, 33), 0)
            way = float((np.abs(np.diff(fine, axis=0)) @ levers).sum())
            parts.append(np.linspace(low, high, max(int(np.ceil(way / travel)), 1) + 1)[:-1])
        s = np.concatenate([*parts, self.places[-1:]])
        return s, self.line(s, 0)

    def cells(self, motion: Motion, configurations: Float[ndarray, "m dof"]) -> Int[ndarray, "ticks"]:
        """At each tick of a motion, with both ends, which one of some configurations is nearest."""
        times, q = motion.rows[:2]
        ticks = self.step * np.arange(motion.ticks + 1)
        at = np.column_stack([np.interp(ticks, times, column) for column in q.T])
        return ((configurations**2).sum(axis=1) - 2 * at @ configurations.T).argmin(axis=1)

    def trajectory(self, way: list[Motion | int]) -> Trajectory:
        """One motion after the other; numbers are places where the arm waits for a step."""
        q = self.line(self.places[:1], 0)
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
