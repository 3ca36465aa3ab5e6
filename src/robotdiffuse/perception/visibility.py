"""What a camera would see from a pose: the voxels that neither the arm nor other voxels hide. Also, which
balls an image shows to be empty; these balls cover the arm's surface at a goal."""

from itertools import product

import numpy as np
from jaxtyping import Float, Float32, Int
from numpy import ndarray

from robotdiffuse.collision.convex_geometry import Part, parts_of
from robotdiffuse.collision.exact_meshes import forward_frames
from robotdiffuse.collision.kernel_arrays import compile_robot
from robotdiffuse.collision.kernels.collision_cost import frames_of
from robotdiffuse.collision.kernels.collision_cost import placed as placed_point
from robotdiffuse.core.kernels import HALF, ONE, ZERO, kernel
from robotdiffuse.core.transforms import placed
from robotdiffuse.core.types import Configuration, Configurations, Mask, Points, Values, Vector
from robotdiffuse.perception.depth_view import Intrinsics
from robotdiffuse.perception.observed_volume import MAX_DEPTH, usable_depth
from robotdiffuse.perception.ray_caster import in_camera, render_depth
from robotdiffuse.perception.voxel_grid import Probabilities, VoxelGrid, Voxels
from robotdiffuse.robots.kinematic_tree import once_per_robot
from robotdiffuse.robots.robot import Robot

OCCLUSION_START = np.float32(2.0)
"""Distance [edges of voxels] within which other voxels do not count as hiding a voxel: they are likely
unknown too, and a view would show all of them or none."""
MIN_VISIBILITY = np.float32(0.02)
"""Smaller probabilities that a voxel is visible count as zero."""
ARM_CELL = 16
"""Edge of the square cells of pixels in which the arm's depth is computed [pixels]."""


