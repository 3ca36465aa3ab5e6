"""The compiled search for the earliest arrival among obstacles that move; see `moving.py`."""

import numpy as np
from jaxtyping import Bool, Int
from numba import njit
from numpy import ndarray

from robotdiffuse.core.deadline import check_timing

NEVER, WAITED = -2, -1
CELLS_AT_ONCE = 10_000_000
"""Cells of motions that are gone through between two looks at the clock."""


def earliest(
    clear: Bool[ndarray, "configurations ticks"],
    cell: Int[ndarray, "places"],
    source: Int[ndarray, "motions"],
    target: Int[ndarray, "motions"],
    first: Int[ndarray, "n"],
    cells: Int[ndarray, "k"],
) -> tuple[list[int], bool]:
    """How the last place is reached first, beginning at rest at the first place at tick 0: the motions in
    order, -1 for each tick that the arm waits; and whether there is a way.

    clear says which configurations are free when; cell[places] are those of the places; motion m goes from
    source[m] to target[m] by cells[first[m] : first[m + 1]], one for each tick. Raises OutOfTimeError where a
    deadline leaves no time for it.
    """
    came = np.full((clear.shape[1], len(cell)), NEVER)
    came[0, 0] = WAITED
    count = max(CELLS_AT_ONCE // len(cells), 1)
    for begin in range(0, len(came) - 1, count):
        check_timing("the grid of times")
        end = _reached(came, clear, cell, source, target, first, cells, begin, count)
        if end >= 0:
            return _way_to(end, came, source, first), True
    return [], False


@njit(cache=True, nogil=True)
def _reached(came, clear, cell, source, target, first, cells, begin, count):
    """Go on through so many ticks from `begin`, and note in came[ticks, places] how a place is reached at a
    tick: by which motion, or WAITED there. Returns the tick at which the last place is reached first; -1 if
    it is none of these."""
    places, ticks = len(cell), clear.shape[1]
    for now in range(begin, min(begin + count, ticks - 1)):
        if came[now, places - 1] != NEVER:
            return now
        for i in range(places):
            rests = came[now, i] != NEVER and clear[cell[i], now + 1]
            if rests and came[now + 1, i] == NEVER:
                came[now + 1, i] = WAITED
        for m in range(len(source)):
            there = now + first[m + 1] - first[m] - 1
            if came[now, source[m]] == NEVER or there >= ticks or came[there, target[m]] != NEVER:
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


@njit(cache=True)
def _way_to(end, came, source, first):
    """The motions by which the last place is reached at tick `end`, in order; -1 for each tick of waiting."""
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
