"""Time-optimal timing of a path within velocity, acceleration and jerk limits. For motions that wait or
retreat, `StopGraph` has stops along a path and timed motions between them in both directions."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import combinations, pairwise
from typing import NamedTuple

import numpy as np
from jaxtyping import Int
from numpy import ndarray

from robotdiffuse.core.errors import MIN_RATE, InputError
from robotdiffuse.core.types import (
    Configurations,
    JointValues,
    Path,
    Trajectory,
    Values,
    interpolated,
    spline_rows,
    step_lengths,
)
from robotdiffuse.robots.robot import Robot
from robotdiffuse.trajectories.speed_limits import (
    DEFAULT,
    MIN_SCALING,
    NO_EXTRA_LIMITS,
    ExtraLimits,
    Rows,
    TimingSettings,
    TooFastError,
    slowed_rows,
    time_line,
    within_limits,
)
from robotdiffuse.trajectories.timing_kernel import line_with_widths, rounded_line

SHRINK_FACTOR = 0.5
"""Each time that a rounding is refused, the deviation of the corner (how far its rounding may leave the path)
shrinks by this factor, or accelerations are lowered by it instead; see MAX_SLOWER_TIMINGS."""
MIN_DEVIATION = 2e-4
"""A corner that cannot be rounded with this deviation is a stop [rad, joint-space L2]."""
MAX_TIMINGS = 8
"""Largest number of times that a motion with rounded corners is timed and validated; if the last is refused,
the motion stops at every corner."""
MAX_SLOWER_TIMINGS = 4
"""If each corner is free but the motion is refused, the next timing has lower accelerations; after this many
timings, all corners are rounded less instead."""
CORNER_SAMPLES = 17
"""Number of configurations that are checked along a rounded corner."""
CORNER_PLACES = np.linspace(-1, 1, CORNER_SAMPLES)
"""Places of the checked configurations: offset from the corner's middle in half widths."""
SAME_WAYPOINT_DISTANCE = 1e-6
"""Consecutive waypoints closer than this are merged [rad]."""


class Timing(NamedTuple):
    """A motion along a path."""

    waypoints: Configurations
    """The distinct waypoints of the path."""
    deviations: Values
    """How far the rounding at each inner waypoint may leave the path [rad, joint-space L2]; 0: a stop."""
    trajectory: Trajectory


