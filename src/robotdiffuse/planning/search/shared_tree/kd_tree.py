"""A compiled k-d tree that grows by one point at a time, for nearest-neighbour queries of sampling planners.

J. L. Bentley, "Multidimensional binary search trees used for associative searching", CACM 1975, with buckets
at the leaves; a query descends nearest side first and keeps the exact distance to each cell (S. Arya and
D. Mount, "Algorithms for fast vector quantization", DCC 1993).
"""

from typing import NamedTuple

import numpy as np

from robotdiffuse.core.kernels import allocation_free, kernel

BUCKET = 16
"""Largest number of points of a leaf."""
DEPTH = 64
"""Size of a query's stack of cells; the depth of the tree stays far below, as splits halve buckets."""


class KdTree(NamedTuple):
    """Cells of the tree; the points stay with the caller."""

    axis: np.ndarray
    """[cells] coordinate that a cell is split in, -1 for leaves."""
    value: np.ndarray
    """[cells] value at which it is split."""
    children: np.ndarray
    """[cells, 2]"""
    bucket: np.ndarray
    """[cells, BUCKET] indices of a leaf's points."""
    count: np.ndarray
    """[cells] points of a leaf."""
    used: np.ndarray
    """[1] number of cells."""


class Neighbours(NamedTuple):
    """The result of a query, and its working memory."""

    index: np.ndarray
    """[k] nearest first."""
    distance: np.ndarray
    """[k] squared."""
    cells: np.ndarray
    bounds: np.ndarray
    offsets: np.ndarray


@kernel()
def make_kd_tree(capacity):
    """An empty tree for up to `capacity` points."""
    # a split leaves at least half a bucket on either side
    cells = 2 * (2 * capacity // BUCKET + 1) + 1
    return KdTree(
        np.full(cells, -1, np.int32),
        np.zeros(cells, np.float32),
        np.zeros((cells, 2), np.int32),
        np.zeros((cells, BUCKET), np.int32),
        np.zeros(cells, np.int32),
        np.ones(1, np.int32),
    )


@kernel()
def make_neighbours(most, dof):
    """Memory for queries of up to `most` points."""
    return Neighbours(
        np.zeros(most, np.int32),
        np.zeros(most, np.float32),
        np.zeros(DEPTH, np.int32),
        np.zeros(DEPTH, np.float32),
        np.zeros((DEPTH, dof), np.float32),
    )


@allocation_free(inner=False)
def insert(tree, points, index):
    """Add the point points[index]. It is left out if its leaf is full of copies of it."""
    cell = 0
    while tree.axis[cell] >= 0:
        cell = tree.children[cell, 1 if points[index, tree.axis[cell]] >= tree.value[cell] else 0]
    if tree.count[cell] == BUCKET and not _split(tree, points, cell):
        return
    if tree.axis[cell] >= 0:
        cell = tree.children[cell, 1 if points[index, tree.axis[cell]] >= tree.value[cell] else 0]
    tree.bucket[cell, tree.count[cell]] = index
    tree.count[cell] += 1


@allocation_free()
def _split(tree, points, cell):
    """Halve a full leaf in the coordinate of its largest spread; False if all its points are the same."""
    axis, spread = 0, np.float32(0.0)
    for j in range(points.shape[1]):
        low = high = points[tree.bucket[cell, 0], j]
        for i in range(1, BUCKET):
            value = points[tree.bucket[cell, i], j]
            low, high = min(low, value), max(high, value)
        if high - low > spread:
            axis, spread = j, high - low
    if spread <= np.float32(0.0):
        return False
    for i in range(1, BUCKET):  # insertion sort along the axis
        moved = tree.bucket[cell, i]
        k = i
        while k > 0 and points[tree.bucket[cell, k - 1], axis] > points[moved, axis]:
            tree.bucket[cell, k] = tree.bucket[cell, k - 1]
            k -= 1
        tree.bucket[cell, k] = moved
    # the median, moved to where neighbours differ
    middle = BUCKET // 2
    while (
        middle < BUCKET
        and points[tree.bucket[cell, middle], axis] <= points[tree.bucket[cell, middle - 1], axis]
    ):
        middle += 1
    if middle == BUCKET:
        middle = BUCKET // 2
        while points[tree.bucket[cell, middle], axis] <= points[tree.bucket[cell, middle - 1], axis]:
            middle -= 1
    low, high = tree.used[0], tree.used[0] + 1
    if high >= len(tree.axis):
        return False
    tree.used[0] += 2
    for i in range(BUCKET):
        side = low if i < middle else high
        tree.bucket[side, i if i < middle else i - middle] = tree.bucket[cell, i]
    tree.count[low], tree.count[high] = middle, BUCKET - middle
    tree.children[cell, 0], tree.children[cell, 1] = low, high
    tree.axis[cell], tree.value[cell] = axis, points[tree.bucket[cell, middle], axis]
    return True


@allocation_free(fastmath=True, inner=False)
def query(tree, points, q, k, out):
    """Find the k points nearest to q; returns their number (fewer than k only in a smaller tree)."""
    dof = len(q)
    found, waiting = 0, 1
    out.cells[0], out.bounds[0] = 0, np.float32(0.0)
    for j in range(dof):
        out.offsets[0, j] = np.float32(0.0)
    while waiting > 0:
        waiting -= 1
        cell, bound, slot = out.cells[waiting], out.bounds[waiting], waiting
        if found == k and bound >= out.distance[k - 1]:
            continue
        while tree.axis[cell] >= 0:
            axis = tree.axis[cell]
            offset = q[axis] - tree.value[cell]
            near = 1 if offset >= np.float32(0.0) else 0
            far_bound = bound - out.offsets[slot, axis] * out.offsets[slot, axis] + offset * offset
            if found < k or far_bound < out.distance[k - 1]:
                # the far side takes this slot; the descent goes on in the slot above
                out.cells[slot], out.bounds[slot] = tree.children[cell, 1 - near], far_bound
                for j in range(dof):
                    out.offsets[slot + 1, j] = out.offsets[slot, j]
                out.offsets[slot, axis] = offset
                slot += 1
            cell = tree.children[cell, near]
        waiting = slot
        for i in range(tree.count[cell]):
            index = tree.bucket[cell, i]
            total = np.float32(0.0)
            for j in range(dof):
                d = points[index, j] - q[j]
                total += d * d
            if found < k or total < out.distance[k - 1]:
                at = found if found < k else k - 1
                while at > 0 and out.distance[at - 1] > total:
                    out.distance[at], out.index[at] = out.distance[at - 1], out.index[at - 1]
                    at -= 1
                out.distance[at], out.index[at] = total, index
                if found < k:
                    found += 1
    return found
