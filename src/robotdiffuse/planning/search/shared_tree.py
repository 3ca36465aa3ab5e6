"""Shared-Tree Informed RRT*, the paper's planner for training data: one tree, many goals, a safety distance.

The parts of the paper's section on data sets, their implementation here, and how the authors' code differs:

- *Shared spanning tree*: one tree from the start grows towards all goal configurations of a target pose at
  once. Every goal has its own best cost; the cheapest path is returned. Goals are drawn at random, weighted
  by how much they are expected to improve the path (`draw_goal`). The authors take goals in turn.
- *Informed*: samples come from the prolate hyperspheroid of the drawn goal (`rrt_kernel.sample_within`;
  J. Gammell et al., IROS 2014). The authors reject uniform samples instead.
- *RRT\\**: choose-parent and rewiring consider the k nearest nodes, with k = e (1 + 1/d) ln n as asymptotic
  optimality requires (S. Karaman and E. Frazzoli, IJRR 2011; `add_node`). The authors rewire within a fixed
  radius of 1.2 and have choose-parent commented out.
- *Node security defense*: nodes and edges keep a safety distance to obstacles. The distance is smaller near a
  start or goal that is closer to obstacles itself (`collision.kernels.motions.padding_near`). If no path is
  found, the distance is lowered in steps; results state the final distance. The authors enlarge obstacles by
  5 cm.
- *Cost*: joint-space length. The authors' cost is the length of the end effector's path plus a small term for
  its orientation, so detours of the joints cost little.

In addition to the paper's method, two steps lower the cost within milliseconds, so that the hyperspheroids
shrink early. In each round, RRT-Connect searches for one path, which is shortened and added to the tree if it
is the shortest to its goal; and the best path is shortened. Both steps add the shorter path as a new branch
and attach the goal's node to it. All other nodes stay as they are, so the tree remains a tree of RRT*.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy import ndarray

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.collision.kernels.motions import (
    distance,
    make_scratch,
    motion_free,
    motions_free,
    path_length,
)
from robotdiffuse.collision.kernels.random import random, random_state
from robotdiffuse.core.kernels import ONE, ZERO, allocation_free, kernel
from robotdiffuse.core.settings import Count, NotNegative, Positive, Settings
from robotdiffuse.core.types import Configuration, Configurations, PlanResult, Values
from robotdiffuse.planning.context import PlanningContext
from robotdiffuse.planning.planner import Planner, ever_finer
from robotdiffuse.planning.search import rrt_kernel
from robotdiffuse.planning.search.rrt_kernel import INFINITE, add, nearest_few, rewire
from robotdiffuse.planning.start_goal import StartGoal, falling_clearances, padded_space
from robotdiffuse.trajectories.simplification import simplify, tighten

CAPACITY = 500_000
"""Largest number of nodes of the tree. The operating system allocates their memory only when it is used."""
GOAL_BIAS = np.float32(0.1)
"""While the drawn goal is not reached: fraction of samples that are the goal itself."""
GAIN = np.float32(1e-4)
"""A cost must fall by more than this fraction to count as lower; smaller differences are rounding errors."""
NEIGHBORS = 64
"""Largest number of near neighbors; e (1 + 1 / dof) ln n is below it up to 10^8 nodes of 7 joints."""
REMAINING_EXCESS = np.float32(0.5)
"""Expected final excess of a goal's cost over the straight line, as a fraction of the current excess."""
MIN_PROMISE = np.float32(0.03)
"""Once a path is known, `draw_goal` adds this to the promise of each goal. So every goal that may still have
the shortest path is drawn at times."""
TIGHTENINGS = 200
"""Number of attempts to shorten a path."""


class Goals(NamedTuple):
    """The goals of the tree."""

    at: np.ndarray
    """[k, dof] goal configurations."""
    node: np.ndarray
    """[k] node of the tree at each goal; -1 until the goal is reached."""
    bound: np.ndarray
    """[k] straight distance from the start, a lower bound of the path length [rad]."""
    failures: np.ndarray
    """[k] number of failed searches of RRT-Connect in which this goal was the only target."""


