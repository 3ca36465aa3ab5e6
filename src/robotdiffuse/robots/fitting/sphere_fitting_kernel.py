"""Compiled inner loops of the sphere fit, and of tests between sets of spheres.

A surface consists of cells: triangles, given by indices of points. A grid stores the largest allowed radius
of a sphere at each center. The excess of a sphere is how far its radius exceeds this allowed radius. There
are no jaxtyping annotations because Numba compiles these functions. Lengths are in meters.
"""

import math
from itertools import product

import numpy as np

from robotdiffuse.core.kernels import allocation_free, kernel
from robotdiffuse.robots.frame_kernel import ball_gap, column, dot, length, minus, placed, rotated_back

# Initial step of the search for a center [m]: INITIAL_STEP in round 1; in each later round, STEP_SHRINKAGE
# times the one before, but at least MIN_INITIAL_STEP.
INITIAL_STEP = 0.004
MIN_INITIAL_STEP = 0.0005
STEP_SHRINKAGE = 0.8
MIN_STEP = 2e-4
"""The search for a center ends at this step [m]."""
OUTSIDE_GRID = -1.0
"""Largest radius just outside the grid [m]: negative, so that no sphere is placed there."""
MIN_GAIN = 1e-7
"""Steps that reduce the excess by less than this are not taken [m]."""

# Unit vectors to the 26 neighbors of a voxel: the directions of the steps in the search for a center.
DIRECTIONS = np.array([*filter(any, product((-1, 0, 1), repeat=3))], dtype=np.float64)
DIRECTIONS /= np.linalg.norm(DIRECTIONS, axis=1, keepdims=True)


@kernel()
def plane_depths(points, normals, offsets, starts, lowest):
    """Distance [n] from each point to the nearest face plane of the part in which the point is deepest;
    negative outside all parts. Values below `lowest` are replaced by `lowest`.

    Planes are as in `sphere_fitting.stacked_planes`.
    """
    depths = np.empty(len(points))
    for i in range(len(points)):
        best = lowest
        for part in range(len(starts) - 1):
            face_distance = 1e9
            for f in range(starts[part], starts[part + 1]):
                face_distance = min(face_distance, offsets[f] - dot(normals[f], points[i]))
                if face_distance <= best:
                    break
            best = max(best, face_distance)
        depths[i] = best
    return depths


@allocation_free(fastmath=True)
def max_radius_at(center, grid, origin, spacing):
    """Grid value interpolated at a point; outside the grid, negative and decreasing with the distance."""
    u = (center[0] - origin[0]) / spacing
    v = (center[1] - origin[1]) / spacing
    w = (center[2] - origin[2]) / spacing
    beyond = 0.0
    for value, count in ((u, grid.shape[0]), (v, grid.shape[1]), (w, grid.shape[2])):
        beyond = max(beyond, -value, value - (count - 1.001))
    if beyond > 0.0:
        return OUTSIDE_GRID - beyond * spacing
    i = int(u)
    j = int(v)
    k = int(w)
    total = 0.0
    for a in range(2):
        for b in range(2):
            for c in range(2):
                share = (1 - abs(u - i - a)) * (1 - abs(v - j - b)) * (1 - abs(w - k - c))
                total += share * grid[i + a, j + b, k + c]
    return total


@kernel(fastmath=True)
def max_radii_at(centers, grid, origin, spacing):
    """Grid values [n] interpolated at centers [n, 3]."""
    radii = np.empty(len(centers))
    for i in range(len(centers)):
        radii[i] = max_radius_at(centers[i], grid, origin, spacing)
    return radii


@allocation_free(fastmath=True)
def squared_distance(a, b):
    """Squared distance between two points."""
    d = minus(a, b)
    return dot(d, d)


@allocation_free(fastmath=True)
def farthest_corner(points, corners, c, center):
    """The largest squared distance of a cell's corners from a point."""
    far = 0.0
    for k in range(3):
        far = max(far, squared_distance(points[corners[c, k]], center))
    return far


