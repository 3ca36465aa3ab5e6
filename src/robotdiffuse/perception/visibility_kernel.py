"""Which voxels a camera would see past an arm and through voxels that may be occupied, in compiled code."""

import numpy as np

from robotdiffuse.collision.kernels.distance import frames_of, placed
from robotdiffuse.core.kernels import kernel

OCCLUSION_START = np.float32(2.0)
"""Voxels nearer to a voxel than this do not hide it, in edges: its neighbours are as unknown as it is."""
MIN_VISIBILITY = np.float32(0.02)
"""Smaller probabilities of seeing through count as zero."""
CELL = 16
"""The arm hides cells of so many pixels by as many."""


@kernel(nogil=True)
def seen_weights(robot, configurations, poses, intrinsics, size, reach, voxels, weights, filled, low, edge):
    """For each camera the sum of the weights of the voxels, each times the probability that the camera sees
    it.

    robot: RobotArrays; configurations float32[m, dof]: of the arm when a camera looks; poses [m, 4, 4]:
    T_base_camera; intrinsics fx, fy, cx, cy; size: height and width of the image; reach: farther voxels are
    not seen [m]; voxels int64[n, 3]; weights [n]; filled [nx, ny, nz]: the probability that a voxel hides
    what is behind; low corner of the grid and edge of a voxel [m].
    """
    fx, fy, cx, cy = intrinsics
    half, one = np.float32(0.5), np.float32(1.0)
    nx, ny, nz = filled.shape
    out = np.zeros(len(poses))
    arm = np.empty((-(-size[0] // CELL), -(-size[1] // CELL)), np.float32)
    for c in range(len(poses)):
        T = poses[c]
        _arm_ahead(robot, configurations[c], T, intrinsics, half * edge, arm)
        ox, oy, oz = (T[0, 3] - low[0]) / edge, (T[1, 3] - low[1]) / edge, (T[2, 3] - low[2]) / edge
        for n in range(len(voxels)):
            x, y, z = voxels[n, 0] + half, voxels[n, 1] + half, voxels[n, 2] + half
            dx, dy, dz = ox - x, oy - y, oz - z
            ahead = -(T[0, 2] * dx + T[1, 2] * dy + T[2, 2] * dz)
            if ahead <= one or ahead * edge > reach:
                continue
            u = -fx * (T[0, 0] * dx + T[1, 0] * dy + T[2, 0] * dz) / ahead + cx
            v = -fy * (T[0, 1] * dx + T[1, 1] * dy + T[2, 1] * dz) / ahead + cy
            if not (-half <= u < size[1] - half and -half <= v < size[0] - half):
                continue
            if arm[int(v + half) // CELL, int(u + half) // CELL] < ahead * edge:
                continue
            far = np.sqrt(dx * dx + dy * dy + dz * dz)
            dx, dy, dz = dx / far, dy / far, dz / far
            chance, way = one, OCCLUSION_START
            while way < far and chance > MIN_VISIBILITY:
                i, j, k = (
                    int(np.floor(x + way * dx)),
                    int(np.floor(y + way * dy)),
                    int(np.floor(z + way * dz)),
                )
                if not (0 <= i < nx and 0 <= j < ny and 0 <= k < nz):
                    break
                chance *= one - filled[i, j, k]
                way += one
            out[c] += weights[n] * chance if chance > MIN_VISIBILITY else 0.0
    return out


@kernel(nogil=True)
def _arm_ahead(robot, q, T, intrinsics, margin, depth):
    """Set `depth` of each cell of an image to that of the arm's nearest covering sphere, inflated by
    `margin`, on the ray through the cell's middle [m]; infinite without one. Spheres around the camera are
    left out."""
    fx, fy, cx, cy = intrinsics
    depth[:] = np.inf
    frames = np.zeros((len(q) + 1, 12), np.float32)
    frames_of(robot, q, frames)
    for g in range(len(robot.frame)):
        for s in range(robot.first[g], robot.first[g + 1]):
            sphere = robot.spheres[s]
            x, y, z = placed(frames[robot.frame[g]], sphere[0], sphere[1], sphere[2])
            x, y, z, r = x - T[0, 3], y - T[1, 3], z - T[2, 3], sphere[3] + margin
            square = x * x + y * y + z * z - r * r
            u = T[0, 0] * x + T[1, 0] * y + T[2, 0] * z
            v = T[0, 1] * x + T[1, 1] * y + T[2, 1] * z
            w = T[0, 2] * x + T[1, 2] * y + T[2, 2] * z
            if square <= 0 or w <= -r:
                continue
            for i in range(len(depth)):
                b = ((i + np.float32(0.5)) * CELL - cy) / fy
                for j in range(depth.shape[1]):
                    a = ((j + np.float32(0.5)) * CELL - cx) / fx
                    along = a * u + b * v + w
                    if along > 0 and square * (a * a + b * b + np.float32(1.0)) < along * along:
                        depth[i, j] = min(depth[i, j], max(w - r, np.float32(0.0)))
