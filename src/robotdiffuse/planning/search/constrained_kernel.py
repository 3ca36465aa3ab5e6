"""Compiled search on what path constraints leave: RRT-Connect whose nodes are projected, and simplification.

D. Berenson, S. Srinivasa and J. Kuffner, "Task Space Regions: A framework for pose-constrained
manipulation planning", IJRR 2011 (CBiRRT2), for trees whose steps are projected. Between nodes nothing is
sampled and hoped for: a straight piece is taken where the constraints are proved along it, else its middle is
projected and both halves are looked at.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from robotdiffuse.collision.kernels.compiled import random
from robotdiffuse.collision.kernels.lane_collision import W, make_workspace
from robotdiffuse.collision.kernels.motions import motion_free
from robotdiffuse.problems.constraint_kernel import evaluate, make_work, project, proved

DEPTH = 9
"""A motion is split into halves so often at most."""
LEAST_PIECE = 0.004
"""Pieces are not shorter [rad]."""
MOST_PIECES = 512
ADDED = 0.2
"""Share of its room that the value of a row may grow by along a straight piece, beyond its ends'."""
COARSEST = 1 / 16
"""Share of a piece down to which its proof splits it."""
DRIFT = 0.85
"""A projected middle is no further from either end than this share of the piece."""
CLOSER = 0.95
"""A step ends at most at this share of the distance that it began at."""
LONGER = 2.0
"""A step is at most so many times as long as the straight line that it replaces."""
PAYS, PATIENCE = 0.99, 20
"""A shortcut takes off at least one part in a hundred; after so many that did not, there are no more."""
LEAST_MOVE = 0.005
"""A corner that smoothing would move less than this stays [rad]."""
FINE = 0.15
"""Pieces of a path are made no longer than this before its simplification [rad]."""


class Limits(NamedTuple):
    """What a search keeps."""

    space: tuple
    """`collision.kernels.motions.Space`"""
    rows: tuple
    """`problems.constraint_kernel.Rows`"""
    kept: np.ndarray
    """[m] limits of the rows, with some room to those of the validator."""


class Trees(NamedTuple):
    """Two trees, from the start and from the goals; filled in place, so that a search can go on."""

    nodes: np.ndarray
    """[2, capacity, dof]"""
    parents: np.ndarray
    """[2, capacity] -1 for roots."""
    sizes: np.ndarray
    """[2]"""


class Memory(NamedTuple):
    space: tuple
    block: np.ndarray
    rows: tuple
    growing: np.ndarray
    """[m] limits along one piece."""
    stack: np.ndarray
    out: np.ndarray
    """[MOST_PIECES, dof] the motion that `between` found."""
    here: np.ndarray
    trial: np.ndarray


@njit(cache=True)
def make_trees(start, goals, capacity):
    """Trees with the start and the goals as their roots."""
    nodes = np.empty((2, capacity, len(start)))
    nodes[0, 0] = start
    nodes[1, : len(goals)] = goals
    return Trees(nodes, np.full((2, capacity), -1, np.int32), np.array([1, len(goals)], np.int32))


@njit(cache=True)
def _memory(limits):
    dof = len(limits.rows.lower)
    return Memory(
        make_workspace(limits.space.robot, limits.space.scene),
        np.empty((dof, W), np.float32),
        make_work(limits.rows),
        np.empty(len(limits.kept)),
        np.empty((DEPTH, dof)),
        np.empty((MOST_PIECES, dof)),
        np.empty(dof),
        np.empty(dof),
    )


@njit(cache=True)
def _distance(a, b):
    total = 0.0
    for j in range(len(a)):
        total += (a[j] - b[j]) ** 2
    return np.sqrt(total)


@njit(cache=True)
def length(path):
    """Sum of the lengths of the segments [rad]."""
    total = 0.0
    for i in range(len(path) - 1):
        total += _distance(path[i], path[i + 1])
    return total


@njit(cache=True)
def _straight(limits, a, b, memory):
    """Whether the straight piece between two configurations keeps the constraints, adding little to the
    values of its ends."""
    rows, work = limits.rows, memory.rows
    evaluate(rows, a, 0, work)
    evaluate(rows, b, 1, work)
    for m in range(len(limits.kept)):
        most = max(work.values[0, m], work.values[1, m]) + ADDED * rows.tolerance[m]
        memory.growing[m] = min(limits.kept[m], most)
    return proved(rows, memory.growing, a, b, COARSEST, work)[1] < 0