def make_goals(start: Configuration, goals: Configurations) -> Goals:
    """Goals that are not reached yet, for a tree from a start."""
    at = goals.astype(np.float32)
    count = len(at)
    bound = np.linalg.norm(at - start, axis=1).astype(np.float32)
    return Goals(at, np.full(count, -1, np.int32), bound, np.zeros(count, np.float32))


@allocation_free()
def _goal_cost(trees, goals, g):
    node = goals.node[g]
    return trees.costs[0, node] if node >= 0 else INFINITE


@allocation_free()
def _best_cost(trees, goals):
    best = INFINITE
    for g in range(len(goals.at)):
        best = min(best, _goal_cost(trees, goals, g))
    return best


@allocation_free()
def _is_open(goals, g, best):
    """Whether a path to the goal might still be shorter than the best one to any goal."""
    return goals.bound[g] < best * (ONE - GAIN)


@allocation_free(inner=False)
def draw_goal(trees, goals, state):
    """Draw a goal with a probability proportional to its promise; -1 if no path can be shortened.

    The promise of a goal is the expected reduction of the best cost: how far the goal's path would be below
    the best cost if only REMAINING_EXCESS of its excess over the straight line remained. While no goal is
    reached, nearer goals have more promise. Failed searches in which a goal was the only target lower its
    promise.
    """
    best = _best_cost(trees, goals)
    total = ZERO
    chosen = -1
    for g in range(len(goals.at)):
        if not _is_open(goals, g, best):
            continue
        bound = goals.bound[g]
        if best < INFINITE:
            # a goal without a path, or with a long one, counts as reached at 1.5 times the best cost
            cost = min(_goal_cost(trees, goals, g), np.float32(1.5) * best)
            hope = best - bound - REMAINING_EXCESS * (cost - bound)
            promise = max(hope / best, ZERO) + MIN_PROMISE
        else:
            promise = ONE / (bound * bound + np.float32(0.1))
        promise /= ONE + goals.failures[g]
        total += promise
        # reservoir sampling: one pass and no array of promises
        if random(state) * total < promise:
            chosen = g
    return chosen


@allocation_free()
def _draw(space, trees, goals, g, state, out):
    """Write a sample for goal g to `out`: the goal itself with the probability GOAL_BIAS until it is reached;
    otherwise from its hyperspheroid, or from the joint range while there is no path."""
    best = _best_cost(trees, goals)
    if goals.node[g] < 0 and random(state) < GOAL_BIAS:
        for j in range(len(out)):
            out[j] = goals.at[g, j]
    elif best < INFINITE:
        rrt_kernel.sample_within(space, trees.nodes[0, 0], goals.at[g], best, out, state)
    else:
        rrt_kernel.sample_box(space, out, state)


@allocation_free()
def _remaining(goals, q, best):
    """A lower bound of the cost from q to any goal whose path may still become shorter."""
    h_hat = INFINITE
    for g in range(len(goals.at)):
        if _is_open(goals, g, best):
            h_hat = min(h_hat, distance(q, goals.at[g]))
    return h_hat


