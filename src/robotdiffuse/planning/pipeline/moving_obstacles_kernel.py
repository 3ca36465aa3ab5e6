"""The compiled search for the earliest arrival among moving obstacles; see `moving_obstacles.py`."""

import numpy as np
from jaxtyping import Bool, Int
from numpy import ndarray

from robotdiffuse.core.deadline import check_timing
from robotdiffuse.core.kernels import kernel

UNREACHED, WAITED = -2, -1
CELLS_PER_CLOCK_CHECK = 10_000_000
"""Cells of motions that are visited between two readings of the clock."""


def earliest(
    clear: Bool[ndarray, "configurations ticks"],
    cell: Int[ndarray, "places"],
    source: Int[ndarray, "motions"],
    target: Int[ndarray, "motions"],
    first: Int[ndarray, "n"],
    cells: Int[ndarray, "k"],
) -> tuple[list[int], bool]:
    """The earliest schedule from rest at the first place, at tick 0, to the last place.

    clear: which configurations are free at which tick.
    cell: the configuration of each place.
    source, target: the places that each motion connects.
    first, cells: motion m passes the configurations cells[first[m] : first[m + 1]], one per tick.

    Returns the numbers of the motions in order, with -1 for each tick of waiting, and whether the last place
    can be reached. Raises OutOfTimeError if a deadline leaves no time.
    """
    came = np.full((clear.shape[1], len(cell)), UNREACHED)
    came[0, 0] = WAITED
    count = max(CELLS_PER_CLOCK_CHECK // len(cells), 1)
    for begin in range(0, len(came) - 1, count):
        check_timing("the grid of times")
        end = _reached(came, clear, cell, source, target, first, cells, begin, count)
        if end >= 0:
            return _way_to(end, came, source, first), True
    return [], False


@kernel(nogil=True)
def _reached(came, clear, cell, source, target, first, cells, begin, count):
    """Go through `count` ticks from `begin`, and write to came[ticks, places] by which motion a place is
    reached at a tick, or WAITED. Returns the tick at which the last place is first reached; -1 if it is none
    of these."""
    places, ticks = len(cell), clear.shape[1]
    for now in range(begin, min(begin + count, ticks - 1)):
        if came[now, places - 1] != UNREACHED:
            return now
        for i in range(places):
            rests = came[now, i] != UNREACHED and clear[cell[i], now + 1]
            if rests and came[now + 1, i] == UNREACHED:
                came[now + 1, i] = WAITED
        for m in range(len(source)):
            there = now + first[m + 1] - first[m] - 1
            if came[now, source[m]] == UNREACHED or there >= ticks or came[there, target[m]] != UNREACHED:
                continue
            free = True
            for k in range(first[m + 1] - first[m] - 1):
                a, b = cells[first[m] + k], cells[first[m] + k + 1]
                if not (clear[a, now + k + 1] and clear[b, now + k] and clear[b, now + k + 1]):
                    free = False
                    break
            if free:
                came[there, target[m]] = m
    return -1


@kernel()
def _way_to(end, came, source, first):
    """The numbers of the motions that reach the last place at tick `end`, in order; -1 for each tick of
    waiting."""
    way = [0 for _ in range(0)]
    place = came.shape[1] - 1
    while end > 0:
        m = came[end, place]
        way.append(m)
        if m == WAITED:
            end -= 1
        else:
            end -= first[m + 1] - first[m] - 1
            place = source[m]
    return way[::-1]
