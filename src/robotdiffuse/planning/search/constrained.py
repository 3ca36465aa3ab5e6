"""Search under path constraints for `rrt.anytime`: RRT-Connect with projected nodes, and simplification.

The trees with projected steps are those of CBiRRT2: D. Berenson, S. Srinivasa and J. Kuffner, "Task Space
Regions: A framework for pose-constrained manipulation planning", IJRR 2011. Edges are proved, not sampled. A
straight piece is accepted if the constraints are proved to hold along it. Otherwise its middle is projected
onto the constraints, and both halves are handled in the same way.

The planners aorrtc, rrt_connect and robotdiffuse use this search for problems with path constraints. Its
tolerances are slightly smaller than the problem's, since rounded corners and rounded numbers deviate a
little. The validator proves the result for the problem's tolerances.
"""

from typing import NamedTuple

import numpy as np
from numba.extending import overload

from robotdiffuse.collision.kernels.motions import distance, make_scratch, motion_free, path_length
from robotdiffuse.collision.kernels.random import random
from robotdiffuse.core.kernels import inner_kernel, kernel
from robotdiffuse.planning.search import rrt_kernel
from robotdiffuse.problems.constraint_kernel import evaluate, make_work, proved
from robotdiffuse.problems.projection_kernel import project

MAX_DEPTH = 9
"""Largest size of the stack of `between`: the ends of pieces that it has yet to reach. Each halving adds
one."""
MIN_PIECE = 0.004
"""Pieces shorter than this are not halved [rad]."""
MAX_PIECES = 512
"""Largest number of straight pieces of an edge."""
MAX_GROWTH = 0.2
"""Along a straight piece, the value of a constraint row may exceed the larger of its values at the two ends
by this fraction of the row's tolerance."""
MIN_PROOF_PIECE = 1 / 16
"""Shortest part of a piece in a proof, as a fraction of the piece's length."""
MAX_DRIFT = 0.85
"""Largest distance of a projected middle from either end, as a fraction of the piece's length."""
MAX_REMAINING = 0.95
"""An extension must end closer to its target than this fraction of the distance from which it began. For
targets more than ten steps away, half a step closer is enough."""
MAX_STEP_FACTOR = 2.0
"""Largest ratio of the length of an edge to the length of the straight line that it replaces."""
SHORTCUT_GAIN = 0.99
"""A shortcut is accepted if its length is at most this fraction of the length that it replaces."""
MAX_FAILED_SHORTCUTS = 20
"""Shortcuts end when more than this many in a row were not accepted."""
MIN_CORNER_MOVE = 0.005
"""Smallest move of a corner by smoothing [rad, joint-space L2]."""
MAX_INITIAL_PIECE = 0.15
"""Pieces of a path are split down to this length before simplification [rad]."""


class Limits(NamedTuple):
    """The path constraints that every edge of the search keeps, and working memory."""

    rows: tuple
    """`problems.constraint_kernel.Rows`"""
    row_limits: np.ndarray
    """[rows] greatest values of the constraint rows, slightly smaller than the validator's limits."""
    work: tuple
    growing: np.ndarray
    """[rows] limits of the constraint rows for the piece that is being proved, see MAX_GROWTH."""
    stack: np.ndarray
    """[MAX_DEPTH, dof] ends of the pieces that `between` has yet to reach."""
    out: np.ndarray
    """[MAX_PIECES, dof] ends of the pieces of the motion that `between` found."""
    here: np.ndarray
    """[dof] the configuration that `between` has reached."""


@kernel()
def make_limits(rows, row_limits):
    dof = len(rows.lower)
    return Limits(
        rows,
        row_limits,
        make_work(rows),
        np.empty(len(row_limits)),
        np.empty((MAX_DEPTH, dof)),
        np.empty((MAX_PIECES, dof)),
        np.empty(dof),
    )


# the compiled functions in place of `rrt_kernel.keep` and `rrt_kernel.extended`
@overload(rrt_kernel.keep)
def _keep(limits, q):
    return lambda limits, q: project(limits.rows, limits.row_limits, q, limits.work)


