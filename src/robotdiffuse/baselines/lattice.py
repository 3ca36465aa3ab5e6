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

Nodes are created as they are reached, in a hash table. Both planners are one compiled search, from a source
to a target: A* from the start to the nearest goal, with an inflated heuristic; D* Lite from the goals to the
start, so that it can be repaired. Edge e of a node is move e of the lattice, and after those the last edges,
which lead to the goals.

Costs are integers, UNITS to a step of the lattice. Edges are rounded up and the heuristic down, so sums are
exact, the heuristic is exactly consistent, and both searches find the same cost.
"""

from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from itertools import combinations, product
from math import comb, sqrt
from typing import Annotated, Generic, NamedTuple, TypeVar

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.collision.kernels.lane_collision import W, block_hits, make_workspace
from robotdiffuse.collision.kernels.motions import Space, motion_free
from robotdiffuse.collision.motions import FINEST_RESOLUTION, largest_motion_radii, search_space
from robotdiffuse.core.errors import InputError
from robotdiffuse.core.kernels import allocation_free, kernel
from robotdiffuse.core.results import PlanResult
from robotdiffuse.core.settings import Bound, Count, NotNegative, Positive, Settings
from robotdiffuse.core.types import Configuration, Configurations, Status
from robotdiffuse.planning.context import PlanningContext
from robotdiffuse.planning.planner import Planner, ever_finer
from robotdiffuse.planning.start_goal import StartGoal
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene import Scene

INFINITE = 1 << 60
"""Cost of nodes that are not reached."""
# States of nodes and edges.
UNKNOWN = 0
FREE = 1
BLOCKED = 2
NODES, QUEUED, EXPANSIONS, TARGET, OFFSET = range(5)
"""Places in `Table.values`."""
_FACTOR_1, _FACTOR_2 = np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB)


class Table(NamedTuple):
    """The nodes seen so far, and the queue. The first nodes are the goals, which are in no slot."""

    slots: np.ndarray
    """[a power of two] node + 1 at the place of its key or after it, 0 where empty."""
    keys: np.ndarray
    """[capacity]"""
    g: np.ndarray
    """[capacity] cost from the source, by the last expansion [units]."""
    rhs: np.ndarray
    """[capacity] cost from the source, by the neighbors' g [units]."""
    parent: np.ndarray
    """[capacity] the neighbor that gives rhs; -1 for none."""
    state: np.ndarray
    """[capacity]"""
    edges: np.ndarray
    """[capacity, moves / 2 + goals] state of the edge by each move of the first half, and to each goal; no
    columns if edges are not remembered."""
    heap: np.ndarray
    """[capacity] queued nodes."""
    place: np.ndarray
    """[capacity] place in the heap + 1; 0 for nodes that are not queued."""
    first: np.ndarray
    second: np.ndarray
    """[capacity] the keys by which the queue is sorted."""
    values: np.ndarray
    """[5] numbers of nodes, queued nodes and expansions; the target of the search; k_m of D* Lite."""


def make_table(goals: int, max_nodes: int, edges: int) -> Table:
    """A table of the goals, with room for more nodes; the system allocates its memory as it is used."""
    n = goals + max_nodes
    slots = np.zeros(1 << (2 * n - 1).bit_length(), np.int32)
    keys, g, rhs, first, second = (np.empty(n, np.int64) for _ in range(5))
    parent = np.empty(n, np.int32)
    heap = np.empty(n, np.int32)
    place = np.zeros(n, np.int32)
    state = np.zeros(n, np.uint8)
    checked_edges = np.zeros((n, edges), np.uint8)
    values = np.zeros(5, np.int64)
    table = Table(slots, keys, g, rhs, parent, state, checked_edges, heap, place, first, second, values)
    table.values[NODES] = goals
    table.g[:goals] = table.rhs[:goals] = INFINITE
    table.parent[:goals] = -1
    table.state[:goals] = FREE
    return table


@allocation_free()
def _slot(table, key):
    """The slot of a key, or the empty one where it belongs (splitmix64, S. Vigna 2015)."""
    x = np.uint64(key)
    x = (x ^ (x >> np.uint64(30))) * _FACTOR_1
    x = (x ^ (x >> np.uint64(27))) * _FACTOR_2
    x ^= x >> np.uint64(31)
    mask = len(table.slots) - 1
    i = np.int64(x) & mask
    while table.slots[i] != 0 and table.keys[table.slots[i] - 1] != key:
        i = (i + 1) & mask
    return i


