"""Support functions on a grid of directions, carried inwards over a joint and its offset; see lever_arms.py.

Sums are in a fixed order and nothing is contracted, so the numbers are those of NumPy.
"""

import numpy as np
from numba import njit


@njit(cache=True)
def turned(support, first, width):
    """[n, rows, columns] the largest value among `width` longitudes from `first` on, seen from each."""
    n, rows, columns = support.shape
    out, wide, next_wide = np.empty_like(support), np.empty(columns), np.empty(columns)
    for i in range(n):
        for row in range(rows):
            for k in range(columns):
                wide[k] = support[i, row, (k + first) % columns]
            done = 1
            while done < width:  # the maximum over 2 n neighbours from those over n
                shift = min(done, width - done)
                for k in range(columns - shift):
                    next_wide[k] = max(wide[k], wide[k + shift])
                for k in range(columns - shift, columns):
                    next_wide[k] = max(wide[k], wide[k + shift - columns])
                wide, next_wide = next_wide, wide
                done += shift
            out[i, row] = wide
    return out


@njit(cache=True)
def carried(values, corners, weights, residual, reach):
    """[n, directions] bounds in turned directions: sums of the values at the corners of the grid around each,
    by their weights [4, directions], and what these leave over of points that are `reach` away."""
    out = np.empty_like(values)
    for i in range(len(values)):
        for k in range(values.shape[1]):
            total = values[i, corners[0, k]] * weights[0, k]
            for c in range(1, 4):
                total += values[i, corners[c, k]] * weights[c, k]
            out[i, k] = total + residual[k] * reach[i]
    return out
