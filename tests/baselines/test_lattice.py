"""A* and D* Lite on a lattice: least-cost paths, also after changes, within memory and time limits."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from helpers.box_arm import box_arm
from helpers.panda import LEFT, PANDA, RIGHT
from helpers.refusals import refuses
from robotdiffuse import Box, JointGoal, Problem, Scene, Sphere, Status, load_robot
from robotdiffuse.baselines.lattice import AStar, AStarSettings, DStarLite, DStarLiteSettings, LatticeSearch, Outcome
from robotdiffuse.collision import CollisionChecker
from robotdiffuse.collision.kernels.motions import motions_free
from robotdiffuse.collision.motions import search_space

ARM = box_arm()
AROUND = Problem(PANDA, Scene([Box([0.45, 0.0, 0.4], [0.3, 0.05, 0.8], name="wall")]), LEFT, JointGoal(RIGHT[None]))
SPACING = 0.35


def scene_of_spheres(rng: np.random.Generator, count: int = 5) -> Scene:
    angle = rng.uniform(-np.pi, np.pi, count)
    distance = rng.uniform(0.35, 1.3, count)
    centers = np.column_stack([distance * np.cos(angle), distance * np.sin(angle), np.zeros(count)])
    return Scene([Sphere(center, rng.uniform(0.05, 0.15)) for center in centers])


def arm_problem(seed: int) -> tuple[CollisionChecker, np.ndarray, np.ndarray, np.random.Generator]:
    rng = np.random.default_rng([5, seed])
    checker = CollisionChecker(ARM, scene_of_spheres(rng))
    q = rng.uniform(-2.5, 2.5, (300, 3))
    q = q[checker.free(q)]
    return checker, q[0].astype(np.float32), q[1:3].astype(np.float32), rng


def least_cost(checker: CollisionChecker, start: np.ndarray, goals: np.ndarray, most_joints: int) -> float:
    """The least cost by Dijkstra's algorithm over the whole graph."""
    origin = start.astype(float)
    low = np.ceil((ARM.lower - origin) / SPACING).astype(int)
    high = np.floor((ARM.upper - origin) / SPACING).astype(int)
    nodes = list(product(*(range(a, b + 1) for a, b in zip(low, high, strict=True))))
    number = {node: i for i, node in enumerate(nodes)}
    q = (origin + SPACING * np.array(nodes)).astype(np.float32)
    free = checker.free(q)
    space = search_space(checker, 0.01)
    graph: dict[tuple[int, int], float] = {}

    def join(i: int, k: int, there: np.ndarray, cost: float) -> None:
        # several goals in one cell would add up, so the least is kept
        if motions_free(space, np.stack([q[i], there]))[0]:
            graph[i, k] = min(cost, graph.get((i, k), np.inf))

    for move in product((-1, 0, 1), repeat=3):
        joints = sum(map(abs, move))
        if 0 < joints <= most_joints and next(step for step in move if step) > 0:
            for node, i in number.items():
                k = number.get(tuple(np.add(node, move)))
                if k is not None and free[i] and free[k]:
                    join(i, k, q[k], SPACING * np.sqrt(joints))
    for goal in goals:
        for node, i in number.items():
            if free[i] and set(np.array(node) - np.floor((goal - origin) / SPACING)) <= {0, 1}:
                join(i, len(nodes), goal, float(np.linalg.norm(origin + SPACING * np.array(node) - goal)))
    size = len(nodes) + 1
    matrix = coo_array((list(graph.values()), np.array(list(graph)).T), (size, size)).tocsr()
    return float(dijkstra(matrix, directed=False, indices=number[0, 0, 0])[-1])


def cost_of(search: LatticeSearch, checker: CollisionChecker) -> float:
    outcome = search.run()
    assert outcome in (Outcome.FOUND, Outcome.EXHAUSTED)
    path = search.path()
    assert (path is None) == (outcome is Outcome.EXHAUSTED)
    if path is None:
        return np.inf
    assert np.linalg.norm(np.diff(path, axis=0), axis=1).sum() == pytest.approx(search.cost, rel=1e-5, abs=1e-5)
    assert np.abs(search.goals - path[-1]).max(axis=1).min() < 1e-6
    assert motions_free(search_space(checker, 0.01), path.astype(np.float32)).all()
    return search.cost


@pytest.mark.parametrize("joints", [1, 2, 3])
@pytest.mark.parametrize("seed", range(3))
def test_both_find_the_least_cost_and_inflation_bounds_it(seed, joints):
    checker, start, goals, _ = arm_problem(seed)
    settings = {"spacing": SPACING, "joints_per_move": joints, "resolution": 0.01, "clearance": 0.0}
    a_star = LatticeSearch(checker, start, goals, AStarSettings(inflation=1.0, **settings))
    d_star = LatticeSearch(checker, start, goals, DStarLiteSettings(**settings))
    assert cost_of(a_star, checker) == pytest.approx(least_cost(checker, start, goals, joints), rel=1e-5)
    assert cost_of(d_star, checker) == a_star.cost
    fast = LatticeSearch(checker, start, goals, AStarSettings(inflation=2.0, **settings))
    assert a_star.cost - 1e-6 <= cost_of(fast, checker) <= 2 * a_star.cost + 1e-6
    assert fast.expansions <= a_star.expansions


