"""ObservedVolume: the voxels around an arm that depth views observed as occupied or as free; all others are
unknown.

Each voxel is projected into the image; rays are not followed through the voxels.
"""

from collections.abc import Sequence
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float32, Int32, UInt8
from numpy import ndarray

from robotdiffuse.core.errors import InputError, counted
from robotdiffuse.core.kernels import HALF, ONE, ZERO, kernel
from robotdiffuse.core.transforms import seen_from
from robotdiffuse.core.types import Configuration, frozen_dataclass
from robotdiffuse.perception.depth_filter import (
    empty_regions,
    filtered,
    grown_for_errors,
    open_depth,
    shows_surface,
)
from robotdiffuse.perception.depth_view import NEAREST, DepthImage, DepthView
from robotdiffuse.perception.ray_caster import FASTMATH, balls, in_camera, rectangle, render_depth
from robotdiffuse.perception.voxel_grid import COARSE, SHAPE, VoxelGrid
from robotdiffuse.robots.robot import Robot

# States of a voxel in a view.
HIDDEN = 0  # at a surface (then it may have points), or not observed for another reason than those below
FREE = 1  # observed as entirely free
BEHIND = 2  # behind a surface
SHADOW = 3  # behind the arm
OUT = 4  # outside the image
LOST = 5  # on a ray without a return, or behind a surface so near that it may cover the lens
# Depths of pixels without a return. A depth of -d means that nothing is nearer than d to the camera.
NO_RETURN = np.float32(0.0)
EMPTY = np.float32(-1e-6)
"""Depth of a pixel without a return where the camera seems to look into empty space, in a view that states no
range. It frees no voxel, but the voxels behind it are HIDDEN, not LOST."""
MAX_DEPTH = np.float32(1e6)
"""Depth of a pixel without an obstacle in range [m]. Minima over pixels also use it for those without a
return."""
POOLED_FOCAL_LENGTH = 250.0
"""Images are downsampled by min-pooling while their focal length stays above this [pixels]: a voxel of 4 cm
at a distance of 2 m is then 5 pixels wide."""
MIN_RETURN_FRACTION = np.float32(0.5)
"""Minimum fraction of a voxel's pixels with a return for it to be observed free."""
MIN_POINT_FRACTION = np.float32(0.03)
"""Minimum fraction of a voxel's pixels that must have points in the voxel for it to be observed occupied;
fewer are outliers."""
FLYING_PIXEL_STEP = np.float32(0.03)
"""A flying pixel is nearer than one neighbor and farther than the opposite neighbor by at least this [m], and
by at least FLYING_PIXEL_WIDTHS widths of a pixel at its distance."""
FLYING_PIXEL_WIDTHS = np.float32(4.0)
LENS_DISTANCE = np.float32(0.2)
"""A surface nearer than this may cover the lens, as a hand does; what is behind it is LOST [m]."""
BLOCK = 4
"""Edge of the blocks of voxels that are first tested as a whole [voxels]."""
PIXEL_SLACK = np.float32(0.01)
"""Larger than the rounding errors of image coordinates [pixels]."""
DEPTH_SLACK = np.float32(1e-4)
"""Larger than the rounding errors of depths [m]."""
_NEAREST = np.float32(NEAREST)


@kernel(fastmath=FASTMATH)
def usable_depth(depth, focal):
    """The depths, with MAX_DEPTH for rays without an obstacle, and NO_RETURN for missing returns and flying
    pixels. Negative depths are not changed."""
    h, w = depth.shape
    returns = np.empty((h, w), np.float32)
    for v in range(h):
        for u in range(w):
            d = depth[v, u]
            returns[v, u] = min(d, MAX_DEPTH) if d >= _NEAREST else (d if d < ZERO else NO_RETURN)
    out = returns.copy()
    for v in range(1, h - 1):
        for u in range(1, w - 1):
            d = returns[v, u]
            step = max(FLYING_PIXEL_STEP, FLYING_PIXEL_WIDTHS * d / focal)
            # the left, right, upper and lower neighbor
            a = returns[v, u - 1]
            b = returns[v, u + 1]
            c = returns[v - 1, u]
            e = returns[v + 1, u]
            across = (a > ZERO) & (b > ZERO) & (min(a, b) < d - step) & (max(a, b) > d + step)
            along = (c > ZERO) & (e > ZERO) & (min(c, e) < d - step) & (max(c, e) > d + step)
            out[v, u] = NO_RETURN if across | along else d
    return out