@njit(cache=True)
def _usable(limits, a, b, memory):
    return _straight(limits, a, b, memory) and motion_free(limits.space, a, b, memory.block, memory.space)


@njit(cache=True)
def between(limits, a, b, most, memory):
    """A motion from a to b, both of which keep the constraints: straight pieces, whose ends after a are put
    into memory.out. Returns their number, 0 if there is no such motion here or it is longer than `most`."""
    memory.stack[0] = b
    memory.here[:] = a
    top, count, done = 1, 0, 0.0
    while top > 0:
        target = memory.stack[top - 1]
        gap = _distance(memory.here, target)
        if done + gap > most:
            return 0
        if _straight(limits, memory.here, target, memory):
            if count == MOST_PIECES:
                return 0
            if not motion_free(limits.space, memory.here, target, memory.block, memory.space):
                return 0
            memory.out[count] = target
            memory.here[:] = target
            top, count, done = top - 1, count + 1, done + gap
            continue
        if top == DEPTH or gap < LEAST_PIECE:
            return 0
        middle = memory.stack[top]
        for j in range(len(middle)):
            middle[j] = 0.5 * (memory.here[j] + target[j])
        if not project(limits.rows, limits.kept, middle, memory.rows):
            return 0
        if max(_distance(memory.here, middle), _distance(middle, target)) > DRIFT * gap:
            return 0
        top += 1
    return count


@njit(cache=True, nogil=True)
def line(limits, a, b):
    """The waypoints [n, dof] of `between`, with a; n = 0 if there is none."""
    memory = _memory(limits)
    count = between(limits, a, b, np.inf, memory)
    out = np.empty((count + 1 if count else 0, len(a)))
    if count:
        out[0] = a
        out[1:] = memory.out[:count]
    return out


@njit(cache=True, nogil=True)
def search(limits, trees, longest, iterations, state):
    """Grow the trees for a number of iterations, or until they meet; `longest` bounds their steps [rad].

    Returns waypoints [n, dof] from the start to a goal, each straight piece of which is free and proved to
    keep the constraints; n = 0 if none were found yet.
    """
    nodes, parents, sizes = trees
    capacity, dof = nodes.shape[1], nodes.shape[2]
    memory, sample = _memory(limits), np.empty(dof)
    for _ in range(iterations):
        tree = 0 if sizes[0] <= sizes[1] else 1
        other = 1 - tree
        for j in range(dof):
            low, high = limits.space.lower[j], limits.space.upper[j]
            sample[j] = low + random(state) * (high - low)
        if not project(limits.rows, limits.kept, sample, memory.rows):
            continue
        here = _extended(limits, trees, tree, sample, longest, memory)
        if here < 0:
            continue
        sample[:] = nodes[tree, here]
        there = _extended(limits, trees, other, sample, longest, memory)
        while there >= 0:
            if _distance(nodes[other, there], sample) == 0.0:
                return _joined(nodes, parents, tree, here, there)
            there = _stepped(limits, trees, other, there, sample, longest, memory)
        if max(sizes[0], sizes[1]) >= capacity - MOST_PIECES:
            break
    return np.empty((0, dof))


@njit(cache=True)
def _extended(limits, trees, tree, q, longest, memory):
    """A step from the nearest node towards q; the last node that it adds, -1 for none."""
    best, near = np.inf, 0
    for n in range(trees.sizes[tree]):
        total = 0.0
        for j in range(len(q)):
            total += (trees.nodes[tree, n, j] - q[j]) ** 2
        if total < best:
            best, near = total, n
    return _stepped(limits, trees, tree, near, q, longest, memory)


@njit(cache=True)
def _stepped(limits, trees, tree, near, q, longest, memory):
    """A step from a node towards q."""
    origin = trees.nodes[tree, near]
    gap = _distance(origin, q)
    share = min(1.0, longest / max(gap, 1e-12))
    end = memory.trial
    for j in range(len(q)):
        end[j] = q[j] if share == 1.0 else origin[j] + share * (q[j] - origin[j])
    if share < 1.0:
        if not project(limits.rows, limits.kept, end, memory.rows):
            return -1
        if _distance(end, q) > max(CLOSER * gap, gap - 0.5 * longest):
            return -1
    if trees.sizes[tree] + MOST_PIECES > trees.nodes.shape[1]:
        return -1
    count = between(limits, origin, end, LONGER * min(gap, longest), memory)
    parent = near
    for i in range(count):
        here = trees.sizes[tree]
        trees.nodes[tree, here] = memory.out[i]
        trees.parents[tree, here] = parent
        trees.sizes[tree] += 1
        parent = here
    return parent if count else -1


