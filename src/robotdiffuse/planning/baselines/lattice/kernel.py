"""Compiled A* and D* Lite on a lattice of configurations, whose nodes are created as they are reached.

A*: P. Hart, N. Nilsson and B. Raphael, "A formal basis for the heuristic determination of minimum cost
paths", IEEE Trans. SSC 1968. D* Lite: S. Koenig and M. Likhachev, "D* Lite", AAAI 2002, optimized version.

`space` is a `collision.kernels.motions.Space`.
"""

import numpy as np
from numba import njit

from robotdiffuse.collision.kernels.compiled import allocation_free
from robotdiffuse.collision.kernels.lane_collision import W
from robotdiffuse.planning.baselines.lattice.graph import (
    ROUNDING,
    check_nodes,
    coordinates,
    corner_node,
    corner_of_cell,
    key_beside,
    last_cost,
    last_free,
    least_between,
    least_to_goal,
    look_around,
    make_scratch,
    move_free,
)
from robotdiffuse.planning.baselines.lattice.table import (
    AT_GOAL,
    BLOCKED,
    CLOSED,
    EXPANSIONS,
    FREE,
    GOAL,
    INFINITE,
    NO_ROOM,
    NODES,
    QUEUED,
    UNKNOWN,
    find,
    find_or_add,
    put,
    take,
)

GOING, FOUND, EXHAUSTED, FULL = 0, 1, 2, 3
"""How a call of a search ends: to be continued, with a path, without one, with memory full."""


@njit(cache=True, nogil=True)
def begin_a_star(lattice, table, start_key, inflation):
    """Queue the start, which must be free."""
    at = np.empty(len(lattice.counts), np.int64)
    start = find_or_add(table, start_key)
    coordinates(lattice, start_key, at)
    table.g[start], table.parent[start], table.state[start] = 0, -1, FREE
    put(table, start, np.int64(inflation * least_to_goal(lattice, at)), 0)


@njit(cache=True, nogil=True)
def a_star(space, lattice, table, inflation, expansions):
    """Weighted A* for up to `expansions` expansions. Each node is expanded once; as the heuristic is
    consistent, the cost is still within the factor `inflation` of the least (M. Likhachev et al., "ARA*",
    NIPS 2003)."""
    scratch = make_scratch(space, lattice)
    half = len(lattice.moves) // 2
    for _ in range(expansions):
        if table.count[QUEUED] == 0:
            return EXHAUSTED
        u = np.int64(table.heap[0])
        if u == AT_GOAL:
            return FOUND
        if not look_around(space, lattice, table, u, scratch):
            return FULL
        take(table, u)
        table.state[u] = CLOSED
        table.count[EXPANSIONS] += 1
        for goal in range(len(lattice.goals)):
            if corner_of_cell(lattice, goal, scratch.at) >= 0:
                cost = table.g[u] + last_cost(lattice, goal, scratch.at)
                if cost < table.g[AT_GOAL] and last_free(space, lattice, scratch.at, goal, scratch):
                    table.g[AT_GOAL], table.parent[AT_GOAL], table.count[GOAL] = cost, u, goal
                    put(table, AT_GOAL, cost, -cost)
        for m in range(2 * half):
            v = scratch.near[m]
            if v < 0 or table.state[v] != FREE:
                continue
            cost = table.g[u] + lattice.costs[m]
            if cost >= table.g[v]:
                continue
            if not move_free(space, lattice, table, u if m < half else v, m % half, scratch):
                continue
            table.g[v], table.parent[v] = cost, u
            coordinates(lattice, table.keys[v], scratch.other)
            # ties go to the node with the larger cost from the start
            put(table, v, cost + np.int64(inflation * least_to_goal(lattice, scratch.other)), -cost)
    return GOING


