"""Compiled A* and D* Lite on a lattice of configurations, whose nodes are created as they are reached.

Both are one search, from a source to a target: A* from the start to the nearest goal, with an inflated
heuristic; D* Lite from the goals to the start, so that it can be repaired. Edge e of a node is move e of the
lattice, and after those the last edges, which lead to the goals.

Costs are integers, UNITS to a step of the lattice. Edges are rounded up and the heuristic down, so sums are
exact, the heuristic is exactly consistent, and both searches find the same cost.
"""

from enum import IntEnum
from typing import NamedTuple

import numpy as np

from robotdiffuse.collision.kernels.lane_collision import W, block_hits
from robotdiffuse.collision.kernels.motions import Space, motion_free
from robotdiffuse.core.kernels import allocation_free, kernel
from robotdiffuse.planning.baselines.lattice.table import (
    BLOCKED,
    EXPANSIONS,
    FREE,
    INFINITE,
    NODES,
    OFFSET,
    QUEUED,
    TARGET,
    UNKNOWN,
    Table,
    find,
    put,
    take,
)

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
    lattice, table, at = s.lattice, s.table, s.at
    moves, dof = lattice.moves.shape
    _coordinates(lattice, table.keys[node], at)
    for m in range(moves):
        key, inside = table.keys[node], True
        for j in range(dof):
            if lattice.moves[m, j] != 0:
                inside &= 0 <= at[j] + lattice.moves[m, j] < lattice.counts[j]
                key += lattice.moves[m, j] * lattice.strides[j]
        near[m], steps[m] = find(table, key, add) if inside else np.int64(-1), lattice.costs[m]
        if add and inside and near[m] < 0:
            return False
    for goal in range(len(lattice.goals)):
        square, corner = 0.0, True
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
    lattice, table = s.lattice, s.table
    moves = len(lattice.moves)
    half = moves // 2
    if table.state[u] != FREE or table.state[v] != FREE:
        return False
    node, column = (v if half <= e < moves else u), (e % half if e < moves else e - half)
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
        square, by_joint = 0.0, 0.0
        for j in range(len(at)):
            d, low = at[j] - targets[k, j], np.int64(np.floor(targets[k, j]))
            square += d * d
            steps = max(low - at[j], at[j] - low - cell, 0)
            by_joint += steps * lattice.slope + (abs(d) - steps) * diagonal
        best = min(best, max(np.sqrt(square), by_joint))
    return max(np.int64(np.floor(UNITS * best - ROUNDING)), 0)


@allocation_free()
def _queue_key(s, node):
    """CalculateKey of D* Lite, whose k_m is OFFSET."""
    least, bound = min(s.table.g[node], s.table.rhs[node]), np.int64(0)
    if node >= len(s.lattice.goals):
        _coordinates(s.lattice, s.table.keys[node], s.at)
        bound = np.int64(s.inflation * heuristic(s.lattice, s.at, s.targets, s.cell))
    return least + bound + s.table.values[OFFSET], s.ties * least


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
    table.rhs[node], table.parent[node] = INFINITE, -1
    if table.state[node] != FREE:
        return
    _look_around(s, node, s.near_other, s.steps_other, False)
    for e in range(len(s.near_other)):
        v = s.near_other[e]
        if v >= 0:
            cost = table.g[v] + s.steps_other[e]
            if cost < table.rhs[node] and _edge_free(s, node, v, e):
                table.rhs[node], table.parent[node] = cost, v


@kernel(nogil=True)
def search(s, expansions):
    """ComputeShortestPath of D* Lite, for up to `expansions` expansions; returns an Outcome. Edges that
    cannot lower a node's cost are not checked."""
    table, goals = s.table, len(s.lattice.goals)
    g, rhs = table.g, table.rhs
    for _ in range(expansions):
        u = np.int64(table.heap[0]) if table.values[QUEUED] > 0 else table.values[TARGET]
        if u < goals:
            table.values[TARGET] = u
        target = table.values[TARGET]
        key = table.first[u], table.second[u]
        done = key >= _queue_key(s, target) and rhs[target] <= g[target]
        if done or table.values[QUEUED] == 0 or table.state[target] == BLOCKED:
            return Outcome.FOUND if rhs[target] < INFINITE else Outcome.EXHAUSTED
        if _queue_key(s, u) > key:
            _queue_if_inconsistent(s, u)
            continue
        if not _look_around(s, u, s.near, s.steps, True):
            return Outcome.FULL
        _check_nodes(s, s.near)
        table.values[EXPANSIONS] += 1
        g[u] = rhs[u] if g[u] > rhs[u] else INFINITE
        _queue_if_inconsistent(s, u)
        for e in range(len(s.near)):
            v = s.near[e]
            if v < 0:
                continue
            if g[u] < INFINITE:
                cost = g[u] + s.steps[e]
                closed = s.inflation > 1 and g[v] < INFINITE
                if cost >= rhs[v] or closed or not _edge_free(s, u, v, e):
                    continue
                rhs[v], table.parent[v] = cost, u
            elif table.parent[v] == u:
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
    table, half, goals = s.table, len(reaches), len(s.lattice.goals)
    changed = np.zeros(len(table.keys), np.bool_)
    for node in range(goals, table.values[NODES]):
        if distances[node] <= 0 or table.state[node] == UNKNOWN:
            table.state[node], changed[node] = UNKNOWN, True
        _look_around(s, node, s.near, s.steps, False)
        for column in range(table.edges.shape[1]):
            if table.edges[node, column] == UNKNOWN:
                continue
            other = s.near[column] if column < half else np.int64(-1)
            if other < 0 or min(distances[node], distances[other]) <= reaches[column]:
                table.edges[node, column] = UNKNOWN
                changed[node] = True
                if other >= 0:
                    changed[other] = True
    _check_nodes(s, np.arange(goals, table.values[NODES]))
    for node in range(goals, table.values[NODES]):
        if changed[node]:
            _choose_parent(s, node)
            if table.state[node] == BLOCKED:
                table.g[node] = INFINITE
            _queue_if_inconsistent(s, node)
