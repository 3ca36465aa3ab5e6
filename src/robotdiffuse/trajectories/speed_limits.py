"""The fastest speeds along a polyline with rounded corners: the grid, the limits and the rows of the
motion."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.core.deadline import check_timing
from robotdiffuse.core.settings import Bound, Count, NotNegative, Settings
from robotdiffuse.robots.dynamics import Dynamics
from robotdiffuse.robots.robot import Robot
from robotdiffuse.trajectories import timing_kernel
from robotdiffuse.trajectories.corner_rounding import BlendedPolyline
from robotdiffuse.trajectories.timing_kernel import fastest_speeds, sample_rows, slowdown

MAX_ROWS = 200_000
"""Rows of a motion between two stops at most, before a jerk limit makes it longer; longer motions have larger
steps."""
SECONDS_PER_ROW = 5e-6
"""Time for sampling and validating a row [s]."""
MIN_STEPS = 4
"""Steps of a motion between two stops at least: with fewer, its rows would miss that it speeds up and
brakes."""
ACCELERATION_FACTOR = 0.7
"""Factor of the accelerations that are tried next for a motion that its jerk limits slow down."""
WINDOW_FRACTIONS = (0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9)
"""Fractions tried of the window over which a motion is averaged that keeps the jerk limits in any case."""
DEFAULT_JERK_RATIO = 10.0
"""Jerk limit over acceleration limit of joints that state no jerk limit: full acceleration after 0.1 s
[1/s]."""
MIN_SCALING = 1e-3
"""Smallest velocity and acceleration scale: a motion with less would be over a thousand times slower."""
MIN_JERK = 0.01
"""Smallest jerk limit [rad/s³] or [m/s³], with which a joint takes 15 s to turn by 1 rad."""
Scaling = Annotated[float, Bound(least=MIN_SCALING, most=1.0)]
Jerk = Annotated[float, Bound(least=MIN_JERK, infinite=True)]
SAMPLES_PER_INTERVAL = 8
"""Parts of a grid interval at whose ends frame speeds and torques are checked."""
MIN_TORQUE_SHARE = 2e-3
"""Share of a torque limit that is left to motion where gravity takes all of it."""
LIMIT_TOLERANCE = 1e-6
"""Share by which a motion with a start speed may exceed the limits."""


class TooFastError(RuntimeError):
    """The start speed of a motion is too high for the first corners, or to stop."""


@dataclass(frozen=True)
class TimingSettings(Settings, name="timing"):
    """Settings of the timing of paths."""

    sample_time: Annotated[float, Bound(least=1e-4, most=1.0)] = 0.004
    """Time between the rows of a trajectory at most [s], unless it would have more than MAX_ROWS rows. Each
    motion from stop to stop takes two of these steps longer than the fastest one without a jerk limit."""
    velocity_scale: Scaling = 1.0
    """Scale of the robot's velocity limits, in (0, 1]."""
    acceleration_scale: Scaling = 1.0
    """Scale of the robot's acceleration limits, in (0, 1]."""
    jerk: Jerk | None = None
    """Jerk limit of every joint [rad/s³] or [m/s³]; None: the robot's own limits, see `jerk_limits`;
    infinite: none."""
    corner_deviation: NotNegative = 0.3
    """How far a rounded corner may leave the path where it stays valid [rad, joint-space L2]."""
    corner_intervals: Count = 8
    """Grid intervals in a rounded corner at least; wide ones have as many as a straight part of their
    length."""
    line_intervals: Count = 64
    """Grid intervals of the whole motion, distributed by length."""


DEFAULT = TimingSettings()


class FrameSpeedLimits(NamedTuple):
    """Limits on the speeds of frames."""

    speeds: Callable[[ndarray, ndarray], ndarray]
    """Speeds [n, k] at configurations [n, dof] with joint velocities [n, dof]; linear in the velocities
    [m/s]."""
    limits: Float[ndarray, "k"]
    """[m/s]"""


class ExtraLimits(NamedTuple):
    """Limits besides those on the velocities and accelerations of joints."""

    frame_speeds: FrameSpeedLimits | None = None
    dynamics: Dynamics | None = None
    """Joint torques are kept within its limits."""


