"""The bench: calls planners on problems and stores a record of each call, so that no call is repeated.

Each planner under test runs in its own process, so that a crash, an endless loop or a memory leak affects no
other planner. Processes run on this machine or on a Ray cluster. Warming up (compilation, imports) is not
timed. Presets are named comparisons of planners, such as the tables of docs/results.md.
"""

import os
import platform
import resource
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass, fields
from datetime import UTC, datetime
from functools import cached_property, lru_cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

from robotdiffuse import __version__
from robotdiffuse.core.errors import InputError, check_name
from robotdiffuse.core.files import JsonLines, append_line, is_file, lock_folder, writing
from robotdiffuse.core.settings import Count, Filled, OneOf, Positive, Settings
from robotdiffuse.core.types import Done
from robotdiffuse.evaluation.metrics import measured
from robotdiffuse.evaluation.report import processor, versions
from robotdiffuse.evaluation.runs import (
    CRASHED,
    OVERRAN,
    RESTARTED,
    Fields,
    Record,
    RecordFile,
    Results,
    Run,
    gather_cases,
    keep_records,
    load_average,
    planner_calls,
    problem_set_name,
    record_path,
    runs_of,
)
from robotdiffuse.learning.weight_files import NETWORKS, folder_of, read_description
from robotdiffuse.planning import PLANNERS, load_planner, planner_settings
from robotdiffuse.planning.context import PlanRequest
from robotdiffuse.planning.planner import Planner
from robotdiffuse.problems.files import Case, Progress, problem_from_record, problem_record
from robotdiffuse.processes.workers import CLUSTERS, EndedError, NotStartedError, OverrunError, Worker
from robotdiffuse.robots.robot import Robot

CALL_ARGUMENTS = [field.name for field in fields(PlanRequest) if field.name not in ("time_limit", "seed")]
"""Arguments of `Planner.plan` that may follow the name of a planner, see `PlannerSpec.parse`. The bench sets
time limit and seed."""


@dataclass(frozen=True)
class PlannerSpec:
    """How the bench loads and calls a planner."""

    name: str
    """Name of the planner in `planning.PLANNERS`."""
    weights: str | None = None
    """Folder of the planner's weights; None: the bundled weights."""
    settings: tuple[str, ...] = ()
    """Settings of the planner and arguments of its calls (`PlanRequest`), each as NAME=VALUE."""

    @classmethod
    def parse(cls, text: str) -> "PlannerSpec":
        """Parse NAME, NAME@WEIGHTS, NAME:SETTING=VALUE:SETTING=VALUE or NAME@WEIGHTS:SETTING=VALUE.

        Raises InputError for an unknown planner or setting, listing the known ones, and for a value out of
        bounds.
        """
        planner_text, *settings = text.split(":")
        name, at, folder = planner_text.partition("@")
        PLANNERS.entry(name)
        if any(setting.startswith("weights=") for setting in settings):
            raise InputError(f"planner {text!r} sets weights; name them after @: {name}@WEIGHTS")
        spec = cls(name, str(folder_of(folder).resolve()) if at else None, tuple(settings))
        spec.request()
        if settings:
            spec._settings()
        return spec

    @property
    def label(self) -> str:
        """The planner's name in results."""
        name = self.name if self.weights is None else f"{self.name}@{Path(self.weights).name}"
        return ":".join([name, *self.settings])

    @property
    def weights_hashes(self) -> Fields:
        """SHA-256 of the weights in the folder, by network; empty if the planner uses the bundled weights."""
        if self.weights is None:
            return {}
        folder = Path(self.weights)
        names = [name for name in NETWORKS if is_file(folder / f"{name}.json")]
        return {name: read_description(folder, name).get("weights_sha256") for name in names}

    def request(self) -> Fields:
        """Arguments of the planner's calls, by name: until, clearance, ..."""
        request = PlanRequest().changed(text for text in self.settings if _of_call(text))
        return {name: getattr(request, name) for name in CALL_ARGUMENTS}

    def load(self) -> Planner:
        """Load the planner. Raises InputError in the cases in which `load_planner` raises it, and for a
        planner that another process cannot import."""
        if PLANNERS.entry(self.name).location.startswith("__main__:"):
            raise InputError(
                f"planner {self.name} is in the program that was started, which the processes of a bench do "
                "not import; put it into a module of its own"
            )
        if not self.settings:
            return load_planner(self.name, weights=self.weights)
        return load_planner(self.name, self._settings())

    def _settings(self) -> Settings:
        weights = () if self.weights is None else (f"weights={self.weights}",)
        setting_texts = (text for text in self.settings if not _of_call(text))
        return planner_settings(self.name, (*weights, *setting_texts))


