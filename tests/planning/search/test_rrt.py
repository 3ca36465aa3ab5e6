"""AORRTC and RRT-Connect: paths below the length bound, shorter with time; starts and goals near contact; reasons."""

import re
import time
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

import robotdiffuse as rd
from helpers.panda import HOME, LEFT, PANDA, RIGHT
from helpers.refusals import refuses
from robotdiffuse.collision import CollisionChecker
from robotdiffuse.collision.exact_meshes import explain_collision
from robotdiffuse.collision.kernels.motions import motions_free, path_length
from robotdiffuse.collision.kernels.random import random_state
from robotdiffuse.collision.motions import search_space
from robotdiffuse.planning import context, start_goal
from robotdiffuse.planning.search import rrt_kernel
from robotdiffuse.planning.search.rrt import AORRTC, AORRTCSettings, RRTConnect
from robotdiffuse.problems.files import held_out_problem
from robotdiffuse.trajectories.simplification import simplify, tighten
from robotdiffuse.trajectories.timing import Timing, time_parameterize

WALL = rd.Scene([rd.Box([0.45, 0.0, 0.4], [0.3, 0.05, 0.8], name="wall")])
AROUND = rd.Problem(PANDA, WALL, LEFT, RIGHT)
ENDS = LEFT.astype(np.float32), RIGHT[None].astype(np.float32)


def test_paths_are_below_the_bound_and_join_the_ends() -> None:
    space = search_space(CollisionChecker(PANDA, WALL), 0.04)
    start, goals = ENDS
    bound = np.float32(np.inf)
    found = 0
    state = random_state(0)
    for _ in range(20):
        trees = rrt_kernel.make_trees(start, goals, 20_000)
        path = rrt_kernel.search(space, None, trees, bound, np.float32(1.0), 5_000, state)
        if not len(path):
            break
        assert path_length(path) <= bound + 1e-4
        assert np.array_equal(path[0], start) and np.array_equal(path[-1], goals[0]) and motions_free(space, path).all()
        for tree in (0, 1):  # costs are the lengths of the ways from the roots
            size = trees.sizes[tree]
            nodes = trees.nodes[tree, :size]
            parents = trees.parents[tree, :size]
            costs = trees.costs[tree, :size]
            for n in np.flatnonzero(parents >= 0):
                assert costs[n] == pytest.approx(costs[parents[n]] + np.linalg.norm(nodes[n] - nodes[parents[n]]), abs=1e-3)
        bound = np.float32(path_length(path))
        found = found + 1
    assert found >= 3


@pytest.mark.parametrize("limit", [2.0, 0.05])
def test_trees_that_are_kept_hold_free_edges_and_change_no_path(limit: float) -> None:
    walls = [rd.Box([x, 0.0, 0.6], [1.4, 0.05, 2.4], name=f"wall{x}") for x in (-0.95, 0.95)]
    scene = WALL if limit > 1 else rd.Scene([*walls, rd.Box([0.0, 0.0, 1.2], [0.6, 0.05, 0.6], name="above")])
    problem = replace(AROUND, scene=scene)
    kept = AORRTC(AORRTCSettings(keep_trees=True)).plan(problem, limit, until="first")
    plain = AORRTC().plan(problem, limit, until="first")
    assert plain.trees == () and len(kept.trees) == 2
    assert limit < 1 or (kept.solved and plain.solved)
    if kept.path is not None and plain.path is not None:
        assert np.array_equal(kept.path.positions, plain.path.positions)
    space = search_space(CollisionChecker(PANDA, problem.scene), 0.04)
    for tree, root in zip(kept.trees, (LEFT, RIGHT), strict=True):
        children = np.flatnonzero(tree.parents >= 0)
        assert np.array_equal(tree.nodes[0], root.astype(np.float32)) and len(children)
        for child in children:
            parent = tree.parents[child]
            assert parent < child and motions_free(space, tree.nodes[[parent, child]]).all()
    assert "trees" not in kept.record()