def time_parameterize(
    robot: Robot,
    path: Path,
    valid: Callable[[Trajectory], bool],
    free: Callable[[Path], bool],
    settings: TimingSettings = DEFAULT,
    keeps: Callable[[ndarray], bool] = lambda _: True,
    start_speed: float = 0.0,
    extra: ExtraLimits = NO_EXTRA_LIMITS,
    deviations: Values | None = None,
    stops: Sequence[int] = (),
) -> Timing:
    """The fastest motion along the path, from `start_speed` to rest, within the robot's limits at every row.

    Corners of the path are rounded so that the motion need not stop there. If `valid` refuses the motion,
    `free` checks the corners one by one, and the deviation of a corner that is not free is halved until the
    corner is free; if its deviation falls below MIN_DEVIATION, it becomes a stop. All corners become stops if
    the motion is still refused after MAX_TIMINGS timings. With stops at all corners, the rows lie on the path
    itself, so a free path always has a trajectory; this trajectory is returned without validation.

    The jerk of motions from rest is constant between rows and within `speed_limits.jerk_limits`. A low
    jerk limit costs time at both ends of the motion and at each stop, and cuts corners slightly more.

    Args:
        robot: The robot.
        path: The path.
        valid: Whether a motion is valid.
        free: Whether a path is free of collision.
        settings: Settings of timing.
        keeps: Whether the configurations [n, dof] along a rounded corner meet a requirement that the path
            meets, such as a clearance. Corners that do not meet it get a smaller deviation before the
            first timing, but none below MIN_DEVIATION.
        start_speed: Speed at the beginning [rad/s, joint-space L2], along the first straight line, which must
            be long enough to stop on.
        extra: Limits on frame speeds and torques, applied only if the motion begins at rest.
        deviations: How far the rounding at each waypoint may leave the path [n] [rad, joint-space L2];
            None: `settings.corner_deviation`.
        stops: Rows of the path at which corners are not rounded.

    Returns:
        The motion and its corners. Times start at 0 and strictly increase; the first and the last row are
        exactly the first and the last waypoint. A path of length zero becomes equal rows at rest.

    Raises:
        InputError: If a velocity or acceleration limit of a joint is below MIN_RATE.
        OutOfTimeError: If the deadline leaves no time.
        TooFastError: If the motion cannot stop on the first straight line from `start_speed`.
    """
    _check_limits(robot)
    rows = _distinct(path.positions)
    waypoints = path.positions[rows]
    if len(rows) == 1:
        motion = Trajectory(path.joint_names, *spline_rows(path.positions[[0, -1]], settings.sample_time))
        return Timing(waypoints, np.zeros(0), within_limits(motion, robot, settings))
    allowed = np.full(len(rows), settings.corner_deviation) if deviations is None else deviations[rows]
    allowed[np.searchsorted(rows, stops, side="right") - 1] = 0.0
    deviations = _shrunk(waypoints, allowed[1:-1], keeps, MIN_DEVIATION)
    while start_speed and deviations[:1].any():
        stop = np.append(np.flatnonzero(deviations == 0), len(deviations))[0]
        try:  # can a motion that begins with the start speed pass the corners before its first stop?
            _time_segments(robot, path, waypoints[: stop + 2], deviations[:stop], settings, start_speed)
            break
        except TooFastError:
            deviations[:1] = _smaller(deviations[:1])
    slower = settings
    attempt = 0
    while True:
        attempt += 1
        trajectory = _time_segments(robot, path, waypoints, deviations, slower, start_speed, extra)
        if not deviations.any() or valid(trajectory):
            return Timing(waypoints, deviations, trajectory)
        less = _shrunk(waypoints, deviations, lambda corner: free(replace(path, positions=corner)))
        if attempt == MAX_TIMINGS:
            deviations = np.zeros_like(deviations)
            slower = settings
        elif (less < deviations).any():
            deviations = less
        elif attempt <= MAX_SLOWER_TIMINGS and not start_speed:
            # To obey the jerk limits, positions are averaged over a window of time, which cuts corners. The
            # cut grows with the acceleration and the square of the window, and the window grows with the
            # acceleration. So half the acceleration cuts an eighth as far.
            scale = max(SHRINK_FACTOR * slower.acceleration_scale, MIN_SCALING)
            slower = replace(slower, acceleration_scale=scale)
        else:  # the refusal may come from any corner: round all of them less
            deviations = _smaller(deviations)
            slower = settings


def _smaller(deviations: Values) -> Values:
    """Smaller deviations to try next; a deviation below MIN_DEVIATION becomes 0, a stop."""
    less = SHRINK_FACTOR * deviations
    return np.where(less < MIN_DEVIATION, 0.0, less)


def _shrunk(
    waypoints: Configurations,
    deviations: Values,
    accepts: Callable[[ndarray], bool],
    least: float = 0.0,
) -> Values:
    """The deviations, each shrunk until `accepts` is true for the configurations [CORNER_SAMPLES, dof] of its
    rounded corner, but not below `least`."""
    deviations, accepted_widths = deviations.copy(), np.zeros(len(deviations))
    while True:
        # Neighboring corners share a segment: if one shrinks, the other may grow and must be checked again.
        line = rounded_line(waypoints, deviations)
        widths = line.half_widths
        unchecked = np.flatnonzero((deviations > 0) & (widths > accepted_widths * (1 + 1e-9)))
        if not len(unchecked):
            return deviations
        s = line.knots[1 + unchecked, None] + widths[unchecked, None] * CORNER_PLACES
        corners = line(s.ravel(), 0).reshape(len(unchecked), CORNER_SAMPLES, -1)
        smaller = np.maximum(_smaller(deviations), np.minimum(deviations, least))
        for i, corner in zip(unchecked.tolist(), corners, strict=True):
            if accepts(corner):
                accepted_widths[i] = widths[i]
            elif smaller[i] < deviations[i]:
                deviations[i] = smaller[i]
            else:  # at its smallest deviation, the corner is not checked again
                accepted_widths[i] = np.inf


