"""A search that goes on after its first path: rounds of two trees, at falling clearances and below the length
of the best path."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.collision.kernels.compiled import random_state
from robotdiffuse.collision.kernels.motions import motions_free, path_length
from robotdiffuse.collision.motions import finer_resolution
from robotdiffuse.core.bounds import for_kernels
from robotdiffuse.core.settings import Count, Natural, Positive, Settings
from robotdiffuse.core.types import Tree
from robotdiffuse.planning.context import DEFAULT_CLEARANCE, PlanningContext
from robotdiffuse.planning.search import rrt_kernel
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
CLOCK_INTERVAL = 100
"""Iterations between two readings of the clock."""
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
    """Rounds of RRT-Connect between the start and the goals of a call, and the best path so far.

    The same seed gives the same rounds; the clock only ends them.
    """

    def __init__(
        self,
        context: PlanningContext,
        start_goal: StartGoal,
        settings: SearchSettings,
        name: str,
        bounded: bool = True,
        clearances: Sequence[float] = (),
        tries: int = ITERATIONS_PER_CLEARANCE,
    ) -> None:
        """
        name: the stage that results name for paths found here.
        bounded: whether rounds search below a bound on length (AORRTC); False: they are restarts.
        clearances: clearances to try, falling, in place of the call's and fractions of it [m].
        tries: iterations without a path before the next clearance is tried.
        """
        self.context, self.start_goal, self.settings, self.name, self.bounded = (
            context,
            start_goal,
            settings,
            name,
            bounded,
        )
        self.start, self.goals = start_goal.rows()
        self.best: Float[ndarray, "n dof"] | None = None
        """The shortest path so far, free at the resolution of the search."""
        self.length = np.float32(np.inf)
        self.stage = ""
        """The stage that it comes from."""
        self.work = 0
        """Iterations so far."""
        self.first_at = np.inf
        """When the first path was found [s since the call]."""
        self.found = 0
        """Number of paths that the search found."""
        self.history = list[tuple[ndarray, str]]()
        """Each path that was the shortest when it was found, and its stage."""
        self.motions: TimeOptimization | None = None
        """The fastest motions near the paths found, if the objective is time."""
        self._lengths = list[tuple[int, float]]()
        self._untightened = False
        """Whether the best path is not tightened yet: the first one is, once there is time to improve it."""
        self._state = random_state(context.request.seed)
        self._round: _Round | None = None
        self._grown: rrt_kernel.Trees | None = None
        """The trees that found the shortest path of the search; those that grow until there is one."""
        usual = usual_clearances(context.clearance)
        self._clearances, self._tries = [*clearances] or usual, tries
        self._set_level(0)

    @property
    def clearance(self) -> float:
        """The distance to obstacles that paths keep, except near the start and the goals [m]."""
        return self._clearances[self._level]

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes for the result on the clearance."""
        if self.clearance >= self.context.clearance:
            return ()
        kept, asked = 100 * self.clearance, 100 * self.context.clearance
        return (
            f"searched with a clearance of {kept:.2g} cm, not {asked:.2g} cm: no path was found with that",
        )

    @property
    def shortest(self) -> bool:
        """Whether no path to any goal can be shorter."""
        straight = np.linalg.norm(self.goals - self.start, axis=1).min()
        return bool(self.length <= straight * (1 + OPTIMALITY_TOLERANCE))

    @property
    def trees(self) -> tuple[Tree, ...]:
        """See `PlanResult.trees`."""
        if self._grown is None or not self.settings.keep_trees:
            return ()
        grown = self._grown
        return tuple(
            Tree(grown.nodes[i, :n].copy(), grown.parents[i, :n].copy()) for i, n in enumerate(grown.sizes)
        )

    def first(self, until: float, fallback: Callable[[], None] | None = None, work: float = np.inf) -> bool:
        """Search for a first path until `until` [s since the call], for at most `work` more iterations.

        Returns whether there is a path. `fallback` is called each time that all clearances failed.
        """
        self._try_straight_lines()
        enough = self.work + work
        while self.best is None and self.context.elapsed < until and self.work < enough:
            self._iterate()
            if self.best is None and self._tried >= self._tries:
                self._lower_clearance(fallback)
        return self.best is not None

    def improve(self, until: float, work: float = np.inf) -> None:
        """Search for shorter paths until `until` [s since the call], for at most `work` more iterations, or
        until the path is optimal."""
        enough = self.work + work
        if self._untightened and self.best is not None:
            self.offer(self.best, self.stage)
            self._untightened = False
        while not self.shortest and self.context.elapsed < until and self.work < enough:
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
        if self.best is None:
            self.first_at = self.context.elapsed
        self.best, self.length, self.stage = path, np.float32(length), stage
        self.history.append((path, stage))
        self._lengths.append((self.work, length))
        self._round = None
        self.context.improved(length)
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
        self._round = None
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
            line = np.stack([self.start, goal])
            if motions_free(self.space, line).all() and self.offer(line, "straight_line"):
                return

    def _iterate(self) -> None:
        """Run some iterations of a round, and offer the path that they find."""
        settings = self.settings
        now = self._round
        if now is None or now.left <= 0 or now.trees.sizes.max() >= now.trees.nodes.shape[1]:
            trees = rrt_kernel.make_trees(self.start, self.goals, settings.iterations + len(self.goals))
            now = self._round = _Round(trees, settings.iterations)
        bound = np.float32(BOUND_FACTOR * self.length if self.bounded else np.inf)
        longest = np.float32(settings.range)
        path = rrt_kernel.search(
            self.space, now.trees, self.goals, bound, longest, CLOCK_INTERVAL, self._state
        )
        self.work, self._tried, now.left = (
            self.work + CLOCK_INTERVAL,
            self._tried + CLOCK_INTERVAL,
            now.left - CLOCK_INTERVAL,
        )
        if self.best is None:
            self._grown = now.trees
        if len(path):
            self.found += 1
            self._round = None
            if self.offer(path, self.name):
                self._grown = now.trees


def usual_clearances(wanted: float) -> list[float]:
    """The clearances that a search tries one after the other [m]: the wanted one and fractions of it, the
    default one's if that is less, MIN_CLEARANCE and 0."""
    falling = [share * wanted for share in FALLING_FRACTIONS]
    if wanted > DEFAULT_CLEARANCE:
        usual = [share * DEFAULT_CLEARANCE for share in FALLING_FRACTIONS]
        falling = [*(kept for kept in falling if kept > DEFAULT_CLEARANCE), *usual]
    return [*(kept for kept in falling if kept > MIN_CLEARANCE), MIN_CLEARANCE, 0.0]


@dataclass
class _Round:
    """The trees of a round, and the iterations left for them."""

    trees: rrt_kernel.Trees
    left: int
