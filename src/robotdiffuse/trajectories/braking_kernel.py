"""Compiled speeds along a path from the arm's place on it: towards the end for a while, then to rest.

s̈ is constant in each grid interval, and limits hold at both ends of the interval, also where the motion
covers only a part of it. So an acceleration that was possible at the beginning of an interval stays possible
in it.
"""

import numpy as np

from robotdiffuse.core.kernels import kernel
from robotdiffuse.trajectories.timing_kernel import NEGLIGIBLE_DERIVATIVE

MIN_INTERVAL = 1e-10
"""Shorter parts of grid intervals are skipped."""
STILL_SPEED_SQUARED = 1e-12
"""A squared speed below this counts as rest."""


@kernel()
def _acceleration_bounds(one, two, grid, i, s, x, most, acceleration):
    """Bounds of s̈ in interval i from s on, where ṡ² is x, such that ṡ² is at most `most` at the interval's
    end."""
    low = -np.inf
    high = (most - x) / (2 * (grid[i + 1] - s))
    for k in range(i, i + 2):
        for j in range(one.shape[1]):
            a = one[k, j] + 2 * (grid[k] - s) * two[k, j]
            if abs(a) < NEGLIGIBLE_DERIVATIVE:
                continue
            limit = acceleration[j] / abs(a)
            middle = -two[k, j] * x / a
            low = max(low, middle - limit)
            high = min(high, middle + limit)
    return low, max(high, low)


@kernel()
def advance_then_brake(one, two, grid, most, s, speed, time, acceleration):
    """Values of s and speeds [n each] of a motion as fast as possible for some time [s], then braking to
    rest.

    one, two: first and second derivative of the path at the grid, [m, dof]; `most` [m]: the greatest ṡ² from
    which the end can be reached within the limits; s, speed: where the motion begins; acceleration [dof].
    """
    n = len(grid)
    out = np.empty((2, n + 2))
    i = max(np.searchsorted(grid, s + MIN_INTERVAL, side="right") - 1, 0)
    if i >= n - 1:
        return np.array([s, s]), np.zeros(2)
    x = speed * speed
    time_left = time
    count = 0
    out[0, 0] = s
    out[1, 0] = speed
    while i < n - 1 and (x >= STILL_SPEED_SQUARED or time_left > 0):
        low, high = _acceleration_bounds(one, two, grid, i, s, x, most[i + 1], acceleration)
        pull = high if time_left > 0 else low
        width = grid[i + 1] - s
        beyond = max(x + 2 * pull * width, 0.0)
        both = np.sqrt(x) + np.sqrt(beyond)
        lasts = 2 * width / both if both > 0 else np.inf
        if 0 < time_left < lasts:
            s = min(s + (np.sqrt(x) + 0.5 * pull * time_left) * time_left, grid[i + 1] - MIN_INTERVAL)
            x = max((np.sqrt(x) + pull * time_left) ** 2, 0.0)
            time_left = 0.0
        elif time_left <= 0 and x + 2 * pull * width < 0:
            s = s - x / (2 * pull)
            x = 0.0
        else:
            time_left -= lasts
            i, s, x = i + 1, grid[i + 1], beyond
        count += 1
        out[0, count], out[1, count] = s, np.sqrt(x)
    out[1, count] = 0.0
    return out[0, : count + 1].copy(), out[1, : count + 1].copy()


@kernel()
def state_after(ahead, speeds, time):
    """s and speed some time [s] after the beginning; at rest at the end once the motion is over."""
    time_left = time
    for i in range(len(ahead) - 1):
        width = ahead[i + 1] - ahead[i]
        both = speeds[i] + speeds[i + 1]
        if both <= 0:
            return ahead[i], 0.0
        lasts = 2 * width / both
        if time_left < lasts:
            pull = (speeds[i + 1] - speeds[i]) / lasts
            return ahead[i] + (speeds[i] + 0.5 * pull * time_left) * time_left, speeds[i] + pull * time_left
        time_left -= lasts
    return ahead[-1], 0.0
