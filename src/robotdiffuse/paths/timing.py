"""Time-optimal timing of a path within velocity and acceleration limits."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Annotated, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from robotdiffuse.errors import InputError
from robotdiffuse.paths.blending import BlendedPolyline, half_widths
from robotdiffuse.paths.jerk import smoothed
from robotdiffuse.paths.time_optimal import fastest, sampled, slowdown
from robotdiffuse.robots.robot import Robot
from robotdiffuse.settings import Bound, Count, NotNegative, OneOf, Positive, Settings
from robotdiffuse.types import Path, Trajectory

COMPILED, TOPPRA = "compiled", "toppra"
SHRINKS = (0.25, 0.25, 0.0)
"""Factors on the deviation of a corner each time that its rounding is refused; 0: the motion stops there."""
CORNER_PLACES = 17
"""Configurations of a rounded corner that are looked at."""
FINE = 0.001
"""Time between the rows that a limit of jerk is kept by [s]."""
GENTLER = (1.0, 0.7, 0.5, 0.35, 0.25, 0.15, 0.1)
"""Shares of the acceleration limits of which the fastest motion of limited jerk is taken."""
BETWEEN = 8
"""Parts of a grid interval between which a pace is looked at."""
ALMOST = 1e-6
"""Share by which a motion that begins moving may exceed the limits."""
SAME = 1e-6
"""Waypoints nearer to each other than this are one [rad]."""


class TooFastError(RuntimeError):
    """A motion that begins moving is too fast for the first corners, or to stop."""


@dataclass(frozen=True)
class TimingSettings(Settings, name="timing"):
    sample_time: Annotated[float, Bound(least=1e-4, most=1.0)] = 0.01
    """Time between the rows of a trajectory [s]; the step before a stop may be 0.1 to 1.1 times as long."""
    velocity_scale: Annotated[float, Bound(above=0.0, most=1.0)] = 1.0
    """Share of the robot's velocity limits that is used."""
    acceleration_scale: Annotated[float, Bound(above=0.0, most=1.0)] = 1.0
    """Share of the robot's acceleration limits that is used."""
    jerk: Positive | None = None
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


def time_parameterize(
    robot: Robot,
    path: Path,
    valid: Callable[[Trajectory], bool],
    free: Callable[[Path], bool],
    settings: TimingSettings = DEFAULT,
    keeps: Callable[[ndarray], bool] = lambda _: True,
    start_speed: float = 0.0,
    pace: "Pace | None" = None,
    deviations: Float[ndarray, "n"] | None = None,
) -> Trajectory:
    """The fastest motion along the path, from rest to rest, within the robot's limits at every row.

    Corners of the path are rounded so that the motion need not stop there. `valid` judges the whole motion.
    Where it refuses, `free` is asked about the corners, one by one, and those that fail are rounded less; in
    the end the motion stops at them. With stops at all corners the rows lie on the path itself, so that a
    path that is free always has a trajectory; that one is returned without asking.

    `keeps` says of configurations [n, dof] along a rounded corner whether they keep what the path does, a
    clearance say; corners that do not are rounded less from the start.

    With a start speed [rad/s, joint-space L2] it begins moving along the first straight line, which must be
    long enough to stop on. `pace` bounds further speeds, those of frames, of motions that begin at rest.
    `deviations` says for each waypoint how far the motion may leave it, in place of the settings.

    A limit of jerk takes time at both ends of the motion and at each stop, and may cut corners a little more.

    Times start at 0 and strictly increase; the first and last rows are the first and last waypoint exactly.
    A path of length zero becomes two equal rows at rest.

    Raises InputError when a joint has no velocity or acceleration limit above 0.
    """
    _check_limits(robot)
    rows = _distinct(path.positions)
    if len(rows) == 1:
        return _at_rest(path, settings)
    most = np.full(len(rows), settings.corner_deviation) if deviations is None else deviations[rows]
    given = path.positions[rows], most[1:-1]
    return _rounded(robot, path, *given, valid, free, settings, keeps, start_speed, pace)[1]


def rounded_corners(
    robot: Robot,
    path: Path,
    valid: Callable[[Trajectory], bool],
    free: Callable[[Path], bool],
    settings: TimingSettings = DEFAULT,
) -> tuple[Float[ndarray, "n dof"], Float[ndarray, "corners"]]:
    """The waypoints of a path that differ, two at least, and how far `time_parameterize` would round each
    corner."""
    _check_limits(robot)
    waypoints = path.positions[_distinct(path.positions)]
    most = np.full(len(waypoints) - 2, settings.corner_deviation)
    return waypoints, _rounded(robot, path, waypoints, most, valid, free, settings, lambda _: True, 0.0)[0]


