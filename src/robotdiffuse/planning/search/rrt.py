"""The planners RRT-Connect and AORRTC, anytime, also under path constraints."""

from dataclasses import dataclass
from typing import Annotated

from robotdiffuse.core.loading import loading
from robotdiffuse.core.results import PlanResult
from robotdiffuse.core.settings import Bound, Count, Natural, NotNegative
from robotdiffuse.planning import CLEARANCE, PATH_CONSTRAINTS
from robotdiffuse.planning.context import PlanningContext
from robotdiffuse.planning.planner import Planner
from robotdiffuse.planning.search.anytime import AnytimeSearch, SearchSettings, anytime
from robotdiffuse.planning.start_goal import StartGoal

IMPROVEMENT_STEP = 1_000
"""Iterations of AORRTC between two checks whether to search on."""


@dataclass(frozen=True)
class AORRTCSettings(SearchSettings, name="aorrtc"):
    gain: Annotated[float, Bound(least=0.0, below=1.0)] = 0.0025
    """With until "converged", the search ends when doubling its work shortened the path by less than this
    part ..."""
    patience: Natural = 16_000
    """... but not before this many iterations."""


@dataclass(frozen=True)
class RRTConnectSettings(SearchSettings, name="rrt_connect"):
    searches: Count = 2
    """With until "converged": number of paths to find; the shortest is returned."""
    optimize_time: NotNegative = 0.0
    """With until "converged": time for restarts after the first path [s]."""


class AORRTC(Planner[AORRTCSettings]):
    """Asymptotically optimal RRT-Connect (T. Wilson et al., 2025), anytime."""

    name = "aorrtc"
    settings_class = AORRTCSettings
    supports = frozenset({PATH_CONSTRAINTS, CLEARANCE})

    def solve(self, context: PlanningContext, start_goal: StartGoal) -> PlanResult:
        """See `planning.planner.Planner`."""
        settings = self.settings
        if context.problem.constraints:
            return plan_constrained(context, start_goal, settings)
        search = AnytimeSearch.of(context, start_goal, settings, self.name)
        return anytime(
            context,
            search,
            lambda: search.improves(settings.gain, settings.patience),
            lambda: search.improve(IMPROVEMENT_STEP),
        )


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
            return plan_constrained(context, start_goal, settings)
        search = AnytimeSearch.of(context, start_goal, settings, self.name, bounded=False)

        def improves() -> bool:
            restarts_end = context.first_path_at + settings.optimize_time
            return search.found < settings.searches or context.elapsed < restarts_end

        return anytime(context, search, improves, lambda: search.improve(search.clock_interval))


def plan_constrained(context: PlanningContext, start_goal: StartGoal, settings: SearchSettings) -> PlanResult:
    """Plan for a problem with path constraints."""
    with loading():
        from robotdiffuse.planning.search.constrained import PATHS_TO_FIND, ConstrainedSearch

    search = ConstrainedSearch(context, start_goal, settings)
    return anytime(
        context, search, lambda: search.found < PATHS_TO_FIND, lambda: search.improve(search.clock_interval)
    )
