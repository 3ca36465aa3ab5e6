"""Propagates support functions on a grid of directions over a joint and its offset; see `motion_bounds.py`.

Sums have a fixed order and no fused operations, so the results equal those of NumPy.
"""

import numpy as np

from robotdiffuse.core.kernels import kernel


@kernel()
def sliding_maximum(support, first, width):
    """Largest value [n, rows, columns] among `width` longitudes, beginning `first` after each longitude."""
    n, rows, columns = support.shape
    out = np.empty_like(support)
    wide = np.empty(columns)
    next_wide = np.empty(columns)
    for i in range(n):
        for row in range(rows):
            for k in range(columns):
                wide[k] = support[i, row, (k + first) % columns]
            done = 1
            while done < width:  # maxima over 2 n neighbours from maxima over n
                shift = min(done, width - done)
                for k in range(columns - shift):
                    next_wide[k] = max(wide[k], wide[k + shift])
                for k in range(columns - shift, columns):
                    next_wide[k] = max(wide[k], wide[k + shift - columns])
                wide, next_wide = next_wide, wide
                done += shift
            for k in range(columns):  # assigning the array would compile Numba's messages on shapes
                out[i, row, k] = wide[k]
    return out


@kernel()
def interpolated(values, corners, weights, residual, reach):
    """Bounds [n, directions] in rotated directions: values interpolated from four grid corners each, with
    weights [4, directions], plus the residual times the distance `reach` [n] of the farthest point."""
    out = np.empty_like(values)
    for i in range(len(values)):
        for k in range(values.shape[1]):
            total = values[i, corners[0, k]] * weights[0, k]
            for c in range(1, 4):
                total += values[i, corners[c, k]] * weights[c, k]
            out[i, k] = total + residual[k] * reach[i]
    return out
