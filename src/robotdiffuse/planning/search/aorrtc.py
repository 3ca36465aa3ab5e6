"""AORRTC: a first path by RRT-Connect, then shorter ones by searches below a bound on length.

Each round grows new trees with paths little longer than the best one known. The path that a round finds is
simplified and tightened; if it is the shortest, it bounds the next round.
"""

from dataclasses import dataclass
from typing import Annotated

from robotdiffuse.core.results import PlanResult
from robotdiffuse.core.settings import Bound, Natural
from robotdiffuse.planning import CLEARANCE, PATH_CONSTRAINTS
from robotdiffuse.planning.context import PlanningContext
from robotdiffuse.planning.planner import Planner
from robotdiffuse.planning.search.anytime import anytime
from robotdiffuse.planning.search.anytime_search import AnytimeSearch, SearchSettings
from robotdiffuse.planning.start_goal import StartGoal

IMPROVEMENT_STEP = 1_000
"""Iterations between two checks whether to search on."""


@dataclass(frozen=True)
class AORRTCSettings(SearchSettings, name="aorrtc"):
    gain: Annotated[float, Bound(least=0.0, below=1.0)] = 0.0025
    """With until "converged", the search ends when doubling its work shortened the path by less than this
    part ..."""
    patience: Natural = 16_000
    """... but not before this many iterations."""


class AORRTC(Planner[AORRTCSettings]):
    """Asymptotically optimal RRT-Connect (T. Wilson et al., 2025), anytime."""

    name = "aorrtc"
    settings_class = AORRTCSettings
    supports = frozenset({PATH_CONSTRAINTS, CLEARANCE})

    def solve(self, context: PlanningContext, start_goal: StartGoal) -> PlanResult:
        """See `planning.planner.Planner`."""
        settings = self.settings
        if context.problem.constraints:
            from robotdiffuse.planning.search.constrained import plan_constrained

            return plan_constrained(context, start_goal, settings)
        search = AnytimeSearch(context, start_goal, settings, self.name)
        return anytime(
            context,
            search,
            lambda: search.improves(settings.gain, settings.patience),
            lambda: search.improve(context.search_until, IMPROVEMENT_STEP),
        )
