"""The compiled part of Shared-Tree Informed RRT*: one tree from the start, searched towards many goals.

`space` is a `collision.kernels.motions.Space`.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from robotdiffuse.collision.kernels.compiled import allocation_free, random
from robotdiffuse.collision.kernels.lanes import W, make_workspace
from robotdiffuse.collision.kernels.motions import distance, motion_free, path_length
from robotdiffuse.planners.shared_tree import kd_tree

_ZERO, _ONE, _HALF = np.float32(0.0), np.float32(1.0), np.float32(0.5)
_INFINITY = np.float32(np.inf)
NEIGHBOURS = 64
"""Most near neighbours that are looked at; e (1 + 1 / dof) ln n is below it up to 10^8 nodes of 7 joints."""
GAIN = np.float32(1e-4)
"""Costs must fall by more than this share to count: less is rounding."""
PESSIMISM = np.float32(0.5)
"""Share of a goal's present excess over the straight line that is taken to remain."""
LEAST_PROMISE = np.float32(0.03)
"""So that no goal that might still win is left out for ever."""
DRAWS = 32
"""Draws from a hyperspheroid before a sample outside the joint limits is clamped to them."""


class Tree(NamedTuple):
    """The shared tree; node 0 is the start. Filled in place."""

    nodes: np.ndarray
    """[capacity, dof]"""
    parent: np.ndarray
    """[capacity] -1 for the root."""
    child: np.ndarray
    """[capacity] first child, -1 for none."""
    sibling: np.ndarray
    """[capacity] next child of the same parent, -1 for the last."""
    cost: np.ndarray
    """[capacity] length of the way from the start [rad]."""
    size: np.ndarray
    """[1]"""
    near: kd_tree.KdTree
    goals: np.ndarray
    """[k, dof]"""
    goal_node: np.ndarray
    """[k] the goal's node, -1 until it is reached."""
    bound: np.ndarray
    """[k] the straight distance from the start: no path to the goal is shorter [rad]."""
    failures: np.ndarray
    """[k] searches for this goal alone that found no path."""


@njit(cache=True)
def make_tree(start, goals, capacity):
    """A tree of the start alone."""
    k, dof = goals.shape
    nodes = np.empty((capacity, dof), np.float32)
    nodes[0] = start
    bound = np.empty(k, np.float32)
    for g in range(k):
        bound[g] = distance(start, goals[g])
    tree = Tree(
        nodes,
        np.full(capacity, -1, np.int32),
        np.full(capacity, -1, np.int32),
        np.full(capacity, -1, np.int32),
        np.zeros(capacity, np.float32),
        np.ones(1, np.int32),
        kd_tree.make_kd_tree(capacity),
        goals.copy(),
        np.full(k, -1, np.int32),
        bound,
        np.zeros(k, np.float32),
    )
    kd_tree.insert(tree.near, nodes, 0)
    return tree


@njit(cache=True)
def grown(tree, capacity):
    """A copy of the tree with more room."""
    wider = make_tree(tree.nodes[0], tree.goals, capacity)
    n = tree.size[0]
    wider.nodes[:n], wider.parent[:n], wider.child[:n] = tree.nodes[:n], tree.parent[:n], tree.child[:n]
    wider.sibling[:n], wider.cost[:n], wider.size[0] = tree.sibling[:n], tree.cost[:n], n
    wider.goal_node[:], wider.failures[:] = tree.goal_node, tree.failures
    for i in range(1, n):
        kd_tree.insert(wider.near, wider.nodes, i)
    return wider


@allocation_free()
def goal_cost(tree, g):
    """The length of the best path known to a goal [rad], infinite if there is none."""
    node = tree.goal_node[g]
    return tree.cost[node] if node >= 0 else _INFINITY


@allocation_free()
def best_goal(tree):
    """The goal with the cheapest path; -1 if none is reached."""
    best, where = _INFINITY, -1
    for g in range(len(tree.goals)):
        cost = goal_cost(tree, g)
        if cost < best:
            best, where = cost, g
    return where


@allocation_free()
def best_cost(tree):
    g = best_goal(tree)
    return goal_cost(tree, g) if g >= 0 else _INFINITY


@allocation_free()
def goal_is_open(tree, g, best):
    """Whether a path to the goal might still be shorter than the best one to any goal."""
    return tree.bound[g] < best * (_ONE - GAIN) and tree.bound[g] < goal_cost(tree, g) * (_ONE - GAIN)


@allocation_free()
def draw_goal(tree, state):
    """A goal drawn by its promise; -1 if no path can be shortened.

    Promise: by how much the best path would fall if the goal's own path lost its hoped-for share of the
    excess over the straight line; while no goal is reached, nearness. Searches for the goal alone that found
    nothing lower it.
    """
    best = best_cost(tree)
    total, chosen = _ZERO, -1
    for g in range(len(tree.goals)):
        if not goal_is_open(tree, g, best):
            continue
        if best < _INFINITY:
            cost = min(goal_cost(tree, g), np.float32(1.5) * best)
            hope = best - tree.bound[g] - PESSIMISM * (cost - tree.bound[g])
            promise = max(hope / best, _ZERO) + LEAST_PROMISE
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


