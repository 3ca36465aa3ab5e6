"""RRT-Connect and AORRTC: rounds of two trees at falling clearances, each below the length of the best path.

Each round of AORRTC grows new trees with paths little longer than the best one known. The path that a round
finds is simplified and tightened; if it is the shortest, it bounds the next round. RRT-Connect restarts
without a bound.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.collision.kernels.compiled import random_state
from robotdiffuse.collision.kernels.motions import motions_free, path_length
from robotdiffuse.collision.motions import finer_resolution
from robotdiffuse.core.bounds import for_kernels
from robotdiffuse.core.loading import loading
from robotdiffuse.core.results import PlanResult
from robotdiffuse.core.settings import Bound, Count, Natural, NotNegative, Positive, Settings
from robotdiffuse.core.types import Tree
from robotdiffuse.planning import CLEARANCE, PATH_CONSTRAINTS
from robotdiffuse.planning.context import DEFAULT_CLEARANCE, PlanningContext
from robotdiffuse.planning.planner import Planner
from robotdiffuse.planning.search import rrt_kernel
from robotdiffuse.planning.search.anytime import anytime
from robotdiffuse.planning.search.time_optimization import TimeOptimization, still_improves
from robotdiffuse.planning.start_goal import StartGoal
from robotdiffuse.trajectories.simplification import simplify, tighten

MIN_CLEARANCE = 0.002
"""Clearance that is tried even if none is requested [m]: telling contact from near contact is costly, and
paths are hardly longer."""
FALLING_FRACTIONS = (1.0, 0.5, 0.25)
"""Fractions of a clearance that are tried; after those of one above the default clearance, the default's."""
ITERATIONS_PER_CLEARANCE = 400
"""Iterations at a clearance before the next lower one is tried."""
FALLBACK_INTERVAL = 8_000
"""Iterations without a path between two calls of the fallback."""
BOUND_FACTOR = 1.15
"""The length bound of a round is this factor of the best length: unsimplified tree paths are longer than
simplified ones, so with a tight bound the trees would miss shorter ways than a long detour."""
IMPROVEMENT_STEP = 1_000
"""Iterations of AORRTC between two checks whether to search on."""
TIGHTENING_FACTOR = 1.05
"""Paths longer than this factor of the best length are not tightened: tightening shortens by less."""
OPTIMALITY_TOLERANCE = 1e-4
"""A path that exceeds the straight line by no more than this part is optimal."""
NEAR_FACTOR = 1.3
"""Paths up to this factor of the best length may become the fastest motion."""


@dataclass(frozen=True)
class SearchSettings(Settings):
    """The settings that RRT-Connect and AORRTC share."""

    range: Positive = 0.7
    """Longest extension of a tree [rad, joint-space L2]: longer ones collide more often."""
    resolution: Positive = 0.05
    """No point of the arm moves further than this between two checks of a motion [m]; the validator's
    certificate covers the rest. The search halves it after a path that the validator refuses."""
    smoothings: Natural = 1
    """Rounds of smoothing for each path found."""
    tightenings: Natural = 200
    """Attempts to shorten each path but the first by small moves of its waypoints."""
    iterations: Count = 20_000
    """Most iterations of a round; its trees hold at most as many nodes."""
    keep_trees: bool = False
    """Whether results hold the trees of the search, for drawing."""