@kernel(fastmath=True)
def assign(points, corners, centers, max_radii):
    """For each cell: the index of the sphere that covers it with the least excess, this excess, and the index
    and excess of the second best sphere. An index is -1 if there is no such sphere.

    `max_radii` are the largest allowed radii of spheres at `centers`.
    """
    owner = np.empty(len(corners), np.int64)
    min_excess = np.empty(len(corners))
    second_owner = np.empty(len(corners), np.int64)
    second_min_excess = np.empty(len(corners))
    for c in range(len(corners)):
        best_excess = 1e9
        second_excess = 1e9
        best_sphere = -1
        second_sphere = -1
        for i in range(len(centers)):
            # most spheres can be excluded by their distance from the first corner
            reach = second_excess + max_radii[i]
            near = squared_distance(points[corners[c, 0]], centers[i])
            if reach <= 0.0 or near >= reach * reach:
                continue
            needed = math.sqrt(farthest_corner(points, corners, c, centers[i])) - max_radii[i]
            if needed < best_excess:
                second_excess = best_excess
                best_excess = needed
                second_sphere = best_sphere
                best_sphere = i
            elif needed < second_excess:
                second_excess = needed
                second_sphere = i
        owner[c] = best_sphere
        min_excess[c] = best_excess
        second_owner[c] = second_sphere
        second_min_excess[c] = second_excess
    return owner, min_excess, second_owner, second_min_excess


@kernel(fastmath=True)
def greedy_cover(points, corners, places, max_radii):
    """Indices of places at which spheres cover all cells, chosen greedily: next is the sphere that covers the
    most uncovered cells.

    `max_radii` are the largest allowed radii of spheres at `places`. A cell that no sphere of an allowed
    radius covers counts as covered by the spheres with the least excess.
    """
    covers = np.zeros((len(corners), len(places)), np.bool_)
    counts = np.zeros(len(places), np.int64)
    for c in range(len(corners)):
        min_excess = 1e9
        for i in range(len(places)):
            if max_radii[i] + max(min_excess, 0.0) <= 0.0:
                continue
            excess = math.sqrt(farthest_corner(points, corners, c, places[i])) - max_radii[i]
            if min_excess > 0.0 and excess < min_excess:
                min_excess = max(excess, 0.0)
                covers[c, :i] = False
            covers[c, i] = excess <= min_excess
        for i in range(len(places)):
            counts[i] += covers[c, i]
    is_open = np.ones(len(corners), np.bool_)
    chosen = []
    while counts.max() > 0:
        best = counts.argmax()
        chosen.append(best)
        for c in range(len(corners)):
            if is_open[c] and covers[c, best]:
                is_open[c] = False
                for i in range(len(places)):
                    counts[i] -= covers[c, i]
    return np.array(chosen)


@kernel()
def enclosing(spheres):
    """A ball [x, y, z, radius] that contains all spheres."""
    ball = np.zeros(4)
    for k in range(3):
        ball[k] = 0.5 * (spheres[:, k].min() + spheres[:, k].max())
    for i in range(len(spheres)):
        ball[3] = max(ball[3], length(minus(spheres[i], ball)) + spheres[i, 3])
    return ball


@kernel()
def ball_distances(T_base_a, T_base_b, first, second):
    """Signed distances [a, b] between the balls of two sets, each set at its pose [4, 4] [m]."""
    gaps_between = np.empty((len(first), len(second)))
    for j in range(len(second)):
        for i in range(len(first)):
            gaps_between[i, j] = ball_gap(T_base_a, first[i], T_base_b, second[j])
    return gaps_between


@kernel()
def deepest_touches(T_base_a, T_base_b, first, second, apart, least):
    """Depth of the deepest overlap of two sets of spheres at each of n poses [m], and the middle of this
    overlap. If the sets do not overlap, the depth is minus their distance.

    Poses are [n, 4, 4]; middles are [n, 3], in the frame of the first set. Where the bounding balls of the
    sets are more than `apart` from each other, the depth is minus the balls' distance. At other poses, depths
    below `least` are replaced by `least`, with zeros as the middle.
    """
    depth = np.full(len(T_base_a), least)
    middle = np.zeros((len(T_base_a), 3))
    a = enclosing(first)
    b = enclosing(second)
    for n in range(len(T_base_a)):
        distance = ball_gap(T_base_a[n], a, T_base_b[n], b)
        if distance > apart:
            depth[n] = -distance
            continue
        for j in range(len(second)):
            at = placed(T_base_b[n], second[j])
            center = rotated_back(T_base_a[n], minus(at, column(T_base_a[n], 3)))
            # skip spheres too far from the first set to overlap more deeply
            reach = a[3] + second[j, 3] - depth[n]
            if reach <= 0.0 or squared_distance(a, center) >= reach * reach:
                continue
            for i in range(len(first)):
                reach = first[i, 3] + second[j, 3] - depth[n]
                d = minus(first[i], center)
                if reach <= 0.0 or dot(d, d) >= reach * reach:
                    continue
                distance = length(d)
                depth[n] = first[i, 3] + second[j, 3] - distance
                # from the center in the second set towards that in the first set, to the middle of the
                # overlap
                along = (distance + second[j, 3] - first[i, 3]) / 2 / max(distance, 1e-9)
                for k in range(3):
                    middle[n, k] = center[k] + along * d[k]
    return depth, middle


