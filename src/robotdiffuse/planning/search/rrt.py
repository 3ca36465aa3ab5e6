"""The planners RRT-Connect and AORRTC, and their anytime search.

The search runs in rounds. In each round, two new trees grow until they find a path. Paths are simplified,
tightened (`trajectories/simplification.py`), and validated during the search. If no path is found, the
required clearance is lowered.

Rounds of AORRTC have a bound: the trees keep only nodes through which a path of at most BOUND_FACTOR times
the best length is possible. Rounds of RRT-Connect are restarts without a bound.

With the objective "length", a call returns the shortest path found. With "time", a local search makes motions
along the paths faster, and the call returns the fastest motion. Under path constraints, there is no local
search: each path with the lowest estimated time so far is timed, and the call returns the fastest motion.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from operator import attrgetter

import numpy as np
from numpy import ndarray

from robotdiffuse.collision.kernels.motions import motions_free, path_length
from robotdiffuse.collision.kernels.random import random_state
from robotdiffuse.collision.motions import finer_resolution
from robotdiffuse.core.loading import loading
from robotdiffuse.core.settings import Count, Natural, NotNegative, Positive, Settings, ShareBelowOne
from robotdiffuse.core.types import (
    FIRST,
    LENGTH,
    TIME,
    TIME_LIMIT,
    Configuration,
    Configurations,
    PlanResult,
    Tree,
    Values,
    for_kernels,
    nearest_first,
)
from robotdiffuse.planning import CLEARANCE, PATH_CONSTRAINTS
from robotdiffuse.planning.context import DEFAULT_CLEARANCE, TOLERANCE_FRACTION, PlanningContext
from robotdiffuse.planning.planner import Planner
from robotdiffuse.planning.search import rrt_kernel
from robotdiffuse.planning.search.time_optimization import (
    Candidate,
    TimeOptimization,
    estimated_duration,
    still_improves,
)
from robotdiffuse.planning.start_goal import StartGoal
from robotdiffuse.problems.problem import JointGoal, goals_of
from robotdiffuse.trajectories.simplification import simplify, tighten
from robotdiffuse.trajectories.speed_limits import scaled_limits

MIN_CLEARANCE = 0.002
"""Clearance that is tried before 0, even if no clearance is requested [m]. It makes paths hardly longer, and
avoids collision checks near contact, which are expensive."""
FALLING_FRACTIONS = (1.0, 0.5, 0.25)
"""Fractions of the requested clearance that are tried in turn; see `usual_clearances`."""
ITERATIONS_PER_CLEARANCE = 400
"""Number of iterations at a clearance before the next lower one is tried."""
BOUND_FACTOR = 1.15
"""Length bound of a round, as a multiple of the best length. The bound is above the best length, because
paths become shorter when they are simplified."""
TIGHTENING_FACTOR = 1.05
"""Paths longer than this multiple of the best length are not tightened, since tightening would not make them
shorter than the best path."""

NEAR_FACTOR = 1.3
"""Paths up to this multiple of the best length become candidates for the fastest motion."""
LONG_ROUND_FACTOR = 5
"""If the first round finds no path, later rounds have this many times as many iterations until a path is
found: large trees find narrow passages sooner than new trees do."""
VALIDATION_INTERVAL = 4_000
"""Number of iterations between two validations during the search. If the search validated only at the end, a
refused path would cost all improvements."""
ATTEMPTS_PER_ITERATION = 0.2
"""Number of attempts to make a motion faster, per iteration of the search. With this ratio, attempts and
iterations take about the same time."""
ATTEMPTS_AFTER_SEARCH = 200
"""Number of attempts to make a motion faster between two checks of the stopping rule, after the search."""
# With until="converged", attempts to make a motion faster end when the last doubling of their number reduced
# its time by less than the fraction TIME_GAIN, but not before TIME_PATIENCE attempts.
TIME_GAIN = 0.0025
TIME_PATIENCE = 1_600
MIN_TIME_GAIN = 0.01
"""While the search goes on, a motion is validated only if its estimated time is below that of the best
validated motion by at least this fraction."""
MAX_DETOUR = 1.05
"""For pose goals: once there is a path up to this multiple of the straight line to the nearest goal
configuration, longer paths are dropped as candidates for the fastest motion."""
FINAL_CANDIDATES = 2
"""At the end, the fastest candidates are validated until this many are valid, if there is time; the fastest
valid motion is returned."""
END_MARGIN = 1e-6
"""Under path constraints, the search widens its tolerances to the values of the constraints at the start and
the goals, plus this margin, but not beyond the problem's tolerances."""
PATHS_TO_FIND = 2
"""With until="converged", RRT-Connect and searches under path constraints look for this many paths, and go on
until `optimize_time` is over; the best path is returned."""

