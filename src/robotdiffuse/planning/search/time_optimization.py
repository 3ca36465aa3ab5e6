"""The fastest motion near the paths of a search. Candidates are the most promising paths; a compiled local
search makes them faster by random changes of waypoints and corners.

The time of a candidate is that of the fastest motion along its polyline with rounded corners, without jerk
limits.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from robotdiffuse.collision.kernels.motions import Space, make_scratch, motion_free
from robotdiffuse.collision.kernels.random import random, random_state
from robotdiffuse.core.kernels import inner_kernel, kernel
from robotdiffuse.core.types import Configuration, Configurations, Values, step_lengths
from robotdiffuse.robots.robot import Robot
from robotdiffuse.trajectories.speed_limits import TimingSettings, least_time, scaled_limits
from robotdiffuse.trajectories.straight_line import straight_line_time
from robotdiffuse.trajectories.timing_kernel import estimated_time, evaluate_at, rounded_line

# An attempt draws a number from 0 to 1. Below REMOVE_SHARE, it removes a waypoint, unless it is the only
# inner one; below ADD_SHARE, it adds a waypoint in the middle of a segment and moves it; below WIDEN_SHARE,
# it changes the deviation of a corner (how far its rounding may leave it); otherwise it moves a waypoint, and
# in half of the cases also changes the deviation of its corner.
REMOVE_SHARE = 0.02
ADD_SHARE = 0.05
WIDEN_SHARE = 0.12
# Factor by which the deviation of a corner changes, and the largest deviation [rad, joint-space L2].
WIDENING = 1.5
MAX_DEVIATION = 1.0
# Largest scale of moves of a waypoint in each joint [rad], and the natural logarithm of the ratio of the
# largest to the smallest scale.
MAX_MOVE = 0.4
MOVE_LOG_RANGE = 5.0
REPEAT_FACTOR = 2.0
"""After a successful move, the waypoint is moved again by this multiple of the move."""
MIN_DEVIATION = 0.002
"""`free_deviations` accepts a deviation up to this without a check [rad]. Timing checks the corner later, and
rounds it less if it is not free."""
MIN_SEGMENT = 0.005
"""Shortest segment [rad]."""
# A rounded corner is checked along chords of this length [rad], of which there are at most MAX_CHORDS.
MAX_CHORD = 0.05
MAX_CHORDS = 16


@kernel(nogil=True)
def reduce_time(space, path, deviations, time, velocity, acceleration, longest, tries, state):
    """A faster rounded polyline: its waypoints [m, dof], its deviations [m - 2] and its estimated time [s].

    path: waypoints [n, dof], n >= 3; the polyline and its rounded corners must be free. deviations: of its
    corners [n - 2]. time: its estimated time [s]. velocity, acceleration: limits [dof]. longest: bound on the
    length of the result [rad, joint-space L2]. tries: number of attempts. state: of the random generator.

    If a move makes the path faster, the next attempt moves this waypoint further in the same direction.
    """
    scratch = make_scratch(space, space.lower)
    step = np.zeros(path.shape[1])
    moved = np.int64(0)  # a literal 0 has another type, for which Numba would compile again
    for _ in range(tries):
        new, new_deviations, first, last = _candidate(space, path, deviations, step, moved, state)
        moved = 0
        if len(new) == 0:
            continue
        line = rounded_line(new, new_deviations)
        if line.knots[-1] > longest:
            continue
        new_time = estimated_time(line, velocity, acceleration)
        if new_time < time and _is_free(space, line, first, last, scratch):
            if len(new) == len(path):  # waypoint `last` moved: the last changed segment begins there
                step[:] = new[last] - path[last]
                moved = last if np.abs(step).max() > 0 else 0
            path = new
            deviations = new_deviations
            time = new_time
    return path, deviations, time


@inner_kernel(inline="always")
def _candidate(space, path, deviations, step, again, state):
    """A changed path, its deviations, and the indices of the first and the last changed segment. If a segment
    beside an added or moved waypoint is too short, the path is empty. again: index of a waypoint that moves
    again in the direction `step`; 0: a random change."""
    n, dof = path.shape
    kind = np.float32(1.0) if again else random(state)
    i = again if again else 1 + min(int(random(state) * (n - 2)), n - 3)
    if kind < REMOVE_SHARE and n > 3:  # remove waypoint i
        new = np.concatenate((path[:i], path[i + 1 :]))
        new_deviations = np.concatenate((deviations[: i - 1], deviations[i:]))
        return new, new_deviations, i - 1, i - 1
    if kind < ADD_SHARE:  # add waypoint i in the middle of a segment
        i = 1 + min(int(random(state) * (n - 1)), n - 2)
        corner = min(i - 1, n - 3)  # it gets the deviation of the next corner, or of the last one
        new = np.concatenate((path[:i], 0.5 * (path[i - 1 : i] + path[i : i + 1]), path[i:]))
        new_deviations = np.concatenate(
            (deviations[: i - 1], deviations[corner : corner + 1], deviations[i - 1 :])
        )
    else:
        new = path.copy()
        new_deviations = deviations.copy()
    # move waypoint i, with a random scale and in a random part of the joints, within the joint limits
    if again:
        new[i] += REPEAT_FACTOR * step
    elif kind < ADD_SHARE or kind >= WIDEN_SHARE:
        size = MAX_MOVE * np.exp(-MOVE_LOG_RANGE * random(state))
        share = random(state)
        for j in range(dof):
            if random(state) < share:
                new[i, j] += size * (2.0 * random(state) - 1.0)
    new[i] = np.minimum(np.maximum(new[i], space.lower), space.upper)
    # change the deviation of its corner
    if not again and kind >= ADD_SHARE and (kind < WIDEN_SHARE or random(state) < 0.5):
        change = WIDENING if random(state) < 0.75 else 1.0 / WIDENING
        new_deviations[i - 1] = min(change * new_deviations[i - 1], MAX_DEVIATION)
    for k in range(i - 1, i + 1):
        if ((new[k + 1] - new[k]) ** 2).sum() < MIN_SEGMENT**2:
            return np.empty((0, dof)), new_deviations, 0, 0
    return new, new_deviations, i - 1, i


@inner_kernel(inline="always")
def _is_free(space, line, first, last, scratch):
    """Whether these parts of the polyline are free: segments `first` to `last`, the rounded corners at their
    ends, and one more corner on each side, whose width may have changed."""
    for i in range(first, last + 1):
        scratch.a[:] = line.waypoints[i]
        scratch.b[:] = line.waypoints[i + 1]
        if not motion_free(space, scratch.a, scratch.b, scratch):
            return False
    for corner in range(max(first - 2, 0), min(last + 2, len(line.half_widths))):
        if not _corner_is_free(space, line, corner, scratch):
            return False
    return True


@inner_kernel()
def _corner_is_free(space, line, corner, scratch):
    width = line.half_widths[corner]
    chords = min(max(int(np.ceil(2 * width / MAX_CHORD)), 2), MAX_CHORDS)
    for k in range(chords + 1):
        s = line.knots[corner + 1] + width * (2 * k / chords - 1)
        evaluate_at(line, s, 0, scratch.b)
        if k > 0 and not motion_free(space, scratch.a, scratch.b, scratch):
            return False
        scratch.a[:] = scratch.b
    return True


@kernel(nogil=True)
def free_deviations(space, path, deviation):
    """Deviations [n - 2] of the corners of a free polyline [n, dof]: each is `deviation`, halved until the
    rounded corner is free or the deviation is at most MIN_DEVIATION."""
    scratch = make_scratch(space, space.lower)
    out = np.full(len(path) - 2, deviation)
    for i in range(len(out)):
        while out[i] > MIN_DEVIATION:
            line = rounded_line(path, out)
            if _corner_is_free(space, line, i, scratch):
                break
            out[i] *= 0.5
    return out


MAX_CANDIDATES = 6
"""Largest number of candidates."""
# Attempts to make a candidate faster: when its path is offered, and each time that it is improved later.
FIRST_ATTEMPTS = 32
ATTEMPTS = 16
BEST_TURNS = 3
"""The fastest candidate is improved this many times in a row, then another candidate once."""
OPTIMALITY_TOLERANCE = 2e-3
"""A motion counts as optimal if its time exceeds the time that its slowest joint would need alone by at most
this fraction."""
ESTIMATE_ERROR = 1.02
"""Largest ratio of an estimated time to the exact time, approximately."""


def still_improves(
    history: Sequence[tuple[int, float]], work: int, now: float, gain: float, patience: int
) -> bool:
    """Whether more work is likely to reduce a cost further: the last doubling of the work reduced it by at
    least the fraction `gain`, or less work than `patience` was done.

    history: the work done and the cost, each time that the cost fell. work, now: the present
    work and cost.
    """
    half = [cost for after, cost in history if after <= work / 2]
    if work < patience or not half:
        return True
    return bool(half[-1] - now >= gain * half[-1])


def estimated_duration(path: Configurations, deviation: float, limits: tuple[Configuration, ...]) -> float:
    """The estimated time of a motion along a path [s]. The motion leaves the path's corners by at most
    `deviation`; limits are the velocity and acceleration limits [dof]."""
    path = with_corner(path)
    return float(estimated_time(rounded_line(path, np.full(len(path) - 2, deviation)), *limits))


def with_corner(path: Configurations) -> Configurations:
    """The path in float64; a path of one segment gets the segment's middle as a waypoint."""
    path = path.astype(np.float64)
    return np.insert(path, 1, path.mean(axis=0), axis=0) if len(path) == 2 else path


