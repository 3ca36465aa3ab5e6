"""Shared-Tree Informed RRT*, the paper's planner for data: one tree, many goals, a safety distance.

The parts of the paper's section on data sets, and where they are here:

- *Shared spanning tree*: one tree from the start is searched towards all goal configurations of a target
  pose at once; every goal keeps its own best cost, the cheapest one is returned. Goals are drawn
  by promise (`kernel.draw_goal`); the authors' code takes them in turn.
- *Informed*: samples come from the prolate hyperspheroid of the drawn goal (`kernel.sample_hyperspheroid`;
  J. Gammell et al., IROS 2014). The authors reject uniform samples instead.
- *RRT\\**: choose-parent and rewiring among the k nearest nodes, k = e (1 + 1/d) ln n, which asymptotic
  optimality needs (S. Karaman and E. Frazzoli, IJRR 2011; `kernel.add_node`). The authors rewire within a
  fixed radius of 1.2 and have choose-parent commented out. Neighbours come from a k-d tree.
- *Node security defence*: nodes and edges keep a safety distance to obstacles; near a start or goal that is
  itself closer it is relaxed in steps (`collision.kernels.motions.padding_near`), and if no path is
  found, the whole distance is lowered in steps. The authors enlarge the obstacles by 5 cm. The distance kept
  is recorded.
- *Cost*: joint-space length. The authors' is that of the end effector plus a little for orientation, which
  makes detours of the joints cheap.

Beyond the paper, to lower the cost within milliseconds: each round also asks RRT-Connect for one path,
shortens it, and adds it to the tree if it is the shortest to its goal; and it shortens the best path. So the
hyperspheroids shrink early. Both only add branches, so the tree remains one of RRT*.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.collision.kernels.compiled import random_state
from robotdiffuse.collision.kernels.motions import motions_free
from robotdiffuse.collision.motions import search_space
from robotdiffuse.core.results import PlanResult
from robotdiffuse.core.settings import Bound, Count, Natural, NotNegative, Positive, Settings
from robotdiffuse.planning.context import PlanningContext
from robotdiffuse.planning.planner import Planner, ever_finer
from robotdiffuse.planning.search import rrt_kernel as connect
from robotdiffuse.planning.search.shared_tree import kernel, tree
from robotdiffuse.planning.start_goal import StartGoal
from robotdiffuse.trajectories.simplification import shortcut

END_MARGIN = 0.0005
"""Near a start or goal closer than the safety distance, paths keep its clearance less this margin [m]."""


@dataclass(frozen=True)
class SharedTreeSettings(Settings, name="shared_tree_rrt_star"):
    safety_distance: NotNegative = 0.05
    """Distance to obstacles that nodes and edges keep [m]; the default is what the authors' scenes imply."""
    steps: Natural = 5
    """Steps in which the safety distance is lowered to zero if no path is found; the clearances of the start
    and of the goal farthest from obstacles are two more steps."""
    step_rounds: Count = 4
    """Rounds without a path before the safety distance is lowered."""
    range: Positive = 1.0
    """Longest extension of a tree [rad, joint-space L2]."""
    resolution: Positive = 0.05
    """No point of the arm moves further than this between two checks of a motion [m]."""
    goal_bias: Annotated[float, Bound(least=0.0, below=1.0)] = 0.1
    """Part of the samples that are at a goal, while it is not reached."""
    growth: Count = 150
    """Iterations of RRT* in a round."""
    connect_iterations: Count = 1_000
    """Most iterations of RRT-Connect in a round."""
    shortcuts: Natural = 20
    """Attempts to shorten a path."""
    rounds: Count = 100_000
    """Most rounds."""
    improvement: NotNegative = 0.005
    """The search ends when the best cost fell by less than this part in `patience` rounds; 0: never."""
    patience: Count = 20
    """See `improvement`."""
    capacity: Count = 2_000
    """Initial capacity of the tree [nodes]; it is doubled when the tree is full."""


