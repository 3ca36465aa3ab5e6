"""For motions that are replanned while the arm moves: paths that are certified in the static scene, speed
profiles along them, and a filter for jerk limits.

The filter takes a motion within velocity and acceleration limits. It samples the motion on a grid of times,
averages the samples over a window, and uses the means as control points of a uniform cubic B-spline. The
spline at any time depends only on samples up to that time, so replanning does not change what lies before.
Its velocities and accelerations are weighted means of the motion's. Its jerk is at most twice the
acceleration limit divided by the duration of the window.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy import ndarray

from robotdiffuse.core.types import Configuration, Configurations, Path, Trajectory, Values
from robotdiffuse.robots.motion_bounds import motion_radii
from robotdiffuse.robots.robot import Robot
from robotdiffuse.trajectories import braking_kernel
from robotdiffuse.trajectories.speed_limits import TimingSettings, symmetric_bounds, timing_grid
from robotdiffuse.trajectories.timing import time_parameterize
from robotdiffuse.trajectories.timing_kernel import (
    RoundedLine,
    controllable,
    line_with_widths,
    rounded_line,
    states_at,
)
from robotdiffuse.validation.tolerances import DEFAULT
from robotdiffuse.validation.validator import Verifier, verifier

# Fractions of the velocity and acceleration limits that are used; the remainder is a margin for the motion
# between grid points.
VELOCITY_FRACTION = 0.99
ACCELERATION_FRACTION = 0.96
CORNER_SAMPLES = 65
"""Number of configurations of a rounded corner at which distances are checked."""
MIN_LENGTH = 1e-4
"""Smallest length of a path [rad, joint-space L2]."""
LINE_INTERVAL = 0.03
"""Approximate length of the grid intervals on straight pieces [rad, joint-space L2]."""
CORNER_INTERVALS = 16
"""Number of grid intervals in a rounded corner."""


class SpeedProfile(NamedTuple):
    """A motion along a path: values of the path parameter s, and ṡ at each; s̈ is constant between them."""

    s: Values
    speeds: Values

    def after(self, time: float) -> "SpeedProfile":
        """What remains of the motion at a time [s] after its beginning."""
        s, speed = states_at(self.s, self.speeds, np.array([time]))
        later = self.s > s + 1e-12
        return SpeedProfile(np.append(s, self.s[later]), np.append(speed, self.speeds[later]))

    @property
    def duration(self) -> float:
        """Time until the arm rests [s]."""
        speed_sums = self.speeds[1:] + self.speeds[:-1]
        return float((2 * np.diff(self.s)[speed_sums > 0] / speed_sums[speed_sums > 0]).sum())


@dataclass(frozen=True, eq=False)
class TimedPath:
    """A polyline with rounded corners that passed the validator; the arm need not stop before its end."""

    robot: Robot
    acceleration: Configuration
    """Acceleration limits of motions along the path [dof]."""
    line: RoundedLine
    to_goal: bool
    """Whether this path, or the last path that follows it, ends at the goal."""
    then: "TimedPath | None" = None
    """The path that follows after a stop at this path's end; None if this is the last path."""

    @staticmethod
    def certified(
        validator: Verifier, waypoints: Configurations, to_goal: bool, jerk_filter: "JerkFilter"
    ) -> "TimedPath | None":
        """The path through waypoints; None if the validator refuses it, or if its length is below MIN_LENGTH.

        A corner is rounded only if the arm is free at it with the filter's displacement as its clearance,
        since the filter moves the arm off the path by up to this distance. At other corners, the arm stops.
        """
        robot = validator.problem.robot
        path = Path(robot.joint_names, waypoints)
        if path.length < MIN_LENGTH or not validator.collision_free(path):
            return None

        contact = max(jerk_filter.displacement, DEFAULT.contact)
        with_clearance = verifier(validator.problem, replace(DEFAULT, contact=contact))

        def free(motion: Trajectory) -> bool:
            return validator.collision_free(Path(motion.joint_names, motion.positions))

        def free_around(q: Configurations) -> bool:
            return with_clearance.collision_free(Path(robot.joint_names, q))

        rows, deviations, _ = time_parameterize(
            robot, path, free, validator.collision_free, keeps=free_around
        )
        line = rounded_line(rows, deviations)
        for i in np.flatnonzero(deviations):
            width = line.half_widths[i]
            if not free_around(line(line.knots[i + 1] + width * np.linspace(-1, 1, CORNER_SAMPLES), 0)):
                deviations[i] = 0.0
        stops = [0, *(np.flatnonzero(deviations == 0) + 1).tolist(), len(rows) - 1]
        timed = None
        for first, last in reversed(list(pairwise(stops))):
            part = line_with_widths(rows[first : last + 1], line.half_widths[first : last - 1])
            timed = TimedPath(robot, jerk_filter.acceleration, part, to_goal, timed)
        return timed

    @cached_property
    def _grid(self) -> tuple[ndarray, ndarray, ndarray, ndarray]:
        """The path's first and second derivatives on the grid, the grid of s, and the largest ṡ² on it."""
        count = max(int(self.line.length / LINE_INTERVAL), 8)
        grid = timing_grid(self.line, TimingSettings(line_intervals=count, corner_intervals=CORNER_INTERVALS))
        path = self.line(grid, 1), self.line(grid, 2), grid
        bounds = symmetric_bounds(self.acceleration, len(grid))
        return *path, controllable(*path, VELOCITY_FRACTION * self.robot.velocity, *bounds)

    def advance_then_brake(self, s: float, speed: float, time: float = np.inf) -> SpeedProfile:
        """The motion from s, with the speed ṡ, that is as fast as possible for `time` [s], then brakes to
        rest, at the latest at the end of the path."""
        return SpeedProfile(
            *braking_kernel.advance_then_brake(*self._grid, s, speed, time, self.acceleration)
        )

    @property
    def end(self) -> float:
        """A motion that reaches this s counts as being at the end of the path."""
        return self.line.length - 1e-9

    def at(self, s: float) -> Configuration:
        """The configuration at s."""
        return self.line(np.array([s]), 0)[0]

    def remaining(self, s: float) -> Configurations:
        """The configuration at s and the waypoints after it, including those of the paths that follow."""
        waypoints = self.line.waypoints[self.line.knots > s + MIN_LENGTH]
        after = self.then.remaining(0.0)[1:] if self.then is not None else waypoints[:0]
        return np.concatenate([self.at(s)[None], waypoints, after])

    def positions(self, motion: SpeedProfile, times: Values) -> Configurations:
        """Configurations [n, dof] at times [s] after the beginning of a motion; at its end, the arm rests."""
        return self.line(states_at(*motion, times)[0], 0)


