"""Shared-Tree Informed RRT*: optimal in the limit, many goals at once, a safety distance, always verified."""

from dataclasses import replace
from itertools import pairwise, product
from math import gcd

import numpy as np
import pytest
from hypothesis import given, strategies as st
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

import robotdiffuse as rd
from helpers.box_arm import box_arm
from helpers.panda import LEFT, PANDA, RIGHT
from robotdiffuse.collision import CollisionChecker
from robotdiffuse.collision.kernels.random import random_state
from robotdiffuse.collision.motions import search_space
from robotdiffuse.planning.search import rrt_kernel, shared_tree
from robotdiffuse.planning.search.shared_tree import SharedTreeSearch

WALL = rd.Scene([rd.Box([0.45, 0.0, 0.25], [0.3, 0.05, 0.5], name="wall")])
ENDLESS = shared_tree.SharedTreeSettings(improvement=0.0)
TOUCHING = replace(ENDLESS, safety_distance=0.0)


def two_joints():
    arm = box_arm().with_locked({box_arm().joint_names[2]: 0.0})
    return replace(arm, allowed_collisions=frozenset(map(frozenset, (("l1", "l2"), ("l1", "l3"), ("l2", "l3")))))


def grid_optimum(checker: CollisionChecker, start: np.ndarray, goal: np.ndarray, cells: int) -> float:
    """Length of the shortest path over a grid with steps in 64 directions, at most 0.4 % too long."""
    axis = np.linspace(-2.8, 2.8, cells)
    h = axis[1] - axis[0]
    free = checker.free(np.array(list(product(axis, axis)))).reshape(cells, cells)
    steps = [(i, j) for i, j in product(range(-5, 6), repeat=2) if gcd(i, j) == 1]
    number = np.arange(cells * cells).reshape(cells, cells)
    edges = []
    for i, j in steps:
        here = np.s_[max(0, -i) : cells - max(0, i), max(0, -j) : cells - max(0, j)]
        there = np.s_[max(0, i) : cells - max(0, -i), max(0, j) : cells - max(0, -j)]
        open_ = free[here] & free[there]
        # nodes that a long step passes over must be free too
        for t in np.arange(1, max(abs(i), abs(j))) / max(abs(i), abs(j)):
            a = round(t * i)
            b = round(t * j)
            open_ = open_ & free[np.s_[max(0, -i) + a : cells - max(0, i) + a, max(0, -j) + b : cells - max(0, j) + b]]
        a, b = number[here][open_], number[there][open_]
        edges.append((np.full(len(a), h * np.hypot(i, j)), a, b))
    lengths, rows, columns = map(np.concatenate, zip(*edges, strict=True))
    graph = coo_array((lengths, (rows, columns)), (cells**2, cells**2))
    a, b = (number[tuple(np.abs(axis - x).argmin() for x in q)] for q in (start, goal))
    return float(dijkstra(graph.tocsr(), indices=a)[b])


def test_rrt_star_alone_converges_to_the_optimum() -> None:
    """Choose-parent and rewiring, without RRT-Connect and shortcuts, as asymptotic optimality requires."""
    checker = CollisionChecker(two_joints(), rd.Scene([rd.Sphere([0.75, 0.0, 0.0], 0.2), rd.Sphere([-0.3, 0.7, 0.0], 0.15)]))
    axis = np.linspace(-2.8, 2.8, 281)
    start, goal = (np.array([axis[np.abs(axis - x).argmin()] for x in q]) for q in ((-0.9, 0.3), (0.9, -0.5)))
    assert checker.free(np.stack([start, goal])).all()
    optimum = grid_optimum(checker, start, goal, 281)
    assert optimum > 1.1 * np.linalg.norm(goal - start), "the straight line must not do"
    space = search_space(checker, 0.01)
    start = start.astype(np.float32)
    trees = rrt_kernel.make_trees(start, np.empty((0, 2), np.float32), 60_000)
    goals = shared_tree.make_goals(start, goal[None])
    state = random_state(0)
    costs = []
    for iterations in (500, 3_000, 30_000):
        shared_tree.grow(space, trees, goals, np.float32(0.5), iterations, state)
        costs.append(float(trees.costs[0, goals.node[0]]) / optimum)
    assert costs[0] > costs[1] > costs[2]
    # the grid's own error: 0.4 % of direction, and cells of 0.02 rad at the obstacle's edge
    assert 0.985 < costs[2] < 1.01
    # rounds with both get there quickly
    search = SharedTreeSearch(checker, start, goal[None], replace(TOUCHING, resolution=0.01), random_state(1))
    for _ in range(40):
        search.round()
    assert 0.985 < search.cost / optimum < 1.01
    assert all(a >= b for a, b in pairwise(search.costs))


