"""The fastest motion near the paths of a search: a local search on each of the most promising ones."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.collision.kernels.compiled import random_state
from robotdiffuse.collision.kernels.motions import Space
from robotdiffuse.planning.search.time_optimization_kernel import free_deviations, reduce_time
from robotdiffuse.robots.robot import Robot
from robotdiffuse.trajectories.speed_limits import TimingSettings, scaled_limits
from robotdiffuse.trajectories.straight_line import straight_line_time
from robotdiffuse.trajectories.timing_kernel import estimated_time, least_time, rounded_line

MAX_CANDIDATES = 6
"""Candidates that are kept."""
FIRST_ATTEMPTS, ATTEMPTS = 32, 16
"""Attempts to make a candidate faster when it is offered, and later in turn."""
BEST_TURNS = 3
"""The fastest candidate has this many turns before another one has its own."""
OPTIMALITY_TOLERANCE = 2e-3
"""A motion that takes longer than one joint by itself by no more than this part is optimal."""
ESTIMATE_ERROR = 1.02
"""Estimated times are greater than exact ones by no more than about this factor."""


def still_improves(
    history: Sequence[tuple[int, float]], work: int, now: float, gain: float, patience: int
) -> bool:
    """Whether the last doubling of the work reduced a cost to `now` by at least the part `gain`, or there was
    less work than `patience`. history: the work after which the cost fell, and the cost then."""
    half = [cost for after, cost in history if after <= work / 2]
    if work < patience or not half:
        return True
    return bool(half[-1] - now >= gain * half[-1])


def estimated_duration(
    path: Float[ndarray, "n dof"], deviation: float, limits: tuple[Float[ndarray, "dof"], ...]
) -> float:
    """The estimated time of a motion along a path whose corners it leaves by at most `deviation`, with these
    limits of velocity and acceleration [s]."""
    path = with_corner(path)
    return float(estimated_time(rounded_line(path, np.full(len(path) - 2, deviation)), *limits))


def with_corner(path: Float[ndarray, "n dof"]) -> Float[ndarray, "m dof"]:
    """The path in float64; of a single segment with its middle as a waypoint."""
    path = path.astype(np.float64)
    return np.insert(path, 1, path.mean(axis=0), axis=0) if len(path) == 2 else path


@dataclass
class Candidate:
    """A polyline with rounded corners."""

    path: Float[ndarray, "n dof"]
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
        start: Float[ndarray, "dof"],
        goals: Float[ndarray, "k dof"],
        seed: int,
        longest: float = np.inf,
    ) -> None:
        """longest: candidates that are no longer than this stay so, and once there is one, only such are kept
        [rad]."""
        self._limits = scaled_limits(robot, settings)
        # no motion is faster than the joint that needs most time is by itself
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
        """Attempts so far."""
        self.times = list[tuple[int, float]]()
        """The attempts after which the least time fell, and the least time [s]."""

    @property
    def best(self) -> Candidate | None:
        """The candidate with the least estimated time."""
        return self.candidates[0] if self.candidates else None

    @property
    def optimal(self) -> bool:
        """Whether no motion to any goal can be faster by more than OPTIMALITY_TOLERANCE."""
        best, most = self.best, (1 + OPTIMALITY_TOLERANCE) * self._bound
        return best is not None and best.time <= ESTIMATE_ERROR * most and self._least_time(best) <= most

    def fastest(self) -> list[Candidate]:
        """The candidates, ordered by the exact time of the fastest motion without limits of jerk."""
        return sorted(self.candidates, key=self._least_time)

    def offer(self, space: Space, path: Float[ndarray, "n dof"], stage: str) -> None:
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
        others = len(self.candidates) - 1
        turn, rest = divmod(self._turn, BEST_TURNS + 1)
        chosen = self.candidates[1 + turn % others if others and rest == 0 else 0]
        self._improve(space, chosen, ATTEMPTS)
        self._sort()

    def improves(self, gain: float, patience: int) -> bool:
        """Whether to go on: the last doubling of the attempts reduced the least time by at least the part
        `gain`, or there were fewer than `patience` attempts."""
        return still_improves(self.times, self.attempts, self.times[-1][1], gain, patience)

    def _least_time(self, candidate: Candidate) -> float:
        line = rounded_line(candidate.path, candidate.deviations)
        return least_time(line, *self._limits, *self._intervals)

    def _improve(self, space: Space, candidate: Candidate, attempts: int) -> None:
        found = reduce_time(
            space,
            candidate.path,
            candidate.deviations,
            candidate.time,
            *self._limits,
            self._longest if candidate.length <= self._longest else np.inf,
            attempts,
            self._state,
        )
        candidate.path, candidate.deviations, candidate.time = found[0], found[1], float(found[2])
        self.attempts += attempts

    def _sort(self) -> None:
        short = [candidate for candidate in self.candidates if candidate.length <= self._longest]
        ordered = sorted(short or self.candidates, key=lambda candidate: candidate.time)
        self.candidates = ordered[:MAX_CANDIDATES]
        if not self.times or self.candidates[0].time < self.times[-1][1]:
            self.times.append((self.attempts, self.candidates[0].time))
