"""Compiled distance queries to point clouds. A grid of distances answers most queries; the others compute
distances to points.

A point is a sphere: its center and a radius. For the center of each voxel, the grid stores the index of the
nearest point and the distance to that point's center. Both are exact within a band around the points. Beyond
the band, the distance is a lower bound. The index there is that of a nearby point, which need not be the
nearest one, or -1. For a query at distance e from the center of its voxel, the grid gives the distance to the
nearest point to within e. If this is not precise enough, the query computes the distances to the points in
the cells around. `point_cloud_grid.py` builds the arrays, which are fields of SceneArrays.

Coordinates called f are in voxels from the grid's origin; c is f clamped to the grid. i is the
voxel, e the offset from the voxel's center, and o = f - c the offset of a query outside the grid. Entries of
`scene.grid_frame`: 0 to 2 origin, 3 voxel, 4 cell, 5 and 6 largest and smallest radius of a point, 7 band, 8
to 10 numbers of voxels, 11 to 13 numbers of cells.
"""

import numpy as np

from robotdiffuse.collision.kernels.nearest_voxels import nearest_voxels
from robotdiffuse.collision.kernels.simd import (
    W,
    first_lane,
    floor,
    gather,
    lane,
    load,
    load_vector,
    maximum,
    minimum,
    sqrt,
    vector_in,
)
from robotdiffuse.core.kernels import HALF, ONE, TINY, ZERO, allocation_free, inner_kernel, kernel
from robotdiffuse.robots.frame_kernel import dot, length, minus, plus, times, write

POINT_RANGE = np.float32(0.3)
"""Points farther than this beyond the robot's reach are left out; clearances to points are capped at this
value [m]."""
_MIDDLE = HALF, HALF, HALF
# Upper bound on the rounding error of a distance within the grid [m]
_SLACK = np.float32(1e-5)


@kernel(fastmath=True)
def make_grid(points, starts, run, low, voxel, shape, band, known):
    """For every voxel center the distance to the nearest point's center [m], and the index of that point.

    Both are exact below `band` [m]. Beyond the band, the distance is a lower bound, and the index is that of
    a nearby point, or -1 where this bound is at least `known` [m]. `low` is the grid's lower corner [m],
    `voxel` the edge of a voxel [m]. run[nx * ny * nz] has the value b for the voxel that contains the
    points starts[b] to starts[b + 1], exclusive, and -1 for voxels without points.
    """
    nx, ny, nz = shape
    balls = _balls(points, starts)
    max_offset = _max_offset(points, low, voxel)
    distances = np.empty(nx * ny * nz, np.float32)
    nearest = np.full(nx * ny * nz, -1, np.int32)
    squares, holders = nearest_voxels(run.reshape(nx, ny, nz))
    for i in range(nx):
        for j in range(ny):
            for k in range(nz):
                v = (i * ny + j) * nz + k
                b = holders[i, j, k]
                # no voxel with points is nearer than that of run b, and no point is farther than `max_offset`
                # from its voxel's center
                lower = voxel * np.sqrt(np.float32(squares[i, j, k])) - max_offset
                distances[v] = max(band, lower)
                if lower >= known:
                    continue
                nearest[v] = starts[b]
                if lower >= band:
                    continue
                cx = low[0] + (np.float32(i) + HALF) * voxel
                cy = low[1] + (np.float32(j) + HALF) * voxel
                cz = low[2] + (np.float32(k) + HALF) * voxel
                best = band * band
                for p in range(starts[b], starts[b + 1]):
                    dx = points[p, 0] - cx
                    dy = points[p, 1] - cy
                    dz = points[p, 2] - cz
                    d = dx * dx + dy * dy + dz * dz
                    if d < best:
                        best = d
                        nearest[v] = p
                distances[v] = min(np.sqrt(best), band) if best < band * band else distances[v]
    _settle(points, starts, balls, low, voxel, shape, band, distances, nearest)
    return distances, nearest


@inner_kernel(fastmath=True)
def _balls(points, starts):
    """A ball [x, y, z, radius] around the centers of the points of each voxel that has points."""
    balls = np.zeros((len(starts) - 1, 4), np.float32)
    for b in range(len(balls)):
        ball = balls[b]
        share = ONE / np.float32(starts[b + 1] - starts[b])
        for p in range(starts[b], starts[b + 1]):
            write(plus(ball, times(share, points[p])), ball)
        for p in range(starts[b], starts[b + 1]):
            ball[3] = max(ball[3], length(minus(points[p], ball)) + _SLACK)
    return balls