MAX_DISPLACEMENT = 0.005
"""Largest distance by which the filter may move a point of the arm off the path, where the path bends [m]."""
SHARE_FACTOR = 0.9
"""Factor by which accelerations are reduced, repeatedly, until MAX_DISPLACEMENT is kept."""
GRID_TOLERANCE = 1e-4
"""A time at most this fraction of a step before a time of the grid counts as the grid's time."""
STILL = 1e-9
"""The arm rests if its last samples differ by less than this in each joint [rad]."""
B_SPLINE = np.array([[1, 4, 1, 0], [-3, 0, 3, 0], [3, -6, 3, 0], [-1, 3, -3, 1]]) / 6
"""Coefficients of the uniform cubic B-spline: a row for each power of u, the fraction of a step that has
passed, and a column for each control point."""


class JerkFilter:
    """The filter for jerk limits: turns a motion within velocity and acceleration limits, which may be
    replanned on the way, into one within jerk limits; see the docstring of the module."""

    def __init__(self, robot: Robot, jerk: Configuration, step: float, q: Configuration) -> None:
        """A filter that is at rest at q. step: time between two times of the grid [s]."""
        reach = float((motion_radii(robot) @ robot.acceleration).max())
        self.joint_names = robot.joint_names
        self.step = step
        share = ACCELERATION_FRACTION
        # The window of the averages, in samples, follows from the jerk limits. Window and spline move the arm
        # off the path by half their variance times the acceleration; lower accelerations need a shorter
        # window.
        while True:
            window = max(int(np.ceil(2 * share * (robot.acceleration / jerk).max() / step)), 1)
            variance = step**2 * ((window**2 - 1) / 12 + 1 / 3)
            displacement = 0.5 * variance * share * reach
            if displacement <= MAX_DISPLACEMENT:
                break
            share *= SHARE_FACTOR
        self.acceleration = share * robot.acceleration
        """Acceleration limits that motions to be filtered must keep [dof]."""
        self.displacement = displacement
        """Upper bound on how far the filter moves any point of the arm off the path [m]; on straight lines,
        it does not leave the path."""
        self._window = window
        self._samples = np.repeat(q[None], window + 3, axis=0)
        """Configurations at the last times of the grid, up to the time with index `_index`."""
        self._origin = -np.inf
        """Time of the grid with index 0 [s]."""
        self._index = 0
        self._ago = 0.0
        """Time since the last time of the grid [s]."""

    @property
    def lag(self) -> float:
        """Largest delay with which the filtered motion comes to rest after the motion that is filtered
        [s]."""
        return (self._window + 3) * self.step

    @property
    def at_rest(self) -> bool:
        """Whether the filtered motion rests, provided that the motion that is filtered continues to rest."""
        return bool(np.ptp(self._samples, axis=0).max() < STILL)

    def advance(self, path: TimedPath, motion: SpeedProfile, since: float, now: float) -> None:
        """Sample a motion that began at the time `since` [s], up to the time `now` [s]."""
        if not np.isfinite(self._origin):
            self._origin = now
            return
        index = int(np.floor((now - self._origin) / self.step + GRID_TOLERANCE))
        steps = np.arange(max(self._index + 1, index + 1 - len(self._samples)), index + 1)
        new = path.positions(motion, np.maximum(self._origin + steps * self.step - since, 0.0))
        self._samples = np.concatenate([self._samples, new])[-len(self._samples) :]
        self._index = index
        self._ago = max(now - self._origin - index * self.step, 0.0)

    def follow(self, path: TimedPath, motion: SpeedProfile) -> Trajectory:
        """The filtered motion from now until it rests, if `motion` begins now; two rows if the arm rests
        already."""
        step = self.step
        window = self._window
        u = self._ago / step
        resting = self.at_rest and motion.duration == 0
        count = 1 if resting else int(np.ceil((motion.duration + self._ago) / step)) + window + 2
        times = step * np.arange(1, count + 1) - self._ago
        raw = np.concatenate([self._samples, path.positions(motion, times)])
        # moving averages of the differences from the end, so that the motion ends exactly at its end
        total = np.cumsum(np.concatenate([0 * raw[:1], raw - raw[-1]]), axis=0)
        points = (total[window:] - total[:-window]) / window
        before = points[1:-3]
        at = points[2:-2]
        after = points[3:-1]
        # The first row is a fraction u of a step after a time of the grid. Rows of `powers`: powers of u, and
        # their first and second derivatives.
        powers = np.array([[1, u, u**2, u**3], [0, 1, 2 * u, 3 * u**2], [0, 0, 2, 6 * u]])
        q, v, a = powers @ B_SPLINE @ points[:4]
        return Trajectory(
            self.joint_names,
            np.append(0.0, times),
            raw[-1] + np.vstack([q, (before + 4 * at + after) / 6]),
            np.vstack([v / step, (after - before) / (2 * step)]),
            np.vstack([a / step**2, (after - 2 * at + before) / step**2]),
        )