def _of_call(text: str) -> bool:
    return text.partition("=")[0] in CALL_ARGUMENTS


START_TIMEOUT = 300.0
"""Timeout for starting a process, and for warming it up [s]. It is long because on a new machine kernels are
compiled."""
GRACE = 20.0
"""A process that has not answered this long after the time limit is killed [s]. In this time, the motion is
validated and timed."""
RESTARTS_TIMEOUT_FACTOR = 20.0
"""Timeout for all repeated calls of a run together (`equal_time`), as a multiple of the time limit; GRACE is
added. It is long because computing the trajectory of each path does not count for the limit."""
RUNS_PER_TASK = 20
"""Number of runs in a task of a cluster. Each task starts the planner's process again."""


# cached: making a record reads the files of shapes and views, and a problem is planned many times
_record_of = lru_cache(maxsize=8)(problem_record)


class PlannerProcess:
    """A planner in another process. The process starts with the first run, and again after it has died."""

    def __init__(self, spec: PlannerSpec, log: Path, cpu_time: bool = False) -> None:
        """The output of the process is appended to the file `log`. For `cpu_time` see `BenchSettings`.

        Raises InputError if this file cannot be written: the process would end, which would count as a crash.
        """
        with writing(log):
            log.parent.mkdir(parents=True, exist_ok=True)
            log.touch()
        self._log = log
        self._worker = Worker(_prepare, (spec, str(log), cpu_time))

    def warm(self, run: Run) -> None:
        """Warm up for the robot of a run. If the process dies while it warms up, `plan` reports this. Raises
        InputError if the program cannot start processes."""
        try:
            self._worker.start()
        except NotStartedError as error:
            raise InputError(str(error)) from None
        except EndedError:
            return
        self._ask(START_TIMEOUT, _warm_up, _record_of(run.problem))

    def plan(self, run: Run, restarts: bool = False) -> list[Fields]:
        """The fields of a run's records. A crash and an overrun also give a record."""
        problem = _record_of(run.problem)
        # warm up first if the robot is new to the process
        answer = self._ask(START_TIMEOUT, _warm_up, problem)
        if answer is not None:
            return [answer]
        answer = self._ask(run.limit + GRACE, _first_answer, problem, run.seed, run.limit, restarts)
        answers = list[Fields]()
        while answer is not None:
            answers.append(answer)
            if answer["status"] in (CRASHED, OVERRAN):
                break
            answer = self._ask(RESTARTS_TIMEOUT_FACTOR * run.limit + GRACE, _next_answer)
        return answers

    def close(self) -> None:
        """Kill the process, even if another thread waits for it."""
        self._worker.close()

    def _ask(self, timeout: float, call: Callable[..., Fields | None], *arguments: Any) -> Fields | None:
        """The answer of a call in the process; if the process gave no answer, the fields of a record with the
        reason."""
        try:
            return self._worker.call(call, *arguments, timeout=timeout)
        except OverrunError:
            reason = f"no answer {timeout:g} s after the call; the process was killed"
            return {"status": OVERRAN, "reason": reason, "time": timeout}
        except EndedError as error:
            lines = self._log.read_text(errors="replace").strip().splitlines() if self._log.exists() else []
            reason = ": ".join([f"the planner's process ended {error}", *lines[-1:]])
            return {"status": CRASHED, "reason": reason[:300], "time": 0.0}


# State and functions of the planner's process

_planner: Planner
# Further arguments of the planner's calls
_request: Fields
# Answers of the current run that have not been sent yet
_answers: Iterator[Fields]
# Robots for which the planner has been warmed up
_warm = set[Robot]()


def _prepare(spec: PlannerSpec, log: str, cpu_time: bool) -> None:
    """Load the planner, and redirect all output of the process to the log."""
    global _planner, _request
    if cpu_time:
        time.perf_counter = time.process_time
    with open(log, "a") as stream:
        os.dup2(stream.fileno(), 1)
        os.dup2(stream.fileno(), 2)
    _planner = spec.load()
    _request = spec.request()


def _warm_up(record: Fields) -> None:
    """Compile and load kernels and fill the caches of the planner and of the metrics."""
    problem = problem_from_record(record)
    if problem.robot in _warm:
        return
    _warm.add(problem.robot)
    try:
        for result in _planner.warm_up(problem):
            if result.trajectory is not None:
                measured(problem.robot, result.path, result.trajectory, result)
    except (Exception, SystemExit):  # the timed call will meet this error too, and report it
        traceback.print_exc()