@kernel(fastmath=FASTMATH)
def _arm_pixels(depth, intrinsics, spheres):
    """Which pixels have points inside the spheres, [n, 4] x y z radius in the camera's frame."""
    h, w = depth.shape
    fx, fy, cx, cy = intrinsics
    mask = np.zeros((h, w), np.bool_)
    for s in range(len(spheres)):
        x, y, z, r = spheres[s]
        v0, v1, u0, u1 = rectangle(x, y, z, r, intrinsics, h, w)
        for v in range(v0, v1 + 1):
            ry = (np.float32(v) - cy) / fy
            for u in range(u0, u1 + 1):
                d = depth[v, u]
                dx = (np.float32(u) - cx) / fx * d - x
                dy = ry * d - y
                dz = d - z
                if dx * dx + dy * dy + dz * dz < r * r:
                    mask[v, u] = True
    return mask


def usable_image(
    view: DepthView, robot: Robot, q: Configuration, margin: float
) -> tuple[DepthImage, Float32[ndarray, "n 4"]]:
    """The view's filtered image, and the arm's spheres in the camera's frame, inflated by the margin [m], by
    noise and by the error of the camera's pose.

    If a pixel has no return and the camera seems to look into empty space there, its depth is infinite if the
    view states its range, otherwise EMPTY. Near a surface in the image it is -d instead of infinite, where d
    is the surface's depth; see `open_depth`. If the pixel's ray meets the arm, the depth is -NEAREST.
    """
    T = view.T_base_camera
    depth = filtered(view).depth
    arm = robot.placed_spheres(q)
    spheres = grown_for_errors(arm, view)
    spheres[:, :3] = seen_from(T, spheres[:, :3])
    spheres[:, 3] += margin
    spheres = spheres.astype(np.float32)
    intrinsics = np.array(view.intrinsics, np.float32)
    arm_pixels = _arm_pixels(depth, intrinsics, spheres)
    # without a surface in the image, the camera may be covered
    empty = empty_regions(view.depth, view.range, arm_pixels) if shows_surface(view) else None
    if empty is not None:
        opening = EMPTY if view.range is None else open_depth(depth, arm_pixels, view.intrinsics[0])
        depth = np.where(empty, opening, depth)
        # Only the error of the camera's position is added here. `carve` accounts for the error of its angle:
        # it enlarges the rectangles of pixels that must all be free.
        outline = balls(arm + np.array([0, 0, 0, view.pose_deviation[0]]))
        arm_depth = np.full(depth.shape, MAX_DEPTH)
        render_depth(outline, intrinsics, T.astype(np.float32), arm_depth)
        depth[empty & (arm_depth < MAX_DEPTH)] = -_NEAREST
    return depth, spheres