SHORTCUTS = 60
"""Number of shortcuts that are tried on each path under path constraints."""


@dataclass(frozen=True)
class SearchSettings(Settings):
    """The settings that RRT-Connect and AORRTC share."""

    range: Positive = 0.7
    """Longest extension of a tree [rad, joint-space L2]; longer extensions collide more often."""
    resolution: Positive = 0.05
    """Largest travel of any point of the arm between two collision checks of a motion [m]. The search halves
    it, down to 2 mm, each time that the validator, which certifies the whole motion, refuses a path."""
    smoothings: Natural = 1
    """Number of rounds of smoothing for each path found."""
    tightenings: Natural = 200
    """Number of attempts to shorten a path by small moves of its waypoints. The first path is shortened only
    once there is time to improve it. Ignored under path constraints."""
    iterations: Count = 20_000
    """Largest number of iterations in a round, and of nodes in each tree. If the first round finds no path,
    later rounds have five times as many."""
    keep_trees: bool = False
    """Whether results hold the search trees, for drawing."""


class AnytimeSearch:
    """Rounds of RRT-Connect or AORRTC between a start and goals, and the best path so far.

    The same seed gives the same rounds; `stop` decides only when they end.
    """

    clock_interval = 100
    """Number of iterations between two calls of `stop`."""
    spare_nodes = 0
    """Number of nodes, in addition to one, that an iteration may add to a tree."""
    limits: tuple | None = None
    """`constrained.Limits`: path constraints that the edges of trees keep; None: no constraints."""
    optimality_tolerance = 1e-4
    """The best path counts as optimal if it is longer than the straight line to the nearest goal by at most
    this fraction."""
    line_stage = "straight_line"
    """The name of the stage (see `history`) for a straight line."""

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
        """Begin without trees.

        Args:
            start_goal: Start and goals.
            settings: Settings of the search.
            name: What results report as their `stage`, the part of the planner that found the motion.
            seed: Seed of the random numbers.
            clearances: Clearances to try in turn, falling [m].
            bounded: Whether rounds have a bound on length (AORRTC); False: they are restarts (RRT-Connect).
            tries: Number of iterations without a path before the next clearance is tried.
            stop: Whether the search must end now.
            improved: Called with the length [rad] of each path that is the best so far.
        """
        self.start_goal = start_goal
        self.settings = settings
        self.name = name
        self.bounded = bounded
        self.start, self.goals = start_goal.leads()  # or free configurations nearby
        self.best: Configurations | None = None
        """The path of the lowest cost so far, free at the resolution of the search."""
        self.length = np.float32(np.inf)
        """Its length [rad]."""
        self.cost = np.inf
        """Its cost, which is its length; for a subclass, that of `cost_of`."""
        self.work = 0
        """Number of iterations so far."""
        self.found = 0
        """Number of paths found so far."""
        self.history = list[tuple[ndarray, str]]()
        """Each path that was the best when it was found, and its stage."""
        self.motions: TimeOptimization | None = None
        """Candidates for the fastest motion, if the objective is time."""
        self._lengths = list[tuple[int, float]]()
        """Number of iterations and length, each time that a path became the best."""
        self._untightened = False
        """Whether the best path is the first one and not tightened; `improve` tightens it."""
        self._shortens = True
        """Whether paths are simplified, and straight lines tried."""
        self._state = random_state(seed)
        self._trees: rrt_kernel.Trees | None = None
        """The trees of the current round; None between rounds."""
        self._round_end = 0
        """The number of iterations (`work`) at which the current round ends."""
        self._grown: rrt_kernel.Trees | None = None
        """The trees that found the best path; before there is a path, those of the current round."""
        self._later_clearances = list(clearances)
        """Clearances that were not tried yet, falling [m]."""
        self._tries = tries
        self._stop = stop
        self._improved = improved
        self._set_clearance(self._later_clearances.pop(0))

    @classmethod
    def of(
        cls,
        context: PlanningContext,
        start_goal: StartGoal,
        settings: SearchSettings,
        name: str,
        bounded: bool = True,
    ) -> "AnytimeSearch":
        """Make the search of a planning call.

        Args:
            context: The call.
            start_goal: Start and goals.
            settings: Settings of the search.
            name: The `stage` of results, as in the constructor.
            bounded: Whether rounds have a bound on length, as in the constructor.

        Returns:
            A search that ends when the call's time for searching has run out.
        """
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
    def shortest(self) -> bool:
        """Whether the best path is about as short as the straight line to the nearest goal."""
        return bool(self.length <= self.straight.min() * (1 + self.optimality_tolerance))

    @property
    def straight(self) -> Values:
        """Lengths of the straight lines to the goals [rad]."""
        return np.linalg.norm(self.goals - self.start, axis=1)

    @property
    def trees(self) -> tuple[Tree, ...]:
        """See `PlanResult.trees`."""
        if self._grown is None or not self.settings.keep_trees:
            return ()
        grown = self._grown
        return tuple(
            Tree(grown.nodes[i, :n].copy(), grown.parents[i, :n].copy()) for i, n in enumerate(grown.sizes)
        )

    def first(self, work: float = np.inf) -> bool:
        """Search for a first path.

        Args:
            work: Largest number of further iterations.

        Returns:
            Whether there is a path.
        """
        if self.best is None:
            self._try_straight_lines()
        work_limit = self.work + work
        while self.best is None and self.work < work_limit and not self._stop():
            self._iterate()
            if self.best is None and self._tried >= self._tries and self._later_clearances:
                # the trees keep a larger clearance, so they stay valid
                self._set_clearance(self._later_clearances.pop(0))
                self._try_straight_lines()
        return self.best is not None

    def improve(self, work: int) -> None:
        """Search for shorter paths, until the path is optimal.

        Args:
            work: Largest number of further iterations.
        """
        work_limit = self.work + work
        if self._untightened and self.best is not None:
            self.offer(self.best, self.history[-1][1])
            self._untightened = False
        while not self.shortest and self.work < work_limit and not self._stop():
            self._iterate()

    def improves(self, gain: float, patience: int) -> bool:
        """Judge whether more iterations are likely to shorten the best path.

        Args:
            gain: Smallest fraction by which the last doubling of the number of iterations must have shortened
                the best path.
            patience: Number of iterations before which the answer is yes.

        Returns:
            Whether to go on; see `still_improves`.
        """
        return still_improves(self._lengths, self.work, float(self.length), gain, patience)

    def offer(self, path: Configurations, stage: str) -> bool:
        """Simplify a path, and make it the best path if its cost is lower.

        If the objective is time, the path may also become a candidate for the fastest motion.

        Args:
            path: A path from the start to a goal [n, dof], free in `space`.
            stage: The part of the planner that found it.

        Returns:
            Whether it is the best path now.
        """
        path = self.simplified(path)
        if self.motions is not None and path_length(path) < NEAR_FACTOR * self.length:
            self.motions.offer(self.space, path, stage)
        if self.cost_of(path) >= self.cost:
            return False
        self._set_best(path)
        self.history.append((path, stage))
        self._lengths.append((self.work, float(self.length)))
        self._improved(float(self.length))
        return True

    def simplified(self, path: Configurations) -> Configurations:
        """Simplify a path, and tighten it if it is about as short as the best path.

        Args:
            path: A path from the start to a goal [n, dof].

        Returns:
            The path with other waypoints [m, dof].
        """
        path = for_kernels(path, np.float32)
        if self._shortens:
            path = simplify(self.space, path, self.settings.smoothings)
        if self.best is None:
            self._untightened = self._shortens
        elif path_length(path) < TIGHTENING_FACTOR * self.length:
            path = tighten(self.space, path, self.settings.tightenings, self._state)
        return path

    def cost_of(self, path: Configurations) -> float:
        """Compute the cost by which paths are compared.

        Args:
            path: A path [n, dof].

        Returns:
            Its length in joint space [rad].
        """
        return float(path_length(path))

    def _set_best(self, path: Configurations | None) -> None:
        """Make a path the best one, and end the round."""
        self.best = path
        self.length = np.float32(np.inf if path is None else path_length(path))
        self.cost = np.inf if path is None else self.cost_of(path)
        self._trees = None

    def keeps_clearance(self, q: Configurations) -> bool:
        """Check a polyline against the clearance of the search.

        Args:
            q: Its configurations [n, dof].

        Returns:
            Whether all of it keeps the clearance.
        """
        return bool(motions_free(self.space, for_kernels(q, np.float32)).all())

    def refuse(self, accepted: Configurations | None) -> None:
        """Go back to the last valid path after the validator refused the best path, and halve the resolution.

        At the finest resolution, paths are not simplified any more, because this could lead to the refused
        path again; those about as short as the valid path are still tightened.

        Args:
            accepted: The last valid path [n, dof]; None: there is none.
        """
        finer = finer_resolution(self.settings.resolution)
        self._shortens = finer < self.settings.resolution
        self.settings = replace(self.settings, resolution=finer)
        self._set_best(accepted)
        self._set_clearance(self.clearance)

    def _set_clearance(self, clearance: float) -> None:
        self.clearance = clearance
        """The distance to obstacles that paths keep, except near the start and the goals [m]."""
        self._tried = 0
        self.space = self.start_goal.space(self.settings.resolution, clearance)

    def _try_straight_lines(self) -> None:
        if not self._shortens:
            return
        for goal in nearest_first(self.goals, self.start):
            path = self._line(goal)
            if len(path) and self.offer(path, self.line_stage):
                self.found += 1
                return

    def _line(self, goal: Configuration) -> Configurations:
        """The path with one edge from the start to a goal; no rows if the edge is not free."""
        path = np.stack([self.start, goal])
        return path if motions_free(self.space, path).all() else path[:0]

    def _iterate(self) -> None:
        """Run `clock_interval` iterations, in a new round if the last has ended, and offer the path that they
        find."""
        iterations = self.settings.iterations
        if self.best is None and self.work >= iterations:
            iterations *= LONG_ROUND_FACTOR
        trees = self._trees
        capacity = iterations + len(self.goals) + 2 * self.spare_nodes
        if trees is None or self.work >= self._round_end or trees.sizes.max() + self.spare_nodes >= capacity:
            trees = self._trees = rrt_kernel.make_trees(self.start, self.goals, capacity)
            self._round_end = self.work + iterations
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


