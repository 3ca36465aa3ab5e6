"""Search under path constraints: RRT-Connect with projected nodes, and simplification, in the anytime loop.

D. Berenson, S. Srinivasa and J. Kuffner, "Task Space Regions: A framework for pose-constrained
manipulation planning", IJRR 2011 (CBiRRT2), for trees with projected steps. Edges are proved, not sampled: a
straight piece is accepted where the constraints are proved along it; else its middle is projected, and both
halves are treated alike.

The planners aorrtc, rrt_connect and robotdiffuse use it for problems with constraints. The search keeps a
little more than the tolerances, which rounding of corners and numbers needs; the validator proves the result.
"""

from typing import NamedTuple

import numpy as np
from numba.extending import overload

from robotdiffuse.collision.kernels.motions import distance, motion_free, path_length
from robotdiffuse.collision.kernels.random import random
from robotdiffuse.core.kernels import inner_kernel, kernel
from robotdiffuse.planning.search import rrt_kernel
from robotdiffuse.problems.constraint_kernel import evaluate, make_work, proved
from robotdiffuse.problems.projection_kernel import project

MAX_DEPTH = 9
"""A motion is halved at most this many times."""
MIN_PIECE = 0.004
"""Shortest piece [rad]."""
MAX_PIECES = 512
MAX_GROWTH = 0.2
"""Along a straight piece, the value of a constraint row may exceed its values at both ends by this fraction
of the row's tolerance."""
MIN_PROOF_PIECE = 1 / 16
"""A proof splits a piece into parts no shorter than this fraction of its length."""
MAX_DRIFT = 0.85
"""A projected middle is no further from either end than this fraction of the piece's length."""
MIN_APPROACH = 0.95
"""After a step, the distance to its target must be at most this fraction of the distance before."""
MAX_STEP_FACTOR = 2.0
"""A step is at most this many times as long as the straight line that it replaces."""
# A shortcut counts if it leaves at most this part of the length; after this many in a row that do not, no
# more are tried.
SHORTCUT_GAIN = 0.99
MAX_FAILED_SHORTCUTS = 20
MIN_CORNER_MOVE = 0.005
"""Smoothing leaves corners that it would move by less than this [rad]."""
MAX_INITIAL_PIECE = 0.15
"""Pieces of a path are split down to this length before simplification [rad]."""


class Limits(NamedTuple):
    """What every edge of the search keeps, and working memory."""

    rows: tuple
    """`problems.constraint_kernel.Rows`"""
    kept: np.ndarray
    """[m] limits of the rows, a little within those of the validator."""
    work: tuple
    growing: np.ndarray
    """[m] limits along one piece."""
    stack: np.ndarray
    out: np.ndarray
    """[MAX_PIECES, dof] the motion that `between` found."""
    here: np.ndarray


@kernel()
def make_limits(rows, kept):
    dof = len(rows.lower)
    return Limits(
        rows,
        kept,
        make_work(rows),
        np.empty(len(kept)),
        np.empty((MAX_DEPTH, dof)),
        np.empty((MAX_PIECES, dof)),
        np.empty(dof),
    )


@overload(rrt_kernel.keep)
def _keep(limits, q):
    return lambda limits, q: project(limits.rows, limits.kept, q, limits.work)


@overload(rrt_kernel.extended)
def _extended(space, limits, trees, tree, near, q, longest, scratch):
    def extended(space, limits, trees, tree, near, q, longest, scratch):
        origin = trees.nodes[tree, near]
        end = scratch.end
        gap = distance(origin, q)
        if gap <= longest:
            end[:] = q
        else:
            end[:] = origin + longest / gap * (q - origin)
            if not project(limits.rows, limits.kept, end, limits.work):
                return -1
            if distance(end, q) > max(MIN_APPROACH * gap, gap - 0.5 * longest):
                return -1
        if trees.sizes[tree] + MAX_PIECES > trees.nodes.shape[1]:
            return -1
        count = between(space, limits, origin, end, MAX_STEP_FACTOR * min(gap, longest), scratch)
        last = near
        for i in range(count):
            cost = trees.costs[tree, last] + distance(trees.nodes[tree, last], limits.out[i])
            last = rrt_kernel.add(trees, tree, limits.out[i], cost, last)
        return last if count else -1

    return extended


@inner_kernel()
def _straight(limits, a, b):
    """Whether the straight piece between two configurations is proved to keep the constraints, with values
    little above those at its ends."""
    rows = limits.rows
    work = limits.work
    evaluate(rows, a, 0, work)
    evaluate(rows, b, 1, work)
    for m in range(len(limits.kept)):
        limit = max(work.values[0, m], work.values[1, m]) + MAX_GROWTH * rows.tolerance[m]
        limits.growing[m] = min(limits.kept[m], limit)
    return proved(rows, limits.growing, a, b, MIN_PROOF_PIECE, work)[1] < 0


@inner_kernel()
def _usable(space, limits, a, b, scratch):
    return _straight(limits, a, b) and motion_free(space, a, b, scratch.block, scratch.work)


