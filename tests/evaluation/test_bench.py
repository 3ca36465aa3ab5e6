"""bench run: every call makes a record, failures too, and killed runs go on; bench confirm finds motions tampered with."""

import json
import os
import signal
import subprocess
import sys
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import robotdiffuse as rd
from helpers import planners, waiting
from helpers.commands import Said
from helpers.refusals import refuses
from robotdiffuse.cli import main
from robotdiffuse.core import registry
from robotdiffuse.evaluation import bench
from robotdiffuse.evaluation.bench_comparisons import LATE_SECONDS
from robotdiffuse.evaluation.metrics import METRICS
from robotdiffuse.evaluation.runs import Record, RecordFile, Run, gather_cases, problem_set_name, read_records, validator
from robotdiffuse.learning.weight_files import BUNDLED
from robotdiffuse.planning import PLANNERS
from robotdiffuse.planning.diffusion import Diffusion
from robotdiffuse.planning.search.rrt import AORRTCSettings, RRTConnect
from robotdiffuse.problems.files import held_out_problem, line_length, problem_record

RECORD = Record("rrt_connect", "rop", "rop/0", "rop", False, 0, 1.0, "solved", "", 0.01, progress=((0.01, 2.0),))


def quiet(*_: object) -> None: ...


def settings(out: Path, planners: str = "rrt_connect", problem: str = "rop", count: int = 3) -> bench.BenchSettings:
    return bench.BenchSettings(tuple(planners.split(",")), (problem,), out, time_limit=20.0, count=count)


def keys(records: list[Record]) -> Counter:
    return Counter(record.key for record in records)


@pytest.mark.slow
def test_records_hold_what_was_measured_and_are_not_made_twice(tmp_path: Path) -> None:
    plain = "rrt_connect"
    with_settings = "rrt_connect:optimize_time=0.05:tightenings=0"
    asked = replace(settings(tmp_path, f"{plain},{with_settings}", count=2), seeds=2)
    assert bench.run_bench(asked, quiet, quiet) == 8
    assert bench.run_bench(asked, quiet, quiet) == 0
    rows = read_records(tmp_path)
    assert list(rows) == [plain, with_settings], "a planner with settings is a row of its own"
    # Regression: other commands did not read the problems of a bench
    again = rd.load_problem(tmp_path / "problems" / "rop.jsonl", 1)
    assert np.array_equal(again.start, held_out_problem("rop", 1).start)
    for records in rows.values():
        assert keys(records) == {("rop", f"rop/{i}", seed, 20.0): 1 for i in range(2) for seed in range(2)}
    records = rows[plain]
    solved = [record for record in records if record.solved]
    runs = [json.loads(line) for line in (tmp_path / "runs.jsonl").read_text().splitlines()]
    assert solved and len(runs) == 2
    for record in solved:
        problem = held_out_problem("rop", int(record.name.partition("/")[2]))
        path = rd.Path(problem.robot.joint_names, record.waypoints)
        assert rd.verify(problem, path).valid
        assert record.joint_length == pytest.approx(path.length, rel=1e-6)
        assert record.progress[-1][1] == pytest.approx(path.length, rel=1e-5)
        assert record.memory is not None and record.memory > 50
        assert (record.workers, record.run) == (1, runs[0]["run"])
        assert record.load is not None and record.cpu is not None
        assert record.trivial == (line_length(problem, validator) is not None)
    assert bench.run_bench(replace(asked, count=3, planners=(plain,)), quiet, quiet) == 2
    assert len(runs[0]["versions"]) > 3


@pytest.mark.slow
def test_failures_of_every_kind_are_records_and_the_run_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(PLANNERS, "faulty", planners.ENTRY)
    monkeypatch.setattr(bench, "GRACE", 8.0)
    asked = replace(settings(tmp_path, "faulty", count=1), seeds=7, time_limit=0.5)
    assert bench.run_bench(asked, quiet, quiet) == 7
    found = {record.seed: record for record in read_records(tmp_path)["faulty"]}
    assert found[planners.SOLVES].solved and found[planners.TALKS].solved
    assert found[planners.RAISES].status == "exception"
    assert found[planners.RAISES].reason == "ValueError: no such thing"
    assert found[planners.EXITS].reason == "SystemExit: no license"
    assert found[planners.DIES].status == "crashed" and "SIGKILL" in found[planners.DIES].reason
    assert found[planners.HANGS].status == "overran"
    log = (tmp_path / "logs" / "faulty.log").read_text()
    assert "about to die" in log and "this is no answer" in log and "ValueError" in log
    assert bench.run_bench(asked, quiet, quiet) == 0