@pytest.mark.parametrize("planner", [AORRTC(), RRTConnect()], ids=["aorrtc", "rrt_connect"])
def test_more_time_gives_no_longer_paths(planner: AORRTC | RRTConnect) -> None:
    planner.plan(AROUND, 1e-3)  # compiles
    longest = np.inf
    for until in ("first", "converged", "time_limit"):
        result = planner.plan(AROUND, 1.0, seed=3, until=until, objective="length")
        assert result.path_length <= longest and rd.verify(AROUND, result.path).valid
        longest = result.path_length
        lengths = [length for _, length in result.progress]
        assert lengths == sorted(lengths, reverse=True) and lengths[-1] == result.path_length


def test_the_clearance_is_kept_or_a_note_says_otherwise() -> None:
    for asked in (0.0, 0.02, 0.05):
        result = AORRTC().plan(AROUND, 5.0, clearance=asked)
        assert result.scene_clearance is not None
        least = CollisionChecker(PANDA, WALL)
        segments = pairwise(result.trajectory.positions)  # rounded corners keep it too
        assert least.link_clearances(np.concatenate([np.linspace(a, b, 5) for a, b in segments])).min() >= asked - 0.002
        assert not any("clearance" in note for note in result.notes)
    wide = AORRTC().plan(replace(AROUND, clearance=0.05), 5.0)
    less = AORRTC().plan(replace(AROUND, clearance=0.05), 5.0, clearance=0.0)
    assert wide.duration > less.duration, "the clearance of a call overrides that of the problem"
    # between the plates the arm cannot keep 20 cm
    narrow = AORRTC().plan(AROUND, 5.0, clearance=0.3)
    assert narrow.solved and any("clearance of 30 cm" in note for note in narrow.notes)


def test_limits_slow_motions_down_and_gain_zero_does_not_end_the_search() -> None:
    asked = {}, {"velocity_scaling": 0.5, "acceleration_scaling": 0.25}, {"jerk": 100.0}
    free, half, gentle = (AORRTC().plan(AROUND, 20.0, until="first", **one).trajectory for one in asked)
    assert half.duration == pytest.approx(2 * free.duration, rel=0.01)
    assert np.abs(np.diff(gentle.accelerations, axis=0) / np.diff(gentle.times)[:, None]).max() <= 100.0 * (1 + 1e-6)
    assert free.duration < gentle.duration < 2 * free.duration
    # Regression: with `gain` 0 the search stopped at once if there was no path at half the work.
    result = AORRTC(AORRTCSettings(gain=0.0, patience=0)).plan(AROUND, 1.0)
    assert result.solved and len(result.progress) > 1


def test_arguments_are_checked() -> None:
    refuses("length, time", AORRTC().plan, AROUND, objective="energy")
    refuses("clearance is nan", AORRTC().plan, AROUND, clearance=float("nan"))
    refuses(r"clearance is 5\.0; it must be between 0 and 0\.5", AORRTC().plan, AROUND, clearance=5.0)
    refuses(r"velocity_scaling is 0\.0; it must be between 0.001 and 1", AORRTC().plan, AROUND, velocity_scaling=0.0)
    refuses(r"acceleration_scaling is 1\.5", AORRTC().plan, AROUND, acceleration_scaling=1.5)
    refuses(r"jerk is 1e-05; it must be at least 0\.01", AORRTC().plan, AROUND, jerk=1e-5)


def test_one_slow_validation_does_not_use_up_later_calls(monkeypatch: pytest.MonkeyPatch) -> None:
    """Regression: a first call, which loaded kernels, validated for a second; shorter calls then ended at once."""
    late = [0.0]

    def slow(*arguments: Any, **others: Any) -> Timing:
        late[0] += 1.0
        return time_parameterize(*arguments, **others)

    monkeypatch.setattr(time, "perf_counter", lambda: time.process_time() + late[0])
    AORRTC().plan(AROUND)
    with monkeypatch.context() as patch:
        patch.setattr(context, "time_parameterize", slow)
        AORRTC().plan(AROUND, 3.0)
    for _ in range(2):
        assert AORRTC().plan(AROUND, 0.3, until="time_limit").solved


