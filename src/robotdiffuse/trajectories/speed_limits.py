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
from robotdiffuse.trajectories.corner_rounding import BlendedPolyline
from robotdiffuse.trajectories.jerk_kernel import moving_average
from robotdiffuse.trajectories.timing_kernel import fastest_speeds, sample_rows, slowdown

JERK_TIME_STEP = 0.001
"""Time step at which motions with a jerk limit are computed [s]."""
MAX_ROWS = 200_000
"""Rows of a motion between two stops at most; longer motions have larger steps."""
MAX_JERK_ROWS = 1_000_000
"""The same for the rows from which a motion with a jerk limit is computed."""
SECONDS_PER_ROW = 5e-6
"""Time for sampling and validating a row [s]."""
MIN_STEPS = 4
"""Steps of a motion between two stops at least: with fewer, its rows would miss that it speeds up and
brakes."""
ACCELERATION_SHARES = (1.0, 0.7, 0.5, 0.35, 0.25, 0.15, 0.1)
"""Shares of the acceleration limits that are tried for a motion with a jerk limit; the fastest result is
taken. While the smallest share is the fastest, further ones follow, each FURTHER_SHARE_FACTOR times the one
before."""
FURTHER_SHARE_FACTOR = 0.7
MIN_WINDOW_ROWS = 1.5
"""Rows over which a change of acceleration is spread at least, however high the jerk limit: over less than
one, the velocities of the rows would not agree with their accelerations."""
MIN_SCALING = 1e-3
"""Smallest velocity and acceleration scale: a motion with less would be over a thousand times slower."""
MIN_JERK = 0.01
"""Smallest jerk limit [rad/s³] or [m/s³], with which a joint takes 15 s to turn by 1 rad."""
Scaling = Annotated[float, Bound(least=MIN_SCALING, most=1.0)]
Jerk = Annotated[float, Bound(least=MIN_JERK)]
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

    sample_time: Annotated[float, Bound(least=1e-4, most=1.0)] = 0.01
    """Time between the rows of a trajectory [s]; the step before a stop is 0.1 to 1.1 times as long. Motions
    that would have more than MAX_ROWS rows have longer steps."""
    velocity_scale: Scaling = 1.0
    """Scale of the robot's velocity limits, in (0, 1]."""
    acceleration_scale: Scaling = 1.0
    """Scale of the robot's acceleration limits, in (0, 1]."""
    jerk: Jerk | None = None
    """Jerk limit of every joint [rad/s³] or [m/s³]; None: accelerations may jump."""
    corner_deviation: NotNegative = 0.1
    """How far a rounded corner may leave the path where it stays valid [rad, joint-space L2]."""
    corner_intervals: Count = 8
    """Grid intervals in a rounded corner; more use the limits better and take longer."""
    line_intervals: Count = 64
    """Grid intervals of all straight parts together, distributed by length."""


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
    """Values of s: equal parts of every rounded corner, and parts of the straight lines by their lengths.

    Along a straight line s̈ is piecewise constant, which any grid represents exactly except at the switching
    points. Rounded corners need points of their own because the limits on ṡ change along them.
    """
    inner, widths = line.knots[1:-1], line.half_widths
    grid = [np.array([0.0])]
    s = 0.0
    for low, high in zip([*(inner - widths), line.length], [*(inner + widths), line.length], strict=True):
        if low - s > 1e-12:
            count = max(2, round(settings.line_intervals * (low - s) / line.length))
            grid.append(np.linspace(s, low, count + 1)[1:])
        if high - low > 0:
            grid.append(np.linspace(low, high, settings.corner_intervals + 1)[1:])
        s = high
    joined = np.concatenate(grid)
    joined[-1] = line.length
    return joined


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

    A motion with a jerk limit begins at rest. Raises OutOfTimeError if the deadline leaves no time for it,
    and TooFastError if it cannot stop from its start speed.
    """
    grid, limits = timing_grid(line, settings), _scaled_limits(robot, settings)
    if settings.jerk is not None:
        return _time_with_jerk_limit(line, grid, *limits, settings, settings.jerk, extra)
    speeds = _fastest_speeds(line, grid, *limits, start_speed, extra)
    speeds = _slow_to_extra_limits(line, grid, speeds, extra)
    duration = _duration(grid, speeds)
    step = min(_row_spacing(duration, settings.sample_time, MAX_ROWS), duration / MIN_STEPS)
    _check_rows(duration, step)
    return sample_rows(line.arrays, grid, speeds, step)


class _SlowedMotion(NamedTuple):
    """The fastest motion with a share of the acceleration limits, before it is averaged over a window."""

    duration: float
    """Of the average [s]."""
    speeds: Float[ndarray, "m"]
    """ṡ on the grid, slowed so that the motion takes a whole number of steps."""
    window: int
    """[steps]"""


def _time_with_jerk_limit(
    line: BlendedPolyline,
    grid: Float[ndarray, "m"],
    velocity: Float[ndarray, "dof"],
    acceleration: Float[ndarray, "dof"],
    settings: TimingSettings,
    jerk: float,
    extra: ExtraLimits,
) -> Rows:
    """A motion from rest to rest: the moving average of the fastest motion with a share of the
    accelerations."""

    def slowed(share: float, step: float) -> _SlowedMotion:
        window = int(np.ceil(max(2 * share * acceleration.max() / jerk / step, MIN_WINDOW_ROWS * every)))
        speeds = _fastest_speeds(line, grid, velocity, share * acceleration, extra=extra)
        speeds = _slow_to_extra_limits(line, grid, speeds, extra)
        duration = _duration(grid, speeds)
        slower = np.ceil(duration / step) * step / duration
        return _SlowedMotion(duration * slower + window * step, speeds / slower, window)

    every = max(round(settings.sample_time / JERK_TIME_STEP), 1)
    step = settings.sample_time / every
    found = {share: slowed(share, step) for share in ACCELERATION_SHARES}
    best = min(found, key=lambda share: found[share].duration)
    while best == min(found):
        found[FURTHER_SHARE_FACTOR * best] = slowed(FURTHER_SHARE_FACTOR * best, step)
        best = min(found, key=lambda share: found[share].duration)
    motion, wider = found[best], _row_spacing(found[best].duration, step, MAX_JERK_ROWS)
    if wider > step:
        step, motion = wider, slowed(best, wider)
    every = max(every, round(_row_spacing(motion.duration, every * step, MAX_ROWS) / step))
    _check_rows(motion.duration, step)
    rows = sample_rows(line.arrays, grid, motion.speeds, step)[1:]
    times, q, v, a = moving_average(*rows, step, motion.window, every)
    # The average of a motion within the torque limits may exceed them slightly.
    slower = 1.0 if extra.dynamics is None else _torque_slowdown(extra.dynamics, q, v, a)
    return (times * slower, q, v / slower, a / slower**2) if slower > 1 else (times, q, v, a)


def _row_spacing(duration: float, step: float, max_rows: int) -> float:
    """Time between the rows of a motion [s]: `step`, or more so that it has no more than `max_rows`."""
    return max(step, duration / max_rows)


def _check_rows(duration: float, step: float) -> None:
    """Raises OutOfTimeError if the deadline leaves no time for the rows of a motion."""
    count = int(np.ceil(duration / step))
    check_timing(f"the {count} rows of a motion of {duration:.3g} s", SECONDS_PER_ROW * count)


def _duration(grid: Float[ndarray, "m"], speeds: Float[ndarray, "m"]) -> float:
    """Duration of a motion with these speeds [s]."""
    return float((2 * np.diff(grid) / (speeds[1:] + speeds[:-1])).sum())


def can_begin(robot: Robot, line: BlendedPolyline, settings: TimingSettings, start_speed: float) -> bool:
    """Whether a motion along the line with this start speed keeps the limits and can stop at the end."""
    try:
        _fastest_speeds(line, timing_grid(line, settings), *_scaled_limits(robot, settings), start_speed)
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
    slower, intervals = 1.0, np.repeat(np.arange(len(grid) - 1), SAMPLES_PER_INTERVAL + 1)
    share = np.tile(np.linspace(0.0, 1.0, SAMPLES_PER_INTERVAL + 1), len(grid) - 1)
    s = grid[intervals] + share * np.diff(grid)[intervals]
    squared = speeds[intervals] ** 2 + share * np.diff(speeds**2)[intervals]
    q, first = line(s, 0), line(s, 1)
    rates = first * np.sqrt(squared)[:, None]
    if extra.frame_speeds is not None:
        slower = max(
            slower, float((extra.frame_speeds.speeds(q, rates) / extra.frame_speeds.limits).max(initial=0.0))
        )
    if extra.dynamics is not None:
        pull = (np.diff(speeds**2) / (2 * np.diff(grid)))[intervals]
        accelerations = first * pull[:, None] + line(s, 2) * squared[:, None]
        slower = max(slower, _torque_slowdown(extra.dynamics, q, rates, accelerations))
    return speeds / slower


def _torque_slowdown(
    dynamics: Dynamics, q: Float[ndarray, "n dof"], v: Float[ndarray, "n dof"], a: Float[ndarray, "n dof"]
) -> float:
    """How many times slower a motion must be, at least 1, for its torques to keep their limits: all torque
    but gravity's grows with the square of the speed."""
    gravity = dynamics.holding_torques(q)
    own = dynamics.torques(q, v, a) - gravity
    room = np.maximum(dynamics.limits - np.sign(own) * gravity, MIN_TORQUE_SHARE * dynamics.limits)
    return float(np.sqrt((np.abs(own) / room).max(initial=1.0)))


def _scaled_limits(robot: Robot, settings: TimingSettings) -> tuple[ndarray, ndarray]:
    """Velocity and acceleration limits [dof] with the scales of the settings."""
    return settings.velocity_scale * robot.velocity, settings.acceleration_scale * robot.acceleration
