"""Compiled RRT-Connect and AORRTC, which adds costs to the trees and a bound on the length of paths.

J. Kuffner and S. LaValle, "RRT-Connect: An efficient approach to single-query path planning", ICRA 2000;
balanced trees as in J. Kuffner and S. LaValle, "An efficient approach to path planning using balanced
bidirectional RRT search", 2005. T. S. Wilson, W. Thomason, Z. Kingston and J. D. Gammell, "AORRTC:
Almost-surely asymptotically optimal planning with RRT-Connect", RA-L 2025; samples as in J. D. Gammell, S. S.
Srinivasa and T. D. Barfoot, "Informed RRT*", IROS 2014.
"""

from typing import NamedTuple

import numpy as np

from robotdiffuse.collision.kernels.compiled import random
from robotdiffuse.collision.kernels.lane_collision import make_workspace
from robotdiffuse.collision.kernels.motions import distance, motion_free
from robotdiffuse.collision.kernels.simd import W, lane, load
from robotdiffuse.core.kernels import allocation_free, inner_kernel, kernel

_ZERO, _ONE, _HALF = np.float32(0.0), np.float32(1.0), np.float32(0.5)
_TAU = np.float32(6.283185307179586)
_NOWHERE = np.float32(1e15)
"""A coordinate far from all nodes, with a finite square [rad]."""


class Trees(NamedTuple):
    """Two trees, from the start and from the goals; filled in place, so that a search can be continued."""

    nodes: np.ndarray
    """[2, capacity, dof]"""
    columns: np.ndarray
    """[2 * dof, capacity in full lanes] the nodes by joint, for the nearest-node search; _NOWHERE beyond the
    last."""
    costs: np.ndarray
    """[2, capacity in full lanes] path lengths from the roots [rad]; roots come first and have 0."""
    parents: np.ndarray
    """[2, capacity] -1 for roots."""
    sizes: np.ndarray
    """[2]"""


@kernel()
def make_trees(start, goals, capacity):
    """Trees with the start and the goals as their roots."""
    dof, lanes = len(start), (capacity + W - 1) // W * W
    trees = Trees(
        np.empty((2, capacity, dof), np.float32),
        np.empty((2 * dof, lanes), np.float32),
        np.zeros((2, lanes), np.float32),
        np.empty((2, capacity), np.int32),
        np.zeros(2, np.int32),
    )
    _add(trees, 0, start, _ZERO, -1)
    for goal in goals:
        _add(trees, 1, goal, _ZERO, -1)
    return trees


@kernel(nogil=True)
def search(space, trees, goals, bound, longest, iterations, state):
    """Grow the trees for a number of iterations, or until they hold a path shorter than `bound` [rad].

    longest: largest extension [rad].
    bound: infinite for RRT-Connect.

    Returns the waypoints [n, dof] from the start to a goal; n = 0 if none was found yet. Stops early when a
    tree is full.
    """
    nodes, costs, parents, sizes = trees.nodes, trees.costs, trees.parents, trees.sizes
    dof, bounded = nodes.shape[2], bound < np.float32(np.inf)
    work, block = make_workspace(space.robot, space.scene), np.empty((dof, W), np.float32)
    sample, new = np.empty(dof, np.float32), np.empty(dof, np.float32)
    shares = goal_shares(nodes[0, 0], goals, bound) if bounded else np.empty(0, np.float32)
    for _ in range(iterations):
        tree = 0 if sizes[0] <= sizes[1] else 1
        other = 1 - tree
        if sizes[tree] >= nodes.shape[1] or sizes[other] >= nodes.shape[1]:
            break
        if bounded:
            sample_within(space, nodes[0, 0], goals, shares, bound, sample, state)
        else:
            _sample_box(space, sample, state)
        roots, other_roots = (len(goals), 1) if tree else (1, len(goals))
        allowed = bound
        if bounded:
            least = _to_roots(nodes, tree, roots, sample)
            allowed = least + random(state) * (bound - _to_roots(nodes, other, other_roots, sample) - least)
        near = _nearest(trees, tree, sample, allowed)
        gap = distance(nodes[tree, near], sample)
        share = min(longest / max(gap, np.float32(1e-6)), _ONE)
        for j in range(dof):
            new[j] = nodes[tree, near, j] + share * (sample[j] - nodes[tree, near, j])
        cost = costs[tree, near] + share * gap
        if bounded and cost + _to_roots(nodes, other, other_roots, new) >= bound:
            continue
        if not motion_free(space, nodes[tree, near], new, block, work):
            continue
        if bounded:
            near, cost = _cheaper(space, trees, tree, roots, near, cost, new, block, work, state)
        here = _add(trees, tree, new, cost, near)
        near = _nearest(trees, other, new, bound - cost)
        while sizes[other] < nodes.shape[1]:
            gap = distance(nodes[other, near], new)
            if bounded and costs[other, near] + gap + cost >= bound:
                break
            last = gap <= longest
            share = _ONE if last else longest / gap
            for j in range(dof):
                sample[j] = nodes[other, near, j] + share * (new[j] - nodes[other, near, j])
            if not motion_free(space, nodes[other, near], sample, block, work):
                break
            if last:
                return _join(nodes, parents, tree, here, near)
            near = _add(trees, other, sample, costs[other, near] + longest, near)
    return np.empty((0, dof), np.float32)


