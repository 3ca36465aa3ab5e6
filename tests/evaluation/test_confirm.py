"""bench confirm: PyBullet accepts solved motions, and finds a motion that was tampered with."""

from dataclasses import replace
from pathlib import Path

import pytest

from robotdiffuse.cli import main
from robotdiffuse.evaluation.problem_sets import gather_cases
from robotdiffuse.evaluation.runs import Record, RecordFile, record_path
from robotdiffuse.planning.search.rrt import RRTConnect
from robotdiffuse.problems.problem import JointGoal

pytest.importorskip("pybullet", reason="the extra `sim` (pybullet) is not installed")
pytestmark = pytest.mark.sim


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    case = gather_cases(["rop_nontrivial"], 1, tmp_path, lambda _: None)[0]
    problem = case.problem
    path = RRTConnect().plan(problem, 10.0).path
    assert isinstance(problem.goal, JointGoal)
    about = Record("good", *case.key, case.family, case.trivial, 0, 1.0, "solved", "", 0.01)
    line = [problem.start.tolist(), problem.goal.positions[0].tolist()]
    for record in (
        replace(about, positions=tuple(map(tuple, path.positions.tolist()))),
        replace(about, planner="bad", positions=tuple(map(tuple, line))),
        replace(about, planner="none", status="timeout"),
    ):
        RecordFile(record_path(tmp_path, record.planner)).append(record)
    return tmp_path


def test_motions_are_looked_at_again(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "confirm", str(folder)]) == 1
    lines = capsys.readouterr().out.splitlines()
    rows = {line.split()[0]: line.split()[1:] for line in lines[1:4]}
    assert rows == {"bad": ["1", "1"], "good": ["1", "0"], "none": ["0", "0"]}
    assert lines[4].startswith("bad, rop_nontrivial rop/") and "mm deep" in lines[4]
    (folder / "records" / "bad.jsonl").unlink()
    assert main(["bench", "confirm", str(folder), "--count", "1"]) == 0


def test_folder_without_results_or_problems(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "confirm", str(folder / "nothing")]) == 2
    assert "holds no records" in capsys.readouterr().err
    (folder / "problems" / "rop.jsonl").unlink()
    assert main(["bench", "confirm", str(folder), "--count", "1"]) == 2
    assert "of rop_nontrivial, which has results" in capsys.readouterr().err
