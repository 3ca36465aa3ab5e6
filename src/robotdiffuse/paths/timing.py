"""Time-optimal timing of a path within velocity and acceleration limits, by toppra."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from robotdiffuse.errors import InputError
from robotdiffuse.paths.blending import BlendedPolyline, half_widths
from robotdiffuse.robots.robot import Robot
from robotdiffuse.types import Path, Trajectory

SHRINKS = (0.25, 0.25, 0.0)
"""Factors on the deviation of a corner each time that its rounding is refused; 0: the motion stops there."""
PARTS = 16
"""Places in a grid interval where rates are looked at; at 4, a reversal was 1.8 % too fast between them."""
SAME = 1e-6
"""Waypoints nearer to each other than this are one [rad]."""


@dataclass(frozen=True)
class TimingSettings:
    sample_time: float = 0.01
    """Time between the rows of a trajectory [s]; the step before a stop may be 0.1 to 1.1 times as long."""
    velocity_scale: float = 1.0
    """Share of the robot's velocity limits that is used, in (0, 1]."""
    acceleration_scale: float = 1.0
    """Share of the robot's acceleration limits that is used, in (0, 1]."""
    corner_deviation: float = 0.1
    """How far a rounded corner may leave the path, if it stays valid there [rad, joint-space L2]."""
    corner_intervals: int = 8
    """Grid intervals in a rounded corner; more follow the limits closer and take longer."""
    line_intervals: int = 64
    """Grid intervals that straight parts share, by their lengths."""

    def __post_init__(self) -> None:
        for name in ("velocity_scale", "acceleration_scale"):
            if not 0 < getattr(self, name) <= 1:
                raise InputError(f"timing.{name} is {getattr(self, name)}; it must lie in (0, 1]")
        if not 1e-4 <= self.sample_time <= 1:
            raise InputError(f"timing.sample_time is {self.sample_time}; it must lie in [0.0001, 1] s")
        if self.corner_deviation < 0:
            raise InputError(f"timing.corner_deviation is {self.corner_deviation}; it must not be negative")


DEFAULT = TimingSettings()


def time_parameterize(
    robot: Robot,
    path: Path,
    valid: Callable[[Trajectory], bool],
    free: Callable[[Path], bool],
    settings: TimingSettings = DEFAULT,
) -> Trajectory:
    """The fastest motion along the path, from rest to rest, within the robot's limits at every row.

    Corners of the path are rounded so that the motion need not stop there. `valid` judges the whole motion.
    Where it refuses, `free` is asked about the corners, one by one, and those that fail are rounded less; in
    the end the motion stops at them. With stops at all corners the rows lie on the path itself, so that a
    path that is free always has a trajectory; that one is returned without asking.

    Times start at 0 and strictly increase; the first and last rows are the first and last waypoint exactly.
    A path of length zero becomes two equal rows at rest.

    Raises InputError when a joint has no velocity or acceleration limit above 0.
    """
    _check_limits(robot)
    waypoints = _distinct(path.positions)
    if len(waypoints) == 1:
        return _at_rest(path, settings)
    deviations = np.full(len(waypoints) - 2, settings.corner_deviation)
    for shrink in SHRINKS:
        trajectory = _timed(robot, path, waypoints, deviations, settings)
        if not deviations.any() or valid(trajectory):
            return trajectory
        bad = _bad_corners(path, waypoints, deviations, free)
        deviations = np.where(bad, shrink * deviations, deviations)
    trajectory = _timed(robot, path, waypoints, deviations, settings)
    if not deviations.any() or valid(trajectory):
        return trajectory
    return _timed(robot, path, waypoints, np.zeros(len(waypoints) - 2), settings)


def _check_limits(robot: Robot) -> None:
    for what in ("velocity", "acceleration"):
        for name, limit in zip(robot.joint_names, getattr(robot, what), strict=True):
            if not limit > 0:
                raise InputError(f"{robot.name}: the {what} limit of {name} is {limit}; it must be above 0")


def _distinct(positions: Float[ndarray, "n dof"]) -> Float[ndarray, "m dof"]:
    """Waypoints without repetitions; the first and the last survive exactly."""
    kept = [positions[0]]
    for q in positions[1:]:
        if np.linalg.norm(q - kept[-1]) > SAME:
            kept.append(q)
    if len(kept) > 1:
        kept[-1] = positions[-1]
    return np.stack(kept)


def _at_rest(path: Path, settings: TimingSettings) -> Trajectory:
    still = np.zeros((2, path.positions.shape[1]))
    positions = np.stack([path.positions[0], path.positions[-1]])
    return Trajectory(path.joint_names, np.array([0.0, settings.sample_time]), positions, still, still)


def _bad_corners(
    path: Path,
    waypoints: Float[ndarray, "n dof"],
    deviations: Float[ndarray, "corners"],
    free: Callable[[Path], bool],
) -> Bool[ndarray, "corners"]:
    """The corners that are not free on their own; all of them, if each is."""
    widths = half_widths(waypoints, deviations)
    line = BlendedPolyline(waypoints, widths)
    u = np.linspace(-1, 1, 17)
    bad = np.array(
        [
            d > 0 and not free(replace(path, positions=line(line.knots[i + 1] + d * u, 0)))
            for i, d in enumerate(widths)
        ],
        dtype=bool,
    )
    return bad if bad.any() else np.ones(len(bad), dtype=bool)


