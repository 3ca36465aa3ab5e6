"""Which voxels a camera would see through voxels that may be occupied, in compiled code."""

import numpy as np
from numba import njit

OCCLUSION_START = np.float32(2.0)
"""Voxels nearer to a voxel than this do not hide it, in edges: its neighbours are as unknown as it is."""
MIN_VISIBILITY = np.float32(0.02)
"""Smaller probabilities of seeing through count as zero."""


@njit(cache=True, nogil=True)
def seen_weights(poses, intrinsics, size, voxels, weights, filled, low, edge):
    """For each camera the sum of the weights of the voxels, each times the probability that the camera sees
    it.

    poses [m, 4, 4]: T_base_camera; intrinsics fx, fy, cx, cy; size: height and width of the image; voxels
    int64[n, 3]; weights [n]; filled [nx, ny, nz]: the probability that a voxel hides what is behind; low
    corner of the grid and edge of a voxel [m].
    """
    fx, fy, cx, cy = intrinsics
    half, one = np.float32(0.5), np.float32(1.0)
    nx, ny, nz = filled.shape
    out = np.zeros(len(poses))
    for c in range(len(poses)):
        T = poses[c]
        ox, oy, oz = (T[0, 3] - low[0]) / edge, (T[1, 3] - low[1]) / edge, (T[2, 3] - low[2]) / edge
        for n in range(len(voxels)):
            x, y, z = voxels[n, 0] + half, voxels[n, 1] + half, voxels[n, 2] + half
            dx, dy, dz = ox - x, oy - y, oz - z
            ahead = -(T[0, 2] * dx + T[1, 2] * dy + T[2, 2] * dz)
            if ahead <= one:
                continue
            u = -fx * (T[0, 0] * dx + T[1, 0] * dy + T[2, 0] * dz) / ahead + cx
            v = -fy * (T[0, 1] * dx + T[1, 1] * dy + T[2, 1] * dz) / ahead + cy
            if not (-half <= u < size[1] - half and -half <= v < size[0] - half):
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