NO_EXTRA_LIMITS = ExtraLimits()


def timing_grid(line: BlendedPolyline, settings: TimingSettings) -> Float[ndarray, "m"]:
    """Values of s at which the limits of a motion along a line are applied; see the kernel."""
    counts = settings.corner_intervals, settings.line_intervals
    return timing_kernel.timing_grid(line.knots, line.half_widths, *counts)


Rows = tuple[Float[ndarray, "n"], Float[ndarray, "n dof"], Float[ndarray, "n dof"], Float[ndarray, "n dof"]]
"""Times, positions, velocities and accelerations."""


def time_line(
    robot: Robot,
    line: BlendedPolyline,
    settings: TimingSettings,
    start_speed: float = 0.0,
    extra: ExtraLimits = NO_EXTRA_LIMITS,
) -> Rows:
    """The fastest motion along a line that begins with ṡ = `start_speed` and ends at rest.

    A motion from rest has constant jerk between its rows, within the limits; its accelerations are 0 at both
    ends. With a start speed, accelerations may jump, since the motion before is not known. Raises
    OutOfTimeError if the deadline leaves no time for it, and TooFastError if it cannot stop from its start
    speed.
    """
    grid, (velocity, acceleration) = timing_grid(line, settings), scaled_limits(robot, settings)
    if start_speed > 0:
        speeds = _fastest_speeds(line, grid, velocity, acceleration, start_speed, extra)
        speeds = _slow_to_extra_limits(line, grid, speeds, extra)
        return sample_rows(line.arrays, grid, speeds, _row_spacing(_duration(grid, speeds), settings))
    jerk, best, share = jerk_limits(robot, settings), None, 1.0
    while True:
        limits = velocity, share * acceleration
        speeds = _fastest_speeds(line, grid, *limits, extra=extra)
        speeds = _slow_to_extra_limits(line, grid, speeds, extra)
        duration = _duration(grid, speeds)
        if 2 * (limits[1] / jerk).max() > duration:  # then lower accelerations make a shorter motion
            share *= ACCELERATION_FACTOR
            continue
        controls = sample_rows(line.arrays, grid, speeds, _row_spacing(duration, settings))[1]
        step = duration / (len(controls) - 1)
        window = _window(controls, step, limits[1], jerk)
        rows = _spline_rows(controls, step, window)
        if best is not None and rows[0][-1] >= best[0][-1]:
            break
        best, share = rows, ACCELERATION_FACTOR * share
        if window == 1:
            break
    times, q, v, a = best
    # The mean of motions within the extra limits may exceed them slightly.
    slower = 1.0 if extra is NO_EXTRA_LIMITS else _extra_slowdown(extra, q, v, a)
    return times * slower, q, v / slower, a / slower**2


def jerk_limits(robot: Robot, settings: TimingSettings = DEFAULT) -> Float[ndarray, "dof"]:
    """The jerk limit of each joint: that of the settings, else the robot's, else DEFAULT_JERK_RATIO times the
    acceleration limit [rad/s³] or [m/s³]."""
    if settings.jerk is not None:
        return np.full(robot.dof, settings.jerk)
    return np.where(robot.jerk > 0, robot.jerk, DEFAULT_JERK_RATIO * robot.acceleration)


def _spline_rows(controls: Float[ndarray, "m dof"], step: float, window: int) -> Rows:
    """The uniform cubic B-spline whose control points are moving averages of the configurations of a motion
    from rest to rest, `step` [s] apart, over `window` of them.

    Velocities and accelerations are weighted means of the motion's, and so within the same limits at every
    time; jerks are constant between rows. The spline leaves the motion's path by no more than about a sixth
    of the acceleration times `step` squared, and stays on straight lines.
    """
    moved = np.concatenate(
        [
            np.zeros((window + 2, controls.shape[1])),
            controls - controls[0],
            np.repeat(controls[-1:] - controls[0], window + 1, axis=0),
        ]
    )
    total = np.cumsum(moved, axis=0)
    points = (total[window:] - total[:-window]) / window
    before, at, after = points[:-2], points[1:-1], points[2:]
    q = controls[0] + (before + 4 * at + after) / 6
    v, a = (after - before) / (2 * step), (after - 2 * at + before) / step**2
    q[0], q[-1] = controls[0], controls[-1]
    v[[0, -1]], a[[0, -1]] = 0.0, 0.0
    return step * np.arange(len(q)), q, v, a