def _check_limits(robot: Robot) -> None:
    for rate in ("velocity", "acceleration"):
        for name, limit in zip(robot.joint_names, getattr(robot, rate), strict=True):
            if not limit >= MIN_RATE:
                raise InputError(
                    f"{robot.name}: the {rate} limit of {name} is {limit}; it must be at least {MIN_RATE:g}"
                )


def _distinct(positions: Configurations) -> Int[ndarray, "m"]:
    """Indices of the rows without repetitions: the first row, and each row that differs from the one returned
    before it. The last index is replaced by that of the last row. Only one index if all rows are equal."""
    if (step_lengths(positions) > SAME_WAYPOINT_DISTANCE).all():
        return np.arange(len(positions))
    distinct = [0]
    for i in range(1, len(positions)):
        if np.linalg.norm(positions[i] - positions[distinct[-1]]) > SAME_WAYPOINT_DISTANCE:
            distinct.append(i)
    if len(distinct) > 1:
        distinct[-1] = len(positions) - 1
    return np.array(distinct)


def _time_segments(
    robot: Robot,
    path: Path,
    waypoints: Configurations,
    deviations: Values,
    settings: TimingSettings,
    start_speed: float,
    extra: ExtraLimits = NO_EXTRA_LIMITS,
) -> Trajectory:
    """The motion, timed separately from each stop to the next. It stops at corners whose deviation is
    zero."""
    stops = [0, *(np.flatnonzero(deviations == 0) + 1), len(waypoints) - 1]
    segments = []
    for a, b in pairwise(stops):
        part = waypoints[a : b + 1]
        line = rounded_line(part, deviations[a : b - 1])
        segments.append(time_line(robot, line, settings, 0.0 if segments else start_speed, extra))
    return Trajectory(path.joint_names, *joined_rows(segments))


def joined_rows(pieces: Sequence[tuple[ndarray, ...]]) -> tuple[ndarray, ...]:
    """Joins motions, which are tuples of times and further columns. Each motion begins with the last row of
    the motion before it."""
    start = 0.0
    parts = []
    for times, *columns in pieces:
        first = min(len(parts), 1)
        parts.append((start + times[first:], *(column[first:] for column in columns)))
        start += times[-1]
    return tuple(np.concatenate(column) for column in zip(*parts, strict=True))


PATH_PARTS = 8
"""Number of parts of about equal length into which `StopGraph` divides a path. With more parts, planning
takes longer and gains little."""
SPEED_FACTORS = (1.0, 0.5)
"""`StopGraph` has each motion at these fractions of its highest speed."""
MIN_DISTANCE = 1e-3
"""A stop that divides the path is left out if it is closer than this to another stop [rad]."""


class Motion(NamedTuple):
    """A timed motion from rest at one stop to rest at another."""

    source: int
    """Index of the stop where the motion begins."""
    target: int
    """Index of the stop where the motion ends."""
    ticks: int
    """Duration in time steps."""
    rows: Rows
    """Times, positions, velocities and accelerations."""


