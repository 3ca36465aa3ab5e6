"""plan_many: results in order, equal to those of single calls; a process that dies costs only one problem."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import robotdiffuse as rd
from helpers.panda import LEFT, PANDA, RIGHT
from helpers.refusals import refuses
from robotdiffuse.core.registry import Entry
from robotdiffuse.planning import PLANNERS, SEARCH

BURIED = rd.Scene([rd.Sphere([0.0, 0.0, 0.3], 0.5, name="everything")])


def problems() -> list[rd.Problem]:
    scenes = [rd.Scene([rd.Box([0.45, 0.0, h], [0.3, 0.05, 0.4], name="wall")]) for h in (0.2, 0.4, 0.6)]
    return [rd.Problem(PANDA, scene, LEFT, RIGHT) for scene in [*scenes, BURIED]]


def test_results_are_in_order_and_as_alone() -> None:
    counts: list[tuple[int, int]] = []
    cup = rd.Cylinder([0, 0, 0.16], 0.03, 0.12, name="cup")
    assert list(rd.plan_many([])) == []
    asked = problems()
    asked.insert(1, replace(asked[0], robot=PANDA.attach(cup, "panda_hand")))
    request: dict[str, Any] = {"settings": {"range": 0.3}, "until": "first", "time_limit": 300.0, "seed": 3}
    results = list(rd.plan_many(asked, "aorrtc", workers=2, progress=lambda *at: counts.append(at), **request))
    assert counts == [(done, 5) for done in range(1, 6)]
    assert [result.status for result in results] == [rd.Status.SOLVED] * 4 + [rd.Status.INVALID_START]
    for problem, together in zip(asked[:4], results[:4], strict=True):
        assert np.array_equal(together.path.positions, rd.plan(problem, planner="aorrtc", **request).path.positions)
        assert rd.verify(problem, together.path).valid


def test_a_process_that_dies_costs_one_problem(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = problems()[:3]
    deadly = rd.Scene([rd.Box([0.45, 0.0, 0.4], [0.3, 0.05, 0.4], name="deadly")])
    asked.insert(1, rd.Problem(PANDA, deadly, LEFT, RIGHT))
    asked.insert(3, replace(asked[0], robot=replace(PANDA, name="unknown")))
    monkeypatch.setitem(PLANNERS, "deadly", Entry("helpers.planners:Deadly", "dies of it", "RRTConnectSettings", SEARCH))
    results = list(rd.plan_many(asked, "deadly", workers=1, time_limit=300.0))
    ends = [result.status for result in results]
    assert ends == [rd.Status.SOLVED, rd.Status.ERROR, rd.Status.SOLVED, rd.Status.ERROR, rd.Status.SOLVED]
    assert "died" in results[1].reason and "no such robot" in results[3].reason


def test_arguments_are_checked_at_once() -> None:
    refuses("workers is 0", rd.plan_many, problems()[:1], workers=0)
    refuses("unknown planner 'rrt'", rd.plan_many, problems()[:1], planner="rrt")
    refuses("unknown argument 'time'; known: .*time_limit", rd.plan_many, problems()[:1], time=1.0)
    refuses("unknown until .soon.", rd.plan_many, problems()[:1], until="soon")


PLANS = """
import robotdiffuse as rd
panda = rd.load_robot("panda")
middle = (panda.lower + panda.upper) / 2
problems = [rd.Problem(panda, rd.Scene([]), middle, middle + 0.1)] * 2
for result in rd.plan_many(problems, "rrt_connect", workers=2):
    print(result.status.value, result.reason)
"""


@pytest.mark.parametrize("others", ["", "raise SystemExit", pytest.param("import os; os._exit(0)", marks=pytest.mark.slow)])
def test_a_script_that_processes_cannot_import_is_an_error(others: str, tmp_path: Path) -> None:
    """Regression: the call hung, since the robots for a starting process do not fit into a pipe that nobody reads."""
    script = tmp_path / "script.py"
    script.write_text(f'if __name__ != "__main__":\n    {others or "pass"}\n{PLANS}')
    lines = subprocess.run([sys.executable, script], capture_output=True, text=True, timeout=500).stdout.splitlines()
    assert len(lines) == 2 and len({*lines}) == 1
    assert lines[0].startswith("error a worker process could not import the main script")
    assert lines[0].endswith('below the line: if __name__ == "__main__":')