def _first_answer(record: Fields, seed: int, limit: float, restarts: bool) -> Fields | None:
    """Begin a run and return the fields of its first record."""
    global _answers
    _answers = iter(planner_calls(_planner, problem_from_record(record), seed, limit, restarts, _request))
    return _next_answer()


def _next_answer() -> Fields | None:
    """The fields of the run's next record, with the memory of the process and the load of the machine; None
    after the last record."""
    answer = next(_answers, None)
    if answer is None:
        return None
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return answer | {"memory": round(memory, 1), "load": load_average()}


# Runs of many planners


def on_this_machine(settings: "BenchSettings", runs: Sequence[Run], session: str) -> Results:
    """Make runs, with one process for each planner; up to `settings.workers` processes plan at the same time.

    All processes are warmed up before the first call is timed. The planners take turns, so that other work on
    the machine affects all of them alike.
    """
    first = {run.method: run for run in reversed(runs)}
    specs = settings.specs
    workers = settings.workers
    planners = {
        label: PlannerProcess(specs[label], settings.log_file(label), settings.cpu_time) for label in first
    }
    pool = ThreadPoolExecutor(workers)
    todo = list(runs)
    running = dict[Future[list[Fields]], Run]()
    try:
        for job in [pool.submit(planners[label].warm, run) for label, run in first.items()]:
            job.result()
        while todo or running:
            busy = {run.method for run in running.values()}
            position = next((i for i, run in enumerate(todo) if run.method not in busy), None)
            if position is not None and len(running) < workers:
                run = todo.pop(position)
                running[pool.submit(planners[run.method].plan, run, settings.equal_time)] = run
                continue
            for job in wait(running, return_when=FIRST_COMPLETED).done:
                run = running.pop(job)
                yield run, records_of(run, job.result(), {"run": session, "workers": workers})
    finally:
        for process in planners.values():
            process.close()
        pool.shutdown(cancel_futures=True)


def on_cluster(settings: "BenchSettings", runs: Sequence[Run], session: str) -> Results:
    """Make runs on a cluster; each task starts a process and makes up to RUNS_PER_TASK runs.

    The nodes need this package, and weights and other files at the same paths as this machine.
    """
    tasks = list[tuple[PlannerSpec, list[Run], bool]]()
    assert settings.cluster is not None
    for label, spec in settings.specs.items():
        planner_runs = [run for run in runs if run.method == label]
        parts = (planner_runs[i : i + RUNS_PER_TASK] for i in range(0, len(planner_runs), RUNS_PER_TASK))
        tasks += [(spec, part, settings.equal_time) for part in parts]
    for number, (answers, output) in CLUSTERS[settings.cluster](_run_task, tasks):
        _, part, _ = tasks[number]
        if output:
            append_line(settings.log_file(part[0].method), output.rstrip(), make_folder=True)
        for run, answer in zip(part, answers, strict=True):
            yield run, records_of(run, answer, {"run": session, "workers": settings.cluster})


def records_of(run: Run, answers: Sequence[Fields], about: Fields) -> list[Record]:
    """The records of a run: one of the first call and, if there were restarts, one of all calls together."""
    labels = (run.method, run.method + RESTARTED)
    pairs = zip(labels, answers, strict=False)
    return [run.record({"planner": label, **about, **answer}) for label, answer in pairs]


def _run_task(spec: PlannerSpec, runs: list[Run], restarts: bool) -> tuple[list[list[Fields]], str]:
    """The answers of the planner to these runs, and what the planner printed."""
    with TemporaryDirectory() as folder:
        log = Path(folder) / "log"
        process = PlannerProcess(spec, log)
        try:
            answers = [process.plan(run, restarts) for run in runs]
        finally:
            process.close()
        return answers, log.read_text(errors="replace") if log.exists() else ""


PACKAGES = ("numpy", "numba", "onnxruntime", "ompl")
"""Packages whose versions are stored with the results."""


