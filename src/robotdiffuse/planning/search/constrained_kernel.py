"""Compiled RRT-Connect under path constraints, with projected nodes, and simplification.

D. Berenson, S. Srinivasa and J. Kuffner, "Task Space Regions: A framework for pose-constrained
manipulation planning", IJRR 2011 (CBiRRT2), for trees with projected steps. Edges are proved, not sampled: a
straight piece is accepted where the constraints are proved along it; else its middle is projected, and both
halves are treated alike.
"""

from typing import NamedTuple

import numpy as np

from robotdiffuse.collision.kernels.compiled import random
from robotdiffuse.collision.kernels.lane_collision import W, make_workspace
from robotdiffuse.collision.kernels.motions import motion_free
from robotdiffuse.core.kernels import inner_kernel, kernel
from robotdiffuse.problems.constraint_kernel import evaluate, make_work, proved
from robotdiffuse.problems.projection_kernel import project

MAX_DEPTH = 9
"""A motion is halved at most this many times."""
MIN_PIECE = 0.004
"""Shortest piece [rad]."""
MAX_PIECES = 512
MAX_GROWTH = 0.2
"""Along a straight piece a row's value may exceed those at its ends by this part of the row's tolerance."""
MIN_PROOF_PIECE = 1 / 16
"""The proof of a piece splits it down to this part of its length."""
MAX_DRIFT = 0.85
"""A projected middle is no further from either end than this part of the piece's length."""
MIN_APPROACH = 0.95
"""A step must bring the distance to its target down to this part or less."""
MAX_STEP_FACTOR = 2.0
"""A step is at most this many times as long as the straight line that it replaces."""
SHORTCUT_GAIN, MAX_FAILED_SHORTCUTS = 0.99, 20
"""A shortcut counts if it leaves at most this part of the length; after this many in a row that do not, no
more are tried."""
MIN_CORNER_MOVE = 0.005
"""Smoothing leaves corners that it would move by less than this [rad]."""
MAX_INITIAL_PIECE = 0.15
"""Pieces of a path are split down to this length before simplification [rad]."""


class Limits(NamedTuple):
    """What every edge of the search keeps."""

    space: tuple
    """`collision.kernels.motions.Space`"""
    rows: tuple
    """`problems.constraint_kernel.Rows`"""
    kept: np.ndarray
    """[m] limits of the rows, a little within those of the validator."""


class Trees(NamedTuple):
    """Two trees, from the start and from the goals; filled in place, so that a search can be continued."""

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
    """[MAX_PIECES, dof] the motion that `between` found."""
    here: np.ndarray
    trial: np.ndarray


@kernel()
def make_trees(start, goals, capacity):
    """Trees with the start and the goals as their roots."""
    nodes = np.empty((2, capacity, len(start)))
    nodes[0, 0] = start
    nodes[1, : len(goals)] = goals
    return Trees(nodes, np.full((2, capacity), -1, np.int32), np.array([1, len(goals)], np.int32))


@inner_kernel()
def _memory(limits):
    dof = len(limits.rows.lower)
    return Memory(
        make_workspace(limits.space.robot, limits.space.scene),
        np.empty((dof, W), np.float32),
        make_work(limits.rows),
        np.empty(len(limits.kept)),
        np.empty((MAX_DEPTH, dof)),
        np.empty((MAX_PIECES, dof)),
        np.empty(dof),
        np.empty(dof),
    )


@inner_kernel()
def _distance(a, b):
    total = 0.0
    for j in range(len(a)):
        total += (a[j] - b[j]) ** 2
    return np.sqrt(total)


@kernel()
def length(path):
    """Sum of the lengths of the segments [rad]."""
    total = 0.0
    for i in range(len(path) - 1):
        total += _distance(path[i], path[i + 1])
    return total


@inner_kernel()
def _straight(limits, a, b, memory):
    """Whether the straight piece between two configurations is proved to keep the constraints, with values
    little above those at its ends."""
    rows, work = limits.rows, memory.rows
    evaluate(rows, a, 0, work)
    evaluate(rows, b, 1, work)
    for m in range(len(limits.kept)):
        most = max(work.values[0, m], work.values[1, m]) + MAX_GROWTH * rows.tolerance[m]
        memory.growing[m] = min(limits.kept[m], most)
    return proved(rows, memory.growing, a, b, MIN_PROOF_PIECE, work)[1] < 0


@inner_kernel()
def _usable(limits, a, b, memory):
    return _straight(limits, a, b, memory) and motion_free(limits.space, a, b, memory.block, memory.space)


@inner_kernel()
def between(limits, a, b, most, memory):
    """Find a motion from a to b, which keep the constraints, as straight pieces; write their ends to
    memory.out.

    Returns their number; 0 if none was found, or it is longer than `most` [rad].
    """
    memory.stack[0] = b
    memory.here[:] = a
    top, count, done = 1, 0, 0.0
    while top > 0:
        target = memory.stack[top - 1]
        gap = _distance(memory.here, target)
        if done + gap > most:
            return 0
        if _straight(limits, memory.here, target, memory):
            if count == MAX_PIECES:
                return 0
            if not motion_free(limits.space, memory.here, target, memory.block, memory.space):
                return 0
            memory.out[count] = target
            memory.here[:] = target
            top, count, done = top - 1, count + 1, done + gap
            continue
        if top == MAX_DEPTH or gap < MIN_PIECE:
            return 0
        middle = memory.stack[top]
        for j in range(len(middle)):
            middle[j] = 0.5 * (memory.here[j] + target[j])
        if not project(limits.rows, limits.kept, middle, memory.rows):
            return 0
        if max(_distance(memory.here, middle), _distance(middle, target)) > MAX_DRIFT * gap:
            return 0
        top += 1
    return count


