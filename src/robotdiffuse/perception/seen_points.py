"""Reduces depth views to few points for the scene of a problem: the mean of the points in each cell of a
grid. A hash table holds the cells."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float32
from numpy import ndarray

from robotdiffuse.collision.kernel_arrays import compile_scene_for, reach_bound
from robotdiffuse.collision.kernels.collision_cost import scene_distance
from robotdiffuse.core.kernels import kernel
from robotdiffuse.core.types import Configuration, Configurations, Mask, Points, for_kernels
from robotdiffuse.perception.depth_filter import PointErrors, filtered, grown_for_errors, point_errors
from robotdiffuse.perception.depth_view import NEAREST, DepthView, SeenPoints
from robotdiffuse.robots.frame_kernel import write
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene import Scene

SAME_SURFACE_PIXELS = np.float32(4.0)
"""Neighboring pixels are on the same surface if their depths differ by less than this many widths of a pixel
at that depth, or by less than SAME_SURFACE_FRACTION."""
SAME_SURFACE_FRACTION = np.float32(0.01)
"""Largest difference of two depths on the same surface, as a fraction of the depth; see
SAME_SURFACE_PIXELS."""
MAX_DEPTH = np.float32(1e6)
"""Larger depths are no returns [m]."""
_NEAREST = np.float32(NEAREST)
RECENT = 256
"""Number of cells whose rows are cached: a power of two."""


@kernel(nogil=True, inline="always")
def _slot(keys, key):
    """Index of a key in an open-addressing hash table, or of the free slot to insert it."""
    mask = len(keys) - 1
    x = np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)
    at = np.int64(x >> np.uint64(32)) & mask
    while keys[at] != key and keys[at] != -1:
        at = (at + 1) & mask
    return at


@kernel(nogil=True, fastmath=True, inline="never")
def _within(x, y, z, xs, ys, zs, radii):
    """Whether a point is inside one of the spheres."""
    inside = np.int32(0)
    for s in range(len(xs)):
        dx = x - xs[s]
        dy = y - ys[s]
        dz = z - zs[s]
        inside |= np.int32(dx * dx + dy * dy + dz * dz < radii[s] * radii[s])
    return inside != 0


@kernel(nogil=True, inline="always")
def _key(x, y, z, voxel):
    """The key of a point's cell: its three indices, each in 21 bits."""
    span = np.int64(1) << 20
    i = np.int64(np.floor(x / voxel))
    j = np.int64(np.floor(y / voxel))
    k = np.int64(np.floor(z / voxel))
    return ((i + span) << 42) | ((j + span) << 21) | (k + span)


@kernel(nogil=True)
def gather(points, reach, spheres, box, voxel, keys, row_of, sums, count):
    """Adds points [3, n] to cells `voxel` wide. Returns the number of cells; -1 if `sums` is too small.

    Points beyond `reach` of the origin, NaN, and points inside one of the spheres [n, 4] are left out. box:
    lower and upper corner of a box around the spheres, in one array. keys, int64, and row_of, int32, are an
    open-addressing hash table from a cell's key to its row in `sums`; empty slots have the key -1.
    sums [m, 4]: the sums of the coordinates and the number of points of each cell. count: number of cells in
    use.
    """
    columns = _columns(spheres)
    # a cache of the rows of recent cells, since most points are in the cell of a neighboring pixel
    recent = np.full(RECENT, -1, np.int64)
    rows = np.zeros(RECENT, np.int32)
    for p in range(points.shape[1]):
        if count >= len(sums):
            return -1
        x = points[0, p]
        y = points[1, p]
        z = points[2, p]
        if not x * x + y * y + z * z <= reach * reach:
            continue
        in_box = box[0] < x < box[3] and box[1] < y < box[4] and box[2] < z < box[5]
        if in_box and _within(x, y, z, *columns):
            continue
        key = _key(x, y, z, voxel)
        at = (key ^ (key >> 18) ^ (key >> 37)) & (RECENT - 1)
        if recent[at] != key:
            recent[at] = key
            slot = _slot(keys, key)
            if keys[slot] == -1:
                keys[slot] = key
                row_of[slot] = count
                count += 1
            rows[at] = row_of[slot]
        row = sums[rows[at]]
        row[0] += x
        row[1] += y
        row[2] += z
        row[3] += np.float32(1.0)
    return count


