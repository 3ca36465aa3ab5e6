"""The lattice, compiled: nodes, edges, collision checks of both, and heuristics.

Costs are integers, UNITS to a step of the lattice. Edges are rounded up and heuristics down, so sums are
exact, heuristics are exactly consistent, and both searches find the same cost.

An edge is free if both of its nodes are, and the motion from the first to the second in the order of the
moves; so the check is the same from either side.

`space` is a `collision.kernels.motions.Space`.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from robotdiffuse.collision.kernels.compiled import allocation_free
from robotdiffuse.collision.kernels.lane_collision import W, block_hits, make_workspace
from robotdiffuse.collision.kernels.motions import motion_free
from robotdiffuse.planning.baselines.lattice.table import BLOCKED, FREE, NO_ROOM, UNKNOWN, find_or_add

UNITS = 1 << 20
"""Cost of one step of one joint."""
ROUNDING = 1e-3
"""Bound on rounding errors of floating point [units]."""


class Lattice(NamedTuple):
    """The geometry of the lattice. Coordinates count steps from the lowest node of each joint."""

    origin: np.ndarray
    """[dof] the lowest node [rad]"""
    spacing: float
    """[rad]"""
    counts: np.ndarray
    """[dof] nodes along each joint."""
    strides: np.ndarray
    """[dof] a node's key is the sum of coordinates times strides."""
    moves: np.ndarray
    """[moves, dof] -1, 0 or 1; the second half are the negatives of the first."""
    costs: np.ndarray
    """[moves] [units]"""
    slope: float
    """Smallest cost of a move per joint that it moves [steps]."""
    goals: np.ndarray
    """[k, dof] [rad]"""
    goals_at: np.ndarray
    """[k, dof] coordinates of the goals, not integers."""
    cells: np.ndarray
    """[k, dof] coordinates of the lowest corner of each goal's cell."""


class Scratch(NamedTuple):
    """Working memory of one thread."""

    at: np.ndarray
    other: np.ndarray
    """[dof] coordinates"""
    near: np.ndarray
    """[moves] the neighbours of a node, -1 for none."""
    pending: np.ndarray
    """[16] nodes to check."""
    a: np.ndarray
    b: np.ndarray
    block: np.ndarray
    work: tuple


@njit(cache=True)
def make_scratch(space, lattice):
    moves, dof = lattice.moves.shape
    return Scratch(
        np.empty(dof, np.int64),
        np.empty(dof, np.int64),
        np.empty(moves, np.int64),
        np.empty(W, np.int64),
        np.empty(dof, np.float32),
        np.empty(dof, np.float32),
        np.empty((dof, W), np.float32),
        make_workspace(space.robot, space.scene),
    )


@allocation_free()
def coordinates(lattice, key, out):
    for j in range(len(out)):
        out[j] = key // lattice.strides[j] % lattice.counts[j]


@allocation_free()
def _configuration(lattice, at, out):
    for j in range(len(at)):
        out[j] = np.float32(lattice.origin[j] + lattice.spacing * at[j])


@allocation_free()
def key_beside(lattice, key, at, m):
    """The key of the node that move m leads to; -1 beyond the joint limits."""
    for j in range(len(at)):
        step = lattice.moves[m, j]
        if step != 0:
            if at[j] + step < 0 or at[j] + step >= lattice.counts[j]:
                return np.int64(-1)
            key += step * lattice.strides[j]
    return key


@allocation_free(inline="always")
def check_nodes(space, lattice, table, count, scratch):
    """Check the first `count` nodes in `pending`, up to 16, and set their states."""
    for i in range(W):
        coordinates(lattice, table.keys[scratch.pending[min(i, count - 1)]], scratch.other)
        _configuration(lattice, scratch.other, scratch.a)
        for j in range(len(scratch.a)):
            scratch.block[j, i] = scratch.a[j]
    hits = block_hits(space.robot, space.scene, scratch.block, space.padding, False, scratch.work)
    for i in range(count):
        table.state[scratch.pending[i]] = BLOCKED if hits >> i & 1 else FREE


