"""Compiled A* and D* Lite on a lattice of configurations, whose nodes are created as they are reached.

Costs are integers, UNITS to a step of the lattice. Edges are rounded up and the heuristic down, so sums are
exact, the heuristic is exactly consistent, and both searches find the same cost.

An edge is free if both of its nodes are, and the motion from the first to the second in the order of the
moves; so the check is the same from either side.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from robotdiffuse.collision.kernels.lane_collision import W, block_hits, make_workspace
from robotdiffuse.collision.kernels.motions import Space, motion_free
from robotdiffuse.core.kernels import allocation_free
from robotdiffuse.planning.baselines.lattice.table import (
    AT_GOAL,
    BLOCKED,
    CLOSED,
    EXPANSIONS,
    FREE,
    GOAL,
    INFINITE,
    NODES,
    OFFSET,
    QUEUED,
    START,
    UNKNOWN,
    Table,
    find,
    find_or_add,
    put,
    take,
)

UNITS = 1 << 20
"""Cost of one step of one joint."""
ROUNDING = 1e-3
"""Bound on rounding errors of floating point [units]."""
GOING, FOUND, EXHAUSTED, FULL = 0, 1, 2, 3
"""How a call of a search ends: to be continued, with a path, without one, with memory full."""


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
    """A search, with the working memory of its thread."""

    space: Space
    lattice: Lattice
    table: Table
    last: np.ndarray
    """[k, 2 ^ dof] D* Lite: states of the edges from the corners of the goals' cells to the goals."""
    start_at: np.ndarray
    """[1, dof] D* Lite: coordinates of the start."""
    at: np.ndarray
    other: np.ndarray
    moved: np.ndarray
    """[dof] coordinates: of the node in hand, of another, and of the nodes being checked."""
    near: np.ndarray
    """[moves] the neighbours of a node, -1 for none."""
    pending: np.ndarray
    """[16] nodes to check."""
    a: np.ndarray
    b: np.ndarray
    block: np.ndarray
    work: tuple


def make_search(space: Space, lattice: Lattice, table: Table, last: np.ndarray) -> Search:
    """A search with new working memory."""
    moves, dof = lattice.moves.shape
    return Search(
        *(space, lattice, table, last, np.empty((1, dof))),
        *(np.empty(dof, np.int64), np.empty(dof, np.int64), np.empty(dof, np.int64)),
        *(np.empty(moves, np.int64), np.empty(W, np.int64)),
        *(np.empty(dof, np.float32), np.empty(dof, np.float32), np.empty((dof, W), np.float32)),
        make_workspace(space.robot, space.scene),
    )


@allocation_free()
def _coordinates(lattice, key, out):
    for j in range(len(out)):
        out[j] = key // lattice.strides[j] % lattice.counts[j]


@allocation_free()
def _configuration(lattice, at, out):
    for j in range(len(at)):
        out[j] = np.float32(lattice.origin[j] + lattice.spacing * at[j])


@allocation_free()
def _key_beside(lattice, key, at, m):
    """The key of the node that move m leads to; -1 beyond the joint limits."""
    for j in range(len(at)):
        step = lattice.moves[m, j]
        if step != 0:
            if at[j] + step < 0 or at[j] + step >= lattice.counts[j]:
                return np.int64(-1)
            key += step * lattice.strides[j]
    return key


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
                _coordinates(s.lattice, s.table.keys[s.pending[min(i, waiting - 1)]], s.moved)
                _configuration(s.lattice, s.moved, s.a)
                for j in range(len(s.a)):
                    s.block[j, i] = s.a[j]
            hits = block_hits(s.space.robot, s.space.scene, s.block, s.space.padding, False, s.work)
            for i in range(waiting):
                s.table.state[s.pending[i]] = BLOCKED if hits >> i & 1 else FREE
            waiting = 0


@allocation_free(inline="always")
def _look_around(s, node):
    """Write the neighbours of a node to `near`, and its coordinates to `at`; add and check new neighbours.

    Returns False if memory is full.
    """
    key = s.table.keys[node]
    _coordinates(s.lattice, key, s.at)
    for m in range(len(s.near)):
        beside = _key_beside(s.lattice, key, s.at, m)
        s.near[m] = find_or_add(s.table, beside) if beside >= 0 else np.int64(-1)
        if beside >= 0 and s.near[m] < 0:
            return False
    _check_nodes(s, s.near)
    return True


@allocation_free(inline="always")
def _move_free(s, u, v, m):
    """Whether move m, from the free node u to the free node v, is free of collision."""
    half = len(s.near) // 2
    _coordinates(s.lattice, s.table.keys[u if m < half else v], s.moved)
    _configuration(s.lattice, s.moved, s.a)
    for j in range(len(s.a)):
        s.moved[j] += s.lattice.moves[m % half, j]
    _configuration(s.lattice, s.moved, s.b)
    return motion_free(s.space, s.a, s.b, s.block, s.work)


