"""The anytime loop of planners that search: a first path, then ever shorter ones, and the validator on the
way."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.collision.kernels.compiled import random_state
from robotdiffuse.collision.kernels.motions import motions_free, path_length
from robotdiffuse.collision.motions import finer
from robotdiffuse.core.bounds import for_kernels
from robotdiffuse.core.results import PlanResult
from robotdiffuse.core.settings import Count, Natural, Positive, Settings
from robotdiffuse.core.types import CONVERGED, FIRST, Tree
from robotdiffuse.planning.context import PlanningContext
from robotdiffuse.planning.search import rrt_kernel
from robotdiffuse.planning.start_goal import StartGoal
from robotdiffuse.trajectories.simplification import simplify, tighten

LEAST_CLEARANCE = 0.002
"""Tried even if none is wanted [m]: contact within that is costly to tell from none, and paths are hardly
longer."""
FIRST_TRIES = 400
"""Iterations at a clearance before the next lower one is tried."""
HELP_AFTER = 8_000
"""Iterations without a path before others are asked for one, and between two times that they are."""
LOOSER = 1.15
"""The bound of rounds, times the length of the best path: what trees hold is not simplified yet, and where it
is tight they hold no path as short as a simplified one that goes the long way round."""
VALIDATE_AFTER = 4_000
"""Iterations between two shorter paths that are validated on the way: at the end of the time, what the validator
refuses would cost all that was found since the last path that passed."""
SLICE = 100
"""Iterations between two looks at the clock."""
NEAR = 1.05
"""Paths that are longer than the best one by more than this factor are not tightened: it takes off less."""
NO_SHORTER = 1e-4
"""A path is the shortest there can be when it exceeds the straight line by no more than this share."""


@dataclass(frozen=True)
class SearchSettings(Settings):
    """What RRT-Connect and AORRTC have in common."""

    range: Positive = 0.7
    """Longest extension of a tree [rad, joint-space L2]: longer ones are in vain more often."""
    resolution: Positive = 0.05
    """No point of the arm moves further than this between two checks of a motion [m]; the validator's certificate
    covers the rest, and after a path that it refuses the search looks twice as closely."""
    smoothings: Natural = 1
    """Rounds of smoothing of each path that is found."""
    tightenings: Natural = 200
    """Attempts to shorten each path but the first a little, where it stands."""
    iterations: Count = 20_000
    """Most iterations of a round; its trees hold at most as many nodes."""
    keep_trees: bool = False
    """Results hold the trees of the search, to be looked at."""


class AnytimeSearch:
    """Rounds between the ends of a call: the best path so far, and the work that it took.

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
        tries: int = FIRST_TRIES,
    ) -> None:
        """`name` is the stage of the paths that are found here; without `bounded`, rounds are restarts.

        clearances: what is tried, falling, in place of the call's clearance and parts of it [m]; each for so
            many iterations, `tries`, without a path.
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
        """Where it comes from."""
        self.work = 0
        """Iterations so far."""
        self.first_at = np.inf
        """When the first path was there [s since the call]."""
        self.found = 0
        """Paths found by search."""
        self.history = list[tuple[ndarray, str]]()
        """The shortest paths, each when it was found, and where they come from."""
        self._lengths = list[tuple[int, float]]()
        self._loose = False
        """Whether the best path is the first one, which is tightened once there is time to improve it."""
        self._state = random_state(context.seed)
        self._round: _Round | None = None
        self._grown: rrt_kernel.Trees | None = None
        """Those that found the shortest path of the search, or that grow."""
        wanted = [share * context.clearance for share in (1.0, 0.5, 0.25)]
        usual = [*(kept for kept in wanted if kept > LEAST_CLEARANCE), LEAST_CLEARANCE, 0.0]
        self._clearances, self._tries = [*clearances] or usual, tries
        self._enter(0)

    @property
    def clearance(self) -> float:
        """The distance to obstacles that is kept away from the ends [m]."""
        return self._clearances[self._level]

    @property
    def notes(self) -> tuple[str, ...]:
        """What the result says of the clearance."""
        if self.clearance >= self.context.clearance:
            return ()
        kept, asked = 100 * self.clearance, 100 * self.context.clearance
        return (f"searched {kept:.2g} cm away from obstacles, not {asked:.2g} cm: there no path was found",)

    @property
    def shortest(self) -> bool:
        """Whether no path to any goal can be shorter."""
        straight = np.linalg.norm(self.goals - self.start, axis=1).min()
        return bool(self.length <= straight * (1 + NO_SHORTER))

    @property
    def trees(self) -> tuple[Tree, ...]:
        """See `PlanResult.trees`."""
        if self._grown is None or not self.settings.keep_trees:
            return ()
        grown = self._grown
        return tuple(
            Tree(grown.nodes[i, :n].copy(), grown.parents[i, :n].copy()) for i, n in enumerate(grown.sizes)
        )

    def first(self, until: float, help_out: Callable[[], None] | None = None, work: float = np.inf) -> bool:
        """Search until there is a path, or `until` [s since the call], or for so many more iterations;
        whether there is one.

        `help_out` is called each time that no clearance gave one.
        """
        self._straight()
        enough = self.work + work
        while self.best is None and self.context.elapsed < until and self.work < enough:
            self._slice()
            if self.best is None and self._tried >= self._tries:
                self._lower(help_out)
        return self.best is not None

    def improve(self, until: float, work: float = np.inf) -> None:
        """Rounds below the length of the best path, until `until` [s since the call], so many more
        iterations, or there can be no shorter path."""
        enough = self.work + work
        if self._loose and self.best is not None:
            self.offer(self.best, self.stage)
            self._loose = False
        while not self.shortest and self.context.elapsed < until and self.work < enough:
            self._slice()

    def pays(self, gain: float, patience: int) -> bool:
        """Whether more time is worth while: the last doubling of the work took off at least the share `gain`
        of the length, or there were not `patience` iterations yet."""
        half = [length for work, length in self._lengths if work <= self.work / 2]
        if self.work < patience or not half:
            return True
        return bool(half[-1] - self.length >= gain * half[-1])

    def offer(self, path: Float[ndarray, "n dof"], stage: str) -> bool:
        """Take a path between the ends that is free in `space`, simplified, if it is the shortest so far."""
        path = for_kernels(path, np.float32)
        settings = self.settings
        path = simplify(self.space, path, settings.smoothings)
        length = path_length(path)
        if self.best is None:
            self._loose = True
        elif length < NEAR * self.length:
            path = tighten(self.space, path, settings.tightenings, self._state)
            length = path_length(path)
        return bool(length < self.length) and self._take(path, float(length), stage)

    def _take(self, path: Float[ndarray, "n dof"], length: float, stage: str) -> bool:
        """The path is the best one now."""
        if self.best is None:
            self.first_at = self.context.elapsed
        self.best, self.length, self.stage = path, np.float32(length), stage
        self.history.append((path, stage))
        self._lengths.append((self.work, length))
        self._round = None
        self.context.improved(length)
        return True

    def keeps_clearance(self, q: Float[ndarray, "n dof"]) -> bool:
        """Whether the way through configurations keeps the clearance of the search."""
        rows = np.ascontiguousarray(q if len(q) > 1 else np.repeat(q, 2, axis=0), np.float32)
        return bool(motions_free(self.space, rows).all())

    def refuse(self, accepted: Float[ndarray, "n dof"] | None) -> None:
        """Look twice as closely from now on, since the validator refused the best path; in its place is the last
        that it accepted."""
        self.settings = replace(self.settings, resolution=finer(self.settings.resolution))
        self.best = accepted
        self.length = np.float32(np.inf if accepted is None else path_length(accepted))
        self._round = None
        self._enter(self._level)

    def _enter(self, level: int) -> None:
        self._level, self._tried = level, 0
        self.space = self.start_goal.space(self.settings.resolution, self.clearance)

    def _lower(self, help_out: Callable[[], None] | None) -> None:
        """The next lower clearance, at which what the trees hold stays valid; after the lowest one, whatever
        helps."""
        if self._level < len(self._clearances) - 1:
            self._enter(self._level + 1)
            self._straight()
        else:
            self._tried = self._tries - HELP_AFTER
            if help_out is not None and self.work >= HELP_AFTER:
                help_out()

    def _straight(self) -> None:
        for goal in sorted(self.goals, key=lambda goal: float(np.linalg.norm(goal - self.start))):
            line = np.stack([self.start, goal])
            if motions_free(self.space, line).all() and self.offer(line, "straight_line"):
                return

    def _slice(self) -> None:
        """Some iterations of a round, and what they find."""
        settings = self.settings
        now = self._round
        if now is None or now.left <= 0 or now.trees.sizes.max() >= now.trees.nodes.shape[1]:
            trees = rrt_kernel.make_trees(self.start, self.goals, settings.iterations + len(self.goals))
            now = self._round = _Round(trees, settings.iterations)
        bound = np.float32(LOOSER * self.length if self.bounded else np.inf)
        longest = np.float32(settings.range)
        path = rrt_kernel.search(self.space, now.trees, self.goals, bound, longest, SLICE, self._state)
        self.work, self._tried, now.left = self.work + SLICE, self._tried + SLICE, now.left - SLICE
        if self.best is None:
            self._grown = now.trees
        if len(path):
            self.found += 1
            self._round = None
            if self.offer(path, self.name):
                self._grown = now.trees


@dataclass
class _Round:
    """Trees, and the iterations that are left to them."""

    trees: rrt_kernel.Trees
    left: int


class Answers:
    """The best motion of a search that passed the validator."""

    def __init__(self, context: PlanningContext, start_goal: StartGoal) -> None:
        self.context, self.start_goal = context, start_goal
        self.best: PlanResult | None = None
        self._path: ndarray | None = None
        self._validated_at = 0

    def due(self, search: AnytimeSearch) -> bool:
        """Whether a path is to be validated before the search goes on: the first one, and then shorter ones, now
        and then."""
        rested = search.work >= self._validated_at + VALIDATE_AFTER
        return self.best is None or (rested and search.best is not self._path)

    def take(self, search: AnytimeSearch) -> bool:
        """Whether the best path of the search passes the validator; if not, the search goes on from the last that
        did."""
        assert search.best is not None
        self._validated_at = search.work
        if search.best is self._path:
            return True
        if self._accepts(search.best, search.stage, search):
            return True
        if self.context.remaining <= 0 and self.best is None:
            # there is no time to search on: the one before, if there is one
            return any(self._accepts(*before, search) for before in search.history[-2:-1])
        search.refuse(self._path)
        return False

    def _accepts(self, path: ndarray, stage: str, search: AnytimeSearch) -> bool:
        waypoints = self.start_goal.complete(path)
        result = self.context.finish(waypoints, stage, notes=search.notes, keeps=search.keeps_clearance)
        if result is not None:
            self.best, self._path = result, path
        return result is not None


def anytime(
    context: PlanningContext,
    start_goal: StartGoal,
    search: AnytimeSearch,
    pays: Callable[[], bool],
    improve: Callable[[], None],
    help_out: Callable[[], None] | None = None,
) -> PlanResult:
    """The answer of a call: its first path, and ever shorter ones for as long as the call's `until` says.

    `pays` says whether more time is worth while, `improve` spends some. `help_out` may offer paths where
    search finds none at any clearance.
    """

    def ended() -> bool:
        done = context.until == FIRST or search.shortest or context.remaining <= 0
        return done or (context.until == CONVERGED and not pays())

    answers = Answers(context, start_goal)
    while search.first(context.search_until, help_out):
        if ended() or (context.ample and answers.due(search)):
            if answers.take(search) and ended():
                break
            if answers.best is None and context.remaining <= 0:
                break
        else:
            improve()
    return replace(answers.best or context.unsolved(), trees=search.trees)
