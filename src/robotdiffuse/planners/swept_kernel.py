"""Which voxels an arm sweeps, in compiled code."""

import numpy as np
from numba import njit

from robotdiffuse.collision.kernels.distance import frames_of, placed

STEP = np.float32(0.05)
"""Largest motion of a joint between two looks [rad], [m] where it slides."""


@njit(cache=True, nogil=True)
def sweep(robot, path, low, voxel, swept):
    """Mark the voxels whose centres a moving covering sphere passes over; `swept` is bool[nx, ny, nz].

    robot: RobotArrays; path float32[n, dof]; low [3] corner of the voxels and `voxel`, their edge [m].
    """
    dof = path.shape[1]
    frames, q = np.zeros((dof + 1, 12), np.float32), np.empty(dof, np.float32)
    for i in range(max(len(path) - 1, 1)):
        a, b = path[i], path[min(i + 1, len(path) - 1)]
        steps = max(int(np.ceil(np.abs(b - a).max() / STEP)), 1)
        for step in range(steps + 1):
            for j in range(dof):
                q[j] = a[j] + np.float32(step / steps) * (b[j] - a[j])
            frames_of(robot, q, frames)
            for g in range(len(robot.frame)):
                if robot.frame[g] == 0:
                    continue
                for s in range(robot.first[g], robot.first[g + 1]):
                    sphere = robot.spheres[s]
                    x, y, z = placed(frames[robot.frame[g]], sphere[0], sphere[1], sphere[2])
                    _mark(x, y, z, sphere[3], low, voxel, swept)


@njit(cache=True, nogil=True)
def mark(spheres, low, voxel, marked):
    """Mark the voxels whose centres are in one of the spheres [n, 4]."""
    for s in range(len(spheres)):
        _mark(spheres[s, 0], spheres[s, 1], spheres[s, 2], spheres[s, 3], low, voxel, marked)


@njit(cache=True, nogil=True)
def _mark(x, y, z, radius, low, voxel, marked):
    nx, ny, nz = marked.shape
    half = np.float32(0.5)
    x, y, z, r = (
        (x - low[0]) / voxel - half,
        (y - low[1]) / voxel - half,
        (z - low[2]) / voxel - half,
        radius / voxel,
    )
    for i in range(max(int(np.ceil(x - r)), 0), min(int(np.floor(x + r)), nx - 1) + 1):
        for j in range(max(int(np.ceil(y - r)), 0), min(int(np.floor(y + r)), ny - 1) + 1):
            rest = r * r - (i - x) ** 2 - (j - y) ** 2
            if rest < 0:
                continue
            reach = np.sqrt(rest)
            for k in range(max(int(np.ceil(z - reach)), 0), min(int(np.floor(z + reach)), nz - 1) + 1):
                marked[i, j, k] = True
