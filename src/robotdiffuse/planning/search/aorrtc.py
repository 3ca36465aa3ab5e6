"""AORRTC: a first path by RRT-Connect, then ever shorter ones by searches below a bound.

Each round has fresh trees, which hold no path that is longer than a little above the best one known; what a
round finds is simplified and tightened, and bounds the next if it is shorter.
"""

from dataclasses import dataclass
from typing import Annotated

from robotdiffuse.core.results import PlanResult
from robotdiffuse.core.settings import Bound, Natural
from robotdiffuse.planning.context import PlanningContext
from robotdiffuse.planning.planner import CLEARANCE, CONSTRAINTS, Planner
from robotdiffuse.planning.search.anytime import AnytimeSearch, SearchSettings, anytime
from robotdiffuse.planning.start_goal import StartGoal

STEP = 1_000
"""Iterations between two questions whether more of them pay."""


@dataclass(frozen=True)
class AORRTCSettings(SearchSettings, name="aorrtc"):
    gain: Annotated[float, Bound(least=0.0, below=1.0)] = 0.005
    """Until "converged", the search ends when its last doubling took off a smaller share of the length ..."""
    patience: Natural = 8_000
    """... but not before so many iterations."""


class AORRTC(Planner[AORRTCSettings]):
    """Asymptotically optimal RRT-Connect (T. Wilson et al., 2025), anytime."""

    name = "aorrtc"
    settings_class = AORRTCSettings
    keeps = frozenset({CONSTRAINTS, CLEARANCE})

    def solve(self, context: PlanningContext, start_goal: StartGoal) -> PlanResult:
        """See `planning.planner.Planner`."""
        settings = self.settings
        if context.problem.constraints:
            from robotdiffuse.planning.search.constrained import plan_constrained

            return plan_constrained(context, start_goal, settings)
        search = AnytimeSearch(context, start_goal, settings, self.name)
        return anytime(
            context,
            start_goal,
            search,
            lambda: search.pays(settings.gain, settings.patience),
            lambda: search.improve(context.search_until, STEP),
        )
