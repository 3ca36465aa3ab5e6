"""What a call of a planner records: shorter and shorter paths, refusals of the validator, compile time."""

import subprocess
import sys
import time

import numpy as np
from numba import njit

from robotdiffuse.core.types import Status
from robotdiffuse.planning.context import PlanningContext, PlanRequest
from robotdiffuse.planning.search.shared_tree.planner import SharedTreeRRTStar, SharedTreeSettings
from robotdiffuse.problems.problem import Problem
from robotdiffuse.robots import load_robot
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.shapes import Sphere

START = np.array([0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785])


def turned(angle: float) -> np.ndarray:
    return START + np.array([angle, 0, 0, 0, 0, 0, 0])


def problem(scene: Scene) -> Problem:
    return Problem(load_robot("panda"), scene, START, turned(1.2))


def blocked() -> Problem:
    return problem(Scene([Sphere((0.4, 0.3, 0.6), 0.15)]))


def context_for(scene: Scene) -> PlanningContext:
    return PlanningContext("test", problem(scene), PlanRequest(time_limit=10.0))


def test_progress_falls_and_ends_with_the_returned_path() -> None:
    context = context_for(Scene([]))
    for length in (5.0, 3.0, 4.0, 0.9):  # 4 is no improvement; 0.9 is shorter than the returned path
        context.improved(length)
    result = context.finish(np.stack([START, turned(1.2)]), "test")
    assert result is not None and result.path is not None
    lengths = [length for _, length in result.progress]
    np.testing.assert_allclose(lengths, [5.0, 3.0, 1.2])
    assert result.progress[-1] == (result.planning_time, result.path.length)


def test_returned_path_keeps_the_time_at_which_it_was_found() -> None:
    context = context_for(Scene([]))
    context.improved(1.2)
    result = context.finish(np.stack([START, turned(1.2)]), "test")
    assert result is not None
    assert len(result.progress) == 1 and result.progress[0][0] < result.planning_time


def test_failures_name_what_the_validator_refused() -> None:
    context = PlanningContext("test", blocked(), PlanRequest(time_limit=10.0))
    assert context.unsolved().refused == ""
    assert context.finish(np.stack([START, turned(1.2)]), "test") is None
    assert context.unsolved().refused == "scene_collision"
    assert context.finish(np.stack([START, turned(0.1)]), "test") is None
    assert context.unsolved().refused == "goal"


def test_a_search_that_ended_differs_from_one_that_ran_out_of_time() -> None:
    ended = PlanningContext("test", blocked(), PlanRequest(time_limit=10.0)).unsolved()
    assert ended.status is Status.NO_PATH and "the search ended" in ended.reason
    late = PlanningContext("test", blocked(), PlanRequest(time_limit=1e-9)).unsolved()
    assert late.status is Status.TIMEOUT and "longer time limit" in late.reason


def test_anytime_planner_reports_its_progress() -> None:
    planner = SharedTreeRRTStar(SharedTreeSettings(safety_distance=0.0, rounds=40, improvement=0.0))
    result = planner.plan(blocked(), time_limit=20.0)
    assert result.path is not None, result.reason
    times, lengths = np.array(result.progress).T
    assert (np.diff(times) > 0).all() and (np.diff(lengths) < 0).all()
    assert lengths[-1] == result.path.length


def test_compiling_takes_no_time_of_the_call_and_is_noted() -> None:
    began = time.perf_counter()
    context = context_for(Scene([]))
    before = context.elapsed
    njit(lambda x: x + 1)(1)
    waited, counted = time.perf_counter() - began, context.elapsed - before
    assert counted < 0.5 * waited
    [note] = context.fail(Status.TIMEOUT, "").notes
    assert "compiled for" in note and "does not count" in note


def test_a_solved_call_imports_no_toppra_and_no_matplotlib() -> None:
    """toppra, which imports matplotlib, once cost the first call over a second; now only tests import it."""
    code = (
        "import sys, numpy as np, robotdiffuse as rd\n"
        f"start = np.array({START.tolist()})\n"
        "problem = rd.Problem(rd.load_robot('panda'), rd.Scene([]), start, start + 0.2)\n"
        "assert rd.plan(problem, time_limit=10.0).solved\n"
        "print([name for name in ('toppra', 'matplotlib') if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0 and done.stdout.strip() == "[]", done.stdout + done.stderr
