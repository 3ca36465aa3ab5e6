"""Renders depth images of scenes in milliseconds, and finds the voxels that scenes fill.

For each shape, rays are cast through the pixels that it may cover.
"""

import numpy as np
from jaxtyping import Float32
from numpy import ndarray

from robotdiffuse.collision.kernel_arrays import compile_scene
from robotdiffuse.collision.kernels.collision_cost import solid_distance
from robotdiffuse.core.errors import InputError
from robotdiffuse.core.kernels import HALF, ONE, TINY, ZERO, kernel
from robotdiffuse.core.transforms import transform
from robotdiffuse.core.types import Configuration, Pose, Spheres, Vector
from robotdiffuse.perception.depth_view import DepthView, Intrinsics
from robotdiffuse.perception.voxel_grid import VoxelGrid, Voxels
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.shapes import PointCloud, Triangulated

FASTMATH = {"contract", "reassoc", "arcp", "nsz"}
"""The fastmath flags that do not assume finite numbers, without approximate functions (afn)."""
# Surfaces nearer to the camera than this are not rendered [m].
_NEAR = np.float32(0.02)
_MISS = np.float32(1e9)


@kernel(inline="always")
def in_camera(T, x, y, z):
    """A vector of the base frame, rotated into the camera's frame. T: T_base_camera."""
    return (
        T[0, 0] * x + T[1, 0] * y + T[2, 0] * z,
        T[0, 1] * x + T[1, 1] * y + T[2, 1] * z,
        T[0, 2] * x + T[1, 2] * y + T[2, 2] * z,
    )


@kernel()
def rectangle(x, y, z, r, intrinsics, h, w):
    """First and last row, first and last column of the pixels that a sphere in the camera's frame may cover;
    if it covers none, a last index is smaller than its first. h, w: height and width of the image."""
    fx, fy, cx, cy = intrinsics
    if z + r <= ZERO:
        return 0, -1, 0, -1
    near = max(z - r, _NEAR)
    far = z + r
    # each edge is projected at the depth that makes the rectangle larger: the near depth if, for example, the
    # left edge is left of the optical axis, else the far depth
    left = (x - r) / (near if x < r else far)
    right = (x + r) / (near if x > -r else far)
    top = (y - r) / (near if y < r else far)
    bottom = (y + r) / (near if y > -r else far)
    u0 = max(np.floor(left * fx + cx), ZERO)
    u1 = min(np.ceil(right * fx + cx), np.float32(w - 1))
    v0 = max(np.floor(top * fy + cy), ZERO)
    v1 = min(np.ceil(bottom * fy + cy), np.float32(h - 1))
    return int(v0), int(v1), int(u0), int(u1)


@kernel(fastmath=FASTMATH)
def _quadratic(a, b, c, last):
    """The smaller root of a t^2 + 2 b t + c, or the larger root if `last`; _MISS if there is no root."""
    under = b * b - a * c
    if under < ZERO or a <= ZERO:
        return _MISS
    root = np.sqrt(under)
    return (root - b if last else -root - b) / a


@kernel(fastmath=FASTMATH)
def _sphere(ox, oy, oz, dx, dy, dz, r):
    c = ox * ox + oy * oy + oz * oz - r * r
    return _quadratic(dx * dx + dy * dy + dz * dz, ox * dx + oy * dy + oz * dz, c, False)


@kernel(fastmath=FASTMATH)
def _slab(o, d, half):
    """The parameters at which a ray enters and leaves |x| < half."""
    if abs(d) < TINY:
        return (-_MISS, _MISS) if abs(o) < half else (_MISS, -_MISS)
    a = (-half - o) / d
    b = (half - o) / d
    return min(a, b), max(a, b)