class ConstrainedSearch(AnytimeSearch):
    """Restarts of RRT-Connect under path constraints; the best path is the one of the lowest cost."""

    clock_interval = 20
    optimality_tolerance = 0.02
    line_stage = "constrained_rrt_connect"

    def __init__(self, context: PlanningContext, start_goal: StartGoal, settings: SearchSettings) -> None:
        constraints = context.validator.constraints
        start = start_goal.start_lead
        assert constraints is not None and start is not None
        with loading():  # compiled code that only problems with constraints need
            from robotdiffuse.planning.search import constrained

        self._code = constrained
        self.spare_nodes = constrained.MAX_PIECES
        tolerances = constraints.limits(TOLERANCE_FRACTION)
        at_ends = constraints.values(np.stack([start, *start_goal.goal_leads])).max(axis=0) + END_MARGIN
        tolerances = np.minimum(np.maximum(tolerances, at_ends), constraints.rows.limit)
        self.context = context
        self.limits = constrained.make_limits(constraints.rows, tolerances)
        self._speed_limits = scaled_limits(context.problem.robot, context.timing)
        super().__init__(
            start_goal,
            settings,
            self.line_stage,
            context.request.seed,
            usual_clearances(context.clearance),
            bounded=False,
            stop=lambda: context.remaining <= 0,
            improved=context.improved,
        )
        self.start, self.goals = start, np.stack(start_goal.goal_leads)

    def keeps_clearance(self, q: Configurations) -> bool:
        """Whether the polyline through configurations keeps the clearance and the constraints."""
        return self.context.keeps_constraints(q) and super().keeps_clearance(q)

    def simplified(self, path: Configurations) -> Configurations:
        """The path, simplified such that it still keeps the constraints."""
        if not self._shortens:
            return path
        return self._code.simplify(
            self.space, self.limits, path, self.settings.smoothings, SHORTCUTS, self._state
        )

    def cost_of(self, path: Configurations) -> float:
        """The estimated duration [s], or the length [rad] if the objective is length."""
        if self.context.request.objective == LENGTH:
            return super().cost_of(path)
        return estimated_duration(path, self.context.timing.corner_deviation, self._speed_limits)

    def _line(self, goal: Configuration) -> Configurations:
        return self._code.line(self.space, self.limits, self.start, goal)