@kernel(nogil=True)
def connect(space, trees, longest, iterations, state):
    """RRT-Connect: `search` without a bound."""
    nowhere = np.empty((0, trees.nodes.shape[2]), np.float32)
    return search(space, trees, nowhere, np.float32(np.inf), longest, iterations, state)


@kernel(nogil=True)
def extend(space, trees, targets, longest):
    """Extend the start's tree from its nearest node towards each of the targets [n, dof], by at most
    longest[n] [rad], where that motion is free; stops early when the tree is full."""
    nodes, sizes = trees.nodes, trees.sizes
    dof = nodes.shape[2]
    work, block = make_workspace(space.robot, space.scene), np.empty((dof, W), np.float32)
    new = np.empty(dof, np.float32)
    for n in range(len(targets)):
        if sizes[0] >= nodes.shape[1]:
            break
        near = _nearest(trees, 0, targets[n], np.float32(np.inf))
        gap = distance(nodes[0, near], targets[n])
        share = min(longest[n] / max(gap, np.float32(1e-6)), _ONE)
        for j in range(dof):
            beyond = nodes[0, near, j] + share * (targets[n, j] - nodes[0, near, j])
            new[j] = min(max(beyond, space.lower[j]), space.upper[j])
        if motion_free(space, nodes[0, near], new, block, work):
            _add(trees, 0, new, trees.costs[0, near] + share * gap, near)


@allocation_free(inline="always")
def _add(trees, tree, q, cost, parent):
    here, dof = trees.sizes[tree], len(q)
    for j in range(dof):
        trees.nodes[tree, here, j] = q[j]
        if here % W == 0:
            trees.columns[tree * dof + j, here : here + W] = _NOWHERE
        trees.columns[tree * dof + j, here] = q[j]
    trees.costs[tree, here], trees.parents[tree, here] = cost, parent
    trees.sizes[tree] += 1
    return here


@allocation_free(fastmath=True)
def _to_roots(nodes, tree, roots, q):
    """Distance to the nearest root, a lower bound of the cost of q [rad]."""
    least = np.float32(1e9)
    for r in range(roots):
        least = min(least, distance(nodes[tree, r], q))
    return least


