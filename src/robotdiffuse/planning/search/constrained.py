"""Search under path constraints: RRT-Connect on what they leave, shortened, in the loop of `aorrtc`.

What aorrtc, rrt_connect and robotdiffuse plan with where a problem has constraints. The search keeps a little
room to the tolerances, which corners and rounding need; the validator proves what comes of it.
"""

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.core.results import PlanResult
from robotdiffuse.planning.context import PlanningContext
from robotdiffuse.planning.search import constrained_kernel
from robotdiffuse.planning.search.anytime import AnytimeSearch, SearchSettings, anytime
from robotdiffuse.planning.start_goal import StartGoal
from robotdiffuse.problems.compiled_constraints import PathConstraints

STAGE = "constrained_rrt_connect"
SLICE = 20
"""Iterations between two looks at the clock; they take longer than those without constraints."""
SHARE, AT_ENDS = 0.95, 1e-6
"""Of the tolerances that the search keeps; where start or goal need more, they and this are kept."""
SEARCHES = 2
"""Until "converged": paths found, the shortest of which is the answer."""
SHORTCUTS = 60
"""Of each path that is found."""


def plan_constrained(context: PlanningContext, start_goal: StartGoal, settings: SearchSettings) -> PlanResult:
    """The answer of a call on a problem with path constraints."""
    search = ConstrainedSearch(context, start_goal, settings)

    def improve() -> None:
        search.improve(context.search_until, SLICE)

    return anytime(context, start_goal, search, lambda: search.found < SEARCHES, improve)


class ConstrainedSearch(AnytimeSearch):
    """Restarts of RRT-Connect under constraints."""

    def __init__(self, context: PlanningContext, start_goal: StartGoal, settings: SearchSettings) -> None:
        constraints = context.validator.constraints
        assert constraints is not None  # or other searches would do
        self.constraints: PathConstraints = constraints
        rows, start = constraints.rows, start_goal.start_lead
        assert start is not None  # or there would be no ends
        self.kept = constraints.limits(SHARE)
        at_ends = constraints.values(np.stack([start, *start_goal.goal_leads])).max(axis=0) + AT_ENDS
        self.kept = np.minimum(np.maximum(self.kept, at_ends), rows.limit)
        super().__init__(context, start_goal, settings, STAGE, bounded=False)
        self.start, self.goals = start, np.stack(start_goal.goal_leads)
        self._trees: constrained_kernel.Trees | None = None

    @property
    def shortest(self) -> bool:
        """Never known: the shortest path under constraints is longer than the straight line."""
        return False

    def keeps_clearance(self, q: Float[ndarray, "n dof"]) -> bool:
        """Whether the way through configurations keeps clearance and constraints."""
        return corner_kept(self.constraints, q) and super().keeps_clearance(q)

    def offer(self, path: Float[ndarray, "n dof"], stage: str) -> bool:
        """Take a path between the ends that keeps the limits, simplified, if it is the shortest so far."""
        settings = self.settings
        path = constrained_kernel.simplify(self.limits, path, settings.smoothings, SHORTCUTS, self._state)
        length = constrained_kernel.length(path)
        return bool(length < self.length) and self._take(path, length, stage)

    def refuse(self, accepted: Float[ndarray, "n dof"] | None) -> None:
        """See `AnytimeSearch`."""
        super().refuse(accepted)
        self._trees = None

    def _enter(self, level: int) -> None:
        super()._enter(level)
        self.limits = constrained_kernel.Limits(self.space, self.constraints.rows, self.kept)

    def _straight(self) -> None:
        for goal in sorted(self.goals, key=lambda goal: float(np.linalg.norm(goal - self.start))):
            path = constrained_kernel.line(self.limits, self.start, goal)
            if len(path) and self.offer(path, self.name):
                self.found += 1
                return

    def _slice(self) -> None:
        settings = self.settings
        if (
            self._trees is None
            or self._trees.sizes.max() >= self._trees.nodes.shape[1] - constrained_kernel.MOST_PIECES
        ):
            room = settings.iterations + len(self.goals) + 2 * constrained_kernel.MOST_PIECES
            self._trees = constrained_kernel.make_trees(self.start, self.goals, room)
        path = constrained_kernel.search(self.limits, self._trees, settings.range, SLICE, self._state)
        self.work, self._tried = self.work + SLICE, self._tried + SLICE
        if len(path):
            self.found += 1
            self._trees = None
            self.offer(path, self.name)


def corner_kept(constraints: PathConstraints | None, q: Float[ndarray, "n dof"]) -> bool:
    """Whether the way through configurations, of a rounded corner say, keeps what the search keeps."""
    rows = q if len(q) > 1 else np.repeat(q, 2, axis=0)
    return constraints is None or constraints.first(rows, share=SHARE) is None