@pytest.mark.parametrize("joints", [1, 2])
@pytest.mark.parametrize("seed", range(4))
def test_repairs_cost_what_a_new_search_costs(seed, joints):
    """Obstacles move, appear and disappear, while the arm moves along its path."""
    checker, start, goals, rng = arm_problem(seed)
    settings = DStarLiteSettings(spacing=0.3, joints_per_move=joints, resolution=0.02, clearance=0.0)
    search = LatticeSearch(checker, start, goals, settings)
    at = start
    cost_of(search, checker)
    for step in range(6):
        shapes = list(checker.scene.shapes)
        new = scene_of_spheres(rng).shapes
        if step % 3 == 0:
            shapes[rng.integers(len(shapes))] = new[0]
        elif step % 3 == 1:
            shapes.pop()
        else:
            shapes += new[1:3]
        checker = CollisionChecker(ARM, Scene(shapes))
        path = search.path()
        if step % 2 and path is not None and len(path) > 2:
            at = path[1]
        search.update(checker, at)
        fresh = LatticeSearch(checker, start, goals, settings)
        # exactly the same lattice, searched from the node where the arm stands
        fresh.update(checker, at)
        assert cost_of(search, checker) == cost_of(fresh, checker)
        if checker.free(at[None])[0]:
            a_star = AStarSettings(spacing=0.3, joints_per_move=joints, resolution=0.02, clearance=0.0, inflation=1.0)
            other = LatticeSearch(checker, at.astype(np.float32), goals, a_star)
            assert search.cost == pytest.approx(cost_of(other, checker), rel=1e-4)


def test_repairs_of_small_changes_expand_less():
    repaired = fresh = 0
    for seed in range(6):
        checker, start, goals, rng = arm_problem(seed)
        settings = DStarLiteSettings(spacing=0.15, resolution=0.02, clearance=0.0)
        search = LatticeSearch(checker, start, goals[:1], settings)
        cost_of(search, checker)
        before = search.expansions
        shapes = list(checker.scene.shapes)
        shapes[0] = Sphere(shapes[0].center + rng.normal(0, 0.02, 3) * [1, 1, 0], shapes[0].radius)  # type: ignore[union-attr]
        checker = CollisionChecker(ARM, Scene(shapes))
        search.update(checker, start)
        new = LatticeSearch(checker, start, goals[:1], settings)
        assert cost_of(search, checker) == cost_of(new, checker)
        repaired += search.expansions - before
        fresh += new.expansions
    assert repaired < 0.5 * fresh


def test_start_buried_and_freed_again():
    checker, start, goals, _ = arm_problem(0)
    search = LatticeSearch(checker, start, goals, DStarLiteSettings(spacing=0.3, clearance=0.0))
    cost = cost_of(search, checker)
    assert cost < np.inf
    search.update(CollisionChecker(ARM, Scene([*checker.scene.shapes, Box([0.0, 0.0, 0.0], [4.0, 4.0, 1.0])])), start)
    assert search.run() is Outcome.EXHAUSTED and search.path() is None
    search.update(checker, start)
    assert cost_of(search, checker) == cost


@pytest.mark.parametrize(
    ("planner", "settings"), [(AStar, AStarSettings(spacing=0.1, max_nodes=300)), (DStarLite, DStarLiteSettings(max_nodes=300))]
)
def test_full_memory_and_the_time_limit_are_reported(planner, settings):
    result = planner(settings).plan(AROUND, time_limit=5.0)
    assert result.status is Status.NO_PATH
    assert "memory is full" in result.reason and "coarser" in result.reason
    result = planner(replace(settings, spacing=0.08, max_nodes=10**7)).plan(AROUND, time_limit=0.1)
    assert result.status is Status.TIMEOUT and "expansions" in result.reason


@pytest.mark.slow
@pytest.mark.parametrize("settings", [AStarSettings(), DStarLiteSettings()])
def test_two_arms_do_not_outrun_the_time_limit(settings: AStarSettings | DStarLiteSettings) -> None:
    """Regression: with 14 joints, 200 expansions between two readings of the clock checked 78,400 edges in a second."""
    baxter = load_robot("baxter")
    checker = CollisionChecker(baxter, Scene())
    q = np.random.default_rng(0).uniform(baxter.lower, baxter.upper, (2000, 14)).astype(np.float32)
    start, goal = q[checker.free(q)][6:8]  # far from each other
    running = LatticeSearch(checker, start, goal[None], replace(settings, max_nodes=60_000))
    looks = [0]

    def stop() -> bool:
        looks.extend([running.expansions] if running.expansions else [])  # at first, corners around goals are connected
        return len(looks) == 4

    assert running.run(stop) is Outcome.GOING
    edges = {1: 28, 2: 392}[settings.joints_per_move]
    assert np.diff(looks).min() > 0 and edges * np.diff(looks).max() <= 4000


def test_too_many_nodes_or_edges_are_refused() -> None:
    baxter = CollisionChecker(load_robot("baxter"), Scene())
    refuses(r"spacing is 0.001.*use at least 0.0", AStar(AStarSettings(spacing=0.001)).plan, AROUND)
    edges = "joints_per_move is 14; on baxter .* 4782968 edges.* at most 100000"
    refuses(edges, LatticeSearch, baxter, np.zeros(14), np.zeros((1, 14)), AStarSettings(joints_per_move=14))