@kernel(nogil=True)
def image_points(depth, intrinsics, T):
    """The points [3, h w] of a depth image in the base frame; NaN for pixels without a return and for flying
    pixels.

    At edges, sensors mix the depths of the near and the far surface. A pixel counts as flying if fewer than
    two of its eight neighbors are on the same surface. depth: [h, w]. intrinsics: fx, fy, cx, cy. T:
    T_base_camera [4, 4]. All are float32.
    """
    h, w = depth.shape
    fx, fy, cx, cy = intrinsics
    around = np.full((h + 2, w + 2), np.nan, np.float32)
    around[1:-1, 1:-1] = depth
    out = np.empty((3, h, w), np.float32)
    pixel = SAME_SURFACE_PIXELS / fx
    for v in range(h):
        b = (np.float32(v) - cy) / fy
        rx = T[0, 1] * b + T[0, 2]
        ry = T[1, 1] * b + T[1, 2]
        rz = T[2, 1] * b + T[2, 2]
        above = around[v]
        middle = around[v + 1]
        below = around[v + 2]
        x = out[0, v]
        y = out[1, v]
        z = out[2, v]
        for u in range(w):
            d = middle[u + 1]
            a = (np.float32(u) - cx) / fx
            jump = max(pixel, SAME_SURFACE_FRACTION) * d
            alike = np.int32(0)
            for row in (above, middle, below):
                alike += np.int32(abs(row[u] - d) < jump)
                alike += np.int32(abs(row[u + 1] - d) < jump)
                alike += np.int32(abs(row[u + 2] - d) < jump)
            # more than two: `alike` counts the pixel itself
            d = d if (alike > 2) & (d >= _NEAREST) & (d < MAX_DEPTH) else np.float32(np.nan)
            x[u] = (T[0, 0] * a + rx) * d + T[0, 3]
            y[u] = (T[1, 0] * a + ry) * d + T[1, 3]
            z[u] = (T[2, 0] * a + rz) * d + T[2, 3]
    return out.reshape(3, h * w)


@kernel(nogil=True)
def supported(keys, row_of, sums, count, least):
    """Which cells hold at least `least` points, or are next to a cell that does."""
    out = np.empty(count, np.bool_)
    for at in range(len(keys)):
        if keys[at] == -1:
            continue
        is_supported = sums[row_of[at], 3] >= least
        for i in range(-1, 2):
            for j in range(-1, 2):
                for k in range(-1, 2):
                    if not is_supported:
                        near = _slot(keys, keys[at] + (i << 42) + (j << 21) + k)
                        is_supported = keys[near] != -1 and sums[row_of[near], 3] >= least
        out[row_of[at]] = is_supported
    return out


@kernel(nogil=True)
def _columns(spheres):
    """The columns of spheres [n, 4], each contiguous in memory."""
    return spheres[:, 0].copy(), spheres[:, 1].copy(), spheres[:, 2].copy(), spheres[:, 3].copy()


@kernel(nogil=True)
def sphere_distances(points, spheres):
    """Signed distance of each point [n, 3] to the nearest sphere [m, 4]; infinite without spheres."""
    out = np.empty(len(points), np.float32)
    x, y, z, radii = _columns(spheres)
    for p in range(len(points)):
        at = np.float32(points[p, 0]), np.float32(points[p, 1]), np.float32(points[p, 2])
        out[p] = _nearest(at, x, y, z, radii)
    return out


