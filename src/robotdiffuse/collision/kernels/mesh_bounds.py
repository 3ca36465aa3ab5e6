"""Compiled lower bounds of the distances of link meshes to obstacles and to each other, from balls around the
meshes' pieces; and the frames of an arm."""

import numpy as np

from robotdiffuse.collision.kernels.frames import parent_of, point_to_solid
from robotdiffuse.core.kernels import kernel
from robotdiffuse.robots.frame_kernel import ball_gap, placed, step


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
def scene_bounds(frames, frame, balls, solids, check):
    """Lower bounds [n, balls * obstacles] of the distances of a link's convex pieces to obstacles [m],
    infinite for obstacles that the link may touch.

    The pieces are enclosed by balls [k, 4] in the frame `frame`. `solids` are `convex_bounds.Solids`, and
    `check` is the link's row of `may_touch`.
    """
    obstacles = len(solids.disc)
    out = np.empty((len(frames), len(balls) * obstacles))
    for i in range(len(frames)):
        for p in range(len(balls)):
            center = placed(frames[i, frame], balls[p])
            for o in range(obstacles):
                R, half = solids.rotation[o], solids.half[o]
                gap = point_to_solid(center, R, solids.middle[o], half, solids.disc[o]) - solids.rounding[o]
                allowed = len(solids.may_touch) and solids.may_touch[check, o]
                out[i, p * obstacles + o] = np.inf if allowed else gap - balls[p, 3]
    return out


@kernel()
def pair_bounds(frames, frame, balls, other_frame, other_balls):
    """Lower bounds [n, balls * others] of the distances between the convex pieces of two links [m]. Each
    piece is enclosed by a ball in the frame of its link."""
    columns = len(other_balls)
    out = np.empty((len(frames), len(balls) * columns))
    for i in range(len(frames)):
        for p in range(len(balls)):
            for o in range(columns):
                gap = ball_gap(frames[i, frame], balls[p], frames[i, other_frame], other_balls[o])
                out[i, p * columns + o] = gap
    return out
