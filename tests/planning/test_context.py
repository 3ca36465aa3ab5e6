"""What a call of a planner records: shorter and shorter paths, refusals of the validator, compile time."""

import numpy as np
import pytest
from numba import njit

from helpers.clock import stop_clock
from robotdiffuse import Problem, Scene, Sphere, Status, load_planner, load_robot
from robotdiffuse.core.deadline import TIMING, OutOfTimeError
from robotdiffuse.planning.context import PlanningContext, PlanRequest

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


def test_a_result_notes_the_compile_time_once() -> None:
    njit(lambda x: x + 1)(1)
    planner = load_planner("rrt_connect")
    first, second = (planner.plan(blocked(), time_limit=20.0) for _ in range(2))
    assert sum("compiled for" in note and "does not count" in note for note in first.notes) == 1
    assert not any("compiled for" in note for note in second.notes)


def test_a_limit_that_runs_out_says_what_took_the_time(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = stop_clock(monkeypatch)
    context = context_for(Scene([]))
    with context.deadline():
        clock.now += 0.7
        context.begin_search()
        clock.now += 100.0
        context.improved(1.0)
        late = context.out_of_time(OutOfTimeError("the fastest speeds", TIMING))
    assert "the search began after 0.70 s, its first path came after 100.70 s" in late.reason
