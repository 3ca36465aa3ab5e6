"""RRT-Connect with simplification: a fast classical planner; with restarts, the control for the others."""

from dataclasses import dataclass

from robotdiffuse.core.results import PlanResult
from robotdiffuse.core.settings import Count, NotNegative
from robotdiffuse.planning import CLEARANCE, PATH_CONSTRAINTS
from robotdiffuse.planning.context import PlanningContext
from robotdiffuse.planning.planner import Planner
from robotdiffuse.planning.search.anytime import anytime
from robotdiffuse.planning.search.anytime_search import CLOCK_INTERVAL, AnytimeSearch, SearchSettings
from robotdiffuse.planning.start_goal import StartGoal


@dataclass(frozen=True)
class RRTConnectSettings(SearchSettings, name="rrt_connect"):
    searches: Count = 2
    """With until "converged": number of paths to find; the shortest is returned."""
    optimize_time: NotNegative = 0.0
    """With until "converged": time for restarts after the first path [s]."""


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
            from robotdiffuse.planning.search.constrained import plan_constrained

            return plan_constrained(context, start_goal, settings)
        search = AnytimeSearch(context, start_goal, settings, self.name, bounded=False)

        def improves() -> bool:
            return (
                search.found < settings.searches or context.elapsed < search.first_at + settings.optimize_time
            )

        return anytime(
            context, search, improves, lambda: search.improve(context.search_until, CLOCK_INTERVAL)
        )
