"""Timing of one polyline with rounded corners: its limits, its fastest speeds, and the rows of the motion."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, NamedTuple

import numpy as np
from numpy import ndarray

from robotdiffuse.core.deadline import check_timing
from robotdiffuse.core.settings import Bound, Count, NotNegative, Settings
from robotdiffuse.core.types import (
    Configurations,
    JointRows,
    JointValues,
    Rows,
    Trajectory,
    Values,
    spline_rows,
)
from robotdiffuse.robots.dynamics import Dynamics
from robotdiffuse.robots.robot import Robot
from robotdiffuse.trajectories import timing_kernel
from robotdiffuse.trajectories.timing_kernel import (
    ROUNDING_MARGIN,
    RoundedLine,
    fastest_speeds,
    line_with_widths,
    slowdown,
    states_at,
)

MAX_ROWS = 200_000
"""Largest number of rows of a motion between two stops; averaging for jerk limits adds further rows. Longer
motions have larger time steps."""
SECONDS_PER_ROW = 5e-6
"""Estimated time to sample and validate a row [s]."""
MIN_STEPS = 4
"""Smallest number of time steps of a motion between two stops; fewer steps could not show that the motion
speeds up and brakes."""
ACCELERATION_FACTOR = 0.7
"""Factor by which accelerations are lowered between attempts to make a motion with jerk limits shorter."""
WINDOW_FRACTIONS = (0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9)
"""Averaging windows tried in turn, as fractions of the full window. The full window keeps the jerk limits of
any motion: it is twice the largest ratio of a joint's acceleration limit to its jerk limit [s]."""
DEFAULT_JERK_RATIO = 10.0
"""Jerk limit divided by acceleration limit, for joints without a jerk limit of their own [1/s]: the
acceleration limit is reached after 0.1 s."""
MIN_SCALING = 1e-3
"""Smallest velocity and acceleration scale."""
MIN_JERK = 0.01
"""Smallest jerk limit [rad/s³] or [m/s³]; a joint then takes about 15 s to turn by 1 rad from rest to
rest."""
Scaling = Annotated[float, Bound(least=MIN_SCALING, most=1.0)]
Jerk = Annotated[float, Bound(least=MIN_JERK, infinite=True)]
CHECKS_PER_INTERVAL = 8
"""Frame speeds and torques are checked at the ends of this many equal parts of each grid interval."""
MIN_TORQUE_SHARE = 2e-3
"""Fraction of a torque limit that a motion may always use, even where gravity needs nearly all of it."""
LIMIT_TOLERANCE = 1e-6
"""Fraction by which a motion with a start speed may exceed the limits."""
START_SHARES = tuple(ACCELERATION_FACTOR**k for k in range(16))
"""Fractions of the acceleration limits that are tried in turn for a motion with a start speed."""
MAX_SPEED_ATTEMPTS = 12
"""Largest number of attempts in `_fastest_speeds`, for each of START_SHARES. Each further attempt lowers the
limits at grid points, until the real limits hold between them."""
BRAKING_FRACTION = 0.9
"""Fraction of the possible deceleration that `stopping_distance` assumes; the remainder allows corners to be
rounded."""
MIN_STOPPING_DISTANCE = 0.01
"""Smallest result of `stopping_distance` [rad] where there is room for it, so that a corner at the end of the
line can be rounded."""


class TooFastError(RuntimeError):
    """The start speed of a motion is too high for the first corners, or for a stop on the path."""


