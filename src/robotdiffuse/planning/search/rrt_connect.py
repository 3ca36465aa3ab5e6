"""RRT-Connect with simplification: the fast classical planner, and with restarts the control of the
others."""

from dataclasses import dataclass

from robotdiffuse.planning.search.anytime import SLICE, AnytimeSearch, SearchSettings, anytime
from robotdiffuse.planning.planner import CLEARANCE, CONSTRAINTS, Planner
from robotdiffuse.planning.context import Call
from robotdiffuse.planning.start_goal import Ends
from robotdiffuse.core.results import PlanResult
from robotdiffuse.core.settings import Count, NotNegative


@dataclass(frozen=True)
class RRTConnectSettings(SearchSettings, name="rrt_connect"):
    searches: Count = 2
    """Until "short": paths found, the shortest of which is the answer."""
    optimize_time: NotNegative = 0.0
    """... and time spent on restarts after the first path [s]."""


class RRTConnect(Planner[RRTConnectSettings]):
    """Two trees grown towards each other (Kuffner and LaValle, 2000), simplified; restarts while time is
    left."""

    name = "rrt_connect"
    settings_class = RRTConnectSettings
    keeps = frozenset({CONSTRAINTS, CLEARANCE})

    def solve(self, call: Call, ends: Ends) -> PlanResult:
        """See `planning.planner.Planner`."""
        settings = self.settings
        if call.problem.constraints:
            from robotdiffuse.planning.search.constrained import plan_constrained

            return plan_constrained(call, ends, settings)
        search = AnytimeSearch(call, ends, settings, self.name, bounded=False)

        def pays() -> bool:
            return search.found < settings.searches or call.elapsed < search.first_at + settings.optimize_time

        return anytime(call, ends, search, pays, lambda: search.improve(call.search_until, SLICE))
