"""Splitting of triangles into small ones."""

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.core.kernels import kernel

Triangles = Float[ndarray, "_ 3 3"]


def split(triangles: Triangles, size: "float | Float[ndarray, 'n']", reach: float = np.inf) -> Triangles:
    """Halve triangles at their longest edge until no edge is longer than `size` [m], a number or one per
    triangle. A triangle is left out if its middle is farther from the origin than its longest edge plus
    `reach` [m]."""
    sizes = np.broadcast_to(np.asarray(size, np.float64), len(triangles))
    return _split(np.ascontiguousarray(triangles, np.float64), sizes**2, reach)


@kernel()
def _split(triangles, squares, reach):
    count = len(triangles)
    out = np.concatenate((triangles, np.empty_like(triangles)))
    limits = np.concatenate((squares, squares))
    t = 0
    while t < count:
        longest_square = -1.0
        k = 0
        middle_square = 0.0  # squared distance of the triangle's middle from the origin
        for i in range(3):
            square = 0.0
            middle_square += ((out[t, 0, i] + out[t, 1, i] + out[t, 2, i]) / 3) ** 2
            for d in range(3):
                square += (out[t, i, d] - out[t, (i + 1) % 3, d]) ** 2
            if square > longest_square:
                longest_square = square
                k = i
        if np.sqrt(middle_square) > reach + np.sqrt(longest_square):
            # beyond reach: the last triangle takes its place
            count -= 1
            out[t] = out[count]
            limits[t] = limits[count]
            continue
        if longest_square <= limits[t]:
            t += 1
            continue
        if count == len(out):
            out = np.concatenate((out, np.empty_like(out)))
            limits = np.concatenate((limits, limits))
        # one half in place of the triangle, the other one at the end
        out[count] = out[t]
        limits[count] = limits[t]
        for d in range(3):
            middle = 0.5 * (out[t, k, d] + out[t, (k + 1) % 3, d])
            out[t, (k + 1) % 3, d] = middle
            out[count, k, d] = middle
        count += 1
    return out[:count].copy()
