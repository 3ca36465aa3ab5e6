"""RRT-Connect: every solution is verified, ends are exact, the same seed gives the same path."""

import re

import numpy as np
import pytest

from robotdiffuse import Box, JointGoal, PoseGoal, Problem, Scene, Sphere, Status, load_robot, verify
from robotdiffuse.collision import CollisionChecker
from robotdiffuse.collision.exact_meshes import explain_collision
from robotdiffuse.collision.kernels.motions import motions_free, path_length
from robotdiffuse.collision.kernels.random import random_state
from robotdiffuse.collision.motions import search_space
from robotdiffuse.planning import start_goal
from robotdiffuse.planning.search import rrt_kernel
from robotdiffuse.planning.search.rrt import RRTConnect, RRTConnectSettings
from robotdiffuse.planning.start_goal import retreat
from robotdiffuse.problems.families.rop import ROP, ROP_DENSE
from robotdiffuse.robots.kinematics import link_pose
from robotdiffuse.trajectories.simplification import shortcut

PANDA = load_robot("panda")
READY = np.array([0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785])
WALL = Scene([Box([0.45, 0.0, 0.4], [0.3, 0.05, 0.8], name="wall")])
SEALED = Scene(
    [
        Box([0.65, 0.0, 0.5], [1.0, 0.02, 3.0]),
        Box([-0.65, 0.0, 0.5], [1.0, 0.02, 3.0]),
        Box([0.0, 0.0, 1.35], [3.0, 0.02, 1.3]),
    ]
)
LEFT = np.array([0.9, 0.3, 0.0, -1.9, 0.0, 2.2, 0.785])
RIGHT = np.array([-0.9, 0.3, 0.0, -1.9, 0.0, 2.2, 0.785])


@pytest.mark.parametrize("family", [ROP, ROP_DENSE], ids=["rop", "rop_dense"])
@pytest.mark.parametrize("index", range(3))
def test_solved_means_verified(family, index):
    problem = family.draw(PANDA, np.random.default_rng([11, index])).problem(PANDA)
    result = RRTConnect().plan(problem, time_limit=2.0)
    assert result.status in (Status.SOLVED, Status.TIMEOUT)
    if result.solved:
        assert result.path is not None and verify(problem, result.path).valid
        assert np.array_equal(result.path.positions[0], problem.start)
        assert isinstance(problem.goal, JointGoal)
        assert np.array_equal(result.path.positions[-1], problem.goal.positions[0])


def test_around_a_wall_and_the_same_again():
    problem = Problem(PANDA, WALL, LEFT, JointGoal(RIGHT[None]))
    first, second = (RRTConnect().plan(problem, 60.0, seed=4) for _ in range(2))
    assert first.path is not None and second.path is not None
    assert np.array_equal(first.path.positions, second.path.positions)
    other = RRTConnect().plan(problem, 60.0, seed=5)
    assert other.path is not None and not np.array_equal(first.path.positions, other.path.positions)


def test_longer_optimization_does_not_lengthen():
    problem = Problem(PANDA, WALL, LEFT, JointGoal(RIGHT[None]))
    once = RRTConnect().plan(problem, 60.0, objective="length")
    longer = RRTConnect(RRTConnectSettings(optimize_time=0.3)).plan(problem, 60.0, objective="length")
    assert once.path_length is not None and longer.path_length is not None
    assert longer.path_length <= once.path_length + 1e-6


def test_shortcuts_keep_ends_and_freedom_and_do_not_lengthen():
    problem = Problem(PANDA, WALL, LEFT, JointGoal(RIGHT[None]))
    space = search_space(CollisionChecker(PANDA, problem.scene), 0.04)
    for seed in range(5):
        state = random_state(seed)
        trees = rrt_kernel.make_trees(LEFT.astype(np.float32), RIGHT[None].astype(np.float32), 5000)
        path = rrt_kernel.search(space, None, trees, rrt_kernel.INFINITE, np.float32(1.0), 100_000, state)
        short = shortcut(space, path, 50, state)
        assert np.array_equal(short[[0, -1]], path[[0, -1]])
        assert path_length(short) <= path_length(path) + 1e-4
        assert motions_free(space, short).all()
        in_double = shortcut(space, path.astype(np.float64), 0, state)
        assert np.array_equal(in_double, shortcut(space, path, 0, state))