@dataclass(frozen=True)
class TimingSettings(Settings, name="timing"):
    """Settings of the timing of paths."""

    sample_time: Annotated[float, Bound(least=1e-4, most=1.0)] = 0.004
    """Largest time between the rows of a trajectory [s], unless a motion from stop to stop would then have
    more than MAX_ROWS rows. Without a jerk limit, each motion from stop to stop takes two of these time steps
    longer than the fastest one."""
    velocity_scale: Scaling = 1.0
    """Scale of the robot's velocity limits, at most 1."""
    acceleration_scale: Scaling = 1.0
    """Scale of the robot's acceleration limits, at most 1."""
    jerk: Jerk | None = None
    """Jerk limit of every joint [rad/s³] or [m/s³]; None: the robot's own limits, see `jerk_limits`;
    infinite: no limit."""
    corner_deviation: NotNegative = 0.3
    """How far a rounded corner may leave the path [rad, joint-space L2]; less where the motion would not be
    valid. Averaging for jerk limits cuts corners by up to 0.03 more (with the Panda's limits)."""
    corner_intervals: Count = 8
    """Smallest number of grid intervals in a rounded corner; a long corner has as many as a straight part of
    the same length."""
    line_intervals: Count = 64
    """Number of grid intervals of each motion from stop to stop, distributed by length. Each part has a
    smallest number of intervals, so the total may be larger."""


DEFAULT = TimingSettings()


class FrameSpeedLimits(NamedTuple):
    """Limits on the speeds of frames."""

    speeds: Callable[[ndarray, ndarray], ndarray]
    """Speeds [m/s] of k frames, [n, k], at configurations [n, dof] with joint velocities [n, dof]. They are
    proportional to the velocities."""
    limits: Values
    """Largest speed of each frame [k] [m/s]."""


class ExtraLimits(NamedTuple):
    """Limits besides those on the velocities and accelerations of joints."""

    frame_speeds: FrameSpeedLimits | None = None
    dynamics: Dynamics | None = None
    """Dynamics with torque limits that the motion must keep."""


NO_EXTRA_LIMITS = ExtraLimits()


def timing_grid(line: RoundedLine, settings: TimingSettings) -> Values:
    """Values of s at which the limits of a motion along a line are applied; see
    `timing_kernel.timing_grid`."""
    counts = settings.corner_intervals, settings.line_intervals
    return timing_kernel.timing_grid(line.knots, line.half_widths, *counts)


def time_line(
    robot: Robot,
    line: RoundedLine,
    settings: TimingSettings,
    start_speed: float = 0.0,
    extra: ExtraLimits = NO_EXTRA_LIMITS,
) -> Rows:
    """The fastest motion along a line; the motion begins with ṡ = `start_speed` and ends at rest.

    The fastest motion without jerk limits is averaged over time, so that the jerk is constant between rows
    and within its limits; accelerations are 0 at both ends. `extra` is applied only to motions from rest.
    Raises OutOfTimeError if the deadline leaves no time, and TooFastError if the motion cannot stop from its
    start speed.
    """
    if start_speed > 0:
        return _moving_start(robot, line, settings, start_speed)
    grid, (velocity, acceleration) = timing_grid(line, settings), scaled_limits(robot, settings)
    jerk = jerk_limits(robot, settings)
    best = None
    share = 1.0
    # lower the accelerations step by step, until the motion with jerk limits becomes longer again
    while True:
        limits = velocity, share * acceleration
        speeds = _fastest_speeds(line, grid, *limits, extra=extra)
        speeds = _slow_to_extra_limits(line, grid, speeds, extra)
        duration = duration_of(grid, speeds)
        # the full averaging window is longer than the motion: lower accelerations shorten the window
        if 2 * (limits[1] / jerk).max() > duration:
            share *= ACCELERATION_FACTOR
            continue
        count = row_count(duration, settings)
        step = duration / count
        controls = line(states_at(grid, speeds, step * np.arange(count + 1))[0], 0)
        controls[-1] = line.waypoints[-1]
        for window in jerk_windows(step, limits[1], jerk):
            rows = spline_rows(controls, step, window)
            rows[1][0] = line.waypoints[0]
            if _keeps_jerk(rows, step, jerk):
                break
        if best is not None and rows[0][-1] >= best[0][-1]:
            break
        best = rows
        share = ACCELERATION_FACTOR * share
        if window == 1:
            break
    # A motion within the extra limits may exceed them slightly after the averaging.
    return slowed_rows(best, extra_slowdown(extra, *best[1:]))


def slowed_rows(rows: Rows, factor: float) -> Rows:
    """The rows of a motion with all times multiplied by a factor."""
    times, q, v, a = rows
    return factor * times, q, v / factor, a / factor**2


