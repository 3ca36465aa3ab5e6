"""Compiled code for the speeds along a path: the motion is as fast as possible for a given time, then brakes
to rest. It begins at the arm's current place on the path, with its current speed.

The path is q(s); q' and q'' are its derivatives with respect to s. s̈ is constant in each interval of a grid
over s, and changes within an interval only where braking begins.
The limits of s̈ are evaluated at both ends of an interval, even if the motion covers only a part of it. So an
s̈ that is within the limits when the motion enters the interval is within them until the motion leaves it.
"""

import numpy as np

from robotdiffuse.core.kernels import kernel

MIN_INTERVAL = 1e-10
"""If a motion begins less than this before a grid point [rad], its first interval is the one after it."""
NEGLIGIBLE_DERIVATIVE = 1e-7
"""Factors of s̈ in q̈ below this count as zero; on straight lines these are q', whose norm is 1."""
STILL_SPEED_SQUARED = 1e-12
"""ṡ² below this counts as rest [rad²/s²]."""


@kernel()
def _acceleration_bounds(first_derivative, second_derivative, grid, i, s, x, greatest, acceleration):
    """Lower and upper bound of s̈ in grid interval i, for a motion that is at s with ṡ² = x. `greatest` is
    the greatest allowed ṡ² at the end of the interval."""
    low = -np.inf
    high = (greatest - x) / (2 * (grid[i + 1] - s))
    # At grid point k, ṡ² is x + 2 s̈ (grid[k] - s), so q̈ = q' s̈ + q'' ṡ² is a s̈ + q'' x.
    for k in range(i, i + 2):
        for j in range(first_derivative.shape[1]):
            a = first_derivative[k, j] + 2 * (grid[k] - s) * second_derivative[k, j]
            if abs(a) < NEGLIGIBLE_DERIVATIVE:
                continue
            limit = acceleration[j] / abs(a)
            middle = -second_derivative[k, j] * x / a
            low = max(low, middle - limit)
            high = min(high, middle + limit)
    return low, max(high, low)


@kernel()
def advance_then_brake(first_derivative, second_derivative, grid, greatest, s, speed, time, acceleration):
    """A motion that is as fast as possible for `time` [s] and then brakes to rest: an array of values of s,
    and an array of ṡ at each of them. Between two values, s̈ is constant.

    first_derivative, second_derivative: q' and q'' at the grid points, of shape (n, dof). grid: n values of
    s. greatest: the greatest ṡ² at each grid point from which the end can be reached within the limits. s,
    speed: s and ṡ at the beginning. acceleration: the limit of each joint [dof].
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
        low, high = _acceleration_bounds(
            first_derivative, second_derivative, grid, i, s, x, greatest[i + 1], acceleration
        )
        path_acceleration = high if time_left > 0 else low
        width = grid[i + 1] - s
        next_speed_squared = max(x + 2 * path_acceleration * width, 0.0)
        speed_sum = np.sqrt(x) + np.sqrt(next_speed_squared)
        duration = 2 * width / speed_sum if speed_sum > 0 else np.inf
        # The step ends inside the interval when the time for acceleration runs out (the next step brakes from
        # there) or when the motion comes to rest.
        if 0 < time_left < duration:
            travel = (np.sqrt(x) + 0.5 * path_acceleration * time_left) * time_left
            s = min(s + travel, grid[i + 1] - MIN_INTERVAL)
            x = max((np.sqrt(x) + path_acceleration * time_left) ** 2, 0.0)
            time_left = 0.0
        elif time_left <= 0 and x + 2 * path_acceleration * width < 0:
            s = s - x / (2 * path_acceleration)
            x = 0.0
        else:
            time_left -= duration
            i, s, x = i + 1, grid[i + 1], next_speed_squared
        count += 1
        out[0, count], out[1, count] = s, np.sqrt(x)
    out[1, count] = 0.0
    return out[0, : count + 1].copy(), out[1, : count + 1].copy()
