"""Compiled search trees, and the planners RRT-Connect and AORRTC, which grow one from the start and one from
the goals.

J. Kuffner and S. LaValle, "RRT-Connect: An efficient approach to single-query path planning", ICRA 2000;
balanced trees as in J. Kuffner and S. LaValle, "An efficient approach to path planning using balanced
bidirectional RRT search", 2005. T. S. Wilson, W. Thomason, Z. Kingston and J. D. Gammell, "AORRTC:
Almost-surely asymptotically optimal planning with RRT-Connect", RA-L 2025; samples as in J. D. Gammell, S. S.
Srinivasa and T. D. Barfoot, "Informed RRT*", IROS 2014.

Without path constraints, `limits` is None and edges are straight lines. With path constraints, `limits` is a
`constrained.Limits`. `keep` and `extended` are empty here; the module `constrained` overloads them for
compiled code.
"""

from typing import NamedTuple

import numpy as np

from robotdiffuse.collision.kernels.motions import distance, make_scratch, motion_free
from robotdiffuse.collision.kernels.random import random
from robotdiffuse.collision.kernels.simd import W, lane, load
from robotdiffuse.core.kernels import HALF, ONE, TINY, ZERO, allocation_free, inner_kernel, kernel

_TAU = np.float32(6.283185307179586)
INFINITE = np.float32(np.inf)
# Coordinate of unused node places, far from all nodes; its square is finite [rad]
_NOWHERE = np.float32(1e15)
# A squared distance that is larger than those of nodes and smaller than those of unused places [rad²]
_FAR = np.float32(1e29)
LINE_SHARE = np.float32(0.5)
"""Without a bound and without path constraints: fraction of the samples that are drawn around the straight
line from start to goal; the other samples are uniform."""
LINE_SPREAD = np.float32(0.3)
"""Standard deviation of the samples around the straight line, as a fraction of a joint's range."""


class Trees(NamedTuple):
    """Tree 0 from the start, and tree 1 from the goals; tree 1 may be empty. The arrays are filled in place,
    so that a search can be continued. The nearest-node search handles a block of W nodes at once."""

    nodes: np.ndarray
    """[2, capacity, dof]"""
    columns: np.ndarray
    """[2 * dof, capacity rounded up to full blocks] the nodes by joint, for the nearest-node search; _NOWHERE
    at unused places."""
    costs: np.ndarray
    """[2, capacity rounded up to full blocks] path length from a root to each node [rad]. Roots are the first
    nodes and have the cost 0."""
    parents: np.ndarray
    """[2, capacity] -1 for roots."""
    children: np.ndarray
    """[2, capacity] first child, -1 for none."""
    siblings: np.ndarray
    """[2, capacity] next child of the same parent, -1 for the last."""
    sizes: np.ndarray
    """[2] numbers of nodes."""


@kernel()
def make_trees(start, goals, capacity):
    """Trees with the start and the goals as their roots; nodes have the start's data type."""
    dof = len(start)
    places = (capacity + W - 1) // W * W
    trees = Trees(
        np.empty((2, capacity, dof), start.dtype),
        np.empty((2 * dof, places), np.float32),
        np.zeros((2, places), np.float32),
        np.empty((2, capacity), np.int32),
        np.empty((2, capacity), np.int32),
        np.empty((2, capacity), np.int32),
        np.zeros(2, np.int32),
    )
    add(trees, 0, start, ZERO, -1)
    for goal in goals:
        add(trees, 1, goal, ZERO, -1)
    return trees


def keep(limits, q):
    """Project q onto the path constraints, in place; returns whether q then keeps them. Only compiled code
    can call this function."""


def extended(space, limits, trees, tree, near, q, longest, scratch) -> int:  # type: ignore[return]
    """`extended_straight` with edges that keep the path constraints. Only compiled code can call this
    function."""


@allocation_free()
def extended_straight(space, trees, tree, near, q, longest, bound, scratch):
    """Extend a tree from a node towards q by at most `longest` [rad].

    Returns the added node. Returns -1, and adds no node, if the motion is not free, if every path through its
    end is at least as long as `bound` [rad], or if the tree is full.
    """
    origin = trees.nodes[tree, near]
    end = scratch.a
    gap = distance(origin, q)
    share = ONE if gap <= longest else longest / gap
    for j in range(len(end)):
        end[j] = q[j] if gap <= longest else origin[j] + share * (q[j] - origin[j])
    cost = trees.costs[tree, near] + share * gap
    if trees.sizes[tree] == trees.nodes.shape[1]:
        return -1
    if bound < INFINITE and cost + _to_roots(trees, 1 - tree, end) >= bound:
        return -1
    if not motion_free(space, origin, end, scratch):
        return -1
    return add(trees, tree, end, cost, near)


