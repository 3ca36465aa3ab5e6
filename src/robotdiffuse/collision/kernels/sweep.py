"""The compiled part of the judge's certificate: what covering spheres can say of a motion; see `motion.py`.

A check is a link against the scene, or a pair of links. A piece of a motion is settled for a check when its
clearance in the middle exceeds what the link can move from there to both ends, and with a margin: by
`tightness` of the least clearance measured of its kind.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from robotdiffuse.collision.kernels.lane_clearance import (
    count_obstacles,
    group_clearance,
    make_clearance_workspace,
    pair_clearance,
)
from robotdiffuse.collision.kernels.lanes import W, place_frames

CAP = 1.0
"""Clearances are not looked for beyond this [m]."""
FLOAT32_SLACK = 1e-5
"""What rounding may add to the clearances of the compiled kernel [m]."""
MESH_BELOW = 0.002
"""Sphere clearance [m] below which the meshes are asked rather than the piece split further: one distance of
meshes costs about as much as ten configurations of spheres, and the spheres stick out by about 1 cm."""
MOST_PIECES = 4
"""A piece is split into at most this many at a time."""
SCENE, PAIR = 0, 1


class Motion(NamedTuple):
    """Waypoints, and how far each check's link can have moved up to them."""

    q: np.ndarray
    """[n, dof]"""
    travelled: np.ndarray
    """[n, checks] motion bounds from the first waypoint [m]."""


class Checks(NamedTuple):
    """What is checked, those against the scene first."""

    where: np.ndarray
    """[checks] the group of spheres, or the pair of groups; -1 where the spheres do not know it."""
    kind: np.ndarray
    """[checks] SCENE or PAIR."""


class Pieces(NamedTuple):
    """Pieces of a motion in order, in waypoint index plus fraction."""

    start: np.ndarray
    stop: np.ndarray
    undecided: np.ndarray
    """[n, checks]"""


class Round(NamedTuple):
    """Pieces that the spheres leave open, with what they say of each check in the middles."""

    pieces: Pieces
    clearance: np.ndarray
    """[n, checks] lower bounds [m]; infinite where settled."""
    bound: np.ndarray
    """[n, checks] how far the link can move from the middle to an end [m]."""


@njit(cache=True)
def _at(rows, at, out):
    """Interpolates rows[n, k] at an index plus fraction."""
    low = min(int(at), len(rows) - 1)
    high = min(low + 1, len(rows) - 1)
    share = at - low
    for j in range(rows.shape[1]):
        out[j] = rows[low, j] + share * (rows[high, j] - rows[low, j])


@njit(cache=True)
def first_pieces(motion, travel):
    """Pieces whose motion bounds are about `travel` [m], after one of no length at the start."""
    n, checks = motion.travelled.shape
    worst = np.empty(n)
    for i in range(n):
        worst[i] = motion.travelled[i].max() if checks else 0.0
    count = max(1, int(np.ceil(worst[n - 1] / travel)))
    start, stop = np.zeros(count + 1), np.zeros(count + 1)
    i = 0
    for k in range(1, count):
        wanted = worst[n - 1] * k / count
        while i < n - 2 and worst[i + 1] <= wanted:
            i += 1
        at = i + min(max((wanted - worst[i]) / max(worst[i + 1] - worst[i], 1e-12), 0.0), 1.0)
        stop[k] = start[k + 1] = at
    stop[count] = n - 1
    return Pieces(start, stop, np.ones((count + 1, checks), np.bool_))