@kernel(fastmath=FASTMATH)
def _min_pooled(depth, factor):
    """Minimum depth of each block of `factor` x `factor` pixels, and the summed-area table of the number of
    missing returns in the blocks. Of negative depths, the magnitude counts."""
    h = (depth.shape[0] + factor - 1) // factor
    w = (depth.shape[1] + factor - 1) // factor
    min_depth = np.full((h, w), MAX_DEPTH, np.float32)
    missing = np.zeros((h + 1, w + 1), np.int32)
    nearest = np.empty(depth.shape[1], np.float32)
    lost = np.empty(depth.shape[1], np.int32)
    for block in range(h):
        nearest[:] = MAX_DEPTH
        lost[:] = 0
        for v in range(block * factor, min((block + 1) * factor, depth.shape[0])):
            row = depth[v]
            for u in range(depth.shape[1]):
                measured = abs(row[u]) >= _NEAREST
                nearest[u] = min(nearest[u], abs(row[u]) if measured else MAX_DEPTH)
                lost[u] += np.int32(0) if measured else np.int32(1)
        total = np.int32(0)
        for u in range(depth.shape[1]):
            cell = u // factor
            min_depth[block, cell] = min(min_depth[block, cell], nearest[u])
            total += lost[u]
            missing[block + 1, cell + 1] = missing[block, cell + 1] + total
    return min_depth, missing


@kernel(fastmath=FASTMATH)
def minimum_table(min_depth, levels):
    """Sparse table for range minima: table[k] holds, for each cell, the minimum depth of the square of
    2^k x 2^k cells that begins there and extends down and to the right."""
    h, w = min_depth.shape
    table = np.empty((levels, h, w), np.float32)
    table[0] = min_depth
    for k in range(1, levels):
        step = 1 << (k - 1)
        before = table[k - 1]
        now = table[k]
        now[:] = before
        rows = max(h - step, 0)
        columns = max(w - step, 0)
        now[:rows] = np.minimum(before[:rows], before[step:])
        now[:, :columns] = np.minimum(now[:, :columns], now[:, step:])
    return table


@kernel(fastmath=FASTMATH)
def _rectangle_minimum(table, v0, v1, u0, u1):
    """Minimum depth of the cells of a rectangle with inclusive bounds, from `minimum_table`."""
    k = 0
    while 2 << k <= min(v1 - v0, u1 - u0) + 1 and k + 1 < len(table):
        k += 1
    step = 1 << k
    min_depth = MAX_DEPTH
    for v in range(v0, v1 + step, step):
        row = table[k, max(v0, min(v, v1 - step + 1))]
        for u in range(u0, u1 + step, step):
            min_depth = min(min_depth, row[max(u0, min(u, u1 - step + 1))])
    return min_depth


@kernel(fastmath=FASTMATH, inline="always")
def _cells(middle, half, share):
    """The first and last cell of an interval of pixels. share: cells per pixel."""
    return int((middle - half + HALF) * share), int((middle + half + HALF) * share)


@kernel(inline="always")
def _rectangle_sum(sums, v0, v1, u0, u1):
    """Sum of the cells of a rectangle with inclusive bounds, from a summed-area table."""
    return sums[v1 + 1, u1 + 1] - sums[v0, u1 + 1] - sums[v1 + 1, u0] + sums[v0, u0]


@kernel(fastmath=FASTMATH)
def _count_points(depth, arm, intrinsics, T, low, voxel, counts):
    """Counts the image points in each voxel; `arm` says which pixels show the arm and do not count."""
    fx, fy, cx, cy = intrinsics
    h, w = depth.shape
    nx, ny, nz = counts.shape
    flat = counts.ravel()
    fnx = np.float32(nx)
    fny = np.float32(ny)
    fnz = np.float32(nz)
    scale = ONE / voxel
    # the camera's position (ox, oy, oz), from the grid's lower corner, in units of a voxel's edge
    ox = (T[0, 3] - low[0]) * scale
    oy = (T[1, 3] - low[1]) * scale
    oz = (T[2, 3] - low[2]) * scale
    at = np.empty(w, np.int32)
    for v in range(h):
        b = (np.float32(v) - cy) / fy
        rx = T[0, 1] * b + T[0, 2]
        ry = T[1, 1] * b + T[1, 2]
        rz = T[2, 1] * b + T[2, 2]
        row = depth[v]
        hidden = arm[v]
        for u in range(w):
            a = (np.float32(u) - cx) / fx
            d = row[u] * scale
            x = ox + (rx + T[0, 0] * a) * d
            y = oy + (ry + T[1, 0] * a) * d
            z = oz + (rz + T[2, 0] * a) * d
            inside = (x >= ZERO) & (y >= ZERO) & (z >= ZERO) & (x < fnx) & (y < fny) & (z < fnz)
            inside &= (d > ZERO) & ~hidden[u]
            x = min(max(x, ZERO), fnx)
            y = min(max(y, ZERO), fny)
            z = min(max(z, ZERO), fnz)
            index = (np.int32(x) * np.int32(ny) + np.int32(y)) * np.int32(nz) + np.int32(z)
            at[u] = index if inside else np.int32(-1)
        for u in range(w):
            if at[u] >= 0:
                flat[at[u]] += 1