@allocation_free(inline="always")
def _edge_free(space, lattice, table, v, w, m, scratch):
    """Whether the edge by move m from v to w is free; checked once and remembered."""
    if table.state[v] != FREE or table.state[w] != FREE:
        return False
    half = len(lattice.moves) // 2
    node = v if m < half else w
    if table.edges[node, m % half] == UNKNOWN:
        free = move_free(space, lattice, table, node, m % half, scratch)
        table.edges[node, m % half] = FREE if free else BLOCKED
    return table.edges[node, m % half] == FREE


@allocation_free()
def _queue_if_inconsistent(lattice, table, node, start_at, offset, scratch):
    """UpdateVertex of the paper; `offset` is its k_m."""
    if table.g[node] == table.rhs[node]:
        take(table, node)
        return
    coordinates(lattice, table.keys[node], scratch.other)
    least = min(table.g[node], table.rhs[node])
    bound = max(np.int64(np.floor(least_between(lattice, start_at, scratch.other) - ROUNDING)), 0)
    put(table, node, least + bound + offset, least)


@allocation_free()
def _cost_by_neighbours(space, lattice, table, last, node, scratch):
    """rhs of a node: the smallest cost over its free edges; edges that cannot lower it are not checked."""
    if table.state[node] != FREE:
        return np.int64(INFINITE)
    key, best = table.keys[node], np.int64(INFINITE)
    # not `at`, which holds the coordinates of the node being expanded
    at = scratch.other
    coordinates(lattice, key, at)
    for goal in range(len(lattice.goals)):
        corner = corner_of_cell(lattice, goal, at)
        if corner >= 0 and last[goal, corner] == FREE:
            best = min(best, last_cost(lattice, goal, at))
    for m in range(len(lattice.moves)):
        coordinates(lattice, key, at)
        beside = key_beside(lattice, key, at, m)
        v = find(table, beside) if beside >= 0 else -1
        if v < 0 or table.g[v] + lattice.costs[m] >= best:
            continue
        if _edge_free(space, lattice, table, node, v, m, scratch):
            best = table.g[v] + lattice.costs[m]
    return best


@njit(cache=True, nogil=True)
def update(space, lattice, table, last, start, offset, near, reaches):
    """Check again the nodes and edges that changed shapes may affect, and update rhs.

    near[capacity]: distance of the arm from the changed shapes at each node [m]. reaches[moves / 2]: how far
    any point of the arm moves by half of each move [m]; an edge is unchanged if both of its nodes are farther
    away than that.

    Edges to the goals, last[k, 2 ^ dof], are all checked. Returns False if memory is too small for the
    corners of the goals' cells.
    """
    scratch = make_scratch(space, lattice)
    at, dof, half = scratch.at, len(lattice.counts), len(lattice.moves) // 2
    known, corners, count = table.count[NODES], len(lattice.goals) << dof, 0
    was, changed = table.state[:known].copy(), np.zeros(len(table.keys), np.bool_)
    checked = np.empty(known + corners, np.int64)
    for node in range(1, known):
        if near[node] <= 0 or table.state[node] == UNKNOWN:
            checked[count] = node
            count += 1
    for number in range(corners):
        before = table.count[NODES]
        node = corner_node(lattice, table, number, at)
        if node == NO_ROOM:
            return False
        if node >= before:
            checked[count] = node
            count += 1
    for first in range(0, count, W):
        some = min(W, count - first)
        for i in range(some):
            scratch.pending[i] = checked[first + i]
        check_nodes(space, lattice, table, some, scratch)
    for node in range(1, known):
        if table.state[node] != was[node]:
            changed[node] = True
            if table.state[node] == BLOCKED:
                # no path leads through it: it is consistent, and its neighbours are updated below
                table.g[node], table.rhs[node] = INFINITE, INFINITE
                take(table, node)
        for m in range(half):
            edge = table.edges[node, m]
            if edge == UNKNOWN:
                continue
            coordinates(lattice, table.keys[node], at)
            other = find(table, key_beside(lattice, table.keys[node], at, m))
            if min(near[node], near[other]) > reaches[m]:
                continue
            table.edges[node, m] = UNKNOWN
            if _edge_free(space, lattice, table, node, other, m, scratch) != (edge == FREE):
                changed[node], changed[other] = True, True
    for number in range(corners):
        node = corner_node(lattice, table, number, at)
        if node < 0:
            continue
        goal, corner = number >> dof, number & ((1 << dof) - 1)
        free = table.state[node] == FREE and last_free(space, lattice, at, goal, scratch)
        state = FREE if free else BLOCKED
        if state != last[goal, corner]:
            last[goal, corner] = state
            changed[node] = True
    coordinates(lattice, table.keys[start], at)
    for node in range(1, table.count[NODES]):
        if changed[node]:
            table.rhs[node] = _cost_by_neighbours(space, lattice, table, last, node, scratch)
            _queue_if_inconsistent(lattice, table, node, at, offset, scratch)
    return True


