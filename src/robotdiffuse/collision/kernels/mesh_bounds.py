"""Compiled lower bounds of distances between meshes, by the balls around them and the boxes around
obstacles."""

import numpy as np
from numba import njit


@njit(cache=True)
def forward(offsets, slides, q):
    """T_base_frame [n, dof + 1, 4, 4] of q[n, dof], in float64; offsets[dof, 4, 4], slides[dof]."""
    n, dof = q.shape
    frames = np.zeros((n, dof + 1, 4, 4))
    for i in range(n):
        for k in range(4):
            frames[i, 0, k, k] = 1.0
        for j in range(dof):
            parent, child, offset = frames[i, j], frames[i, j + 1], offsets[j]
            c, s, slide = (1.0, 0.0, q[i, j]) if slides[j] else (np.cos(q[i, j]), np.sin(q[i, j]), 0.0)
            child[3, 3] = 1.0
            for r in range(3):
                x = parent[r, 0] * offset[0, 0] + parent[r, 1] * offset[1, 0] + parent[r, 2] * offset[2, 0]
                y = parent[r, 0] * offset[0, 1] + parent[r, 1] * offset[1, 1] + parent[r, 2] * offset[2, 1]
                z = parent[r, 0] * offset[0, 2] + parent[r, 1] * offset[1, 2] + parent[r, 2] * offset[2, 2]
                t = parent[r, 0] * offset[0, 3] + parent[r, 1] * offset[1, 3] + parent[r, 2] * offset[2, 3]
                child[r, 0], child[r, 1], child[r, 2] = x * c + y * s, y * c - x * s, z
                child[r, 3] = t + parent[r, 3] + z * slide
    return frames


@njit(cache=True)
def _placed(T, center, out):
    for r in range(3):
        out[r] = T[r, 0] * center[0] + T[r, 1] * center[1] + T[r, 2] * center[2] + T[r, 3]


@njit(cache=True)
def scene_bounds(frames, frame, centers, radii, boxes):
    """[n, pieces * obstacles] for pieces of a link, balls in its frame, and `boxes`: R_box_base [o, 3, 3],
    centres [o, 3], half sizes [o, 3] and roundings [o]."""
    rotation, middle, half, rounding = boxes
    obstacles = len(middle)
    out, at = np.empty((len(frames), len(radii) * obstacles)), np.empty(3)
    for i in range(len(frames)):
        for p in range(len(radii)):
            _placed(frames[i, frame], centers[p], at)
            for o in range(obstacles):
                outside, deepest = 0.0, -np.inf
                for r in range(3):
                    x = 0.0
                    for c in range(3):
                        x += rotation[o, r, c] * (at[c] - middle[o, c])
                    x = abs(x) - half[o, r]
                    outside += max(x, 0.0) ** 2
                    deepest = max(deepest, x)
                out[i, p * obstacles + o] = np.sqrt(outside) + min(deepest, 0.0) - rounding[o] - radii[p]
    return out


@njit(cache=True)
def pair_bounds(frames, frame, centers, radii, other_frame, other_centers, other_radii):
    """[n, pieces * others] for pieces of two links."""
    others = len(other_radii)
    out, a, b = np.empty((len(frames), len(radii) * others)), np.empty(3), np.empty(3)
    for i in range(len(frames)):
        for p in range(len(radii)):
            _placed(frames[i, frame], centers[p], a)
            for o in range(others):
                _placed(frames[i, other_frame], other_centers[o], b)
                gap = np.sqrt((a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 + (a[2] - b[2]) ** 2)
                out[i, p * others + o] = gap - radii[p] - other_radii[o]
    return out