@kernel(fastmath=FASTMATH)
def carve(depth, intrinsics, T, spheres, low, voxel, errors, state, behind, counts):
    """Writes the state of each voxel [nx ny nz], its depth behind a surface [m], and its number of points.

    intrinsics: fx, fy, cx, cy. T: T_base_camera [4 4]. spheres: the arm's, in the camera's frame. low: lower
    corner of the grid. voxel: edge of a voxel [m]. errors: four numbers: free space is narrowed by the first
    [m] plus the second [rad] times the distance from the camera; the third is the noise of depth at 1 m [m],
    and the fourth the sensor's range [m]. counts: number of points in each voxel, less the outliers that
    MIN_POINT_FRACTION allows. All arrays are float32, except state, uint8, and counts, int32.
    """
    nx, ny, nz = state.shape
    raw = usable_depth(depth, intrinsics[0])
    arm = _arm_pixels(raw, intrinsics, spheres)
    counts[:] = 0
    _count_points(raw, arm, intrinsics, T, low, voxel, counts)
    factor = max(1, int(intrinsics[0] / POOLED_FOCAL_LENGTH))
    min_depth, missing = _min_pooled(raw, factor)
    table = minimum_table(min_depth, 6)
    for i in range(0, nx, BLOCK):
        for j in range(0, ny, BLOCK):
            for k in range(0, nz, BLOCK):
                first = (i, j, k)
                end = (min(i + BLOCK, nx), min(j + BLOCK, ny), min(k + BLOCK, nz))
                block_state = _state_of_block(
                    first, intrinsics, T, low, voxel, errors, raw.shape, factor, table, missing
                )
                if block_state >= 0:
                    state[i : end[0], j : end[1], k : end[2]] = block_state
                    behind[i : end[0], j : end[1], k : end[2]] = ZERO
                else:
                    _carve_block(
                        first,
                        end,
                        raw,
                        arm,
                        intrinsics,
                        T,
                        low,
                        voxel,
                        errors,
                        factor,
                        table,
                        missing,
                        state,
                        behind,
                        counts,
                    )


@kernel(fastmath=FASTMATH)
def _half_sizes(T, x, y, half, error):
    """Half the width and height of the rectangle around a cube's image, as lengths at the depth of the cube's
    center [m].

    half: half the edge of the cube [m]. error: by how far the cube may be displaced [m]. x, y: the direction
    (x, y, 1) of its center in the camera's frame.
    """
    du = ZERO
    dv = ZERO
    u_square = ZERO
    v_square = ZERO
    for c in range(3):
        across = T[c, 0] - x * T[c, 2]
        along = T[c, 1] - y * T[c, 2]
        du += abs(across)
        dv += abs(along)
        u_square += across * across
        v_square += along * along
    return half * du + error * np.sqrt(u_square), half * dv + error * np.sqrt(v_square)


