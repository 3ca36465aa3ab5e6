"""Many problems: results in order, as alone; a process that dies costs one problem."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import robotdiffuse as rd
from robotdiffuse.core.registry import Entry
from robotdiffuse.planning import PLANNERS, SEARCH
from robotdiffuse.planning.search.rrt import RRTConnect

PANDA = rd.load_robot("panda")
LEFT = np.array([0.9, 0.3, 0.0, -1.9, 0.0, 2.2, 0.785])
RIGHT = np.array([-0.9, 0.3, 0.0, -1.9, 0.0, 2.2, 0.785])
BURIED = rd.Scene([rd.Sphere([0.0, 0.0, 0.3], 0.5, name="everything")])


def problems() -> list[rd.Problem]:
    heights = (0.2, 0.3, 0.4, 0.5, 0.6)
    scenes = [rd.Scene([rd.Box([0.45, 0.0, h], [0.3, 0.05, 0.4], name="wall")]) for h in heights]
    return [rd.Problem(PANDA, scene, LEFT, RIGHT) for scene in [*scenes, BURIED]]


def test_results_are_in_order_and_as_alone() -> None:
    counts: list[tuple[int, int]] = []
    request = {"time_limit": 300.0, "seed": 3, "progress": lambda done, total: counts.append((done, total))}
    results = list(rd.plan_many(problems(), "rrt_connect", workers=2, **request))
    assert counts == [(done, 6) for done in range(1, 7)]
    alone = [RRTConnect().plan(problem, 300.0, seed=3) for problem in problems()]
    assert [result.status for result in results] == [rd.Status.SOLVED] * 5 + [rd.Status.INVALID_START]
    for together, one in zip(results[:5], alone, strict=False):
        assert together.path is not None and one.path is not None
        assert np.array_equal(together.path.positions, one.path.positions)


def test_a_process_that_dies_costs_one_problem(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = problems()[:3]
    deadly = rd.Scene([rd.Box([0.45, 0.0, 0.4], [0.3, 0.05, 0.4], name="deadly")])
    asked.insert(1, rd.Problem(PANDA, deadly, LEFT, RIGHT))
    asked.insert(3, replace(asked[0], robot=replace(PANDA, name="unknown")))
    entry = Entry("helpers.deadly_planner:Deadly", "dies of it", "RRTConnectSettings", SEARCH)
    monkeypatch.setitem(PLANNERS, "deadly", entry)
    results = list(rd.plan_many(asked, "deadly", workers=1, time_limit=300.0))
    ends = [result.status for result in results]
    assert ends == [rd.Status.SOLVED, rd.Status.ERROR, rd.Status.SOLVED, rd.Status.ERROR, rd.Status.SOLVED]
    assert "died" in results[1].reason and "no such robot" in results[3].reason


def test_no_problems_are_no_results() -> None:
    assert list(rd.plan_many([])) == []


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"workers": 0}, "workers is 0"),
        ({"planner": "rrt"}, "unknown planner 'rrt'"),
        ({"time": 1.0}, "unknown argument 'time'; known: .*time_limit"),
        ({"until": "soon"}, "unknown until .soon."),
    ],
)
def test_arguments_are_checked_at_once(arguments: dict, message: str) -> None:
    with pytest.raises(rd.InputError, match=message):
        rd.plan_many(problems()[:1], **arguments)


def test_robots_that_hold_something_go_to_processes_with_settings_of_a_table() -> None:
    cup = rd.Cylinder([0, 0, 0.16], 0.03, 0.12, name="cup")
    problem = replace(problems()[0], robot=PANDA.attach(cup, "panda_hand"))
    asked = {"settings": {"range": 0.3}, "until": "first", "time_limit": 300.0}
    [result] = rd.plan_many([problem], "aorrtc", workers=1, **asked)  # type: ignore[arg-type]
    alone = rd.plan(problem, planner="aorrtc", **asked)  # type: ignore[arg-type]
    assert result.path is not None and rd.verify(problem, result.path).valid
    assert alone.path is not None and np.array_equal(result.path.positions, alone.path.positions)


PLANS = """
import robotdiffuse as rd
panda = rd.load_robot("panda")
middle = (panda.lower + panda.upper) / 2
problems = [rd.Problem(panda, rd.Scene([]), middle, middle + 0.1)] * 2
for result in rd.plan_many(problems, "rrt_connect", workers=2):
    print(result.status.value, result.reason)
"""
NOT_MAIN = """if __name__ != "__main__":
    {}
"""


@pytest.mark.parametrize(
    "beginning",
    [
        pytest.param("", id="unguarded"),
        pytest.param(NOT_MAIN.format("raise ValueError"), id="raises"),
        pytest.param(NOT_MAIN.format("raise SystemExit"), id="exits"),
        pytest.param(NOT_MAIN.format("import os; os._exit(0)"), id="ends", marks=pytest.mark.slow),
    ],
)
def test_a_script_that_processes_cannot_import_is_an_error(beginning: str, tmp_path: Path) -> None:
    """It hung: what a process is given as it starts, robots, does not fit a pipe that nobody reads."""
    script = tmp_path / "script.py"
    script.write_text(beginning + PLANS)
    ended = subprocess.run([sys.executable, script], capture_output=True, text=True, timeout=500)
    lines = ended.stdout.splitlines()
    assert len(lines) == 2 and len({*lines}) == 1
    assert lines[0].startswith("error a worker process could not import the main script")
    assert lines[0].endswith('below the line: if __name__ == "__main__":')
