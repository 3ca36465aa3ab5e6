"""AORRTC for data: the anytime loop of the planner `aorrtc`, ended by its work and not by the clock.

As in Shared-Tree Informed RRT*, paths keep a safety distance to obstacles, which is lowered in steps where
there is none, and which ends that are closer are exempt from.
"""

from collections.abc import Callable
from dataclasses import dataclass
from math import inf
from typing import Annotated

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.core.settings import Bound, Count, Natural, NotNegative, Positive, Settings
from robotdiffuse.planning.context import PlanningContext, PlanRequest
from robotdiffuse.planning.search.anytime import AnytimeSearch, SearchSettings
from robotdiffuse.planning.start_goal import END_MARGIN, StartGoal
from robotdiffuse.problems.problem import JointGoal, Problem
from robotdiffuse.robots.robot import TURN

STEP = 500
"""Iterations between two questions whether to go on."""
NO_LIMIT = 1e9
"""Of time: the search counts its iterations instead [s]."""


@dataclass(frozen=True)
class AORRTCSearchSettings(Settings, name="aorrtc"):
    safety_distance: NotNegative = 0.05
    """Distance to obstacles that paths keep [m]; the default is what the authors' scenes imply."""
    steps: Natural = 5
    """Steps in which it is lowered to zero where no path is found; one more is what the start has, and one
    what the goal farthest from obstacles has."""
    tries: Count = 1_500
    """Iterations without a path before it is lowered; three times as many at the last step end the search."""
    range: Positive = 1.0
    """Longest extension of a tree [rad, joint-space L2]."""
    resolution: Positive = 0.02
    """No point of the arm moves further than this between two checks of a motion [m]."""
    gain: Annotated[float, Bound(least=0.0, below=1.0)] = 0.01
    """The search ends when the last doubling of its work took off a smaller share of the length ..."""
    patience: Natural = 4_000
    """... but not before so many iterations."""


class AORRTCSearch:
    """One search: what was found so far. The same state gives the same search."""

    def __init__(
        self,
        checker: CollisionChecker,
        start: Float[ndarray, "dof"],
        goals: Float[ndarray, "k dof"],
        settings: AORRTCSearchSettings,
        state: ndarray,
    ) -> None:
        """Start and goals must be free of collision. `state` is that of `random_state`."""
        self.settings, self.goals = settings, goals.astype(np.float32)
        self._robot = checker.robot
        self._ends = StartGoal(checker, start.astype(np.float64), goals.astype(np.float64))
        problem = Problem(
            checker.robot, checker.scene, start.astype(np.float64), JointGoal(goals.astype(np.float64))
        )
        context = PlanningContext("aorrtc", problem, PlanRequest(NO_LIMIT, int(state[0] >> np.uint64(32))))
        has = checker.link_clearances(np.stack([start, *goals]).astype(np.float32)).min(axis=1, initial=1.0)
        self._distances = _falling(settings, (float(has[0]), float(has[1:].max())))
        search = SearchSettings(range=settings.range, resolution=settings.resolution)
        self._search = AnytimeSearch(
            context, self._ends, search, "aorrtc", clearances=self._distances, tries=settings.tries
        )
        self.best_goal = -1
        """The goal that the path leads to; -1 if there is none."""

    def run(self, stop: Callable[[], bool] = lambda: False) -> None:
        """Until no path can be shorter, more work does not pay, there seems to be no path, or `stop` says
        so."""
        settings, search = self.settings, self._search
        most = settings.tries * (len(self._distances) + 2)
        while search.best is None and search.work < most and not stop():
            search.first(inf, work=STEP)
        while search.best is not None and not (search.shortest or stop()):
            if not search.improves(settings.gain, settings.patience):
                break
            search.improve(inf, STEP)
        if search.best is not None:
            self._arrive(search.best)

    def _arrive(self, path: Float[ndarray, "n dof"]) -> None:
        """Note the goal; a continuous joint may end whole turns from the value that was given for it."""
        end = self._ends.complete(path)[-1]
        turns = np.abs(self.goals - end) / TURN
        apart = np.where(self._robot.continuous, np.abs(turns - np.round(turns)), turns).max(axis=1)
        self.best_goal = int(apart.argmin())
        self.goals[self.best_goal] = end

    @property
    def cost(self) -> float:
        """The length of the best path [rad]; infinite if there is none."""
        return float(self._search.length)

    @property
    def goal_costs(self) -> Float[ndarray, "k"]:
        """The length of the best path to the goal that it leads to [rad]; infinite for the others."""
        costs = np.full(len(self.goals), np.inf)
        if self.best_goal >= 0:
            costs[self.best_goal] = self.cost
        return costs

    @property
    def safety_distance(self) -> float:
        """Distance to obstacles that is kept but near ends that are closer themselves [m]."""
        return self._search.clearance

    def path(self) -> Float[ndarray, "n dof"] | None:
        """Waypoints of the best path; None if there is none."""
        best = self._search.best
        return None if best is None else self._ends.complete(best).astype(np.float32)


def _falling(settings: AORRTCSearchSettings, start_goal: tuple[float, float]) -> list[float]:
    """The safety distances that are tried [m]; `ends` are what the start has, and the goal that has most."""
    most, steps = settings.safety_distance, max(settings.steps, 1)
    between = {max(has - END_MARGIN, 0.0) for has in start_goal if has < most}
    return sorted({most * step / steps for step in range(steps + 1)} | between, reverse=True)