@kernel(fastmath=FASTMATH)
def _state_of_block(first, intrinsics, T, low, voxel, errors, size, factor, table, missing):
    """OUT or FREE if the rectangle that a block covers in the image shows that all of its voxels have this
    state; -1 if the voxels must be tested one by one.

    first: indices of the block's first voxel. size: height and width of the image.
    """
    fx, fy, cx, cy = intrinsics
    middle = HALF * np.float32(BLOCK)
    px = low[0] + (np.float32(first[0]) + middle) * voxel - T[0, 3]
    py = low[1] + (np.float32(first[1]) + middle) * voxel - T[1, 3]
    pz = low[2] + (np.float32(first[2]) + middle) * voxel - T[2, 3]
    x, y, z = in_camera(T, px, py, pz)
    # half the extent of a voxel in depth, and the range of depths of the block [m]
    ez = HALF * voxel * (abs(T[0, 2]) + abs(T[1, 2]) + abs(T[2, 2]))
    near = z - np.float32(BLOCK) * ez
    far = z + np.float32(BLOCK) * ez
    if far <= ez:
        return OUT
    if near <= voxel:
        return -1
    x = x / z
    y = y / z
    # u ± du, v ± dv: a rectangle of pixels that contains the rectangles of all voxels of the block
    error = errors[0] + errors[1] * far
    du, dv = _half_sizes(T, x, y, middle * voxel, error)
    # an upper bound of the 1 / (z - ez) that `_carve_block` uses for a voxel; ez / near is added since the
    # voxel's x and y differ from the block's
    wider = (ONE + ez / near) / near
    far = far + error * (ONE + far / near) + errors[2] * far * far
    u = fx * x + cx
    v = fy * y + cy
    du = fx * wider * du + PIXEL_SLACK
    dv = fy * wider * dv + PIXEL_SLACK
    h, w = size
    if u + du < -HALF or v + dv < -HALF or u - du >= np.float32(w) - HALF or v - dv >= np.float32(h) - HALF:
        return OUT
    share = ONE / np.float32(factor)
    u0, u1 = _cells(u, du, share)
    v0, v1 = _cells(v, dv, share)
    if u - du < -HALF or v - dv < -HALF or u1 >= table.shape[2] or v1 >= table.shape[1]:
        return -1
    if _rectangle_sum(missing, v0, v1, u0, u1):
        return -1
    if far > errors[3]:
        return -1
    return FREE if _rectangle_minimum(table, v0, v1, u0, u1) > far + DEPTH_SLACK else -1


