"""Result and trajectory files: round trips, one-line errors for damaged files; files are written whole."""

import json
import os
import re
from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields, replace
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest

import robotdiffuse as rd
from helpers.refusals import refuses
from robotdiffuse.core.errors import OutputError
from robotdiffuse.core.output_files import JsonLines, write_atomically

NAMES = ("shoulder", "elbow")
FULL = OSError(28, "No space left on device")


@pytest.fixture
def solved() -> rd.PlanResult:
    rng = np.random.default_rng(0)
    trajectory = rd.Trajectory(NAMES, np.cumsum(np.array([0.0, 0.1, 0.1, 0.07])), *(rng.normal(size=(4, 2)) for _ in range(3)))
    path = rd.Path(NAMES, trajectory.positions[[0, 3]])
    found = rd.Status.SOLVED, "found by a straight line", "rrt_connect", "panda", 0.01, 3, "straight line", path, trajectory
    more = {"min_clearance": 0.02, "scene_clearance": 0.02, "self_clearance": 0.05, "notes": ("start clamped",)}
    more |= {"goal_index": 2, "progress": ((0.002, 3.5), (0.008, 3.0)), "refused": "scene_collision"}
    return rd.PlanResult(*found, **more)  # type: ignore[arg-type]


def test_solved_result_round_trip(solved: rd.PlanResult, tmp_path: Path) -> None:
    file = tmp_path / "result.json"
    solved.save(file, {"robot": "panda", "scene": []})
    read = rd.load_result(file)
    assert read.problem == {"robot": "panda", "scene": []}
    for field in fields(rd.PlanResult):
        if field.name not in ("path", "trajectory"):
            assert getattr(read.result, field.name) == getattr(solved, field.name), field.name
    assert read.result.path_length == solved.path_length
    assert read.result.path is not None and solved.path is not None
    assert np.array_equal(read.result.path.positions, solved.path.positions)
    for name in ("times", "positions", "velocities", "accelerations"):
        assert np.array_equal(getattr(read.result.trajectory, name), getattr(solved.trajectory, name))


def test_fields_are_those_that_the_design_promises_and_later_ones_may_lack(solved: rd.PlanResult, tmp_path: Path) -> None:
    file = tmp_path / "r.json"
    solved.save(str(file))
    record = json.loads(file.read_text())
    promised = (
        "status reason planner robot joint_names times positions velocities accelerations path_length "
        "min_clearance scene_clearance self_clearance planning_time verified seed"
    )
    assert set(promised.split()) <= set(record)
    assert record["verified"] is True and record["status"] == "solved"
    assert len(record["times"]) == len(record["positions"]) == len(record["accelerations"]) == 4
    # earlier versions lacked fields
    for name in ("scene_clearance", "self_clearance", "goal_index", "progress", "refused"):
        del record[name]
    file.write_text(json.dumps(record))
    read = rd.load_result(file).result
    assert (read.min_clearance, read.scene_clearance, read.self_clearance) == (0.02, None, None)
    assert (read.progress, read.refused, read.goal_index) == ((), "", None)


def test_failed_result_round_trip(tmp_path: Path) -> None:
    failed = rd.PlanResult(rd.Status.TIMEOUT, "no path in 1 s", "rrt_connect", "panda", 1.0, 0)
    file = tmp_path / "result.json"
    failed.save(str(file))
    read = rd.load_result(file).result
    assert read.status is rd.Status.TIMEOUT and read.path is None and read.trajectory is None
    assert json.loads(file.read_text())["verified"] is False
    refuses(r"no trajectory to write \(timeout\)", failed.save, str(tmp_path / "result.csv"))


def test_what_cannot_be_written_is_refused(solved: rd.PlanResult, tmp_path: Path) -> None:
    refuses("nowhere does not exist", solved.save, tmp_path / "nowhere" / "r.json")
    (tmp_path / "folder.json").mkdir()
    refuses("is a folder", solved.save, tmp_path / "folder.json")
    with pytest.raises(ValueError, match="not JSON compliant"):
        replace(solved, min_clearance=float("nan")).save(tmp_path / "r.json")
    assert [path.name for path in tmp_path.iterdir()] == ["folder.json"]


