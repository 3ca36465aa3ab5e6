"""Compiled lower bounds of distances between meshes, from balls around them and boxes around obstacles."""

import numpy as np

from robotdiffuse.collision.kernels.frames import parent_of, placed, point_to_box
from robotdiffuse.core.kernels import kernel
from robotdiffuse.robots.frame_kernel import step


@kernel()
def forward(offsets, parents, slides, q):
    """T_base_frame [n, dof + 1, 4, 4] at q[n, dof] in float64, from offsets[dof, 4, 4], parents[dof] (None
    for a chain) and slides[dof], which marks prismatic joints."""
    n, dof = q.shape
    frames = np.zeros((n, dof + 1, 4, 4))
    for i in range(n):
        for k in range(4):
            frames[i, 0, k, k] = 1.0
        for j in range(dof):
            frames[i, j + 1, 3, 3] = 1.0
            step(frames[i, parent_of(parents, j)], offsets[j], slides[j], q[i, j], frames[i, j + 1])
    return frames


@kernel()
def scene_bounds(frames, frame, centers, radii, boxes):
    """Lower bounds [n, pieces * obstacles] of the distances of a link's convex pieces to obstacles [m].

    The pieces are enclosed by balls in the frame `frame`, the obstacles by `boxes`: R_box_base [o, 3, 3],
    centers [o, 3], half edges [o, 3], and radii by which the boxes are inflated [o].
    """
    rotation, middle, half, rounding = boxes
    obstacles = len(middle)
    out = np.empty((len(frames), len(radii) * obstacles))
    for i in range(len(frames)):
        T = frames[i, frame]
        for p in range(len(radii)):
            x = placed(T, centers[p], 0)
            y = placed(T, centers[p], 1)
            z = placed(T, centers[p], 2)
            for o in range(obstacles):
                gap = point_to_box(x, y, z, rotation[o], middle[o], half[o], 0.0)
                out[i, p * obstacles + o] = gap - rounding[o] - radii[p]
    return out


@kernel()
def pair_bounds(frames, frame, centers, radii, other_frame, other_centers, other_radii):
    """Lower bounds [n, pieces * others] of the distances between the convex pieces of two links [m]. Each
    piece is enclosed by a ball in the frame of its link."""
    other_count = len(other_radii)
    out = np.empty((len(frames), len(radii) * other_count))
    for i in range(len(frames)):
        S = frames[i, frame]
        T = frames[i, other_frame]
        for p in range(len(radii)):
            x = placed(S, centers[p], 0)
            y = placed(S, centers[p], 1)
            z = placed(S, centers[p], 2)
            for o in range(other_count):
                c = other_centers[o]
                u = x - placed(T, c, 0)
                v = y - placed(T, c, 1)
                w = z - placed(T, c, 2)
                gap = np.sqrt(u * u + v * v + w * w)
                out[i, p * other_count + o] = gap - radii[p] - other_radii[o]
    return out
