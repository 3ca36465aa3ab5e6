"""Results, paths and trajectories: their files, round trips and damaged ones; times, samples and rates of motions."""

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
from helpers.box_arm import box_arm
from helpers.refusals import refuses
from robotdiffuse import Problem, Scene, Trajectory, load_planner, verify
from robotdiffuse.core.errors import OutputError
from robotdiffuse.core.files import JsonLines, write_atomically
from robotdiffuse.core.types import ROWS
from robotdiffuse.validation.rates import rate_violations
from robotdiffuse.validation.validator import VerifySettings

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
    for wrong, problem in ((replace(solved, min_clearance=float("nan")), None), (solved, {"start": np.zeros(7)})):
        refuses("r.json: JSON holds texts, .*finite numbers only: .*JSON", wrong.save, tmp_path / "r.json", problem)
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
    ({"status": "fine"}, "unknown status 'fine'; known: error, invalid_goal"),
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
    write_atomically(file, "folder a\udcff")  # regression: a page titled by a folder whose name is not UTF-8
    assert file.read_text() == "folder a?"


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


def cubic(steps: int = 7) -> Trajectory:
    """A minimum-acceleration motion, whose positions are one cubic, with rows at uneven times."""
    t = np.linspace(0.0, 1.0, steps) ** 1.3 * 2.0
    u = (t / 2.0)[:, None]
    far = np.array([[1.0, -0.5, 0.2]])
    return Trajectory(("a", "b", "c"), t, u**2 * (3 - 2 * u) * far, 3 * u * (1 - u) * far, (1.5 - 3 * u) * far)


def smooth(legs: int = 1, rate: float = 40.0) -> Trajectory:
    """Minimum-jerk motions of 1 s each, with a wait of 0.5 s between them."""
    u = np.linspace(0.0, 1.0, int(rate) + 1)[:, None]
    far = np.array([[0.9, -0.5, 0.2]])
    q = (10 * u**3 - 15 * u**4 + 6 * u**5) * far
    v = 30 * u**2 * (1 - u) ** 2 * far
    a = 60 * u * (1 - u) * (1 - 2 * u) * far
    shift = [(1.5 * k + u[:, 0], q + k * far) for k in range(legs)]
    times, positions = (np.concatenate(of) for of in zip(*shift, strict=True))
    return Trajectory(("a", "b", "c"), times, positions, np.tile(v, (legs, 1)), np.tile(a, (legs, 1)))


def pulse(step: float = 0.004, count: int = 6) -> Trajectory:
    """An accelerating and a braking pulse, each of `count` steps up and down at constant jerk: a few rows at 125 Hz."""
    half = np.concatenate([np.arange(count), np.arange(count, 0, -1)])
    a = 2.0 * np.concatenate([half, -half, [0]])[:, None] * np.array([[1.0, 0.5, -1.0]]) / count
    v = np.concatenate([np.zeros((1, 3)), np.cumsum((a[1:] + a[:-1]) / 2 * step, axis=0)])
    q = np.concatenate([np.zeros((1, 3)), np.cumsum(step * (v[1:] + v[:-1]) / 2 - step**2 * (a[1:] - a[:-1]) / 12, axis=0)])
    return Trajectory(("a", "b", "c"), step * np.arange(len(a)), q, v, a)


def test_a_cubic_is_exact_at_any_time_and_other_times_and_rates_are_refused():
    rough = cubic()
    fine = cubic(101)
    state = rough.at(fine.times)
    for got, right in zip(state, (fine.positions, fine.velocities, fine.accelerations), strict=False):
        assert np.allclose(got, right, atol=1e-12)
    assert np.allclose(state.jerks, -1.5 * np.array([1.0, -0.5, 0.2]))
    one = rough.at(0.7)
    assert one.jerks.shape == one.positions.shape == (3,)
    assert np.allclose(one.positions, rough.at(np.array([0.7])).positions[0])
    for time in (-0.1, 2.1, np.nan, np.array([0.5, 3.0])):
        refuses(r"it must be in \[0, 2\]", cubic().at, time)
    for rate in (0, -5, np.inf, np.nan, 1e12):
        refuses("rate is", cubic().resample, rate)


