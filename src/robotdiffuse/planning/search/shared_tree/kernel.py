"""The search of Shared-Tree Informed RRT*, compiled: one tree from the start, grown towards many goals.

`space` is a `collision.kernels.motions.Space`.
"""

from typing import NamedTuple

import numpy as np

from robotdiffuse.collision.kernels.compiled import random
from robotdiffuse.collision.kernels.lane_collision import W, make_workspace
from robotdiffuse.collision.kernels.motions import distance, motion_free
from robotdiffuse.core.kernels import allocation_free, inner_kernel, kernel
from robotdiffuse.planning.search.shared_tree import kd_tree
from robotdiffuse.planning.search.shared_tree.tree import (
    GAIN,
    append,
    best_cost,
    goal_cost,
    goal_is_open,
    rewire,
)

_ZERO, _ONE, _HALF = np.float32(0.0), np.float32(1.0), np.float32(0.5)
_INFINITY = np.float32(np.inf)
NEIGHBOURS = 64
"""Largest number of near neighbours; e (1 + 1 / dof) ln n is below it up to 10^8 nodes of 7 joints."""
REMAINING_EXCESS = np.float32(0.5)
"""Part of a goal's present excess over the straight line that is expected to remain."""
MIN_PROMISE = np.float32(0.03)
"""Smallest promise of a goal that may still have the shortest path, so that none is left out forever."""
MAX_DRAWS = 32
"""Draws from a hyperspheroid before a sample outside the joint limits is clamped to them."""


@allocation_free(inner=False)
def draw_goal(tree, state):
    """Draw a goal by its promise; -1 if no path can be shortened.

    Promise: how much shorter the best path would get if the goal's own path lost the expected part of its
    excess over the straight line; while no goal is reached, its nearness. Failed searches for the goal alone
    lower it.
    """
    best = best_cost(tree)
    total, chosen = _ZERO, -1
    for g in range(len(tree.goals)):
        if not goal_is_open(tree, g, best):
            continue
        if best < _INFINITY:
            cost = min(goal_cost(tree, g), np.float32(1.5) * best)
            hope = best - tree.bound[g] - REMAINING_EXCESS * (cost - tree.bound[g])
            promise = max(hope / best, _ZERO) + MIN_PROMISE
        else:
            promise = _ONE / (tree.bound[g] * tree.bound[g] + np.float32(0.1))
        promise /= _ONE + tree.failures[g]
        total += promise
        # reservoir sampling: one pass and no array of promises
        if random(state) * total < promise:
            chosen = g
    return chosen


@allocation_free()
def _gaussian(state):
    """Box and Muller."""
    u = max(random(state), np.float32(1e-7))
    return np.sqrt(np.float32(-2.0) * np.log(u)) * np.cos(np.float32(2.0 * np.pi) * random(state))


@allocation_free(inner=False)
def sample_hyperspheroid(a, b, length, lower, upper, state, out):
    """Sample uniformly among the points through which a path from a to b can be shorter than `length`.

    J. Gammell, S. Srinivasa and T. Barfoot, "Informed RRT*", IROS 2014: a ball, stretched, and turned here by
    a Householder reflection onto the axis of the foci.
    """
    dof = len(a)
    gap = distance(a, b)
    axis = _HALF * length
    radius = _HALF * np.sqrt(max(length * length - gap * gap, _ZERO))
    for _ in range(MAX_DRAWS):
        norm = _ZERO
        for j in range(dof):
            out[j] = _gaussian(state)
            norm += out[j] * out[j]
        scale = random(state) ** np.float32(_ONE / np.float32(dof)) / np.sqrt(max(norm, np.float32(1e-12)))
        out[0] *= scale * axis
        for j in range(1, dof):
            out[j] *= scale * radius
        if gap > np.float32(1e-6):
            # Householder reflection that swaps the first axis and the direction from a to b
            toward = (b[0] - a[0]) / gap
            square = np.float32(2.0) * (_ONE - toward)
            if square > np.float32(1e-9):
                along = (toward - _ONE) * out[0]
                for j in range(1, dof):
                    along += (b[j] - a[j]) / gap * out[j]
                along *= np.float32(2.0) / square
                out[0] -= along * (toward - _ONE)
                for j in range(1, dof):
                    out[j] -= along * (b[j] - a[j]) / gap
        inside = True
        for j in range(dof):
            out[j] += _HALF * (a[j] + b[j])
            inside &= lower[j] <= out[j] <= upper[j]
        if inside:
            return
    for j in range(dof):
        out[j] = min(max(out[j], lower[j]), upper[j])


@allocation_free()
def _draw(space, tree, g, goal_bias, state, out):
    """A sample for the goal: until it is reached sometimes the goal itself, else from its hyperspheroid."""
    dof = len(out)
    if tree.goal_node[g] < 0 and random(state) < goal_bias:
        for j in range(dof):
            out[j] = tree.goals[g, j]
        return
    length = min(goal_cost(tree, g), best_cost(tree))
    if length < _INFINITY:
        sample_hyperspheroid(tree.nodes[0], tree.goals[g], length, space.lower, space.upper, state, out)
        return
    for j in range(dof):
        out[j] = space.lower[j] + random(state) * (space.upper[j] - space.lower[j])


