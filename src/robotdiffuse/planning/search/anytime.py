"""The anytime loop of the search planners: find a first path, improve it, and validate paths on the way.

With the objective "length" a call returns the shortest path found. With "time", every path found is also
the start of a local search for a faster motion, and the call returns the motion that takes the least time.
Under path constraints there is no such local search: each path that is estimated to be the fastest so far is
timed, and the call returns the fastest of these motions.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy import ndarray

from robotdiffuse.core.results import PlanResult
from robotdiffuse.core.types import FIRST, TIME, TIME_LIMIT
from robotdiffuse.planning.context import PlanningContext
from robotdiffuse.planning.search.time_optimization import Candidate, TimeOptimization
from robotdiffuse.problems.goals import AnyGoal, JointGoal

if TYPE_CHECKING:
    from robotdiffuse.planning.search.rrt import AnytimeSearch

VALIDATION_INTERVAL = 4_000
"""Iterations between two validations of shorter paths. Validating only at the end could lose everything found
since the last valid path."""
ATTEMPTS_PER_ITERATION = 0.2
"""Attempts to make a motion faster per iteration of the search; both then take about the same time."""
ATTEMPTS_AFTER_SEARCH = 200
"""Attempts between two checks whether to go on, once the search has ended."""
TIME_GAIN, TIME_PATIENCE = 0.0025, 1_600
"""With until "converged", attempts end when doubling them reduced the time by less than this part, but not
before this many."""
MIN_TIME_GAIN = 0.01
"""A faster motion is validated before the search ends if its estimated time is less by this part."""
MAX_DETOUR = 1.05
"""To a pose, whose nearest configuration a straight line reaches, motions are at most this factor longer."""
FINAL_CANDIDATES = 2
"""Number of valid motions of which the fastest is returned, if there is time to validate as many."""


class _Validation:
    """The best validated result of a search, and which of its paths was validated when."""

    def __init__(self, context: PlanningContext, search: "AnytimeSearch") -> None:
        self.context, self.search = context, search
        self.best: PlanResult | None = None
        self._by_time = context.request.objective == TIME
        self._path: ndarray | None = None
        self._shortest: PlanResult | None = None
        """The last valid path of the search, and its result."""
        self._timed = list[ndarray]()
        """The paths of the search that were validated."""
        self._validated_at = 0
        self._late = False
        """Whether a path was validated after the time for searching had run out."""

    @property
    def due(self) -> bool:
        """Whether to validate now: the first path at once, better ones every VALIDATION_INTERVAL iterations,
        or at once under path constraints."""
        interval = 0 if self.context.problem.constraints else VALIDATION_INTERVAL
        rested = self.search.work >= self._validated_at + interval
        return self.best is None or (rested and self._improved())

    def _improved(self) -> bool:
        motions = self.search.motions
        if motions is None or motions.best is None:
            return self.search.best is not self._path
        return motions.best.time < (1 - MIN_TIME_GAIN) * _duration(self.best)

    def run(self) -> bool:
        """Validate the best path of the search; if it is refused, the search goes back to the last valid one.

        Returns whether there is a valid path to answer with.
        """
        search, motions = self.search, self.search.motions
        assert search.best is not None
        self._validated_at = search.work
        self._late = self.context.remaining <= 0
        if motions is not None and motions.best is not None and (self.best is not None or self._late):
            self._accepts_motion(motions.best)
        if motions is not None and self.best is not None:
            return True
        if search.best is self._path or self._accepts(search.best, search.stage):
            return True
        if self.context.remaining <= 0 and self.best is None:
            # no time to search on: try the path before it
            return any(self._accepts(*before) for before in search.history[-2:-1])
        search.refuse(self._path)
        return False

    def run_last(self) -> None:
        """Make the best result the fastest of the best motions found and of the shortest path's.

        Results before these count only if time ran out, or else the clock would decide which is returned.
        """
        search, motions, before = self.search, self.search.motions, self.best
        if before is None or self.context.ended or self._late:
            return
        if motions is None:
            for path, stage in reversed(search.history if self.context.problem.constraints else ()):
                if self.context.remaining > 0 and not any(path is timed for timed in self._timed):
                    self._accepts(path, stage)
            return
        self.best = None
        accepted = 0
        for candidate in motions.fastest():
            accepted += self._accepts_motion(candidate)
            if accepted == FINAL_CANDIDATES or self.context.remaining <= 0:
                break
        if self.context.remaining > 0 and search.best is not None:
            if search.best is self._path:
                self._keep(self._shortest)
            else:
                self._accepts(search.best, search.stage)
        if self.best is None or self.context.remaining <= 0:
            self._keep(before)

    def _accepts(self, path: ndarray, stage: str) -> bool:
        self._timed.append(path)
        paths = [self.search.start_goal.complete(path, direct) for direct in (True, False)]
        result = None
        if len(paths[0]) < len(paths[1]):  # covering spheres touch at an end, but the meshes may be free
            result = self._finished(paths[0], stage, None)
        if result is None:
            result = self._finished(paths[1], stage, None)
        if result is not None:
            self._path, self._shortest = path, result
        return result is not None

    def _accepts_motion(self, candidate: Candidate) -> bool:
        start_goal, most = self.search.start_goal, self.context.timing.corner_deviation
        path = start_goal.complete(candidate.path)
        # the exact start or goal may be added beside the ends of the search
        deviations = np.full(len(path), most)
        begins = start_goal.start_lead
        assert begins is not None  # else there would be no path
        first = 1 if np.array_equal(begins, start_goal.start) else 2
        deviations[first : first + len(candidate.deviations)] = candidate.deviations
        return self._finished(path, candidate.stage, deviations) is not None

    def _finished(self, path: ndarray, stage: str, deviations: ndarray | None) -> PlanResult | None:
        """Validate and time a path, and keep its result."""
        search, wanted = self.search, self.context.clearance
        keeps = search.keeps_clearance
        notes = ()
        if search.clearance < wanted:
            kept, asked = 100 * search.clearance, 100 * wanted
            notes = (
                f"searched with a clearance of {kept:.2g} cm, not {asked:.2g} cm: "
                "no path was found with that",
            )
        result = self.context.finish(path, stage, notes=notes, keeps=keeps, deviations=deviations)
        self._keep(result)
        return result

    def _keep(self, result: PlanResult | None) -> None:
        """Make a result the best one, unless its motion takes longer and the objective is time."""
        if result is not None and (not self._by_time or _duration(result) < _duration(self.best)):
            self.best = result


def _duration(result: PlanResult | None) -> float:
    return np.inf if result is None or result.duration is None else result.duration


def anytime(
    context: PlanningContext,
    search: "AnytimeSearch",
    improves: Callable[[], bool],
    improve: Callable[[], None],
    fallback: Callable[[], None] | None = None,
) -> PlanResult:
    """Search for a path, and for better ones for as long as the call's `until` says.

    improves: whether more time is still likely to shorten the path.
    improve: spends some time on shorter paths.
    fallback: may offer paths where the search finds none at any clearance.
    """
    request, problem = context.request, context.problem
    if request.objective == TIME and request.until != FIRST and not problem.constraints:
        straight = float(np.linalg.norm(search.goals - search.start, axis=1).min())
        several = problem.goal.goals if isinstance(problem.goal, AnyGoal) else (problem.goal,)
        given = all(isinstance(goal, JointGoal) for goal in several)
        longest = np.inf if given else MAX_DETOUR * straight
        search.motions = TimeOptimization(
            problem.robot, context.timing, search.start, search.goals, request.seed, longest
        )
    motions = search.motions

    def searches() -> bool:
        return not search.shortest and (request.until == TIME_LIMIT or improves())

    def optimizes() -> bool:
        if motions is None or not motions.candidates:
            return False
        return request.until == TIME_LIMIT or motions.improves(TIME_GAIN, TIME_PATIENCE)

    def ended() -> bool:
        if request.until == FIRST or context.remaining <= 0 or (motions is not None and motions.optimal):
            return True
        return not (searches() or optimizes())

    validation = _Validation(context, search)
    while search.first(fallback):
        done = ended()
        if done and motions is not None and validation.best is not None:
            break
        if done or (context.validates_early and validation.due):
            if validation.run() and ended():
                break
            if validation.best is None and context.remaining <= 0:
                break
        else:
            searching = searches()
            if searching:
                improve()
            if motions is not None:
                share = ATTEMPTS_PER_ITERATION * search.work
                wanted = share if searching else motions.attempts + ATTEMPTS_AFTER_SEARCH
                while motions.attempts < wanted and context.remaining > 0 and motions.candidates:
                    motions.improve(search.space)
    validation.run_last()
    return replace(validation.best or context.unsolved(), trees=search.trees)
