"""Compiled grouping of point clouds for PointNet++: furthest point sampling and ball query in one pass.

Both are of C. Qi et al., "PointNet++", NeurIPS 2017, and need the distances from a new centre to all points,
which are computed once.
"""

import numpy as np

from robotdiffuse.core.kernels import kernel


@kernel(nogil=True, fastmath=True)
def group_points(points, count, neighbours, radius):
    """Indices into points [n, m, 3] of centres [n, count], and of the points around each [n, count,
    neighbours].

    The first centre is the point farthest from the mean, each further one the point farthest from the centres
    so far. Around a centre: the nearest points within the radius, beginning with the centre itself; where
    there are fewer, the centre repeats. So the order of the points makes no difference.
    """
    n, m = points.shape[:2]
    centres = np.empty((n, count), np.int64)
    around = np.empty((n, count, neighbours), np.int64)
    x, y, z = np.empty(m, np.float32), np.empty(m, np.float32), np.empty(m, np.float32)
    squared, least = np.empty(m, np.float32), np.empty(m, np.float32)
    near = np.empty(neighbours, np.float32)
    reach = np.float32(radius) * np.float32(radius)
    for i in range(n):
        a, b, c = np.float32(0.0), np.float32(0.0), np.float32(0.0)
        for j in range(m):
            x[j], y[j], z[j] = points[i, j, 0], points[i, j, 1], points[i, j, 2]
            a += x[j]
            b += y[j]
            c += z[j]
        share = np.float32(1.0) / np.float32(m)
        a, b, c = a * share, b * share, c * share
        for j in range(m):
            least[j] = (x[j] - a) ** 2 + (y[j] - b) ** 2 + (z[j] - c) ** 2
        chosen = np.argmax(least)
        for s in range(count):
            centres[i, s] = chosen
            a, b, c = x[chosen], y[chosen], z[chosen]
            for j in range(m):
                squared[j] = (x[j] - a) ** 2 + (y[j] - b) ** 2 + (z[j] - c) ** 2
            if s == 0:
                least[:] = squared
            else:
                for j in range(m):
                    least[j] = min(least[j], squared[j])
            around[i, s, :] = chosen
            near[:] = reach
            near[0] = np.float32(0.0)
            for j in range(m):
                distance = squared[j]
                if distance < near[neighbours - 1] and j != chosen:
                    place = neighbours - 1
                    while place > 1 and near[place - 1] > distance:
                        near[place], around[i, s, place] = near[place - 1], around[i, s, place - 1]
                        place -= 1
                    near[place], around[i, s, place] = distance, j
            furthest, most = 0, least[0]
            for j in range(1, m):
                if least[j] > most:
                    furthest, most = j, least[j]
            chosen = furthest
    return centres, around