@kernel(fastmath=True)
def gaps(points, spheres):
    """Signed distance of points from a union of spheres [m]; inside the union, only an upper bound."""
    out = np.empty(len(points))
    for n in range(len(points)):
        gap = 1e9
        for i in range(len(spheres)):
            reach = gap + spheres[i, 3]
            square = squared_distance(points[n], spheres[i])
            if reach > 0.0 and square < reach * reach:
                gap = math.sqrt(square) - spheres[i, 3]
        out[n] = gap
    return out


@kernel()
def held_by_one(triangles, spheres):
    """Whether each triangle [t] is contained in a single sphere, and whether each corner [3 t] is outside all
    spheres."""
    contained = np.zeros(len(triangles), np.bool_)
    outside = np.ones(3 * len(triangles), np.bool_)
    for t in range(len(triangles)):
        for i in range(len(spheres)):
            inside = 0
            square = spheres[i, 3] * spheres[i, 3]
            for k in range(3):
                d = minus(triangles[t, k], spheres[i])
                if dot(d, d) <= square:
                    inside += 1
                    outside[3 * t + k] = False
            if inside == 3:
                contained[t] = True
                break
        if contained[t]:
            outside[3 * t : 3 * t + 3] = False
    return contained, outside


@allocation_free(fastmath=True)
def excess_radius(center, assigned_points, count, grid, origin, spacing):
    """Excess radius of the smallest sphere at a center that contains the first `count` of the assigned
    points."""
    far = 0.0
    for k in range(count):
        far = max(far, squared_distance(assigned_points[k], center))
    return math.sqrt(far) - max_radius_at(center, grid, origin, spacing)


@kernel(fastmath=True)
def move_center(center, assigned_points, count, step, grid, origin, spacing, directions):
    """Moves `center` in place to the least excess radius, by pattern search with an initial `step`."""
    min_excess = excess_radius(center, assigned_points, count, grid, origin, spacing)
    while step > MIN_STEP:
        best = min_excess - MIN_GAIN
        direction = -1
        for k in range(len(directions)):
            trial = center + step * directions[k]
            value = excess_radius(trial, assigned_points, count, grid, origin, spacing)
            if value < best:
                best = value
                direction = k
        if direction < 0:
            step /= 2
        else:
            min_excess = best
            center += step * directions[direction]


@kernel(fastmath=True)
def relax(points, corners, sharp, centers, rounds, enough, grid, origin, spacing, directions):
    """Alternate between assigning cells to spheres and moving the spheres.

    sharp: points that are always tested, see `Cells.sharp`.

    Returns the best centers found and their largest excess radius. Ends early when the excess is at most
    `enough`.
    """
    cells = len(corners)
    first = np.empty(len(points), np.int64)
    collected_by = np.empty(len(points), np.int64)
    on_rim = np.empty(len(points), np.bool_)
    assigned_points = np.empty((len(points), 3))
    centers = centers.copy()
    best = centers.copy()
    best_value = 1e9
    step = INITIAL_STEP
    for r in range(rounds + 1):
        owner, min_excess, _, _ = assign(
            points, corners, centers, max_radii_at(centers, grid, origin, spacing)
        )
        value = min_excess.max()
        if value < best_value:
            best = centers.copy()
            best_value = value
        if value <= enough or r == rounds:
            break
        # `on_rim`: points to test against the owners of their cells: those that are `sharp` or whose cells
        # have several owners; all others are inside if these are. `first`: owner of a point's first cell.
        first[:] = -1
        on_rim[:] = sharp
        for c in range(cells):
            for k in range(3):
                p = corners[c, k]
                if first[p] < 0:
                    first[p] = owner[c]
                elif first[p] != owner[c]:
                    on_rim[p] = True
        # move each sphere; `collected_by`: the last sphere for which a point was collected
        collected_by[:] = -1
        for i in range(len(centers)):
            assigned_count = 0
            for c in range(cells):
                if owner[c] != i:
                    continue
                for k in range(3):
                    p = corners[c, k]
                    if on_rim[p] and collected_by[p] != i:
                        collected_by[p] = i
                        assigned_points[assigned_count] = points[p]
                        assigned_count += 1
            if assigned_count > 0:
                move_center(
                    centers[i], assigned_points, assigned_count, step, grid, origin, spacing, directions
                )
        step = max(STEP_SHRINKAGE * step, MIN_INITIAL_STEP)
    return best, best_value