@allocation_free()
def find(table, key, add):
    """The node of a key, added if it is new and `add`; -1 if there is none, or no memory for one."""
    i = _slot(table, key)
    node = table.values[NODES]
    if table.slots[i] == 0 and add and node < len(table.keys):
        table.values[NODES] += 1
        table.slots[i] = node + 1
        table.keys[node] = key
        table.g[node] = INFINITE
        table.rhs[node] = INFINITE
        table.parent[node] = -1
    return np.int64(table.slots[i]) - 1


@kernel()
def add_nodes(table, keys):
    """The nodes of keys, added where they are new; -1 where memory is full."""
    return np.array([find(table, key, True) for key in keys])


@allocation_free()
def _before(table, a, b):
    return (table.first[a], table.second[a]) < (table.first[b], table.second[b])


@allocation_free()
def _settle(table, i, node):
    """Fill the gap at place i of the heap with a node, moved up or down to where its keys belong."""
    heap = table.heap
    place = table.place
    queued = table.values[QUEUED]
    while i > 0 and _before(table, node, heap[(i - 1) // 2]):
        heap[i] = heap[(i - 1) // 2]
        place[heap[i]] = i + 1
        i = (i - 1) // 2
    while 2 * i + 1 < queued:
        child = 2 * i + 1
        if child + 1 < queued and _before(table, heap[child + 1], heap[child]):
            child += 1
        if not _before(table, heap[child], node):
            break
        heap[i] = heap[child]
        place[heap[i]] = i + 1
        i = child
    heap[i] = node
    place[node] = i + 1


@allocation_free(inner=False)
def put(table, node, first, second):
    """Queue a node, or change its keys if it is queued."""
    table.first[node] = first
    table.second[node] = second
    if table.place[node] == 0:
        table.values[QUEUED] += 1
        table.place[node] = table.values[QUEUED]
    _settle(table, np.int64(table.place[node]) - 1, node)


@allocation_free()
def take(table, node):
    """Remove a node from the queue, if it is there."""
    i = np.int64(table.place[node]) - 1
    if i < 0:
        return
    table.place[node] = 0
    table.values[QUEUED] -= 1
    last = np.int64(table.heap[table.values[QUEUED]])
    if last != node:
        _settle(table, i, last)


UNITS = 1 << 20
"""Cost of one step of one joint."""
ROUNDING = 1e-3
"""Bound on rounding errors of floating point [units]."""


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
    goals: np.ndarray
    """[k, dof] [rad]"""
    goals_at: np.ndarray
    """[k, dof] coordinates of the goals, not integers; the nodes around one are the corners of its cell."""


class Search(NamedTuple):
    """A search, with its working memory."""

    space: Space
    lattice: Lattice
    table: Table
    targets: np.ndarray
    """[n, dof] coordinates; the heuristic leads to the nearest."""
    cell: int
    """Size of the cells around targets from whose corners edges lead to them: 1 for goals, 0 for nodes."""
    inflation: float
    """Factor on the heuristic. If it is larger than 1, each node is expanded once; as the heuristic is
    consistent, the cost is still within this factor of the least (M. Likhachev et al., "ARA*", NIPS 2003)."""
    ties: int
    """Among nodes of equal first keys, 1 prefers smaller costs, as repairs need; -1 larger ones (faster)."""
    near: np.ndarray
    steps: np.ndarray
    near_other: np.ndarray
    steps_other: np.ndarray
    """[moves + k] along each edge of a node: the neighbor, -1 for none, and the cost; of two nodes."""
    at: np.ndarray
    """[dof] coordinates of a node."""
    pending: np.ndarray
    """[W] nodes to check."""
    a: np.ndarray
    b: np.ndarray
    block: np.ndarray
    work: tuple


@allocation_free()
def _coordinates(lattice, key, out):
    for j in range(len(out)):
        out[j] = key // lattice.strides[j] % lattice.counts[j]


@allocation_free()
def _configuration(lattice, at, out):
    for j in range(len(at)):
        out[j] = np.float32(lattice.origin[j] + lattice.spacing * at[j])


@allocation_free(inline="always")
def _check_nodes(s, nodes):
    """Check the nodes of unknown state, W at a time. -1 stands for no node."""
    waiting = 0
    for k in range(len(nodes)):
        if nodes[k] >= 0 and s.table.state[nodes[k]] == UNKNOWN:
            s.pending[waiting] = nodes[k]
            waiting += 1
        if waiting == W or (waiting > 0 and k == len(nodes) - 1):
            for i in range(W):
                _coordinates(s.lattice, s.table.keys[s.pending[min(i, waiting - 1)]], s.at)
                _configuration(s.lattice, s.at, s.a)
                for j in range(len(s.a)):
                    s.block[j, i] = s.a[j]
            hits = block_hits(s.space.robot, s.space.scene, s.block, s.space.padding, False, s.work)
            for i in range(waiting):
                s.table.state[s.pending[i]] = BLOCKED if hits >> i & 1 else FREE
            waiting = 0


@allocation_free()
def _look_around(s, node, near, steps, add):
    """Write the neighbors of a node, and the costs of the edges to them; neighbors that are not in memory are
    added if `add`. Returns False if memory is full."""
    lattice = s.lattice
    table = s.table
    at = s.at
    moves, dof = lattice.moves.shape
    _coordinates(lattice, table.keys[node], at)
    for m in range(moves):
        key = table.keys[node]
        inside = True
        for j in range(dof):
            if lattice.moves[m, j] != 0:
                inside &= 0 <= at[j] + lattice.moves[m, j] < lattice.counts[j]
                key += lattice.moves[m, j] * lattice.strides[j]
        near[m] = find(table, key, add) if inside else np.int64(-1)
        steps[m] = lattice.costs[m]
        if add and inside and near[m] < 0:
            return False
    for goal in range(len(lattice.goals)):
        square = 0.0
        corner = True
        for j in range(dof):
            low = np.int64(np.floor(lattice.goals_at[goal, j]))
            corner &= low <= at[j] <= low + 1
            square += (at[j] - lattice.goals_at[goal, j]) ** 2
        near[moves + goal] = goal if corner else -1
        steps[moves + goal] = np.int64(np.ceil(UNITS * np.sqrt(square)))
    return True


@allocation_free()
def _edge_free(s, u, v, e):
    """Whether edge e, from node u to node v, is free of collision, as remembered or checked.

    Of a move and its negative, the first half has the motion that is checked, for the same result from both.
    """
    lattice = s.lattice
    table = s.table
    moves = len(lattice.moves)
    half = moves // 2
    if table.state[u] != FREE or table.state[v] != FREE:
        return False
    node = v if half <= e < moves else u
    column = e % half if e < moves else e - half
    remembered = table.edges.shape[1] > 0
    if remembered and table.edges[node, column] != UNKNOWN:
        return table.edges[node, column] == FREE
    _coordinates(lattice, table.keys[node], s.at)
    _configuration(lattice, s.at, s.a)
    if e < moves:
        for j in range(len(s.at)):
            s.at[j] += lattice.moves[e % half, j]
        _configuration(lattice, s.at, s.b)
    else:
        for j in range(len(s.b)):
            s.b[j] = lattice.goals[e - moves, j]
    free = motion_free(s.space, s.a, s.b, s.block, s.work)
    if remembered:
        table.edges[node, column] = FREE if free else BLOCKED
    return free


@allocation_free(inner=False)
def heuristic(lattice, at, targets, cell):
    """A consistent lower bound of the cost from a node to the nearest of the targets.

    The larger of the straight distance and the cost by joint: a move costs at least `slope` for each joint
    that it moves, and a last edge, from a corner of the target's cell, is at least as long as its projection
    on the diagonal.
    """
    best = np.inf
    diagonal = 1.0 / np.sqrt(len(at))
    for k in range(len(targets)):
        square = 0.0
        by_joint = 0.0
        for j in range(len(at)):
            d = at[j] - targets[k, j]
            low = np.int64(np.floor(targets[k, j]))
            square += d * d
            steps = max(low - at[j], at[j] - low - cell, 0)
            by_joint += steps * lattice.slope + (abs(d) - steps) * diagonal
        best = min(best, max(np.sqrt(square), by_joint))
    return max(np.int64(np.floor(UNITS * best - ROUNDING)), 0)


@allocation_free()
def _queue_key(s, node):
    """CalculateKey of D* Lite, whose k_m is OFFSET."""
    cost = min(s.table.g[node], s.table.rhs[node])
    bound = np.int64(0)
    if node >= len(s.lattice.goals):
        _coordinates(s.lattice, s.table.keys[node], s.at)
        bound = np.int64(s.inflation * heuristic(s.lattice, s.at, s.targets, s.cell))
    return cost + bound + s.table.values[OFFSET], s.ties * cost


@allocation_free()
def _queue_if_inconsistent(s, node):
    """UpdateVertex of D* Lite."""
    if s.table.g[node] == s.table.rhs[node]:
        take(s.table, node)
    else:
        first, second = _queue_key(s, node)
        put(s.table, node, first, second)


@allocation_free()
def _choose_parent(s, node):
    """Set rhs and the parent of a node by all of its edges. Those that cannot lower rhs are not checked."""
    table = s.table
    table.rhs[node] = INFINITE
    table.parent[node] = -1
    if table.state[node] != FREE:
        return
    _look_around(s, node, s.near_other, s.steps_other, False)
    for e in range(len(s.near_other)):
        v = s.near_other[e]
        if v >= 0:
            cost = table.g[v] + s.steps_other[e]
            if cost < table.rhs[node] and _edge_free(s, node, v, e):
                table.rhs[node] = cost
                table.parent[node] = v


@kernel(nogil=True)
def search(s, expansions):
    """ComputeShortestPath of D* Lite, for up to `expansions` expansions; returns an Outcome. Edges that
    cannot lower a node's cost are not checked."""
    table = s.table
    goals = len(s.lattice.goals)
    g = table.g
    rhs = table.rhs
    for _ in range(expansions):
        # u and k_old: the top of U and its key
        u = np.int64(table.heap[0]) if table.values[QUEUED] > 0 else table.values[TARGET]
        if u < goals:
            table.values[TARGET] = u
        target = table.values[TARGET]
        key = table.first[u], table.second[u]
        # until U.TopKey >= CalculateKey(s_start) and rhs(s_start) <= g(s_start)
        converged = key >= _queue_key(s, target) and rhs[target] <= g[target]
        if converged or table.values[QUEUED] == 0 or table.state[target] == BLOCKED:
            return Outcome.FOUND if rhs[target] < INFINITE else Outcome.EXHAUSTED
        # k_old < CalculateKey(u): k_m has grown since u was queued
        if _queue_key(s, u) > key:
            _queue_if_inconsistent(s, u)
            continue
        if not _look_around(s, u, s.near, s.steps, True):
            return Outcome.FULL
        _check_nodes(s, s.near)
        table.values[EXPANSIONS] += 1
        # an overconsistent node gets its rhs; an underconsistent one is queued again, without a cost
        g[u] = rhs[u] if g[u] > rhs[u] else INFINITE
        _queue_if_inconsistent(s, u)
        for e in range(len(s.near)):
            v = s.near[e]
            if v < 0:
                continue
            if g[u] < INFINITE:
                # rhs(s) = min(rhs(s), c(s, u) + g(u))
                cost = g[u] + s.steps[e]
                closed = s.inflation > 1 and g[v] < INFINITE
                if cost >= rhs[v] or closed or not _edge_free(s, u, v, e):
                    continue
                rhs[v] = cost
                table.parent[v] = u
            elif table.parent[v] == u:
                # u gave rhs(s): the minimum over all edges instead
                _choose_parent(s, v)
            else:
                continue
            _queue_if_inconsistent(s, v)
    return Outcome.GOING


@kernel(nogil=True)
def update(s, distances, reaches):
    """Check again what changed shapes may affect, and update the nodes around it.

    distances[capacity]: of the arm at each node from the changed shapes [m]. reaches[moves / 2]: how far any
    point of the arm moves by half of each move [m]; an edge is unchanged if both of its nodes are farther
    away than that. Edges to the goals are all checked again.
    """
    table = s.table
    half = len(reaches)
    goals = len(s.lattice.goals)
    changed = np.zeros(len(table.keys), np.bool_)
    for node in range(goals, table.values[NODES]):
        if distances[node] <= 0 or table.state[node] == UNKNOWN:
            table.state[node] = UNKNOWN
            changed[node] = True
        _look_around(s, node, s.near, s.steps, False)
        for column in range(table.edges.shape[1]):
            if table.edges[node, column] == UNKNOWN:
                continue
            neighbor = s.near[column] if column < half else np.int64(-1)
            if neighbor < 0 or min(distances[node], distances[neighbor]) <= reaches[column]:
                table.edges[node, column] = UNKNOWN
                changed[node] = True
                if neighbor >= 0:
                    changed[neighbor] = True
    _check_nodes(s, np.arange(goals, table.values[NODES]))
    for node in range(goals, table.values[NODES]):
        if changed[node]:
            _choose_parent(s, node)
            if table.state[node] == BLOCKED:
                table.g[node] = INFINITE
            _queue_if_inconsistent(s, node)


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
    """Largest number of nodes in memory; each takes about 80 bytes. D* Lite needs one more byte for each goal
    and for each pair of edges, and has room for the nodes around the goals besides."""
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


LatticePlannerSettings = TypeVar("LatticePlannerSettings", bound=LatticeSettings)


def make_lattice(
    robot: Robot, start: Configuration, goals: Configurations, settings: LatticeSettings
) -> tuple[Lattice, int]:
    """The lattice through the start, and the start's key. Raises InputError for one that is too large."""
    spacing = settings.spacing
    name = settings.settings_name
    start = start.astype(float)
    moving_joints = min(settings.joints_per_move, robot.dof)
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
    if (count := edges[moving_joints - 1]) > MAX_MOVES:
        raise InputError(
            f"{name}.joints_per_move is {settings.joints_per_move}; on {robot.name} that makes {count} edges "
            f"of a node; it must be at most {np.searchsorted(edges, MAX_MOVES, side='right')}"
        )
    strides = np.concatenate([[1], np.cumprod(counts[:-1])]).astype(np.int64)
    origin = start - spacing * below
    half = lattice_moves(robot.dof, moving_joints)
    moves = np.concatenate([half, -half])
    costs = np.ceil(UNITS * np.sqrt(np.abs(moves).sum(axis=1))).astype(np.int64)
    goals_at = (goals.astype(float) - origin) / spacing
    goals = np.ascontiguousarray(goals, np.float32)
    lattice = Lattice(
        origin, float(spacing), counts, strides, moves, costs, 1 / sqrt(moving_joints), goals, goals_at
    )
    return lattice, int(below @ strides)


def lattice_moves(dof: int, joints: int) -> Int[ndarray, "moves dof"]:
    """One of each pair of opposite moves, that in which the first moving joint moves up; those of few joints
    first."""
    moves = list(np.eye(dof, dtype=np.int64)[:: 1 if joints == 1 else -1])
    for count in range(2, min(joints, dof) + 1):
        rows = []
        for moving, signs in product(combinations(range(dof), count), product((1, -1), repeat=count - 1)):
            rows.append(np.zeros(dof, np.int64))
            rows[-1][list(moving)] = (1, *signs)
        moves += sorted(rows, key=lambda move: list(move % 3))
    return np.array(moves)


class AStarSearch(Generic[LatticePlannerSettings]):
    """Weighted A* from the start, which must be free, to the nearest goal; the base of D* Lite."""

    def __init__(
        self,
        checker: CollisionChecker,
        start: Configuration,
        goals: Configurations,
        settings: LatticePlannerSettings,
        padding: float = 0.0,
    ) -> None:
        """`padding` is the distance to obstacles that paths keep [m]."""
        self.settings = settings
        self.padding = padding
        self.goals = goals
        self._lattice, key = make_lattice(checker.robot, start, goals, settings)
        self._expansions = max(CLOCK_INTERVAL // len(self._lattice.moves), 1)
        self._begin(checker, key)

    def _begin(self, checker: CollisionChecker, start_key: int) -> None:
        """Make the table, and queue the nodes of the source."""
        self._table = make_table(len(self.goals), self.settings.max_nodes, 0)
        [start] = add_nodes(self._table, np.array([start_key]))
        self._table.rhs[start] = 0
        self._table.state[start] = FREE
        put(self._table, start, 0, 0)
        self._use(checker, self._lattice.goals_at, 1, getattr(self.settings, "inflation", 1.0), -1)

    def _use(
        self,
        checker: CollisionChecker,
        targets: Configurations,
        cell: int,
        inflation: float,
        ties: int,
    ) -> None:
        """The compiled search among the obstacles of a checker; see `Search`."""
        space = search_space(checker, self.settings.resolution, self.padding)
        edges = len(self._lattice.moves) + len(self.goals)
        dof = checker.robot.dof
        near, steps, near_other, steps_other = np.empty((4, edges), np.int64)
        a, b = np.empty((2, dof), np.float32)
        self.checker = checker
        self._search = Search(
            *(space, self._lattice, self._table, targets, cell, float(inflation), ties),
            *(near, steps, near_other, steps_other, np.empty(dof, np.int64), np.empty(W, np.int64)),
            *(a, b, np.empty((dof, W), np.float32), make_workspace(space.robot, space.scene)),
        )

    def run(self, stop: Callable[[], bool] = lambda: False) -> Outcome:
        """Search until there is a path, there is none, memory is full, or `stop` returns True."""
        while True:
            outcome = Outcome(search(self._search, self._expansions))
            if outcome is not Outcome.GOING or stop():
                return outcome

    def path(self) -> Configurations | None:
        """The start, the nodes at which the path found so far turns, and the goal; None if there is none."""
        nodes = [int(self._table.values[TARGET])]
        if self._table.rhs[nodes[0]] >= INFINITE:
            return None
        while (parent := int(self._table.parent[nodes[-1]])) >= 0:
            nodes.append(parent)
        *nodes, goal = nodes if nodes[-1] < len(self.goals) else reversed(nodes)
        at = self._coordinates(self._table.keys[nodes])
        turns = np.ones(len(at), np.bool_)
        turns[1:-1] = (np.diff(at, 2, axis=0) != 0).any(axis=1)
        return np.concatenate([self._configurations(at[turns]), self.goals[[goal]].astype(np.float64)])

    @property
    def cost(self) -> float:
        """Length of the path found so far [rad]; infinite if there is none."""
        units = int(self._table.rhs[self._table.values[TARGET]])
        return float("inf") if units >= INFINITE else units * self.settings.spacing / UNITS

    @property
    def expansions(self) -> int:
        """Number of expansions so far; a node may be expanded several times."""
        return int(self._table.values[EXPANSIONS])

    @property
    def nodes(self) -> int:
        """Nodes in memory."""
        return int(self._table.values[NODES]) - len(self.goals)

    def _coordinates(self, keys: Int[ndarray, "n"]) -> Int[ndarray, "n dof"]:
        return keys[:, None] // self._lattice.strides % self._lattice.counts

    def _configurations(self, at: Int[ndarray, "n dof"]) -> Configurations:
        robot = self.checker.robot
        lattice = self._lattice
        return np.clip(lattice.origin + lattice.spacing * at, robot.lower, robot.upper)


class DStarLiteSearch(AStarSearch[DStarLiteSettings]):
    """D* Lite from the goals, which can be repaired when obstacles or the arm have moved. Needs memory for
    the 2^dof nodes around each goal."""

    def _begin(self, checker: CollisionChecker, start_key: int) -> None:
        goals = len(self.goals)
        lattice = self._lattice
        half = len(lattice.moves) // 2
        corners = np.floor(lattice.goals_at).astype(np.int64)[:, None] + list(
            product((0, 1), repeat=len(lattice.counts))
        )
        corners = corners[((corners >= 0) & (corners < lattice.counts)).all(axis=2)]
        keys = np.unique(corners @ lattice.strides)
        self._table = make_table(goals, self.settings.max_nodes + len(keys), half + goals)
        self._table.g[:goals] = self._table.rhs[:goals] = 0
        add_nodes(self._table, np.array([start_key, *keys]))
        self._table.values[TARGET] = goals
        radii = largest_motion_radii(checker.robot)
        reaches = 0.5 * self.settings.spacing * np.abs(lattice.moves[:half]) @ radii
        self._reaches = reaches.astype(np.float32)
        """How far any point of the arm moves by half of each move [m]."""
        self._update(checker, np.full(len(self._table.keys), np.inf, np.float32))

    def _update(self, checker: CollisionChecker, distances: Float[ndarray, "capacity"]) -> None:
        start = self._table.keys[self._table.values[TARGET]]
        self._use(checker, self._coordinates(start[None]).astype(np.float64), 0, 1.0, 1)
        update(self._search, distances, self._reaches)

    def update(self, checker: CollisionChecker, start: Configuration | None = None) -> None:
        """Take over a changed scene, and a new start at another node of the lattice; `run` then repairs the
        search.

        Shapes that are the same objects in both scenes are taken to be unchanged. Only nodes and known edges
        within reach of the other shapes are checked again. Raises InputError for another robot, and for a
        start that is no node.
        """
        if checker.robot is not self.checker.robot:
            raise InputError(
                f"checker has the robot {checker.robot.name}; it must have that of the search, "
                f"{self.checker.robot.name}"
            )
        if start is not None:
            self._move_start(start)
        self._update(checker, self._distances_to_changes(checker))

    def _distances_to_changes(self, checker: CollisionChecker) -> Float[ndarray, "capacity"]:
        """A lower bound of the distance of the arm at each node from shapes that were added, removed or moved
        [m]."""
        distances = np.full(len(self._table.keys), np.inf, np.float32)
        before = self.checker.scene.shapes
        after = checker.scene.shapes
        unchanged = {id(shape) for shape in before} & {id(shape) for shape in after}
        unchanged = (
            unchanged if self.checker.scene.allowed_contacts == checker.scene.allowed_contacts else set()
        )
        moved = [shape for shape in (*before, *after) if id(shape) not in unchanged]
        table_rows = slice(len(self.goals), self._table.values[NODES])
        if checker.padding != self.checker.padding:
            distances[table_rows] = -np.inf
        elif moved:
            margin = float(self._search.space.padding) + DISTANCE_ROUNDING
            q = self._configurations(self._coordinates(self._table.keys[table_rows]))
            limit = float(self._reaches.max()) + 2 * margin
            clearances = CollisionChecker(checker.robot, Scene(moved)).link_clearances(q, limit=limit)
            distances[table_rows] = clearances.min(axis=1, initial=np.inf) - margin
        return distances

    def _move_start(self, start: Configuration) -> None:
        lattice = self._lattice
        at = (np.asarray(start, np.float64) - lattice.origin) / lattice.spacing
        rounded = np.round(at).astype(np.int64)
        if np.abs(at - rounded).max() > 1e-3 or (rounded < 0).any() or (rounded >= lattice.counts).any():
            raise InputError(f"start is {np.round(start, 4)}; it must be a node of the lattice")
        [node] = add_nodes(self._table, np.array([rounded @ lattice.strides]))
        if node < 0:
            raise InputError(
                f"start is {np.round(start, 4)}; the search has not reached it, and memory is full"
            )
        if node != self._table.values[TARGET]:
            # rounded up: queued keys must stay lower bounds
            self._table.values[OFFSET] += heuristic(lattice, rounded, self._search.targets, 0) + 2
        self._table.values[TARGET] = node


class _LatticePlanner(Planner[LatticePlannerSettings]):
    """Base of both planners. The path depends on the seed only through the configurations of a goal pose."""

    search: Callable[..., AStarSearch]

    def solve(self, context: PlanningContext, start_goal: StartGoal) -> PlanResult:
        """See `planning.planner.Planner`."""
        padding = start_goal.kept_clearance(self.settings.clearance)
        for settings, _ in ever_finer(context, self.settings):
            search = self.search(start_goal.checker, *start_goal.rows(), settings, padding)
            outcome = search.run(lambda: context.remaining <= 0)
            path = search.path() if outcome is Outcome.FOUND else None
            if path is None:
                after = f"after {search.expansions} expansions"
                spacing = f"{settings.settings_name}.spacing (now {settings.spacing:g} rad)"
                reasons = {
                    Outcome.FULL: f"memory is full: {search.nodes} nodes {after}; take a coarser {spacing} "
                    f"or a larger {settings.settings_name}.max_nodes",
                    Outcome.EXHAUSTED: f"there is no path on the lattice; a finer {spacing} may have one",
                    Outcome.GOING: f"time ran out {after}; a coarser {spacing} searches faster",
                }
                status = Status.TIMEOUT if outcome is Outcome.GOING else Status.NO_PATH
                return context.fail(status, reasons[outcome])
            reason = f"solved by {self.name}: {search.expansions} expansions"
            result = context.finish(start_goal.complete(path), self.name, reason=reason)
            if result is not None:
                return result
            if settings.resolution <= FINEST_RESOLUTION:
                break
        return context.unsolved(
            "the validator refused every path that was found; a larger clearance may help"
        )


class AStar(_LatticePlanner[AStarSettings]):
    """Weighted A* on a lattice."""

    name = "a_star"
    settings_class = AStarSettings
    search = AStarSearch


class DStarLite(_LatticePlanner[DStarLiteSettings]):
    """D* Lite on a lattice, for one problem; `DStarLiteSearch` can be repaired after changes."""

    name = "d_star_lite"
    settings_class = DStarLiteSettings
    search = DStarLiteSearch
