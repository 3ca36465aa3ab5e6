"""Compiled speeds along a path from where the arm is on it: on towards the end for a while, then to rest.

In each interval of the grid s̈ is constant, and limits hold at both its ends, whichever part of it is gone
through. So what was possible in an interval stays possible on the way through it.
"""

import numpy as np
from numba import njit

from robotdiffuse.trajectories.timing_kernel import TINY

SHORTEST = 1e-10
"""Parts of intervals that are left out."""
STILL = 1e-12
"""Squared speeds below this are none."""


@njit(cache=True)
def _pulls(one, two, grid, i, s, x, most, acceleration):
    """The least and greatest s̈ in interval i from s on, where ṡ² is x, such that it is at most `most` at its
    end."""
    low, high = -np.inf, (most - x) / (2 * (grid[i + 1] - s))
    for k in range(i, i + 2):
        for j in range(one.shape[1]):
            a = one[k, j] + 2 * (grid[k] - s) * two[k, j]
            if abs(a) < TINY:
                continue
            limit, middle = acceleration[j] / abs(a), -two[k, j] * x / a
            low, high = max(low, middle - limit), min(high, middle + limit)
    return low, max(high, low)


@njit(cache=True)
def on_then_rest(one, two, grid, most, s, speed, time, acceleration):
    """Values of s and speeds: as fast as possible towards the end for some time, then braking to rest.

    one, two: the path's derivatives at the grid; `most` the greatest ṡ² there from which the end can be
    reached within the limits.
    """
    n = len(grid)
    out = np.empty((2, n + 2))
    i = max(np.searchsorted(grid, s + SHORTEST, side="right") - 1, 0)
    if i >= n - 1:
        return np.array([s, s]), np.zeros(2)
    x, left, count = speed * speed, time, 0
    out[0, 0], out[1, 0] = s, speed
    while i < n - 1 and (x >= STILL or left > 0):
        low, high = _pulls(one, two, grid, i, s, x, most[i + 1], acceleration)
        pull, width = high if left > 0 else low, grid[i + 1] - s
        beyond = max(x + 2 * pull * width, 0.0)
        both = np.sqrt(x) + np.sqrt(beyond)
        lasts = 2 * width / both if both > 0 else np.inf
        if 0 < left < lasts:
            s = min(s + (np.sqrt(x) + 0.5 * pull * left) * left, grid[i + 1] - SHORTEST)
            x = max((np.sqrt(x) + pull * left) ** 2, 0.0)
            left = 0.0
        elif left <= 0 and x + 2 * pull * width < 0:
            s, x = s - x / (2 * pull), 0.0
        else:
            left -= lasts
            i, s, x = i + 1, grid[i + 1], beyond
        count += 1
        out[0, count], out[1, count] = s, np.sqrt(x)
    out[1, count] = 0.0
    return out[0, : count + 1].copy(), out[1, : count + 1].copy()


@njit(cache=True)
def after(ahead, speeds, time):
    """s and speed some time after the beginning; at rest at the end thereafter."""
    left = time
    for i in range(len(ahead) - 1):
        width, both = ahead[i + 1] - ahead[i], speeds[i] + speeds[i + 1]
        if both <= 0:
            return ahead[i], 0.0
        lasts = 2 * width / both
        if left < lasts:
            pull = (speeds[i + 1] - speeds[i]) / lasts
            return ahead[i] + (speeds[i] + 0.5 * pull * left) * left, speeds[i] + pull * left
        left -= lasts
    return ahead[-1], 0.0
