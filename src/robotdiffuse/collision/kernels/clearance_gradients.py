"""Compiled clearances of links, with the gradient of the arm's violation of a margin to obstacles."""

import numpy as np

from robotdiffuse.collision.kernels.collision_cost import cost_gradient_at, make_cost_workspace
from robotdiffuse.collision.kernels.lane_clearance import (
    clearances_into,
    count_obstacles,
    make_clearance_workspace,
)
from robotdiffuse.core.kernels import inner_kernel, kernel


@inner_kernel()
def clearances_and_gradients_into(robot, scene, q, limit, margin, work, clearances, gradients):
    """Writes clearances[n, groups] of the moving groups and gradients[n, dof] for the rows of q[n, dof].

    The gradients are those of sqrt(2 cost), with the cost of `cost_gradient_at` towards the scene alone: the
    root of the sum of h^2 over the spheres with h = max(0, S - D), S being the margin and D the signed
    distance. Because of the root, gradients have the size of a sphere's distance from the joint axes, from
    the edge of the margin to deep inside an obstacle. Gradients of the cost itself vary by a factor of a
    thousand.
    """
    clearances_into(robot, scene, q, limit, work, clearances)
    scratch = make_cost_workspace(q.shape[1])
    pairs = np.zeros(len(robot.pairs), np.float32)  # with a self margin of 0 they cost nothing
    gradients[:] = np.float32(0.0)
    for i in range(len(q)):
        if clearances[i].min() < margin:
            cost = cost_gradient_at(robot, scene, q[i], pairs, margin, np.float32(0.0), scratch, gradients[i])
            if cost > np.float32(0.0):
                gradients[i] /= np.sqrt(np.float32(2.0) * cost)


@kernel(nogil=True)
def clearances_and_gradients(robot, scene, q, limit, margin):
    """Clearances [n, moving groups] to the scene, at most `limit`, and gradients [n, dof]; see
    `clearances_and_gradients_into`."""
    moving = len(robot.frame) - np.searchsorted(robot.frame, 1)
    clearances, gradients = np.empty((len(q), moving), np.float32), np.empty(q.shape, np.float32)
    work = make_clearance_workspace(robot, count_obstacles(scene))
    clearances_and_gradients_into(robot, scene, q, limit, margin, work, clearances, gradients)
    return clearances, gradients