def test_logs_that_cannot_be_written_are_refused(tmp_path: Path) -> None:
    """Regression: no process could start, and every call was recorded as a crash."""
    (tmp_path / "logs").write_text("")
    spec = bench.PlannerSpec.parse("rrt_connect")
    refuses(r"logs/a\.log cannot be written", bench.PlannerProcess, spec, tmp_path / "logs" / "a.log")


def test_a_planner_of_the_program_itself_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(PLANNERS, "mine", registry.Entry("__main__:Mine", "for tests"))
    refuses("planner mine is in the program that was started", bench.run_bench, settings(tmp_path, "mine"), quiet, quiet)


def test_a_metric_of_an_imported_module_is_measured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Regression: the processes of planners did not import the module of `bench run --import`, so the metric was missing."""
    (tmp_path / "counted.py").write_text(
        "from robotdiffuse.evaluation.metrics import METRICS, Metric\n"
        'METRICS["legs"] = Metric("legs", "", "less", ".0f", lambda motion: len(motion.path.positions) - 1)\n'
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(registry, "imported", [])
    try:
        registry.import_modules(["counted"])
        assert bench.run_bench(replace(settings(tmp_path / "run", "rrt_connect", count=1), time_limit=60.0), quiet, quiet) == 1
        (record,) = read_records(tmp_path / "run")["rrt_connect"]
        assert record.measures["legs"] == len(record.waypoints) - 1
    finally:
        METRICS.pop("legs", None)


@pytest.mark.slow
def test_killed_run_completes_without_repeating_or_losing_a_result(tmp_path: Path) -> None:
    arguments = ["bench", "run", "--planners", "rrt_connect,shared_tree_rrt_star", "--problems", "rop"]
    arguments += ["--count", "3", "--time-limit", "20", "--workers", "2", "--out", str(tmp_path)]
    command = [sys.executable, "-m", "robotdiffuse", *arguments]
    run = subprocess.Popen(command, start_new_session=True, stderr=subprocess.DEVNULL)
    first = tmp_path / "records" / "rrt_connect.jsonl"

    def half_done() -> bool:
        assert run.poll() is None
        return first.is_file() and first.read_text().count("\n") >= 2

    waiting.until(half_done, 400.0)
    os.kill(run.pid, signal.SIGKILL)
    run.wait()
    before = {file: file.read_text() for file in (tmp_path / "records").iterdir()}
    assert main(arguments) == 0
    for file in (tmp_path / "records").iterdir():
        assert file.read_text().startswith(before.get(file, "").rpartition("\n")[0])
        assert keys(RecordFile(file).records) == {("rop", f"rop/{i}", 0, 20.0): 1 for i in range(3)}


def test_runs_that_are_left_and_restarts_where_time_is_left(tmp_path: Path) -> None:
    """Calls that ended by themselves are not repeated with a longer time limit."""
    cases = gather_cases(["rop"], 3, tmp_path, quiet)
    ran_out = replace(RECORD, name="rop/1", status="timeout", time=1.0, progress=())
    crashed = replace(RECORD, name="rop/2", status="crashed", time=0.0, progress=())
    refused = replace(crashed, status="invalid_goal")

    def left(records: list[Record], time_limit: float, seeds: int = 1, **more: Any) -> list[tuple[int, int]]:
        by_planner = {"rrt_connect": [RECORD, ran_out, crashed]}
        if more:
            by_planner = {"rrt_connect": [RECORD, ran_out, refused], "rrt_connect+restarts": records}
        asked = replace(settings(tmp_path), time_limit=time_limit, seeds=seeds, **more)
        return [(int(run.case.name[-1]), run.seed) for run in bench.open_runs(by_planner, cases, asked)]

    assert left([], 1.0) == [] and left([], 10.0) == [(1, 0), (2, 0)]
    assert left([], 0.5) == [(0, 0), (1, 0), (2, 0)]
    assert left([], 1.0, seeds=2) == [(0, 1), (1, 1), (2, 1)]
    again = [replace(RECORD, planner="rrt_connect+restarts", time=0.99, restarts=80)]
    assert left([], 1.0, equal_time=True) == [(0, 0)]
    assert left(again, 1.0, equal_time=True) == []
    assert left(again, 10.0, equal_time=True) == [(0, 0), (1, 0)]


@pytest.mark.slow
def test_a_planner_is_restarted_until_its_time_is_used_up(tmp_path: Path) -> None:
    asked = replace(settings(tmp_path, "rrt_connect", "rop_nontrivial", count=2), time_limit=2.0)
    assert bench.run_bench(asked, quiet, quiet) == 2
    before = read_records(tmp_path)["rrt_connect"]
    assert bench.run_bench(replace(asked, equal_time=True), quiet, quiet) == 2
    assert bench.run_bench(replace(asked, equal_time=True), quiet, quiet) == 0
    found = read_records(tmp_path)
    assert found["rrt_connect"] == before
    for once, again in zip(before, found["rrt_connect+restarts"], strict=True):
        assert again.name == once.name and again.restarts is not None and again.restarts > 0
        assert once.joint_length is not None and again.joint_length is not None
        assert again.joint_length <= once.joint_length
        assert again.progress[-1][1] == pytest.approx(again.joint_length, rel=1e-5)
        assert list(again.progress) == sorted(again.progress) and again.progress[-1][0] <= 2.0 + LATE_SECONDS
        problem = held_out_problem("rop", int(again.name.partition("/")[2]))
        assert rd.verify(problem, rd.Path(problem.robot.joint_names, again.waypoints)).valid
        assert not again.ended_by_itself


def test_planners_take_turns_with_each_problem(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Other work on the machine then affects all planners alike. The number of simultaneous calls stays constant."""
    calls = []
    at_once = [0]
    most = [0]
    wanted = [1]

    def plan(self: bench.PlannerProcess, run: Run, restarts: bool) -> list[dict]:
        at_once[0] += 1
        most[0] = max(most[0], at_once[0])
        calls.append((run.case.name, run.method))
        waiting.until(lambda: most[0] >= wanted[0], 300.0)
        at_once[0] -= 1
        return [{"status": "timeout", "time": 2.0}]

    monkeypatch.setattr(bench.PlannerProcess, "plan", plan)
    monkeypatch.setattr(bench.PlannerProcess, "warm", quiet)
    planners = "rrt_connect,mpnet,a_star"
    assert bench.run_bench(settings(tmp_path / "a", planners), quiet, quiet) == 9
    assert calls == [(f"rop/{i}", name) for i in range(3) for name in planners.split(",")]
    assert most == [1]
    wanted[0] = 2
    assert bench.run_bench(replace(settings(tmp_path / "b", planners), workers=2), quiet, quiet) == 9
    assert most == [2]
    for name in planners.split(","):
        assert [record.name for record in read_records(tmp_path / "b")[name]] == [f"rop/{i}" for i in range(3)]