@kernel(nogil=True)
def search(space, limits, trees, bound, longest, iterations, state):
    """Grow both trees for a number of iterations, or until they hold a path shorter than `bound` [rad].

    This is RRT_CONNECT_PLANNER of Kuffner and LaValle, but instead of SWAP, T_a is the smaller tree. With a
    finite bound, which is c_max of AORRTC, the trees grow in the space of configurations and costs. T_a is
    `tree`, T_b is `other_tree`.

    limits: None without path constraints, see the docstring of the module.
    bound: infinite for RRT-Connect, and with path constraints.
    longest: length of the longest extension [rad, joint-space L2].
    state: of the random generator.

    Returns the waypoints [n, dof] from the start to a goal; n = 0 if no path was found yet.
    """
    nodes = trees.nodes
    costs = trees.costs
    sizes = trees.sizes
    scratch = make_scratch(space, nodes)
    sample = scratch.b
    start = nodes[0, 0]
    goals = nodes[1, : _root_count(trees, 1)]
    bounded = bound < INFINITE
    shares = goal_shares(start, goals, bound)
    for _ in range(iterations):
        # T_a is the smaller tree
        tree = 0 if sizes[0] <= sizes[1] else 1
        other_tree = 1 - tree
        # x_rand, and c_rand, the cost at which T_a may reach it
        c_rand = bound
        if bounded:
            # from the hyperspheroid of a goal, chosen by volume (Informed RRT*)
            u = random(state)
            g = 0
            while g < len(goals) - 1 and u > shares[g]:
                g += 1
            sample_within(space, start, goals[g], bound, sample, state)
            # c_rand is uniform from g_hat to c_max - h_hat; g_hat and h_hat bound cost-to-come and cost-to-go
            g_hat = _to_roots(trees, tree, sample)
            h_hat = _to_roots(trees, other_tree, sample)
            c_rand = g_hat + random(state) * (bound - h_hat - g_hat)
        elif limits is None and random(state) < LINE_SHARE:
            sample_about_line(space, start, goals, sample, state)
        else:
            sample_box(space, sample, state)
        # EXTEND(T_a, x_rand): x_near and x_new
        if limits is None:
            x_near = nearest(trees, tree, sample, c_rand)
            x_new = extended_straight(space, trees, tree, x_near, sample, longest, bound, scratch)
            if x_new >= 0 and bounded:
                _lower_cost(space, trees, tree, x_new, scratch, state)
        else:
            if not keep(limits, sample):
                continue
            x_near = nearest(trees, tree, sample, c_rand)
            x_new = extended(space, limits, trees, tree, x_near, sample, longest, scratch)
        # Trapped
        if x_new < 0:
            continue
        c_new = costs[tree, x_new]
        sample[:] = nodes[tree, x_new]
        # CONNECT(T_b, x_new): T_b must reach x_new at a cost of at most c_max - c_new
        x_near = nearest(trees, other_tree, sample, bound - c_new)
        while True:
            gap = distance(nodes[other_tree, x_near], sample)
            # a path through this edge would not be shorter than c_max
            if costs[other_tree, x_near] + gap + c_new >= bound:
                break
            if limits is None:
                x_connect = extended_straight(
                    space, trees, other_tree, x_near, sample, longest, INFINITE, scratch
                )
            else:
                x_connect = extended(space, limits, trees, other_tree, x_near, sample, longest, scratch)
            # Trapped
            if x_connect < 0:
                break
            # Reached: the trees meet
            if gap <= longest:
                return _joined(trees, tree, x_new, x_connect)
            x_near = x_connect
    return nodes[0, :0].copy()


@kernel(nogil=True)
def extend(space, trees, targets, longest):
    """Extend the start's tree from its nearest node towards each of the targets [n, dof], by at most
    `longest` [n] [rad]. Targets to which the motion is not free are skipped."""
    scratch = make_scratch(space, trees.nodes)
    # the type of `tree` in the search: for a literal, Numba would compile the functions again
    start_tree = np.int64(0)
    for n in range(len(targets)):
        near = nearest(trees, start_tree, targets[n], INFINITE)
        extended_straight(space, trees, start_tree, near, targets[n], longest[n], INFINITE, scratch)


@allocation_free(inline="always")
def add(trees, tree, q, cost, parent):
    """Add a node to a tree, which must not be full; returns the index of the node."""
    node = trees.sizes[tree]
    dof = len(q)
    for j in range(dof):
        trees.nodes[tree, node, j] = q[j]
        if node % W == 0:
            trees.columns[tree * dof + j, node : node + W] = _NOWHERE
        trees.columns[tree * dof + j, node] = q[j]
    trees.costs[tree, node] = cost
    trees.parents[tree, node] = parent
    trees.children[tree, node] = -1
    if parent >= 0:
        trees.siblings[tree, node] = trees.children[tree, parent]
        trees.children[tree, parent] = node
    trees.sizes[tree] += 1
    return node


