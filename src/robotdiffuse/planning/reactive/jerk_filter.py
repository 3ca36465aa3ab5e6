"""Jerk limits for motions that are replanned while the arm moves.

A motion within velocity and acceleration limits is sampled on a grid of times, averaged over a window, and
read as the control points of a uniform cubic B-spline. Each value of the spline depends on samples up to its
own time only, so that a new motion from then on changes nothing before. Velocities and accelerations are
weighted means of the motion's, and the jerk is at most twice the acceleration over the window's time.
"""

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.core.types import Trajectory
from robotdiffuse.planning.reactive.timed_path import ACCELERATION_FRACTION, SpeedProfile, TimedPath
from robotdiffuse.robots.motion_bounds import motion_radii
from robotdiffuse.robots.robot import Robot

MAX_DISPLACEMENT = 0.005
"""Averaging moves no point of the arm further than this off its path, where the path bends [m]."""
SHARE_FACTOR = 0.9
"""Factor of the accelerations that are tried next where it would."""
GRID_TOLERANCE = 1e-4
"""Part of a step by which a motion may begin before a time of the grid and count as beginning there."""
STILL = 1e-9
"""Samples that differ by less are equal [rad]."""


class JerkFilter:
    """The jerk-limited motion that follows an acceleration-limited one."""

    def __init__(
        self, robot: Robot, jerk: Float[ndarray, "dof"], step: float, q: Float[ndarray, "dof"]
    ) -> None:
        """At rest at q; `step`: between two times of the grid [s]."""
        reach = float((motion_radii(robot) @ robot.acceleration).max())
        self.joint_names, self.step = robot.joint_names, step
        share = ACCELERATION_FRACTION
        while True:
            window = max(int(np.ceil(2 * share * (robot.acceleration / jerk).max() / step)), 1)
            variance = step**2 * ((window**2 - 1) / 12 + 1 / 3)
            displacement = 0.5 * variance * share * reach
            if displacement <= MAX_DISPLACEMENT:
                break
            share *= SHARE_FACTOR
        self.acceleration = share * robot.acceleration
        """Acceleration limits that the given motions must keep [dof]."""
        self.displacement = displacement
        """Bound on the distance of any point of the arm to where the given path takes it [m]; 0 on straight
        lines."""
        self._window = window
        self._samples = np.repeat(q[None], window + 3, axis=0)
        """At the last times of the grid, up to the one with index `_index`."""
        self._origin, self._index, self._ago = -np.inf, 0, 0.0

    @property
    def lag(self) -> float:
        """Time by which the filtered motion comes to rest after the given one, at most [s]."""
        return (self._window + 3) * self.step

    @property
    def at_rest(self) -> bool:
        """Whether the filtered motion rests, if the given one goes on resting."""
        return bool(np.ptp(self._samples, axis=0).max() < STILL)

    def advance(self, path: TimedPath, motion: SpeedProfile, since: float, now: float) -> None:
        """Take samples of the given motion, which began at `since`, up to the time `now` [s]."""
        if not np.isfinite(self._origin):
            self._origin = now
            return
        index = int(np.floor((now - self._origin) / self.step + GRID_TOLERANCE))
        wanted = np.arange(max(self._index + 1, index + 1 - len(self._samples)), index + 1)
        new = path.positions(motion, np.maximum(self._origin + wanted * self.step - since, 0.0))
        self._samples = np.concatenate([self._samples, new])[-len(self._samples) :]
        self._index = index
        self._ago = max(now - self._origin - index * self.step, 0.0)

    def follow(self, path: TimedPath, motion: SpeedProfile) -> Trajectory:
        """The filtered motion from now on until it rests, if the given motion begins now; two rows if it
        rests."""
        step, window, u = self.step, self._window, self._ago / self.step
        resting = self.at_rest and motion.duration == 0
        count = 1 if resting else int(np.ceil((motion.duration + self._ago) / step)) + window + 2
        times = step * np.arange(1, count + 1) - self._ago
        raw = np.concatenate([self._samples, path.positions(motion, times)])
        # differences from the end, so that the motion ends exactly there
        total = np.cumsum(np.concatenate([0 * raw[:1], raw - raw[-1]]), axis=0)
        points = (total[window:] - total[:-window]) / window
        before, at, after = points[1:-3], points[2:-2], points[3:-1]
        first = np.array(
            [
                [(1 - u) ** 3, 3 * u**3 - 6 * u**2 + 4, 1 + 3 * u + 3 * u**2 - 3 * u**3, u**3],
                [-3 * (1 - u) ** 2, 9 * u**2 - 12 * u, 3 + 6 * u - 9 * u**2, 3 * u**2],
                [6 - 6 * u, 18 * u - 12, 6 - 18 * u, 6 * u],
            ]
        )
        q, v, a = first / 6 @ points[:4]
        return Trajectory(
            self.joint_names,
            np.append(0.0, times),
            raw[-1] + np.vstack([q, (before + 4 * at + after) / 6]),
            np.vstack([v / step, (after - before) / (2 * step)]),
            np.vstack([a / step**2, (after - 2 * at + before) / step**2]),
        )