def test_the_largest_jerk_is_that_between_rows_unless_the_ends_jump_and_a_wait_is_one_stop():
    # 60 at both ends of a minimum-jerk motion, whose accelerations are 0 there
    assert np.allclose(smooth(rate=400.0).peak_jerks, 60 * np.array([0.9, 0.5, 0.2]), rtol=0.01)
    assert np.isinf(cubic().peak_jerks).all()
    assert len(smooth().stops) == 0
    assert np.allclose(smooth(3).stops, [1.25, 2.75])


@pytest.mark.parametrize("rate", [125, 250, 500, 1000, 3.3, 0.1])
def test_resampled_times_also_in_files(rate, tmp_path):
    motion = cubic()
    rows = motion.resample(rate)
    motion.save(tmp_path / "motion.csv", rate=rate)
    assert np.allclose(np.loadtxt(tmp_path / "motion.csv", delimiter=",", skiprows=1)[:, 0], rows.times)
    assert np.allclose(rows.times[:-1] * rate, np.arange(len(rows.times) - 1))
    assert rows.duration == motion.duration and (np.diff(rows.times) > 1e-9).all()
    assert (rows.positions[-1] == motion.positions[-1]).all() and (rows.velocities[-1] == 0).all()


@pytest.mark.parametrize("rate", [125, 250, 500, 1000])
def test_resampled_rates_still_keep_limits(rate):
    tolerances = VerifySettings(rate_agreement=0.25)
    for motion in (smooth(), smooth(2), pulse()):
        assert rate_violations(box_arm(), motion, tolerances) == []
        assert rate_violations(box_arm(), motion.resample(rate), tolerances) == []


@pytest.mark.parametrize("rate", [30, 125, 1000])
@pytest.mark.parametrize("size", [1e-6, 1e-5, 1e-4, 3e-4, 1e-2])
def test_short_motions_stay_valid_when_resampled(size, rate):
    """The accelerations of these motions swing within a row or two, and are 0 at both ends."""
    start = np.array([0.1, 0.2, 0.3])
    problem = Problem(box_arm(), Scene(), start, start + size * np.array([1.0, 0.7, -1.0]))
    motion = load_planner("straight_line").plan(problem).trajectory
    assert verify(problem, motion).valid
    report = verify(problem, motion.resample(rate))
    assert report.valid, report.violation


@pytest.mark.parametrize("rate", [10, 20, 125, 250, 1000])
def test_rows_at_a_constant_rate_keep_the_stops(rate: int) -> None:
    """Regression: a motion that stops at waypoints was valid at no rate, so it could not be exported."""
    ways = [[0.2, 0.1, 0.3], [0.1, 0.2, 0.1]]
    problem = Problem(box_arm(), Scene(), [0.1, 0.2, 0.3], [0.3, 0.2, 0.1], waypoints=ways)
    motion = load_planner("straight_line").plan(problem).trajectory.resample(rate)
    assert len(motion.stops) == 2 and verify(problem, motion).valid


def test_a_trajectory_of_one_row_rests_there():
    """Regression: positions were NaN, and resampling gave two rows at the same time."""
    motion = cubic()
    one = Trajectory(motion.joint_names, *(getattr(motion, name)[:1] for name in ("times", *ROWS)))
    state = one.at(np.zeros(2))
    assert (state.positions == motion.positions[:1]).all() and not state.jerks.any()
    assert one.at(0.0).positions.shape == (3,)
    assert len(one.resample(500).times) == 1


def test_links_are_written_through_and_impossible_names_refused(tmp_path: Path) -> None:
    (tmp_path / "latest.json").symlink_to(tmp_path / "run.json")
    write_atomically(tmp_path / "latest.json", "new")
    assert (tmp_path / "latest.json").is_symlink() and (tmp_path / "run.json").read_text() == "new"
    for name in ("a\0.json", "\ud800.json"):
        refuses("not a valid file name", write_atomically, tmp_path / name, "")
        refuses("not a valid file name", rd.Trajectory(("joint",), np.zeros(1), *[np.zeros((1, 1))] * 3).save, name)