@allocation_free()
def rewire(trees, tree, node, parent, cost):
    """Move a node, with its subtree, to another parent, from which its cost is `cost`."""
    parents = trees.parents[tree]
    costs = trees.costs[tree]
    children = trees.children[tree]
    siblings = trees.siblings[tree]
    old = parents[node]
    if children[old] == node:
        children[old] = siblings[node]
    else:
        before = children[old]
        while siblings[before] != node:
            before = siblings[before]
        siblings[before] = siblings[node]
    parents[node] = parent
    siblings[node] = children[parent]
    children[parent] = node
    gain = costs[node] - cost
    costs[node] = cost
    # all descendants, in depth-first order without a stack
    at = children[node]
    while at >= 0:
        costs[at] -= gain
        if children[at] >= 0:
            at = children[at]
            continue
        while at != node and siblings[at] < 0:
            at = parents[at]
        if at == node:
            break
        at = siblings[at]


@allocation_free()
def _root_count(trees, tree):
    count = 0
    while count < trees.sizes[tree] and trees.parents[tree, count] < 0:
        count += 1
    return count


@allocation_free(fastmath=True)
def _to_roots(trees, tree, q):
    """g_hat of AORRTC: the distance of q to the nearest root of the tree, a lower bound of q's cost [rad]."""
    g_hat = np.float32(1e9)
    for r in range(_root_count(trees, tree)):
        g_hat = min(g_hat, distance(trees.nodes[tree, r], q))
    return g_hat


