"""Paths that are certified in the static scene, and speed profiles along them."""

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.core.types import Path, Trajectory
from robotdiffuse.robots.robot import Robot
from robotdiffuse.trajectories import braking_kernel
from robotdiffuse.trajectories.corner_rounding import BlendedPolyline, half_widths
from robotdiffuse.trajectories.speed_limits import TimingSettings, symmetric_bounds, timing_grid
from robotdiffuse.trajectories.timing import rounded_corners
from robotdiffuse.trajectories.timing_kernel import controllable, sample_rows
from robotdiffuse.validation.validator import Verifier

VELOCITY_FRACTION, ACCELERATION_FRACTION = 0.99, 0.96
"""Parts of the limits that are used at the grid points; the rest covers what lies between them."""
MIN_LENGTH = 1e-4
"""Paths are longer than this [rad]."""
LINE_INTERVAL = 0.03
"""Approximate length of the grid intervals on straight pieces [rad, joint-space L2]."""
CORNER_INTERVALS = 16
"""Grid intervals in a rounded corner."""


class SpeedProfile(NamedTuple):
    """A motion along a path: values of the path parameter s, and the speed at each."""

    s: Float[ndarray, "m"]
    speeds: Float[ndarray, "m"]

    def after(self, time: float) -> tuple[float, float]:
        """s and speed at a time after the beginning [s]."""
        return braking_kernel.state_after(self.s, self.speeds, time)

    def rest(self, time: float) -> "SpeedProfile":
        """The rest of the motion from a time after the beginning on [s]."""
        s, speed = self.after(time)
        ahead = self.s > s + 1e-12
        return SpeedProfile(np.append(s, self.s[ahead]), np.append(speed, self.speeds[ahead]))

    @property
    def duration(self) -> float:
        """Time until the arm rests [s]."""
        both = self.speeds[1:] + self.speeds[:-1]
        return float((2 * np.diff(self.s)[both > 0] / both[both > 0]).sum())


@dataclass(frozen=True, eq=False)
class TimedPath:
    """A polyline with rounded corners that passed the validator; the arm need not stop along it."""

    robot: Robot
    line: BlendedPolyline
    to_goal: bool
    """Whether it, or the path that follows, ends at the goal."""
    then: "TimedPath | None" = None
    """The path that follows after a stop at the end; None if this is the last."""

    @staticmethod
    def certified(
        robot: Robot, validator: Verifier, waypoints: Float[ndarray, "n dof"], to_goal: bool
    ) -> "TimedPath | None":
        """The path through waypoints; None if the validator refuses it, or all waypoints are the same."""
        path = Path(robot.joint_names, waypoints)
        if path.length < MIN_LENGTH or not validator.collision_free(path):
            return None

        def free(motion: Trajectory) -> bool:
            return validator.collision_free(Path(motion.joint_names, motion.positions))

        rows, deviations = rounded_corners(robot, path, free, validator.collision_free)
        stops = [0, *(np.flatnonzero(deviations == 0) + 1).tolist(), len(rows) - 1]
        timed = None
        for first, last in reversed(list(pairwise(stops))):
            part = rows[first : last + 1]
            line = BlendedPolyline(part, half_widths(part, deviations[first : last - 1]))
            timed = TimedPath(robot, line, to_goal, timed)
        return timed

    @cached_property
    def _grid(self) -> tuple[ndarray, ndarray, ndarray, ndarray]:
        """The path's first and second derivatives on the grid, the grid of s, and the largest ṡ² on it."""
        count = max(int(self.line.length / LINE_INTERVAL), 8)
        grid = timing_grid(self.line, TimingSettings(line_intervals=count, corner_intervals=CORNER_INTERVALS))
        one, two = self.line(grid, 1), self.line(grid, 2)
        return (
            one,
            two,
            grid,
            controllable(
                one,
                two,
                grid,
                VELOCITY_FRACTION * self.robot.velocity,
                *symmetric_bounds(self._acceleration, len(grid)),
            ),
        )

    @property
    def _acceleration(self) -> Float[ndarray, "dof"]:
        return ACCELERATION_FRACTION * self.robot.acceleration

    def on_then_rest(self, s: float, speed: float, time: float) -> SpeedProfile:
        """The motion that drives as fast as possible towards the end for a time [s], then brakes to rest."""
        return SpeedProfile(
            *braking_kernel.advance_then_brake(*self._grid, s, speed, time, self._acceleration)
        )

    def onwards(self, s: float, speed: float) -> SpeedProfile:
        """The fastest motion to the end."""
        return self.on_then_rest(s, speed, np.inf)

    @property
    def end(self) -> float:
        """A value of s just before the last."""
        return self.line.length - 1e-9

    def at(self, s: float) -> Float[ndarray, "dof"]:
        """The configuration at s."""
        return self.line(np.array([s]), 0)[0]

    def remaining(self, s: float) -> Float[ndarray, "n dof"]:
        """Waypoints from s to the end, of the paths that follow too."""
        ahead = self.line.waypoints[self.line.knots > s + MIN_LENGTH]
        after = self.then.remaining(0.0)[1:] if self.then is not None else ahead[:0]
        return np.concatenate([self.at(s)[None], ahead, after])

    def rows(self, speeds: SpeedProfile, sample_time: float) -> Trajectory:
        """The trajectory of a motion; two rows at rest if it has no duration."""
        if speeds.duration <= 0:
            q = np.repeat(self.at(float(speeds.s[0]))[None], 2, axis=0)
            return Trajectory(self.robot.joint_names, np.array([0.0, sample_time]), q, 0 * q, 0 * q)
        moving = np.append(True, (speeds.speeds[1:] + speeds.speeds[:-1]) > 0)
        rows = sample_rows(self.line.arrays, speeds.s[moving], speeds.speeds[moving], sample_time)
        return Trajectory(self.robot.joint_names, *rows)
