"""The fastest speeds along a polyline with rounded corners: its grid, its limits, its rows."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.core.deadline import check_timing
from robotdiffuse.core.settings import Bound, Count, NotNegative, OneOf, Settings
from robotdiffuse.robots.dynamics import Dynamics
from robotdiffuse.robots.robot import Robot
from robotdiffuse.trajectories.corner_rounding import BlendedPolyline
from robotdiffuse.trajectories.jerk_kernel import smoothed
from robotdiffuse.trajectories.timing_kernel import fastest, sampled, slowdown

COMPILED, TOPPRA = "compiled", "toppra"
FINE = 0.001
"""Time between the rows that a limit of jerk is kept by [s]."""
MOST_ROWS = 200_000
"""Of a motion between two stops; those of a longer motion are further apart."""
MOST_FINE_ROWS = 1_000_000
"""Of a motion between two stops that a limit of jerk is kept by."""
ROW_SECONDS = 5e-6
"""What sampling and validating a row takes [s]."""
LEAST_STEPS = 4
"""Between the rows of a motion however short, or its rows would not tell that it speeds up and brakes."""
GENTLER = (1.0, 0.7, 0.5, 0.35, 0.25, 0.15, 0.1)
"""Shares of the acceleration limits of which the fastest motion of limited jerk is taken; while the last one
is the fastest, further ones follow, each STILL_GENTLER times the one before."""
STILL_GENTLER = 0.7
LEAST_WINDOW = 1.5
"""Rows that the acceleration takes to change at least, however high the limit of jerk: in less than one, the
velocities of the rows would not agree with their accelerations."""
LEAST_SCALING = 1e-3
"""Of velocities and accelerations: a motion with less is a thousand times slower, or has no end."""
LEAST_JERK = 0.01
"""Of limits [rad/s³] or [m/s³]; with it a joint takes 15 s to turn by 1 rad."""
Scaling = Annotated[float, Bound(least=LEAST_SCALING, most=1.0)]
Jerk = Annotated[float, Bound(least=LEAST_JERK)]
BETWEEN = 8
"""Parts of a grid interval between which paces and torques are looked at."""
ROOM = 2e-3
"""Share of a torque limit that is there for motion where gravity takes all of it."""
ALMOST = 1e-6
"""Share by which a motion that begins moving may exceed the limits."""


class TooFastError(RuntimeError):
    """A motion that begins moving is too fast for the first corners, or to stop."""


@dataclass(frozen=True)
class TimingSettings(Settings, name="timing"):
    sample_time: Annotated[float, Bound(least=1e-4, most=1.0)] = 0.01
    """Time between the rows of a trajectory [s]; the step before a stop may be 0.1 to 1.1 times as long. More
    in motions that would have more than MOST_ROWS rows."""
    velocity_scale: Scaling = 1.0
    """Share of the robot's velocity limits that is used."""
    acceleration_scale: Scaling = 1.0
    """Share of the robot's acceleration limits that is used."""
    jerk: Jerk | None = None
    """Most jerk of any joint [rad/s³] or [m/s³]; None: accelerations may change at once."""
    corner_deviation: NotNegative = 0.1
    """How far a rounded corner may leave the path, if it stays valid there [rad, joint-space L2]."""
    corner_intervals: Count = 8
    """Grid intervals in a rounded corner; more follow the limits closer and take longer."""
    solver: Annotated[str, OneOf((COMPILED, TOPPRA))] = COMPILED
    """What finds the speeds: this package's compiled code, or toppra."""
    line_intervals: Count = 64
    """Grid intervals that straight parts share, by their lengths."""


DEFAULT = TimingSettings()


class Pace(NamedTuple):
    """Speeds that are bounded beside those of the joints."""

    speeds: Callable[[ndarray, ndarray], ndarray]
    """[n, k] at configurations [n, dof] with joint rates [n, dof]; in proportion to the rates."""
    most: Float[ndarray, "k"]