@kernel(fastmath=FASTMATH)
def _carve_block(
    first, end, raw, arm, intrinsics, T, low, voxel, errors, factor, table, missing, state, behind, counts
):
    """Does the work of `carve` for the voxels of one block."""
    fx, fy, cx, cy = intrinsics
    h, w = table.shape[1:]
    share = ONE / np.float32(factor)
    half = HALF * voxel
    ez = half * (abs(T[0, 2]) + abs(T[1, 2]) + abs(T[2, 2]))  # half the extent of a voxel in depth [m]
    for i in range(first[0], end[0]):
        px = low[0] + (np.float32(i) + HALF) * voxel - T[0, 3]
        for j in range(first[1], end[1]):
            py = low[1] + (np.float32(j) + HALF) * voxel - T[1, 3]
            for k in range(first[2], end[2]):
                pz = low[2] + (np.float32(k) + HALF) * voxel - T[2, 3]
                x, y, z = in_camera(T, px, py, pz)
                behind[i, j, k] = ZERO
                state[i, j, k] = OUT
                if z <= ez:
                    continue
                x = x / z
                y = y / z
                u = fx * x + cx
                v = fy * y + cy
                column = int(np.floor(u + HALF))
                row = int(np.floor(v + HALF))
                if column < 0 or row < 0 or column >= raw.shape[1] or row >= raw.shape[0]:
                    continue
                if counts[i, j, k] > 0:
                    pixels = fx * fy * (voxel / z) ** 2
                    counts[i, j, k] = max(0, counts[i, j, k] - int(MIN_POINT_FRACTION * pixels))
                # the depth at the voxel's center; if there is no return, `front` becomes the nearest depth
                center_depth = raw[row, column]
                front = center_depth
                if front > z + ez or front <= ZERO:
                    # The voxel is free if all pixels that it may cover are deeper than `beyond`.
                    # A rotation of the camera moves a point perpendicular to its ray, so it changes the
                    # point's depth only beside the optical axis.
                    aside = errors[1] * z * np.sqrt(x * x + y * y)
                    beyond = z + ez + errors[0] + aside + errors[2] * z * z
                    du0, dv0 = _half_sizes(T, x, y, half, ZERO)
                    du, dv = _half_sizes(T, x, y, half, errors[0] + errors[1] * z)
                    own_share = du0 * dv0 / (du * dv)  # share of the rectangle that the voxel covers
                    du = fx * du / (z - ez)
                    dv = fy * dv / (z - ez)
                    u0, u1 = _cells(u, du, share)
                    v0, v1 = _cells(v, dv, share)
                    inside = u - du >= -HALF and v - dv >= -HALF and u1 < w and v1 < h
                    u0 = max(0, u0)
                    v0 = max(0, v0)
                    u1 = min(w - 1, u1)
                    v1 = min(h - 1, v1)
                    lost = _rectangle_sum(missing, v0, v1, u0, u1)
                    pixels = np.float32((v1 + 1 - v0) * (u1 + 1 - u0) * factor * factor) * own_share
                    nearest = _rectangle_minimum(table, v0, v1, u0, u1)
                    if (
                        inside
                        and nearest > beyond
                        and beyond < errors[3]
                        and np.float32(lost) <= (ONE - MIN_RETURN_FRACTION) * pixels
                    ):
                        state[i, j, k] = FREE
                        continue
                    front = nearest if front <= ZERO else front
                state[i, j, k] = HIDDEN
                if arm[row, column]:
                    state[i, j, k] = SHADOW
                elif center_depth <= -_NEAREST or ZERO < front < LENS_DISTANCE:
                    state[i, j, k] = LOST
                elif front < z:
                    state[i, j, k] = BEHIND
                    behind[i, j, k] = z - front
                elif center_depth == NO_RETURN:
                    state[i, j, k] = LOST


@kernel()
def add_evidence(state, counts, evidence, hit, miss, largest):
    """Add the evidence of a view for each voxel [nx ny nz]: `hit` for voxels with points, -`miss` for free
    voxels. The sum is clipped to [-largest, largest]. Returns the number of observed voxels whose evidence
    was 0 before."""
    state = state.ravel()
    counts = counts.ravel()
    evidence = evidence.ravel()
    new = 0
    for v in range(len(evidence)):
        points = counts[v] > 0
        free = state[v] == FREE
        before = evidence[v]
        gain = hit if points else (-miss if free else ZERO)
        new += (points | free) & (before == ZERO)
        evidence[v] = min(max(before + gain, -largest), largest)
    return new


CoarseVoxels = Bool[ndarray, "56 56 32"]
ARM_MARGIN = 0.015
"""Points within this distance of the arm's covering spheres are points of the arm [m]; more with noise: see
`grown_for_errors`."""
NARROWED_SHARE = 0.35
"""Free space is narrowed by this fraction of the largest error of a camera's pose. Observed surfaces are
inflated by the whole error. The inflated surfaces cover most wrongly free voxels, so narrowing only has to
cover those right behind an edge."""


@frozen_dataclass
class ObservedVolume:
    """The states of coarse voxels according to views. Voxels neither occupied nor free are unknown."""

    occupied: CoarseVoxels
    """The voxel contains points that are not the arm's."""
    free: CoarseVoxels
    """A view observed the whole voxel as free."""
    shadow: CoarseVoxels
    """The voxel is unknown, and behind the arm in some view."""
    out_of_view: CoarseVoxels
    """The voxel is outside all images."""
    behind: Float32[ndarray, "56 56 32"]
    """How far the voxel is behind an observed surface, the minimum over all views [m]; 0 if it is behind
    none, or observed."""
    lost: CoarseVoxels
    """The voxel is unknown, and in some view its ray has no return (so something may be in range) or meets a
    surface nearer than LENS_DISTANCE. It is behind no other surface in any view."""

    @cached_property
    def unknown(self) -> CoarseVoxels:
        return ~(self.occupied | self.free)