@njit(cache=True)
def _joined(nodes, parents, tree, here, there):
    a, b = (here, there) if tree == 0 else (there, here)
    count, node = 0, a
    while node >= 0:
        count, node = count + 1, parents[0, node]
    first, node = count, parents[1, b]
    while node >= 0:
        count, node = count + 1, parents[1, node]
    path, node = np.empty((count, nodes.shape[2])), a
    for i in range(first - 1, -1, -1):
        path[i], node = nodes[0, node], parents[0, node]
    node = parents[1, b]
    for i in range(first, count):
        path[i], node = nodes[1, node], parents[1, node]
    return path


@njit(cache=True, nogil=True)
def simplify(limits, path, rounds, tries, state):
    """A path between the same ends that is no longer: `tries` shortcuts between random places, then in each
    of the rounds corners smoothed, and waypoints left out where a straight piece keeps the constraints."""
    memory = _memory(limits)
    points, lost = _finer(path), 0
    for _ in range(tries):
        n = len(points)
        if n < 3 or lost > PATIENCE:
            break
        i = min(int(random(state) * (n - 2)), n - 3)
        k = min(i + 2 + int(random(state) * (n - i - 2)), n - 1)
        before = length(points[i : k + 1])
        if before <= _distance(points[i], points[k]) * 1.0001:
            continue
        count = between(limits, points[i], points[k], PAYS * before, memory)
        lost += 1
        if count > 0:
            found = np.concatenate((points[i : i + 1], memory.out[:count]))
            points = np.concatenate((points[:i], _finer(found), points[k + 1 :]))
            lost = 0
    points = _skipped(limits, points, memory)
    for _ in range(rounds):
        points = _smoothed(limits, points, memory)
    return _skipped(limits, points, memory)


@njit(cache=True)
def _finer(path):
    """The path with its pieces split until they are no longer than FINE."""
    total = 1
    for i in range(len(path) - 1):
        total += max(1, int(np.ceil(_distance(path[i], path[i + 1]) / FINE)))
    out, n = np.empty((total, path.shape[1])), 0
    for i in range(len(path) - 1):
        parts = max(1, int(np.ceil(_distance(path[i], path[i + 1]) / FINE)))
        for part in range(parts):
            out[n] = path[i] + part / parts * (path[i + 1] - path[i])
            n += 1
    out[n] = path[-1]
    return out


@njit(cache=True)
def _skipped(limits, path, memory):
    """The path less waypoints that straight pieces can skip, in growing steps."""
    out, n, i = np.empty(path.shape), 0, 0
    while True:
        out[n] = path[i]
        n += 1
        if i == len(path) - 1:
            return out[:n].copy()
        following, ahead = i + 1, 2
        while i + ahead < len(path) and _usable(limits, path[i], path[i + ahead], memory):
            following, ahead = i + ahead, ahead + max(1, ahead // 2)
        i = following


@njit(cache=True)
def _smoothed(limits, path, memory):
    """The path with the middles of its pieces as waypoints, and its corners drawn towards them."""
    finer, dof = np.empty((2 * len(path) - 1, path.shape[1])), path.shape[1]
    for i in range(len(path)):
        finer[2 * i] = path[i]
        if i > 0:
            finer[2 * i - 1] = 0.5 * (path[i - 1] + path[i])
    trial = np.empty(dof)
    for i in range(2, len(finer) - 1, 2):
        for j in range(dof):
            trial[j] = 0.5 * finer[i, j] + 0.25 * (finer[i - 1, j] + finer[i + 1, j])
        if _distance(trial, finer[i]) < LEAST_MOVE:
            continue
        if (
            project(limits.rows, limits.kept, trial, memory.rows)
            and _usable(limits, finer[i - 1], trial, memory)
            and _usable(limits, trial, finer[i + 1], memory)
        ):
            finer[i] = trial
    return finer