class Beside(NamedTuple):
    """What is bounded beside velocities and accelerations of joints."""

    pace: Pace | None = None
    dynamics: Dynamics | None = None
    """Torques, by its limits."""


NOTHING = Beside()


def timing_grid(line: BlendedPolyline, settings: TimingSettings) -> Float[ndarray, "m"]:
    """Values of s: every blend in equal parts, straight parts by length, first and last interval split.

    Along a straight line s̈ is piecewise constant, which any grid holds exactly but for the switching
    points; blends need their own points because the limits on ṡ change along them.
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


def _speeds_by_toppra(
    line: BlendedPolyline,
    grid: Float[ndarray, "m"],
    velocity: Float[ndarray, "dof"],
    acceleration: Float[ndarray, "dof"],
    begins: float,
) -> Float[ndarray, "m"]:
    """ṡ at each value of s in the grid; `begins` at the first, zero at the last."""
    import toppra

    class Geometry(toppra.interpolator.AbstractGeometricPath):
        @property
        def dof(self) -> int:
            return len(velocity)

        @property
        def path_interval(self) -> ndarray:
            return np.array([0.0, line.length])

        def __call__(self, path_positions: ndarray | float, order: int = 0) -> ndarray:
            return line(np.atleast_1d(np.asarray(path_positions, dtype=np.float64)), order)

    constraints = [
        toppra.constraint.JointVelocityConstraint(velocity),
        toppra.constraint.JointAccelerationConstraint(
            acceleration, discretization_scheme=toppra.constraint.DiscretizationType.Interpolation
        ),
    ]
    algorithm = toppra.algorithm.TOPPRA(constraints, Geometry(), gridpoints=grid, solver_wrapper="seidel")
    speeds = algorithm.compute_parameterization(begins, 0.0)[1]
    return np.full(len(grid), np.nan) if speeds is None else speeds


Rows = tuple[Float[ndarray, "n"], Float[ndarray, "n dof"], Float[ndarray, "n dof"], Float[ndarray, "n dof"]]
"""Times, positions, velocities and accelerations."""


def timed_piece(
    robot: Robot,
    line: BlendedPolyline,
    settings: TimingSettings,
    begins: float = 0.0,
    beside: Beside = NOTHING,
) -> Rows:
    """A motion from a speed, or rest, to rest; with limited jerk from rest.

    Raises OutOfTimeError where a deadline leaves no time for it.
    """
    grid, limits = timing_grid(line, settings), _limits(robot, settings)
    if settings.jerk is not None:
        return _of_limited_jerk(line, grid, *limits, settings, settings.jerk, beside)
    speeds = _slowed(line, grid, _speeds(line, grid, settings.solver, *limits, begins, beside), beside)
    lasts = _lasts(grid, speeds)
    step = min(_spacing(lasts, settings.sample_time, MOST_ROWS), lasts / LEAST_STEPS)
    _check_rows(lasts, step)
    return sampled(line.arrays, grid, speeds, step)


class _Gentle(NamedTuple):
    """The fastest motion with a share of the acceleration limits, to be averaged over a window."""

    lasts: float
    """The mean [s]."""
    speeds: Float[ndarray, "m"]
    """So slow that the motion lasts whole steps."""
    window: int
    """Steps."""


def _of_limited_jerk(
    line: BlendedPolyline,
    grid: Float[ndarray, "m"],
    velocity: Float[ndarray, "dof"],
    acceleration: Float[ndarray, "dof"],
    settings: TimingSettings,
    jerk: float,
    beside: Beside,
) -> Rows:
    """A motion from rest to rest: the mean of one that is the fastest with a share of the accelerations."""

    def gentle(share: float, step: float) -> _Gentle:
        window = int(np.ceil(max(2 * share * acceleration.max() / jerk / step, LEAST_WINDOW * every)))
        speeds = _speeds(line, grid, settings.solver, velocity, share * acceleration, beside=beside)
        speeds = _slowed(line, grid, speeds, beside)
        lasts = _lasts(grid, speeds)
        slower = np.ceil(lasts / step) * step / lasts
        return _Gentle(lasts * slower + window * step, speeds / slower, window)

    every = max(round(settings.sample_time / FINE), 1)
    step = settings.sample_time / every
    found = {share: gentle(share, step) for share in GENTLER}
    best = min(found, key=lambda share: found[share].lasts)
    while best == min(found):
        found[STILL_GENTLER * best] = gentle(STILL_GENTLER * best, step)
        best = min(found, key=lambda share: found[share].lasts)
    motion, wider = found[best], _spacing(found[best].lasts, step, MOST_FINE_ROWS)
    if wider > step:
        step, motion = wider, gentle(best, wider)
    every = max(every, round(_spacing(motion.lasts, every * step, MOST_ROWS) / step))
    _check_rows(motion.lasts, step)
    rows = sampled(line.arrays, grid, motion.speeds, step)[1:]
    times, q, v, a = smoothed(*rows, step, motion.window, every)
    # the mean of motions within the torque limits may need a hair more
    slower = 1.0 if beside.dynamics is None else _times_too_fast(beside.dynamics, q, v, a)
    return (times * slower, q, v / slower, a / slower**2) if slower > 1 else (times, q, v, a)


def _spacing(lasts: float, step: float, most: int) -> float:
    """Time between the rows of a motion that lasts so long, such that it has no more than `most` [s]."""
    return max(step, lasts / most)


def _check_rows(lasts: float, step: float) -> None:
    """OutOfTimeError where a deadline leaves no time for the rows of a motion."""
    count = int(np.ceil(lasts / step))
    check_timing(f"the {count} rows of a motion of {lasts:.3g} s", ROW_SECONDS * count)


def _lasts(grid: Float[ndarray, "m"], speeds: Float[ndarray, "m"]) -> float:
    """Duration of a motion with these speeds [s]."""
    return float((2 * np.diff(grid) / (speeds[1:] + speeds[:-1])).sum())


def can_begin(robot: Robot, line: BlendedPolyline, settings: TimingSettings, speed: float) -> bool:
    """Whether a motion along the line that begins so fast keeps the limits and can stop at its end."""
    try:
        _speeds(line, timing_grid(line, settings), settings.solver, *_limits(robot, settings), speed)
    except TooFastError:
        return False
    return True


def symmetric(
    acceleration: Float[ndarray, "dof"], rows: int
) -> tuple[Float[ndarray, "n dof"], Float[ndarray, "n dof"]]:
    """Least and greatest accelerations at each of the grid's points."""
    most = np.tile(acceleration, (rows, 1))
    return -most, most


