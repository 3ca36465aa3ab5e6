"""A* and D* Lite on a lattice of configurations: classical graph searches as baselines.

A*: P. Hart, N. Nilsson and B. Raphael, "A formal basis for the heuristic determination of minimum cost
paths", IEEE Trans. SSC 1968. D* Lite: S. Koenig and M. Likhachev, "D* Lite", AAAI 2002.

In each planned joint, a node differs from the start by a multiple of `spacing`. An edge moves up to
`joints_per_move` joints by one step each; its cost is its length in joint space. Goals are nodes too, with
edges to the corners of the lattice cell around them. The result is the path along the lattice, without
shortcuts. The heuristic ignores obstacles, so a search fills a dead end completely before it leaves it.
Passages that are narrower than a step may be missed.

Both planners use the same compiled search from the goals to the start. A* inflates the heuristic. D* Lite
does not, so that its search can be repaired after obstacles or the start have moved. There are two
differences from the published D* Lite. A node and its edges are checked for collision only when the node is
expanded; until then, its rhs is a lower bound. And a repair visits all nodes, so it computes all keys again;
the published algorithm corrects old keys by k_m.
"""

from collections import namedtuple
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from itertools import combinations, product
from math import comb
from typing import Annotated

import numpy as np

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.collision.kernels.motions import make_scratch, motion_free
from robotdiffuse.collision.motions import FINEST_RESOLUTION
from robotdiffuse.core.errors import InputError, counted
from robotdiffuse.core.kernels import allocation_free, kernel
from robotdiffuse.core.settings import Bound, Count, Positive
from robotdiffuse.core.types import Configuration, Configurations, PlanResult, Status
from robotdiffuse.planning.context import PlanningContext
from robotdiffuse.planning.planner import CheckedSettings, Planner, ever_finer
from robotdiffuse.planning.start_goal import StartGoal, padded_space

CLOCK_INTERVAL = 4000  # approximate number of edges between two readings of the clock
MAX_MOVES = 100_000  # largest number of edges of a node
MAX_NODES = 2**62  # largest number of nodes of a lattice, since a node's place is an int64
STRICTNESS = 0.999  # factor on the heuristic, so that keys rise along every path in spite of rounding
HASH_FACTOR = 0x1E3779B97F4A7C15
Outcome = IntEnum("Outcome", "GOING FOUND EXHAUSTED FULL", start=0)  # result of a call of `search`
# A node. at: its place, the sum of its lattice coordinates times strides; -1 for a goal. g: its cost from the
# goals as of its last expansion [steps]. rhs: its cost from the goals by the neighbors' g [steps]. parent:
# the neighbor that gives rhs.
NODE = np.dtype([("at", "i8"), ("g", "f8"), ("rhs", "f8"), ("parent", "i8")])
# The arrays of a search. origin[dof]: the node with the lowest coordinates [rad]. counts[dof]: number of
# nodes along each joint; the first and the last are outside the limits. strides[dof]: change of `at` per step
# of each joint. moves, costs: what each edge adds to `at`, and its cost [steps]. goals: number of goals.
# corners: `at` of the nodes around them. inflation: factor on the heuristic; above 1, nodes are expanded only
# once, as in ARA* (M. Likhachev et al., NIPS 2003). slots: hash table from `at` to the index of a node.
# nodes, q: the nodes and their configurations; index 0 stands for no node; then come the goals, then the
# nodes of the lattice. queue: priority queue as a binary tree of maxima; its leaves are 1 / (1 + key), or 0
# if not queued. values: counters, see below. offers: costs of one node through each of its neighbors and
# goals [steps].
FIELDS = "origin spacing counts strides moves costs goals corners inflation slots nodes q queue "
Search = namedtuple("Search", FIELDS + "values offers space scratch", defaults=(None, ()))
NODES, EXPANSIONS, START = range(3)  # in `values`: number of nodes, number of expansions, index of the start


@allocation_free()
def find(s, at, add):
    """Index of the node at a place. With `add`, a new node is added. Returns 0 if there is no node, if the
    place is outside the limits, or if memory is full."""
    i = (at * HASH_FACTOR >> 32) & (len(s.slots) - 1)
    while s.slots[i] > 0 and s.nodes[s.slots[i]].at != at:
        i = (i + 1) & (len(s.slots) - 1)
    new = s.values[NODES]
    if s.slots[i] == 0 and add and new < len(s.nodes):
        inside = True
        for j in range(len(s.counts)):
            steps = at // s.strides[j] % s.counts[j]
            inside &= 0 < steps < s.counts[j] - 1
            s.q[new, j] = s.origin[j] + s.spacing * steps
        if inside:
            s.values[NODES] += 1
            s.slots[i] = new
            s.nodes[new].at = at
            s.nodes[new].g = s.nodes[new].rhs = np.inf
    return np.int64(s.slots[i])


