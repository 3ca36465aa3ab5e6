"""The next view: a pose from which nothing hides the space that the motion crosses."""

from dataclasses import replace

import numpy as np
import pytest

from helpers.commands import Said
from helpers.refusals import refuses
from robotdiffuse import Box, PlanResult, Problem, Scene, load_planner, load_robot, next_view
from robotdiffuse.collision.kernel_arrays import compile_robot
from robotdiffuse.perception.ray_caster import looking_at, ray_cast
from robotdiffuse.perception.visibility import ARM_CELL, seen_weights
from robotdiffuse.planning.exploration.viewpoints import poses_around

PANDA = load_robot("panda")
START = np.array([-0.9, 0.3, 0.0, -1.8, 0.0, 2.1, 0.8])
GOAL = np.array([0.9, 0.3, 0.0, -1.8, 0.0, 2.1, 0.8])
WALL = Scene([Box([0.75, 0.0, 0.35], [0.05, 1.2, 0.7])])
"""Ahead of the arm: a camera beyond sees nothing of what the arm crosses."""
INTRINSICS = (150.0, 150.0, 79.5, 59.5)
BEYOND, ABOVE = (looking_at(np.array(at), np.array([0.3, 0.0, 0.3])) for at in ([1.9, 0.0, 0.35], [0.3, 0.0, 1.9]))


@pytest.fixture(scope="module")
def problem() -> Problem:
    view = ray_cast(WALL, BEYOND, INTRINSICS, (160, 120), PANDA, START)
    return Problem(PANDA, Scene(), START, GOAL, views=(view,), unknown="optimistic")


@pytest.fixture(scope="module")
def result(problem: Problem) -> PlanResult:
    return load_planner("aorrtc").plan(problem, time_limit=2.0)


def test_what_hides_counts_as_often_as_it_is_there() -> None:
    """One voxel between two cameras along x, one of which sees it behind a voxel that is occupied at 0.5."""
    filled = np.zeros((20, 9, 9), np.float32)
    filled[14, 4, 4] = 0.5
    voxel = np.array([[8, 4, 4]])
    low = np.zeros(3, np.float32)
    middle = np.array([0.85, 0.45, 0.45])
    poses = [looking_at(middle + np.array([x, 0, 0]), middle) for x in (3.0, -3.0)]
    away = looking_at(middle + np.array([3, 0, 0]), middle + np.array([6, 0, 0]))
    intrinsics = np.array([100, 100, 50, 40], np.float32)
    stacked = np.stack([*poses, away]).astype(np.float32)
    far = np.float32(np.inf)
    above = np.tile(np.zeros(PANDA.dof, np.float32), (3, 1))
    scene = voxel, np.array([2.0], np.float32), filled, low + np.array([0, 1, 0], np.float32), np.float32(0.1)
    stacked[:, :3, 3] += [0, 1, 0]  # beside the arm
    seen = seen_weights(compile_robot(PANDA), above, stacked, intrinsics, (81, 101), far, *scene)
    np.testing.assert_allclose(seen, [1.0, 2.0, 0.0], rtol=1e-6)
    seen = seen_weights(compile_robot(PANDA), above, stacked, intrinsics, (81, 101), np.float32(2.9), *scene)
    np.testing.assert_allclose(seen, [0.0, 0.0, 0.0])


def test_the_arm_hides_what_is_behind_it() -> None:
    """Single voxels, beside the arm and behind it as the ray caster sees the arm."""
    filled = np.zeros((60, 60, 50), np.float32)
    low = np.array([-0.6, -0.6, 0.0], np.float32)
    edge = np.float32(0.02)
    camera = (600.0, 600.0, 319.5, 239.5)
    arm = ray_cast(Scene(), BEYOND, camera, (640, 480), PANDA, START).depth
    voxels = np.argwhere(filled == 0)[::397]
    x, y, z = (((voxels + 0.5) * edge + low - BEYOND[:3, 3]) @ BEYOND[:3, :3]).T
    rows = np.rint(600 * y / z + 239.5).astype(int)
    columns = np.rint(600 * x / z + 319.5).astype(int)
    image = (np.array(camera, np.float32), (480, 640))
    q = START.astype(np.float32)[None]
    pose = BEYOND[None].astype(np.float32)
    seen = []
    expected = []
    for i in np.flatnonzero((abs(rows - 240) < 239) & (abs(columns - 320) < 319)):
        around = np.s_[max(rows[i] - ARM_CELL, 0) : rows[i] + ARM_CELL, max(columns[i] - ARM_CELL, 0) : columns[i] + ARM_CELL]
        behind = arm[around] < z[i] - 0.2
        if behind.all() or np.isinf(arm[around]).all():
            one = voxels[i : i + 1], np.ones(1, np.float32), filled, low, edge
            expected.append(0.0 if behind.all() else 1.0)
            seen += seen_weights(compile_robot(PANDA), q, pose, *image, np.float32(np.inf), *one).tolist()
    assert min(expected.count(0.0), expected.count(1.0)) >= 3 and seen == expected


def test_it_looks_from_where_nothing_is_in_the_way(problem: Problem, result: PlanResult) -> None:
    found = next_view(problem, result, [BEYOND, ABOVE])
    assert np.array_equal(found.T_base_camera, ABOVE) and 0.2 < found.seen <= 1
    assert next_view(problem, result, [BEYOND]).seen < 0.1
    assert next_view(problem, result).seen >= max(next_view(problem, result, [T]).seen for T in poses_around()[::7])
    above = ray_cast(WALL, ABOVE, INTRINSICS, (160, 120), PANDA, START)
    seen_twice = replace(problem, scene=Scene(), views=(*problem.views, above))
    assert next_view(seen_twice, result, [ABOVE]).seen < found.seen


def test_misuse_is_refused(problem: Problem, result: PlanResult, said: Said) -> None:
    refuses("has no views", next_view, Problem(PANDA, Scene(), START, GOAL), result)
    refuses("poses is empty", next_view, problem, result, [])
    refuses("no motion", next_view, problem, replace(result, path=None, trajectory=None))
    refuses("T_base_camera", next_view, problem, result, [2 * np.eye(4)])
    assert "--next-view needs a problem with views" in said(2, "plan", "examples/two_spheres.yaml", "--next-view")
