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
    """[n] bound on the motion of any point of the arm up to each waypoint [m]. Places on the motion are
    values of it."""


class Pieces(NamedTuple):
    """Pieces of a motion in order."""

    start: np.ndarray
    """[n] place where each begins."""
    stop: np.ndarray
    undecided: np.ndarray
    """[n, checks] whether the check is still open."""


@kernel()
def travel_along(q, motion_radii):
    """`Motion.travel` [n] of the waypoints q[n, dof]: each step counts the link that moves most."""
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
    """The last waypoint that is not beyond a place, and the share of the segment from there to the next."""
    low = min(max(np.searchsorted(travel, at, side="right") - 1, 0), max(len(travel) - 2, 0))
    if low + 1 >= len(travel) or travel[low + 1] <= travel[low]:
        return low, 0.0
    return low, min((at - travel[low]) / (travel[low + 1] - travel[low]), 1.0)


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
    """Appends the ends of the equal parts, about `travel` long, of a stretch."""
    count = max(int(np.ceil((stop - start) / travel)), 1)
    for k in range(1, count):
        ends.append(start + (stop - start) * (k / count))
    ends.append(stop)


@kernel()
def first_pieces(motion, checks, travel):
    """The initial pieces: one of length zero at the start, then pieces with a motion bound of about `travel`
    [m] that change their direction little."""
    q, travelled = motion
    n, dof = q.shape
    ends = [0.0]
    last = 0.0
    before = -1
    for i in range(1, n):
        if travelled[i] <= travelled[i - 1]:
            continue
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
            _cut(ends, last, travelled[i - 1], travel)
            last = travelled[i - 1]
        before = i - 1
    if travelled[n - 1] > last:
        _cut(ends, last, travelled[n - 1], travel)
    start = np.empty(len(ends))
    stop = np.empty(len(ends))
    for k in range(len(ends)):
        start[k] = ends[max(k - 1, 0)]
        stop[k] = ends[k]
    return Pieces(start, stop, np.ones((len(ends), len(checks.kind)), np.bool_))


@inner_kernel()
def split(pieces, parts, total):
    """Every piece in parts[n] equal parts, `total` altogether; 0 drops a piece."""
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