@dataclass(frozen=True)
class BenchSettings(Settings):
    """What `bench run` runs."""

    planners: Annotated[tuple[str, ...], Filled()]
    """Planners, each as text for `PlannerSpec.parse`; or only `all`."""
    problems: Annotated[tuple[str, ...], Filled()]
    """Problem sets: files, folders, families (rop, rop_dense, ...), or FAMILY_nontrivial for a family
    without the problems that a straight line solves."""
    out: Path
    """Folder for problems and results."""
    time_limit: Positive = 1.0
    """Time limit of a call [s]."""
    seeds: Count = 1
    """Number of calls on each problem, with seeds 0, 1, ..."""
    count: Count | None = None
    """Number of problems of each set; None: 100 for a family, all for a file or folder."""
    workers: Count = 1
    """Number of planners that run at the same time, each in its own process."""
    cluster: Annotated[str, OneOf(CLUSTERS)] | None = None
    """"ray" for the cluster that RAY_ADDRESS names; None for this machine."""
    equal_time: bool = False
    """Whether planners that end early are called again with other seeds until the limit, so that lengths can
    be compared at equal time. Planners with repeated calls have their own rows in results."""
    cpu_time: bool = False
    """Whether limits and times are CPU time of the planner's process; not possible on a cluster."""

    def __post_init__(self) -> None:
        if self.planners == ("all",):
            object.__setattr__(self, "planners", tuple(PLANNERS))
        super().__post_init__()
        _ = self.specs
        if len(set(self.problems)) < len(self.problems):
            raise InputError(f"problems are {', '.join(self.problems)!r}; each may be named only once")
        if self.cpu_time and self.cluster is not None:
            raise InputError(
                f"cpu_time is True and cluster is {self.cluster}; CPU time is measured only on this machine"
            )

    def log_file(self, label: str) -> Path:
        """File with the output of the planner with this name in results."""
        return self.out / "logs" / f"{label.replace('/', '_')}.log"

    @cached_property
    def specs(self) -> dict[str, PlannerSpec]:
        """The planners by their names in results. Raises InputError for an unknown planner, and if two
        planners have the same name."""
        specs = {spec.label: spec for spec in map(PlannerSpec.parse, self.planners)}
        if len(specs) < len(self.planners):
            raise InputError(f"planners is {', '.join(self.planners)!r}; two have the same name in results")
        return specs


def run_bench(settings: BenchSettings, report: Progress, done: Done) -> int:
    """Make the calls that have no record in the folder; returns how many were made.

    A call is not repeated if a record with a shorter time limit shows that it ended before that limit, since
    more time would not change its result. With `equal_time`, such a call is repeated if another seed could
    change its result. Raises InputError, before any call, for a folder that another process uses, a planner
    that cannot be loaded, weights or a clock other than those of the folder's records, and problems that
    `gather_cases` refuses; KeyboardInterrupt on Ctrl-C. Running again with the same settings then continues.
    """
    with lock_folder(settings.out):
        specs = settings.specs
        for spec in specs.values():
            spec.load()
        sessions = JsonLines(settings.out / "runs.jsonl")
        _check_sessions(settings, sessions.rows)
        cases = gather_cases(list(settings.problems), settings.count, settings.out, report)
        session = _note_session(settings, sessions)
        suffixes = ("", RESTARTED) if settings.equal_time else ("",)
        labels = [label + suffix for label in specs for suffix in suffixes]
        files = {label: RecordFile(record_path(settings.out, label)) for label in labels}
        todo = open_runs({label: file.records for label, file in files.items()}, cases, settings)
        total = len(cases) * settings.seeds * len(specs)
        done(total - len(todo), total)
        results = (on_this_machine if settings.cluster is None else on_cluster)(settings, todo, session)
        return keep_records(todo, results, files, lambda left: done(total - left, total))


def open_runs(
    records: Mapping[str, Sequence[Record]], cases: Sequence[Case], settings: BenchSettings
) -> list[Run]:
    """The runs that are still to be made: those that no record answers (see `run_bench`). `records` are the
    existing records by planner."""
    answered = set[tuple[str, str, str, int]]()
    for label in settings.specs:
        restarted = {record.key for record in records.get(label + RESTARTED, ())}
        for record in records.get(label, ()):
            same_limit = record.time_limit == settings.time_limit
            is_answered = same_limit or (record.time_limit < settings.time_limit and record.ended_by_itself)
            if settings.equal_time and record.restartable:
                is_answered = same_limit and record.key in restarted
            if is_answered:
                answered.add((label, *record.case))
    runs = runs_of(cases, settings.specs, range(settings.seeds), settings.time_limit)
    return [run for run in runs if (run.method, *run.case.key, run.seed) not in answered]


def _check_sessions(settings: BenchSettings, sessions: Sequence[Mapping[str, Any]]) -> None:
    """Raise InputError if calls in this folder were timed by another clock, or a planner of the same name was
    run with other weights: different records would be mixed."""
    if any(session.get("cpu_time", False) != settings.cpu_time for session in sessions):
        ours, theirs = ("with", "without") if settings.cpu_time else ("without", "with")
        raise InputError(
            f"{settings.out} has records of calls {theirs} --cpu-time, this run is {ours} it; use the same "
            "clock, or another folder"
        )
    for label, spec in settings.specs.items():
        now = spec.weights_hashes
        if any(session.get("weights", {}).get(label, now) != now for session in sessions):
            raise InputError(
                f"{settings.out} has records of {label} with other weights than those in {spec.weights}; "
                "rename the folder of the weights, or use another folder for the results"
            )