def usual_clearances(wanted: float) -> list[float]:
    """The clearances that a search tries in turn, falling [m].

    These are FALLING_FRACTIONS of the wanted clearance. If it is above the default clearance, its fractions
    above the default come first, then FALLING_FRACTIONS of the default. Clearances up to MIN_CLEARANCE are
    left out; MIN_CLEARANCE and 0 come last.
    """
    lowest, later = MIN_CLEARANCE, [MIN_CLEARANCE, 0.0]
    if wanted > DEFAULT_CLEARANCE:
        lowest, later = DEFAULT_CLEARANCE, usual_clearances(DEFAULT_CLEARANCE)
    falling = (fraction * wanted for fraction in FALLING_FRACTIONS)
    return [*(clearance for clearance in falling if clearance > lowest), *later]


class _Validation:
    """Validates paths of a search and keeps the best valid result."""

    def __init__(self, context: PlanningContext, search: AnytimeSearch) -> None:
        self.context = context
        self.search = search
        self.best: PlanResult | None = None
        self._path: ndarray | None = None
        self._shortest: PlanResult | None = None
        """Result of `_path`, the last path of the search that passed validation."""
        self._validated = list[ndarray]()
        """The paths of the search that were validated, whether they passed or not."""
        self._validated_at = 0
        self._late = False
        """Whether a path was validated after the time for searching had run out."""

    @property
    def due(self) -> bool:
        """Whether to validate now: the first path at once; improvements every VALIDATION_INTERVAL iterations,
        or at once under path constraints."""
        search = self.search
        motions = search.motions
        interval = 0 if self.context.problem.constraints else VALIDATION_INTERVAL
        if self.best is None:
            return True
        if search.work < self._validated_at + interval:
            return False
        if motions is None or motions.best is None:
            return search.best is not self._path
        return motions.best.time < (1 - MIN_TIME_GAIN) * self.best.duration

    def run(self) -> bool:
        """Validate the fastest candidate if there is a valid result already, or if no time is left to search.
        If motions are not optimized, or there is no valid result after that, validate the best path of the
        search. If this path is refused, the search goes back to its last valid path.

        Returns False if it went back, or if nothing valid was found in time.
        """
        search = self.search
        motions = search.motions
        assert search.best is not None
        self._validated_at = search.work
        self._late = self.context.remaining <= 0
        if motions is not None and motions.best is not None and (self.best is not None or self._late):
            self._accepts_motion(motions.best)
        if motions is not None and self.best is not None:
            return True
        if search.best is self._path or self._accepts(*search.history[-1]):
            return True
        if self.context.remaining <= 0 and self.best is None:
            # no time is left to search: try the best path before the refused one
            return any(self._accepts(*before) for before in search.history[-2:-1])
        search.refuse(self._path)
        return False

    def run_last(self) -> None:
        """Choose the final result. If motions are optimized, it is the fastest of the best candidates'
        motions and of the motion along the shortest path. Under path constraints, paths that were not
        validated yet are tried.

        If motions are optimized, earlier results count only if time ran out or nothing else is valid: which
        paths were validated earlier depends on the clock, and the same seed must give the same result.
        """
        search = self.search
        motions = search.motions
        before = self.best
        if before is None or self.context.ended or self._late:
            return
        if motions is None:
            for path, stage in reversed(search.history if self.context.problem.constraints else ()):
                if self.context.remaining > 0 and not any(path is done for done in self._validated):
                    self._accepts(path, stage)
            return
        self.best = None
        accepted = 0
        for candidate in sorted(motions.candidates, key=motions.least_time):
            accepted += self._accepts_motion(candidate)
            if accepted == FINAL_CANDIDATES or self.context.remaining <= 0:
                break
        if self.context.remaining > 0 and search.best is not None:
            if search.best is self._path:
                self._keep(self._shortest)
            else:
                self._accepts(*search.history[-1])
        if self.best is None or self.context.remaining <= 0:
            self._keep(before)

    def _accepts(self, path: ndarray, stage: str) -> bool:
        self._validated.append(path)
        # If covering spheres collide at the start or goal, the search begins or ends nearby, where they do
        # not: at a lead, see `StartGoal`. The direct way, without the lead, is tried first, since the meshes
        # may be free there.
        complete = self.search.start_goal.complete
        direct = complete(path, direct=True)
        by_leads = complete(path)
        result = self._finished(direct, stage)
        if result is None and len(direct) < len(by_leads):
            result = self._finished(by_leads, stage)
        if result is not None:
            self._path = path
            self._shortest = result
        return result is not None

    def _accepts_motion(self, candidate: Candidate) -> bool:
        start_goal = self.search.start_goal
        path = start_goal.complete(candidate.path)
        # `complete` may have added the start before the search's first waypoint, or the goal after its last
        deviations = np.full(len(path), self.context.timing.corner_deviation)
        assert start_goal.start_lead is not None  # otherwise there would be no path
        first = 1 if np.array_equal(start_goal.start_lead, start_goal.start) else 2
        deviations[first : first + len(candidate.deviations)] = candidate.deviations
        return self._finished(path, candidate.stage, deviations) is not None

    def _finished(self, path: ndarray, stage: str, deviations: ndarray | None = None) -> PlanResult | None:
        """Validate and time a path, and make its result the best one if it is better; None if it is
        refused."""
        search = self.search
        clearance = self.context.clearance
        notes = (
            f"no path was found with a clearance of {100 * clearance:.2g} cm; "
            f"this one was found with {100 * search.clearance:.2g} cm",
        )
        result = self.context.finish(
            path,
            stage,
            notes=notes if search.clearance < clearance else (),
            keeps=search.keeps_clearance,
            deviations=deviations,
        )
        self._keep(result)
        return result

    def _keep(self, result: PlanResult | None) -> None:
        """Make a result the best one if its motion is faster or, for the objective length, its path is
        shorter."""
        cost = attrgetter("duration" if self.context.request.objective == TIME else "path_length")
        if result is not None and (self.best is None or cost(result) < cost(self.best)):
            self.best = result


