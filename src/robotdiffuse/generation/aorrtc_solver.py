"""AORRTC for data generation: the anytime loop of the planner `aorrtc`, limited by iterations instead of
time.

As in Shared-Tree Informed RRT*, paths keep a safety distance to obstacles, except near a start or goal that
is closer to them. The safety distance is lowered in steps if no path is found.
"""

from dataclasses import dataclass

import numpy as np
from numpy import ndarray

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.core.settings import Count, Natural, NotNegative, Positive, Settings, ShareBelowOne
from robotdiffuse.core.types import Configuration, Configurations, Values
from robotdiffuse.planning.search.rrt import AnytimeSearch, SearchSettings
from robotdiffuse.planning.start_goal import StartGoal, falling_clearances

ITERATIONS_PER_STEP = 500
"""Number of iterations between two checks whether the search must stop."""


@dataclass(frozen=True)
class AORRTCSearchSettings(Settings, name="aorrtc"):
    safety_distance: NotNegative = 0.05
    """Distance to obstacles that paths keep [m]; by default, as much as the paper's authors enlarge
    obstacles."""
    tries: Count = 1_500
    """The safety distance is lowered after this many iterations without a path. At the lowest distance, the
    search gives up after three times as many iterations."""
    range: Positive = 1.0
    """Longest extension of a tree [rad, joint-space L2]."""
    resolution: Positive = 0.02
    """No point of the arm moves further than this between two checks of a motion [m]."""
    gain: ShareBelowOne = 0.01
    """The search ends when the last doubling of the iterations shortened the path by less than this
    fraction."""
    patience: Natural = 4_000
    """Minimum number of iterations before `gain` can end the search."""


class AORRTCSearch:
    """A search and its present results. The same random state gives the same search."""

    def __init__(
        self,
        checker: CollisionChecker,
        start: Configuration,
        goals: Configurations,
        settings: AORRTCSearchSettings,
        state: ndarray,
    ) -> None:
        """Start and goals must be free of collision. `state`: a random state, see `random_state`."""
        self.settings = settings
        self.goals = goals.astype(np.float32)
        self._start_goal = StartGoal(checker, start.astype(np.float64), goals.astype(np.float64))
        distances = falling_clearances(settings.safety_distance, checker, np.stack([start, *goals]))
        self._levels = len(distances) + 2
        """Number of distances plus 2: at the lowest distance, `tries` iterations are made three times."""
        self._search = AnytimeSearch(
            self._start_goal,
            SearchSettings(range=settings.range, resolution=settings.resolution),
            "aorrtc",
            int(state[0] >> np.uint64(32)),
            distances,
            tries=settings.tries,
        )
        self.best_goal = -1
        """Index of the goal to which the path leads; -1 if there is no path."""

    def run(self) -> None:
        """Search until no path can be shorter, further iterations hardly shorten the path (`gain`), or the
        iterations without a path are used up."""
        settings = self.settings
        search = self._search
        if not search.first(work=settings.tries * self._levels):
            return
        while not search.shortest and search.improves(settings.gain, settings.patience):
            search.improve(ITERATIONS_PER_STEP)
        path = self.path()
        assert path is not None
        # find the goal that was reached; a continuous joint may end whole turns from the goal's value
        offsets = self.goals - path[-1]
        offsets -= self._start_goal.checker.robot.whole_turns(offsets)
        self.best_goal = int(np.abs(offsets).max(axis=1).argmin())
        self.goals[self.best_goal] = path[-1]

    @property
    def cost(self) -> float:
        """Length of the best path [rad]; infinite if there is no path."""
        return float(self._search.length)

    @property
    def goal_costs(self) -> Values:
        """For each goal, the length of the best path if it ends at this goal, otherwise infinity [rad]."""
        costs = np.full(len(self.goals), np.inf)
        if self.best_goal >= 0:
            costs[self.best_goal] = self.cost
        return costs

    @property
    def safety_distance(self) -> float:
        """Distance to obstacles that the path keeps, except near a start or goal that is closer [m]."""
        return self._search.clearance

    def path(self) -> Configurations | None:
        """Waypoints of the best path; None if there is no path."""
        best = self._search.best
        return None if best is None else self._start_goal.complete(best).astype(np.float32)