def _speeds(
    line: BlendedPolyline,
    grid: Float[ndarray, "m"],
    solver: str,
    velocity: Float[ndarray, "dof"],
    acceleration: Float[ndarray, "dof"],
    begins: float = 0.0,
    beside: Beside = NOTHING,
) -> Float[ndarray, "m"]:
    """ṡ at each value of s in the grid, such that the limits are kept in between too."""
    share = 1.0
    while True:
        check_timing("the fastest speeds")
        limits = share * velocity, share**2 * acceleration
        if solver == TOPPRA:
            speeds = _speeds_by_toppra(line, grid, *limits, begins)
        else:
            speeds = fastest(*_rates(line, grid, *limits, beside), begins)
        if begins and np.isnan(speeds).any():
            raise TooFastError(f"the motion cannot stop along the path from {begins:.3g} rad/s")
        if not (speeds[1:-1] > 0).all():
            raise RuntimeError("toppra found no timing; solver=compiled has one for every path")
        slower = slowdown(line.arrays, grid, speeds, velocity, acceleration)
        if begins == 0:
            return speeds / slower
        if slower <= 1 + ALMOST:
            return speeds
        share /= slower  # the speed at the beginning is given


def _rates(
    line: BlendedPolyline,
    grid: Float[ndarray, "m"],
    velocity: Float[ndarray, "dof"],
    acceleration: Float[ndarray, "dof"],
    beside: Beside,
) -> tuple[ndarray, ndarray, ndarray, ndarray, ndarray, ndarray]:
    """q' and q'' along the path, its grid, and the limits.

    Speeds of frames stand among those of joints, as of joints without limits of acceleration; shares of
    torque limits as of joints without limits of velocity: with q' they grow by s̈, with q'' by ṡ², and what
    gravity takes is no longer there for them.
    """
    first, second = line(grid, 1), line(grid, 2)
    least, most = symmetric(acceleration, len(grid))
    if beside is NOTHING:
        return first, second, grid, velocity, least, most
    columns = [(first, second, velocity, least, most)]
    if beside.pace is not None:
        speeds = beside.pace.speeds(line(grid, 0), first)
        endless = np.full_like(speeds, np.inf)
        columns.append((speeds, np.zeros_like(speeds), beside.pace.most, -endless, endless))
    if beside.dynamics is not None:
        torques, limits, q, still = beside.dynamics.torques, beside.dynamics.limits, line(grid, 0), 0 * first
        gravity = torques(q, still, still)
        low, high = -limits - gravity, limits - gravity
        low, high = np.minimum(low, -ROOM * limits), np.maximum(high, ROOM * limits)
        pull, bend = torques(q, still, first) - gravity, torques(q, first, second) - gravity
        endless = np.full(len(limits), np.inf)
        columns.append((pull / limits, bend / limits, endless, low / limits, high / limits))
    first, second, velocity, least, most = (
        np.concatenate(rows, axis=-1) for rows in zip(*columns, strict=True)
    )
    return first, second, grid, velocity, least, most


