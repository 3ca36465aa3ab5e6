"""Compiled clearances of links together with the gradient of how far the arm is too close to obstacles."""

import numpy as np
from numba import njit

from robotdiffuse.collision.kernels.collision_cost import cost_gradient_at, make_cost_workspace
from robotdiffuse.collision.kernels.lane_clearance import (
    clearances_into,
    count_obstacles,
    make_clearance_workspace,
)


@njit(cache=True)
def clearances_and_gradients_into(robot, scene, q, limit, margin, work, clearances, gradients):
    """For the rows of q[n, dof]: clearances[n, groups] of the moving groups, and gradients[n, dof].

    The gradients are those of sqrt(2 cost), the root of the sum of h^2 over the spheres with
    h = max(0, S - D), with the cost of `cost_gradient_at` towards the scene alone and S the margin. The root
    makes them of one size, that of a sphere's lever, from the first touch of the margin to deep in an
    obstacle; those of the cost itself differ by a thousandfold.
    """
    clearances_into(robot, scene, q, limit, work, clearances)
    scratch = make_cost_workspace(q.shape[1])
    pairs = np.zeros(len(robot.pairs), np.float32)  # at a margin of 0: no cost
    gradients[:] = np.float32(0.0)
    for i in range(len(q)):
        if clearances[i].min() < margin:
            cost = cost_gradient_at(robot, scene, q[i], pairs, margin, np.float32(0.0), scratch, gradients[i])
            if cost > np.float32(0.0):
                gradients[i] /= np.sqrt(np.float32(2.0) * cost)


@njit(cache=True, nogil=True)
def clearances_and_gradients(robot, scene, q, limit, margin):
    """[n, moving groups] clearances to the scene, at most `limit`, and [n, dof] gradients; see above."""
    moving = len(robot.frame) - np.searchsorted(robot.frame, 1)
    clearances, gradients = np.empty((len(q), moving), np.float32), np.empty(q.shape, np.float32)
    work = make_clearance_workspace(robot, count_obstacles(scene))
    clearances_and_gradients_into(robot, scene, q, limit, margin, work, clearances, gradients)
    return clearances, gradients
