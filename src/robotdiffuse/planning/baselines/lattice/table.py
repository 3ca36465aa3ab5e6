"""The memory of a search on a lattice: a hash table of nodes (open addressing), and a queue as a binary heap
with the place of each node in it."""

from typing import NamedTuple

import numpy as np

from robotdiffuse.core.kernels import allocation_free

INFINITE = 1 << 60
"""Cost of nodes that are not reached."""
UNKNOWN, FREE, BLOCKED, CLOSED = 0, 1, 2, 3
"""States of nodes and edges; CLOSED is a free node that A* has expanded."""
NODES, QUEUED, EXPANSIONS, GOAL, START, OFFSET = range(6)
"""Places in `Table.values`."""
AT_GOAL = 0
"""The node that stands for the goals."""
_FACTOR_1, _FACTOR_2 = np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB)


class Table(NamedTuple):
    """The nodes seen so far, and the queue. Node AT_GOAL stands for the goals and is in no slot."""

    slots: np.ndarray
    """[a power of two] node + 1 at the place of its key or after it, 0 where empty."""
    keys: np.ndarray
    """[capacity]"""
    g: np.ndarray
    """[capacity] A*: cost from the start; D* Lite: to the goal, by the last expansion [units]."""
    rhs: np.ndarray
    """[capacity] D* Lite: cost to the goal, by the neighbours' g [units]; A*: the node before."""
    state: np.ndarray
    """[capacity]"""
    edges: np.ndarray
    """[capacity, moves / 2] D* Lite: state of the motion of each move of the first half."""
    heap: np.ndarray
    """[capacity] queued nodes."""
    place: np.ndarray
    """[capacity] place in the heap + 1; 0 for nodes that are not queued."""
    first: np.ndarray
    second: np.ndarray
    """[capacity] the keys by which the queue is sorted."""
    values: np.ndarray
    """[6] numbers of nodes, queued nodes and expansions; the path's goal; the start and k_m of D* Lite."""


def make_table(max_nodes: int, edges: int) -> Table:
    """An empty table for `max_nodes` nodes, each with room for `edges` edges; the system allocates its memory
    as it is used."""
    capacity = max_nodes + 1
    table = Table(
        np.zeros(1 << (2 * capacity - 1).bit_length(), np.int32),
        *(np.empty(capacity, np.int64), np.empty(capacity, np.int64), np.empty(capacity, np.int64)),
        *(np.zeros(capacity, np.uint8), np.zeros((capacity, edges), np.uint8)),
        *(np.empty(capacity, np.int32), np.zeros(capacity, np.int32)),
        *(np.empty(capacity, np.int64), np.empty(capacity, np.int64)),
        np.zeros(6, np.int64),
    )
    table.values[NODES] = 1
    table.keys[AT_GOAL], table.g[AT_GOAL] = -1, INFINITE
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
def find(table, key):
    """The node of a key; -1 if there is none yet."""
    return np.int64(table.slots[_slot(table, key)]) - 1


@allocation_free(inner=False)
def find_or_add(table, key):
    """The node of a key, added if it is new; -1 if memory is full."""
    i = _slot(table, key)
    if table.slots[i] != 0:
        return np.int64(table.slots[i]) - 1
    node = table.values[NODES]
    if node == len(table.keys):
        return np.int64(-1)
    table.values[NODES] += 1
    table.slots[i] = node + 1
    table.keys[node], table.g[node], table.rhs[node] = key, INFINITE, INFINITE
    return node


@allocation_free()
def _before(table, a, b):
    return table.first[a] < table.first[b] or (
        table.first[a] == table.first[b] and table.second[a] < table.second[b]
    )


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