def slowed(motion: Trajectory, factor: float) -> Trajectory:
    """The motion with all times multiplied by a factor."""
    rows = (motion.times, motion.positions, motion.velocities, motion.accelerations)
    return Trajectory(motion.joint_names, *slowed_rows(rows, factor))


def within_limits(
    motion: Trajectory, robot: Robot, settings: TimingSettings, least: float = 1.0
) -> Trajectory:
    """The motion with all times multiplied by the smallest factor, at least `least`, with which the limits of
    velocity, acceleration and jerk hold."""
    velocity, acceleration = scaled_limits(robot, settings)
    factor = max(
        (np.abs(motion.velocities) / velocity).max(),
        np.sqrt((np.abs(motion.accelerations) / acceleration).max()),
        np.cbrt((motion.peak_jerks / jerk_limits(robot, settings)).max()),
    )
    return slowed(motion, max(ROUNDING_MARGIN * factor, least))


def jerk_limits(
    robot: Robot, settings: TimingSettings = DEFAULT, ratio: float = DEFAULT_JERK_RATIO
) -> JointValues:
    """The jerk limit of each joint [rad/s³] or [m/s³]: the limit of the settings, else the joint's own limit,
    else `ratio` times its acceleration limit."""
    if settings.jerk is not None:
        return np.full(robot.dof, settings.jerk)
    default = ratio * robot.acceleration if np.isfinite(ratio) else np.full(robot.dof, ratio)
    return np.where(robot.jerk > 0, robot.jerk, default)


def _moving_start(robot: Robot, line: RoundedLine, settings: TimingSettings, start_speed: float) -> Rows:
    """`time_line` for a motion with a start speed. Before the averaging, the motion gets a lead: a part of
    the first straight line at constant speed. The averaged motion then begins at the start with this speed
    and without acceleration."""
    velocity, acceleration = scaled_limits(robot, settings)
    jerk = jerk_limits(robot, settings)
    step = settings.sample_time
    best = None
    direction = line.directions[0]
    first_length = line.knots[1]
    for share in START_SHARES:
        candidate = None
        windows = jerk_windows(step, share * acceleration, jerk)
        for window in windows:
            lead = 0.5 * (window + 1) * step * start_speed
            if lead >= first_length:
                break
            widths = line.half_widths.copy()
            widths[:1] = np.minimum(widths[:1], first_length - lead)
            waypoints = np.concatenate([line.waypoints[:1] + lead * direction, line.waypoints[1:]])
            after_lead = line_with_widths(waypoints, widths)
            grid = timing_grid(after_lead, settings)
            try:
                speeds = _fastest_speeds(after_lead, grid, velocity, share * acceleration, start_speed)
            except TooFastError:
                break
            count = int(np.ceil(duration_of(grid, speeds) / step))
            check_timing(f"the {count} rows of a motion", SECONDS_PER_ROW * count)
            controls = after_lead(states_at(grid, speeds, step * np.arange(count + 1))[0], 0)
            rows = spline_rows(controls, step, window, start_speed * direction)
            if window == windows[-1] or _keeps_jerk(rows, step, jerk):
                rows[1][0] = line.waypoints[0]
                candidate = rows
                break
        if best is not None and (candidate is None or candidate[0][-1] >= best[0][-1]):
            break
        best = candidate
    if best is None:
        raise TooFastError(f"the motion cannot stop along the path from {start_speed:.3g} rad/s")
    return best


def stopping_distance(
    robot: Robot, settings: TimingSettings, velocity: JointValues, room: float = np.inf
) -> float:
    """Length of a straight line in the direction of `velocity` on which a motion that begins with this
    velocity can stop [rad, joint-space L2]. At most `room`, unless the motion needs more to stop."""
    acceleration = scaled_limits(robot, settings)[1]
    speed = float(np.linalg.norm(velocity))
    moving = velocity != 0
    max_acceleration = float((acceleration[moving] * speed / np.abs(velocity[moving])).min())
    window = 2 * float((acceleration / jerk_limits(robot, settings)).max())
    delays = [0.5 * share * window + 2 * settings.sample_time for share in START_SHARES]
    braking = [speed**2 / (2 * BRAKING_FRACTION * share * max_acceleration) for share in START_SHARES]
    shortest = min(speed * delay + length for delay, length in zip(delays, braking, strict=True))
    return max(shortest, min(MIN_STOPPING_DISTANCE, room))