@kernel(fastmath=FASTMATH)
def _intersect(solid, ox, oy, oz, dx, dy, dz):
    """The parameter t at which the ray o + t d, in the frame of a solid, enters the solid; or _MISS.

    solid: a row of `SceneArrays.solids`.
    """
    # half edges a, solid[13], c of a box or, if solid[16] is 1, radius a and half height c of a cylinder;
    # a ball of radius r enlarges the shape: a sphere is an enlarged point, a capsule an enlarged line
    a = solid[12]
    c = solid[14]
    r = solid[15]
    if r > ZERO and c <= ZERO:
        return _sphere(ox, oy, oz, dx, dy, dz, r)
    if r <= ZERO and solid[16] <= ZERO:  # a box
        x0, x1 = _slab(ox, dx, a)
        y0, y1 = _slab(oy, dy, solid[13])
        z0, z1 = _slab(oz, dz, c)
        enter = max(x0, y0, z0)
        return enter if enter < min(x1, y1, z1) else _MISS
    # a cylinder, or the infinite cylinder around a capsule
    a += r
    square = dx * dx + dy * dy
    mixed = ox * dx + oy * dy
    offset = ox * ox + oy * oy - a * a
    if solid[16] > ZERO:
        z0, z1 = _slab(oz, dz, c)
        if square < np.float32(1e-12):
            return z0 if offset < ZERO else _MISS
        enter = _quadratic(square, mixed, offset, False)
        leave = _quadratic(square, mixed, offset, True)
        enter = max(enter, z0)
        return enter if enter < min(leave, z1) else _MISS
    side = _quadratic(square, mixed, offset, False)
    if abs(oz + side * dz) > c:
        side = _MISS
    return min(side, _sphere(ox, oy, oz - c, dx, dy, dz, r), _sphere(ox, oy, oz + c, dx, dy, dz, r))


@kernel(inline="always")
def _radius(solid):
    """The radius of a ball around the center of a solid that contains the solid [m]."""
    return np.sqrt(solid[12] ** 2 + solid[13] ** 2 + solid[14] ** 2) + solid[15]


@kernel(fastmath=FASTMATH)
def render_depth(solids, intrinsics, T, depth):
    """Lowers each pixel of `depth` [h w] to the depth of the nearest of `SceneArrays.solids`.

    Solids that contain the camera are not rendered. T: T_base_camera. All arrays are float32.
    """
    h, w = depth.shape
    fx, fy, cx, cy = intrinsics
    # the camera's rotation and position in the frame of the solid
    M = np.empty((3, 3), np.float32)
    o = np.empty(3, np.float32)
    for s in range(len(solids)):
        row = solids[s]
        px = row[0] - T[0, 3]
        py = row[1] - T[1, 3]
        pz = row[2] - T[2, 3]
        x, y, z = in_camera(T, px, py, pz)
        v0, v1, u0, u1 = rectangle(x, y, z, _radius(row), intrinsics, h, w)
        if v1 < v0 or u1 < u0:
            continue
        for i in range(3):
            a = row[3 + 3 * i]
            b = row[4 + 3 * i]
            c = row[5 + 3 * i]
            o[i] = -(a * px + b * py + c * pz)
            for j in range(3):
                M[i, j] = a * T[0, j] + b * T[1, j] + c * T[2, j]
        for v in range(v0, v1 + 1):
            q = (np.float32(v) - cy) / fy
            dx = M[0, 1] * q + M[0, 2]
            dy = M[1, 1] * q + M[1, 2]
            dz = M[2, 1] * q + M[2, 2]
            for u in range(u0, u1 + 1):
                p = (np.float32(u) - cx) / fx
                t = _intersect(row, o[0], o[1], o[2], dx + M[0, 0] * p, dy + M[1, 0] * p, dz + M[2, 0] * p)
                if _NEAR < t < depth[v, u]:
                    depth[v, u] = t