@allocation_free()
def sample_hyperspheroid(a, b, length, lower, upper, state, out):
    """Uniform among the points through which a path from a to b can be shorter than `length`.

    J. Gammell, S. Srinivasa and T. Barfoot, "Informed RRT*", IROS 2014: a ball, stretched, and turned here by
    a Householder reflection onto the axis of the foci.
    """
    dof = len(a)
    gap = distance(a, b)
    axis = _HALF * length
    radius = _HALF * np.sqrt(max(length * length - gap * gap, _ZERO))
    for _ in range(DRAWS):
        norm = _ZERO
        for j in range(dof):
            out[j] = _gaussian(state)
            norm += out[j] * out[j]
        scale = random(state) ** np.float32(_ONE / np.float32(dof)) / np.sqrt(max(norm, np.float32(1e-12)))
        out[0] *= scale * axis
        for j in range(1, dof):
            out[j] *= scale * radius
        if gap > np.float32(1e-6):
            # the reflection that swaps the first axis and the direction from a to b
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
def _append(tree, q, parent, cost):
    node = tree.size[0]
    for j in range(len(q)):
        tree.nodes[node, j] = q[j]
    tree.parent[node], tree.cost[node], tree.child[node] = parent, cost, -1
    tree.sibling[node] = tree.child[parent]
    tree.child[parent] = node
    tree.size[0] = node + 1
    kd_tree.insert(tree.near, tree.nodes, node)
    return node


@allocation_free()
def _rewire(tree, node, parent, cost):
    """Hang a node, and all that grows from it, under another parent."""
    old = tree.parent[node]
    if tree.child[old] == node:
        tree.child[old] = tree.sibling[node]
    else:
        before = tree.child[old]
        while tree.sibling[before] != node:
            before = tree.sibling[before]
        tree.sibling[before] = tree.sibling[node]
    tree.parent[node] = parent
    tree.sibling[node] = tree.child[parent]
    tree.child[parent] = node
    gain = tree.cost[node] - cost
    tree.cost[node] = cost
    # all descendants, in depth-first order without a stack
    at = tree.child[node]
    while at >= 0:
        tree.cost[at] -= gain
        if tree.child[at] >= 0:
            at = tree.child[at]
            continue
        while at != node and tree.sibling[at] < 0:
            at = tree.parent[at]
        if at == node:
            break
        at = tree.sibling[at]


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


@njit(cache=True)
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
    node = _append(tree, q, parent, cost)
    for i in range(count):
        gap = near.distance[i]
        other = near.index[i]
        if gap < _ZERO or other == parent:
            continue
        if cost + gap < tree.cost[other] * (_ONE - GAIN) and motion_free(
            space, q, tree.nodes[other], scratch.block, scratch.work
        ):
            _rewire(tree, other, node, cost + gap)
    return node


@allocation_free()
def _try_goals(space, tree, node, drawn, reach, scratch):
    """Join the goals that the node reaches more cheaply: the drawn one, and those within reach."""
    for g in range(len(tree.goals)):
        gap = distance(tree.nodes[node], tree.goals[g])
        if (g != drawn and gap > reach) or tree.size[0] >= len(tree.nodes):
            continue
        cost = tree.cost[node] + gap
        # a goal that cannot beat the best one still gets its own first path
        if cost >= goal_cost(tree, g) * (_ONE - GAIN):
            continue
        if not motion_free(space, tree.nodes[node], tree.goals[g], scratch.block, scratch.work):
            continue
        if tree.goal_node[g] < 0:
            tree.goal_node[g] = _append(tree, tree.goals[g], node, cost)
        else:
            _rewire(tree, tree.goal_node[g], node, cost)


@njit(cache=True, nogil=True)
def grow(space, tree, reach, goal_bias, iterations, state):
    """RRT* iterations; returns how many were done: fewer when the tree is full or no path can be shortened.

    `reach` is the longest extension [rad], `goal_bias` the share of samples at a goal not yet reached.
    """
    return _grow(space, tree, reach, goal_bias, iterations, state, make_scratch(space, tree.nodes.shape[1]))


@allocation_free()
def _grow(space, tree, reach, goal_bias, iterations, state, scratch):
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
        share = min(reach / max(gap, np.float32(1e-6)), _ONE)
        for j in range(dof):
            new[j] = tree.nodes[nearest, j] + share * (sample[j] - tree.nodes[nearest, j])
        node = add_node(space, tree, new, scratch)
        if node >= 0:
            _try_goals(space, tree, node, g, reach, scratch)
    return iterations


@njit(cache=True)
def path_to(tree, g):
    """Waypoints [n, dof] of the best path to a goal; n = 0 if it is not reached."""
    count, node = 0, tree.goal_node[g]
    while node >= 0:
        count += 1
        node = tree.parent[node]
    path = np.empty((count, tree.nodes.shape[1]), np.float32)
    node = tree.goal_node[g]
    for i in range(count - 1, -1, -1):
        path[i] = tree.nodes[node]
        node = tree.parent[node]
    return path


@njit(cache=True)
def graft(tree, path, g):
    """Add a free path from the start to a goal as a branch, if it is the shortest known; whether it was."""
    cost = path_length(path)
    if cost >= goal_cost(tree, g) * (_ONE - GAIN) or tree.size[0] + len(path) >= len(tree.nodes):
        return False
    node, cost = 0, _ZERO
    for i in range(1, len(path) - 1):
        cost += distance(path[i - 1], path[i])
        node = _append(tree, path[i], node, cost)
    cost += distance(path[len(path) - 2], path[len(path) - 1])
    if tree.goal_node[g] < 0:
        tree.goal_node[g] = _append(tree, tree.goals[g], node, cost)
    else:
        _rewire(tree, tree.goal_node[g], node, cost)
    return True