def test_simplification_keeps_ends_and_freedom_and_does_not_lengthen() -> None:
    space = search_space(CollisionChecker(PANDA, WALL), 0.04)
    for seed in range(5):
        state = random_state(seed)
        trees = rrt_kernel.make_trees(*ENDS, 5_000)
        path = rrt_kernel.search(space, None, trees, rrt_kernel.INFINITE, np.float32(1.0), 100_000, state)
        for rounds, tries in ((0, 0), (1, 0), (4, 10), (1, 300)):
            short = tighten(space, simplify(space, path, rounds), tries, state)
            assert np.array_equal(short[[0, -1]], path[[0, -1]])
            assert path_length(short) <= path_length(path) + 1e-4 and motions_free(space, short).all()
        assert np.array_equal(simplify(space, path.astype(np.float64), 0), simplify(space, path, 0))


def test_a_long_detour_is_replaced() -> None:
    """Regression: in a bounded number of rounds, nothing shorter was found than a first path around a shelf."""
    problem = replace(held_out_problem("shelf", 3), clearance=0.0)
    assert AORRTC(AORRTCSettings(patience=40_000)).plan(problem, time_limit=60.0).path.length < 8.0


def test_a_step_of_nearly_a_whole_turn_is_two_steps() -> None:
    """On the free way, a continuous joint turns by 5.84 rad, which the validator refuses as one step."""
    start, goal = (np.array([turn, 1.4, 0.0, 0.3, 0.0, 0.0, 0.0]) for turn in (0.22, -0.22))
    problem = rd.Problem(rd.load_robot("gen3"), rd.Scene([rd.Box([0.9, 0.0, 0.5], [0.8, 0.02, 1.6])]), start, goal)
    result = AORRTC().plan(problem, until="first")
    assert result.solved and result.stage == "straight_line"
    assert rd.verify(problem, result.path).valid and rd.verify(problem, result.trajectory).valid


def test_a_line_that_is_always_refused_does_not_end_the_search(monkeypatch: pytest.MonkeyPatch) -> None:
    finish = context.PlanningContext.finish

    def refusing(self: Any, waypoints: np.ndarray, *rest: Any, **options: Any) -> Any:
        return finish(self, waypoints, *rest, **options) if len(waypoints) > 2 else None

    monkeypatch.setattr(context.PlanningContext, "finish", refusing)
    result = AORRTC().plan(rd.Problem(PANDA, rd.Scene(), LEFT, RIGHT), time_limit=20.0, until="first")
    assert result.solved and len(result.path.positions) > 2


@pytest.mark.parametrize("end", ["start", "goal"])
def test_ends_free_by_the_meshes_but_not_by_the_spheres_are_left_or_named(end, monkeypatch):
    """Regression: a start or goal without a way out was an immediate timeout."""
    ahead = PANDA.fk(HOME, "panda_hand")[:3, 3] - [0.0, 0.0, 0.2]
    scenes = (rd.Scene([rd.Sphere(ahead, radius, name="ball")]) for radius in np.arange(0.1, 0.05, -0.0002))
    scene = next(scene for scene in scenes if explain_collision(PANDA, scene, HOME) is None)
    checker = CollisionChecker(PANDA, scene)
    lead = start_goal.retreat(checker, HOME)
    assert lead is not None and checker.free(np.stack([HOME, lead])).tolist() == [False, True]
    assert np.abs(lead - HOME).max() < 0.3
    monkeypatch.setattr(start_goal, "RETREAT_STEPS", 1)
    rows = (HOME, LEFT) if end == "start" else (LEFT, HOME)
    result = RRTConnect().plan(rd.Problem(PANDA, scene, rows[0], rows[1]))
    assert result.status is (rd.Status.INVALID_START if end == "start" else rd.Status.INVALID_GOAL)
    told = re.search(r"spheres of (\w+) reach ([\d.]+) mm into ball, .* are ([\d.]+) mm apart", result.reason)
    assert told and told[1].startswith("panda_") and result.reason.startswith(f"the {end} is too close")
    assert float(told[2]) > 0 and float(told[3]) >= 0