def _note_session(settings: BenchSettings, sessions: JsonLines) -> str:
    """Append machine, versions and settings of this session to runs.jsonl. Returns the name of the session,
    its starting time, which is stored in the records."""
    now = datetime.now(UTC)
    session = now.strftime("%Y-%m-%d %H:%M:%S")
    note = {
        "run": session,
        "date": now.strftime("%Y-%m-%d %H:%M"),
        "processor": processor(),
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        "versions": {"robotdiffuse": __version__, **versions(PACKAGES)},
        "planners": list(settings.specs),
        "weights": {label: spec.weights_hashes for label, spec in settings.specs.items() if spec.weights},
        "problems": [problem_set_name(text) for text in settings.problems],
        "time_limit": settings.time_limit,
        "seeds": settings.seeds,
        "count": settings.count,
        "workers": settings.cluster or settings.workers,
        "load": load_average(),
        "equal_time": settings.equal_time,
        "cpu_time": settings.cpu_time,
    }
    sessions.append(note)
    return session


# Presets

# planners that search for the shortest path
AORRTC = "aorrtc:objective=length"
RRT_CONNECT = "rrt_connect:objective=length"
ROP = ("rop_nontrivial", "rop_dense_nontrivial")


@dataclass(frozen=True)
class Preset:
    """A named comparison: planners that run on the first `count` problems of each set, with each of the time
    limits."""

    planners: tuple[str, ...]
    problems: tuple[str, ...]
    limits: tuple[float, ...]
    """Time limits of a call [s]."""
    count: int
    """Number of problems of each set."""
    equal_time: bool = True
    """See `BenchSettings`."""


PRESETS = {
    # path lengths at one second: search, diffusion, learned baselines
    "equal_time": Preset(
        (
            *(AORRTC, RRT_CONNECT, "shared_tree_rrt_star"),
            *("diffusion", "mpd", "edmp", "mpnet", "mpinets"),
        ),
        (*ROP, "shelf_nontrivial"),
        (1.0,),
        30,
    ),
    # the diffusion network against search, with 0.1 and 0.3 s
    "learning": Preset(
        ("diffusion", AORRTC, "shared_tree_rrt_star"),
        (*ROP, "shelf_nontrivial"),
        (0.1, 0.3),
        150,
    ),
    # durations of motions with 0.1 and 1 s: minimizing time, minimizing length, and OMPL's timed paths
    "durations": Preset(
        (
            "aorrtc",
            "diffusion",
            AORRTC,
            "ompl_rrt_connect",
            "ompl_aorrtc",
        ),
        ("shelf_nontrivial", "crate_nontrivial", "table_nontrivial", "kitchen_nontrivial", "rop_nontrivial"),
        (0.1, 1.0),
        100,
        equal_time=False,
    ),
    # Shared-Tree Informed RRT* and AORRTC against OMPL's AORRTC and Informed RRT*
    "anytime": Preset(
        ("shared_tree_rrt_star", AORRTC, "ompl_aorrtc", "ompl_informed_rrt_star"),
        ROP,
        (1.0,),
        100,
    ),
    # AORRTC against restarts of RRT-Connect until the same limit
    "restarts": Preset(
        (AORRTC, RRT_CONNECT),
        (*ROP, "shelf_nontrivial"),
        (1.0,),
        100,
    ),
}


def preset_settings(
    preset: str, out: Path, problems: Sequence[str] = (), count: int | None = None, **more: Any
) -> list[BenchSettings]:
    """The bench settings of a preset, one for each of its time limits.

    Args:
        preset: Name of the preset.
        out: Folder for problems and results.
        problems: Problem sets in addition to those of the preset.
        count: Number of problems of each set, at most that of the preset; None: that of the preset.
        more: Further `BenchSettings`.

    Raises:
        InputError: For an unknown preset; the message lists the known ones.
    """
    check_name("preset", preset, PRESETS)
    chosen = PRESETS[preset]
    max_count = chosen.count
    preset_values = {
        "count": max_count if count is None else min(count, max_count),
        "equal_time": chosen.equal_time,
    }
    sets = (*chosen.problems, *problems)
    return [
        BenchSettings(chosen.planners, sets, out, time_limit=limit, **preset_values, **more)
        for limit in chosen.limits
    ]
