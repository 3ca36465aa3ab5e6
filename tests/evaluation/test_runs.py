"""Runs: methods alternate, stored records are not made again, motions of planners and networks are validated."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import robotdiffuse as rd
from helpers.panda import GOAL, PANDA, START
from robotdiffuse.collision import CollisionChecker
from robotdiffuse.evaluation.runs import Fields, Record, Run, planned, restarted, run_all, sampled
from robotdiffuse.planning.search.rrt import RRTConnect
from robotdiffuse.problems.files import Case

FREE = rd.Problem(PANDA, rd.Scene([]), START, rd.JointGoal(GOAL[None]))
BLOCKED = rd.Problem(PANDA, rd.Scene([rd.Sphere([0.5, 0.0, 0.5], 0.2)]), START, rd.JointGoal(GOAL[None]))
LENGTH_OF_LINE = float(np.linalg.norm(GOAL - START))
CASES = [Case("a", "free", FREE, True, LENGTH_OF_LINE, "mine"), Case("b", "free", BLOCKED, False, LENGTH_OF_LINE, "mine")]


def quick(length: float, calls: list[tuple[str, str, int]]) -> dict:
    def call(run: Run) -> Iterator[Fields]:
        calls.append((run.method, run.case.name, run.seed))
        yield {"status": "solved", "time": 0.1, "joint_length": length + run.rng().random()}

    return {"x": call, "y": call}


def test_methods_take_turns_on_each_case_with_the_same_random_numbers() -> None:
    calls: list[tuple[str, str, int]] = []
    found = run_all(CASES, quick(1.0, calls), seeds=(0, 4), bar=False)
    assert calls == [(m, c, s) for s in (0, 4) for c in "ab" for m in "xy"]
    assert [(r.name, r.seed, r.planner) for r in found["y"]] == [(c, s, "y") for s in (0, 4) for c in "ab"]
    assert [r.joint_length for r in found["x"]] == [r.joint_length for r in found["y"]]
    assert len({r.joint_length for r in found["x"]}) == 4
    assert found["x"][0].reference == LENGTH_OF_LINE and found["x"][0].workers == 1


def test_what_is_kept_is_not_made_again_but_for_other_limits(tmp_path: Path) -> None:
    calls: list[tuple[str, str, int]] = []

    def stopping(run: Run) -> Iterator[Fields]:
        if run.case.name == "b":
            raise KeyboardInterrupt
        return quick(1.0, calls)["x"](run)

    with pytest.raises(KeyboardInterrupt):
        run_all(CASES, {"x": stopping}, folder=tmp_path, bar=False)
    again = run_all(CASES, {"x": quick(2.0, calls)["x"]}, folder=tmp_path, bar=False)
    assert calls == [("x", "a", 0), ("x", "b", 0)]
    assert [int(record.joint_length or 0) for record in again["x"]] == [1, 2]
    backwards = run_all(CASES[::-1], {"x": quick(3.0, calls)["x"]}, folder=tmp_path, bar=False)
    assert len(calls) == 2 and [record.name for record in backwards["x"]] == ["b", "a"]
    # records of any time limit were returned
    for limit, made in ((9.0, 4), (9.0, 4), (8.0, 6)):
        found = run_all(CASES, {"x": quick(1.0, calls)["x"]}, limit=limit, folder=tmp_path, bar=False)
        assert {record.time_limit for record in found["x"]} == {limit} and len(calls) == made


def test_samples_are_validated_as_they_are_and_the_shortest_that_passes_is_measured() -> None:
    def draw(run: Run, checker: CollisionChecker) -> np.ndarray:
        bent = [np.stack([START, (START + GOAL) / 2 + np.array([0, 0, bend, 0, 0, 0, 0.0]), GOAL]) for bend in (0.4, 0.2)]
        bent[1][[0, -1]] += 0.01
        return np.stack([bent[0], bent[1], np.stack([START, START + 20.0, GOAL])]).astype(np.float32)

    free, blocked = run_all(CASES, {"x": sampled(draw)}, bar=False)["x"]
    assert free.solved and free.passed == pytest.approx(2 / 3)
    with_exact_ends = 2 * np.hypot(LENGTH_OF_LINE / 2, 0.2)
    assert free.joint_length == pytest.approx(with_exact_ends, rel=1e-5)
    assert {"scene_clearance", "link_length", "turning"} <= free.measures.keys()
    assert blocked.status == "no_path" and blocked.passed == 0.0 and blocked.collided == 1.0


def test_a_planner_in_this_process_gives_the_bench_records() -> None:
    free, blocked = run_all(CASES, {"x": planned(RRTConnect())}, limit=5.0, bar=False)["x"]
    assert isinstance(free, Record) and free.solved and blocked.solved
    assert blocked.joint_length is not None and blocked.joint_length > LENGTH_OF_LINE
    assert blocked.cpu is not None and blocked.restarts is None and blocked.time_limit == 5.0
    assert np.array_equal(blocked.waypoints[0], START)


def test_a_motion_that_stands_still_is_not_planned_again() -> None:
    """Regression: a path of length 0 was taken for no path."""
    problem = rd.Problem(PANDA, rd.Scene(), START, rd.JointGoal(START[None]))
    found = RRTConnect().plan(problem, time_limit=2.0, seed=0)
    again, best = restarted(RRTConnect(), problem, 0, 2.0, replace(found, path=rd.Path(PANDA.joint_names, START[None])), {})
    assert (again, best.path_length) == (0, 0.0)