@overload(rrt_kernel.extended)
def _extended(space, limits, trees, tree, near, q, longest, scratch):
    def extended(space, limits, trees, tree, near, q, longest, scratch):
        origin = trees.nodes[tree, near]
        end = scratch.a
        gap = distance(origin, q)
        if gap <= longest:
            end[:] = q
        else:
            # steer towards q by at most one step, then project onto the constraints (CBiRRT)
            end[:] = origin + longest / gap * (q - origin)
            if not project(limits.rows, limits.row_limits, end, limits.work):
                return -1
            # the projection may have undone most of the step
            if distance(end, q) > max(MAX_REMAINING * gap, gap - 0.5 * longest):
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
    that exceed those at its ends by at most MAX_GROWTH of the tolerance."""
    rows = limits.rows
    work = limits.work
    evaluate(rows, a, 0, work)
    evaluate(rows, b, 1, work)
    for m in range(len(limits.row_limits)):
        limit = max(work.values[0, m], work.values[1, m]) + MAX_GROWTH * rows.tolerance[m]
        limits.growing[m] = min(limits.row_limits[m], limit)
    return proved(rows, limits.growing, a, b, MIN_PROOF_PIECE, work)[1] < 0


@inner_kernel()
def _usable(space, limits, a, b, scratch):
    return _straight(limits, a, b) and motion_free(space, a, b, scratch)


@inner_kernel()
def between(space, limits, a, b, most, scratch):
    """Find a free motion in straight pieces that keep the constraints, between two configurations a and b;
    write the ends of the pieces to limits.out.

    Returns the number of pieces; 0 if no motion was found or if it is longer than `most` [rad].
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
            # the straight piece to the target keeps the constraints: take it
            if count == MAX_PIECES or not motion_free(space, current, target, scratch):
                return 0
            limits.out[count] = target
            current[:] = target
            top = top - 1
            count = count + 1
            length = length + gap
            continue
        if top == MAX_DEPTH or gap < MIN_PIECE:
            return 0
        # else split it in the middle, which is projected onto the constraints
        middle = stack[top]
        middle[:] = 0.5 * (current + target)
        if not project(limits.rows, limits.row_limits, middle, limits.work):
            return 0
        # a middle that is far from one of the ends is on another branch of the solutions
        if max(distance(current, middle), distance(middle, target)) > MAX_DRIFT * gap:
            return 0
        top += 1
    return count


@kernel(nogil=True)
def line(space, limits, a, b):
    """The waypoints [n, dof] of a motion from a to b by `between`; n = 0 if none was found."""
    count = between(space, limits, a, b, MAX_STEP_FACTOR * distance(a, b), make_scratch(space, a))
    path = np.concatenate((a.reshape(1, -1), limits.out[:count]))
    return path if count else path[:0]


@kernel(nogil=True)
def simplify(space, limits, path, rounds, tries, state):
    """A simpler path with the start and goal of `path`. First, up to `tries` shortcuts
    between random waypoints are tried, and waypoints that a straight piece can skip are removed. Then each of
    `rounds` rounds smooths the corners. At the end, waypoints that can be skipped are removed again."""
    scratch = make_scratch(space, path)
    points = _finer(path)
    failed = 0
    for _ in range(tries):
        n = len(points)
        if n < 3 or failed > MAX_FAILED_SHORTCUTS:
            break
        i = min(int(random(state) * (n - 2)), n - 3)
        k = min(i + 2 + int(random(state) * (n - i - 2)), n - 1)
        before = path_length(points[i : k + 1])
        if before <= distance(points[i], points[k]) * 1.0001:
            continue
        count = between(space, limits, points[i], points[k], SHORTCUT_GAIN * before, scratch)
        failed += 1
        if count > 0:
            shortcut = np.concatenate((points[i : i + 1], limits.out[:count]))
            points = np.concatenate((points[:i], _finer(shortcut), points[k + 1 :]))
            failed = 0
    points = _skipped(space, limits, points, scratch)
    for _ in range(rounds):
        points = _smoothed(space, limits, points, scratch)
    return _skipped(space, limits, points, scratch)


@inner_kernel()
def _finer(path):
    """The path with each piece split into equal parts that are at most MAX_INITIAL_PIECE long."""
    parts = np.ones(len(path) - 1, np.int64)
    for i in range(len(parts)):
        parts[i] = max(1, int(np.ceil(distance(path[i], path[i + 1]) / MAX_INITIAL_PIECE)))
    out = np.empty((parts.sum() + 1, path.shape[1]))
    n = 0
    for i in range(len(parts)):
        for part in range(parts[i]):
            out[n] = path[i] + part / parts[i] * (path[i + 1] - path[i])
            n += 1
    out[n] = path[-1]
    return out


@inner_kernel()
def _skipped(space, limits, path, scratch):
    """The path without waypoints that straight pieces can skip. From each waypoint, a piece to the second
    next waypoint is tried, then to waypoints further and further ahead, until one fails."""
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
    finer[::2] = path
    finer[1::2] = 0.5 * (path[:-1] + path[1:])
    for i in range(2, len(finer) - 1, 2):
        trial = 0.5 * finer[i] + 0.25 * (finer[i - 1] + finer[i + 1])
        if distance(trial, finer[i]) < MIN_CORNER_MOVE:
            continue
        if (
            project(limits.rows, limits.row_limits, trial, limits.work)
            and _usable(space, limits, finer[i - 1], trial, scratch)
            and _usable(space, limits, trial, finer[i + 1], scratch)
        ):
            finer[i] = trial
    return finer
