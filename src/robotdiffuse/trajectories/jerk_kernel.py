"""Compiled moving averages of timed motions, which limit their jerk.

A motion q(t) from rest to rest is replaced by its mean over the last T seconds, which ends T later.
Velocities and accelerations are averaged too, so they keep their limits. The jerk (a(t) - a(t - T)) / T is at
most 2 a_max / T, also as a difference quotient over any time. On a straight line the mean stays on the line.
"""

import numpy as np
from numba import njit


@njit(cache=True)
def moving_average(positions, velocities, accelerations, step, window, every):
    """Times [n], positions, velocities and accelerations [n, dof] of the moving average over `window` steps.

    The arguments are the rows of a motion from rest to rest, `step` [s] apart. Returned are every `every`-th
    row and the last.
    """
    rows, dof = positions.shape
    last = rows - 1 + window
    # integrals of the positions relative to the first one (Hermite's formula)
    area = np.zeros((rows, dof))
    for i in range(1, rows):
        for j in range(dof):
            mean = 0.5 * (positions[i - 1, j] + positions[i, j]) - positions[0, j]
            bend = (velocities[i - 1, j] - velocities[i, j]) * step / 12
            area[i, j] = area[i - 1, j] + (mean + bend) * step
    count = max(1, int(np.ceil(last / every - 0.1)))
    times, q = np.empty(count + 1), np.empty((count + 1, dof))
    v, a = np.zeros((count + 1, dof)), np.zeros((count + 1, dof))
    for k in range(count + 1):
        at = k * every if k < count else last
        times[k] = at * step
        now, before = min(at, rows - 1), min(max(at - window, 0), rows - 1)
        for j in range(dof):
            # after its end the motion stands still
            beyond = (at - now) * (positions[rows - 1, j] - positions[0, j]) * step
            total = area[now, j] + beyond - area[before, j]
            q[k, j] = positions[0, j] + total / (window * step)
            v[k, j] = (positions[now, j] - positions[before, j]) / (window * step)
            a[k, j] = (velocities[now, j] - velocities[before, j]) / (window * step)
    q[0], q[count] = positions[0], positions[rows - 1]
    v[0] = v[count] = 0.0
    return times, q, v, a
