"""Numba kernel of `depth_filter`: the median of neighbouring pixels."""

import numpy as np

from robotdiffuse.core.kernels import kernel

MIN_RETURNS = 4
"""A pixel with fewer returns among its 3 x 3 counts as without a return."""


@kernel(nogil=True)
def median_filter(depth):
    """Each pixel with a return as the median of the returns of its 3 x 3 pixels, the nearer one of two; 0
    elsewhere."""
    h, w = depth.shape
    out = np.zeros((h, w), np.float32)
    some = np.empty(9, np.float32)
    for v in range(h):
        for u in range(w):
            if not depth[v, u] > 0:
                continue
            count = 0
            for row in range(max(v - 1, 0), min(v + 2, h)):
                for column in range(max(u - 1, 0), min(u + 2, w)):
                    d = depth[row, column]
                    if not d > 0:
                        continue
                    at = count
                    while at > 0 and some[at - 1] > d:
                        some[at] = some[at - 1]
                        at -= 1
                    some[at] = d
                    count += 1
            if count >= MIN_RETURNS:
                out[v, u] = some[(count - 1) // 2]
    return out