@njit(cache=True, nogil=True)
def d_star_lite(space, lattice, table, last, start, offset, expansions):
    """ComputeShortestPath of the paper, for up to `expansions` expansions. Edges that cannot lower a node's
    cost are not checked."""
    scratch, start_at = make_scratch(space, lattice), np.empty(len(lattice.counts), np.int64)
    coordinates(lattice, table.keys[start], start_at)
    g, rhs = table.g, table.rhs
    begun = table.count[EXPANSIONS]
    while table.count[QUEUED] > 0:
        u = np.int64(table.heap[0])
        least = min(g[start], rhs[start])
        first, second = table.first[u], table.second[u]
        sooner = first < least + offset or (first == least + offset and second < least)
        if not sooner and rhs[start] <= g[start]:
            break
        if table.count[EXPANSIONS] - begun >= expansions:
            return GOING
        _queue_if_inconsistent(lattice, table, u, start_at, offset, scratch)
        if table.first[u] > first or (table.first[u] == first and table.second[u] > second):
            continue
        if not look_around(space, lattice, table, u, scratch):
            return FULL
        table.count[EXPANSIONS] += 1
        before = g[u]
        if before > rhs[u]:
            g[u] = rhs[u]
        else:
            g[u] = INFINITE
        _queue_if_inconsistent(lattice, table, u, start_at, offset, scratch)
        for m in range(len(lattice.moves)):
            v = scratch.near[m]
            if v < 0 or table.state[v] != FREE:
                continue
            if g[u] < INFINITE:
                cost = g[u] + lattice.costs[m]
                if cost >= rhs[v] or not _edge_free(space, lattice, table, u, v, m, scratch):
                    continue
                rhs[v] = cost
            elif rhs[v] == before + lattice.costs[m]:
                rhs[v] = _cost_by_neighbours(space, lattice, table, last, v, scratch)
            else:
                continue
            _queue_if_inconsistent(lattice, table, v, start_at, offset, scratch)
    return FOUND if rhs[start] < INFINITE else EXHAUSTED


@njit(cache=True)
def path_from(lattice, table, last, start):
    """The keys of the nodes of the path that D* Lite found; writes its goal to `table.count`. Edges that
    determine rhs are known to be free, so nothing is checked."""
    at, node, half = np.empty(len(lattice.counts), np.int64), start, len(lattice.moves) // 2
    keys = [table.keys[start]]
    while True:
        coordinates(lattice, table.keys[node], at)
        best, following = np.int64(INFINITE), np.int64(-1)
        for goal in range(len(lattice.goals)):
            corner = corner_of_cell(lattice, goal, at)
            if corner >= 0 and last[goal, corner] == FREE:
                cost = last_cost(lattice, goal, at)
                if cost < best:
                    best, table.count[GOAL] = cost, goal
        for m in range(2 * half):
            beside = key_beside(lattice, table.keys[node], at, m)
            v = find(table, beside) if beside >= 0 else np.int64(-1)
            if v < 0 or table.state[v] != FREE or table.g[v] + lattice.costs[m] >= best:
                continue
            if table.edges[node if m < half else v, m % half] == FREE:
                best, following = table.g[v] + lattice.costs[m], v
        if following < 0:
            return np.array(keys)
        node = following
        keys.append(table.keys[node])
