"""Search under path constraints: RRT-Connect with projected nodes, and simplification, in the anytime loop.

The planners aorrtc, rrt_connect and robotdiffuse use it for problems with constraints. The search keeps a
little more than the tolerances, which rounding of corners and numbers needs; the validator proves the result.
"""

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.core.results import PlanResult
from robotdiffuse.core.types import LENGTH
from robotdiffuse.planning.context import PlanningContext
from robotdiffuse.planning.search import constrained_kernel
from robotdiffuse.planning.search.anytime import anytime
from robotdiffuse.planning.search.anytime_search import AnytimeSearch, SearchSettings
from robotdiffuse.planning.search.time_optimization import estimated_duration
from robotdiffuse.planning.start_goal import StartGoal
from robotdiffuse.problems.compiled_constraints import PathConstraints
from robotdiffuse.trajectories.speed_limits import scaled_limits

STAGE = "constrained_rrt_connect"
CLOCK_INTERVAL = 20
"""Iterations between two readings of the clock; they take longer than those without constraints."""
TOLERANCE_FRACTION, END_MARGIN = 0.95, 1e-6
"""The search keeps this part of each tolerance; or the value at the start or a goal, plus the margin, if
larger."""
PATHS_TO_FIND = 2
"""With until "converged": number of paths to find; the best is returned."""
STRAIGHT_FACTOR = 1.02
"""A path is the shortest if it is longer than the straight line by no more than this factor."""
SHORTCUTS = 60
"""Shortcuts that are tried on each path found."""


def plan_constrained(context: PlanningContext, start_goal: StartGoal, settings: SearchSettings) -> PlanResult:
    """Plan for a problem with path constraints."""
    search = ConstrainedSearch(context, start_goal, settings)

    def improve() -> None:
        search.improve(context.search_until, CLOCK_INTERVAL)

    return anytime(context, search, lambda: search.found < PATHS_TO_FIND, improve)


class ConstrainedSearch(AnytimeSearch):
    """Restarts of RRT-Connect under constraints."""

    def __init__(self, context: PlanningContext, start_goal: StartGoal, settings: SearchSettings) -> None:
        constraints = context.validator.constraints
        assert constraints is not None  # else AnytimeSearch would be used
        self.constraints: PathConstraints = constraints
        rows, start = constraints.rows, start_goal.start_lead
        assert start is not None  # a StartGoal without a start is refused before
        self.kept = constraints.limits(TOLERANCE_FRACTION)
        at_ends = constraints.values(np.stack([start, *start_goal.goal_leads])).max(axis=0) + END_MARGIN
        self.kept = np.minimum(np.maximum(self.kept, at_ends), rows.limit)
        self.cost = np.inf
        """Of the best path: its estimated duration [s]; its length [rad] if that is the objective."""
        self._speed_limits = scaled_limits(context.problem.robot, context.timing)
        super().__init__(context, start_goal, settings, STAGE, bounded=False)
        self.start, self.goals = start, np.stack(start_goal.goal_leads)
        self._trees: constrained_kernel.Trees | None = None

    @property
    def shortest(self) -> bool:
        """Whether no path can be shorter by more than a small part: the constraints hardly bend the straight
        line."""
        straight = np.linalg.norm(self.goals - self.start, axis=1).min()
        return bool(self.length <= STRAIGHT_FACTOR * straight)

    def keeps_clearance(self, q: Float[ndarray, "n dof"]) -> bool:
        """Whether the polyline through configurations keeps the clearance and the constraints."""
        return corner_kept(self.constraints, q) and super().keeps_clearance(q)

    def offer(self, path: Float[ndarray, "n dof"], stage: str) -> bool:
        """See `AnytimeSearch`; the path also keeps the constraints, and the one of the least cost is kept."""
        settings = self.settings
        path = constrained_kernel.simplify(self.limits, path, settings.smoothings, SHORTCUTS, self._state)
        cost = self._cost_of(path)
        if cost >= self.cost:
            return False
        self.cost = cost
        return self._take(path, constrained_kernel.length(path), stage)

    def _cost_of(self, path: Float[ndarray, "n dof"]) -> float:
        if self.context.request.objective == LENGTH:
            return constrained_kernel.length(path)
        return estimated_duration(path, self.context.timing.corner_deviation, self._speed_limits)

    def refuse(self, accepted: Float[ndarray, "n dof"] | None) -> None:
        """See `AnytimeSearch`."""
        super().refuse(accepted)
        self.cost = np.inf if accepted is None else self._cost_of(accepted)
        self._trees = None

    def _set_level(self, level: int) -> None:
        super()._set_level(level)
        self.limits = constrained_kernel.Limits(self.space, self.constraints.rows, self.kept)

    def _try_straight_lines(self) -> None:
        for goal in sorted(self.goals, key=lambda goal: float(np.linalg.norm(goal - self.start))):
            path = constrained_kernel.line(self.limits, self.start, goal)
            if len(path) and self.offer(path, self.name):
                self.found += 1
                return

    def _iterate(self) -> None:
        settings = self.settings
        if (
            self._trees is None
            or self._trees.sizes.max() >= self._trees.nodes.shape[1] - constrained_kernel.MAX_PIECES
        ):
            capacity = settings.iterations + len(self.goals) + 2 * constrained_kernel.MAX_PIECES
            self._trees = constrained_kernel.make_trees(self.start, self.goals, capacity)
        path = constrained_kernel.search(
            self.limits, self._trees, settings.range, CLOCK_INTERVAL, self._state
        )
        self.work, self._tried = self.work + CLOCK_INTERVAL, self._tried + CLOCK_INTERVAL
        if len(path):
            self.found += 1
            self._trees = None
            self.offer(path, self.name)


def corner_kept(constraints: PathConstraints | None, q: Float[ndarray, "n dof"]) -> bool:
    """Whether the polyline through configurations, such as a rounded corner, keeps the constraints as closely
    as the search does."""
    rows = q if len(q) > 1 else np.repeat(q, 2, axis=0)
    return (
        constraints is None
        or constraints.first_violation(rows, tolerance_fraction=TOLERANCE_FRACTION) is None
    )