def test_search_can_be_continued():
    space = search_space(CollisionChecker(PANDA, WALL), 0.04)
    trees = rrt_kernel.make_trees(LEFT.astype(np.float32), RIGHT[None].astype(np.float32), 5000)
    state = random_state(1)
    sizes = []
    for _ in range(1000):
        if len(rrt_kernel.search(space, None, trees, rrt_kernel.INFINITE, np.float32(0.3), 1, state)):
            break
        sizes.append(trees.sizes.sum())
    assert len(sizes) > 1 and (np.diff(sizes) >= 0).all() and sizes[-1] > sizes[0]


def test_retreat_from_contact_of_the_spheres():
    """A start whose meshes are free while the covering spheres around them are not."""
    ahead = link_pose(PANDA, READY, "panda_hand")[:3, 3] - [0.0, 0.0, 0.2]
    for radius in np.arange(0.1, 0.05, -0.0002):
        scene = Scene([Sphere(ahead, radius)])
        if explain_collision(PANDA, scene, READY) is None:
            break
    checker = CollisionChecker(PANDA, scene)
    assert not checker.free(READY[None])[0]
    lead = retreat(checker, READY)
    assert lead is not None and checker.free(lead[None])[0]
    assert np.abs(lead - READY).max() < 0.3


@pytest.mark.parametrize("end", ["start", "goal"])
def test_ends_too_close_to_contact_name_link_obstacle_and_depth(end, monkeypatch):
    """Regression: a state free by the meshes but not by the spheres, without a way out, was an immediate
    timeout."""
    ahead = link_pose(PANDA, READY, "panda_hand")[:3, 3] - [0.0, 0.0, 0.2]
    radii = np.arange(0.1, 0.05, -0.0002)
    scenes = (Scene([Sphere(ahead, radius, name="ball")]) for radius in radii)
    scene = next(scene for scene in scenes if explain_collision(PANDA, scene, READY) is None)
    monkeypatch.setattr(start_goal, "RETREAT_STEPS", 1)
    rows = (READY, LEFT) if end == "start" else (LEFT, READY)
    result = RRTConnect().plan(Problem(PANDA, scene, rows[0], rows[1]))
    assert result.status is (Status.INVALID_START if end == "start" else Status.INVALID_GOAL)
    told = re.search(r"spheres of (\w+) reach ([\d.]+) mm into ball, .* are ([\d.]+) mm apart", result.reason)
    assert told and told[1].startswith("panda_") and result.reason.startswith(f"the {end} is too close")
    assert float(told[2]) > 0 and float(told[3]) >= 0


def test_start_in_collision_names_link_and_obstacle():
    scene = Scene([Sphere(link_pose(PANDA, READY, "panda_link5")[:3, 3], 0.1, name="ball")])
    result = RRTConnect().plan(Problem(PANDA, scene, READY, JointGoal(LEFT[None])))
    assert result.status is Status.INVALID_START and result.path is None
    assert "ball" in result.reason and "panda_link" in result.reason


def test_out_of_reach():
    T = np.eye(4)
    T[:3, 3] = [2.0, 0.0, 0.5]
    result = RRTConnect().plan(Problem(PANDA, Scene(), READY, PoseGoal("panda_hand", T)))
    assert result.status is Status.UNREACHABLE_GOAL and "panda_hand" in result.reason


def test_no_way_through_times_out():
    """A wall between start and goal, with a gap only for the base: the search ends with the time limit."""
    checker = CollisionChecker(PANDA, SEALED)
    assert checker.free(np.stack([LEFT, RIGHT])).all()
    result = RRTConnect().plan(Problem(PANDA, SEALED, LEFT, JointGoal(RIGHT[None])), time_limit=0.3)
    assert result.status is Status.TIMEOUT and result.path is None and "no path was found in" in result.reason