def _timed(
    robot: Robot,
    path: Path,
    waypoints: Float[ndarray, "n dof"],
    deviations: Float[ndarray, "corners"],
    settings: TimingSettings,
) -> Trajectory:
    """Pieces between stops, one after the other. The motion stops where the deviation is zero."""
    stops = [0, *(np.flatnonzero(deviations == 0) + 1), len(waypoints) - 1]
    pieces = []
    for a, b in pairwise(stops):
        part = waypoints[a : b + 1]
        line = BlendedPolyline(part, half_widths(part, deviations[a : b - 1]))
        pieces.append(_piece(robot, line, settings))
    start, rows = 0.0, []
    for k, (times, positions, velocities, accelerations) in enumerate(pieces):
        first = 0 if k == 0 else 1
        rows.append((start + times[first:], positions[first:], velocities[first:], accelerations[first:]))
        start += times[-1]
    times, positions, velocities, accelerations = (
        np.concatenate(column) for column in zip(*rows, strict=True)
    )
    return Trajectory(path.joint_names, times, positions, velocities, accelerations)


def _grid(line: BlendedPolyline, settings: TimingSettings) -> Float[ndarray, "m"]:
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


def _path_velocities(
    robot: Robot, line: BlendedPolyline, grid: Float[ndarray, "m"], settings: TimingSettings
) -> Float[ndarray, "m"]:
    """ṡ at each value of s in the grid, by toppra; zero at both ends."""
    import toppra

    class Geometry(toppra.interpolator.AbstractGeometricPath):
        @property
        def dof(self) -> int:
            return robot.dof

        @property
        def path_interval(self) -> ndarray:
            return np.array([0.0, line.length])

        def __call__(self, path_positions: ndarray | float, order: int = 0) -> ndarray:
            return line(np.atleast_1d(np.asarray(path_positions, dtype=np.float64)), order)

    velocity = toppra.constraint.JointVelocityConstraint(settings.velocity_scale * robot.velocity)
    acceleration = toppra.constraint.JointAccelerationConstraint(
        settings.acceleration_scale * robot.acceleration,
        discretization_scheme=toppra.constraint.DiscretizationType.Interpolation,
    )
    algorithm = toppra.algorithm.TOPPRA(
        [velocity, acceleration], Geometry(), gridpoints=grid, solver_wrapper="seidel"
    )
    speeds = algorithm.compute_parameterization(0.0, 0.0)[1]
    if speeds is None or np.isnan(speeds).any() or (speeds[1:-1] <= 0).any():
        raise RuntimeError("toppra found no timing; every path has one, so this is a numerical failure")
    return speeds


def _piece(
    robot: Robot, line: BlendedPolyline, settings: TimingSettings
) -> tuple[Float[ndarray, "n"], Float[ndarray, "n dof"], Float[ndarray, "n dof"], Float[ndarray, "n dof"]]:
    """Times, positions, velocities and accelerations of a motion from rest to rest."""
    grid = _grid(line, settings)
    speeds = _path_velocities(robot, line, grid, settings)
    speeds = speeds / _excess(robot, line, grid, speeds, settings)
    steps = 2 * np.diff(grid) / (speeds[:-1] + speeds[1:])
    knots = np.concatenate([[0.0], np.cumsum(steps)])
    times = _sample_times(float(knots[-1]), settings.sample_time)
    interval = np.clip(np.searchsorted(knots, times, side="right") - 1, 0, len(steps) - 1)
    pull = (speeds[1:] - speeds[:-1]) / steps
    ago = times - knots[interval]
    s = np.minimum(grid[interval] + (speeds[interval] + 0.5 * pull[interval] * ago) * ago, line.length)
    velocities, accelerations = _motion(line, s, speeds[interval] + pull[interval] * ago, pull[interval])
    positions = line(s, 0)
    positions[0], positions[-1] = line.waypoints[0], line.waypoints[-1]
    velocities[0] = velocities[-1] = 0.0
    return times, positions, velocities, accelerations


def _motion(
    line: BlendedPolyline, s: Float[ndarray, "n"], speed: Float[ndarray, "n"], pull: Float[ndarray, "n"]
) -> tuple[Float[ndarray, "n dof"], Float[ndarray, "n dof"]]:
    """q̇ = q' ṡ and q̈ = q' s̈ + q'' ṡ²."""
    first = line(s, 1)
    return first * speed[:, None], first * pull[:, None] + line(s, 2) * (speed**2)[:, None]


def _excess(
    robot: Robot,
    line: BlendedPolyline,
    grid: Float[ndarray, "m"],
    speeds: Float[ndarray, "m"],
    settings: TimingSettings,
) -> float:
    """How many times slower the motion must be (at least 1) to keep the limits between grid points too."""
    pull = np.diff(speeds**2) / (2 * np.diff(grid))
    worst = 1.0
    for part in np.linspace(0.0, 1.0, PARTS + 1):
        s = grid[:-1] + part * np.diff(grid)
        speed = np.sqrt(np.maximum(speeds[:-1] ** 2 + 2 * pull * part * np.diff(grid), 0))
        velocities, accelerations = _motion(line, s, speed, pull)
        v = np.abs(velocities) / (settings.velocity_scale * robot.velocity)
        a = np.abs(accelerations) / (settings.acceleration_scale * robot.acceleration)
        worst = max(worst, float(v.max()), float(np.sqrt(a.max())))
    return worst


def _sample_times(duration: float, sample_time: float) -> Float[ndarray, "n"]:
    """Multiples of the sample time, then the duration, no nearer than a tenth of the sample time."""
    count = max(1, int(np.ceil(duration / sample_time - 0.1)))
    return np.concatenate([sample_time * np.arange(count), [duration]])