@inner_kernel(fastmath=True)
def _max_offset(points, low, voxel):
    """Largest distance of a point from the center of its voxel [m]."""
    max_square = ZERO
    for p in range(len(points)):
        square = ZERO
        for axis in range(3):
            coordinate = (points[p, axis] - low[axis]) / voxel
            off = coordinate - np.floor(coordinate) - HALF
            square += off * off
        max_square = max(max_square, square)
    return voxel * np.sqrt(max_square) + _SLACK


@inner_kernel(fastmath=True)
def _settle(points, starts, balls, low, voxel, shape, band, distances, nearest):
    """Lowers the distances that are too large. Afterwards each voxel center that is nearer than `band` to a
    point has its exact distance; the others keep their lower bounds, which are at least `band`."""
    nx, ny, nz = shape
    # each voxel's ball of points updates the voxel centers within `band` of the ball, one row along z at a
    # time
    for b in range(len(balls)):
        x, y, z, radius = balls[b]
        reach = band + radius
        px = (x - low[0]) / voxel
        py = (y - low[1]) / voxel
        pz = (z - low[2]) / voxel
        span = reach / voxel
        i0 = max(int(px - span), 0)
        i1 = min(int(px + span) + 1, nx)
        j0 = max(int(py - span), 0)
        j1 = min(int(py + span) + 1, ny)
        k0 = max(int(pz - span), 0)
        k1 = min(int(pz + span) + 1, nz)
        n = np.int32(k1 - k0)
        first_z = np.float32(k0) + HALF
        for i in range(i0, i1):
            cx = low[0] + (np.float32(i) + HALF) * voxel
            for j in range(j0, j1):
                cy = low[1] + (np.float32(j) + HALF) * voxel
                across = (cx - x) * (cx - x) + (cy - y) * (cy - y)
                row = (i * ny + j) * nz + k0
                if across >= reach * reach or not _any_closer(
                    distances, row, n, across, pz - first_z, voxel, radius
                ):
                    continue
                for p in range(starts[b], starts[b + 1]):
                    dx = cx - points[p, 0]
                    dy = cy - points[p, 1]
                    point_z = (points[p, 2] - low[2]) / voxel - first_z
                    _closer(distances, nearest, row, n, dx * dx + dy * dy, point_z, voxel, np.int32(p), band)


@allocation_free(fastmath=True)
def _any_closer(distances, row, n, across, z, voxel, radius):
    """Whether a ball of points may contain a point that is nearer to the center of one of n voxels than the
    voxel's current distance.

    The voxels follow each other along z; `row` is the index of the first. The ball's center is `z` voxels
    above the center of the first voxel, and `across` is its squared distance from the line of centers [m²].
    """
    any_closer = np.int32(0)
    for k in range(n):
        dz = (np.float32(k) - z) * voxel
        threshold = distances[row + k] + radius
        any_closer |= np.int32(across + dz * dz < threshold * threshold)
    return any_closer


@allocation_free(fastmath=True)
def _closer(distances, nearest, row, n, across, z, voxel, p, band):
    """Updates the distances and nearest points of n voxels with point p; `row`, `across` and `z` as in
    `_any_closer`, for the point."""
    for k in range(n):
        dz = (np.float32(k) - z) * voxel
        d = np.sqrt(across + dz * dz)
        old = distances[row + k]
        closer = d < min(old, band)
        distances[row + k] = d if closer else old
        nearest[row + k] = p if closer else nearest[row + k]


@allocation_free(forceinline=True)
def _ask_grid(centers, radius, scene):
    """Two masks of spheres in 16 lanes, from the grid alone: the spheres that may touch a point, and the
    spheres that certainly do."""
    frame = scene.grid_frame
    band = frame[7]
    voxel = frame[3]
    f = times(ONE / voxel, minus(centers, frame))
    c = (
        minimum(maximum(f[0], ZERO), frame[8] - HALF),
        minimum(maximum(f[1], ZERO), frame[9] - HALF),
        minimum(maximum(f[2], ZERO), frame[10] - HALF),
    )
    i = floor(c[0]), floor(c[1]), floor(c[2])
    g = gather(scene.grid, (i[0] * frame[9] + i[1]) * frame[10] + i[2])
    e = minus(minus(c, i), _MIDDLE)
    from_center = sqrt(dot(e, e)) * voxel
    o = minus(f, c)
    out = dot(o, o) * (voxel * voxel)
    grid_distance = maximum(g - from_center, ZERO)
    touch_distance = radius + (frame[5] + _SLACK)
    near = grid_distance * grid_distance + out < touch_distance * touch_distance
    touching = (g + from_center + sqrt(out) < radius + (frame[6] - _SLACK)) & (g < band)
    return near, near & touching