@kernel(nogil=True, fastmath={"contract", "reassoc", "nnan", "nsz"})
def _nearest(at, x, y, z, radii):
    distance = np.float32(np.inf)
    for s in range(len(x)):
        dx = at[0] - x[s]
        dy = at[1] - y[s]
        dz = at[2] - z[s]
        distance = min(distance, np.sqrt(dx * dx + dy * dy + dz * dz) - radii[s])
    return distance


@kernel(nogil=True)
def _nearest_surfaces(scene, points, limit):
    out = np.empty((len(points), 4), np.float32)
    for p in range(len(points)):
        out[p, 0], normal = scene_distance(scene, points[p], limit)
        write(normal, out[p, 1:])
    return out


def nearest_surfaces(robot: Robot, scene: Scene, points: Points, limit: float) -> Float32[ndarray, "n 4"]:
    """For each point, its signed distance to the nearest obstacle that the robot can come near, at most
    `limit` [m], and the normal there."""
    arrays = compile_scene_for(robot, scene)
    return _nearest_surfaces(arrays, points.astype(np.float32), np.float32(limit))


def near_scene(robot: Robot, scene: Scene, points: Points, limit: float) -> Mask:
    """Which points are inside an obstacle, or nearer to one than `limit` [m]."""
    return nearest_surfaces(robot, scene, points, limit)[:, 0] < np.float32(limit)


CELL = 0.015
"""Edge length of the cells whose points are replaced by their mean [m]."""
POINT_RADIUS = 0.01
"""Radius of the obstacle around each point [m]."""
MIN_POINT_RADIUS = 0.001
"""Smallest radius of points near the arm at start or goal, so that they do not collide there [m]."""
JOINED = 1.4
"""Collision checks merge neighboring points with radii above POINT_RADIUS into spheres that are up to about
this many times as large, so such points need more distance from the arm at start and goals."""
ARM_DISTANCE = 0.02
"""Points within this distance of the arm, at its configuration in the view, are points of the arm [m];
`grown_for_errors` adds an allowance for noise."""
KNOWN_DISTANCE = 0.01
"""Points within this distance of a known shape are points of the shape [m]."""
REACH_MARGIN = 0.3
"""Points are kept up to this distance beyond the robot's reach [m]."""
MIN_CELL_POINTS = 3
"""Minimum number of points in an isolated cell; fewer points are sensor errors."""
CAMERA_DISTANCE = 2.0
"""Isolated cells with few points are left out only if every view is an image that has at least
MIN_CELL_POINTS² pixels per cell at this distance [m]."""
INITIAL_CELLS = 1 << 16
"""Initial capacity of the table of cells."""


def seen_points(views: Sequence[DepthView], robot: Robot, start: Configuration) -> Points:
    """The mean of the observed points in each cell of a grid, in the base frame [m].

    Flying pixels, isolated cells with few points, points of the arm at its configuration in each view, and
    points far beyond the arm's reach are left out. start: the arm's configuration in views that state none.
    """
    capacity = INITIAL_CELLS
    while True:
        keys = np.full(4 * capacity, -1, np.int64)
        row_of = np.zeros(4 * capacity, np.int32)
        sums = np.zeros((capacity, 4), np.float32)
        count = 0
        for view in views:
            arm = robot.placed_spheres(start if view.configuration is None else view.configuration)
            spheres = grown_for_errors(arm + np.array([0, 0, 0, ARM_DISTANCE]), view).astype(np.float32)
            if view.cloud is not None:
                points = for_kernels(view.cloud.T, np.float32)
            else:
                intrinsics = tuple(map(np.float32, view.intrinsics))
                points = image_points(filtered(view).depth, intrinsics, view.T_base_camera.astype(np.float32))
            reach = np.float32(reach_bound(robot) + REACH_MARGIN)
            low = (spheres[:, :3] - spheres[:, 3:]).min(axis=0, initial=np.inf)
            high = (spheres[:, :3] + spheres[:, 3:]).max(axis=0, initial=-np.inf)
            box = np.concatenate([low, high])
            count = gather(points, reach, spheres, box, np.float32(CELL), keys, row_of, sums, count)
            if count < 0:
                break
        if count >= 0:
            # isolated cells need more than one point only if all images have enough pixels per cell
            focal = min(
                (0.0 if view.cloud is not None else view.intrinsics[0] for view in views), default=0.0
            )
            is_dense = (CELL * focal / CAMERA_DISTANCE) ** 2 >= MIN_CELL_POINTS**2
            min_points = np.float32(MIN_CELL_POINTS if is_dense else 1)
            supported_cells = supported(keys, row_of, sums, count, min_points)
            return sums[:count, :3][supported_cells] / sums[:count, 3:][supported_cells]
        capacity *= 4


