"""The compiled search for the earliest arrival among obstacles that move; see `moving.py`."""

import numpy as np
from numba import njit

NEVER, WAITED = -2, -1


@njit(cache=True, nogil=True)
def earliest(clear, cell, source, target, first, cells):
    """How the last place is reached first, beginning at rest at the first place at tick 0.

    clear[configurations, ticks] says which configurations are free when; cell[places] are those of the
    places; motion m goes from source[m] to target[m] by cells[first[m] : first[m + 1]], one for each tick.
    Returns the motions in order, -1 for each tick that the arm waits; and whether there is a way.
    """
    places, ticks = len(cell), clear.shape[1]
    came = np.full((ticks, places), NEVER)
    came[0, 0] = WAITED
    end = -1
    for now in range(ticks - 1):
        if came[now, places - 1] != NEVER:
            end = now
            break
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
    way = [0 for _ in range(0)]
    if end < 0:
        return way, False
    place = places - 1
    while end > 0:
        m = came[end, place]
        way.append(m)
        if m == WAITED:
            end -= 1
        else:
            end -= first[m + 1] - first[m] - 1
            place = source[m]
    return way[::-1], True