class StopGraph:
    """A graph along a path: nodes are stops where the arm may wait, edges are timed motions between them."""

    def __init__(
        self,
        robot: Robot,
        timing: Timing,
        settings: TimingSettings,
        step: float,
        extra: ExtraLimits = NO_EXTRA_LIMITS,
    ) -> None:
        """The graph along the path of `timing`. Every motion lasts a whole number of time steps `step`
        [s]."""
        self.joint_names = robot.joint_names
        self.step = step
        self._extra = extra
        deviations = timing.deviations
        self.line = rounded_line(timing.waypoints, deviations)
        self.stops = self._find_stops(deviations)
        """The values of s along the path at which motions may stop, in order."""
        sharp = self.line.knots[1:-1][deviations == 0]
        self.motions = list[Motion]()
        for (i, low), (j, high) in combinations(enumerate(self.stops), 2):
            if not ((low < sharp) & (sharp < high)).any():  # a motion cannot pass a sharp corner
                self.motions += self._between(robot, settings, i, j)

    def _find_stops(self, deviations: Values) -> Values:
        """Values of s of all stops, in order: both ends, every sharp corner, and PATH_PARTS - 1 places
        between the ends, moved out of rounded corners and dropped if near another stop."""
        line = self.line
        length = line.length
        corners = line.knots[1:-1]
        widths = line.half_widths
        stops = [0.0, *corners[deviations == 0], length]
        for s in np.linspace(0.0, length, PATH_PARTS + 1)[1:-1]:
            for i in np.flatnonzero(np.abs(s - corners) < widths)[:1]:
                s = corners[i] + np.copysign(widths[i], s - corners[i])
            if min(abs(s - stop) for stop in stops) > MIN_DISTANCE:
                stops.append(float(s))
        return np.sort(np.array(stops))

    def _between(self, robot: Robot, settings: TimingSettings, i: int, j: int) -> list[Motion]:
        """The motions from stop i to stop j and back, at each speed factor."""
        line, (low, high) = self.line, self.stops[[i, j]]
        interior = np.flatnonzero((line.knots > low + MIN_DISTANCE) & (line.knots < high - MIN_DISTANCE))
        ends = line(np.array([low, high]), 0)
        waypoints = np.concatenate([ends[:1], line.waypoints[interior], ends[1:]])
        part = line_with_widths(waypoints, line.half_widths[interior - 1])
        times, q, v, a = time_line(robot, part, settings, extra=self._extra)
        q = q.copy()
        q[[0, -1]] = ends
        motions = []
        for factor in SPEED_FACTORS:
            ticks = max(int(np.ceil(times[-1] / factor / self.step - 1e-9)), 1)
            rows = slowed_rows((times, q, v, a), ticks * self.step / times[-1])
            back = rows[0][-1] - rows[0][::-1], q[::-1], -rows[2][::-1], rows[3][::-1]
            motions += [Motion(i, j, ticks, rows), Motion(j, i, ticks, back)]
        return motions

    def sample(self, radii: JointValues, travel: float) -> tuple[Values, Configurations]:
        """Values of s, including all stops, and the configurations there [n, dof]. Between neighboring stops,
        the values are equally spaced, so closely that no point of the arm moves by more than `travel` [m] a
        step on average. radii: largest `motion_radii` of each joint over all links."""
        parts = []
        for low, high in zip(self.stops[:-1], self.stops[1:], strict=True):
            samples = self.line(np.linspace(low, high, 33), 0)
            travel_length = float((np.abs(np.diff(samples, axis=0)) @ radii).sum())
            parts.append(np.linspace(low, high, max(int(np.ceil(travel_length / travel)), 1) + 1)[:-1])
        s = np.concatenate([*parts, self.stops[-1:]])
        return s, self.line(s, 0)

    def nearest_samples(self, motion: Motion, configurations: Configurations) -> Int[ndarray, "n"]:
        """For each of the `ticks` + 1 times of a motion, its start and end included, the index of the nearest
        configuration among `configurations`."""
        times, q = motion.rows[:2]
        at = interpolated(self.step * np.arange(motion.ticks + 1), times, q)
        # squared distances, without the term that is the same for all configurations
        return ((configurations**2).sum(axis=1) - 2 * at @ configurations.T).argmin(axis=1)

    def trajectory(self, numbers: list[int]) -> Trajectory:
        """The trajectory of motions one after the other, given by their indices in `motions`; a negative
        index is a wait of one time step."""
        q = self.line(self.stops[:1], 0)
        segments = [(np.zeros(1), q, 0 * q, 0 * q)]  # motions begin and end without acceleration
        for number in numbers:
            if number < 0:
                q = np.repeat(segments[-1][1][-1:], 2, axis=0)
                segments.append((np.array([0.0, self.step]), q, 0 * q, 0 * q))
            else:
                segments.append(self.motions[number].rows)
        return Trajectory(self.joint_names, *joined_rows(segments))