def jerk_windows(step: float, acceleration: JointValues, jerk: JointValues) -> list[int]:
    """Windows for `spline_rows` to try, in increasing order: numbers of configurations that are `step` [s]
    apart. The last window keeps the jerk limits of any motion within the acceleration limits."""
    jerk_window = max(int(np.ceil(2 * (acceleration / jerk).max() / step)), 1)
    return sorted({1, *(int(np.ceil(fraction * jerk_window)) for fraction in WINDOW_FRACTIONS), jerk_window})


def _keeps_jerk(rows: Rows, step: float, jerk: JointValues) -> bool:
    """Whether the jerks between rows are within their limits."""
    return bool((np.abs(np.diff(rows[3], axis=0)) <= step * jerk).all())


def row_count(duration: float, settings: TimingSettings) -> int:
    """The number of time steps of a motion of this duration [s].

    Raises OutOfTimeError if the deadline leaves no time for that many rows.
    """
    count = min(max(int(np.ceil(duration / settings.sample_time)), MIN_STEPS), MAX_ROWS)
    check_timing(f"the {count} rows of a motion of {duration:.3g} s", SECONDS_PER_ROW * count)
    return count


def duration_of(grid: Values, speeds: Values) -> float:
    """Duration of a motion with these speeds [s]."""
    return float((2 * np.diff(grid) / (speeds[1:] + speeds[:-1])).sum())


def least_time(
    line: RoundedLine, velocity: JointValues, acceleration: JointValues, settings: TimingSettings
) -> float:
    """Duration of the fastest motion along a line from rest to rest, without jerk limits [s]."""
    grid = timing_grid(line, settings)
    return duration_of(grid, _fastest_speeds(line, grid, velocity, acceleration))


def symmetric_bounds(acceleration: JointValues, rows: int) -> tuple[JointRows, JointRows]:
    """Lowest and highest accelerations [rows, dof] at each of the grid's points."""
    highest = np.tile(acceleration, (rows, 1))
    return -highest, highest


def _fastest_speeds(
    line: RoundedLine,
    grid: Values,
    velocity: JointValues,
    acceleration: JointValues,
    start_speed: float = 0.0,
    extra: ExtraLimits = NO_EXTRA_LIMITS,
) -> Values:
    """ṡ at each grid point of the fastest motion that keeps the limits between grid points as well. A motion
    from rest is slowed down as a whole. For a motion with a start speed, velocity limits at the grid points
    are multiplied by `share`, and acceleration limits by its square, until the motion keeps the real limits
    everywhere. Raises TooFastError if no motion does."""
    share = 1.0
    at_start = start_speed * np.abs(line(grid[:1], 1)[0])
    for _ in range(MAX_SPEED_ATTEMPTS):
        check_timing("the fastest speeds")
        # the start velocity is fixed, so velocity limits below it could not be met
        limits = np.minimum(velocity, np.maximum(share * velocity, at_start)), share**2 * acceleration
        speeds = fastest_speeds(*derivatives_and_limits(line, grid, *limits, extra), start_speed)
        if start_speed and np.isnan(speeds).any():
            break
        slower = slowdown(line, grid, speeds, velocity, acceleration)
        if start_speed == 0:
            return speeds / slower
        if slower <= 1 + LIMIT_TOLERANCE:
            return speeds
        share /= slower * (1 + LIMIT_TOLERANCE)
    raise TooFastError(f"the motion cannot stop along the path from {start_speed:.3g} rad/s")