def test_a_planner_with_settings_or_weights_of_the_package() -> None:
    planner = bench.PlannerSpec.parse("rrt_connect:optimize_time=0.05:tightenings=0").load()
    assert isinstance(planner, RRTConnect)
    assert (planner.settings.optimize_time, planner.settings.tightenings) == (0.05, 0)
    calls = bench.PlannerSpec.parse("aorrtc:until=time_limit:gain=0.01:clearance=0")
    assert calls.request()["until"] == "time_limit" and calls.request()["clearance"] == 0
    assert calls.load().settings == AORRTCSettings(gain=0.01)
    refuses("until 'soon'; known: converged", bench.PlannerSpec.parse, "aorrtc:until=soon")
    refuses("name them after @: diffusion@WEIGHTS", bench.PlannerSpec.parse, "diffusion:weights=panda")
    nested = bench.PlannerSpec.parse("diffusion:guidance.margin=0.02:samples=4").load()
    assert isinstance(nested, Diffusion)
    assert (nested.settings.guidance.margin, nested.settings.samples) == (0.02, 4)
    # weights of the package were sought in the working folder
    spec = bench.PlannerSpec.parse("diffusion@panda_points:samples=1")
    assert spec.label == "diffusion@panda_points:samples=1" and list(spec.weights_hashes) == ["model"]
    planner = spec.load()
    assert isinstance(planner, Diffusion) and planner.settings.weights == str(BUNDLED / "panda_points")