def _rounded(
    robot: Robot,
    path: Path,
    waypoints: Float[ndarray, "n dof"],
    deviations: Float[ndarray, "corners"],
    valid: Callable[[Trajectory], bool],
    free: Callable[[Path], bool],
    settings: TimingSettings,
    keeps: Callable[[ndarray], bool],
    start_speed: float,
    pace: "Pace | None" = None,
) -> tuple[Float[ndarray, "corners"], Trajectory]:
    """How far each corner is rounded, at most by the deviations, and the motion then; see
    `time_parameterize`."""
    for shrink in SHRINKS:
        corners = zip(deviations, _corners(waypoints, deviations), strict=True)
        bad = [deviation > 0 and not keeps(corner) for deviation, corner in corners]
        if not any(bad):
            break
        deviations = np.where(bad, shrink * deviations, deviations)
    for shrink in SHRINKS:
        if not start_speed or _can_begin(robot, waypoints, deviations, settings, start_speed):
            break
        deviations[:1] *= shrink
    for shrink in SHRINKS:
        trajectory = _timed(robot, path, waypoints, deviations, settings, start_speed, pace)
        if not deviations.any() or valid(trajectory):
            return deviations, trajectory
        bad = _bad_corners(path, waypoints, deviations, free)
        deviations = np.where(bad, shrink * deviations, deviations)
    trajectory = _timed(robot, path, waypoints, deviations, settings, start_speed, pace)
    if not deviations.any() or valid(trajectory):
        return deviations, trajectory
    deviations = np.zeros(len(waypoints) - 2)
    return deviations, _timed(robot, path, waypoints, deviations, settings, start_speed, pace)


def _check_limits(robot: Robot) -> None:
    for what in ("velocity", "acceleration"):
        for name, limit in zip(robot.joint_names, getattr(robot, what), strict=True):
            if not limit > 0:
                raise InputError(f"{robot.name}: the {what} limit of {name} is {limit}; it must be above 0")


def _distinct(positions: Float[ndarray, "n dof"]) -> Int[ndarray, "m"]:
    """Rows that differ from those before them; the first and the last survive."""
    kept = [0]
    for i in range(1, len(positions)):
        if np.linalg.norm(positions[i] - positions[kept[-1]]) > SAME:
            kept.append(i)
    if len(kept) > 1:
        kept[-1] = len(positions) - 1
    return np.array(kept)


def _at_rest(path: Path, settings: TimingSettings) -> Trajectory:
    still = np.zeros((2, path.positions.shape[1]))
    positions = np.stack([path.positions[0], path.positions[-1]])
    return Trajectory(path.joint_names, np.array([0.0, settings.sample_time]), positions, still, still)


def _corners(
    waypoints: Float[ndarray, "n dof"], deviations: Float[ndarray, "corners"]
) -> list[Float[ndarray, "k dof"]]:
    """Configurations along each rounded corner; of those that are not rounded, the corner."""
    widths = half_widths(waypoints, deviations)
    line, u = BlendedPolyline(waypoints, widths), np.linspace(-1, 1, CORNER_PLACES)
    return [
        line(line.knots[i + 1] + d * u, 0) if d > 0 else waypoints[i + 1 : i + 2]
        for i, d in enumerate(widths)
    ]


def _bad_corners(
    path: Path,
    waypoints: Float[ndarray, "n dof"],
    deviations: Float[ndarray, "corners"],
    free: Callable[[Path], bool],
) -> Bool[ndarray, "corners"]:
    """The corners that are not free on their own; all of them, if each is."""
    corners = zip(deviations, _corners(waypoints, deviations), strict=True)
    bad = np.array([d > 0 and not free(replace(path, positions=corner)) for d, corner in corners], dtype=bool)
    return bad if bad.any() else np.ones(len(bad), dtype=bool)


def _can_begin(
    robot: Robot,
    waypoints: Float[ndarray, "n dof"],
    deviations: Float[ndarray, "corners"],
    settings: TimingSettings,
    start_speed: float,
) -> bool:
    """Whether a motion that begins so fast can go round the corners until it stops."""
    stop = np.append(np.flatnonzero(deviations == 0), len(deviations))[0]
    waypoints, deviations = waypoints[: stop + 2], deviations[:stop]
    line = BlendedPolyline(waypoints, half_widths(waypoints, deviations))
    try:
        _speeds(line, timing_grid(line, settings), settings.solver, *_limits(robot, settings), start_speed)
    except TooFastError:
        return False
    return True