@allocation_free()
def far_from_points(scene, low, high, radius):
    """Whether one look-up, in the middle of the box from `low` to `high`, shows that no sphere of this radius
    with its center in the box touches a point."""
    lower = points_lower_bound(scene, times(HALF, plus(low, high)))
    return lower > radius + HALF * length(minus(high, low)) + _SLACK


@allocation_free()
def near_points(centers, radius, scene):
    """Mask of the lanes whose sphere may touch a point."""
    return _ask_grid(centers, radius, scene)[0]


@allocation_free()
def _near_by_eight(centers, radius, scene):
    """Mask of the lanes whose sphere may touch a point, from the eight voxels around the sphere's center.

    Each voxel gives a lower bound of the distance to the nearest point; that of the voxel on the far side of
    the sphere's center, as seen from this point, is almost exact.
    """
    frame = scene.grid_frame
    x, y, z = times(ONE / frame[3], minus(centers, frame))
    fx = minimum(maximum(x, ZERO), frame[8] - HALF)
    fy = minimum(maximum(y, ZERO), frame[9] - HALF)
    fz = minimum(maximum(z, ZERO), frame[10] - HALF)
    lx = minimum(floor(maximum(fx - HALF, ZERO)), frame[8] - np.float32(2.0))
    ly = minimum(floor(maximum(fy - HALF, ZERO)), frame[9] - np.float32(2.0))
    lz = minimum(floor(maximum(fz - HALF, ZERO)), frame[10] - np.float32(2.0))
    bound = fx * ZERO
    for corner in range(8):
        ix = lx + np.float32(corner >> 2)
        iy = ly + np.float32((corner >> 1) & 1)
        iz = lz + np.float32(corner & 1)
        e = minus((fx - ix, fy - iy, fz - iz), _MIDDLE)
        from_center = sqrt(dot(e, e)) * frame[3]
        bound = maximum(bound, gather(scene.grid, (ix * frame[9] + iy) * frame[10] + iz) - from_center)
    return bound < radius + (frame[5] + _SLACK)


@allocation_free()
def touch_points(centers, radius, scene):
    """Whether a sphere in any of 16 lanes touches a point."""
    near, touching = _ask_grid(centers, radius, scene)
    if touching:
        return True
    if near:
        near &= _near_by_eight(centers, radius, scene)
    while near:
        i = first_lane(near)
        near &= near - 1
        if _touches(scene, vector_in(centers, i), lane(radius, i)):
            return True
    return False


@allocation_free(forceinline=True)
def _columns(frame, rx, ry, reach):
    """Index ranges along x and y of the columns of cells that may contain points within `reach` of (rx, ry),
    given from the grid's origin [m]."""
    cell = frame[4]
    mx = int(frame[11])
    my = int(frame[12])
    i0 = max(int((rx - reach) / cell), 0)
    i1 = min(int((rx + reach) / cell), mx - 1)
    j0 = max(int((ry - reach) / cell), 0)
    j1 = min(int((ry + reach) / cell), my - 1)
    return i0, i1 + 1, j0, j1 + 1


@allocation_free(forceinline=True)
def _in_column(scene, i, j, rx, ry, rz, reach):
    """Index range of the points in those cells of column (i, j) that may be within `reach` of (rx, ry, rz)
    [m]; empty if there are none."""
    frame = scene.grid_frame
    cell = frame[4]
    my = int(frame[12])
    mz = int(frame[13])
    gx = max(max(np.float32(i) * cell - rx, rx - np.float32(i + 1) * cell), ZERO)
    gy = max(max(np.float32(j) * cell - ry, ry - np.float32(j + 1) * cell), ZERO)
    squared_half = reach * reach - gx * gx - gy * gy
    if squared_half <= ZERO:
        return np.int32(0), np.int32(0)
    half = np.sqrt(squared_half) + _SLACK
    k0 = max(int((rz - half) / cell), 0)
    k1 = min(int((rz + half) / cell), mz - 1)
    if k0 > k1:
        return np.int32(0), np.int32(0)
    column = (i * my + j) * mz
    return scene.cell_first[column + k0], scene.cell_first[column + k1 + 1]


