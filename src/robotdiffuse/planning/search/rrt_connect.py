"""RRT-Connect with simplification: the fast classical planner, and with restarts the control of the
others."""

from dataclasses import dataclass

from robotdiffuse.core.results import PlanResult
from robotdiffuse.core.settings import Count, NotNegative
from robotdiffuse.planning.context import PlanningContext
from robotdiffuse.planning.planner import CLEARANCE, CONSTRAINTS, Planner
from robotdiffuse.planning.search.anytime import SLICE, AnytimeSearch, SearchSettings, anytime
from robotdiffuse.planning.start_goal import StartGoal


@dataclass(frozen=True)
class RRTConnectSettings(SearchSettings, name="rrt_connect"):
    searches: Count = 2
    """Until "converged": paths found, the shortest of which is the answer."""
    optimize_time: NotNegative = 0.0
    """... and time spent on restarts after the first path [s]."""


class RRTConnect(Planner[RRTConnectSettings]):
    """Two trees grown towards each other (Kuffner and LaValle, 2000), simplified; restarts while time is
    left."""

    name = "rrt_connect"
    settings_class = RRTConnectSettings
    keeps = frozenset({CONSTRAINTS, CLEARANCE})

    def solve(self, context: PlanningContext, start_goal: StartGoal) -> PlanResult:
        """See `planning.planner.Planner`."""
        settings = self.settings
        if context.problem.constraints:
            from robotdiffuse.planning.search.constrained import plan_constrained

            return plan_constrained(context, start_goal, settings)
        search = AnytimeSearch(context, start_goal, settings, self.name, bounded=False)

        def pays() -> bool:
            return (
                search.found < settings.searches or context.elapsed < search.first_at + settings.optimize_time
            )

        return anytime(context, start_goal, search, pays, lambda: search.improve(context.search_until, SLICE))
