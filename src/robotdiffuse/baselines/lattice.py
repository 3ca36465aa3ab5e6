"""A* and D* Lite on a lattice of configurations: the classical graph searches, as baselines.

A*: P. Hart, N. Nilsson and B. Raphael, "A formal basis for the heuristic determination of minimum cost
paths", IEEE Trans. SSC 1968. D* Lite: S. Koenig and M. Likhachev, "D* Lite", AAAI 2002, optimized version.

In each planned joint, nodes lie whole steps of `spacing` from the start. Edges change one joint by a step (or
up to `joints_per_move` joints); their cost is joint-space length [rad]. The corners of the cell around a goal
are connected to it by exact last edges. The result is the path along the lattice, without shortcuts.

Limits, with seven joints: a node has 14 neighbors, or 2,186 if all joints may move at once, and a spacing of
0.3 rad makes 10^9 nodes. The heuristic ignores obstacles: before a search leaves a pocket, it fills it, and
that takes a time that grows with the seventh power of the pocket's width. Inflation trades length for speed.
Passages narrower than a step are not found: no path on the lattice does not mean no path. A path of
single-joint steps is up to sqrt(dof) times as long as the straight line that it follows.

Both planners are one compiled search from the goals to the start, over nodes that are created in a hash table
as they are reached. A* inflates the heuristic; D* Lite does not, so that its search can be repaired when
obstacles or the start have moved. A repair visits all nodes in any case, so it computes the keys of the queue
anew, where D* Lite as published keeps the old ones, which are lower by k_m.

Costs are integers, UNITS to a step of the lattice. Edges are rounded up and the heuristic down, so sums are
exact, the heuristic is exactly consistent, and both searches find the same cost.
"""

from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from itertools import combinations, product
from math import comb, sqrt
from typing import Annotated, NamedTuple

import numpy as np
from jaxtyping import Int
from numpy import ndarray

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.collision.kernels.lane_collision import W, block_hits, make_workspace
from robotdiffuse.collision.kernels.motions import Space, motion_free
from robotdiffuse.collision.motions import FINEST_RESOLUTION, largest_motion_radii, search_space
from robotdiffuse.core.errors import InputError
from robotdiffuse.core.kernels import allocation_free, kernel
from robotdiffuse.core.results import PlanResult
from robotdiffuse.core.settings import Bound, Count, NotNegative, Positive, Settings
from robotdiffuse.core.types import Configuration, Configurations, Status, Values
from robotdiffuse.planning.context import PlanningContext
from robotdiffuse.planning.planner import Planner, ever_finer
from robotdiffuse.planning.start_goal import StartGoal
from robotdiffuse.scenes.scene import Scene

INFINITE = 1 << 60
"""Cost of nodes that are not reached."""
UNITS = 1 << 20
"""Cost of one step of one joint."""
ROUNDING = 1e-3
"""Bound on rounding errors of floating point [units]."""
# States of nodes.
UNKNOWN = 0
FREE = 1
BLOCKED = 2
NODES, QUEUED, EXPANSIONS, START = range(4)
"""Places in `Search.values`."""
_FACTOR = np.uint64(0x9E3779B97F4A7C15)


class Outcome(IntEnum):
    """How a call of the search ends."""

    GOING = 0
    """It can be continued."""
    FOUND = 1
    EXHAUSTED = 2
    """There is no path on the lattice."""
    FULL = 3
    """`max_nodes` nodes are in use."""


class Lattice(NamedTuple):
    """The geometry of the lattice. Coordinates count steps from the lowest node of each joint."""

    origin: np.ndarray
    """[dof] the lowest node [rad]"""
    spacing: float
    """[rad]"""
    counts: np.ndarray
    """[dof] nodes along each joint."""
    strides: np.ndarray
    """[dof] a node's key is the sum of coordinates times strides."""
    moves: np.ndarray
    """[moves, dof] -1, 0 or 1; the second half are the negatives of the first."""
    costs: np.ndarray
    """[moves] [units]"""
    slope: float
    """Smallest cost of a move per joint that it moves [steps]."""