def anytime(
    context: PlanningContext,
    search: AnytimeSearch,
    improves: Callable[[], bool],
    step: int,
) -> PlanResult:
    """Search for a path, and then for better paths as long as the call's `until` requires.

    Args:
        context: The planning call.
        search: Its search.
        improves: Whether more search is likely to shorten the path.
        step: Number of iterations of the search for shorter paths between two checks of `improves`.

    Returns:
        The result with the best valid motion, or the failed result.
    """
    request = context.request
    problem = context.problem
    if request.objective == TIME and request.until != FIRST and not problem.constraints:
        joint_goals_only = all(isinstance(goal, JointGoal) for goal in goals_of(problem.goal))
        longest = np.inf if joint_goals_only else MAX_DETOUR * float(search.straight.min())
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
    while search.first():
        finished = ended()
        if finished and motions is not None and validation.best is not None:
            break
        if finished or (context.validates_early and validation.due):
            if validation.run() and ended():
                break
            if validation.best is None and context.remaining <= 0:
                break
        else:
            searching = searches()
            if searching:
                search.improve(step)
            if motions is not None:
                after_search = motions.attempts + ATTEMPTS_AFTER_SEARCH
                target = ATTEMPTS_PER_ITERATION * search.work if searching else after_search
                while motions.attempts < target and context.remaining > 0 and motions.candidates:
                    motions.improve(search.space)
    validation.run_last()
    return replace(validation.best or context.unsolved(), trees=search.trees)


