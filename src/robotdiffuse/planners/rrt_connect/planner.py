"""RRT-Connect with shortcutting: the fast classical planner, and the one that answers when learning fails."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.collision.kernels.compiled import random_state
from robotdiffuse.collision.kernels.motions import path_length
from robotdiffuse.collision.motion import search_space
from robotdiffuse.paths.shortcut import shortcut
from robotdiffuse.planners.base import Planner, ever_finer
from robotdiffuse.planners.call import Call
from robotdiffuse.planners.ends import Ends
from robotdiffuse.planners.rrt_connect import kernel
from robotdiffuse.results import PlanResult
from robotdiffuse.settings import Count, Natural, NotNegative, Positive, Settings
from robotdiffuse.types import Path
from robotdiffuse.verify import VerifySettings, verifier

ITERATIONS = 2_000
"""Iterations between two looks at the clock."""


@dataclass(frozen=True)
class RRTConnectSettings(Settings, name="rrt_connect"):
    reach: Positive = 1.0
    """Longest extension of a tree [rad, joint-space L2]."""
    resolution: Positive = 0.05
    """No point of the arm moves further than this between two checks of a motion [m]; the judge's certificate
    covers the rest, and a path that it refuses is searched again at half the distance."""
    clearance: NotNegative = 0.002
    """Distance to obstacles that paths keep where start and goal allow it [m]."""
    searches: Count = 2
    """Paths found, the shortest of which is shortened: a search costs less than the shortcuts it saves."""
    shortcuts: Natural = 25
    """Attempts to shorten a path."""
    optimize_time: NotNegative = 0.0
    """Time spent on restarts and more shortcuts after the first path [s]; the shortest path is kept."""
    capacity: Count = 20_000
    """Most nodes of a tree; a full pair of trees is started anew."""


class RRTConnect(Planner[RRTConnectSettings]):
    """Two trees grown towards each other (Kuffner and LaValle, 2000), then shortcuts."""

    name = "rrt_connect"
    settings_class = RRTConnectSettings

    def first(self, call: Call, ends: Ends) -> Path | None:
        """A path that passes the judge, its motion not yet timed.

        None if ITERATIONS iterations find none, or the judge refuses it.
        """
        found = _Search(call, ends, self.settings, 0).shortened(call.elapsed)
        if found is None:
            return None
        path = Path(call.problem.robot.joint_names, ends.complete(found))
        return path if verifier(call.problem, VerifySettings()).path(path).valid else None

    def solve(self, call: Call, ends: Ends) -> PlanResult:
        """See `planners.base.Planner`."""
        for settings, attempt in ever_finer(call, self.settings):
            path = _Search(call, ends, settings, attempt).best()
            if path is None:
                break
            result = call.finish(ends.complete(path), self.name)
            if result is not None:
                return result
        return call.unsolved()


class _Search:
    """Paths between the ends of a call, not yet judged."""

    def __init__(self, call: Call, ends: Ends, settings: RRTConnectSettings, attempt: int) -> None:
        self.call, self.settings = call, settings
        self.space = search_space(ends.checker, settings.resolution, ends.kept_clearance(settings.clearance))
        self.state = random_state(call.seed, attempt)
        self.start, self.goals = ends.rows()

    def best(self) -> Float[ndarray, "n dof"] | None:
        """The first path, or the shortest after restarts for as long as the settings say."""
        best = self.shortened(self.call.time_limit)
        if best is None:
            return None
        until = min(self.call.elapsed + self.settings.optimize_time, self.call.time_limit)
        while self.call.elapsed < until:
            other = self.shortened(until)
            if other is not None:
                if path_length(other) < path_length(best):
                    best = other
                best = shortcut(self.space, best, self.settings.shortcuts, self.state)
        return best

    def shortened(self, until: float) -> Float[ndarray, "n dof"] | None:
        """The shortest of some paths, shortened; None if the first of them takes until `until` [s]."""
        best: ndarray | None = None
        for _ in range(self.settings.searches):
            path = self._path(until)
            if path is None:
                break
            if best is None or path_length(path) < path_length(best):
                best = path
        return None if best is None else shortcut(self.space, best, self.settings.shortcuts, self.state)

    def _path(self, until: float) -> Float[ndarray, "n dof"] | None:
        reach, capacity = np.float32(self.settings.reach), self.settings.capacity + len(self.goals)
        while True:
            trees = kernel.make_trees(self.start, self.goals, capacity)
            while trees.sizes.max() < capacity:
                path = kernel.search(self.space, trees, reach, ITERATIONS, self.state)
                if len(path):
                    return path
                if self.call.elapsed > until:
                    return None