def _slowed(
    line: BlendedPolyline, grid: Float[ndarray, "m"], speeds: Float[ndarray, "m"], beside: Beside
) -> Float[ndarray, "m"]:
    """The speeds, slowed down so that paces and torques are kept between grid points too."""
    if beside is NOTHING:
        return speeds
    slower, intervals = 1.0, np.repeat(np.arange(len(grid) - 1), BETWEEN + 1)
    share = np.tile(np.linspace(0.0, 1.0, BETWEEN + 1), len(grid) - 1)
    s = grid[intervals] + share * np.diff(grid)[intervals]
    squared = speeds[intervals] ** 2 + share * np.diff(speeds**2)[intervals]
    q, first = line(s, 0), line(s, 1)
    rates = first * np.sqrt(squared)[:, None]
    if beside.pace is not None:
        slower = max(slower, float((beside.pace.speeds(q, rates) / beside.pace.most).max(initial=0.0)))
    if beside.dynamics is not None:
        pull = (np.diff(speeds**2) / (2 * np.diff(grid)))[intervals]
        accelerations = first * pull[:, None] + line(s, 2) * squared[:, None]
        slower = max(slower, _times_too_fast(beside.dynamics, q, rates, accelerations))
    return speeds / slower


def _times_too_fast(
    dynamics: Dynamics, q: Float[ndarray, "n dof"], v: Float[ndarray, "n dof"], a: Float[ndarray, "n dof"]
) -> float:
    """How many times slower a motion must be, at least 1, for its torques to keep their limits: what is not
    gravity's part goes with the square of its speed."""
    gravity = dynamics.holding_torques(q)
    own = dynamics.torques(q, v, a) - gravity
    room = np.maximum(dynamics.limits - np.sign(own) * gravity, ROOM * dynamics.limits)
    return float(np.sqrt((np.abs(own) / room).max(initial=1.0)))


def _limits(robot: Robot, settings: TimingSettings) -> tuple[ndarray, ndarray]:
    return settings.velocity_scale * robot.velocity, settings.acceleration_scale * robot.acceleration