@allocation_free(inline="always")
def look_around(space, lattice, table, node, scratch):
    """Write the neighbours of a node to `near`, and its coordinates to `at`; add and check new neighbours.

    Returns False if memory is full.
    """
    key, waiting = table.keys[node], 0
    coordinates(lattice, key, scratch.at)
    for m in range(len(lattice.moves)):
        scratch.near[m] = -1
        beside = key_beside(lattice, key, scratch.at, m)
        if beside < 0:
            continue
        v = find_or_add(table, beside)
        if v < 0:
            return False
        scratch.near[m] = v
        if table.state[v] == UNKNOWN:
            scratch.pending[waiting] = v
            waiting += 1
            if waiting == W:
                check_nodes(space, lattice, table, waiting, scratch)
                waiting = 0
    if waiting > 0:
        check_nodes(space, lattice, table, waiting, scratch)
    return True


@allocation_free(inline="always")
def move_free(space, lattice, table, node, m, scratch):
    """Whether move m of the first half, from a free node to a free node, is free of collision."""
    coordinates(lattice, table.keys[node], scratch.other)
    _configuration(lattice, scratch.other, scratch.a)
    for j in range(len(scratch.a)):
        scratch.other[j] += lattice.moves[m, j]
    _configuration(lattice, scratch.other, scratch.b)
    return motion_free(space, scratch.a, scratch.b, scratch.block, scratch.work)


@allocation_free(inline="always")
def last_free(space, lattice, at, goal, scratch):
    """Whether the motion from the node at these coordinates to a goal is free."""
    _configuration(lattice, at, scratch.a)
    for j in range(len(scratch.b)):
        scratch.b[j] = lattice.goals[goal, j]
    return motion_free(space, scratch.a, scratch.b, scratch.block, scratch.work)


@allocation_free()
def corner_of_cell(lattice, goal, at):
    """The corner of the goal's cell at these coordinates, as bits; -1 if there is none."""
    corner = 0
    for j in range(len(at)):
        d = at[j] - lattice.cells[goal, j]
        if d < 0 or d > 1:
            return -1
        corner |= d << j
    return corner


@allocation_free()
def corner_node(lattice, table, number, at):
    """The node at a corner of a goal's cell, `number` = goal and corner bits; writes its coordinates to `at`.

    -1 beyond the joint limits, NO_ROOM if memory is full.
    """
    dof, key = len(at), np.int64(0)
    goal, corner = number >> dof, number & ((1 << dof) - 1)
    for j in range(dof):
        at[j] = lattice.cells[goal, j] + ((corner >> j) & 1)
        if at[j] < 0 or at[j] >= lattice.counts[j]:
            return np.int64(-1)
        key += at[j] * lattice.strides[j]
    node = find_or_add(table, key)
    return node if node >= 0 else np.int64(NO_ROOM)


@allocation_free()
def last_cost(lattice, goal, at):
    """Cost of the edge from a corner of the goal's cell to the goal."""
    total = 0.0
    for j in range(len(at)):
        total += (at[j] - lattice.goals_at[goal, j]) ** 2
    return np.int64(np.ceil(UNITS * np.sqrt(total)))


@allocation_free()
def least_to_goal(lattice, at):
    """A consistent lower bound of the cost to the nearest goal.

    The larger of the straight distance and the cost by joint: a move costs at least `slope` for each joint
    that it moves, and the last edge, from a corner of the goal's cell, is at least as long as its projection
    on the diagonal.
    """
    best = np.inf
    dof = len(at)
    diagonal = 1.0 / np.sqrt(dof)
    for goal in range(len(lattice.goals)):
        square, by_joint = 0.0, 0.0
        for j in range(dof):
            d = at[j] - lattice.goals_at[goal, j]
            square += d * d
            steps = max(lattice.cells[goal, j] - at[j], at[j] - lattice.cells[goal, j] - 1, 0)
            by_joint += steps * lattice.slope + (abs(d) - steps) * diagonal
        best = min(best, max(np.sqrt(square), by_joint))
    return max(np.int64(np.floor(UNITS * best - ROUNDING)), 0)


@allocation_free()
def least_between(lattice, a, b):
    """A lower bound of the cost between two nodes [units, not whole]; a metric."""
    square, by_joint = 0, 0
    for j in range(len(a)):
        square += (a[j] - b[j]) ** 2
        by_joint += abs(a[j] - b[j])
    return UNITS * max(np.sqrt(square), by_joint * lattice.slope)