@pytest.mark.parametrize("cut", [1, 20, 100])
def test_line_that_was_cut_off_is_made_again(tmp_path: Path, cut: int) -> None:
    file = tmp_path / "a.jsonl"
    whole = RecordFile(file)
    whole.append(RECORD)
    whole.append(replace(RECORD, seed=1))
    cut_off = file.read_bytes()[:-cut]
    file.write_bytes(cut_off)
    appended = RecordFile(file)
    assert appended.records == [RECORD]
    assert file.read_bytes() == cut_off  # another process may be about to end the line
    appended.append(replace(RECORD, seed=2))
    assert RecordFile(file).records == [RECORD, replace(RECORD, seed=2)]
    file.write_text(file.read_text() + '{"planner": 1}\n' + json.dumps(RECORD.row()) + "\n")
    refuses("line 3 is no record", RecordFile, file)


def test_nontrivial_problems_are_not_solved_by_the_line(tmp_path: Path) -> None:
    cases = gather_cases(["rop_nontrivial", "rop"], 2, tmp_path, quiet)
    hard = [case for case in cases if case.problem_set == "rop_nontrivial"]
    assert len(hard) == 2 and not any(case.trivial or line_length(case.problem, validator) for case in hard)
    assert [case.key for case in gather_cases(["rop_nontrivial", "rop"], 2, tmp_path, quiet)] == [case.key for case in cases]
    assert [case.name for case in gather_cases(["rop"], 5, tmp_path, quiet)] == [f"rop/{i}" for i in range(5)]
    np.testing.assert_array_equal(cases[2].problem.start, held_out_problem("rop", 0).start)


def test_problems_of_files_and_folders(tmp_path: Path) -> None:
    lines = [json.dumps(problem_record(held_out_problem("rop", i))) for i in range(3)]
    folder = tmp_path / "mine"
    folder.mkdir()
    (folder / "a.jsonl").write_text("\n".join(lines[:2]))
    (folder / "b.json").write_text(lines[2])
    (folder / "readme.txt").write_text("not a problem")
    cases = gather_cases([str(folder)], None, tmp_path / "out", quiet)
    assert [(case.problem_set, case.family) for case in cases] == [("mine", family) for family in "aba"]
    assert len(gather_cases([str(folder)], 2, tmp_path / "out", quiet)) == 2
    (tmp_path / "empty").mkdir()
    refuses("holds no usable problem", gather_cases, [str(tmp_path / "empty")], None, tmp_path / "out", quiet)


def test_other_problems_of_the_same_name_are_refused(tmp_path: Path) -> None:
    """Regression: problems of the first file with a name were used for every other file with this name."""
    lines = [json.dumps(problem_record(held_out_problem("rop", i))) for i in range(2)]
    for folder, line in zip("ab", lines, strict=True):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "mine.jsonl").write_text(line)
    for _ in range(2):
        assert len(gather_cases([str(tmp_path / "a" / "mine.jsonl")], None, tmp_path / "out", quiet)) == 1
    with pytest.raises(rd.InputError, match=r"problems called mine that were read from .*; those in .* differ: rename"):
        gather_cases([str(tmp_path / "b" / "mine.jsonl")], None, tmp_path / "out", quiet)
    (tmp_path / "rop.jsonl").write_text(lines[0])
    refuses("a is an input of this command", gather_cases, [str(tmp_path / "a")], None, tmp_path / "a", quiet)
    refuses("have the name of the family rop", gather_cases, [str(tmp_path / "rop.jsonl")], None, tmp_path / "out", quiet)