IMPROVEMENT_STEP = 1_000
"""Number of iterations of AORRTC between two checks of the stopping rule."""


@dataclass(frozen=True)
class AORRTCSettings(SearchSettings, name="aorrtc"):
    gain: ShareBelowOne = 0.0025
    """With until="converged", the search ends when the last doubling of the number of iterations shortened
    the path by less than this fraction, but not before `patience` iterations."""
    patience: Natural = 16_000
    """Smallest number of iterations with until="converged"; see `gain`."""


@dataclass(frozen=True)
class RRTConnectSettings(SearchSettings, name="rrt_connect"):
    optimize_time: NotNegative = 0.0
    """With until="converged": least time for restarts after the first path [s]. Restarts also go on until
    PATHS_TO_FIND paths are found."""


class AORRTC(Planner[AORRTCSettings]):
    """Asymptotically optimal RRT-Connect (T. Wilson et al., 2025), anytime. Under path constraints, it is
    RRT-Connect with restarts, and the settings `gain`, `patience` and `tightenings` are ignored."""

    name = "aorrtc"
    settings_class = AORRTCSettings
    supports = frozenset({PATH_CONSTRAINTS, CLEARANCE})
    follows_lines = True

    def solve(self, context: PlanningContext, start_goal: StartGoal) -> PlanResult:
        """See `planning.planner.Planner`."""
        settings = self.settings
        if context.problem.constraints:
            return plan_by_restarts(context, ConstrainedSearch(context, start_goal, settings))
        search = AnytimeSearch.of(context, start_goal, settings, AORRTC.name)
        return anytime(
            context,
            search,
            lambda: search.improves(settings.gain, settings.patience),
            IMPROVEMENT_STEP,
        )