def observe(views: Sequence[DepthView], robot: Robot, start: Configuration) -> ObservedVolume:
    """The volume observed by all views. A voxel is occupied if any view says so, else free if any does.

    A voxel is free in a view if its far side is in range, all pixels that it may cover are in the image, no
    depth of these pixels is nearer than the far side, and at least half of them have a return. start: the
    arm's configuration in views that state none. Raises InputError if there are no views, or for a
    configuration of the wrong length.
    """
    if not len(views):
        raise InputError("views is empty; at least one depth view is needed")
    return merged([observed_by(view, robot, start) for view in views])


def merged(volumes: Sequence[ObservedVolume]) -> ObservedVolume:
    """The union of volumes: a voxel is occupied if any volume says so, else free if any does."""
    occupied, free, shadow, lost = (np.zeros(SHAPE, np.bool_) for _ in range(4))
    out = np.ones(SHAPE, np.bool_)
    depth_behind = np.full(SHAPE, np.inf, np.float32)
    for volume in volumes:
        occupied |= volume.occupied
        free |= volume.free
        shadow |= volume.shadow
        lost |= volume.lost
        out &= volume.out_of_view
        np.copyto(depth_behind, volume.behind, where=(volume.behind > 0) & (volume.behind < depth_behind))
    free &= ~occupied
    observed = free | occupied
    depth_behind[~np.isfinite(depth_behind) | observed] = 0.0
    return ObservedVolume(
        occupied, free, shadow & ~observed, out, depth_behind, lost & ~observed & (depth_behind == 0)
    )


def observed_by(view: DepthView, robot: Robot, start: Configuration) -> ObservedVolume:
    """The volume observed by one view. If the image has too few returns (see `shows_surface`), the camera may
    be covered or broken: then no voxel is free, in shadow or lost."""
    q = start if view.configuration is None else view.configuration
    if len(q) != robot.dof:
        raise InputError(
            f"the configuration has {counted(len(q), 'number')}; {robot.name} plans "
            f"{counted(robot.dof, 'joint')}"
        )
    state, behind, counts = carve_view(view, robot, q, COARSE)
    occupied = counts > 0
    behind[(state != BEHIND) | occupied] = 0.0
    usable = shows_surface(view)
    free, shadow, lost = ((state == kind) & ~occupied & usable for kind in (FREE, SHADOW, LOST))
    return ObservedVolume(occupied, free, shadow, state == OUT, behind, lost)


def carve_view(
    view: DepthView,
    robot: Robot,
    q: Configuration,
    grid: VoxelGrid,
    narrowed: float = NARROWED_SHARE,
) -> tuple[UInt8[ndarray, "nx ny nz"], Float32[ndarray, "nx ny nz"], Int32[ndarray, "nx ny nz"]]:
    """The state of each voxel in the filtered image of one view, its depth behind a surface [m], and its
    number of points; see `carve`.

    q: the arm's configuration in the view. narrowed: free space is narrowed by this fraction of the largest
    error of the camera's pose.
    """
    depth, spheres = usable_image(view, robot, q, ARM_MARGIN)
    position, angle = narrowed * np.array(view.pose_deviation)
    farthest = MAX_DEPTH if view.range is None else view.range
    state = np.empty(grid.shape, np.uint8)
    depth_behind = np.empty(grid.shape, np.float32)
    counts = np.empty(grid.shape, np.int32)
    carve(
        depth,
        np.array(view.intrinsics, np.float32),
        view.T_base_camera.astype(np.float32),
        spheres,
        *grid.frame,
        np.array([position, angle, filtered(view).spread, farthest], np.float32),
        state,
        depth_behind,
        counts,
    )
    return state, depth_behind, counts
