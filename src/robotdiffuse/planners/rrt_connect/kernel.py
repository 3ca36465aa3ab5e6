"""Compiled RRT-Connect over the collision kernel.

J. Kuffner and S. LaValle, "RRT-Connect: An efficient approach to single-query path planning", ICRA 2000;
balanced trees as in J. Kuffner and S. LaValle, "An efficient approach to path planning using balanced
bidirectional RRT search", 2005.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from robotdiffuse.collision.kernels.compiled import allocation_free, random
from robotdiffuse.collision.kernels.lanes import W, make_workspace
from robotdiffuse.collision.kernels.motions import distance, motion_free

_ONE = np.float32(1.0)


class Trees(NamedTuple):
    """Two trees, from the start and from the goals; filled in place, so that a search can go on."""

    nodes: np.ndarray
    """[2, capacity, dof]"""
    parents: np.ndarray
    """[2, capacity] -1 for roots."""
    sizes: np.ndarray
    """[2]"""


@allocation_free(fastmath=True)
def _nearest(nodes, tree, size, q):
    best, where = np.float32(np.inf), 0
    dof = len(q)
    for n in range(size):
        total = np.float32(0.0)
        for j in range(dof):
            d = nodes[tree, n, j] - q[j]
            total += d * d
        if total < best:
            best, where = total, n
    return where


@njit(cache=True)
def make_trees(start, goals, capacity):
    """Trees with the start and the goals as their roots."""
    nodes = np.empty((2, capacity, len(start)), np.float32)
    parents = np.full((2, capacity), -1, np.int32)
    nodes[0, 0] = start
    for g in range(len(goals)):
        nodes[1, g] = goals[g]
    return Trees(nodes, parents, np.array([1, len(goals)], np.int32))


@njit(cache=True, nogil=True)
def search(space, trees, reach, iterations, state):
    """RRT-Connect for a number of iterations; `reach` is the longest extension [rad].

    Returns the waypoints [n, dof] from the start to a goal, with n = 0 if none was found yet. Stops early
    when a tree is full.
    """
    nodes, parents, sizes = trees
    dof = nodes.shape[2]
    work, block = make_workspace(space.robot, space.scene), np.empty((dof, W), np.float32)
    target, new = np.empty(dof, np.float32), np.empty(dof, np.float32)
    for _ in range(iterations):
        tree = 0 if sizes[0] <= sizes[1] else 1
        if sizes[tree] >= nodes.shape[1] or sizes[1 - tree] >= nodes.shape[1]:
            break
        for j in range(dof):
            target[j] = space.lower[j] + random(state) * (space.upper[j] - space.lower[j])
        near = _nearest(nodes, tree, sizes[tree], target)
        gap = distance(nodes[tree, near], target)
        share = min(reach / max(gap, np.float32(1e-6)), _ONE)
        for j in range(dof):
            new[j] = nodes[tree, near, j] + share * (target[j] - nodes[tree, near, j])
        if not motion_free(space, nodes[tree, near], new, block, work):
            continue
        here = sizes[tree]
        nodes[tree, here], parents[tree, here] = new, near
        sizes[tree] += 1
        other = 1 - tree
        near = _nearest(nodes, other, sizes[other], new)
        while sizes[other] < nodes.shape[1]:
            gap = distance(nodes[other, near], new)
            last = gap <= reach
            share = _ONE if last else reach / gap
            for j in range(dof):
                target[j] = nodes[other, near, j] + share * (new[j] - nodes[other, near, j])
            if not motion_free(space, nodes[other, near], target, block, work):
                break
            if last:
                return _join(nodes, parents, tree, here, near)
            nodes[other, sizes[other]], parents[other, sizes[other]] = target, near
            near = sizes[other]
            sizes[other] += 1
    return np.empty((0, dof), np.float32)


@njit(cache=True)
def _join(nodes, parents, tree, here, near):
    a, b = (here, near) if tree == 0 else (near, here)
    count = 0
    for side, node in ((0, a), (1, b)):
        while node >= 0:
            node = parents[side, node]
            count += 1
    path = np.empty((count, nodes.shape[2]), np.float32)
    count, node = 0, a
    while node >= 0:
        count += 1
        node = parents[0, node]
    node = a
    for i in range(count - 1, -1, -1):
        path[i] = nodes[0, node]
        node = parents[0, node]
    node = b
    while node >= 0:
        path[count] = nodes[1, node]
        count += 1
        node = parents[1, node]
    return path
