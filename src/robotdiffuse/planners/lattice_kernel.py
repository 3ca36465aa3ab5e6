"""Compiled A* and D* Lite on a lattice of configurations that is never written down.

A*: P. Hart, N. Nilsson and B. Raphael, "A formal basis for the heuristic determination of minimum cost
paths", IEEE Trans. SSC 1968. D* Lite: S. Koenig and M. Likhachev, "D* Lite", AAAI 2002, optimized version.
Nodes live in a hash table (open addressing) and wait in a binary heap that knows where each of them is.

Costs are whole numbers, UNITS to a step of the lattice: edges are rounded up and heuristics down, so sums are
exact, heuristics are consistent to the last bit, and both searches find the same cost.

An edge is free if both of its nodes are and the motion from the first to the second, in the order of the
moves, is: so it is the same edge from either side.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from robotdiffuse.collision.compiled import allocation_free
from robotdiffuse.collision.lanes import W, block_hits, make_workspace
from robotdiffuse.planners.rrt_connect_kernel import motion_free

UNITS = 1 << 20
"""Cost of one step of one joint."""
ROUNDING = 1e-3
"""What floating point may be wrong by [units]; far more than it is."""
INFINITE = 1 << 60
"""Cost of what is not reached."""
GOING, FOUND, EXHAUSTED, FULL = 0, 1, 2, 3
"""How a slice of a search ends: there is more to do, a path is known, there is none, no room for nodes."""
UNKNOWN, FREE, BLOCKED, CLOSED = 0, 1, 2, 3
"""States of nodes and edges; CLOSED is a free node that A* has expanded."""
NODES, QUEUED, EXPANSIONS, GOAL = 0, 1, 2, 3
"""Places in `Table.count`."""
AT_GOAL = 0
"""The node that stands for the goals."""
NO_ROOM = -2
"""In place of a node."""
_FACTOR_1, _FACTOR_2 = np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB)


class Lattice(NamedTuple):
    """Where the nodes are and what joins them. Coordinates count steps from the lowest node of each joint."""

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
    """Least cost of a move for each joint that it moves [steps]."""
    goals: np.ndarray
    """[k, dof] [rad]"""
    goals_at: np.ndarray
    """[k, dof] their coordinates, not whole."""
    cells: np.ndarray
    """[k, dof] coordinates of the lowest corner of the cell that each is in."""


class Table(NamedTuple):
    """The nodes seen so far, and the queue. Node AT_GOAL stands for the goals and is in no slot."""

    slots: np.ndarray
    """[a power of two] node + 1 at the place of its key or after it, 0 where empty."""
    keys: np.ndarray
    """[capacity]"""
    g: np.ndarray
    """[capacity] A*: cost from the start; D* Lite: to the goal, by the last expansion [units]."""
    rhs: np.ndarray
    """[capacity] D* Lite: cost to the goal, by the neighbours' g [units]."""
    parent: np.ndarray
    """[capacity] A*: the node before."""
    state: np.ndarray
    """[capacity]"""
    edges: np.ndarray
    """[capacity, moves / 2] D* Lite: state of the motion of each move of the first half."""
    heap: np.ndarray
    """[capacity] queued nodes."""
    place: np.ndarray
    """[capacity] place in the heap + 1, 0 if not queued."""
    first: np.ndarray
    second: np.ndarray
    """[capacity] the keys by which the queue is sorted."""
    count: np.ndarray
    """[4] see NODES and what follows."""


class Scratch(NamedTuple):
    """Memory of one thread."""

    at: np.ndarray
    other: np.ndarray
    """[dof] coordinates"""
    near: np.ndarray
    """[moves] the nodes beside a node, -1 for none."""
    pending: np.ndarray
    """[16] nodes to be checked."""
    a: np.ndarray
    b: np.ndarray
    block: np.ndarray
    work: tuple