def _window(
    controls: Float[ndarray, "m dof"],
    step: float,
    acceleration: Float[ndarray, "dof"],
    jerk: Float[ndarray, "dof"],
) -> int:
    """The number of configurations over which `_spline_rows` must average to keep the jerk limits."""
    enough = max(int(np.ceil(2 * (acceleration / jerk).max() / step)), 1)
    tried = sorted({1, *(int(np.ceil(fraction * enough)) for fraction in WINDOW_FRACTIONS)} - {enough})
    for window in tried:
        accelerations = _spline_rows(controls, step, window)[3]
        if (np.abs(np.diff(accelerations, axis=0)) <= step * jerk).all():
            return window
    return enough


def _row_spacing(duration: float, settings: TimingSettings) -> float:
    """Time between the rows of a motion, which divides its duration [s].

    Raises OutOfTimeError if the deadline leaves no time for that many rows.
    """
    count = min(max(int(np.ceil(duration / settings.sample_time)), MIN_STEPS), MAX_ROWS)
    check_timing(f"the {count} rows of a motion of {duration:.3g} s", SECONDS_PER_ROW * count)
    return duration / count


def _duration(grid: Float[ndarray, "m"], speeds: Float[ndarray, "m"]) -> float:
    """Duration of a motion with these speeds [s]."""
    return float((2 * np.diff(grid) / (speeds[1:] + speeds[:-1])).sum())


def can_begin(robot: Robot, line: BlendedPolyline, settings: TimingSettings, start_speed: float) -> bool:
    """Whether a motion along the line with this start speed keeps the limits and can stop at the end."""
    try:
        _fastest_speeds(line, timing_grid(line, settings), *scaled_limits(robot, settings), start_speed)
    except TooFastError:
        return False
    return True


def symmetric_bounds(
    acceleration: Float[ndarray, "dof"], rows: int
) -> tuple[Float[ndarray, "n dof"], Float[ndarray, "n dof"]]:
    """Lowest and highest accelerations [rows, dof] at each of the grid's points."""
    highest = np.tile(acceleration, (rows, 1))
    return -highest, highest


def _fastest_speeds(
    line: BlendedPolyline,
    grid: Float[ndarray, "m"],
    velocity: Float[ndarray, "dof"],
    acceleration: Float[ndarray, "dof"],
    start_speed: float = 0.0,
    extra: ExtraLimits = NO_EXTRA_LIMITS,
) -> Float[ndarray, "m"]:
    """ṡ at each value of s in the grid, such that limits hold between grid points too."""
    share = 1.0
    while True:
        check_timing("the fastest speeds")
        limits = share * velocity, share**2 * acceleration
        speeds = fastest_speeds(*_derivatives_and_limits(line, grid, *limits, extra), start_speed)
        if start_speed and np.isnan(speeds).any():
            raise TooFastError(f"the motion cannot stop along the path from {start_speed:.3g} rad/s")
        slower = slowdown(line.arrays, grid, speeds, velocity, acceleration)
        if start_speed == 0:
            return speeds / slower
        if slower <= 1 + LIMIT_TOLERANCE:
            return speeds
        share /= slower  # the start speed is given, so that the motion cannot just be slowed down


