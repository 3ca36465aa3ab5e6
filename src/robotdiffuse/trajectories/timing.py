"""Time-optimal timing of a path within velocity and acceleration limits."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from robotdiffuse.core.bounds import MIN_RATE
from robotdiffuse.core.errors import InputError
from robotdiffuse.core.types import Path, Trajectory
from robotdiffuse.robots.robot import Robot
from robotdiffuse.trajectories.corner_rounding import BlendedPolyline, half_widths
from robotdiffuse.trajectories.speed_limits import (
    DEFAULT,
    NOTHING,
    Beside,
    TimingSettings,
    can_begin,
    timed_piece,
)

SHRINKS = (0.25, 0.25, 0.0)
"""Factors on the deviation of a corner each time that its rounding is refused; 0: the motion stops there."""
CORNER_PLACES = 17
"""Configurations of a rounded corner that are looked at."""
SAME = 1e-6
"""Waypoints nearer to each other than this are one [rad]."""


def time_parameterize(
    robot: Robot,
    path: Path,
    valid: Callable[[Trajectory], bool],
    free: Callable[[Path], bool],
    settings: TimingSettings = DEFAULT,
    keeps: Callable[[ndarray], bool] = lambda _: True,
    start_speed: float = 0.0,
    beside: Beside = NOTHING,
    deviations: Float[ndarray, "n"] | None = None,
) -> Trajectory:
    """The fastest motion along the path, from rest to rest, within the robot's limits at every row.

    Corners of the path are rounded so that the motion need not stop there. `valid` validates the whole motion.
    Where it refuses, `free` is asked about the corners, one by one, and those that fail are rounded less; in
    the end the motion stops at them. With stops at all corners the rows lie on the path itself, so that a
    path that is free always has a trajectory; that one is returned without asking.

    `keeps` says of configurations [n, dof] along a rounded corner whether they keep what the path does, a
    clearance say; corners that do not are rounded less from the start.

    With a start speed [rad/s, joint-space L2] it begins moving along the first straight line, which must be
    long enough to stop on. `beside` is what else is bounded, of motions that begin at rest.
    `deviations` says for each waypoint how far the motion may leave it, in place of the settings.

    A limit of jerk takes time at both ends of the motion and at each stop, and may cut corners a little more.

    Times start at 0 and strictly increase; the first and last rows are the first and last waypoint exactly.
    A path of length zero becomes two equal rows at rest.

    Raises InputError when a velocity or acceleration limit of a joint is below MIN_RATE.
    """
    _check_limits(robot)
    rows = _distinct(path.positions)
    if len(rows) == 1:
        return _at_rest(path, settings)
    most = np.full(len(rows), settings.corner_deviation) if deviations is None else deviations[rows]
    given = path.positions[rows], most[1:-1]
    return _rounded(robot, path, *given, valid, free, settings, keeps, start_speed, beside)[1]


def rounded_corners(
    robot: Robot,
    path: Path,
    valid: Callable[[Trajectory], bool],
    free: Callable[[Path], bool],
    settings: TimingSettings = DEFAULT,
    keeps: Callable[[ndarray], bool] = lambda _: True,
    beside: Beside = NOTHING,
    stops: Sequence[int] = (),
) -> tuple[Float[ndarray, "n dof"], Float[ndarray, "corners"]]:
    """The waypoints of a path that differ, two at least, and how far `time_parameterize` would round each
    corner; those at the rows `stops` not at all."""
    _check_limits(robot)
    rows = _distinct(path.positions)
    most = np.full(len(rows), settings.corner_deviation)
    most[np.searchsorted(rows, stops, side="right") - 1] = 0.0
    given = path.positions[rows], most[1:-1]
    return given[0], _rounded(robot, path, *given, valid, free, settings, keeps, 0.0, beside)[0]


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
    beside: Beside = NOTHING,
) -> tuple[Float[ndarray, "corners"], Trajectory]:
    """How far each corner is rounded, at most by the deviations, and the motion then; see
    `time_parameterize`."""
    bad = deviations > 0
    for shrink in SHRINKS:
        corners = zip(bad, _corners(waypoints, deviations), strict=True)
        bad = np.array([asked and not keeps(corner) for asked, corner in corners], dtype=bool)
        if not bad.any():
            break
        deviations = np.where(bad, shrink * deviations, deviations)
    for shrink in SHRINKS:
        if not start_speed or _can_begin(robot, waypoints, deviations, settings, start_speed):
            break
        deviations[:1] *= shrink
    for shrink in SHRINKS:
        trajectory = _timed(robot, path, waypoints, deviations, settings, start_speed, beside)
        if not deviations.any() or valid(trajectory):
            return deviations, trajectory
        bad = _bad_corners(path, waypoints, deviations, free)
        deviations = np.where(bad, shrink * deviations, deviations)
    trajectory = _timed(robot, path, waypoints, deviations, settings, start_speed, beside)
    if not deviations.any() or valid(trajectory):
        return deviations, trajectory
    deviations = np.zeros(len(waypoints) - 2)
    return deviations, _timed(robot, path, waypoints, deviations, settings, start_speed, beside)


def _check_limits(robot: Robot) -> None:
    for what in ("velocity", "acceleration"):
        for name, limit in zip(robot.joint_names, getattr(robot, what), strict=True):
            if not limit >= MIN_RATE:
                raise InputError(
                    f"{robot.name}: the {what} limit of {name} is {limit}; it must be at least {MIN_RATE:g}"
                )


def _distinct(positions: Float[ndarray, "n dof"]) -> Int[ndarray, "m"]:
    """Rows that differ from those before them; the first and the last survive."""
    if (np.linalg.norm(positions[1:] - positions[:-1], axis=1) > SAME).all():
        return np.arange(len(positions))
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
    line = BlendedPolyline(waypoints, widths)
    along = line.knots[1:-1, None] + widths[:, None] * np.linspace(-1, 1, CORNER_PLACES)
    rounded = line(along.ravel(), 0).reshape(-1, CORNER_PLACES, waypoints.shape[1])
    return [rounded[i] if d > 0 else waypoints[i + 1 : i + 2] for i, d in enumerate(widths)]


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
    return can_begin(robot, line, settings, start_speed)


def _timed(
    robot: Robot,
    path: Path,
    waypoints: Float[ndarray, "n dof"],
    deviations: Float[ndarray, "corners"],
    settings: TimingSettings,
    start_speed: float,
    beside: Beside = NOTHING,
) -> Trajectory:
    """Pieces between stops, one after the other. The motion stops where the deviation is zero."""
    stops = [0, *(np.flatnonzero(deviations == 0) + 1), len(waypoints) - 1]
    pieces = []
    for a, b in pairwise(stops):
        part = waypoints[a : b + 1]
        line = BlendedPolyline(part, half_widths(part, deviations[a : b - 1]))
        pieces.append(timed_piece(robot, line, settings, 0.0 if pieces else start_speed, beside))
    start, rows = 0.0, []
    for k, (times, positions, velocities, accelerations) in enumerate(pieces):
        first = 0 if k == 0 else 1
        rows.append((start + times[first:], positions[first:], velocities[first:], accelerations[first:]))
        start += times[-1]
    times, positions, velocities, accelerations = (
        np.concatenate(column) for column in zip(*rows, strict=True)
    )
    return Trajectory(path.joint_names, times, positions, velocities, accelerations)
