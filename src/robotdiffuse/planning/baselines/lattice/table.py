"""The memory of a search on a lattice: a hash table of nodes (open addressing), and a queue as a binary heap
with the place of each node in it."""

from typing import NamedTuple

import numpy as np

from robotdiffuse.core.kernels import allocation_free, kernel

INFINITE = 1 << 60
"""Cost of nodes that are not reached."""
UNKNOWN, FREE, BLOCKED = 0, 1, 2
"""States of nodes and edges."""
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
    parent, heap, place = np.empty(n, np.int32), np.empty(n, np.int32), np.zeros(n, np.int32)
    state, known = np.zeros(n, np.uint8), np.zeros((n, edges), np.uint8)
    values = np.zeros(5, np.int64)
    table = Table(slots, keys, g, rhs, parent, state, known, heap, place, first, second, values)
    table.values[NODES] = goals
    table.g[:goals] = table.rhs[:goals] = INFINITE
    table.parent[:goals], table.state[:goals] = -1, FREE
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
        table.keys[node], table.g[node], table.rhs[node], table.parent[node] = key, INFINITE, INFINITE, -1
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
    heap, place, queued = table.heap, table.place, table.values[QUEUED]
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
    heap[i], place[node] = node, i + 1


@allocation_free(inner=False)
def put(table, node, first, second):
    """Queue a node, or change its keys if it is queued."""
    table.first[node], table.second[node] = first, second
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