@njit(cache=True)
def _measure(robot, scene, motion, checks, pieces, best, work):
    """Clearances in the middles of the pieces by spheres, and motion bounds; lowers best[2]."""
    n, count = pieces.undecided.shape
    dof = motion.q.shape[1]
    clearance, bound = np.full((n, count), np.inf), np.empty((n, count))
    block, found = np.empty((dof, W), np.float32), np.empty((1, W), np.float32)
    q, before, here, after = np.empty(dof), np.empty(count), np.empty(count), np.empty(count)
    for first in range(0, n, W):
        last = min(first + W, n)
        for i in range(W):
            row = min(first + i, n - 1)
            _at(motion.q, 0.5 * (pieces.start[row] + pieces.stop[row]), q)
            for j in range(dof):
                block[j, i] = q[j]
        for row in range(first, last):
            _at(motion.travelled, pieces.start[row], before)
            _at(motion.travelled, 0.5 * (pieces.start[row] + pieces.stop[row]), here)
            _at(motion.travelled, pieces.stop[row], after)
            for c in range(count):
                bound[row, c] = max(here[c] - before[c], after[c] - here[c])
        place_frames(robot, block, work.frames, work.centres)
        work.placed[:] = False
        for c in range(count):
            open_ones, furthest = 0, 0.0
            for row in range(first, last):
                if pieces.undecided[row, c]:
                    open_ones += 1
                    furthest = max(furthest, bound[row, c])
            if open_ones == 0:
                continue
            kind = checks.kind[c]
            if checks.where[c] < 0:
                for row in range(first, last):
                    if pieces.undecided[row, c]:
                        clearance[row, c] = -np.inf
                continue
            limit = np.float32(min(furthest + best[kind] + FLOAT32_SLACK, CAP))
            if kind == SCENE:
                group_clearance(robot, scene, checks.where[c], limit, work, found)
            else:
                pair_clearance(robot, checks.where[c], limit, work, found)
            for row in range(first, last):
                if pieces.undecided[row, c]:
                    clearance[row, c] = found[0, row - first] - FLOAT32_SLACK
                    if clearance[row, c] > MESH_BELOW:
                        best[kind] = min(best[kind], clearance[row, c])
    return Round(pieces, clearance, bound)


@njit(cache=True)
def settle(checks, found, best, certified, tightness):
    """Settle what the clearances of a round allow and split the rest; lowers certified[2]."""
    pieces, clearance, bound = found
    n, count = clearance.shape
    parts, total = np.zeros(n, np.int64), 0
    for row in range(n):
        need, open_ones = 0.0, 0
        for c in range(count):
            if not pieces.undecided[row, c]:
                continue
            kind = checks.kind[c]
            least = tightness * best[kind]
            lower = clearance[row, c] - bound[row, c]
            if lower >= least:
                pieces.undecided[row, c] = False
                certified[kind] = min(certified[kind], lower)
            else:
                open_ones += 1
                need = max(need, bound[row, c] / max(clearance[row, c] - least, 1e-9))
        if open_ones:
            parts[row] = min(max(int(np.ceil(min(need, 1e6))), 2), MOST_PIECES)
            total += parts[row]
    return split(pieces, parts, total)


@njit(cache=True)
def split(pieces, parts, total):
    """Every piece in so many equal parts, `total` altogether; 0 drops it."""
    start, stop = np.empty(total), np.empty(total)
    undecided = np.empty((total, pieces.undecided.shape[1]), np.bool_)
    at = 0
    for row in range(len(parts)):
        width = pieces.stop[row] - pieces.start[row]
        for k in range(parts[row]):
            start[at] = pieces.start[row] + width * (k / parts[row])
            stop[at] = pieces.start[row] + width * ((k + 1) / parts[row])
            undecided[at] = pieces.undecided[row]
            at += 1
    return Pieces(start, stop, undecided)


@njit(cache=True, nogil=True)
def rounds(robot, scene, motion, checks, pieces, best, certified, tightness):
    """Rounds of measuring, settling and splitting until a check needs the meshes, or nothing is left.

    best[2] and certified[2], by kind, are lowered. Returns the last round, not settled, and which of its
    checks
    the meshes are to be asked about: rows and columns, in order of the motion.
    """
    work = make_clearance_workspace(robot, count_obstacles(scene))
    while True:
        found = _measure(robot, scene, motion, checks, pieces, best, work)
        n, count = found.clearance.shape
        asked = 0
        for row in range(n):
            for c in range(count):
                asked += _is_asked(found, checks, best, tightness, row, c)
        if n == 0 or asked:
            rows, columns, k = np.empty(asked, np.int64), np.empty(asked, np.int64), 0
            for row in range(n):
                for c in range(count):
                    if _is_asked(found, checks, best, tightness, row, c):
                        rows[k], columns[k] = row, c
                        k += 1
            return found, rows, columns
        pieces = settle(checks, found, best, certified, tightness)


@njit(cache=True)
def _is_asked(found, checks, best, tightness, row, c):
    clearance = found.clearance[row, c]
    return (
        found.pieces.undecided[row, c]
        and clearance <= MESH_BELOW
        and clearance - found.bound[row, c] < tightness * best[checks.kind[c]]
    )