def test_other_weights_of_the_same_name_and_another_clock_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Regression: calls with other weights of the same name were not made, or put into the same row; so with --cpu-time."""
    monkeypatch.setattr(bench, "keep_records", lambda *_: 0)
    for parent, digest in (("a", "1"), ("b", "2")):
        (tmp_path / parent / "best").mkdir(parents=True)
        (tmp_path / parent / "best" / "mpnet.json").write_text(json.dumps({"format": 2, "weights_sha256": digest}))
    first, other = (settings(tmp_path / "out", f"mpnet@{tmp_path / at}/best", count=1) for at in "ab")
    for _ in range(2):
        bench.run_bench(first, quiet, quiet)
    refuses("has records of mpnet@best with other weights than those in", bench.run_bench, other, quiet, quiet)
    timed = replace(first, cpu_time=True)
    refuses("has records of calls without --cpu-time, this run is with it", bench.run_bench, timed, quiet, quiet)


def test_bad_settings_are_told_before_anything_is_made(tmp_path: Path) -> None:
    for change, match in (
        ({"planners": ("rrt",)}, "unknown planner 'rrt'; known:"),
        ({"planners": ("rrt_connect", "rrt_connect")}, "the same name"),
        ({"planners": ("rrt_connect@.",)}, "rrt_connect has no weights"),
        ({"planners": ("rrt_connect:stp=1",)}, "rrt_connect has no setting 'stp'; it has .*tightenings"),
        ({"planners": ("rrt_connect:range",)}, "'range' is not NAME=VALUE"),
        ({"planners": ("diffusion@nowhere",)}, r"there are no weights \S*nowhere"),
        ({"problems": ("rop", "rop")}, "named only once"),
        ({"problems": ("ropp",)}, "neither a file or folder nor a family"),
        ({"count": 0}, "count is 0"),
        ({"cluster": "slurm"}, "known: ray"),
    ):
        refuses(match, lambda change=change: bench.run_bench(replace(settings(tmp_path / "out"), **change), quiet, quiet))
    assert not (tmp_path / "out" / "records").exists()


@pytest.mark.parametrize("name", bench.PRESETS)
def test_planners_and_problems_of_presets_are_known(name: str, tmp_path: Path) -> None:
    pytest.importorskip("ompl")
    stages = bench.preset_settings(name, tmp_path)
    assert stages
    for settings in stages:
        assert settings.specs and all(problem_set_name(text) for text in settings.problems)
    [first, *_] = bench.preset_settings(name, tmp_path, ("shelf",), count=20)
    assert first.problems == (*stages[0].problems, "shelf") and first.count == 20


@pytest.mark.slow
def test_the_command_runs_every_stage_of_a_preset(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    preset = bench.Preset(("rrt_connect",), ("rop",), (0.001, 0.5), 5, equal_time=False)
    monkeypatch.setitem(bench.PRESETS, "small", preset)
    assert main(["bench", "run", "--preset", "small", "--count", "2", "--out", str(tmp_path)]) == 0
    found = read_records(tmp_path)
    limits = {record.time_limit for record in found["rrt_connect"]}
    assert 0.001 in limits and len({record.name for record in found["rrt_connect"]}) == 2


def test_a_preset_in_place_of_planners_and_limits(tmp_path: Path, said: Said) -> None:
    refuses("unknown preset 'table2'; known: anytime", bench.preset_settings, "table2", tmp_path)
    asked = ("bench", "run", "--out", tmp_path, "--planners", "rrt_connect")
    assert "name --planners and --problems, or a --preset" in said(2, *asked)
    assert "--preset cannot be combined with --planners" in said(2, *asked, "--preset", "anytime")


@pytest.mark.sim
def test_motions_are_looked_at_again(tmp_path: Path, said: Said) -> None:
    """Where there are results, and problems for them."""
    pytest.importorskip("pybullet", reason="the extra `sim` (pybullet) is not installed")
    case = gather_cases(["rop_nontrivial"], 1, tmp_path, quiet)[0]
    problem = case.problem
    path = RRTConnect().plan(problem, 10.0).path
    assert isinstance(problem.goal, rd.JointGoal)
    about = Record("good", *case.key, case.family, case.trivial, 0, 1.0, "solved", "", 0.01)
    line = [problem.start.tolist(), problem.goal.positions[0].tolist()]
    for record in (
        replace(about, positions=tuple(map(tuple, path.positions.tolist()))),
        replace(about, planner="bad", positions=tuple(map(tuple, line))),
        replace(about, planner="none", status="timeout"),
    ):
        RecordFile(tmp_path / "records" / f"{record.planner}.jsonl").append(record)
    lines = said(1, "bench", "confirm", tmp_path).splitlines()
    rows = {line.split()[0]: line.split()[1:] for line in lines[1:4]}
    assert rows == {"bad": ["1", "1"], "good": ["1", "0"], "none": ["0", "0"]}
    assert lines[4].startswith("bad, rop_nontrivial rop/") and "mm deep" in lines[4]
    (tmp_path / "records" / "bad.jsonl").unlink()
    said(0, "bench", "confirm", tmp_path, "--count", 1)
    assert "holds no records" in said(2, "bench", "confirm", tmp_path / "nothing")
    (tmp_path / "problems" / "rop.jsonl").unlink()
    assert "of rop_nontrivial, which has results" in said(2, "bench", "confirm", tmp_path, "--count", 1)