class RobotDiffuse(AORRTC):
    """The default planner, which is AORRTC under the package's name."""

    name = "robotdiffuse"


class RRTConnect(Planner[RRTConnectSettings]):
    """RRT-Connect (Kuffner and LaValle, 2000): two trees grow towards each other until they meet, and the
    path is simplified. The search then restarts, as long as `until` requires."""

    name = "rrt_connect"
    settings_class = RRTConnectSettings
    supports = frozenset({PATH_CONSTRAINTS, CLEARANCE})
    follows_lines = True

    def solve(self, context: PlanningContext, start_goal: StartGoal) -> PlanResult:
        """See `planning.planner.Planner`."""
        settings = self.settings
        if context.problem.constraints:
            search = ConstrainedSearch(context, start_goal, settings)
        else:
            search = AnytimeSearch.of(context, start_goal, settings, self.name, bounded=False)
        return plan_by_restarts(context, search, settings.optimize_time)


def plan_by_restarts(
    context: PlanningContext, search: AnytimeSearch, optimize_time: float = 0.0
) -> PlanResult:
    """Plan by restarts of RRT-Connect; see `RRTConnectSettings`."""

    def improves() -> bool:
        return search.found < PATHS_TO_FIND or context.elapsed < context.first_path_at + optimize_time

    return anytime(context, search, improves, search.clock_interval)