@pytest.mark.parametrize("capacity", [1_000, 200])
def test_the_tree_stays_a_tree(capacity: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shared_tree, "CAPACITY", capacity)
    goals = RIGHT + np.pad([[0.0, 0.0, 0.0], [0.2, 0.2, 0.0], [0.1, -0.3, 0.3]], ((0, 0), (0, 4)))
    search = SharedTreeSearch(CollisionChecker(PANDA, WALL), LEFT, goals, replace(TOUCHING, growth=200), random_state(2))
    for _ in range(4):
        search.round()
    assert 64 < search.tree.sizes[0] <= capacity
    trees = search.tree
    for node in range(1, int(trees.sizes[0])):
        parent = int(trees.parents[0, node])
        gap = np.linalg.norm(trees.nodes[0, node].astype(float) - trees.nodes[0, parent])
        assert abs(trees.costs[0, node] - trees.costs[0, parent] - gap) < 1e-3
        siblings = []
        child = int(trees.children[0, parent])
        while child >= 0:
            siblings.append(child)
            child = int(trees.siblings[0, child])
        assert siblings.count(node) == 1
    for g, cost in enumerate(search.goal_costs):
        path = rrt_kernel.branch(trees, 0, search.targets.node[g])
        if len(path):
            np.testing.assert_allclose(np.linalg.norm(np.diff(path, axis=0), axis=1).sum(), cost, rtol=1e-4)
            np.testing.assert_array_equal(path[[0, -1]], np.stack([LEFT, goals[g]]).astype(np.float32))