@allocation_free()
def _remaining(tree, q, best):
    """A lower bound of the way from q to any goal that may still improve."""
    least = _INFINITY
    for g in range(len(tree.goals)):
        if goal_is_open(tree, g, best):
            least = min(least, distance(q, tree.goals[g]))
    return least


class Scratch(NamedTuple):
    """Room that the search works in."""

    work: tuple
    block: np.ndarray
    sample: np.ndarray
    new: np.ndarray
    near: kd_tree.Neighbours


@inner_kernel()
def make_scratch(space, dof):
    return Scratch(
        make_workspace(space.robot, space.scene),
        np.empty((dof, W), np.float32),
        np.empty(dof, np.float32),
        np.empty(dof, np.float32),
        kd_tree.make_neighbours(NEIGHBOURS, dof),
    )


@allocation_free()
def _neighbour_count(size, dof):
    """k of k-nearest RRT*: S. Karaman and E. Frazzoli, IJRR 2011, e (1 + 1 / d) ln n."""
    k = int(np.ceil(np.e * (1.0 + 1.0 / dof) * np.log(size + 1.0)))
    return min(max(k, 1), NEIGHBOURS)


@allocation_free()
def add_node(space, tree, q, scratch):
    """RRT*'s extension to q: the cheapest free way from the near nodes; then those near nodes that q reaches
    more cheaply are hung under it. Returns the node; -1 if q is of no use or cannot be reached."""
    near, best = scratch.near, best_cost(tree)
    count = kd_tree.query(tree.near, tree.nodes, q, _neighbour_count(tree.size[0], len(q)), near)
    remaining = _remaining(tree, q, best)
    # parents in the order of cost: mostly the first is free; a negative distance marks those in collision
    parent, cost = -1, _INFINITY
    for i in range(count):
        near.distance[i] = np.sqrt(near.distance[i])
    while True:
        chosen, cost = -1, _INFINITY
        for i in range(count):
            if near.distance[i] >= _ZERO and tree.cost[near.index[i]] + near.distance[i] < cost:
                chosen, cost = i, tree.cost[near.index[i]] + near.distance[i]
        if chosen < 0 or cost + remaining >= best:
            return -1
        if near.distance[chosen] <= np.float32(1e-6):
            return -1  # a copy of a node
        if motion_free(space, tree.nodes[near.index[chosen]], q, scratch.block, scratch.work):
            parent = near.index[chosen]
            break
        near.distance[chosen] = -_ONE - near.distance[chosen]
    node = append(tree, q, parent, cost)
    for i in range(count):
        gap = near.distance[i]
        other = near.index[i]
        if gap < _ZERO or other == parent:
            continue
        if cost + gap < tree.cost[other] * (_ONE - GAIN) and motion_free(
            space, q, tree.nodes[other], scratch.block, scratch.work
        ):
            rewire(tree, other, node, cost + gap)
    return node


@allocation_free()
def _try_goals(space, tree, node, drawn, longest, scratch):
    """Join the goals that the node reaches more cheaply: the drawn one, and those nearby."""
    for g in range(len(tree.goals)):
        gap = distance(tree.nodes[node], tree.goals[g])
        if (g != drawn and gap > longest) or tree.size[0] >= len(tree.nodes):
            continue
        cost = tree.cost[node] + gap
        # a goal that cannot beat the best one still gets its own first path
        if cost >= goal_cost(tree, g) * (_ONE - GAIN):
            continue
        if not motion_free(space, tree.nodes[node], tree.goals[g], scratch.block, scratch.work):
            continue
        if tree.goal_node[g] < 0:
            tree.goal_node[g] = append(tree, tree.goals[g], node, cost)
        else:
            rewire(tree, tree.goal_node[g], node, cost)


@kernel(nogil=True)
def grow(space, tree, longest, goal_bias, iterations, state):
    """RRT* iterations; returns how many were done: fewer when the tree is full or no path can be shortened.

    `longest` bounds extensions [rad], `goal_bias` the share of samples at a goal not yet reached.
    """
    return _grow(space, tree, longest, goal_bias, iterations, state, make_scratch(space, tree.nodes.shape[1]))


@allocation_free()
def _grow(space, tree, longest, goal_bias, iterations, state, scratch):
    dof = tree.nodes.shape[1]
    sample, new = scratch.sample, scratch.new
    for done in range(iterations):
        if tree.size[0] + len(tree.goals) + 1 >= len(tree.nodes):
            return done
        g = draw_goal(tree, state)
        if g < 0:
            return done
        _draw(space, tree, g, goal_bias, state, sample)
        kd_tree.query(tree.near, tree.nodes, sample, 1, scratch.near)
        nearest = scratch.near.index[0]
        gap = np.sqrt(scratch.near.distance[0])
        share = min(longest / max(gap, np.float32(1e-6)), _ONE)
        for j in range(dof):
            new[j] = tree.nodes[nearest, j] + share * (sample[j] - tree.nodes[nearest, j])
        node = add_node(space, tree, new, scratch)
        if node >= 0:
            _try_goals(space, tree, node, g, longest, scratch)
    return iterations