def seen_shapes(
    views: Sequence[DepthView],
    robot: Robot,
    known: Scene,
    start: Configuration,
    goals: Configurations,
) -> tuple[SeenPoints, ...]:
    """The points that views observed as obstacles; see `point_shapes`."""
    points = seen_points(views, robot, start)
    return point_shapes(points, robot, known, start, goals, point_errors(views, points))


END_SPREADS = 3.0
"""Noise of up to this many standard deviations must not make a free start or goal invalid."""
ERROR_STEP = 0.005
"""Errors of poses are rounded up to multiples of this [m]. Points with equal rounded errors and equal radii
form one shape."""


def point_shapes(
    points: Points,
    robot: Robot,
    known: Scene,
    start: Configuration,
    goals: Configurations,
    errors: PointErrors,
    enlarged: bool = True,
) -> tuple[SeenPoints, ...]:
    """Observed points as obstacles, without those of known shapes.

    The radius of a point is POINT_RADIUS plus the error of its camera's pose. This safety margin must not
    make a free start or goal invalid, so points that would touch the arm's spheres there get a smaller
    radius, at least MIN_POINT_RADIUS. Noise does not enlarge points, since it displaces some points of each
    surface towards the camera anyway.

    Two kinds of points are left out because their errors may have displaced them. Points of the first kind
    are less than MIN_POINT_RADIUS outside the arm at start or goals, or inside it by at most the error of the
    pose plus END_SPREADS times the noise; there are none if both are 0. Points of the second kind are nearer
    to a known shape than KNOWN_DISTANCE plus the error of the pose plus the noise.

    errors: see `point_errors`. enlarged: whether the error of the pose is added to the radius.
    """
    points = points.astype(np.float32)
    shifts = ERROR_STEP * np.ceil(errors[:, 0] / ERROR_STEP)
    ends = np.concatenate([robot.placed_spheres(q) for q in (start, *goals)]).astype(np.float32)
    shapes = list[SeenPoints]()
    for shift in np.unique(shifts):
        alike = points[shifts == shift]
        noise = errors[shifts == shift, 1].max()
        alike = alike[~near_scene(robot, known, alike, KNOWN_DISTANCE + shift + noise)]
        distances = sphere_distances(alike, ends)
        remaining = np.ones(len(alike), np.bool_)
        error = shift + END_SPREADS * noise
        if error:
            remaining = (distances >= MIN_POINT_RADIUS) | (distances < -error)
        padded = POINT_RADIUS + enlarged * shift * np.array((1.0, 2 / 3, 1 / 3, 0.0))
        name = "seen"
        for radius in (*dict.fromkeys(padded.tolist()), MIN_POINT_RADIUS):
            distance = (JOINED if radius > POINT_RADIUS else 1.0) * radius + MIN_POINT_RADIUS
            part = remaining & (distances >= distance) if radius > MIN_POINT_RADIUS else remaining
            remaining = remaining & ~part
            if part.any():
                shapes.append(SeenPoints(alike[part], radius, name=name))
            name = "seen_at_ends"
    return tuple(shapes)