@kernel(nogil=True)
def line(limits, a, b):
    """The waypoints [n, dof] of `between`, with a; n = 0 if there is none."""
    memory = _memory(limits)
    count = between(limits, a, b, np.inf, memory)
    out = np.empty((count + 1 if count else 0, len(a)))
    if count:
        out[0] = a
        out[1:] = memory.out[:count]
    return out


@kernel(nogil=True)
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
        if max(sizes[0], sizes[1]) >= capacity - MAX_PIECES:
            break
    return np.empty((0, dof))


@inner_kernel()
def _extended(limits, trees, tree, q, longest, memory):
    """Step from the nearest node towards q; returns the last node added, -1 for none."""
    best, near = np.inf, 0
    for n in range(trees.sizes[tree]):
        total = 0.0
        for j in range(len(q)):
            total += (trees.nodes[tree, n, j] - q[j]) ** 2
        if total < best:
            best, near = total, n
    return _stepped(limits, trees, tree, near, q, longest, memory)


@inner_kernel()
def _stepped(limits, trees, tree, near, q, longest, memory):
    """Step from a node towards q; returns the last node added, -1 for none."""
    origin = trees.nodes[tree, near]
    gap = _distance(origin, q)
    share = min(1.0, longest / max(gap, 1e-12))
    end = memory.trial
    for j in range(len(q)):
        end[j] = q[j] if share == 1.0 else origin[j] + share * (q[j] - origin[j])
    if share < 1.0:
        if not project(limits.rows, limits.kept, end, memory.rows):
            return -1
        if _distance(end, q) > max(MIN_APPROACH * gap, gap - 0.5 * longest):
            return -1
    if trees.sizes[tree] + MAX_PIECES > trees.nodes.shape[1]:
        return -1
    count = between(limits, origin, end, MAX_STEP_FACTOR * min(gap, longest), memory)
    parent = near
    for i in range(count):
        here = trees.sizes[tree]
        trees.nodes[tree, here] = memory.out[i]
        trees.parents[tree, here] = parent
        trees.sizes[tree] += 1
        parent = here
    return parent if count else -1


@inner_kernel()
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


@kernel(nogil=True)
def simplify(limits, path, rounds, tries, state):
    """A path with the same ends that is no longer: try shortcuts between random places, `tries` of them; then
    in each of `rounds` rounds smooth the corners and leave out waypoints that a straight piece can skip."""
    memory = _memory(limits)
    points, lost = _finer(path), 0
    for _ in range(tries):
        n = len(points)
        if n < 3 or lost > MAX_FAILED_SHORTCUTS:
            break
        i = min(int(random(state) * (n - 2)), n - 3)
        k = min(i + 2 + int(random(state) * (n - i - 2)), n - 1)
        before = length(points[i : k + 1])
        if before <= _distance(points[i], points[k]) * 1.0001:
            continue
        count = between(limits, points[i], points[k], SHORTCUT_GAIN * before, memory)
        lost += 1
        if count > 0:
            found = np.concatenate((points[i : i + 1], memory.out[:count]))
            points = np.concatenate((points[:i], _finer(found), points[k + 1 :]))
            lost = 0
    points = _skipped(limits, points, memory)
    for _ in range(rounds):
        points = _smoothed(limits, points, memory)
    return _skipped(limits, points, memory)


@inner_kernel()
def _finer(path):
    """The path with its pieces split until they are no longer than MAX_INITIAL_PIECE."""
    total = 1
    for i in range(len(path) - 1):
        total += max(1, int(np.ceil(_distance(path[i], path[i + 1]) / MAX_INITIAL_PIECE)))
    out, n = np.empty((total, path.shape[1])), 0
    for i in range(len(path) - 1):
        parts = max(1, int(np.ceil(_distance(path[i], path[i + 1]) / MAX_INITIAL_PIECE)))
        for part in range(parts):
            out[n] = path[i] + part / parts * (path[i + 1] - path[i])
            n += 1
    out[n] = path[-1]
    return out


@inner_kernel()
def _skipped(limits, path, memory):
    """The path without waypoints that straight pieces can skip, in growing steps."""
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


@inner_kernel()
def _smoothed(limits, path, memory):
    """The path with the middles of its pieces as waypoints, and its corners moved towards them."""
    finer, dof = np.empty((2 * len(path) - 1, path.shape[1])), path.shape[1]
    for i in range(len(path)):
        finer[2 * i] = path[i]
        if i > 0:
            finer[2 * i - 1] = 0.5 * (path[i - 1] + path[i])
    trial = np.empty(dof)
    for i in range(2, len(finer) - 1, 2):
        for j in range(dof):
            trial[j] = 0.5 * finer[i, j] + 0.25 * (finer[i - 1, j] + finer[i + 1, j])
        if _distance(trial, finer[i]) < MIN_CORNER_MOVE:
            continue
        if (
            project(limits.rows, limits.kept, trial, memory.rows)
            and _usable(limits, finer[i - 1], trial, memory)
            and _usable(limits, trial, finer[i + 1], memory)
        ):
            finer[i] = trial
    return finer