@allocation_free()
def _nearest(trees, tree, q, allowed):
    """The nearest node, by position and cost, of those that reach q at a cost of at most `allowed`.

    The cost of q is taken to be `allowed`. Without a bound, the nearest node by position; if no node reaches
    q, the nearest root.
    """
    bounded = allowed < np.float32(np.inf)
    best, where = np.float32(np.inf), -1
    for part in range((trees.sizes[tree] + W - 1) // W):
        apart = _squared(trees, tree, part, q)
        if bounded:
            late = allowed - load(trees.costs, tree, part)
            both = apart + late * late
            near = (both < best) & ~(late < _ZERO) & ~(late * late < apart)
        else:
            both = apart
            near = both < best
        i = 0
        while near != 0:
            if near & 1 and lane(both, i) < best:
                best, where = lane(both, i), W * part + i
            near, i = near >> 1, i + 1
    if where >= 0:
        return where
    for n in range(trees.sizes[tree]):
        if trees.parents[tree, n] >= 0:
            break
        apart = distance(trees.nodes[tree, n], q)
        if apart < best:
            best, where = apart, n
    return where


@allocation_free(inline="always")
def _squared(trees, tree, part, q):
    """Squared distances of sixteen nodes from q."""
    dof = len(q)
    aside = load(trees.columns, tree * dof, part) - q[0]
    total = aside * aside
    for j in range(1, dof):
        aside = load(trees.columns, tree * dof + j, part) - q[j]
        total = total + aside * aside
    return total


@inner_kernel(inline="always")
def _cheaper(space, trees, tree, roots, near, cost, new, block, work, state):
    """A parent that reaches `new` at a lower cost, and that cost: draws cheaper ones until an edge
    collides."""
    least = _to_roots(trees.nodes, tree, roots, new)
    while cost > least:
        allowed = least + random(state) * (cost - least)
        other = _nearest(trees, tree, new, allowed)
        through = trees.costs[tree, other] + distance(trees.nodes[tree, other], new)
        if other == near or through >= cost:
            break
        if not motion_free(space, trees.nodes[tree, other], new, block, work):
            break
        near, cost = other, through
    return near, cost


@allocation_free()
def _sample_box(space, q, state):
    for j in range(len(q)):
        q[j] = space.lower[j] + random(state) * (space.upper[j] - space.lower[j])


@kernel()
def goal_shares(start, goals, bound):
    """Cumulative shares of the samples for each goal, by the volumes of their hyperspheroids."""
    shares, total = np.empty(len(goals), np.float32), _ZERO
    for g in range(len(goals)):
        straight = distance(start, goals[g])
        if straight < bound:
            flat = np.sqrt(_ONE - (straight / bound) ** 2)
            total += flat ** np.float32(len(start) - 1)
        shares[g] = total
    return shares / max(total, np.float32(1e-30))


@kernel()
def sample_within(space, start, goals, shares, bound, q, state):
    """Sample q uniformly in the prolate hyperspheroid of paths from the start to a goal shorter than `bound`,
    clamped to the limits; the goal is drawn by `shares`."""
    dof, u, g = len(q), random(state), 0
    while g < len(goals) - 1 and u > shares[g]:
        g += 1
    straight = distance(start, goals[g])
    across = _HALF * np.sqrt(max(bound * bound - straight * straight, _ZERO))
    norm = _ZERO
    for j in range(dof):
        q[j] = _normal(state)
        norm += q[j] * q[j]
    scale = random(state) ** (_ONE / np.float32(dof)) / np.sqrt(max(norm, np.float32(1e-12)))
    for j in range(dof):
        q[j] *= scale * (_HALF * bound if j == 0 else across)
    # Householder reflection of the first axis onto the direction of the goal
    along, total = _ZERO, _ZERO
    for j in range(dof):
        v = (_ONE if j == 0 else _ZERO) - (goals[g, j] - start[j]) / max(straight, np.float32(1e-9))
        along += v * q[j]
        total += v * v
    for j in range(dof):
        v = (_ONE if j == 0 else _ZERO) - (goals[g, j] - start[j]) / max(straight, np.float32(1e-9))
        turned = q[j] - (np.float32(2.0) * along / total * v if total > np.float32(1e-9) else _ZERO)
        q[j] = min(max(turned + _HALF * (start[j] + goals[g, j]), space.lower[j]), space.upper[j])


@allocation_free()
def _normal(state):
    """A standard normal number (G. Box and M. Muller, 1958)."""
    radius = np.sqrt(np.float32(-2.0) * np.log(max(random(state), np.float32(1e-12))))
    return radius * np.cos(_TAU * random(state))


@inner_kernel()
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