@njit(cache=True)
def make_table(lattice, max_nodes, incremental):
    """Room for `max_nodes`; the system hands out the memory as it is used."""
    capacity, slots = max_nodes + 1, 1
    while slots < 2 * capacity:
        slots *= 2
    cached = capacity if incremental else 1
    table = Table(
        np.zeros(slots, np.int32),
        np.empty(capacity, np.int64),
        np.empty(capacity, np.int64),
        np.empty(cached, np.int64),
        np.empty(capacity, np.int32),
        np.zeros(capacity, np.uint8),
        np.zeros((cached, len(lattice.moves) // 2), np.uint8),
        np.empty(capacity, np.int32),
        np.zeros(capacity, np.int32),
        np.empty(capacity, np.int64),
        np.empty(capacity, np.int64),
        np.zeros(4, np.int64),
    )
    table.count[NODES] = 1
    table.keys[AT_GOAL], table.g[AT_GOAL] = -1, INFINITE
    return table


@njit(cache=True)
def make_scratch(space, lattice):
    moves, dof = lattice.moves.shape
    return Scratch(
        np.empty(dof, np.int64),
        np.empty(dof, np.int64),
        np.empty(moves, np.int64),
        np.empty(W, np.int64),
        np.empty(dof, np.float32),
        np.empty(dof, np.float32),
        np.empty((dof, W), np.float32),
        make_workspace(space.robot, space.scene),
    )


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
def find(table, key):
    """The node of a key; -1 if it was not seen yet."""
    return np.int64(table.slots[_slot(table, key)]) - 1


@allocation_free()
def find_or_add(table, key):
    """The node of a key; -1 if it is new and there is no room for it."""
    i = _slot(table, key)
    if table.slots[i] != 0:
        return np.int64(table.slots[i]) - 1
    node = table.count[NODES]
    if node == len(table.keys):
        return np.int64(-1)
    table.count[NODES] += 1
    table.slots[i] = node + 1
    table.keys[node], table.g[node] = key, INFINITE
    if len(table.rhs) > 1:
        table.rhs[node] = INFINITE
    return node


@allocation_free()
def _before(table, a, b):
    return table.first[a] < table.first[b] or (
        table.first[a] == table.first[b] and table.second[a] < table.second[b]
    )


@allocation_free()
def _settle(table, i):
    """Moves the node at place i of the heap up or down to where its keys belong."""
    heap, place, node = table.heap, table.place, np.int64(table.heap[i])
    while i > 0 and _before(table, node, heap[(i - 1) // 2]):
        heap[i] = heap[(i - 1) // 2]
        place[heap[i]] = i + 1
        i = (i - 1) // 2
    queued = table.count[QUEUED]
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


@allocation_free()
def put(table, node, first, second):
    """Queues a node, or changes its keys if it is queued."""
    table.first[node], table.second[node] = first, second
    if table.place[node] == 0:
        table.heap[table.count[QUEUED]] = node
        table.place[node] = table.count[QUEUED] + 1
        table.count[QUEUED] += 1
    _settle(table, np.int64(table.place[node]) - 1)


@allocation_free()
def take(table, node):
    """Takes a node out of the queue, if it is there."""
    i = np.int64(table.place[node]) - 1
    if i < 0:
        return
    table.place[node] = 0
    table.count[QUEUED] -= 1
    last = np.int64(table.heap[table.count[QUEUED]])
    if last != node:
        table.heap[i] = last
        table.place[last] = i + 1
        _settle(table, i)


@allocation_free()
def coordinates(lattice, key, out):
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
def _check_nodes(space, lattice, table, count, scratch):
    """Finds the states of the first nodes in `pending`, up to 16 at once."""
    for i in range(W):
        coordinates(lattice, table.keys[scratch.pending[min(i, count - 1)]], scratch.other)
        _configuration(lattice, scratch.other, scratch.a)
        for j in range(len(scratch.a)):
            scratch.block[j, i] = scratch.a[j]
    block_hits(space.robot, space.scene, scratch.block, space.padding, False, scratch.work)
    for i in range(count):
        table.state[scratch.pending[i]] = FREE if scratch.work.hits[i] == 0 else BLOCKED


@allocation_free(inline="always")
def _look_around(space, lattice, table, node, scratch):
    """Writes the nodes beside a node to `near`, and its coordinates to `at`; new ones are added and checked.
    False if there is no room for them."""
    key, waiting = table.keys[node], 0
    coordinates(lattice, key, scratch.at)
    for m in range(len(lattice.moves)):
        scratch.near[m] = -1
        beside = _key_beside(lattice, key, scratch.at, m)
        if beside < 0:
            continue
        v = find_or_add(table, beside)
        if v < 0:
            return False
        scratch.near[m] = v
        if table.state[v] == UNKNOWN:
            scratch.pending[waiting] = v
            waiting += 1
            if waiting == W:
                _check_nodes(space, lattice, table, waiting, scratch)
                waiting = 0
    if waiting > 0:
        _check_nodes(space, lattice, table, waiting, scratch)
    return True


@allocation_free(inline="always")
def _move_free(space, lattice, table, node, m, scratch):
    """Whether move m of the first half, from a free node to a free node, is free of collision."""
    coordinates(lattice, table.keys[node], scratch.other)
    _configuration(lattice, scratch.other, scratch.a)
    for j in range(len(scratch.a)):
        scratch.other[j] += lattice.moves[m, j]
    _configuration(lattice, scratch.other, scratch.b)
    return motion_free(space, scratch.a, scratch.b, scratch.block, scratch.work)


@allocation_free(inline="always")
def _last_free(space, lattice, at, goal, scratch):
    """Whether the motion from the node at these coordinates to a goal is free."""
    _configuration(lattice, at, scratch.a)
    for j in range(len(scratch.b)):
        scratch.b[j] = lattice.goals[goal, j]
    return motion_free(space, scratch.a, scratch.b, scratch.block, scratch.work)


@allocation_free()
def _corner(lattice, goal, at):
    """Which corner of the goal's cell the coordinates are, as bits; -1 if none."""
    corner = 0
    for j in range(len(at)):
        d = at[j] - lattice.cells[goal, j]
        if d < 0 or d > 1:
            return -1
        corner |= d << j
    return corner


@allocation_free()
def _corner_node(lattice, table, number, at):
    """The node at a corner of a goal's cell, by goal and corner, and its coordinates; -1 beyond the joint
    limits."""
    dof, key = len(at), np.int64(0)
    goal, corner = number >> dof, number & ((1 << dof) - 1)
    for j in range(dof):
        at[j] = lattice.cells[goal, j] + ((corner >> j) & 1)
        if at[j] < 0 or at[j] >= lattice.counts[j]:
            return np.int64(-1)
        key += at[j] * lattice.strides[j]
    node = find_or_add(table, key)
    return node if node >= 0 else np.int64(NO_ROOM)


@allocation_free()
def _last_cost(lattice, goal, at):
    """Cost of the edge from a corner of the goal's cell to the goal."""
    total = 0.0
    for j in range(len(at)):
        total += (at[j] - lattice.goals_at[goal, j]) ** 2
    return np.int64(np.ceil(UNITS * np.sqrt(total)))


@allocation_free()
def _to_goal(lattice, at):
    """A lower bound of the cost to the nearest goal, consistent.

    The larger of the straight distance and of what the moves cost by joint: no move is cheaper than `slope`
    for each joint that it moves, and the last edge, from a corner of the goal's cell, is at least as long as
    its projection on the diagonal.
    """
    best = np.inf
    dof = len(at)
    diagonal = 1.0 / np.sqrt(dof)
    for goal in range(len(lattice.goals)):
        square, by_joint = 0.0, 0.0
        for j in range(dof):
            d = at[j] - lattice.goals_at[goal, j]
            square += d * d
            steps = max(lattice.cells[goal, j] - at[j], at[j] - lattice.cells[goal, j] - 1, 0)
            by_joint += steps * lattice.slope + (abs(d) - steps) * diagonal
        best = min(best, max(np.sqrt(square), by_joint))
    return max(np.int64(np.floor(UNITS * best - ROUNDING)), 0)


@allocation_free()
def _between(lattice, a, b):
    """A lower bound of the cost between two nodes [units, not whole]; a metric."""
    square, by_joint = 0, 0
    for j in range(len(a)):
        square += (a[j] - b[j]) ** 2
        by_joint += abs(a[j] - b[j])
    return UNITS * max(np.sqrt(square), by_joint * lattice.slope)


@njit(cache=True, nogil=True)
def begin_a_star(lattice, table, start_key, inflation):
    """Queues the start; it must be free."""
    at = np.empty(len(lattice.counts), np.int64)
    start = find_or_add(table, start_key)
    coordinates(lattice, start_key, at)
    table.g[start], table.parent[start], table.state[start] = 0, -1, FREE
    put(table, start, np.int64(inflation * _to_goal(lattice, at)), 0)


@njit(cache=True, nogil=True)
def a_star(space, lattice, table, inflation, expansions):
    """Weighted A* for up to so many expansions. Nodes are expanded once, which keeps the cost within
    `inflation` of the least, as the heuristic is consistent (M. Likhachev et al., "ARA*", NIPS 2003)."""
    scratch = make_scratch(space, lattice)
    half = len(lattice.moves) // 2
    for _ in range(expansions):
        if table.count[QUEUED] == 0:
            return EXHAUSTED
        u = np.int64(table.heap[0])
        if u == AT_GOAL:
            return FOUND
        if not _look_around(space, lattice, table, u, scratch):
            return FULL
        take(table, u)
        table.state[u] = CLOSED
        table.count[EXPANSIONS] += 1
        for goal in range(len(lattice.goals)):
            if _corner(lattice, goal, scratch.at) >= 0:
                cost = table.g[u] + _last_cost(lattice, goal, scratch.at)
                if cost < table.g[AT_GOAL] and _last_free(space, lattice, scratch.at, goal, scratch):
                    table.g[AT_GOAL], table.parent[AT_GOAL], table.count[GOAL] = cost, u, goal
                    put(table, AT_GOAL, cost, -cost)
        for m in range(2 * half):
            v = scratch.near[m]
            if v < 0 or table.state[v] != FREE:
                continue
            cost = table.g[u] + lattice.costs[m]
            if cost >= table.g[v]:
                continue
            if not _move_free(space, lattice, table, u if m < half else v, m % half, scratch):
                continue
            table.g[v], table.parent[v] = cost, u
            coordinates(lattice, table.keys[v], scratch.other)
            # of equally promising nodes, the one that is farthest on its way
            put(table, v, cost + np.int64(inflation * _to_goal(lattice, scratch.other)), -cost)
    return GOING


@allocation_free(inline="always")
def _edge_free(space, lattice, table, v, w, m, scratch):
    """Whether the edge by move m from v to w is free; it is checked once."""
    if table.state[v] != FREE or table.state[w] != FREE:
        return False
    half = len(lattice.moves) // 2
    node = v if m < half else w
    if table.edges[node, m % half] == UNKNOWN:
        free = _move_free(space, lattice, table, node, m % half, scratch)
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
    bound = max(np.int64(np.floor(_between(lattice, start_at, scratch.other) - ROUNDING)), 0)
    put(table, node, least + bound + offset, least)


@allocation_free()
def _cost_by_neighbours(space, lattice, table, last, node, scratch):
    """rhs anew: the least over all free edges, which are checked as far as they matter."""
    if table.state[node] != FREE:
        return np.int64(INFINITE)
    key, best = table.keys[node], np.int64(INFINITE)
    # not `at`: that belongs to the node that is being expanded
    at = scratch.other
    coordinates(lattice, key, at)
    for goal in range(len(lattice.goals)):
        corner = _corner(lattice, goal, at)
        if corner >= 0 and last[goal, corner] == FREE:
            best = min(best, _last_cost(lattice, goal, at))
    for m in range(len(lattice.moves)):
        coordinates(lattice, key, at)
        beside = _key_beside(lattice, key, at, m)
        v = find(table, beside) if beside >= 0 else -1
        if v < 0 or table.g[v] + lattice.costs[m] >= best:
            continue
        if _edge_free(space, lattice, table, node, v, m, scratch):
            best = table.g[v] + lattice.costs[m]
    return best


@njit(cache=True, nogil=True)
def update(space, lattice, table, last, start, offset, near, reaches):
    """Finds anew what changed shapes may have changed, and then rhs.

    near[capacity] is how far from them the arm is at each node, reaches[moves / 2] how far any point of it
    gets by half of each move [m]: a motion stays as it was if both of its ends are farther away than that.
    Edges to the goals, last[k, 2 ^ dof], are all checked. False if there is no room for the corners of the
    goals' cells.
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
        node = _corner_node(lattice, table, number, at)
        if node == NO_ROOM:
            return False
        if node >= before:
            checked[count] = node
            count += 1
    for first in range(0, count, W):
        some = min(W, count - first)
        for i in range(some):
            scratch.pending[i] = checked[first + i]
        _check_nodes(space, lattice, table, some, scratch)
    for node in range(1, known):
        if table.state[node] != was[node]:
            changed[node] = True
            if table.state[node] == BLOCKED:
                # no path can lead through it: consistent as it is, and its neighbours are changed below
                table.g[node], table.rhs[node] = INFINITE, INFINITE
                take(table, node)
        for m in range(half):
            edge = table.edges[node, m]
            if edge == UNKNOWN:
                continue
            coordinates(lattice, table.keys[node], at)
            other = find(table, _key_beside(lattice, table.keys[node], at, m))
            if min(near[node], near[other]) > reaches[m]:
                continue
            table.edges[node, m] = UNKNOWN
            if _edge_free(space, lattice, table, node, other, m, scratch) != (edge == FREE):
                changed[node], changed[other] = True, True
    for number in range(corners):
        node = _corner_node(lattice, table, number, at)
        if node < 0:
            continue
        goal, corner = number >> dof, number & ((1 << dof) - 1)
        free = table.state[node] == FREE and _last_free(space, lattice, at, goal, scratch)
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
    """ComputeShortestPath of the paper, for up to so many expansions. Edges that could not make a node
    cheaper are left unchecked."""
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
        if not _look_around(space, lattice, table, u, scratch):
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
    """After D* Lite found a path: the keys of its nodes; the goal that it ends at goes to `count`. What makes
    rhs of a node is known to be free, so nothing is checked."""
    at, node, half = np.empty(len(lattice.counts), np.int64), start, len(lattice.moves) // 2
    keys = [table.keys[start]]
    while True:
        coordinates(lattice, table.keys[node], at)
        best, following = np.int64(INFINITE), np.int64(-1)
        for goal in range(len(lattice.goals)):
            corner = _corner(lattice, goal, at)
            if corner >= 0 and last[goal, corner] == FREE:
                cost = _last_cost(lattice, goal, at)
                if cost < best:
                    best, table.count[GOAL] = cost, goal
        for m in range(2 * half):
            beside = _key_beside(lattice, table.keys[node], at, m)
            v = find(table, beside) if beside >= 0 else np.int64(-1)
            if v < 0 or table.state[v] != FREE or table.g[v] + lattice.costs[m] >= best:
                continue
            if table.edges[node if m < half else v, m % half] == FREE:
                best, following = table.g[v] + lattice.costs[m], v
        if following < 0:
            return np.array(keys)
        node = following
        keys.append(table.keys[node])