def _timed(
    robot: Robot,
    path: Path,
    waypoints: Float[ndarray, "n dof"],
    deviations: Float[ndarray, "corners"],
    settings: TimingSettings,
    start_speed: float,
    pace: "Pace | None" = None,
) -> Trajectory:
    """Pieces between stops, one after the other. The motion stops where the deviation is zero."""
    stops = [0, *(np.flatnonzero(deviations == 0) + 1), len(waypoints) - 1]
    pieces = []
    for a, b in pairwise(stops):
        part = waypoints[a : b + 1]
        line = BlendedPolyline(part, half_widths(part, deviations[a : b - 1]))
        pieces.append(timed_piece(robot, line, settings, 0.0 if pieces else start_speed, pace))
    start, rows = 0.0, []
    for k, (times, positions, velocities, accelerations) in enumerate(pieces):
        first = 0 if k == 0 else 1
        rows.append((start + times[first:], positions[first:], velocities[first:], accelerations[first:]))
        start += times[-1]
    times, positions, velocities, accelerations = (
        np.concatenate(column) for column in zip(*rows, strict=True)
    )
    return Trajectory(path.joint_names, times, positions, velocities, accelerations)


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
    pace: "Pace | None" = None,
) -> Rows:
    """A motion from a speed, or rest, to rest; with limited jerk from rest."""
    grid, limits = timing_grid(line, settings), _limits(robot, settings)
    if settings.jerk is None:
        speeds = _paced(line, grid, _speeds(line, grid, settings.solver, *limits, begins, pace), pace)
        return sampled(line.arrays, grid, speeds, settings.sample_time)
    every = max(round(settings.sample_time / FINE), 1)
    step, found = settings.sample_time / every, list[tuple[float, ndarray, int]]()
    for share in GENTLER:
        velocity, acceleration = limits[0], share * limits[1]
        window = max(int(np.ceil(2 * acceleration.max() / settings.jerk / step)), 1)
        speeds = _speeds(line, grid, settings.solver, velocity, acceleration, pace=pace)
        speeds = _paced(line, grid, speeds, pace)
        lasts = float((2 * np.diff(grid) / (speeds[1:] + speeds[:-1])).sum())
        slower = np.ceil(lasts / step) * step / lasts  # whole steps
        found.append((lasts * slower + window * step, speeds / slower, window))
    _, speeds, window = min(found, key=lambda timed: timed[0])
    rows = sampled(line.arrays, grid, speeds, step)[1:]
    return smoothed(*rows, step, window, every)


def _speeds(
    line: BlendedPolyline,
    grid: Float[ndarray, "m"],
    solver: str,
    velocity: Float[ndarray, "dof"],
    acceleration: Float[ndarray, "dof"],
    begins: float = 0.0,
    pace: "Pace | None" = None,
) -> Float[ndarray, "m"]:
    """ṡ at each value of s in the grid, such that the limits are kept in between too."""
    share = 1.0
    while True:
        limits = share * velocity, share**2 * acceleration
        if solver == TOPPRA:
            speeds = _speeds_by_toppra(line, grid, *limits, begins)
        else:
            speeds = fastest(*_rates(line, grid, *limits, pace), begins)
        if begins and np.isnan(speeds).any():
            raise TooFastError(f"the motion cannot stop along the path from {begins:.3g} rad/s")
        if not (speeds[1:-1] > 0).all():
            raise RuntimeError("no timing was found; every path has one, so this is a numerical failure")
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
    pace: "Pace | None",
) -> tuple[ndarray, ndarray, ndarray, ndarray, ndarray]:
    """q' and q'' along the path, its grid, and the limits; speeds of frames stand among those of joints, as
    of joints without limits of acceleration."""
    first, second = line(grid, 1), line(grid, 2)
    if pace is None:
        return first, second, grid, velocity, acceleration
    more = pace.speeds(line(grid, 0), first)
    first, second = np.column_stack([first, more]), np.column_stack([second, np.zeros_like(more)])
    limits = np.append(velocity, pace.most), np.append(acceleration, np.full(len(pace.most), np.inf))
    return first, second, grid, *limits


def _paced(
    line: BlendedPolyline, grid: Float[ndarray, "m"], speeds: Float[ndarray, "m"], pace: Pace | None
) -> Float[ndarray, "m"]:
    """The speeds, slowed down so that the pace is kept between grid points too."""
    if pace is None:
        return speeds
    s = np.interp(np.arange(BETWEEN * (len(grid) - 1) + 1), BETWEEN * np.arange(len(grid)), grid)
    rates = line(s, 1) * np.sqrt(np.interp(s, grid, speeds**2))[:, None]
    return speeds / max(1.0, float((pace.speeds(line(s, 0), rates) / pace.most).max(initial=0.0)))


def _limits(robot: Robot, settings: TimingSettings) -> tuple[ndarray, ndarray]:
    return settings.velocity_scale * robot.velocity, settings.acceleration_scale * robot.acceleration