class Search(NamedTuple):
    """A search: its nodes, its queue, and its working memory."""

    lattice: Lattice
    goals: np.ndarray
    """[k, dof] [rad]"""
    last: np.ndarray
    """[n, 3] last edges: a node, a goal, and the cost."""
    inflation: float
    """Factor on the heuristic. If it is larger than 1, each node is expanded once; as the heuristic is
    consistent, the cost is still within this factor of the least (M. Likhachev et al., "ARA*", NIPS 2003)."""
    ties: int
    """Among nodes of equal first keys, 1 prefers smaller costs, as repairs need; -1 larger ones (faster)."""
    slots: np.ndarray
    """[a power of two] node + 1 at the place of its key or after it, 0 where empty."""
    keys: np.ndarray
    """[capacity]"""
    g: np.ndarray
    """[capacity] cost from the goals, by the last expansion [units]."""
    rhs: np.ndarray
    """[capacity] cost from the goals, by the neighbors' g [units]."""
    parent: np.ndarray
    """[capacity] the node that gives rhs, or -1 - goal."""
    base: np.ndarray
    """[capacity, 2] cost of the best last edge from the node [units], and its goal."""
    state: np.ndarray
    """[capacity]"""
    heap: np.ndarray
    """[capacity] queued nodes."""
    place: np.ndarray
    """[capacity] place in the heap + 1; 0 for nodes that are not queued."""
    first: np.ndarray
    second: np.ndarray
    """[capacity] the keys by which the queue is sorted."""
    values: np.ndarray
    """[4] numbers of nodes, queued nodes and expansions, and the start's node."""
    near: np.ndarray
    """[2, moves] the neighbors of two nodes, -1 for none."""
    at: np.ndarray
    """[2, dof] coordinates of two nodes, the second the start's."""
    pending: np.ndarray
    """[W] nodes to check."""
    ends: np.ndarray
    """[2, dof] of an edge."""
    block: np.ndarray
    space: Space
    work: tuple


@allocation_free()
def find(s, key, add):
    """The node of a key, added if it is new and `add`; -1 if there is none, or no memory for one."""
    i = np.int64((np.uint64(key) * _FACTOR) >> np.uint64(32)) & (len(s.slots) - 1)
    while s.slots[i] != 0 and s.keys[s.slots[i] - 1] != key:
        i = (i + 1) & (len(s.slots) - 1)
    node = s.values[NODES]
    if s.slots[i] == 0 and add and node < len(s.keys):
        s.values[NODES] += 1
        s.slots[i] = node + 1
        s.keys[node] = key
        s.g[node] = s.rhs[node] = s.base[node, 0] = INFINITE
        s.parent[node] = -1
    return np.int64(s.slots[i]) - 1


@kernel()
def add_nodes(s, keys):
    """The nodes of keys, added where they are new; -1 where memory is full."""
    return np.array([find(s, key, True) for key in keys])


@allocation_free()
def _before(s, a, b):
    return (s.first[a], s.second[a]) < (s.first[b], s.second[b])