@pytest.mark.parametrize(("error", "raised"), [(FULL, OutputError), (KeyboardInterrupt, KeyboardInterrupt)])
def test_a_failed_write_keeps_the_old_file(error, raised, solved, tmp_path, monkeypatch) -> None:
    file = tmp_path / "r.json"
    file.write_text("old")
    monkeypatch.setattr(Path, "replace", Mock(side_effect=error))
    with pytest.raises(raised, match="No space left on device" if error is FULL else None):
        solved.save(file)
    assert file.read_text() == "old" and list(tmp_path.iterdir()) == [file]


DAMAGE = [
    ({"status": "fine"}, "status is 'fine'; known: solved, timeout"),
    ({"verified": False}, "verified is False, but status is 'solved'"),
    ({"times": [0.0, 0.1, 0.1, 0.2]}, "times do not increase: 0.1 s in row 1, 0.1 s in row 2"),
    ({"times": ["0", "0.1", "0.2", "0.3"]}, r"times is \['0', .*; it must be 4 finite numbers, one"),
    ({"positions": [[0.0, 0.0]]}, r"times is \[0.0, .*; it must be 1 finite numbers, one for each row"),
    ({"velocities": [[0.0]] * 4}, "velocities is an array of 4 x 1; it must be 4 x 2"),
    ({"accelerations": "none"}, "accelerations is 'none'; it must be 4 x 2 finite numbers"),
    ({"waypoints": None}, "waypoints is None; it must be n x 2 finite numbers, a column for each"),
    ({"waypoints": [[0.0, None]]}, r"waypoints is \[\[0.0, None\]\]; it must be n x 2"),
    ({"joint_names": [1, 2]}, r"joint_names is \[1, 2\]; it must be a list of names"),
    ({"planning_time": "soon"}, "planning_time is 'soon'; it takes a number"),
    ({"progress": [[0.1]]}, r"progress\[0\] is \[0.1\]; it must have 2 entries"),
    ({"goal_index": -1}, "goal_index is -1; it must be at least 0"),
    ({"goal_index": True}, "goal_index is True; it takes an integer"),
    ({"reason": 7}, "reason is 7; it takes a text"),
    ({"problem": [1]}, r"problem is \[1\]; it must be an object"),
    ("{", "is not valid JSON"),
    ("[]", "must hold one JSON object"),
    ("{}", "status, reason, planner"),
]


@pytest.mark.parametrize(("change", "message"), DAMAGE)
def test_damaged_result_is_refused(change: dict | str, message: str, solved: rd.PlanResult, tmp_path: Path) -> None:
    file = tmp_path / "r.json"
    solved.save(file)
    file.write_text(change if isinstance(change, str) else json.dumps(json.loads(file.read_text()) | change))
    refuses(f"^{re.escape(str(file))}.*{message}", rd.load_result, file)


def test_threads_that_write_one_file_leave_one_of_their_texts(tmp_path: Path) -> None:
    """Regression: the threads shared a temporary file, which one of them renamed while another wrote it."""
    file = tmp_path / "a.json"
    texts = [letter * 100_000 for letter in "ab"]

    def write(text: str) -> None:
        for _ in range(50):
            write_atomically(file, text)

    with ThreadPoolExecutor(2) as threads:
        list(threads.map(write, texts))
    assert file.read_text() in texts and list(tmp_path.iterdir()) == [file]


def test_a_row_that_is_not_written_whole_is_dropped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Regression: the next row was appended to the incomplete line, and no reader understood the line."""
    lines = JsonLines(tmp_path / "a.jsonl")
    lines.append({"a": 1})
    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", Mock(side_effect=FULL))
        with pytest.raises(OutputError, match=r"a\.jsonl cannot be written: No space"):
            lines.append({"a": 2})
    lines.append({"a": 3})
    assert lines.rows == JsonLines(tmp_path / "a.jsonl").rows == [{"a": 1}, {"a": 3}]