class AnytimeSearch:
    """Rounds of RRT-Connect between a start and goals, and the best path so far.

    The same seed gives the same rounds; `stop` only ends them.
    """

    clock_interval = 100
    """Iterations between two calls of `stop`."""
    spare_nodes = 0
    """Nodes that an iteration may add to a tree besides one."""
    limits: tuple | None = None
    """Path constraints that the edges of trees keep."""

    def __init__(
        self,
        start_goal: StartGoal,
        settings: SearchSettings,
        name: str,
        seed: int,
        clearances: Sequence[float],
        bounded: bool = True,
        tries: int = ITERATIONS_PER_CLEARANCE,
        stop: Callable[[], bool] = lambda: False,
        improved: Callable[[float], None] = lambda length: None,
    ) -> None:
        """
        name: the stage that results name for paths found here.
        clearances: clearances to try, falling [m].
        bounded: whether rounds search below a bound on length (AORRTC); False: they are restarts.
        tries: iterations without a path before the next clearance is tried.
        improved: called with the length [rad] of each path that is the best so far.
        """
        self.start_goal = start_goal
        self.settings = settings
        self.name = name
        self.bounded = bounded
        self.start, self.goals = start_goal.rows()
        self.best: Float[ndarray, "n dof"] | None = None
        """The shortest path so far, free at the resolution of the search."""
        self.length = np.float32(np.inf)
        self.stage = ""
        """The stage that it comes from."""
        self.work = 0
        """Iterations so far."""
        self.found = 0
        """Number of paths that the search found."""
        self.history = list[tuple[ndarray, str]]()
        """Each path that was the shortest when it was found, and its stage."""
        self.motions: TimeOptimization | None = None
        """The fastest motions near the paths found, if the objective is time."""
        self._lengths = list[tuple[int, float]]()
        self._untightened = False
        """Whether the best path is not tightened yet: the first one is, once there is time to improve it."""
        self._state = random_state(seed)
        self._trees: rrt_kernel.Trees | None = None
        self._round_end = 0
        """The work at which the trees are given up."""
        self._grown: rrt_kernel.Trees | None = None
        """The trees that found the shortest path of the search; those that grow until there is one."""
        self._clearances = clearances
        self._tries = tries
        self._stop = stop
        self._improved = improved
        self._set_level(0)

    @classmethod
    def of(
        cls,
        context: PlanningContext,
        start_goal: StartGoal,
        settings: SearchSettings,
        name: str,
        bounded: bool = True,
    ) -> "AnytimeSearch":
        """The search of a call of a planner, which ends with the call's time."""
        return cls(
            start_goal,
            settings,
            name,
            context.request.seed,
            usual_clearances(context.clearance),
            bounded,
            stop=lambda: context.remaining <= 0,
            improved=context.improved,
        )

    @property
    def clearance(self) -> float:
        """The distance to obstacles that paths keep, except near the start and the goals [m]."""
        return self._clearances[self._level]

    @property
    def shortest(self) -> bool:
        """Whether no path to any goal can be shorter."""
        return self._near_straight(OPTIMALITY_TOLERANCE)

    def _near_straight(self, part: float) -> bool:
        """Whether the best path exceeds the straight line by no more than this part."""
        straight = np.linalg.norm(self.goals - self.start, axis=1).min()
        return bool(self.length <= straight * (1 + part))

    @property
    def trees(self) -> tuple[Tree, ...]:
        """See `PlanResult.trees`."""
        if self._grown is None or not self.settings.keep_trees:
            return ()
        grown = self._grown
        return tuple(
            Tree(grown.nodes[i, :n].copy(), grown.parents[i, :n].copy()) for i, n in enumerate(grown.sizes)
        )

    def first(self, fallback: Callable[[], None] | None = None, work: float = np.inf) -> bool:
        """Search for a first path, for at most `work` more iterations; returns whether there is a path.

        fallback: called each time that all clearances failed.
        """
        if self.best is None:
            self._try_straight_lines()
        enough = self.work + work
        while self.best is None and self.work < enough and not self._stop():
            self._iterate()
            if self.best is None and self._tried >= self._tries:
                self._lower_clearance(fallback)
        return self.best is not None

    def improve(self, work: float) -> None:
        """Search for shorter paths, for at most `work` more iterations, or until the path is optimal."""
        enough = self.work + work
        if self._untightened and self.best is not None:
            self.offer(self.best, self.stage)
            self._untightened = False
        while not self.shortest and self.work < enough and not self._stop():
            self._iterate()

    def improves(self, gain: float, patience: int) -> bool:
        """Whether to search on: the last doubling of the work shortened the path by at least the part `gain`,
        or there were fewer than `patience` iterations."""
        return still_improves(self._lengths, self.work, float(self.length), gain, patience)

    def offer(self, path: Float[ndarray, "n dof"], stage: str) -> bool:
        """Simplify a path from the start to a goal, free in `space`, and keep it if it is the shortest so
        far; returns whether it was."""
        path = for_kernels(path, np.float32)
        settings = self.settings
        path = simplify(self.space, path, settings.smoothings)
        length = path_length(path)
        if self.best is None:
            self._untightened = True
        elif length < TIGHTENING_FACTOR * self.length:
            path = tighten(self.space, path, settings.tightenings, self._state)
            length = path_length(path)
        if self.motions is not None and length < NEAR_FACTOR * self.length:
            self.motions.offer(self.space, path, stage)
        return bool(length < self.length) and self._take(path, float(length), stage)

    def _take(self, path: Float[ndarray, "n dof"], length: float, stage: str) -> bool:
        """Make a path the best one."""
        self.best, self.length, self.stage = path, np.float32(length), stage
        self.history.append((path, stage))
        self._lengths.append((self.work, length))
        self._trees = None
        self._improved(length)
        return True

    def keeps_clearance(self, q: Float[ndarray, "n dof"]) -> bool:
        """Whether the polyline through configurations keeps the clearance of the search."""
        rows = np.ascontiguousarray(q if len(q) > 1 else np.repeat(q, 2, axis=0), np.float32)
        return bool(motions_free(self.space, rows).all())

    def refuse(self, accepted: Float[ndarray, "n dof"] | None) -> None:
        """Halve the resolution after the validator refused the best path, and go back to the last accepted
        one."""
        self.settings = replace(self.settings, resolution=finer_resolution(self.settings.resolution))
        self.best = accepted
        self.length = np.float32(np.inf if accepted is None else path_length(accepted))
        self._trees = None
        self._set_level(self._level)

    def _set_level(self, level: int) -> None:
        self._level, self._tried = level, 0
        self.space = self.start_goal.space(self.settings.resolution, self.clearance)

    def _lower_clearance(self, fallback: Callable[[], None] | None) -> None:
        """Go to the next lower clearance, at which the trees stay valid; call the fallback after the lowest
        one."""
        if self._level < len(self._clearances) - 1:
            self._set_level(self._level + 1)
            self._try_straight_lines()
        else:
            self._tried = self._tries - FALLBACK_INTERVAL
            if fallback is not None and self.work >= FALLBACK_INTERVAL:
                fallback()

    def _try_straight_lines(self) -> None:
        for goal in sorted(self.goals, key=lambda goal: float(np.linalg.norm(goal - self.start))):
            path = self._line(goal)
            if len(path) and self.offer(path, "straight_line"):
                self.found += 1
                return

    def _line(self, goal: Float[ndarray, "dof"]) -> Float[ndarray, "n dof"]:
        """The edge from the start to a goal; without rows if there is none."""
        path = np.stack([self.start, goal])
        return path if motions_free(self.space, path).all() else path[:0]

    def _iterate(self) -> None:
        """Run some iterations of a round, and offer the path that they find."""
        most, trees = self.settings.iterations, self._trees
        capacity = most + len(self.goals) + 2 * self.spare_nodes
        if trees is None or self.work >= self._round_end or trees.sizes.max() + self.spare_nodes >= capacity:
            trees = self._trees = rrt_kernel.make_trees(self.start, self.goals, capacity)
            self._round_end = self.work + most
        bound = np.float32(BOUND_FACTOR * self.length if self.bounded else np.inf)
        longest = np.float32(self.settings.range)
        path = rrt_kernel.search(
            self.space, self.limits, trees, bound, longest, self.clock_interval, self._state
        )
        self.work += self.clock_interval
        self._tried += self.clock_interval
        if self.best is None:
            self._grown = trees
        if len(path):
            self.found += 1
            self._trees = None
            if self.offer(path, self.name):
                self._grown = trees