@allocation_free()
def _settle(s, i, node):
    """Fill the gap at place i of the heap with a node, moved up or down to where its keys belong."""
    heap = s.heap
    while i > 0 and _before(s, node, heap[(i - 1) // 2]):
        heap[i] = heap[(i - 1) // 2]
        s.place[heap[i]] = i + 1
        i = (i - 1) // 2
    while 2 * i + 1 < s.values[QUEUED]:
        child = 2 * i + 1
        if child + 1 < s.values[QUEUED] and _before(s, heap[child + 1], heap[child]):
            child += 1
        if not _before(s, heap[child], node):
            break
        heap[i] = heap[child]
        s.place[heap[i]] = i + 1
        i = child
    heap[i] = node
    s.place[node] = i + 1


@allocation_free()
def _place_node(s, node, at, q):
    """Write the coordinates of a node, and its configuration."""
    for j in range(len(at)):
        at[j] = s.keys[node] // s.lattice.strides[j] % s.lattice.counts[j]
        q[j] = np.float32(s.lattice.origin[j] + s.lattice.spacing * at[j])


@allocation_free()
def _queue_key(s, node):
    """CalculateKey of D* Lite, without k_m.

    The heuristic, a consistent lower bound of the cost to the start, is the larger of the straight distance
    and the cost by joint: a move costs at least `slope` for each joint that it moves.
    """
    _place_node(s, node, s.at[0], s.ends[0])
    square = 0.0
    steps = 0.0
    for j in range(s.at.shape[1]):
        d = np.float64(abs(s.at[0, j] - s.at[1, j]))
        square += d * d
        steps += d
    bound = np.floor(UNITS * max(np.sqrt(square), steps * s.lattice.slope) - ROUNDING)
    cost = min(s.g[node], s.rhs[node])
    return cost + np.int64(s.inflation * max(bound, 0.0)), s.ties * cost


@allocation_free()
def _update_vertex(s, node):
    """UpdateVertex of D* Lite: a node is queued while it is inconsistent."""
    i = np.int64(s.place[node]) - 1
    if s.g[node] != s.rhs[node]:
        s.first[node], s.second[node] = _queue_key(s, node)
        if i < 0:
            i = s.values[QUEUED]
            s.values[QUEUED] += 1
        _settle(s, i, node)
    elif i >= 0:
        s.place[node] = 0
        s.values[QUEUED] -= 1
        last = np.int64(s.heap[s.values[QUEUED]])
        if last != node:
            _settle(s, i, last)


@allocation_free(inline="always")
def _check_nodes(s, nodes):
    """Check the nodes of unknown state, W at a time. -1 stands for no node."""
    waiting = 0
    for k in range(len(nodes)):
        if nodes[k] >= 0 and s.state[nodes[k]] == UNKNOWN:
            s.pending[waiting] = nodes[k]
            waiting += 1
        if waiting == W or (waiting > 0 and k == len(nodes) - 1):
            for i in range(W):
                _place_node(s, s.pending[min(i, waiting - 1)], s.at[0], s.ends[0])
                for j in range(len(s.block)):
                    s.block[j, i] = s.ends[0, j]
            hits = block_hits(s.space.robot, s.space.scene, s.block, s.space.padding, False, s.work)
            for i in range(waiting):
                s.state[s.pending[i]] = BLOCKED if hits >> i & 1 else FREE
            waiting = 0


@allocation_free()
def _look_around(s, node, near, add):
    """Write the neighbors of a node; those that are not in memory are added if `add`. Returns False if memory
    is full."""
    lattice = s.lattice
    _place_node(s, node, s.at[0], s.ends[0])
    for m in range(len(near)):
        key = s.keys[node]
        inside = True
        for j in range(s.at.shape[1]):
            inside &= 0 <= s.at[0, j] + lattice.moves[m, j] < lattice.counts[j]
            key += lattice.moves[m, j] * lattice.strides[j]
        near[m] = find(s, key, add) if inside else np.int64(-1)
        if add and inside and near[m] < 0:
            return False
    return True


@allocation_free()
def _edge_free(s, u, v, m):
    """Whether the edge of move m, from node u to node v, is free of collision.

    Of a move and its negative, the first half has the motion that is checked, for the same result from both.
    """
    if s.state[u] != FREE or s.state[v] != FREE:
        return False
    forward = m < s.near.shape[1] // 2
    _place_node(s, u if forward else v, s.at[0], s.ends[0])
    _place_node(s, v if forward else u, s.at[0], s.ends[1])
    return motion_free(s.space, s.ends[0], s.ends[1], s.block, s.work)


@allocation_free()
def _choose_parent(s, node):
    """Set rhs and the parent of a node by all of its edges. Those that cannot lower rhs are not checked."""
    s.rhs[node] = s.base[node, 0]
    s.parent[node] = -1 - s.base[node, 1]
    _look_around(s, node, s.near[1], False)
    for m in range(s.near.shape[1]):
        v = s.near[1, m]
        if v >= 0:
            cost = s.g[v] + s.lattice.costs[m]
            if cost < s.rhs[node] and _edge_free(s, node, v, m):
                s.rhs[node] = cost
                s.parent[node] = v


@kernel(nogil=True)
def search(s, expansions):
    """ComputeShortestPath of D* Lite, for up to `expansions` expansions; returns an Outcome. Edges that
    cannot lower a node's cost are not checked."""
    g = s.g
    rhs = s.rhs
    start = s.values[START]
    for _ in range(expansions):
        # u: the top of U; until U.TopKey >= CalculateKey(s_start) and rhs(s_start) <= g(s_start)
        u = np.int64(s.heap[0])
        converged = (s.first[u], s.second[u]) >= _queue_key(s, start) and rhs[start] <= g[start]
        if s.values[QUEUED] == 0 or converged or s.state[start] == BLOCKED:
            return Outcome.FOUND if rhs[start] < INFINITE else Outcome.EXHAUSTED
        if not _look_around(s, u, s.near[0], True):
            return Outcome.FULL
        _check_nodes(s, s.near[0])
        s.values[EXPANSIONS] += 1
        # an overconsistent node gets its rhs; an underconsistent one is queued again, without a cost
        g[u] = rhs[u] if g[u] > rhs[u] else INFINITE
        _update_vertex(s, u)
        for m in range(s.near.shape[1]):
            v = s.near[0, m]
            if v < 0:
                continue
            if g[u] < INFINITE:
                # rhs(s) = min(rhs(s), c(s, u) + g(u))
                cost = g[u] + s.lattice.costs[m]
                closed = s.inflation > 1 and g[v] < INFINITE
                if cost >= rhs[v] or closed or not _edge_free(s, u, v, m):
                    continue
                rhs[v] = cost
                s.parent[v] = u
            elif s.parent[v] == u:
                # u gave rhs(s): the minimum over all edges instead
                _choose_parent(s, v)
            else:
                continue
            _update_vertex(s, v)
    return Outcome.GOING


@kernel(nogil=True)
def update(s, distances, reach):
    """Check again what changed shapes may affect, and all last edges, and update the nodes around.

    distances[capacity]: of the arm at each node from the changed shapes [m]. reach: how far any point of the
    arm moves along an edge at most [m].
    """
    nodes = s.values[NODES]
    for node in range(nodes):
        s.base[node, 0] = INFINITE
        if distances[node] <= 0:
            s.state[node] = UNKNOWN
    _place_node(s, s.values[START], s.at[1], s.ends[0])
    _check_nodes(s, np.arange(nodes))
    for k in range(len(s.last)):
        node, goal, cost = s.last[k]
        _place_node(s, node, s.at[0], s.ends[0])
        distances[node] = 0.0
        if (
            s.state[node] == FREE
            and cost < s.base[node, 0]
            and motion_free(s.space, s.ends[0], s.goals[goal], s.block, s.work)
        ):
            s.base[node] = cost, goal
    for node in range(nodes):
        if distances[node] <= reach:
            _choose_parent(s, node)
        _update_vertex(s, node)


CLOCK_INTERVAL = 4000
"""Approximate number of edges between two readings of the clock; some take 10 microseconds."""
MAX_MOVES = 100_000
"""Largest number of edges of a node."""
MAX_NODE_KEYS = 2**62
"""Largest number of nodes of a lattice."""
DISTANCE_ROUNDING = 1e-4
"""Bound on rounding errors of single precision [m]."""
LIMIT_MARGIN = 1e-9
"""Distance of the lattice from the joint limits [steps]."""


@dataclass(frozen=True)
class LatticeSettings(Settings):
    spacing: Positive = 0.4
    """Step of the lattice [rad], [m] for prismatic joints."""
    joints_per_move: Count = 1
    """Largest number of joints that an edge moves, each by one step."""
    max_nodes: Annotated[int, Bound(least=1.0, most=2e9)] = 2_000_000
    """Largest number of nodes in memory, besides those around the goals; each takes about 90 bytes."""
    resolution: Positive = 0.05
    """No point of the arm moves further than this between two checks of an edge [m]; after a path that the
    validator refuses, the search starts again at half the distance."""
    clearance: NotNegative = 0.002
    """Distance to obstacles that paths keep where start and goal allow it [m]."""


@dataclass(frozen=True)
class AStarSettings(LatticeSettings, name="a_star"):
    joints_per_move: Count = 2
    """See LatticeSettings. Higher values make paths shorter (2.1, 1.6, 1.35 and 1.2 times the straight line
    with 1, 2, 3 and 7 on ROP problems) and the search slower: an expansion checks up to 14, 98, 378 and 2,186
    edges."""
    inflation: Annotated[float, Bound(least=1.0, most=1000.0)] = 1.5
    """Factor on the heuristic (weighted A*): paths are at most this much longer than the shortest of the
    lattice; 1 finds the shortest, with seven joints often not in time."""


@dataclass(frozen=True)
class DStarLiteSettings(LatticeSettings, name="d_star_lite"):
    """No inflation: repairs are right only with a consistent heuristic."""


def make_lattice(checker: CollisionChecker, start: Configuration, settings: LatticeSettings) -> Lattice:
    """The lattice through the start. Raises InputError for one that is too large."""
    robot = checker.robot
    spacing = settings.spacing
    name = settings.settings_name
    joints = min(settings.joints_per_move, robot.dof)
    below, above = (
        np.maximum(np.floor(distance / spacing - LIMIT_MARGIN), 0).astype(np.int64)
        for distance in (start - robot.lower, robot.upper - start)
    )
    counts = below + above + 1
    if (total := np.prod(counts.astype(float))) >= MAX_NODE_KEYS:
        raise InputError(
            f"{name}.spacing is {spacing:g}; on {robot.name} that makes {total:.0e} nodes, which must be "
            f"below {MAX_NODE_KEYS:.0e}: a spacing of "
            f"{spacing * (total / MAX_NODE_KEYS) ** (1 / robot.dof) * 1.1:.2g} does it"
        )
    edges = np.cumsum([comb(robot.dof, k) * 2**k for k in range(1, robot.dof + 1)])
    if edges[joints - 1] > MAX_MOVES:
        raise InputError(
            f"{name}.joints_per_move is {settings.joints_per_move}; on {robot.name} that makes "
            f"{edges[joints - 1]} edges of a node; it must be at most "
            f"{np.searchsorted(edges, MAX_MOVES, side='right')}"
        )
    strides = np.concatenate([[1], np.cumprod(counts[:-1])]).astype(np.int64)
    half = lattice_moves(robot.dof, joints)
    moves = np.concatenate([half, -half])
    costs = np.ceil(UNITS * np.sqrt(np.abs(moves).sum(axis=1))).astype(np.int64)
    origin = start - spacing * below
    return Lattice(origin, float(spacing), counts, strides, moves, costs, 1 / sqrt(joints))


def lattice_moves(dof: int, joints: int) -> Int[ndarray, "moves dof"]:
    """One of each pair of opposite moves, that in which the first moving joint moves up; those of few joints
    first."""
    moves = []
    for count in range(1, min(joints, dof) + 1):
        for moving, signs in product(combinations(range(dof), count), product((1, -1), repeat=count - 1)):
            moves.append(np.zeros(dof, np.int64))
            moves[-1][list(moving)] = (1, *signs)
    return np.array(moves)


class LatticeSearch:
    """Weighted A* with `AStarSettings`. D* Lite with `DStarLiteSettings`: it can be repaired when obstacles
    or the arm have moved. Needs memory for the 2^dof nodes around each goal."""

    def __init__(
        self,
        checker: CollisionChecker,
        start: Configuration,
        goals: Configurations,
        settings: LatticeSettings,
        padding: float = 0.0,
    ) -> None:
        """`padding` is the distance to obstacles that paths keep [m]."""
        self.settings = settings
        self.padding = padding
        self.goals = goals
        dof = checker.robot.dof
        lattice = make_lattice(checker, start.astype(float), settings)
        self._expansions = max(CLOCK_INTERVAL // len(lattice.moves), 1)
        travel = settings.spacing * np.abs(lattice.moves) @ largest_motion_radii(checker.robot)
        self._reach = float(travel.max())
        """How far any point of the arm moves along an edge at most [m]."""
        goals_at = (goals.astype(float) - lattice.origin) / settings.spacing
        corners = np.floor(goals_at)[:, None] + list(product((0, 1), repeat=dof))
        of_goal, corner = np.nonzero(((corners >= 0) & (corners < lattice.counts)).all(axis=2))
        corners = corners[of_goal, corner]
        lengths = np.linalg.norm(corners - goals_at[of_goal], axis=1)
        capacity = settings.max_nodes + len(corners) + 1
        inflation = settings.inflation if isinstance(settings, AStarSettings) else 1.0
        keys, g, rhs, first, second = np.empty((5, capacity), np.int64)
        self._search = Search(
            lattice,
            goals.astype(np.float32),
            np.zeros((len(corners), 3), np.int64),
            float(inflation),
            -1 if isinstance(settings, AStarSettings) else 1,
            np.zeros(1 << (2 * capacity - 1).bit_length(), np.int32),
            keys,
            g,
            rhs,
            np.empty(capacity, np.int32),
            np.zeros((capacity, 2), np.int64),
            np.zeros(capacity, np.uint8),
            np.zeros(capacity, np.int32),
            np.zeros(capacity, np.int32),
            first,
            second,
            np.zeros(4, np.int64),
            np.empty((2, len(lattice.moves)), np.int64),
            np.empty((2, dof), np.int64),
            np.empty(W, np.int64),
            np.empty((2, dof), np.float32),
            np.empty((dof, W), np.float32),
            *self._obstacles(checker),
        )
        self._move_start(start)
        nodes = add_nodes(self._search, (corners @ lattice.strides).astype(np.int64))
        self._search.last[:] = np.column_stack([nodes, of_goal, np.ceil(UNITS * lengths)])
        update(self._search, np.full(capacity, np.inf, np.float32), self._reach)

    def _obstacles(self, checker: CollisionChecker) -> tuple[Space, tuple]:
        self.checker = checker
        space = search_space(checker, self.settings.resolution, self.padding)
        return space, make_workspace(space.robot, space.scene)

    def run(self, stop: Callable[[], bool] = lambda: False) -> Outcome:
        """Search until there is a path, there is none, memory is full, or `stop` returns True."""
        while True:
            outcome = Outcome(search(self._search, self._expansions))
            if outcome is not Outcome.GOING or stop():
                return outcome

    def path(self) -> Configurations | None:
        """The start, the nodes at which the path found so far turns, and the goal; None if there is none."""
        if self.cost == np.inf:
            return None
        nodes = [int(self._search.values[START])]
        while nodes[-1] >= 0:
            nodes.append(int(self._search.parent[nodes[-1]]))
        *nodes, goal = nodes
        at = self._coordinates(self._search.keys[nodes])
        turns = np.ones(len(at), np.bool_)
        turns[1:-1] = (np.diff(at, 2, axis=0) != 0).any(axis=1)
        return np.concatenate([self._configurations(at[turns]), self.goals[[-1 - goal]].astype(np.float64)])

    @property
    def cost(self) -> float:
        """Length of the path found so far [rad]; infinite if there is none."""
        units = int(self._search.rhs[self._search.values[START]])
        return float("inf") if units >= INFINITE else units * self.settings.spacing / UNITS

    @property
    def expansions(self) -> int:
        """Number of expansions so far; a node may be expanded several times."""
        return int(self._search.values[EXPANSIONS])

    @property
    def nodes(self) -> int:
        """Nodes in memory."""
        return int(self._search.values[NODES])

    def _coordinates(self, keys: Int[ndarray, "n"]) -> Int[ndarray, "n dof"]:
        return keys[:, None] // self._search.lattice.strides % self._search.lattice.counts

    def _configurations(self, at: Int[ndarray, "n dof"]) -> Configurations:
        robot = self.checker.robot
        lattice = self._search.lattice
        return np.clip(lattice.origin + lattice.spacing * at, robot.lower, robot.upper)

    def update(self, checker: CollisionChecker, start: Configuration | None = None) -> None:
        """Take over a changed scene, and a new start at another node of the lattice; `run` then repairs the
        search, of D* Lite only.

        Shapes that are the same objects in both scenes are taken to be unchanged. Only nodes and edges within
        reach of the other shapes are checked again. Raises InputError for another robot, and for a start that
        is no node.
        """
        if checker.robot is not self.checker.robot:
            raise InputError(
                f"checker has the robot {checker.robot.name}; it must have that of the search, "
                f"{self.checker.robot.name}"
            )
        if start is not None:
            self._move_start(start)
        distances = self._distances_to_changes(checker)
        space, work = self._obstacles(checker)
        self._search = self._search._replace(space=space, work=work)
        update(self._search, distances, self._reach)

    def _distances_to_changes(self, checker: CollisionChecker) -> Values:
        """A lower bound of the distance of the arm at each node from shapes that were added, removed or moved
        [m]."""
        distances = np.full(len(self._search.keys), np.inf, np.float32)
        before = self.checker.scene
        after = checker.scene
        kept = {id(shape) for shape in before.shapes} & {id(shape) for shape in after.shapes}
        if before.allowed_contacts != after.allowed_contacts:
            kept = set()
        moved = [shape for shape in (*before.shapes, *after.shapes) if id(shape) not in kept]
        if checker.padding != self.checker.padding:
            distances[:] = -np.inf
        elif moved:
            margin = float(self._search.space.padding) + DISTANCE_ROUNDING
            q = self._configurations(self._coordinates(self._search.keys[: self.nodes]))
            limit = self._reach + 2 * margin
            clearances = CollisionChecker(checker.robot, Scene(moved)).link_clearances(q, limit=limit)
            distances[: self.nodes] = clearances.min(axis=1, initial=np.inf) - margin
        return distances

    def _move_start(self, start: Configuration) -> None:
        lattice = self._search.lattice
        at = (start.astype(float) - lattice.origin) / lattice.spacing
        rounded = np.round(at).astype(np.int64)
        if np.abs(at - rounded).max() > 1e-3 or (rounded < 0).any() or (rounded >= lattice.counts).any():
            raise InputError(f"start is {np.round(start, 4)}; it must be a node of the lattice")
        [node] = add_nodes(self._search, np.array([rounded @ lattice.strides]))
        if node < 0:
            raise InputError(
                f"start is {np.round(start, 4)}; the search has not reached it, and memory is full"
            )
        self._search.values[START] = node


class AStar(Planner[LatticeSettings]):
    """Weighted A* on a lattice. The path depends on the seed only through the configurations of a goal
    pose."""

    name = "a_star"
    settings_class = AStarSettings

    def solve(self, context: PlanningContext, start_goal: StartGoal) -> PlanResult:
        """See `planning.planner.Planner`."""
        padding = start_goal.kept_clearance(self.settings.clearance)
        for settings, _ in ever_finer(context, self.settings):
            search = LatticeSearch(start_goal.checker, *start_goal.rows(), settings, padding)
            outcome = search.run(lambda: context.remaining <= 0)
            path = search.path() if outcome is Outcome.FOUND else None
            after = f"after {search.expansions} expansions"
            if path is None:
                spacing = f"{settings.settings_name}.spacing (now {settings.spacing:g} rad)"
                reasons = {
                    Outcome.FULL: f"memory is full: {search.nodes} nodes {after}; take a coarser {spacing} "
                    f"or a larger {settings.settings_name}.max_nodes",
                    Outcome.EXHAUSTED: f"there is no path on the lattice; a finer {spacing} may have one",
                    Outcome.GOING: f"time ran out {after}; a coarser {spacing} searches faster",
                }
                status = Status.TIMEOUT if outcome is Outcome.GOING else Status.NO_PATH
                return context.fail(status, reasons[outcome])
            reason = f"solved by {self.name} {after}"
            result = context.finish(start_goal.complete(path), self.name, reason=reason)
            if result is not None:
                return result
            if settings.resolution <= FINEST_RESOLUTION:
                break
        return context.unsolved(
            "the validator refused every path that was found; a larger clearance may help"
        )


class DStarLite(AStar):
    """D* Lite on a lattice, for one problem; `LatticeSearch` can be repaired after changes."""

    name = "d_star_lite"
    settings_class = DStarLiteSettings
