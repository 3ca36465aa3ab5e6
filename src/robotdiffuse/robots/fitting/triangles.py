"""Splitting of triangles into small ones."""

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.core.kernels import kernel

Triangles = Float[ndarray, "_ 3 3"]


def split(triangles: Triangles, size: "float | Float[ndarray, 'n']", reach: float = np.inf) -> Triangles:
    """Cut triangles in two at their longest edge until no edge is longer than `size` [m], a number or one per
    triangle. The cut is in the middle of the edge. In a narrow triangle it is placed so that the piece
    beside the shortest edge needs no further cut: with halving alone, the number of pieces of a needle grows
    with its length to the power of 1.6. A triangle is left out if its middle is farther from the origin than
    its longest edge plus `reach` [m]."""
    sizes = np.broadcast_to(np.asarray(size, np.float64), len(triangles))
    return _split(np.ascontiguousarray(triangles, np.float64), sizes**2, reach)


@kernel()
def _split(triangles, squares, reach):
    count = len(triangles)
    out = np.concatenate((triangles, np.empty_like(triangles)))
    limits = np.concatenate((squares, squares))  # squared greatest edge lengths, one for each triangle
    edges = np.empty(3)  # squared lengths of the edges from each corner to the next
    t = 0
    while t < count:
        middle_square = 0.0  # squared distance of the triangle's middle from the origin
        for i in range(3):
            square = 0.0
            middle_square += ((out[t, 0, i] + out[t, 1, i] + out[t, 2, i]) / 3) ** 2
            for d in range(3):
                square += (out[t, i, d] - out[t, (i + 1) % 3, d]) ** 2
            edges[i] = square
        k = np.argmax(edges)
        longest_square = edges[k]
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
        # where to cut the longest edge, as a fraction of it from its end beside the shortest edge
        after = edges[(k + 1) % 3]
        before = edges[(k + 2) % 3]
        shortest_square = min(after, before)
        longest = np.sqrt(longest_square)
        # Each of two distances from that end keeps the new edge within the limit: the projection of the
        # shortest edge (the new edge is perpendicular), and the limit minus the shortest edge (triangle
        # inequality).
        projection = (shortest_square + longest_square - max(after, before)) / (2 * longest)
        at = max(projection, np.sqrt(limits[t]) - np.sqrt(shortest_square)) / longest
        # in the middle instead if the shortest edge needs cuts too, or if the cut would be nearer to that end
        # than half the limit
        if shortest_square > limits[t] or 4 * at * at * longest_square < limits[t]:
            at = 0.5
        at = min(at, 0.5) if before < after else 1 - min(at, 0.5)
        # one piece in place of the triangle, the other one at the end
        out[count] = out[t]
        limits[count] = limits[t]
        for d in range(3):
            cut = (1 - at) * out[t, k, d] + at * out[t, (k + 1) % 3, d]
            out[t, (k + 1) % 3, d] = cut
            out[count, k, d] = cut
        count += 1
    return out[:count].copy()