def _derivatives_and_limits(
    line: BlendedPolyline,
    grid: Float[ndarray, "m"],
    velocity: Float[ndarray, "dof"],
    acceleration: Float[ndarray, "dof"],
    extra: ExtraLimits,
) -> tuple[ndarray, ndarray, ndarray, ndarray, ndarray, ndarray]:
    """q' and q'' along the path, the grid, velocity limits, and lowest and highest accelerations.

    Further columns stand for frame speeds, which have no acceleration limits, and for torques as shares of
    their limits, which have no velocity limits: s̈ acts on them through q' and ṡ² through q'', and gravity's
    share is taken from their limits.
    """
    first, second = line(grid, 1), line(grid, 2)
    least, most = symmetric_bounds(acceleration, len(grid))
    if extra is NO_EXTRA_LIMITS:
        return first, second, grid, velocity, least, most
    columns = [(first, second, velocity, least, most)]
    if extra.frame_speeds is not None:
        speeds = extra.frame_speeds.speeds(line(grid, 0), first)
        endless = np.full_like(speeds, np.inf)
        columns.append((speeds, np.zeros_like(speeds), extra.frame_speeds.limits, -endless, endless))
    if extra.dynamics is not None:
        torques, limits, q, still = extra.dynamics.torques, extra.dynamics.limits, line(grid, 0), 0 * first
        gravity = torques(q, still, still)
        low, high = -limits - gravity, limits - gravity
        low, high = np.minimum(low, -MIN_TORQUE_SHARE * limits), np.maximum(high, MIN_TORQUE_SHARE * limits)
        pull, bend = torques(q, still, first) - gravity, torques(q, first, second) - gravity
        endless = np.full(len(limits), np.inf)
        columns.append((pull / limits, bend / limits, endless, low / limits, high / limits))
    first, second, velocity, least, most = (
        np.concatenate(rows, axis=-1) for rows in zip(*columns, strict=True)
    )
    return first, second, grid, velocity, least, most


def _slow_to_extra_limits(
    line: BlendedPolyline, grid: Float[ndarray, "m"], speeds: Float[ndarray, "m"], extra: ExtraLimits
) -> Float[ndarray, "m"]:
    """The speeds, slowed down so that frame speeds and torques keep their limits between grid points too."""
    if extra is NO_EXTRA_LIMITS:
        return speeds
    intervals = np.repeat(np.arange(len(grid) - 1), SAMPLES_PER_INTERVAL + 1)
    share = np.tile(np.linspace(0.0, 1.0, SAMPLES_PER_INTERVAL + 1), len(grid) - 1)
    s = grid[intervals] + share * np.diff(grid)[intervals]
    squared = speeds[intervals] ** 2 + share * np.diff(speeds**2)[intervals]
    q, first = line(s, 0), line(s, 1)
    rates = first * np.sqrt(squared)[:, None]
    pull = (np.diff(speeds**2) / (2 * np.diff(grid)))[intervals]
    accelerations = first * pull[:, None] + line(s, 2) * squared[:, None]
    return speeds / _extra_slowdown(extra, q, rates, accelerations)


def _extra_slowdown(
    extra: ExtraLimits, q: Float[ndarray, "n dof"], v: Float[ndarray, "n dof"], a: Float[ndarray, "n dof"]
) -> float:
    """How many times slower a motion must be, at least 1, to keep the extra limits."""
    slower = 1.0
    if extra.frame_speeds is not None:
        speeds = extra.frame_speeds.speeds(q, v)
        slower = max(slower, float((speeds / extra.frame_speeds.limits).max(initial=0.0)))
    if extra.dynamics is not None:
        slower = max(slower, _torque_slowdown(extra.dynamics, q, v, a))
    return slower


def _torque_slowdown(
    dynamics: Dynamics, q: Float[ndarray, "n dof"], v: Float[ndarray, "n dof"], a: Float[ndarray, "n dof"]
) -> float:
    """How many times slower a motion must be, at least 1, for its torques to keep their limits: all torque
    but gravity's grows with the square of the speed."""
    gravity = dynamics.holding_torques(q)
    own = dynamics.torques(q, v, a) - gravity
    room = np.maximum(dynamics.limits - np.sign(own) * gravity, MIN_TORQUE_SHARE * dynamics.limits)
    return float(np.sqrt((np.abs(own) / room).max(initial=1.0)))


def scaled_limits(robot: Robot, settings: TimingSettings) -> tuple[ndarray, ndarray]:
    """Velocity and acceleration limits [dof] with the scales of the settings."""
    return settings.velocity_scale * robot.velocity, settings.acceleration_scale * robot.acceleration