@allocation_free()
def add_node(space, trees, goals, q, scratch, index, gaps):
    """Extend of RRT* (Karaman and Frazzoli, IJRR 2011, algorithm 6) with q as x_new.

    q becomes a child of the near node through which its cost is lowest, and then the parent of near nodes
    whose cost is lower through q. Returns the node of q; -1 if q cannot improve any path, cannot be reached
    or is a copy of a node.

    index, gaps: memory for the near nodes X_near and their distances.
    """
    # k of k-nearest RRT*: S. Karaman and E. Frazzoli, IJRR 2011, e (1 + 1 / d) ln n
    k_nearest = np.ceil(np.e * (1.0 + 1.0 / len(q)) * np.log(trees.sizes[0] + 1.0))
    count = nearest_few(trees, 0, q, index[: min(int(k_nearest), NEIGHBORS)], gaps)
    nodes = trees.nodes[0]
    costs = trees.costs[0]
    best = _best_cost(trees, goals)
    remaining = _remaining(goals, q, best)
    for i in range(count):
        gaps[i] = np.sqrt(gaps[i])
    # x_min, the parent of least cost. Parents are tried in the order of cost, since usually the edge from the
    # first is free. A negative distance marks a node whose edge collides.
    while True:
        chosen = -1
        cost = INFINITE
        for i in range(count):
            if gaps[i] >= ZERO and costs[index[i]] + gaps[i] < cost:
                chosen = i
                cost = costs[index[i]] + gaps[i]
        # no edge is free, q cannot improve a path, or q is a copy of a node
        if chosen < 0 or cost + remaining >= best or gaps[chosen] <= np.float32(1e-6):
            return -1
        parent = index[chosen]
        if motion_free(space, nodes[parent], q, scratch):
            break
        gaps[chosen] = -ONE - gaps[chosen]
    node = add(trees, 0, q, cost, parent)
    # rewire: x_new becomes the parent of the near nodes that it reaches more cheaply
    for i in range(count):
        near = index[i]
        through = cost + gaps[i]
        if gaps[i] < ZERO or near == parent or through >= costs[near] * (ONE - GAIN):
            continue
        if motion_free(space, q, nodes[near], scratch):
            rewire(trees, 0, near, node, through)
    return node


@allocation_free()
def _reach(trees, goals, g, node, cost):
    """Make a node the parent of the goal's node, with `cost` as the goal's cost. If the goal is not reached
    yet, its node is added to the tree."""
    if goals.node[g] < 0:
        goals.node[g] = add(trees, 0, goals.at[g], cost, node)
    else:
        rewire(trees, 0, goals.node[g], node, cost)


@allocation_free()
def _try_goals(space, trees, goals, node, drawn, longest, scratch):
    """Connect the node to the drawn goal and to goals up to `longest` away, where this lowers the goal's
    cost."""
    for g in range(len(goals.at)):
        gap = distance(trees.nodes[0, node], goals.at[g])
        cost = trees.costs[0, node] + gap
        # a goal gets its own first path even if another goal's path is shorter
        if (g != drawn and gap > longest) or cost >= _goal_cost(trees, goals, g) * (ONE - GAIN):
            continue
        if motion_free(space, trees.nodes[0, node], goals.at[g], scratch):
            _reach(trees, goals, g, node, cost)


@kernel(nogil=True)
def grow(space, trees, goals, longest, iterations, state):
    """RRT* iterations with extensions of at most `longest` [rad]; they end early when the tree is full or no
    path can be shortened."""
    index = np.empty(NEIGHBORS, np.int32)
    gaps = np.empty(NEIGHBORS, np.float32)
    scratch = make_scratch(space, trees.nodes)
    _grow(space, trees, goals, longest, iterations, state, scratch, index, gaps)


@allocation_free()
def _grow(space, trees, goals, longest, iterations, state, scratch, index, gaps):
    x_new = scratch.a
    x_rand = scratch.b
    for _ in range(iterations):
        if trees.sizes[0] + len(goals.at) >= trees.nodes.shape[1]:
            return
        g = draw_goal(trees, goals, state)
        if g < 0:
            return
        _draw(space, trees, goals, g, state, x_rand)
        x_nearest = trees.nodes[0, rrt_kernel.nearest(trees, 0, x_rand, INFINITE)]
        # Steer
        share = min(longest / max(distance(x_nearest, x_rand), np.float32(1e-6)), ONE)
        for j in range(len(x_new)):
            x_new[j] = x_nearest[j] + share * (x_rand[j] - x_nearest[j])
        node = add_node(space, trees, goals, x_new, scratch, index, gaps)
        if node >= 0:
            _try_goals(space, trees, goals, node, g, longest, scratch)