@kernel()
def fill_voxels(solids, low, voxel, margin, out):
    """Sets the voxels of out [nx ny nz] whose center is in a solid, or at most `margin` [m] from it.

    low: lower corner of the grid. All arrays are float32, except `out`, bool.
    """
    first = np.empty(3, np.int64)
    end = np.empty(3, np.int64)
    for s in range(len(solids)):
        row = solids[s]
        reach = _radius(row) + margin
        for axis in range(3):
            first[axis] = int(max((row[axis] - reach - low[axis]) / voxel, ZERO))
            end[axis] = min(int((row[axis] + reach - low[axis]) / voxel + 1), out.shape[axis])
        for i in range(first[0], end[0]):
            x = low[0] + (np.float32(i) + HALF) * voxel
            for j in range(first[1], end[1]):
                y = low[1] + (np.float32(j) + HALF) * voxel
                for k in range(first[2], end[2]):
                    z = low[2] + (np.float32(k) + HALF) * voxel
                    distance, _ = solid_distance(row, (x, y, z))
                    if distance <= margin:
                        out[i, j, k] = True


MAX_RANGE = 4.0
"""Range of rendered cameras [m]."""


def looking_at(position: Vector, target: Vector, roll: float = 0.0) -> Pose:
    """T_base_camera of a camera at `position` that looks at `target`, upright except for `roll` [rad].

    x is to the right in the image, y down, z forward. If the camera looks straight down, the top of the image
    is towards the +x of the base.
    """
    z = np.subtract(target, position) / np.linalg.norm(np.subtract(target, position))
    right = np.array([z[1], -z[0], 0.0])
    x = right / np.linalg.norm(right) if np.linalg.norm(right) > 1e-6 else np.array([0.0, -1.0, 0.0])
    y = np.cross(z, x)
    c = np.cos(roll)
    s = np.sin(roll)
    return transform(np.asarray(position, np.float64), np.stack([c * x + s * y, c * y - s * x, z], axis=1))


def ray_cast(
    scene: Scene,
    T_base_camera: Pose,
    intrinsics: Intrinsics,
    size: tuple[int, int],
    robot: Robot | None = None,
    configuration: Configuration | None = None,
) -> DepthView:
    """The depth image of a scene, and of the covering spheres of a robot if it and a configuration are given.

    size: width and height [pixels]; intrinsics: see DepthView. Depth is infinite for pixels without an
    obstacle within MAX_RANGE. Raises InputError for shapes other than spheres, boxes, cylinders and capsules.
    """
    solids = _solids(scene)
    if robot is not None and configuration is not None:
        solids = np.concatenate([solids, balls(robot.placed_spheres(configuration))])
    depth = np.full((size[1], size[0]), MAX_RANGE, np.float32)
    render_depth(solids, np.array(intrinsics, np.float32), np.asarray(T_base_camera, np.float32), depth)
    depth[depth >= MAX_RANGE] = np.inf
    return DepthView(depth, intrinsics, T_base_camera, configuration)


def balls(spheres: Spheres) -> Float32[ndarray, "n 17"]:
    """Spheres (x, y, z, radius [m]) as rows of `SceneArrays.solids`."""
    rows = np.zeros((len(spheres), 17), np.float32)
    rows[:, [0, 1, 2, 15]] = spheres
    rows[:, [3, 7, 11]] = ONE
    return rows


def voxels_within(
    scene: Scene,
    grid: VoxelGrid,
    margin: float = 0.005,
) -> Voxels:
    """Which voxels of a grid are occupied: their centers are in a shape, or at most `margin` [m] from it.

    With the default margin, walls of 1 cm have no holes in a grid with voxels of 2 cm. Raises
    InputError for shapes other than spheres, boxes, cylinders and capsules.
    """
    out = np.zeros(grid.shape, np.bool_)
    fill_voxels(_solids(scene), *grid.frame, np.float32(margin), out)
    return out


def _solids(scene: Scene) -> Float32[ndarray, "n 17"]:
    """`SceneArrays.solids` of a scene."""
    for shape in scene.shapes:
        if isinstance(shape, PointCloud | Triangulated):
            raise InputError(
                f"{shape.name} is a {shape.kind}; only spheres, boxes, cylinders and capsules can be rendered"
            )
    return compile_scene(scene).solids