def derivatives_and_limits(
    line: Callable[[ndarray, int], ndarray],
    grid: Values,
    velocity: JointValues,
    acceleration: JointValues,
    extra: ExtraLimits,
) -> tuple[ndarray, ndarray, ndarray, ndarray, ndarray, ndarray]:
    """The arguments of `fastest_speeds`: q' and q'' at the grid points, the grid, velocity limits, and lowest
    and highest accelerations.

    Extra limits are further columns of the same form, as if they were joints. A frame speed is proportional
    to ṡ; the factor is its q', and it has no acceleration limits. A torque is `a` s̈ + `b` ṡ² + gravity, all
    divided by the torque limit: `a` is its q', `b` its q'', and its acceleration limits are ±1 minus gravity.
    It has no velocity limit.
    """
    first = line(grid, 1)
    second = line(grid, 2)
    lowest, highest = symmetric_bounds(acceleration, len(grid))
    columns = [(first, second, velocity, lowest, highest)]
    if extra.frame_speeds is not None:
        speeds = extra.frame_speeds.speeds(line(grid, 0), first)
        no_limit = np.full_like(speeds, np.inf)
        columns.append((speeds, np.zeros_like(speeds), extra.frame_speeds.limits, -no_limit, no_limit))
    if extra.dynamics is not None:
        torques = extra.dynamics.torques
        limits = extra.dynamics.limits
        q = line(grid, 0)
        still = 0 * first
        gravity = torques(q, still, still)
        low = np.minimum(-limits - gravity, -MIN_TORQUE_SHARE * limits)
        high = np.maximum(limits - gravity, MIN_TORQUE_SHARE * limits)
        a = torques(q, still, first) - gravity
        b = torques(q, first, second) - gravity
        no_limit = np.full(len(limits), np.inf)
        columns.append((a / limits, b / limits, no_limit, low / limits, high / limits))
    first, second, velocity, lowest, highest = (
        np.concatenate(parts, axis=-1) for parts in zip(*columns, strict=True)
    )
    return first, second, grid, velocity, lowest, highest


def _slow_to_extra_limits(line: RoundedLine, grid: Values, speeds: Values, extra: ExtraLimits) -> Values:
    """The speeds, slowed down so that frame speeds and torques keep their limits between grid points as
    well."""
    if extra == NO_EXTRA_LIMITS:
        return speeds
    intervals = np.repeat(np.arange(len(grid) - 1), CHECKS_PER_INTERVAL + 1)
    share = np.tile(np.linspace(0.0, 1.0, CHECKS_PER_INTERVAL + 1), len(grid) - 1)
    s = grid[intervals] + share * np.diff(grid)[intervals]
    squared = speeds[intervals] ** 2 + share * np.diff(speeds**2)[intervals]
    q = line(s, 0)
    first = line(s, 1)
    rates = first * np.sqrt(squared)[:, None]
    s_acceleration = (np.diff(speeds**2) / (2 * np.diff(grid)))[intervals]
    accelerations = first * s_acceleration[:, None] + line(s, 2) * squared[:, None]
    return speeds / extra_slowdown(extra, q, rates, accelerations)


def extra_slowdown(extra: ExtraLimits, q: Configurations, v: JointRows, a: JointRows) -> float:
    """The factor, at least 1, by which a motion's duration must grow to keep the extra limits at these
    rows."""
    slower = 1.0
    if extra.frame_speeds is not None:
        speeds = extra.frame_speeds.speeds(q, v)
        slower = max(slower, float((speeds / extra.frame_speeds.limits).max(initial=0.0)))
    if extra.dynamics is not None:
        # torques of the motion, without gravity, grow with the square of the speed
        gravity = extra.dynamics.holding_torques(q)
        limits = extra.dynamics.limits
        motion_torques = extra.dynamics.torques(q, v, a) - gravity
        available = np.maximum(limits - np.sign(motion_torques) * gravity, MIN_TORQUE_SHARE * limits)
        slower = max(slower, float(np.sqrt((np.abs(motion_torques) / available).max(initial=1.0))))
    return slower


def scaled_limits(robot: Robot, settings: TimingSettings) -> tuple[ndarray, ndarray]:
    """Velocity and acceleration limits [dof] of a robot, multiplied by the scales of the settings."""
    return settings.velocity_scale * robot.velocity, settings.acceleration_scale * robot.acceleration
