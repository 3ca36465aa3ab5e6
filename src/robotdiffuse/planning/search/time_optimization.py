"""The fastest motion near the paths of a search: a compiled local search on each of the most promising ones,
by random changes of its waypoints and corners.

The time of a candidate is that of the fastest motion along its rounded polyline, without limits of jerk.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.collision.kernels.lane_collision import make_workspace
from robotdiffuse.collision.kernels.motions import Space, motion_free
from robotdiffuse.collision.kernels.random import random, random_state
from robotdiffuse.collision.kernels.simd import W
from robotdiffuse.core.kernels import inner_kernel, kernel
from robotdiffuse.core.types import Configuration, Configurations
from robotdiffuse.robots.robot import Robot
from robotdiffuse.trajectories.speed_limits import TimingSettings, scaled_limits
from robotdiffuse.trajectories.straight_line import straight_line_time
from robotdiffuse.trajectories.timing_kernel import estimated_time, evaluate_at, least_time, rounded_line

# Of all attempts, the part up to REMOVE_SHARE removes a waypoint unless it is the only one, that up to
# ADD_SHARE adds one in the middle of a segment and moves it, and that up to WIDEN_SHARE changes a corner's
# deviation. All others move a waypoint, and half of them change its deviation too.
REMOVE_SHARE = 0.02
ADD_SHARE = 0.05
WIDEN_SHARE = 0.12
# Factor by which the deviation of a corner changes, and the most it may reach [rad, joint-space L2].
WIDENING = 1.5
MAX_DEVIATION = 1.0
# Longest move of a waypoint in each joint [rad], and the natural logarithm of its ratio to the shortest.
MAX_MOVE = 0.4
MOVE_LOG_RANGE = 5.0
REPEAT_FACTOR = 2.0
"""Length of the move that follows a successful one, in its direction."""
MIN_DEVIATION = 0.002
"""Corners are rounded with at least this deviation [rad]; the timing may round them less."""
MIN_SEGMENT = 0.005
"""Shortest segment [rad]."""
# A rounded corner is checked along chords of this length [rad], of which there are at most MAX_CHORDS.
MAX_CHORD = 0.05
MAX_CHORDS = 16


@kernel(nogil=True)
def reduce_time(space, path, deviations, time, velocity, acceleration, longest, tries, state):
    """A faster rounded polyline: its waypoints [m, dof], its deviations [m - 2] and its estimated time [s].

    path: waypoints [n, dof], n >= 3, whose polyline is free, as are its rounded corners; time: its estimated
    time; longest: bound on its length [rad, joint-space L2]. After a move that made it faster, the same
    waypoint moves on in the same direction.
    """
    dof = path.shape[1]
    work = make_workspace(space.robot, space.scene)
    block = np.empty((dof, W), np.float32)
    a = np.empty(dof, np.float32)
    b = np.empty(dof, np.float32)
    # a literal 0 would be compiled separately
    step = np.zeros(dof)
    moved = np.int64(0)
    for _ in range(tries):
        new, wider, first, last = _candidate(space, path, deviations, step, moved, state)
        moved = 0
        if len(new) == 0:
            continue
        line = rounded_line(new, wider)
        if line[1][-1] > longest:
            continue
        new_time = estimated_time(line, velocity, acceleration)
        if new_time < time and _is_free(space, line, first, last, a, b, block, work):
            if len(new) == len(path):
                step[:] = new[last] - path[last]
                moved = last if np.abs(step).max() > 0 else 0
            path = new
            deviations = wider
            time = new_time
    return path, deviations, time


@inner_kernel(inline="always")
def _candidate(space, path, deviations, step, again, state):
    """A change of the path or of its corners, and the first and the last segment that it touches; no
    waypoints if one of these is too short. Waypoint `again`, unless it is 0, moves on by `step`."""
    n, dof = path.shape
    kind = np.float32(1.0) if again else random(state)
    i = again if again else 1 + min(int(random(state) * (n - 2)), n - 3)
    if kind < REMOVE_SHARE and n > 3:
        new = np.empty((n - 1, dof))
        wider = np.empty(n - 3)
        new[:i] = path[:i]
        new[i:] = path[i + 1 :]
        wider[: i - 1] = deviations[: i - 1]
        wider[i - 1 :] = deviations[i:]
        return new, wider, i - 1, i - 1
    if kind < ADD_SHARE:
        i = 1 + min(int(random(state) * (n - 1)), n - 2)
        new = np.empty((n + 1, dof))
        wider = np.empty(n - 1)
        new[:i] = path[:i]
        new[i + 1 :] = path[i:]
        new[i] = 0.5 * (path[i - 1] + path[i])
        wider[: i - 1] = deviations[: i - 1]
        wider[i:] = deviations[i - 1 :]
        wider[i - 1] = deviations[min(i - 1, n - 3)]
    else:
        new = path.copy()
        wider = deviations.copy()
    if again:
        new[i] += REPEAT_FACTOR * step
    elif kind < ADD_SHARE or kind >= WIDEN_SHARE:
        size = MAX_MOVE * np.exp(-MOVE_LOG_RANGE * random(state))
        share = random(state)
        for j in range(dof):
            if random(state) < share:
                new[i, j] += size * (2.0 * random(state) - 1.0)
    for j in range(dof):
        new[i, j] = min(max(new[i, j], space.lower[j]), space.upper[j])
    if not again and kind >= ADD_SHARE and (kind < WIDEN_SHARE or random(state) < 0.5):
        change = WIDENING if random(state) < 0.75 else 1.0 / WIDENING
        wider[i - 1] = min(change * wider[i - 1], MAX_DEVIATION)
    for k in range(i - 1, i + 1):
        if ((new[k + 1] - new[k]) ** 2).sum() < MIN_SEGMENT**2:
            return np.empty((0, dof)), wider, 0, 0
    return new, wider, i - 1, i


@inner_kernel(inline="always")
def _is_free(space, line, first, last, a, b, block, work):
    """Whether segments `first` to `last` of the polyline are free, and the rounded corners at their ends and
    next to them."""
    waypoints = line[0]
    widths = line[3]
    for i in range(first, last + 1):
        a[:] = waypoints[i]
        b[:] = waypoints[i + 1]
        if not motion_free(space, a, b, block, work):
            return False
    for corner in range(max(first - 2, 0), min(last + 2, len(widths))):
        if not _corner_is_free(space, line, corner, a, b, block, work):
            return False
    return True


@inner_kernel()
def _corner_is_free(space, line, corner, a, b, block, work):
    waypoints, knots, directions, widths = line
    width = widths[corner]
    chords = min(max(int(np.ceil(2 * width / MAX_CHORD)), 2), MAX_CHORDS)
    for k in range(chords + 1):
        s = knots[corner + 1] + width * (2 * k / chords - 1)
        evaluate_at(waypoints, knots, directions, widths, s, 0, b)
        if k > 0 and not motion_free(space, a, b, block, work):
            return False
        a[:] = b
    return True


@kernel(nogil=True)
def free_deviations(space, path, deviation):
    """For each corner of a free polyline [n, dof], the largest of `deviation` and its halves for which the
    rounded corner is free [n - 2], and at least MIN_DEVIATION."""
    dof = path.shape[1]
    work = make_workspace(space.robot, space.scene)
    block = np.empty((dof, W), np.float32)
    a = np.empty(dof, np.float32)
    b = np.empty(dof, np.float32)
    out = np.full(len(path) - 2, deviation)
    for i in range(len(out)):
        while out[i] > MIN_DEVIATION:
            line = rounded_line(path, out)
            if _corner_is_free(space, line, i, a, b, block, work):
                break
            out[i] *= 0.5
    return out


MAX_CANDIDATES = 6
"""Largest number of candidates that are kept."""
# Attempts to make a candidate faster when it is offered, and later in turn.
FIRST_ATTEMPTS = 32
ATTEMPTS = 16
BEST_TURNS = 3
"""The fastest candidate has this many turns before another one has its own."""
OPTIMALITY_TOLERANCE = 2e-3
"""A motion is optimal if it takes longer than its slowest joint would alone by no more than this fraction."""
ESTIMATE_ERROR = 1.02
"""Estimated times are at most about this factor times the exact ones."""


def still_improves(
    history: Sequence[tuple[int, float]], work: int, now: float, gain: float, patience: int
) -> bool:
    """Whether the last doubling of the work reduced a cost to `now` by at least the fraction `gain`, or there
    was less work than `patience`. history: for each time that the cost fell, the work until then and the
    cost."""
    half = [cost for after, cost in history if after <= work / 2]
    if work < patience or not half:
        return True
    return bool(half[-1] - now >= gain * half[-1])


def estimated_duration(path: Configurations, deviation: float, limits: tuple[Configuration, ...]) -> float:
    """The estimated time of a motion along a path whose corners it leaves by at most `deviation`, with these
    limits of velocity and acceleration [s]."""
    path = with_corner(path)
    return float(estimated_time(rounded_line(path, np.full(len(path) - 2, deviation)), *limits))


def with_corner(path: Configurations) -> Configurations:
    """The path in float64; of a single segment with its middle as a waypoint."""
    path = path.astype(np.float64)
    return np.insert(path, 1, path.mean(axis=0), axis=0) if len(path) == 2 else path


@dataclass
class Candidate:
    """A polyline with rounded corners."""

    path: Configurations
    deviations: Float[ndarray, "corners"]
    """How far the motion may leave each inner waypoint [rad, joint-space L2]."""
    time: float
    """Its estimated duration, without limits of jerk [s]."""
    stage: str
    """The part of the planner that found the path."""

    @property
    def length(self) -> float:
        """Length of the path [rad, joint-space L2]."""
        return float(np.linalg.norm(np.diff(self.path, axis=0), axis=1).sum())


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
        """longest: once there is a candidate that is no longer than this, only such candidates are kept
        [rad]."""
        self._limits = scaled_limits(robot, settings)
        # no motion is faster than its slowest joint alone
        alone = [
            straight_line_time(start[[j]], goals[:, [j]], *(limits[[j]] for limits in self._limits))
            for j in range(len(start))
        ]
        self._bound = float(np.max(alone, axis=0).min())
        self._deviation = settings.corner_deviation
        self._intervals = settings.corner_intervals, settings.line_intervals
        self._state = random_state(seed, 1)
        self._longest = longest
        self._turn = 0
        self.candidates = list[Candidate]()
        """Fastest first."""
        self.attempts = 0
        """Number of attempts so far."""
        self.times = list[tuple[int, float]]()
        """The attempts after which the least time fell, and the least time [s]."""

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
            and self._least_time(best) <= threshold
        )

    def fastest(self) -> list[Candidate]:
        """The candidates, ordered by the exact time of the fastest motion without limits of jerk."""
        return sorted(self.candidates, key=self._least_time)

    def offer(self, space: Space, path: Configurations, stage: str) -> None:
        """Make a path whose polyline is free in `space` a candidate, if it is among the fastest."""
        path = with_corner(path)
        deviations = free_deviations(space, path, self._deviation)
        time = float(estimated_time(rounded_line(path, deviations), *self._limits))
        candidate = Candidate(path, deviations, time, stage)
        self._improve(space, candidate, FIRST_ATTEMPTS)
        self.candidates.append(candidate)
        self._sort()

    def improve(self, space: Space) -> None:
        """Spend ATTEMPTS on one of the candidates."""
        self._turn += 1
        runners_up = len(self.candidates) - 1
        turn, rest = divmod(self._turn, BEST_TURNS + 1)
        chosen = self.candidates[1 + turn % runners_up if runners_up and rest == 0 else 0]
        self._improve(space, chosen, ATTEMPTS)
        self._sort()

    def improves(self, gain: float, patience: int) -> bool:
        """Whether to go on: the last doubling of the number of attempts reduced the least time by at least
        the fraction `gain`, or there were fewer than `patience` attempts."""
        return still_improves(self.times, self.attempts, self.times[-1][1], gain, patience)

    def _least_time(self, candidate: Candidate) -> float:
        line = rounded_line(candidate.path, candidate.deviations)
        return least_time(line, *self._limits, *self._intervals)

    def _improve(self, space: Space, candidate: Candidate, attempts: int) -> None:
        reduced = reduce_time(
            space,
            candidate.path,
            candidate.deviations,
            candidate.time,
            *self._limits,
            self._longest if candidate.length <= self._longest else np.inf,
            attempts,
            self._state,
        )
        candidate.path, candidate.deviations, candidate.time = reduced[0], reduced[1], float(reduced[2])
        self.attempts += attempts

    def _sort(self) -> None:
        short_candidates = [candidate for candidate in self.candidates if candidate.length <= self._longest]
        ordered = sorted(short_candidates or self.candidates, key=lambda candidate: candidate.time)
        self.candidates = ordered[:MAX_CANDIDATES]
        if not self.times or self.candidates[0].time < self.times[-1][1]:
            self.times.append((self.attempts, self.candidates[0].time))