@allocation_free()
def _distance(s, u, v):
    """Euclidean distance of two nodes, the sum of their differences over the joints, and the largest
    difference [steps]."""
    square = total = largest = 0.0
    for j in range(s.q.shape[1]):
        d = abs(np.float64(s.q[u, j]) - s.q[v, j]) / s.spacing
        square += d * d
        total += d
        largest = max(largest, d)
    return np.sqrt(square), total, largest


@allocation_free()
def _update_vertex(s, v):
    """UpdateVertex of D* Lite: sets the key of a node in the queue. The heuristic is the larger of two lower
    bounds on the cost to the start: the Euclidean distance, and the summed joint differences divided by
    sqrt(k), where k is the most joints that a move has. Such a move, of cost sqrt(k), lowers the sum by k."""
    node = s.nodes[v]
    queue = s.queue
    i = len(queue) // 2 + v
    queue[i] = 0.0
    if node.g != node.rhs:
        distance, total, _ = _distance(s, v, s.values[START])
        queue[i] = 1 / (1 + min(node.g, node.rhs) + s.inflation * max(distance, total / s.costs[-1]))
    while i > 1 and queue[i // 2] != max(queue[i], queue[i ^ 1]):
        queue[i // 2] = max(queue[i], queue[i ^ 1])
        i //= 2


@allocation_free()
def _choose_parent(s, v):
    """Sets rhs(v) = min over neighbors u of c(v, u) + g(u), and the parent. Edges are checked for collision
    in the order of these sums, until one is free."""
    node = s.nodes[v]
    q = s.q[v]
    node.rhs = np.inf
    for m in range(len(s.moves)):
        s.offers[m] = s.nodes[find(s, node.at + s.moves[m], False)].g + s.costs[m]
    # goals have their costs at the end of `offers`: goal 1 is the last
    for goal in range(1, s.goals + 1):
        distance, _, largest = _distance(s, v, goal)
        s.offers[-goal] = s.nodes[goal].g + distance if largest < 1 else np.inf
    while True:
        m = np.argmin(s.offers)
        if s.offers[m] >= node.rhs:
            return
        u = find(s, node.at + s.moves[m], False) if m < len(s.moves) else len(s.offers) - m
        if motion_free(s.space, s.q[u], q, s.scratch):
            node.rhs = s.offers[m]
            node.parent = u
        elif not motion_free(s.space, q, q, s.scratch):  # v itself collides, so none of its edges is free
            return
        s.offers[m] = np.inf


@allocation_free()
def _offer(s, u):
    """Offers node u, after its g has changed, to its neighbors as parent. A neighbor that is not expanded
    takes a cheaper parent without a collision check, which follows when the neighbor is expanded. An expanded
    neighbor chooses again, with collision checks, if u is cheaper than its parent; so does a neighbor with
    parent u if u has become more expensive. With an inflation above 1, expanded neighbors keep their
    parents."""
    for m in range(len(s.moves)):
        v = find(s, s.nodes[u].at + s.moves[m], True)
        node = s.nodes[v]
        cost = s.nodes[u].g + s.costs[m]
        if node.g < np.inf and s.inflation > 1:
            continue
        if (cost > node.rhs and node.parent == u) or (cost < node.rhs and node.g < np.inf):
            _choose_parent(s, v)
        elif cost < node.rhs:
            node.rhs = cost
            node.parent = u
        else:
            continue
        _update_vertex(s, v)


@kernel(nogil=True)
def search(s, expansions):
    """ComputeShortestPath of D* Lite, for up to `expansions` iterations; returns an Outcome."""
    start = s.nodes[s.values[START]]
    q = s.q[s.values[START]]
    blocked = not motion_free(s.space, q, q, s.scratch)
    for _ in range(expansions):
        if s.values[NODES] == len(s.nodes):
            return Outcome.FULL
        if blocked or (s.queue[1] <= 1 / (1 + start.rhs) and start.rhs == start.g):
            return Outcome.FOUND if start.rhs == start.g < np.inf else Outcome.EXHAUSTED
        # the node with the lowest key: follow the maxima from the root of the queue to a leaf
        u = 1
        while 2 * u < len(s.queue):
            u = 2 * u + (s.queue[2 * u] < s.queue[2 * u + 1])
        u -= len(s.queue) // 2
        node = s.nodes[u]
        bound = node.rhs
        if node.g > bound:
            _choose_parent(s, u)
        if node.rhs <= bound:
            s.values[EXPANSIONS] += 1
            node.g = node.rhs if node.g > node.rhs else np.inf
            _offer(s, u)
        _update_vertex(s, u)
    return Outcome.GOING


@kernel(nogil=True)
def update(s, start):
    """Adapts a search to a new scene or start: checks goals, expanded nodes and the edges to their parents,
    and computes all keys again."""
    s.values[START] = find(s, start, True)
    for goal in range(1, s.goals + 1):
        s.nodes[goal].g = 0.0 if motion_free(s.space, s.q[goal], s.q[goal], s.scratch) else np.inf
    for v in range(s.goals + 1, s.values[NODES]):
        if s.nodes[v].g < np.inf:
            _choose_parent(s, v)
            _offer(s, v)
        _update_vertex(s, v)


@kernel(nogil=True)
def connect(s, corners):
    """Connects nodes around goals with their best free neighbors or goals."""
    for at in corners:
        v = find(s, at, True)
        _choose_parent(s, v)
        _update_vertex(s, v)


@dataclass(frozen=True)
class DStarLiteSettings(CheckedSettings, name="d_star_lite"):
    spacing: Positive = 0.4
    """Step of the lattice [rad], or [m] for prismatic joints."""
    joints_per_move: Count = 1
    """Largest number of joints that an edge moves, each by one step. With 1, 2, 3 and 7 joints, paths are
    2.1, 1.6, 1.35 and 1.2 times as long as the straight line on problems of the family `rop`, the scenes of
    the paper. The more joints, the slower the search."""
    max_nodes: Annotated[int, Bound(least=1.0, most=2e9)] = 2_000_000
    """Largest number of nodes in memory, besides those around the goals; a node takes about 100 bytes."""


@dataclass(frozen=True)
class AStarSettings(DStarLiteSettings, name="a_star"):
    joints_per_move: Count = 2
    inflation: Annotated[float, Bound(least=1.0, most=1000.0)] = 1.5
    """Factor on the heuristic (weighted A*). Paths are at most this many times as long as the shortest path
    on the lattice; with 1, the shortest path is found, but for seven joints often not in time."""


class LatticeSearch:
    """Weighted A* with `AStarSettings`; D* Lite, which can be repaired, with `DStarLiteSettings`."""

    expansions = 0
    """Number of expanded nodes so far."""
    cost = np.inf
    """Length of the path that `run` found [rad]; infinite if it found none."""

    def __init__(
        self,
        checker: CollisionChecker,
        start: Configuration,
        goals: Configurations,
        settings: DStarLiteSettings,
    ) -> None:
        """Raises InputError for a lattice with too many nodes, or too many edges at a node."""
        self.goals = goals
        self._checks = settings.resolution, settings.clearance
        robot = checker.robot
        name = settings.settings_name
        spacing = settings.spacing
        # lattice coordinates: nodes along each joint, and one beyond each limit
        below, above = np.floor(np.array([start - robot.lower, robot.upper - start]) / spacing).clip(0) + 1
        counts = (below + above + 1).astype(np.int64)
        nodes = counts.prod(dtype=float)
        if nodes >= MAX_NODES:
            min_spacing = 1.1 * spacing * (nodes / MAX_NODES) ** (1 / robot.dof)
            raise InputError(
                f"{name}.spacing is {spacing:g}; use at least {min_spacing:.2g} for {robot.name}"
            )
        sizes = range(1, min(settings.joints_per_move, robot.dof) + 1)
        edges = sum(comb(robot.dof, size) * 2**size for size in sizes)
        if edges > MAX_MOVES:
            raise InputError(
                f"{name}.joints_per_move is {settings.joints_per_move}; on {robot.name} a node then has "
                f"{edges} edges; at most {MAX_MOVES} are possible"
            )
        # edges: all combinations of joints and signs
        moving = [joints for size in sizes for joints in combinations(range(robot.dof), size)]
        signed = [(joints, signs) for joints in moving for signs in product((1, -1), repeat=len(joints))]
        moves = np.array([np.bincount(*move, robot.dof) for move in signed], np.int64)
        costs = np.linalg.norm(moves, axis=1)
        strides = np.append(np.cumprod(counts[:0:-1])[::-1], 1)
        origin = start - spacing * below
        around = np.floor((goals - origin) / spacing)[:, None] + list(product((0, 1), repeat=robot.dof))
        corners = around[((around > 0) & (around < counts - 1)).all(axis=2)].astype(np.int64) @ strides
        inflation = getattr(settings, "inflation", 1.0) * STRICTNESS
        lattice = origin, spacing, counts, strides, moves @ strides, costs, len(goals), corners, inflation
        # memory, with the goals as the first nodes
        first = len(goals) + 1
        capacity = settings.max_nodes + len(corners) + first + 1
        size = 2 << capacity.bit_length()
        shapes = size, capacity, (capacity, robot.dof), size, 3, len(moves) + len(goals)
        kinds = np.int32, NODE, np.float32, float, np.int64, float
        self._search = s = Search(*lattice, *map(np.zeros, shapes, kinds))
        s.values[NODES] = first
        s.nodes["g"][0] = np.inf
        s.nodes["at"][1:first] = -1
        s.q[1:first] = goals
        self.update(checker, start)

    def update(self, checker: CollisionChecker, start: Configuration) -> None:
        """Adopt a changed scene and a new start, which must be a node of the lattice, and compute all keys
        again. For D* Lite, `run` then continues the search."""
        s = self._search
        at = np.round((start - s.origin) / s.spacing).astype(np.int64) @ s.strides
        space = padded_space(checker, np.vstack([start, self.goals]), *self._checks)
        self._search = s._replace(space=space, scratch=make_scratch(space, space.lower))
        update(self._search, at)
        self._unconnected = s.corners

    def run(self, stop: Callable[[], bool] = lambda: False) -> Outcome:
        """Search until a path is found (FOUND), it is certain that there is none (EXHAUSTED), memory is full
        (FULL), or `stop` returns True (GOING)."""
        s = self._search
        batch = max(CLOCK_INTERVAL // len(s.moves), 1)
        while len(self._unconnected):
            connect(s, self._unconnected[:batch])
            self._unconnected = self._unconnected[batch:]
            if len(self._unconnected) and stop():
                self.cost = np.inf
                return Outcome.GOING
        while True:
            outcome = Outcome(search(s, batch))
            self.expansions = int(s.values[EXPANSIONS])
            if outcome is not Outcome.GOING or stop():
                cost = s.nodes["g"][s.values[START]] if outcome is Outcome.FOUND else np.inf
                self.cost = float(cost * s.spacing)
                return outcome

    def path(self) -> Configurations | None:
        """The path that `run` found: start, nodes where it turns, and goal; None without a path."""
        s = self._search
        if self.cost == np.inf:
            return None
        path = [s.values[START]]
        while path[-1] > s.goals:
            path.append(s.nodes["parent"][path[-1]])
        turns = np.diff(np.diff(s.nodes["at"][path]), prepend=0, append=0) != 0
        return s.q[path][turns].astype(float)


class AStar(Planner[DStarLiteSettings]):
    """Weighted A* on a lattice. Its path depends on the seed only if the goal is a pose."""

    name = "a_star"
    settings_class = AStarSettings

    def solve(self, context: PlanningContext, start_goal: StartGoal) -> PlanResult:
        """See `planning.planner.Planner`."""
        for settings in ever_finer(context, self.settings):
            search = LatticeSearch(start_goal.checker, *start_goal.leads(), settings)
            outcome = search.run(lambda: context.remaining <= 0)
            after = f"after {counted(search.expansions, 'expansion')}"
            path = search.path()
            if path is None:
                spacing = f"{self.name}.spacing (now {settings.spacing:g} rad)"
                reason = {
                    Outcome.FULL: f"memory is full {after}; take a coarser {spacing} or more max_nodes",
                    Outcome.EXHAUSTED: f"there is no path on the lattice; a finer {spacing} may have one",
                    Outcome.GOING: f"time ran out {after}; a coarser {spacing} searches faster",
                }[outcome]
                return context.fail(Status.TIMEOUT if outcome == Outcome.GOING else Status.NO_PATH, reason)
            result = context.finish(start_goal.complete(path), self.name, f"solved by {self.name} {after}")
            if result is not None:
                return result
            if settings.resolution <= FINEST_RESOLUTION:
                break
        return context.unsolved("the validator refused every path; a larger clearance may help")


class DStarLite(AStar):
    name = "d_star_lite"
    settings_class = DStarLiteSettings
