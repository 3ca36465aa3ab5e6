"""Motions through waypoints, and the pieces into which the motion certificate cuts them."""

from typing import NamedTuple

import numpy as np

from robotdiffuse.core.kernels import inner_kernel, kernel

STRAIGHT_COSINE = 0.995
"""Initial pieces end at waypoints where the cosine of the change of direction is below this."""


class Motion(NamedTuple):
    """Straight lines through waypoints."""

    q: np.ndarray
    """[n, dof]"""
    travel: np.ndarray
    """[n] upper bound on how far any point of the arm has moved up to each waypoint [m]. A place on the
    motion is given as a value of this bound."""


class Pieces(NamedTuple):
    """Pieces of a motion in order."""

    start: np.ndarray
    """[n] place where each piece begins, as a value of `Motion.travel` [m]."""
    stop: np.ndarray
    """[n] place where each piece ends [m]."""
    undecided: np.ndarray
    """[n, checks] whether the check of the piece is still undecided."""


@kernel()
def travel_along(q, motion_radii):
    """`Motion.travel` [n] of the waypoints q[n, dof]: the sum over segments of the largest motion bound of
    any check. `motion_radii` [checks, dof] are bounds per unit of joint motion."""
    travel = np.zeros(len(q))
    for i in range(1, len(q)):
        link_travel = 0.0
        for c in range(len(motion_radii)):
            total = 0.0
            for j in range(q.shape[1]):
                total += motion_radii[c, j] * abs(q[i, j] - q[i - 1, j])
            link_travel = max(link_travel, total)
        travel[i] = travel[i - 1] + link_travel
    return travel


@kernel()
def segment_at(travel, at):
    """The waypoint at which the segment that contains a place begins, and the fraction of this segment up to
    the place. The end of the motion belongs to the last segment."""
    low = min(max(np.searchsorted(travel, at, side="right") - 1, 0), max(len(travel) - 2, 0))
    if low + 1 >= len(travel) or travel[low + 1] <= travel[low]:
        return low, 0.0
    return low, min(max((at - travel[low]) / (travel[low + 1] - travel[low]), 0.0), 1.0)


@inner_kernel()
def configuration(motion, at, out):
    """Writes the configuration at a place to out[dof]."""
    low, share = segment_at(motion.travel, at)
    high = min(low + 1, len(motion.travel) - 1)
    for j in range(len(out)):
        out[j] = motion.q[low, j] + share * (motion.q[high, j] - motion.q[low, j])


@kernel()
def configurations(motion, places):
    """Configurations [m, dof] at places."""
    out = np.empty((len(places), motion.q.shape[1]))
    for i in range(len(places)):
        configuration(motion, places[i], out[i])
    return out


@inner_kernel()
def _cut(ends, start, stop, travel):
    """Divides start to stop into equal parts of at most `travel` [m] and appends the end of each to
    `ends`."""
    count = max(int(np.ceil((stop - start) / travel)), 1)
    for k in range(1, count):
        ends.append(start + (stop - start) * (k / count))
    ends.append(stop)


@kernel()
def first_pieces(motion, checks, travel):
    """The initial pieces: one of length zero at the start, then pieces with a motion bound of at most
    `travel` [m]. A piece also ends where the direction changes by more than STRAIGHT_COSINE allows."""
    q, traveled = motion
    n, dof = q.shape
    ends = [0.0]
    last = 0.0
    before = -1
    for i in range(1, n):
        if traveled[i] <= traveled[i - 1]:
            continue
        # cosine of the angle between this segment and the previous one
        dot = 1.0
        a = 1.0
        b = 1.0
        if before >= 0:
            dot = 0.0
            a = 0.0
            b = 0.0
            for j in range(dof):
                u = q[before + 1, j] - q[before, j]
                v = q[i, j] - q[i - 1, j]
                dot = dot + u * v
                a = a + u * u
                b = b + v * v
        if dot < STRAIGHT_COSINE * np.sqrt(a * b):
            _cut(ends, last, traveled[i - 1], travel)
            last = traveled[i - 1]
        before = i - 1
    if traveled[n - 1] > last:
        _cut(ends, last, traveled[n - 1], travel)
    start = np.empty(len(ends))
    stop = np.empty(len(ends))
    for k in range(len(ends)):
        start[k] = ends[max(k - 1, 0)]
        stop[k] = ends[k]
    return Pieces(start, stop, np.ones((len(ends), len(checks.kind)), np.bool_))


@inner_kernel()
def split(pieces, parts, total):
    """Divides piece i into parts[i] equal parts; a piece with 0 parts is dropped. `total` is the sum of
    parts."""
    start = np.empty(total)
    stop = np.empty(total)
    undecided = np.empty((total, pieces.undecided.shape[1]), np.bool_)
    at = 0
    for row in range(len(parts)):
        begin = pieces.start[row]
        end = pieces.stop[row]
        count = parts[row]
        for k in range(count):
            start[at] = begin + (end - begin) * (k / count)
            stop[at] = end if k + 1 == count else begin + (end - begin) * ((k + 1) / count)
            undecided[at] = pieces.undecided[row]
            at += 1
    return Pieces(start, stop, undecided)