class SharedTreeSearch:
    """One search: start, goals, the tree, and the costs so far. The same state gives the same search."""

    def __init__(
        self,
        checker: CollisionChecker,
        start: Float[ndarray, "dof"],
        goals: Float[ndarray, "k dof"],
        settings: SharedTreeSettings,
        state: ndarray,
    ) -> None:
        """Start and goals must be free of collision. `state` is that of `random_state`."""
        self.checker, self.settings, self.state = checker, settings, state
        self.start, self.goals = start.astype(np.float32), goals.astype(np.float32)
        self._ends = np.concatenate([self.start[None], self.goals])
        self._clearances = checker.link_clearances(self._ends).min(axis=1, initial=1.0)
        self.tree = tree.make_tree(self.start, self.goals, settings.capacity + len(goals))
        self.costs: list[float] = []
        """The best cost after each round [rad], infinite while there is no path."""
        self._distances = self._safety_distances()
        self._step = 0
        self._enter_step()

    @property
    def cost(self) -> float:
        """The length of the best path to any goal [rad]; infinite if there is none."""
        return float(tree.best_cost(self.tree))

    @property
    def goal_costs(self) -> Float[ndarray, "k"]:
        """The length of the best path to each goal [rad]; infinite where there is none."""
        return np.array([tree.goal_cost(self.tree, g) for g in range(len(self.goals))])

    @property
    def best_goal(self) -> int:
        """The goal that the best path leads to; -1 if there is no path."""
        return int(tree.best_goal(self.tree))

    @property
    def nodes(self) -> int:
        return int(self.tree.size[0])

    def path(self, goal: int | None = None) -> Float[ndarray, "n dof"] | None:
        """Waypoints of the best path, or of the best one to a goal; None if there is none."""
        g = self.best_goal if goal is None else goal
        return None if g < 0 or self.tree.goal_node[g] < 0 else tree.path_to(self.tree, g)

    @property
    def finished(self) -> bool:
        """Whether it is enough by the settings: no path can be shorter, or it hardly improves any more."""
        settings, costs = self.settings, self.costs
        if self.cost < np.inf:
            if not any(tree.goal_is_open(self.tree, g, self.cost) for g in range(len(self.goals))):
                return True
            if settings.improvement > 0 and len(costs) > settings.patience:
                before = costs[-1 - settings.patience]
                if before < np.inf and before - costs[-1] < settings.improvement * before:
                    return True
        elif self._step == len(self._distances) - 1 and self._rounds_at_step >= 3 * settings.step_rounds:
            # no path at any distance: give up after three times the usual number of rounds
            return settings.improvement > 0
        return len(costs) >= settings.rounds

    def run(self, stop: Callable[[], bool] = lambda: False) -> None:
        """Search until it is finished, or `stop` returns True."""
        while not (self.finished or stop()):
            self.round()

    def round(self) -> None:
        """Run a round: one path by RRT-Connect, RRT* iterations, and shortcuts of the best path."""
        settings = self.settings
        g = kernel.draw_goal(self.tree, self.state)
        if g >= 0:
            self._connect(np.arange(len(self.goals)) if self.best_goal < 0 else np.array([g]))
            self._grow()
            path = self.path()
            if path is not None:
                self._graft(path, self.best_goal)
        self.costs.append(self.cost)
        self._rounds_at_step += 1
        last = self._step == len(self._distances) - 1
        if self.best_goal < 0 and not last and self._rounds_at_step >= settings.step_rounds:
            self._step += 1
            self._enter_step()

    def _safety_distances(self) -> list[float]:
        """The safety distances to try, falling [m]."""
        most, steps = self.settings.safety_distance, max(self.settings.steps, 1)
        start_goal = (self._clearances[0], self._clearances[1:].max())
        between = {max(float(distance) - END_MARGIN, 0.0) for distance in start_goal if distance < most}
        return sorted({most * step / steps for step in range(steps + 1)} | between, reverse=True)

    def _enter_step(self) -> None:
        """Set the safety distance of the step; the tree stays valid, as distances only fall."""
        self.safety_distance = self._distances[self._step]
        """Distance to obstacles that paths keep, except near a start or goal that is closer [m]."""
        self._rounds_at_step = 0
        close = self._clearances < self.safety_distance
        allowed = np.maximum(self._clearances[close] - END_MARGIN, 0.0)
        near_ends = np.column_stack([self._ends[close], allowed])
        self._space = search_space(self.checker, self.settings.resolution, self.safety_distance, near_ends)
        for g, goal in enumerate(self.goals):
            line = np.stack([self.start, goal])
            if motions_free(self._space, line)[0]:
                tree.graft(self.tree, line, g)

    def _connect(self, targets: ndarray) -> None:
        settings = self.settings
        room = 8 * settings.connect_iterations + len(targets)
        trees = connect.make_trees(self.start, self.goals[targets], room)
        longest = np.float32(settings.range)
        path = connect.connect(self._space, trees, longest, settings.connect_iterations, self.state)
        if len(path):
            self._graft(path, int(targets[np.abs(self.goals[targets] - path[-1]).max(axis=1).argmin()]))
        elif len(targets) == 1:
            self.tree.failures[targets] += 1

    def _grow(self) -> None:
        settings, left = self.settings, self.settings.growth
        longest, bias = np.float32(settings.range), np.float32(settings.goal_bias)
        while True:
            left -= kernel.grow(self._space, self.tree, longest, bias, left, self.state)
            if left == 0 or not self._make_room(len(self.goals) + 1):
                return

    def _graft(self, path: Float[ndarray, "n dof"], g: int) -> None:
        shorter = shortcut(self._space, path, self.settings.shortcuts, self.state)
        self._make_room(len(shorter))
        tree.graft(self.tree, shorter, g)

    def _make_room(self, nodes: int) -> bool:
        """Double the tree's capacity if less than this is left; returns whether that was done."""
        if self.nodes + nodes < len(self.tree.nodes):
            return False
        self.tree = tree.grown(self.tree, 2 * (len(self.tree.nodes) + nodes))
        return True


class SharedTreeRRTStar(Planner[SharedTreeSettings]):
    """Shared-Tree Informed RRT* as an anytime planner: it ends when it hardly improves or time runs out."""

    name = "shared_tree_rrt_star"
    settings_class = SharedTreeSettings

    def solve(self, context: PlanningContext, start_goal: StartGoal) -> PlanResult:
        """See `planning.planner.Planner`."""
        for settings, attempt in ever_finer(context, self.settings):
            state = random_state(context.request.seed, attempt)
            search = SharedTreeSearch(start_goal.checker, *start_goal.rows(), settings, state)

            def out_of_time(search: SharedTreeSearch = search) -> bool:
                if search.cost < np.inf:
                    context.improved(search.cost)
                return context.remaining <= 0

            search.run(out_of_time)
            path = search.path()
            if path is None:
                break
            result = context.finish(start_goal.complete(path), self.name, reason=_reason(search))
            if result is not None:
                return result
        return context.unsolved()


def _reason(search: SharedTreeSearch) -> str:
    reached = int(np.isfinite(search.goal_costs).sum())
    return (
        f"solved by {SharedTreeRRTStar.name}: {len(search.costs)} rounds, {reached} of {len(search.goals)} "
        f"goals reached, {100 * search.safety_distance:.0f} cm of safety distance kept away from the ends"
    )
