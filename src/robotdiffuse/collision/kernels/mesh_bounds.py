"""Compiled lower bounds of distances between meshes, by the balls around them and the boxes around
obstacles."""

import numpy as np
from numba import njit

from robotdiffuse.collision.kernels.compiled import parent_of
from robotdiffuse.collision.kernels.frames import placed, point_to_box, step


@njit(cache=True)
def forward(offsets, parents, slides, q):
    """T_base_frame [n, dof + 1, 4, 4] of q[n, dof], in float64; offsets[dof, 4, 4], parents[dof] or None of a
    chain, slides[dof]."""
    n, dof = q.shape
    frames = np.zeros((n, dof + 1, 4, 4))
    for i in range(n):
        for k in range(4):
            frames[i, 0, k, k] = 1.0
        for j in range(dof):
            frames[i, j + 1, 3, 3] = 1.0
            step(frames[i, parent_of(parents, j)], offsets[j], slides[j], q[i, j], frames[i, j + 1])
    return frames


@njit(cache=True)
def scene_bounds(frames, frame, centers, radii, boxes):
    """[n, pieces * obstacles] for pieces of a link, balls in its frame, and `boxes`: R_box_base [o, 3, 3],
    centres [o, 3], half sizes [o, 3] and roundings [o]."""
    rotation, middle, half, rounding = boxes
    obstacles = len(middle)
    out = np.empty((len(frames), len(radii) * obstacles))
    for i in range(len(frames)):
        T = frames[i, frame]
        for p in range(len(radii)):
            x, y, z = placed(T, centers[p], 0), placed(T, centers[p], 1), placed(T, centers[p], 2)
            for o in range(obstacles):
                gap = point_to_box(x, y, z, rotation[o], middle[o], half[o], 0.0)
                out[i, p * obstacles + o] = gap - rounding[o] - radii[p]
    return out


@njit(cache=True)
def pair_bounds(frames, frame, centers, radii, other_frame, other_centers, other_radii):
    """[n, pieces * others] for pieces of two links."""
    others = len(other_radii)
    out = np.empty((len(frames), len(radii) * others))
    for i in range(len(frames)):
        S, T = frames[i, frame], frames[i, other_frame]
        for p in range(len(radii)):
            x, y, z = placed(S, centers[p], 0), placed(S, centers[p], 1), placed(S, centers[p], 2)
            for o in range(others):
                c = other_centers[o]
                u, v, w = x - placed(T, c, 0), y - placed(T, c, 1), z - placed(T, c, 2)
                gap = np.sqrt(u * u + v * v + w * w)
                out[i, p * others + o] = gap - radii[p] - other_radii[o]
    return out