@allocation_free()
def nearest(trees, tree, q, c_rand):
    """The node nearest to (q, c_rand), by position and cost, among nodes from which a straight edge reaches q
    at a cost of at most c_rand; the nearest root if there are none.

    If c_rand is infinite, the node nearest to q.
    """
    bounded = c_rand < INFINITE
    best = INFINITE
    x_near = -1
    # one block of W nodes at a time; `nearer` has a bit for each node
    for part in range((trees.sizes[tree] + W - 1) // W):
        square = _squared(trees, tree, part, q)
        if bounded:
            # slack, the cost that remains for the edge, must be at least the edge's length
            slack = c_rand - load(trees.costs, tree, part)
            total = square + slack * slack
            nearer = (total < best) & ~(slack < ZERO) & ~(slack * slack < square)
        else:
            total = square
            nearer = total < best
        i = 0
        while nearer != 0:
            if nearer & 1 and lane(total, i) < best:
                best = lane(total, i)
                x_near = W * part + i
            nearer = nearer >> 1
            i = i + 1
    if x_near >= 0:
        return x_near
    for n in range(_root_count(trees, tree)):
        gap = distance(trees.nodes[tree, n], q)
        if gap < best:
            best = gap
            x_near = n
    return x_near


@allocation_free(inner=False)
def nearest_few(trees, tree, q, index, squares):
    """Write the len(index) nodes nearest to q to `index`, the nearest first, and their squared distances to
    `squares`. Returns their number, which is less than len(index) only if the tree has fewer nodes."""
    count = 0
    cutoff = _FAR
    for part in range((trees.sizes[tree] + W - 1) // W):
        square = _squared(trees, tree, part, q)
        nearer = square < cutoff
        i = 0
        while nearer != 0:
            if nearer & 1 and lane(square, i) < cutoff:
                # insertion into the sorted list
                count = min(count + 1, len(index))
                at = count - 1
                while at > 0 and squares[at - 1] > lane(square, i):
                    index[at] = index[at - 1]
                    squares[at] = squares[at - 1]
                    at -= 1
                index[at] = W * part + i
                squares[at] = lane(square, i)
                if count == len(index):
                    cutoff = squares[count - 1]
            nearer = nearer >> 1
            i = i + 1
    return count


@allocation_free(inline="always")
def _squared(trees, tree, part, q):
    """Squared distances from q of the W nodes in a block."""
    dof = len(q)
    aside = load(trees.columns, tree * dof, part) - np.float32(q[0])
    total = aside * aside
    for j in range(1, dof):
        aside = load(trees.columns, tree * dof + j, part) - np.float32(q[j])
        total = total + aside * aside
    return total


@allocation_free()
def _lower_cost(space, trees, tree, leaf, scratch, state):
    """Give a leaf a parent through which its cost is lower, by AORRTC's resampling of c_rand. Resampling ends
    when the parent stays the same, the cost cannot or does not fall, or an edge collides."""
    x_new = trees.nodes[tree, leaf]
    parent = trees.parents[tree, leaf]
    c_new = trees.costs[tree, leaf]
    g_hat = _to_roots(trees, tree, x_new)
    while c_new > g_hat:
        c_rand = g_hat + random(state) * (c_new - g_hat)
        x_near = nearest(trees, tree, x_new, c_rand)
        cost = trees.costs[tree, x_near] + distance(trees.nodes[tree, x_near], x_new)
        if x_near == parent or cost >= c_new:
            break
        if not motion_free(space, trees.nodes[tree, x_near], x_new, scratch):
            break
        parent = x_near
        c_new = cost
    rewire(trees, tree, leaf, parent, c_new)


@allocation_free()
def sample_box(space, q, state):
    """Sample q uniformly within the joint limits."""
    for j in range(len(q)):
        q[j] = space.lower[j] + random(state) * (space.upper[j] - space.lower[j])


@allocation_free(inner=False)
def sample_about_line(space, start, goals, q, state):
    """Sample q around the straight line from the start to a random goal: normally distributed around a
    uniform point of the line, clamped to the joint limits."""
    g = min(int(random(state) * len(goals)), len(goals) - 1)
    share = random(state)
    for j in range(len(q)):
        center = start[j] + share * (goals[g, j] - start[j])
        spread = LINE_SPREAD * (space.upper[j] - space.lower[j])
        q[j] = min(max(center + spread * _normal(state), space.lower[j]), space.upper[j])


@kernel()
def goal_shares(start, goals, bound):
    """Cumulative fractions of the samples for each goal [goals], proportional to the volumes of the
    hyperspheroids of paths shorter than `bound`."""
    shares = np.empty(len(goals), np.float32)
    total = ZERO
    for g in range(len(goals)):
        c_min = distance(start, goals[g])
        if c_min < bound:
            # ratio of the short axes to the long one
            flatness = np.sqrt(ONE - (c_min / bound) ** 2)
            total += flatness ** np.float32(len(start) - 1)
        shares[g] = total
    return shares / max(total, np.float32(1e-30))


@allocation_free(inner=False)
def sample_within(space, start, goal, bound, q, state):
    """Sample q uniformly in the prolate hyperspheroid of paths from the start to a goal shorter than `bound`,
    clamped to the limits (Sample of Informed RRT*; `bound` is c_max)."""
    dof = len(q)
    c_min = distance(start, goal)
    # L: half axes c_max / 2 and sqrt(c_max^2 - c_min^2) / 2
    half_axis = HALF * np.sqrt(max(bound * bound - c_min * c_min, ZERO))
    # SampleUnitNBall: a normal direction, and a radius u^(1/n)
    norm = ZERO
    for j in range(dof):
        q[j] = _normal(state)
        norm += q[j] * q[j]
    scale = random(state) ** (ONE / np.float32(dof)) / np.sqrt(max(norm, np.float32(1e-12)))
    for j in range(dof):
        q[j] *= scale * (HALF * bound if j == 0 else half_axis)
    # C, the rotation to the world frame, is a Householder reflection of the first axis onto the goal's
    # direction; the center is halfway
    along = ZERO
    total = ZERO
    for j in range(dof):
        v = (ONE if j == 0 else ZERO) - (goal[j] - start[j]) / max(c_min, TINY)
        along += v * q[j]
        total += v * v
    for j in range(dof):
        v = (ONE if j == 0 else ZERO) - (goal[j] - start[j]) / max(c_min, TINY)
        turned = q[j] - (np.float32(2.0) * along / total * v if total > TINY else ZERO)
        q[j] = min(max(turned + HALF * (start[j] + goal[j]), space.lower[j]), space.upper[j])


@allocation_free()
def _normal(state):
    """A standard normal number (G. Box and M. Muller, 1958)."""
    radius = np.sqrt(np.float32(-2.0) * np.log(max(random(state), np.float32(1e-12))))
    return radius * np.cos(_TAU * random(state))


@kernel()
def branch(trees, tree, node):
    """Waypoints [n, dof] from a root to a node; n = 0 for node -1."""
    count = 0
    at = node
    while at >= 0:
        count = count + 1
        at = trees.parents[tree, at]
    path = np.empty((count, trees.nodes.shape[2]), trees.nodes.dtype)
    for i in range(count - 1, -1, -1):
        path[i] = trees.nodes[tree, node]
        node = trees.parents[tree, node]
    return path


@inner_kernel()
def _joined(trees, tree, x_new, x_connect):
    """The path from the start to a goal through the configuration where the trees meet. This is the node
    x_new of `tree` and the node x_connect of the other tree."""
    first, second = (x_new, x_connect) if tree == 0 else (x_connect, x_new)
    back = branch(trees, 1, trees.parents[1, second])
    return np.concatenate((branch(trees, 0, first), back[::-1]))