@kernel()
def graft(trees, goals, path, g):
    """Add a free path from the start to goal g as a branch if no path to this goal is as short, and if there
    is room in the tree."""
    if path_length(path) >= _goal_cost(trees, goals, g) * (ONE - GAIN):
        return
    if trees.sizes[0] + len(path) >= trees.nodes.shape[1]:
        return
    node = 0
    cost = ZERO
    for i in range(1, len(path) - 1):
        cost += distance(path[i - 1], path[i])
        node = add(trees, 0, path[i], cost, node)
    _reach(trees, goals, g, node, cost + distance(path[len(path) - 2], path[len(path) - 1]))


@dataclass(frozen=True)
class SharedTreeSettings(Settings, name="shared_tree_rrt_star"):
    safety_distance: NotNegative = 0.05
    """Distance to obstacles that nodes and edges keep [m]; by default, as much as the authors enlarge
    obstacles."""
    step_rounds: Count = 4
    """Number of rounds without a path before the safety distance is lowered."""
    range: Positive = 1.0
    """Longest extension of a tree [rad, joint-space L2]."""
    resolution: Positive = 0.05
    """No point of the arm moves further than this between two checks of a motion [m]."""
    growth: Count = 150
    """Number of iterations of RRT* in a round."""
    connect_iterations: Count = 1_000
    """Largest number of iterations of RRT-Connect in a round."""
    rounds: Count = 100_000
    """Largest number of rounds."""
    improvement: NotNegative = 0.005
    """The search ends when the best cost fell by less than this fraction in the last `patience` rounds. 0:
    only `rounds`, the caller or a straight path ends a search; without a path, it does not give up early."""
    patience: Count = 20
    """Number of rounds over which `improvement` is measured."""


