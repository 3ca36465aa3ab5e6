"""The fastest motions along smooth curves, such as the curves in joint space on which the tool follows a
straight line.

To keep the jerk limits, the motion is averaged over time. `timing.py` averages configurations, which cuts
corners; here the place s on the curve is averaged, so that the motion stays on the curve.
"""

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.interpolate import CubicSpline

from robotdiffuse.core.types import Trajectory, spline_rows
from robotdiffuse.robots.robot import Robot
from robotdiffuse.trajectories.speed_limits import (
    NO_EXTRA_LIMITS,
    ExtraLimits,
    TimingSettings,
    derivatives_and_limits,
    extra_slowdown,
    jerk_limits,
    jerk_windows,
    row_count,
    scaled_limits,
)
from robotdiffuse.trajectories.timing_kernel import ROUNDING_MARGIN, fastest_speeds

GRID_INTERVALS = 128
"""Number of equal intervals of s in which s̈ is constant."""
ACCELERATION_SHARES = (1.0, 0.7, 0.5, 0.35)
"""Fractions of the acceleration limits that are tried in turn, until a lower fraction makes the motion
longer. With lower accelerations, the jerk limits need a shorter averaging window."""


class SmoothCurve:
    """The cubic spline through configurations; its parameter s is the arc length of their polyline."""

    def __init__(self, waypoints: Float[ndarray, "n dof"]) -> None:
        self.knots = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(waypoints, axis=0), axis=1)))
        self._spline = CubicSpline(self.knots, waypoints)

    def __call__(self, s: Float[ndarray, "m"], order: int) -> Float[ndarray, "m dof"]:
        """The curve (order 0) or its derivative of this order by s, at each s."""
        return self._spline(s, order)


def time_curve(
    robot: Robot,
    waypoints: Float[ndarray, "n dof"],
    settings: TimingSettings,
    extra: ExtraLimits = NO_EXTRA_LIMITS,
) -> Trajectory:
    """The fastest motion from rest to rest along the smooth curve through configurations. There must be at
    least four, and neighbors must differ.

    Velocity, acceleration and jerk limits hold at every time. Raises OutOfTimeError if the deadline leaves no
    time.
    """
    curve = SmoothCurve(waypoints)
    grid = np.linspace(0.0, curve.knots[-1], GRID_INTERVALS + 1)
    widths = np.diff(grid)
    velocity, acceleration = scaled_limits(robot, settings)
    jerk = jerk_limits(robot, settings)
    best = None
    shortest_duration = np.inf
    for share in ACCELERATION_SHARES:
        limits = derivatives_and_limits(curve, grid, velocity, share * acceleration, extra)
        speeds = fastest_speeds(*limits)
        ends = np.append(0.0, np.cumsum(2 * widths / (speeds[1:] + speeds[:-1])))
        count = row_count(ends[-1], settings)
        step = ends[-1] / count
        times = step * np.arange(count + 1)
        interval = np.clip(np.searchsorted(ends, times, side="right") - 1, 0, GRID_INTERVALS - 1)
        s_acceleration = np.diff(speeds**2) / (2 * widths)
        dt = times - ends[interval]
        s = grid[interval] + (speeds[interval] + 0.5 * s_acceleration[interval] * dt) * dt
        s[-1] = grid[-1]
        # average s over each window; the longer the window, the lower the jerk, and the later the end
        shortest = np.inf
        for window in jerk_windows(step, share * acceleration, jerk):
            total = np.cumsum(np.concatenate([np.zeros(window), s, np.full(window, s[-1])]))
            controls = curve((total[window:] - total[:-window]) / window, 0)
            controls[0] = waypoints[0]
            controls[-1] = waypoints[-1]
            clock, q, v, a = spline_rows(controls, step)
            # factor on the time with which all limits hold
            slower = ROUNDING_MARGIN * max(
                float((np.abs(v) / velocity).max()),
                float(np.sqrt((np.abs(a) / acceleration).max())),
                float(np.cbrt((np.abs(np.diff(a, axis=0)) / (step * jerk)).max())),
            )
            if extra is not NO_EXTRA_LIMITS:
                slower = max(slower, extra_slowdown(extra, q, v / slower, a / slower**2) * slower)
            duration = slower * clock[-1]
            shortest = min(shortest, duration)
            if duration < shortest_duration:
                shortest_duration = duration
                best = Trajectory(robot.joint_names, slower * clock, q, v / slower, a / slower**2)
        if shortest > shortest_duration:
            break
    assert best is not None
    return best