@inner_kernel()
def between(space, limits, a, b, most, scratch):
    """Find a motion from a to b, which keep the constraints, as straight pieces; write their ends to
    limits.out.

    Returns their number; 0 if none was found, or it is longer than `most` [rad].
    """
    stack = limits.stack
    current = limits.here
    stack[0] = b
    current[:] = a
    top = 1
    count = 0
    length = 0.0
    while top > 0:
        target = stack[top - 1]
        gap = distance(current, target)
        if length + gap > most:
            return 0
        if _straight(limits, current, target):
            if count == MAX_PIECES or not motion_free(space, current, target, scratch.block, scratch.work):
                return 0
            limits.out[count] = target
            current[:] = target
            top = top - 1
            count = count + 1
            length = length + gap
            continue
        if top == MAX_DEPTH or gap < MIN_PIECE:
            return 0
        middle = stack[top]
        middle[:] = 0.5 * (current + target)
        if not project(limits.rows, limits.kept, middle, limits.work):
            return 0
        if max(distance(current, middle), distance(middle, target)) > MAX_DRIFT * gap:
            return 0
        top += 1
    return count


@kernel(nogil=True)
def line(space, limits, a, b):
    """The waypoints [n, dof] of `between`, with a; n = 0 if there is none."""
    trees = rrt_kernel.make_trees(a, b.reshape(1, -1), MAX_PIECES + 1)
    scratch = rrt_kernel.make_scratch(space, trees.nodes)
    end = rrt_kernel.extended(space, limits, trees, 0, 0, b, 2.0 * distance(a, b), scratch)
    return rrt_kernel.branch(trees, 0, end)


@kernel(nogil=True)
def simplify(space, limits, path, rounds, tries, state):
    """A path with the same ends that is no longer: try shortcuts between random places, `tries` of them; then
    in each of `rounds` rounds smooth the corners and leave out waypoints that a straight piece can skip."""
    scratch = rrt_kernel.make_scratch(space, path)
    points = _finer(path)
    lost = 0
    for _ in range(tries):
        n = len(points)
        if n < 3 or lost > MAX_FAILED_SHORTCUTS:
            break
        i = min(int(random(state) * (n - 2)), n - 3)
        k = min(i + 2 + int(random(state) * (n - i - 2)), n - 1)
        before = path_length(points[i : k + 1])
        if before <= distance(points[i], points[k]) * 1.0001:
            continue
        count = between(space, limits, points[i], points[k], SHORTCUT_GAIN * before, scratch)
        lost += 1
        if count > 0:
            shortcut = np.concatenate((points[i : i + 1], limits.out[:count]))
            points = np.concatenate((points[:i], _finer(shortcut), points[k + 1 :]))
            lost = 0
    points = _skipped(space, limits, points, scratch)
    for _ in range(rounds):
        points = _smoothed(space, limits, points, scratch)
    return _skipped(space, limits, points, scratch)


@inner_kernel()
def _finer(path):
    """The path with its pieces split until they are no longer than MAX_INITIAL_PIECE."""
    total = 1
    for i in range(len(path) - 1):
        total += max(1, int(np.ceil(distance(path[i], path[i + 1]) / MAX_INITIAL_PIECE)))
    out = np.empty((total, path.shape[1]))
    n = 0
    for i in range(len(path) - 1):
        parts = max(1, int(np.ceil(distance(path[i], path[i + 1]) / MAX_INITIAL_PIECE)))
        for part in range(parts):
            out[n] = path[i] + part / parts * (path[i + 1] - path[i])
            n += 1
    out[n] = path[-1]
    return out


@inner_kernel()
def _skipped(space, limits, path, scratch):
    """The path without waypoints that straight pieces can skip, in growing steps."""
    out = np.empty(path.shape)
    n = 0
    i = 0
    while True:
        out[n] = path[i]
        n += 1
        if i == len(path) - 1:
            return out[:n].copy()
        following = i + 1
        skip = 2
        while i + skip < len(path) and _usable(space, limits, path[i], path[i + skip], scratch):
            following = i + skip
            skip = skip + max(1, skip // 2)
        i = following


@inner_kernel()
def _smoothed(space, limits, path, scratch):
    """The path with the middles of its pieces as waypoints, and its corners moved towards them."""
    finer = np.empty((2 * len(path) - 1, path.shape[1]))
    dof = path.shape[1]
    for i in range(len(path)):
        finer[2 * i] = path[i]
        if i > 0:
            finer[2 * i - 1] = 0.5 * (path[i - 1] + path[i])
    trial = np.empty(dof)
    for i in range(2, len(finer) - 1, 2):
        for j in range(dof):
            trial[j] = 0.5 * finer[i, j] + 0.25 * (finer[i - 1, j] + finer[i + 1, j])
        if distance(trial, finer[i]) < MIN_CORNER_MOVE:
            continue
        if (
            project(limits.rows, limits.kept, trial, limits.work)
            and _usable(space, limits, finer[i - 1], trial, scratch)
            and _usable(space, limits, trial, finer[i + 1], scratch)
        ):
            finer[i] = trial
    return finer