@kernel(nogil=True)
def seen_weights(robot, configurations, poses, intrinsics, size, reach, voxels, weights, filled, low, edge):
    """For each camera, the sum over the voxels of weight times the probability that the camera sees the
    voxel.

    robot: RobotArrays. configurations: float32[m, dof], the arm's for each camera. poses: [m, 4, 4],
    T_base_camera. intrinsics: fx, fy, cx, cy. size: height and width of the image. reach: largest depth along
    the optical axis at which voxels are seen [m]. voxels: int64[n, 3], their indices. weights: [n]. filled:
    [nx, ny, nz], the probability that a voxel is occupied and hides what is behind it. low: lower corner of
    the grid [m]. edge: edge of a voxel [m].
    """
    fx, fy, cx, cy = intrinsics
    nx, ny, nz = filled.shape
    out = np.zeros(len(poses))
    frames = np.zeros((configurations.shape[1] + 1, 12), np.float32)
    arm = np.zeros((len(robot.spheres), 17), np.float32)
    arm[:, 3:12:4] = ONE  # no rotation
    # the depth of the arm's spheres in the middle of each cell of pixels
    arm_depth = np.empty((-(-size[0] // ARM_CELL), -(-size[1] // ARM_CELL)), np.float32)
    cells = intrinsics / np.float32(ARM_CELL)
    cells[2:] -= HALF
    for c in range(len(poses)):
        T = poses[c]
        _place(robot, configurations[c], HALF * edge, frames, arm)
        arm_depth[:] = np.inf
        render_depth(arm, cells, T, arm_depth)
        ox = (T[0, 3] - low[0]) / edge
        oy = (T[1, 3] - low[1]) / edge
        oz = (T[2, 3] - low[2]) / edge
        for n in range(len(voxels)):
            # the voxel's center, and the vector from it to the camera, in edges of voxels
            x = voxels[n, 0] + HALF
            y = voxels[n, 1] + HALF
            z = voxels[n, 2] + HALF
            dx = ox - x
            dy = oy - y
            dz = oz - z
            x_away, y_away, z_away = in_camera(T, dx, dy, dz)
            forward = -z_away
            if forward <= ONE or forward * edge > reach:
                continue
            u = -fx * x_away / forward + cx
            v = -fy * y_away / forward + cy
            if not (-HALF <= u < size[1] - HALF and -HALF <= v < size[0] - HALF):
                continue
            if arm_depth[int(v + HALF) // ARM_CELL, int(u + HALF) // ARM_CELL] < forward * edge:
                continue
            far = np.sqrt(dx * dx + dy * dy + dz * dz)
            dx = dx / far
            dy = dy / far
            dz = dz / far
            # walk from the voxel to the camera in steps of one voxel
            visible = ONE
            traveled = OCCLUSION_START
            while traveled < far and visible > MIN_VISIBILITY:
                i = int(np.floor(x + traveled * dx))
                j = int(np.floor(y + traveled * dy))
                k = int(np.floor(z + traveled * dz))
                if not (0 <= i < nx and 0 <= j < ny and 0 <= k < nz):
                    break
                visible *= ONE - filled[i, j, k]
                traveled += ONE
            out[c] += weights[n] * visible if visible > MIN_VISIBILITY else 0.0
    return out


def seen_share(
    robot: Robot,
    configurations: Configurations,
    poses: Float[ndarray, "n 4 4"],
    intrinsics: Intrinsics,
    size: tuple[int, ...],
    reach: float,
    voxels: Int[ndarray, "m 3"],
    weights: Float32[ndarray, "m"],
    filled: Probabilities,
    grid: VoxelGrid,
) -> Values:
    """The fraction of the voxels' total weight that a camera sees from each pose, with the arm at the
    configuration of the same row; the other arguments are those of `seen_weights`."""
    sums = seen_weights(
        compile_robot(robot),
        configurations.astype(np.float32),
        poses.astype(np.float32),
        np.array(intrinsics, np.float32),
        size,
        np.float32(reach),
        voxels,
        weights,
        filled,
        *grid.frame,
    )
    return sums / weights.sum()


@kernel(nogil=True)
def _place(robot, q, margin, frames, arm):
    """Writes the arm's covering spheres at a configuration, inflated by `margin`, to `arm`, whose rows have
    the form of those of `SceneArrays.solids`. frames: working memory."""
    frames_of(robot, q, frames)
    for g in range(len(robot.frame)):
        for s in range(robot.first[g], robot.first[g + 1]):
            arm[s, 0], arm[s, 1], arm[s, 2] = placed_point(frames[robot.frame[g]], robot.spheres[s])
            arm[s, 15] = robot.spheres[s, 3] + margin


MAX_LOST_FRACTION = 0.2
"""Largest fraction of a ball's pixels without a return."""


@kernel(nogil=True)
def see_through(depth, intrinsics, T, balls, radius, errors, border, seen):
    """Mark the balls that are empty in an image: the projection of the ball is inside the image, and all
    returns of its pixels are behind the ball. A few of these pixels may have no return.

    depth: float32[h, w]. Where nothing is in range it is infinite; without a return it is 0, or -d if it is
    known that nothing is nearer than d. intrinsics: fx, fy, cx, cy. T: T_base_camera [4, 4]. balls: centers
    [n, 3] [m]. radius: of all balls [m]. errors: three numbers: the radius grows by the first [m] plus the
    second [rad] times the distance; returns must be behind the ball by the third [1/m] times the square of
    the distance. border: width of the margin around the projection that is checked as well [pixels]. seen:
    bool[n]. All numbers are float32.
    """
    usable = usable_depth(depth, intrinsics[0])
    h, w = usable.shape
    fx, fy, cx, cy = intrinsics
    for n in range(len(balls)):
        if seen[n]:
            continue
        dx = balls[n, 0] - T[0, 3]
        dy = balls[n, 1] - T[1, 3]
        dz = balls[n, 2] - T[2, 3]
        x, y, z = in_camera(T, dx, dy, dz)
        grown = radius + errors[0] + errors[1] * z
        near = z - grown
        far = z + grown
        if near <= ZERO:
            continue
        u0 = np.floor(fx * (x - grown) / (near if x < grown else far) + cx) - border
        u1 = np.ceil(fx * (x + grown) / (near if x > -grown else far) + cx) + border
        v0 = np.floor(fy * (y - grown) / (near if y < grown else far) + cy) - border
        v1 = np.ceil(fy * (y + grown) / (near if y > -grown else far) + cy) + border
        if u0 < ZERO or v0 < ZERO or u1 > np.float32(w - 1) or v1 > np.float32(h - 1):
            continue
        # at most MAX_DEPTH / 2: pixels with nothing in range have the depth MAX_DEPTH, behind every ball
        min_return = min(far + errors[2] * far * far, MAX_DEPTH * HALF)
        seen[n] = _all_behind(usable, int(v0), int(v1), int(u0), int(u1), min_return)


@kernel(nogil=True)
def _all_behind(depth, v0, v1, u0, u1, min_return):
    """Whether all returns in a rectangle of pixels, with inclusive bounds, are deeper than `min_return` [m],
    and at most MAX_LOST_FRACTION of the pixels say nothing about this depth."""
    lost = 0
    max_lost = MAX_LOST_FRACTION * (v1 + 1 - v0) * (u1 + 1 - u0)
    for v in range(v0, v1 + 1):
        for u in range(u0, u1 + 1):
            if abs(depth[v, u]) > min_return:
                continue
            lost += 1
            if depth[v, u] > ZERO or lost > max_lost:
                return False
    return True


def within_voxels(balls: Points, radius: float, marked: Voxels, grid: VoxelGrid) -> Mask:
    """Which balls lie entirely in marked voxels of the grid. radius: at most half a voxel's edge [m]."""
    corners = balls[:, None] + list(product((-radius, radius), repeat=3))
    return np.asarray(grid.hold(marked, corners.reshape(-1, 3)).reshape(-1, 8).all(axis=1))


# Edge of the grid cells by which surface samples are merged; largest distance of a surface point from the
# nearest sample [m].
BALL_CELL = 0.005
SAMPLE_DISTANCE = 0.0012
BALL_RADIUS = BALL_CELL * 3**0.5 / 2 + SAMPLE_DISTANCE
"""Radius of a ball around a cell's center that covers the samples in the cell and the surface near them
[m]."""


def surface_balls(robot: Robot, q: Configuration) -> Points:
    """Centers of balls of BALL_RADIUS that cover the surfaces of the moving links and of the objects that
    they hold, at a configuration, in the base frame [m]."""
    frames = forward_frames(robot, q)
    return np.concatenate(list(map(placed, frames, _balls_by_frame(robot)))).astype(np.float32)


@once_per_robot
def _balls_by_frame(robot: Robot) -> list[Points]:
    """The balls' centers for each frame, in coordinates of the frame; empty for the base."""
    parts = [part for of_link in parts_of(robot).values() for part in of_link]
    out = [np.zeros((0, 3)) for _ in range(robot.dof + 1)]
    for frame in range(1, robot.dof + 1):
        of_frame = [part for part in parts if part.frame == frame]
        if of_frame:
            cells = np.floor(np.concatenate([_samples(part) for part in of_frame]) / BALL_CELL)
            out[frame] = (np.unique(cells, axis=0) + 0.5) * BALL_CELL
    return out


def _samples(part: Part) -> Points:
    """Points such that each point of the part's surface is within SAMPLE_DISTANCE of one of them."""
    if not len(part.faces):
        return _sphere(part.center, part.radius)
    return np.concatenate([_triangle(part.vertices[face]) for face in part.faces])


def _triangle(corners: Float[ndarray, "3 3"]) -> Points:
    longest = max(np.linalg.norm(corners[i] - corners[i - 1]) for i in range(3))
    count = int(np.ceil(longest / (SAMPLE_DISTANCE * 3**0.5))) + 1
    i, j = np.divmod(np.arange((count + 1) ** 2), count + 1)
    weights = np.stack([i, j, count - i - j], axis=1)[i + j <= count] / count
    return weights @ corners


def _sphere(center: Vector, radius: float) -> Points:
    """Points on a sphere, along a spiral, about SAMPLE_DISTANCE apart."""
    count = max(int(4 * np.pi * (radius / SAMPLE_DISTANCE) ** 2), 1)
    z = 1 - (2 * np.arange(count) + 1) / count
    angle = np.pi * (1 + 5**0.5) * np.arange(count)
    around = np.sqrt(1 - z * z)
    return center + radius * np.stack([around * np.cos(angle), around * np.sin(angle), z], axis=1)
