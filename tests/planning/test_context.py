"""Records of a planner's call: ever shorter paths, refusals of the validator, compile time."""

import numpy as np
import pytest
from numba import njit

from helpers.panda import HOME
from helpers.waiting import stop_clock
from robotdiffuse import Problem, Scene, Sphere, Status, load_planner, load_robot
from robotdiffuse.core.deadline import TIMING, OutOfTimeError
from robotdiffuse.planning.context import PlanningContext, PlanRequest


def turned(angle: float) -> np.ndarray:
    return HOME + np.array([angle, 0, 0, 0, 0, 0, 0])


BLOCKED = Scene([Sphere((0.4, 0.3, 0.6), 0.15)])


def context_for(scene: Scene, time_limit: float = 10.0) -> PlanningContext:
    return PlanningContext("test", Problem(load_robot("panda"), scene, HOME, turned(1.2)), PlanRequest(time_limit=time_limit))


def test_progress_falls_and_ends_with_the_returned_path_when_it_was_found() -> None:
    # 4 is no improvement; 0.9 is shorter than the returned path
    for found, kept in (((5.0, 3.0, 4.0, 0.9), [5.0, 3.0, 1.2]), ((1.2,), [1.2])):
        context = context_for(Scene([]))
        for length in found:
            context.improved(length)
        result = context.finish(np.stack([HOME, turned(1.2)]), "test")
        assert result is not None
        np.testing.assert_allclose([length for _, length in result.progress], kept)
        assert result.progress[-1][1] == result.path.length
        assert (result.progress[-1][0] < result.planning_time) == (len(found) == 1)


def test_failures_name_what_the_validator_refused_and_what_ended_the_search() -> None:
    context = context_for(BLOCKED)
    for angle, refused in ((None, ""), (1.2, "scene_collision"), (0.1, "goal")):
        if angle is not None:
            assert context.finish(np.stack([HOME, turned(angle)]), "test") is None
        ended = context.unsolved()
        assert ended.refused == refused and ended.status is Status.NO_PATH and "the search ended" in ended.reason
    late = context_for(BLOCKED, 1e-9).unsolved()
    assert late.status is Status.TIMEOUT and "longer time limit" in late.reason


def test_a_result_notes_the_compile_time_once_and_stops_that_nobody_asked_for() -> None:
    njit(lambda x: x + 1)(1)
    planner = load_planner("rrt_connect")
    both = [planner.plan(context_for(BLOCKED).problem, time_limit=20.0).notes for _ in range(2)]
    assert [["compiled for" in note and "not part of the planning" in note for note in notes] for notes in both] == [[True], []]
    stopping = {"stage": "", "deviations": np.zeros(3)}
    planner.solve = lambda call, ends: call.finish(np.stack([ends.start, turned(-0.2), *ends.goals]), **stopping)  # type: ignore
    for waypoints, noted in (((), True), ([turned(0.5)], False)):
        result = planner.plan(Problem(load_robot("panda"), Scene([]), HOME, turned(1.2), waypoints=waypoints), time_limit=20.0)
        assert any("stops on its way, at" in n for n in result.notes) == noted and result.stops == 1 + 2 * len(waypoints)


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