def usual_clearances(wanted: float) -> list[float]:
    """The clearances that a search tries one after the other [m]: the wanted one and fractions of it, the
    default one's if that is less, MIN_CLEARANCE and 0."""
    falling = [share * wanted for share in FALLING_FRACTIONS]
    if wanted > DEFAULT_CLEARANCE:
        usual = [share * DEFAULT_CLEARANCE for share in FALLING_FRACTIONS]
        falling = [*(clearance for clearance in falling if clearance > DEFAULT_CLEARANCE), *usual]
    return [*(clearance for clearance in falling if clearance > MIN_CLEARANCE), MIN_CLEARANCE, 0.0]


@dataclass(frozen=True)
class AORRTCSettings(SearchSettings, name="aorrtc"):
    gain: Annotated[float, Bound(least=0.0, below=1.0)] = 0.0025
    """With until "converged", the search ends when doubling its work shortened the path by less than this
    part ..."""
    patience: Natural = 16_000
    """... but not before this many iterations."""


@dataclass(frozen=True)
class RRTConnectSettings(SearchSettings, name="rrt_connect"):
    searches: Count = 2
    """With until "converged": number of paths to find; the shortest is returned."""
    optimize_time: NotNegative = 0.0
    """With until "converged": time for restarts after the first path [s]."""


class AORRTC(Planner[AORRTCSettings]):
    """Asymptotically optimal RRT-Connect (T. Wilson et al., 2025), anytime."""

    name = "aorrtc"
    settings_class = AORRTCSettings
    supports = frozenset({PATH_CONSTRAINTS, CLEARANCE})

    def solve(self, context: PlanningContext, start_goal: StartGoal) -> PlanResult:
        """See `planning.planner.Planner`."""
        settings = self.settings
        if context.problem.constraints:
            return plan_constrained(context, start_goal, settings)
        search = AnytimeSearch.of(context, start_goal, settings, self.name)
        return anytime(
            context,
            search,
            lambda: search.improves(settings.gain, settings.patience),
            lambda: search.improve(IMPROVEMENT_STEP),
        )


class RRTConnect(Planner[RRTConnectSettings]):
    """Two trees grown towards each other (Kuffner and LaValle, 2000), simplified; restarts while time is
    left."""

    name = "rrt_connect"
    settings_class = RRTConnectSettings
    supports = frozenset({PATH_CONSTRAINTS, CLEARANCE})

    def solve(self, context: PlanningContext, start_goal: StartGoal) -> PlanResult:
        """See `planning.planner.Planner`."""
        settings = self.settings
        if context.problem.constraints:
            return plan_constrained(context, start_goal, settings)
        search = AnytimeSearch.of(context, start_goal, settings, self.name, bounded=False)

        def improves() -> bool:
            restarts_end = context.first_path_at + settings.optimize_time
            return search.found < settings.searches or context.elapsed < restarts_end

        return anytime(context, search, improves, lambda: search.improve(search.clock_interval))


def plan_constrained(context: PlanningContext, start_goal: StartGoal, settings: SearchSettings) -> PlanResult:
    """Plan for a problem with path constraints."""
    with loading():
        from robotdiffuse.planning.search.constrained import PATHS_TO_FIND, ConstrainedSearch

    search = ConstrainedSearch(context, start_goal, settings)
    return anytime(
        context, search, lambda: search.found < PATHS_TO_FIND, lambda: search.improve(search.clock_interval)
    )