@dataclass
class Candidate:
    """A polyline with rounded corners."""

    path: Configurations
    deviations: Values
    """How far the motion may leave each inner waypoint [rad, joint-space L2]."""
    time: float
    """Its estimated duration, without limits of jerk [s]."""
    stage: str
    """The part of the planner that found the path."""

    @property
    def length(self) -> float:
        """Length of the path [rad, joint-space L2]."""
        return float(step_lengths(self.path).sum())


class TimeOptimization:
    """The fastest motions found so far near the paths that were offered."""

    def __init__(
        self,
        robot: Robot,
        settings: TimingSettings,
        start: Configuration,
        goals: Configurations,
        seed: int,
        longest: float = np.inf,
    ) -> None:
        """longest: length [rad, joint-space L2]. Once there is a candidate up to this length, longer
        candidates are dropped."""
        self._limits = scaled_limits(robot, settings)
        # no motion is faster than its slowest joint would be alone
        alone = [
            straight_line_time(start[[j]], goals[:, [j]], *(limits[[j]] for limits in self._limits))
            for j in range(len(start))
        ]
        self._bound = float(np.max(alone, axis=0).min())
        self._settings = settings
        self._state = random_state(seed, 1)
        self._longest = longest
        self._turn = 0
        self.candidates = list[Candidate]()
        """Fastest first."""
        self.attempts = 0
        """Number of attempts so far."""
        self.times = list[tuple[int, float]]()
        """Number of attempts and least time [s], each time that the least time fell."""

    @property
    def best(self) -> Candidate | None:
        """The candidate with the least estimated time."""
        return self.candidates[0] if self.candidates else None

    @property
    def optimal(self) -> bool:
        """Whether no motion to any goal can be faster by more than OPTIMALITY_TOLERANCE."""
        best = self.best
        threshold = (1 + OPTIMALITY_TOLERANCE) * self._bound
        return (
            best is not None
            and best.time <= ESTIMATE_ERROR * threshold
            and self.least_time(best) <= threshold
        )

    def offer(self, space: Space, path: Configurations, stage: str) -> None:
        """Add a path to the candidates if it is among the fastest. Its polyline must be free in `space`."""
        path = with_corner(path)
        deviations = free_deviations(space, path, self._settings.corner_deviation)
        time = float(estimated_time(rounded_line(path, deviations), *self._limits))
        candidate = Candidate(path, deviations, time, stage)
        self._improve(space, candidate, FIRST_ATTEMPTS)
        self.candidates.append(candidate)
        self._sort()

    def improve(self, space: Space) -> None:
        """Make ATTEMPTS attempts to make one candidate faster. In three of four calls it is the fastest one,
        in the fourth call another; the others take turns."""
        self._turn += 1
        runners_up = len(self.candidates) - 1
        cycle, turn = divmod(self._turn, BEST_TURNS + 1)
        chosen = 1 + cycle % runners_up if runners_up and turn == 0 else 0
        self._improve(space, self.candidates[chosen], ATTEMPTS)
        self._sort()

    def improves(self, gain: float, patience: int) -> bool:
        """`still_improves` for the least time and the number of attempts."""
        return still_improves(self.times, self.attempts, self.times[-1][1], gain, patience)

    def least_time(self, candidate: Candidate) -> float:
        """The exact time of the fastest motion without limits of jerk [s]."""
        line = rounded_line(candidate.path, candidate.deviations)
        return least_time(line, *self._limits, self._settings)

    def _improve(self, space: Space, candidate: Candidate, attempts: int) -> None:
        candidate.path, candidate.deviations, candidate.time = reduce_time(
            space,
            candidate.path,
            candidate.deviations,
            candidate.time,
            *self._limits,
            self._longest if candidate.length <= self._longest else np.inf,
            attempts,
            self._state,
        )
        self.attempts += attempts

    def _sort(self) -> None:
        short_candidates = [candidate for candidate in self.candidates if candidate.length <= self._longest]
        ordered = sorted(short_candidates or self.candidates, key=lambda candidate: candidate.time)
        self.candidates = ordered[:MAX_CANDIDATES]
        if not self.times or self.candidates[0].time < self.times[-1][1]:
            self.times.append((self.attempts, self.candidates[0].time))