@allocation_free()
def _touches(scene, at, radius):
    """Whether a sphere touches a point. The point that the grid stores as the nearest is checked first, then
    the points in the cells around."""
    frame = scene.grid_frame
    _, p = _look_up(scene, at)
    if p >= 0 and length(minus(scene.points[p], at)) < radius + scene.points[p, 3]:
        return True
    reach = radius + frame[5] + _SLACK
    if reach <= ZERO:
        return False
    rx, ry, rz = minus(at, frame)
    i0, i1, j0, j1 = _columns(frame, rx, ry, reach)
    for i in range(i0, i1):
        for j in range(j0, j1):
            first, last = _in_column(scene, i, j, rx, ry, rz, reach)
            # sixteen points at once; points of the first and last row that are outside the range are checked
            # too
            for row in range(first // W, (last + W - 1) // W if last > first else 0):
                offset = minus(load_vector(scene.point_rows, row, 0), at)
                r = load(scene.point_rows, row, 3) + radius
                if dot(offset, offset) < r * r:
                    return True
    return False


@allocation_free()
def _look_up(scene, at):
    """A lower bound of the distance to the nearest point's surface [m], and the index of the point stored in
    the voxel."""
    frame = scene.grid_frame
    voxel = frame[3]
    f = times(ONE / voxel, minus(at, frame))
    c = (
        min(max(f[0], ZERO), frame[8] - HALF),
        min(max(f[1], ZERO), frame[9] - HALF),
        min(max(f[2], ZERO), frame[10] - HALF),
    )
    i = np.int32(c[0]), np.int32(c[1]), np.int32(c[2])
    index = (i[0] * np.int32(frame[9]) + i[1]) * np.int32(frame[10]) + i[2]
    e = minus(minus(c, (np.float32(i[0]), np.float32(i[1]), np.float32(i[2]))), _MIDDLE)
    grid_distance = max(scene.grid[index] - voxel * length(e), ZERO)
    out = voxel * length(minus(f, c))
    return np.sqrt(grid_distance * grid_distance + out * out) - frame[5] - _SLACK, scene.nearest[index]


@allocation_free(fastmath=True)
def _search(scene, at, limit):
    """Distance to the surface of the nearest point if it is below `limit`, else `limit` [m]."""
    points = scene.points
    frame = scene.grid_frame
    reach = limit + frame[5] + _SLACK
    best = limit
    if reach <= ZERO:
        return best
    rx, ry, rz = minus(at, frame)
    i0, i1, j0, j1 = _columns(frame, rx, ry, reach)
    for i in range(i0, i1):
        for j in range(j0, j1):
            first, last = _in_column(scene, i, j, rx, ry, rz, reach)
            for p in range(first, last):
                offset = minus(points[p], at)
                r = best + points[p, 3]
                square = dot(offset, offset)
                if r > ZERO and square < r * r:
                    best = np.sqrt(square) - points[p, 3]
            reach = best + frame[5] + _SLACK
            if reach <= ZERO:
                return best
    return best


@allocation_free()
def points_distance(scene, at, limit):
    """Distance to the surface of the scene's nearest point, at most `limit` [m].

    It is exact if the grid stores a point for the voxel of `at`; otherwise it is a lower bound. It is exact
    for every sphere of the robot whose clearance is below about EXACT_RANGE (`point_cloud_grid.py`).
    """
    lower, p = _look_up(scene, at)
    if lower >= limit:
        return limit
    if p < 0:
        return lower
    point = scene.points[p]
    return _search(scene, at, min(length(minus(point, at)) - point[3], limit))


@allocation_free()
def points_lower_bound(scene, at):
    """A lower bound of the distance to the nearest point's surface, from the grid alone [m]."""
    return _look_up(scene, at)[0]


@allocation_free()
def near_point(scene, at, limit):
    """Approximate distance to the surface of the nearest point, at most `limit` [m], and its gradient.

    It is the distance to the nearest of the points stored in the eight voxels around `at`, which is too
    large by a few millimeters at most. It is used for gradients, where an exact search would take too long.
    """
    best = limit
    gradient = ZERO, ZERO, ZERO
    if points_lower_bound(scene, at) >= limit:
        return best, gradient
    frame = scene.grid_frame
    points = scene.points
    nx = int(frame[8])
    ny = int(frame[9])
    nz = int(frame[10])
    fx, fy, fz = minus(times(ONE / frame[3], minus(at, frame)), _MIDDLE)
    i = min(max(int(np.floor(fx)), 0), nx - 2)
    j = min(max(int(np.floor(fy)), 0), ny - 2)
    k = min(max(int(np.floor(fz)), 0), nz - 2)
    for corner in range(8):
        a = corner >> 2
        b = (corner >> 1) & 1
        c = corner & 1
        p = scene.nearest[((i + a) * ny + j + b) * nz + k + c]
        if p < 0:
            continue
        offset = minus(at, points[p])
        d = length(offset) + TINY
        if d - points[p, 3] < best:
            best = d - points[p, 3]
            gradient = times(ONE / d, offset)
    return best, gradient