@allocation_free(inline="always")
def _last_free(s, at, goal):
    """Whether the motion from the node at these coordinates to a goal is free."""
    _configuration(s.lattice, at, s.a)
    for j in range(len(s.b)):
        s.b[j] = s.lattice.goals[goal, j]
    return motion_free(s.space, s.a, s.b, s.block, s.work)


@allocation_free()
def _last_edge(lattice, goal, at):
    """The corner of the goal's cell at these coordinates, as bits, and the cost of its edge to the goal;
    INFINITE if there is none."""
    corner, square = 0, 0.0
    for j in range(len(at)):
        d = at[j] - np.int64(np.floor(lattice.goals_at[goal, j]))
        if d < 0 or d > 1:
            return 0, np.int64(INFINITE)
        corner |= d << j
        square += (at[j] - lattice.goals_at[goal, j]) ** 2
    return corner, np.int64(np.ceil(UNITS * np.sqrt(square)))


@allocation_free(inner=False)
def heuristic(lattice, at, targets, cell):
    """A consistent lower bound of the cost from a node to the nearest of the targets' coordinates.

    The larger of the straight distance and the cost by joint: a move costs at least `slope` for each joint
    that it moves, and a last edge, from a corner of the target's cell, is at least as long as its projection
    on the diagonal. `cell` is the size of cells: 1 for goals, 0 for nodes.
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


@njit(cache=True, nogil=True)
def a_star(s, inflation, expansions):
    """Weighted A* for up to `expansions` expansions. Each node is expanded once; as the heuristic is
    consistent, the cost is still within the factor `inflation` of the least (M. Likhachev et al., "ARA*",
    NIPS 2003)."""
    lattice, table = s.lattice, s.table
    g, parent = table.g, table.rhs
    for _ in range(expansions):
        if table.values[QUEUED] == 0:
            return EXHAUSTED
        u = np.int64(table.heap[0])
        if u == AT_GOAL:
            return FOUND
        if not _look_around(s, u):
            return FULL
        take(table, u)
        table.state[u] = CLOSED
        table.values[EXPANSIONS] += 1
        for goal in range(len(lattice.goals)):
            cost = g[u] + _last_edge(lattice, goal, s.at)[1]
            if cost < g[AT_GOAL] and _last_free(s, s.at, goal):
                g[AT_GOAL], parent[AT_GOAL], table.values[GOAL] = cost, u, goal
                put(table, AT_GOAL, cost, -cost)
        for m in range(len(s.near)):
            v = s.near[m]
            if v < 0 or table.state[v] != FREE:
                continue
            cost = g[u] + lattice.costs[m]
            if cost < g[v] and _move_free(s, u, v, m):
                g[v], parent[v] = cost, u
                _coordinates(lattice, table.keys[v], s.other)
                bound = heuristic(lattice, s.other, lattice.goals_at, 1)
                # ties go to the node with the larger cost from the start
                put(table, v, cost + np.int64(inflation * bound), -cost)
    return GOING


@allocation_free(inline="always")
def _edge_free(s, u, v, m, check):
    """Whether the edge by move m from u to v is free, as remembered. Unknown edges are checked if `check`;
    otherwise they do not count as free."""
    half, table = len(s.near) // 2, s.table
    node = u if m < half else v
    if table.state[u] != FREE or table.state[v] != FREE:
        return False
    if check and table.edges[node, m % half] == UNKNOWN:
        table.edges[node, m % half] = FREE if _move_free(s, u, v, m) else BLOCKED
    return table.edges[node, m % half] == FREE


@allocation_free()
def _best_edge(s, node, check):
    """The smallest cost to the goal over a node's free edges, and where that edge leads. Edges that cannot
    lower the cost are not checked."""
    lattice, table, at = s.lattice, s.table, s.other
    best, following = np.int64(INFINITE), np.int64(-1)
    if table.state[node] != FREE:
        return best, following
    _coordinates(lattice, table.keys[node], at)
    for goal in range(len(lattice.goals)):
        corner, cost = _last_edge(lattice, goal, at)
        if cost >= best:
            continue
        if check and s.last[goal, corner] == UNKNOWN:
            s.last[goal, corner] = FREE if _last_free(s, at, goal) else BLOCKED
        if s.last[goal, corner] == FREE:
            best, following, table.values[GOAL] = cost, np.int64(AT_GOAL), goal
    for m in range(len(s.near)):
        beside = _key_beside(lattice, table.keys[node], at, m)
        v = find(table, beside) if beside >= 0 else np.int64(-1)
        if v >= 0 and table.g[v] + lattice.costs[m] < best and _edge_free(s, node, v, m, check):
            best, following = table.g[v] + lattice.costs[m], v
    return best, following


@allocation_free()
def _queue_if_inconsistent(s, node):
    """UpdateVertex of the paper, whose k_m is OFFSET."""
    table = s.table
    if table.g[node] == table.rhs[node]:
        take(table, node)
        return
    _coordinates(s.lattice, table.keys[node], s.other)
    least = min(table.g[node], table.rhs[node])
    put(table, node, least + heuristic(s.lattice, s.other, s.start_at, 0) + table.values[OFFSET], least)


@njit(cache=True, nogil=True)
def update(s, near, reaches):
    """Check again the nodes that changed shapes may affect, forget such edges, and update rhs.

    near[capacity]: distance of the arm from the changed shapes at each node [m]. reaches[moves / 2]: how far
    any point of the arm moves by half of each move [m]; an edge is unchanged if both of its nodes are farther
    away than that. Edges to the goals are all forgotten.

    Returns False if memory is too small for the corners of the goals' cells.
    """
    lattice, table, at, dof = s.lattice, s.table, s.at, len(s.at)
    _coordinates(lattice, table.keys[table.values[START]], at)
    s.start_at[0], s.last[:] = at, UNKNOWN
    changed = np.zeros(len(table.keys), np.bool_)
    for node in range(1, table.values[NODES]):
        if near[node] <= 0 or table.state[node] == UNKNOWN:
            table.state[node], changed[node] = UNKNOWN, True
        for m in range(len(reaches)):
            if table.edges[node, m] == UNKNOWN:
                continue
            _coordinates(lattice, table.keys[node], at)
            other = find(table, _key_beside(lattice, table.keys[node], at, m))
            if min(near[node], near[other]) <= reaches[m]:
                table.edges[node, m] = UNKNOWN
                changed[node], changed[other] = True, True
    for goal in range(len(lattice.goals)):
        for corner in range(1 << dof):
            key, inside = np.int64(0), True
            for j in range(dof):
                c = np.int64(np.floor(lattice.goals_at[goal, j])) + (corner >> j & 1)
                inside &= 0 <= c < lattice.counts[j]
                key += c * lattice.strides[j]
            node = find_or_add(table, key) if inside else np.int64(AT_GOAL)
            if node < 0:
                return False
            changed[node] = True
    _check_nodes(s, np.arange(1, table.values[NODES]))
    for node in range(1, table.values[NODES]):
        if changed[node]:
            table.rhs[node], _ = _best_edge(s, node, True)
            if table.state[node] == BLOCKED:
                table.g[node] = INFINITE
            _queue_if_inconsistent(s, node)
    return True


@njit(cache=True, nogil=True)
def d_star_lite(s, expansions):
    """ComputeShortestPath of the paper, for up to `expansions` expansions. Edges that cannot lower a node's
    cost are not checked."""
    table, start, offset = s.table, s.table.values[START], s.table.values[OFFSET]
    g, rhs, begun = table.g, table.rhs, table.values[EXPANSIONS]
    while table.state[start] != BLOCKED and table.values[QUEUED] > 0:
        u = np.int64(table.heap[0])
        first, second, least = table.first[u], table.second[u], min(g[start], rhs[start])
        if (first, second) >= (least + offset, least) and rhs[start] <= g[start]:
            break
        if table.values[EXPANSIONS] - begun >= expansions:
            return GOING
        _queue_if_inconsistent(s, u)
        if (table.first[u], table.second[u]) > (first, second):
            continue
        if not _look_around(s, u):
            return FULL
        table.values[EXPANSIONS] += 1
        before = g[u]
        g[u] = rhs[u] if before > rhs[u] else INFINITE
        _queue_if_inconsistent(s, u)
        for m in range(len(s.near)):
            v = s.near[m]
            if v < 0 or table.state[v] != FREE:
                continue
            if g[u] < INFINITE:
                cost = g[u] + s.lattice.costs[m]
                if cost >= rhs[v] or not _edge_free(s, u, v, m, True):
                    continue
                rhs[v] = cost
            elif rhs[v] == before + s.lattice.costs[m]:
                rhs[v], _ = _best_edge(s, v, True)
            else:
                continue
            _queue_if_inconsistent(s, v)
    return FOUND if rhs[start] < INFINITE else EXHAUSTED


@njit(cache=True)
def path_keys(s):
    """The keys of the nodes of the path that D* Lite found; writes its goal to `table.values`. Edges that
    determine rhs are known to be free, so nothing is checked."""
    node = s.table.values[START]
    keys = [s.table.keys[node]]
    while True:
        _, node = _best_edge(s, node, False)
        if node <= AT_GOAL:
            return np.array(keys)
        keys.append(s.table.keys[node])
