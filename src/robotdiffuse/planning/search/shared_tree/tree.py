"""The tree of Shared-Tree Informed RRT*, compiled: nodes, their costs, the best path to each goal."""

from typing import NamedTuple

import numpy as np

from robotdiffuse.collision.kernels.motions import distance, path_length
from robotdiffuse.core.kernels import allocation_free, kernel
from robotdiffuse.planning.search.shared_tree import kd_tree

_ZERO, _ONE = np.float32(0.0), np.float32(1.0)
_INFINITY = np.float32(np.inf)
GAIN = np.float32(1e-4)
"""A cost must fall by more than this part to count; less is rounding."""


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
    """[capacity] length of the path from the start [rad]."""
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
    """[k] failed searches for this goal alone."""


@kernel()
def make_tree(start, goals, capacity):
    """A tree with only the start."""
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


@kernel()
def grown(tree, capacity):
    """A copy of the tree with a larger capacity."""
    wider = make_tree(tree.nodes[0], tree.goals, capacity)
    n = tree.size[0]
    wider.nodes[:n], wider.parent[:n], wider.child[:n] = tree.nodes[:n], tree.parent[:n], tree.child[:n]
    wider.sibling[:n], wider.cost[:n], wider.size[0] = tree.sibling[:n], tree.cost[:n], n
    wider.goal_node[:], wider.failures[:] = tree.goal_node, tree.failures
    for i in range(1, n):
        kd_tree.insert(wider.near, wider.nodes, i)
    return wider


@allocation_free(inner=False)
def goal_cost(tree, g):
    """The length of the best path known to a goal [rad], infinite if there is none."""
    node = tree.goal_node[g]
    return tree.cost[node] if node >= 0 else _INFINITY


@allocation_free(inner=False)
def best_goal(tree):
    """The goal with the shortest path; -1 if none is reached."""
    best, where = _INFINITY, -1
    for g in range(len(tree.goals)):
        cost = goal_cost(tree, g)
        if cost < best:
            best, where = cost, g
    return where


@allocation_free(inner=False)
def best_cost(tree):
    g = best_goal(tree)
    return goal_cost(tree, g) if g >= 0 else _INFINITY


@allocation_free(inner=False)
def goal_is_open(tree, g, best):
    """Whether a path to the goal might still be shorter than the best one to any goal."""
    return tree.bound[g] < best * (_ONE - GAIN) and tree.bound[g] < goal_cost(tree, g) * (_ONE - GAIN)


@allocation_free()
def append(tree, q, parent, cost):
    """Add a node; the tree must not be full."""
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
def rewire(tree, node, parent, cost):
    """Move a node, with its subtree, to another parent."""
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


@kernel()
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


@kernel()
def graft(tree, path, g):
    """Add a free path from the start to a goal as a branch if it is the shortest known; returns whether it
    was."""
    cost = path_length(path)
    if cost >= goal_cost(tree, g) * (_ONE - GAIN) or tree.size[0] + len(path) >= len(tree.nodes):
        return False
    node, cost = 0, _ZERO
    for i in range(1, len(path) - 1):
        cost += distance(path[i - 1], path[i])
        node = append(tree, path[i], node, cost)
    cost += distance(path[len(path) - 2], path[len(path) - 1])
    if tree.goal_node[g] < 0:
        tree.goal_node[g] = append(tree, tree.goals[g], node, cost)
    else:
        rewire(tree, tree.goal_node[g], node, cost)
    return True