@given(st.integers(1, 400), st.integers(1, 7), st.integers(1, 40), st.integers(0, 2**31))
def test_nearest_nodes_are_those_of_brute_force(count: int, dof: int, most: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    # rounded: many equal coordinates, and copies
    points = rng.normal(size=(count, dof)).round(int(rng.integers(1, 6))).astype(np.float32)
    trees = rrt_kernel.make_trees(points[0], points, count)
    index = np.empty(most, np.int32)
    squares = np.empty(most, np.float32)
    for q in rng.normal(size=(5, dof)).astype(np.float32):
        found = rrt_kernel.nearest_few(trees, 1, q, index, squares)
        assert found == min(most, count) == len(set(index[:found].tolist()))
        expected = ((points - q) ** 2).sum(axis=1)
        np.testing.assert_allclose(squares[:found], expected[index[:found]], rtol=1e-5, atol=1e-10)
        np.testing.assert_allclose(squares[:found], np.sort(expected)[:found], rtol=1e-5, atol=1e-10)


def test_samples_fill_the_hyperspheroid_evenly() -> None:
    """Every sample can lie on a shorter path; the share of samples in a smaller spheroid is that of its volume."""
    a, b = np.random.default_rng(0).normal(size=(2, 4)).astype(np.float32)
    wide = np.full(4, 100, np.float32)
    space = search_space(CollisionChecker(PANDA, WALL), 0.04)._replace(lower=-wide, upper=wide)
    gap = np.float32(np.linalg.norm(b - a))
    state = random_state(0)
    inner, length = np.float32(1.2) * gap, np.float32(1.5) * gap
    out = np.empty(4, np.float32)
    sums = []
    for _ in range(20_000):
        rrt_kernel.sample_within(space, a, b, length, out, state)
        sums.append(np.linalg.norm(out - a) + np.linalg.norm(out - b))
    assert max(sums) <= length * 1.0001
    volume = [c * (c**2 - gap**2) ** 1.5 for c in (inner, length)]
    share = np.mean(np.array(sums) < inner)
    expected = volume[0] / volume[1]
    assert abs(share - expected) < 4 * np.sqrt(expected / 20_000)
    shares = rrt_kernel.goal_shares(a, np.stack([b, b + np.float32(0.1)]), length)
    assert 0 < shares[0] < shares[1] == 1


def test_the_cheapest_goal_wins_and_every_goal_has_its_cost() -> None:
    goals = np.stack([RIGHT, RIGHT, LEFT])
    goals[1:, :2] += [[0.2, 0.2], [0.1, 0.4]]
    checker = CollisionChecker(PANDA, WALL)
    assert checker.free(goals).all()
    search = SharedTreeSearch(checker, LEFT, goals, TOUCHING, random_state(0))
    assert search.best_goal == 2 and search.finished, "its straight line is free: nothing can be shorter"
    search = SharedTreeSearch(checker, LEFT, goals[:2], TOUCHING, random_state(0))
    for _ in range(30):
        search.round()
    costs = search.goal_costs
    assert np.isfinite(costs[search.best_goal]) and search.cost == costs.min()
    single = [SharedTreeSearch(checker, LEFT, g[None], TOUCHING, random_state(1)) for g in goals[:2]]
    for other in single:
        for _ in range(30):
            other.round()
    assert search.cost < 1.02 * min(other.cost for other in single)


def searched(checker: CollisionChecker, start: np.ndarray, distance: float) -> tuple[SharedTreeSearch, np.ndarray]:
    settings = replace(ENDLESS, safety_distance=distance, resolution=0.01)
    search = SharedTreeSearch(checker, start, RIGHT[None], settings, random_state(0))
    for _ in range(10):
        search.round()
    path = search.path()
    assert path is not None
    return search, np.concatenate([a + np.linspace(0, 1, 60)[:, None] * (b - a) for a, b in pairwise(path)])


def test_the_safety_distance_is_kept() -> None:
    checker = CollisionChecker(PANDA, WALL)
    assert (checker.link_clearances(np.stack([LEFT, RIGHT])).min(axis=1) > 0.06).all()
    for distance in (0.0, 0.05):
        search, fine = searched(checker, LEFT, distance)
        assert search.safety_distance == distance
        least = checker.link_clearances(fine).min()
        assert distance - 0.002 < least < distance + 0.02, "the shortest way passes at this distance"


def test_near_a_close_end_the_distance_is_relaxed() -> None:
    checker = CollisionChecker(PANDA, WALL)
    close = LEFT.copy()
    while checker.link_clearances(close[None]).min() > 0.01:
        close[0] -= 0.002
    search, fine = searched(checker, close, 0.05)
    assert search.safety_distance == 0.05
    clearance = checker.link_clearances(fine).min(axis=1)
    away = np.linalg.norm(fine - close, axis=1)
    allowed = np.minimum(0.05, clearance[0] + 0.1 * (away + 0.1))
    assert clearance[0] < 0.01 < 0.04 < clearance[away > 0.6].min()
    # half a step of the relaxation, and what hides between two checks
    assert (clearance > np.minimum(0.05, clearance[0] + 0.1 * away) - 0.01).all(), allowed


def test_a_gap_too_narrow_for_the_distance_lowers_it() -> None:
    """A robot with one joint must pass between two balls, 1.1 cm from each."""
    arm = two_joints()
    arm = arm.with_locked({arm.joint_names[1]: 0.0})
    checker = CollisionChecker(arm, rd.Scene([rd.Sphere([0.87, 0.0, side * 0.16], 0.1) for side in (1, -1)]))
    start, goal = np.array([[-0.9], [0.9]])
    assert 0.01 < checker.link_clearances(np.linspace(start, goal, 200)).min() < 0.02
    search = SharedTreeSearch(checker, start, goal[None], ENDLESS, random_state(0))
    search.run(lambda: search.cost < np.inf)
    assert search.safety_distance == pytest.approx(0.01) and search.cost == pytest.approx(1.8)


def test_what_ends_a_search_without_a_path() -> None:
    walls = [rd.Box([side * 0.65, 0.0, 0.5], [1.0, 0.02, 3.0]) for side in (1, -1)]
    sealed = rd.Scene([*walls, rd.Box([0.0, 0.0, 1.35], [3.0, 0.02, 1.3])])
    problem = rd.Problem(PANDA, sealed, LEFT, rd.JointGoal(RIGHT[None]))
    for step_rounds, limit, status in ((10**9, 0.3, rd.Status.TIMEOUT), (1, 60.0, rd.Status.NO_PATH)):
        settings = shared_tree.SharedTreeSettings(step_rounds=step_rounds, growth=10, connect_iterations=10)
        result = shared_tree.SharedTreeRRTStar(settings).plan(problem, time_limit=limit)
        assert result.status is status and result.path is None and result.reason
    settings = replace(TOUCHING, growth=1, connect_iterations=1, step_rounds=1, rounds=5)
    search = SharedTreeSearch(CollisionChecker(PANDA, WALL), LEFT, RIGHT[None], settings, random_state(0))
    search.run()
    assert search.best_goal == -1 and len(search.costs) == 5
