"""The fastest motions along smooth curves, such as the curves in joint space on which the tool follows a
straight line.

To keep the jerk limits, the motion is averaged over time. `speed_limits.time_line` averages configurations,
which cuts corners; here the place s on the curve is averaged, so that the motion stays on the curve.
"""

import numpy as np
from scipy.interpolate import CubicSpline

from robotdiffuse.core.types import Configurations, Trajectory, arc_lengths, running_means, spline_rows
from robotdiffuse.robots.robot import Robot
from robotdiffuse.trajectories.speed_limits import (
    NO_EXTRA_LIMITS,
    ExtraLimits,
    TimingSettings,
    derivatives_and_limits,
    duration_of,
    extra_slowdown,
    jerk_limits,
    jerk_windows,
    row_count,
    scaled_limits,
    slowed,
    within_limits,
)
from robotdiffuse.trajectories.timing_kernel import fastest_speeds, states_at

GRID_INTERVALS = 128
"""Number of equal intervals of s in which s̈ is constant."""
ACCELERATION_SHARES = (1.0, 0.7, 0.5, 0.35)
"""Fractions of the acceleration limits that are tried in turn, until a lower fraction makes the motion
longer. With lower accelerations, the jerk limits need a shorter averaging window."""


def time_curve(
    robot: Robot,
    waypoints: Configurations,
    settings: TimingSettings,
    extra: ExtraLimits = NO_EXTRA_LIMITS,
) -> Trajectory:
    """The fastest motion from rest to rest along the cubic spline through configurations. There must be at
    least four, and neighbors must differ.

    Velocity, acceleration and jerk limits hold at every time. Raises OutOfTimeError if the deadline leaves no
    time.
    """
    knots = arc_lengths(waypoints)
    curve = CubicSpline(knots, waypoints)
    grid = np.linspace(0.0, knots[-1], GRID_INTERVALS + 1)
    velocity, acceleration = scaled_limits(robot, settings)
    jerk = jerk_limits(robot, settings)
    best: Trajectory | None = None
    for share in ACCELERATION_SHARES:
        limits = derivatives_and_limits(curve, grid, velocity, share * acceleration, extra)
        speeds = fastest_speeds(*limits)
        duration = duration_of(grid, speeds)
        count = row_count(duration, settings)
        step = duration / count
        s = states_at(grid, speeds, step * np.arange(count + 1))[0]
        s[-1] = grid[-1]
        # average s over each window; the longer the window, the lower the jerk, and the later the end
        motions = []
        for window in jerk_windows(step, share * acceleration, jerk):
            padded = np.concatenate([np.zeros(window), s, np.full(window, s[-1])])
            controls = curve(running_means(padded, window), 0)
            controls[0] = waypoints[0]
            controls[-1] = waypoints[-1]
            motion = Trajectory(robot.joint_names, *spline_rows(controls, step))
            motion = within_limits(motion, robot, settings, 0.0)
            motions.append(
                slowed(
                    motion,
                    extra_slowdown(extra, motion.positions, motion.velocities, motion.accelerations),
                )
            )
        fastest = min(motions, key=lambda motion: motion.duration)
        if best is not None and fastest.duration > best.duration:
            break
        best = fastest
    assert best is not None
    return best