class SharedTreeSearch:
    """A search with its start, goals, tree, and costs so far. The same random state gives the same search."""

    def __init__(
        self,
        checker: CollisionChecker,
        start: Configuration,
        goals: Configurations,
        settings: SharedTreeSettings,
        state: ndarray,
    ) -> None:
        """Start and goals must be free of collision. state: of the random generator, from `random_state`."""
        self.checker = checker
        self.settings = settings
        self.start = start.astype(np.float32)
        self.goals = goals.astype(np.float32)
        self.tree = rrt_kernel.make_trees(self.start, self.goals[:0], CAPACITY)
        self.targets = make_goals(self.start, self.goals)
        self.costs = list[float]()
        """The best cost after each round [rad], infinite while there is no path."""
        self._longest = np.float32(settings.range)
        self._state = state
        self._ends = np.vstack([self.start, self.goals])
        self._later_distances = falling_clearances(settings.safety_distance, checker, self._ends)
        """Safety distances that were not tried yet, falling [m]."""
        self._lower_distance()

    @property
    def goal_costs(self) -> Values:
        """The length of the best path to each goal [rad]; infinite where there is none."""
        nodes = self.targets.node
        return np.where(nodes >= 0, self.tree.costs[0, nodes], np.inf)

    @property
    def cost(self) -> float:
        """The length of the best path to any goal [rad]; infinite if there is none."""
        return float(self.goal_costs.min())

    @property
    def best_goal(self) -> int:
        """The goal that the best path leads to; -1 if there is no path."""
        return int(self.goal_costs.argmin()) if (self.targets.node >= 0).any() else -1

    def path(self) -> Configurations | None:
        """Waypoints of the best path; None if there is none."""
        # without a path, `best_goal` is -1, the last goal; it has no node, and its branch is empty
        path = rrt_kernel.branch(self.tree, 0, self.targets.node[self.best_goal])
        return path if len(path) else None

    @property
    def finished(self) -> bool:
        """Whether the search should end: the best path is a straight line, paths hardly improve any more, no
        path was found at any safety distance, or the largest number of rounds is reached."""
        settings = self.settings
        costs = self.costs
        if self.cost < np.inf:
            if self.targets.bound.min() >= self.cost * (1 - GAIN):
                return True
            if settings.improvement > 0 and len(costs) > settings.patience:
                before = costs[-1 - settings.patience]
                if before < np.inf and before - costs[-1] < settings.improvement * before:
                    return True
        elif (
            settings.improvement > 0
            and not self._later_distances
            and self._rounds_at_distance >= 3 * settings.step_rounds
        ):
            # no path at any distance: give up after three times the usual number of rounds
            return True
        return len(costs) >= settings.rounds

    def run(self, stop: Callable[[], bool] = lambda: False) -> None:
        """Search until it is finished, or `stop` returns True."""
        while not (self.finished or stop()):
            self.round()

    def round(self) -> None:
        """Run a round: one path by RRT-Connect, RRT* iterations, and a shorter best path."""
        settings = self.settings
        g = draw_goal(self.tree, self.targets, self._state)
        if g >= 0:
            self._connect(np.arange(len(self.goals)) if self.best_goal < 0 else np.array([g]))
            grow(self._space, self.tree, self.targets, self._longest, settings.growth, self._state)
            path = self.path()
            if path is not None:
                self._graft(path, self.best_goal)
        self.costs.append(self.cost)
        self._rounds_at_distance += 1
        distance_tried = self._rounds_at_distance >= settings.step_rounds
        if self.best_goal < 0 and self._later_distances and distance_tried:
            self._lower_distance()

    def _lower_distance(self) -> None:
        """Go on with the next safety distance. The straight paths that are free at it are added to the tree.
        The tree stays valid, since safety distances only fall."""
        self.safety_distance = self._later_distances.pop(0)
        """Distance to obstacles that paths keep, except near a start or goal that is closer to them [m]."""
        self._rounds_at_distance = 0
        self._space = padded_space(self.checker, self._ends, self.settings.resolution, self.safety_distance)
        for g, goal in enumerate(self.goals):
            line = np.stack([self.start, goal])
            if motions_free(self._space, line)[0]:
                graft(self.tree, self.targets, line, g)

    def _connect(self, indices: ndarray) -> None:
        iterations = self.settings.connect_iterations
        trees = rrt_kernel.make_trees(self.start, self.goals[indices], 8 * iterations + len(indices))
        path = rrt_kernel.search(self._space, None, trees, INFINITE, self._longest, iterations, self._state)
        if len(path):
            self._graft(path, int(indices[np.abs(self.goals[indices] - path[-1]).max(axis=1).argmin()]))
        elif len(indices) == 1:
            self.targets.failures[indices] += 1

    def _graft(self, path: Configurations, g: int) -> None:
        shorter = tighten(self._space, simplify(self._space, path, 0), TIGHTENINGS, self._state)
        graft(self.tree, self.targets, shorter, g)


class SharedTreeRRTStar(Planner[SharedTreeSettings]):
    """Shared-Tree Informed RRT* as a planner: it ends when the path hardly improves or time runs out."""

    name = "shared_tree_rrt_star"
    settings_class = SharedTreeSettings

    def solve(self, context: PlanningContext, start_goal: StartGoal) -> PlanResult:
        """See `planning.planner.Planner`."""
        for attempt, settings in enumerate(ever_finer(context, self.settings)):
            state = random_state(context.request.seed, attempt)
            search = SharedTreeSearch(start_goal.checker, *start_goal.leads(), settings, state)

            def out_of_time(search: SharedTreeSearch = search) -> bool:
                if search.cost < np.inf:
                    context.improved(search.cost)
                return context.remaining <= 0

            search.run(out_of_time)
            path = search.path()
            if path is None:
                break
            reached = int(np.isfinite(search.goal_costs).sum())
            reason = (
                f"solved by {self.name}: round {len(search.costs)}, {reached} of {len(search.goals)} goals "
                f"reached, {100 * search.safety_distance:.0f} cm of safety distance, except near start and "
                "goal"
            )
            result = context.finish(start_goal.complete(path), self.name, reason)
            if result is not None:
                return result
        return context.unsolved()
