"""Compiled lower bounds of the distances of link meshes to obstacles and to each other, from balls around the
meshes' pieces; and the frames of an arm."""

import numpy as np

from robotdiffuse.collision.kernels.frames import gap_to_solid, pose_arm
from robotdiffuse.core.kernels import kernel
from robotdiffuse.robots.frame_kernel import ball_gap, placed


@kernel()
def forward(offsets, parents, slides, q):
    """T_base_frame [n, dof + 1, 4, 4] at q[n, dof] in float64, from offsets[dof, 4, 4], parents[dof] (None
    for a chain) and slides[dof], which marks prismatic joints."""
    n, dof = q.shape
    frames = np.zeros((n, dof + 1, 4, 4))
    frames[:, :, 3, 3] = 1.0
    for i in range(n):
        for k in range(3):
            frames[i, 0, k, k] = 1.0
        pose_arm(offsets, parents, slides, q[i], frames[i])
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
                gap = gap_to_solid(center, solids, o)
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
