"""Runs: every case (a problem of a problem set) with every method and seed. The result of each run is
validated and stored as a record, a line of JSON.

A method takes a run and yields the fields of its records, including the validator's verdict. Methods are
planners, and samplers of trajectories: networks or controls (baselines without a network). The time of a
planner's call includes its validation; the time of sampling does not. Methods are called one after the other
in this process (`in_this_process`), or in the processes of a bench. Runs that already have a record are not
made again.

A problem set has a name and holds held-out problems of a family (a kind of random problems), or the problems
of a file or folder. Problems are checked once and then stored.
"""

import hashlib
import itertools
import json
import os
import time
import traceback
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path as FilePath
from typing import TYPE_CHECKING, Any, NamedTuple
from urllib.parse import quote, unquote

import numpy as np
from numpy import ndarray
from rich.console import Console
from rich.progress import Progress as ProgressBar

from robotdiffuse.baselines.controls import Control, ControlSettings
from robotdiffuse.collision import CollisionChecker
from robotdiffuse.core.errors import InputError, repeated
from robotdiffuse.core.files import JsonLines, check_not_input, read_bytes, read_json, write_atomically
from robotdiffuse.core.types import (
    LENGTH,
    Configurations,
    Mask,
    Path,
    PlanResult,
    Status,
    Values,
    frozen_dataclass,
)
from robotdiffuse.evaluation.metrics import measured
from robotdiffuse.learning.guidance import Trajectories
from robotdiffuse.planning.diffusion import Diffusion, DiffusionSettings, encode
from robotdiffuse.planning.planner import Planner
from robotdiffuse.planning.search.rrt import AORRTC, AORRTCSettings
from robotdiffuse.problems.families import FAMILIES
from robotdiffuse.problems.files import SEED, Case, CaseFile, Progress, goal_of, line_length, load_problems
from robotdiffuse.problems.problem import JointGoal, Problem
from robotdiffuse.robots.robot import Robot
from robotdiffuse.validation.report import Report
from robotdiffuse.validation.validator import VerifySettings, verifier

if TYPE_CHECKING:
    from robotdiffuse.learning.motion_model import ClearanceFn

NONTRIVIAL_SUFFIX = "_nontrivial"
"""Suffix of a family's name for the set of its non-trivial problems: a search solves them, the straight line
does not."""
SEARCH_TIME = 10.0
"""A problem is left out of such a set if the search does not solve it in this time [s]."""
FAMILY_COUNT = 100
"""Number of problems of a family if none is given."""
REFERENCE_ITERATIONS = 20_000
"""Minimum number of iterations of the search for the reference length."""


def validator(problem: Problem, path: Path) -> bool:
    """Whether a path passes the validator."""
    return verifier(problem, VerifySettings()).path(path).valid


def search(problem: Problem) -> float | None:
    """The reference length of a problem: the length of a short path that a search finds [rad]; None if the
    search does not solve the problem in time."""
    planner = AORRTC(AORRTCSettings(gain=0.001, patience=REFERENCE_ITERATIONS))
    return planner.plan(problem, SEARCH_TIME, seed=1, clearance=0.0, objective=LENGTH).path_length


def case_file(folder: FilePath | None, name: str) -> CaseFile:
    """The file that stores the cases of a problem set in a folder. Without a folder, cases are kept in
    memory."""
    return CaseFile(None if folder is None else folder / f"{name}.jsonl")


def hard_cases(
    family: str, count: int, folder: FilePath | None = None, report: Progress = lambda text: None
) -> list[Case]:
    """The first `count` held-out problems of a family that are not trivial and that the search solves. The
    folder stores the problems with the results of validator and search."""
    return case_file(folder, family).held_out(family, count, validator, search, report)


def problem_set_name(text: str) -> str:
    """The name of a problem set in results. Raises InputError for a text that is neither a family nor a file
    or folder."""
    family = text.removesuffix(NONTRIVIAL_SUFFIX)
    if family in FAMILIES:
        return text
    place = FilePath(text)
    if not place.exists():
        raise InputError(
            f"problems {text!r} are neither a file or folder nor a family; known families: "
            f"{', '.join(FAMILIES)}, each also with {NONTRIVIAL_SUFFIX}"
        )
    name = place.resolve().stem
    if name.removesuffix(NONTRIVIAL_SUFFIX) in FAMILIES:
        raise InputError(f"problems {text!r} have the name of the family {name}; rename the file or folder")
    return name


def gather_cases(names: list[str], count: int | None, out: FilePath, report: Progress) -> list[Case]:
    """The first `count` problems of each set (None: all of a file or folder, 100 of a family).

    Problems are stored in `out`/problems, one file for each set, and read from there next time. If `count` is
    then larger, problems of families are added. `report` is called with lines of text about the progress.
    Raises InputError for unknown and repeated names, for empty sets, if `out` is itself one of the sets, and
    if the content of a file or folder differs from the problems that are stored under its name.
    """
    repeated_names = repeated(problem_set_name(text) for text in names)
    if repeated_names:
        twice = ", ".join(sorted(repeated_names))
        raise InputError(f"problems have {twice} twice; leave one out, or rename its file or folder")
    return [case for text in names for case in _set(text, count, out / "problems", report)]


def read_cases(out: FilePath, problem_set: str) -> list[Case]:
    """All cases of a problem set that are stored in a folder. Raises InputError if their file is damaged."""
    family = problem_set.removesuffix(NONTRIVIAL_SUFFIX)
    name = family if family in FAMILIES else problem_set
    return _of_set(case_file(out / "problems", name).cases(hard=name != problem_set), problem_set)


def _set(text: str, count: int | None, folder: FilePath, report: Progress) -> list[Case]:
    name = problem_set_name(text)
    family = text.removesuffix(NONTRIVIAL_SUFFIX)
    case_store = case_file(folder, family if family in FAMILIES else name)
    if family in FAMILIES:
        finder = search if family != text else None
        return _of_set(case_store.held_out(family, count or FAMILY_COUNT, validator, finder, report), name)
    place = FilePath(text)
    check_not_input(folder.parent, text)
    source = folder / f"{name}.source.json"
    about = {"source": str(place.resolve()), "sha256": _content_hash(place)}
    if not len(case_store):
        cases = _read_place(place, name, report)
        write_atomically(source, json.dumps(about), make_folder=True)
        case_store.fill(cases)
    elif source.is_file() and (stored := read_json(source))["sha256"] != about["sha256"]:
        raise InputError(
            f"{folder} has problems called {name} that were read from {stored['source']}; those in {text} "
            "differ: rename them, or use another output folder"
        )
    return _of_set(case_store.cases()[:count], name)


def _content_hash(place: FilePath) -> str:
    """SHA-256 of the problem files of a set. Mesh files are not included."""
    digest = hashlib.sha256()
    for part in _parts(place):
        for file in [part] if part.is_file() else sorted(part.glob("*.yaml")):
            digest.update(f"{file.relative_to(place)} {file.stat().st_size}\n".encode())
            digest.update(read_bytes(file))
    return digest.hexdigest()


def _of_set(cases: list[Case], problem_set: str) -> list[Case]:
    return [replace(case, problem_set=problem_set) for case in cases]


def _read_place(place: FilePath, name: str, report: Progress) -> list[Case]:
    """The cases of a problem file, of a MotionBenchMaker folder, or of all problem files and MotionBenchMaker
    folders in a folder."""
    cases = []
    for part in _parts(place):
        family = part.resolve().stem
        for entry in load_problems(part):
            if entry.problem is None:
                report(f"left out: {entry.error}")
                continue
            line = line_length(entry.problem, validator)
            cases.append(Case(entry.name, family, entry.problem, line is not None, line))
        report(f"problems: {len(cases)} of {name}")
    if not cases:
        raise InputError(f"{place} holds no usable problem")
    return _interleaved(cases)


def _parts(place: FilePath) -> list[FilePath]:
    if place.is_file() or any(place.glob("scene*.yaml")):
        return [place]
    endings = (".jsonl", ".json", ".yaml", ".yml")
    return [
        part
        for part in sorted(place.iterdir())
        if (part.is_dir() and any(part.glob("scene*.yaml"))) or part.suffix.lower() in endings
    ]


def _interleaved(cases: list[Case]) -> list[Case]:
    """The cases, ordered by taking one of each family in turn, so that the first cases are of all
    families."""
    families = dict[str, list[Case]]()
    for case in cases:
        families.setdefault(case.family, []).append(case)
    rows = itertools.zip_longest(*families.values())
    return [case for row in rows for case in row if case is not None]


SOLVED = Status.SOLVED.value
CRASHED = "crashed"
"""Status of a record whose planner's process died. This status and the next two are not in `types.Status`."""
OVERRAN = "overran"
"""Status of a record whose planner did not answer in time."""
RAISED = "exception"
"""Status of a record whose planner raised an exception."""
ENDED_EARLY = 0.9
"""A call that took less than this fraction of its time limit ended by itself: a longer limit would give the
same result."""
SHORTEST_FACTOR = 1 + 1e-6
"""A path counts as shortest if its length is at most this multiple of the shortest known or possible one."""
RESTARTABLE = {SOLVED, Status.TIMEOUT.value, Status.NO_PATH.value}
"""Statuses of calls for which another seed can give another result."""
RESTARTED = "+restarts"
"""Suffix of the name of a planner whose calls were repeated until the time limit."""


@dataclass(frozen=True)
class Record:
    """The result of one call on one problem."""

    planner: str
    """Name of the planner or other method."""
    problem_set: str
    name: str
    """Name of the problem in its set."""
    family: str
    """Family of the problem."""
    trivial: bool
    """Whether the straight line from the start to a goal configuration passes the validator."""
    seed: int
    time_limit: float
    """Time limit of the call [s]."""
    status: str
    """A value of `types.Status`, or crashed, overran, exception."""
    reason: str
    """Explanation of the status."""
    time: float
    """Time [s]: of a planner's call with its validation, but without computing the trajectory; of sampling,
    without validation."""
    cpu: float | None = None
    """CPU time [s]; None if it was not measured."""
    restarts: int | None = None
    """How often the planner was called again within the time limit; None for a single call without
    restarts."""
    refused: str = ""
    """Why the validator refused the last path, see `PlanResult`."""
    stage: str = ""
    """The part of the planner that found the path, see `PlanResult`."""
    progress: tuple[tuple[float, float], ...] = ()
    """For each path that was shorter than all earlier paths: the time at which it was found [s], and its
    joint-space length [rad]."""
    passed: float | None = None
    """Fraction of the samples of a batch that passed the validator."""
    collided: float | None = None
    """Fraction of the samples of a batch that collide."""
    reference: float | None = None
    """Length of the shortest known path [rad], see `problems.files.Case`."""
    measures: dict[str, float] = field(default_factory=dict)
    """Metrics of the returned motion by name (`metrics.METRICS`). In files they are fields like all
    others."""
    memory: float | None = None
    """Peak memory of the planner's process up to the end of the call [MB]."""
    run: str = ""
    """The session that made the call, named by its starting time; empty if unknown."""
    workers: int | str = ""
    """Number of simultaneous calls, or the name of the cluster."""
    load: float | None = None
    """Load average of the machine after the call."""
    positions: tuple[tuple[float, ...], ...] = ()
    """Waypoints of the returned path [rad]."""

    @property
    def key(self) -> tuple[str, str, int, float]:
        """Identifies the record among all records of its planner: problem set, problem, seed and time
        limit."""
        return *self.case, self.time_limit

    @property
    def case(self) -> tuple[str, str, int]:
        """Problem set, problem and seed."""
        return self.problem_set, self.name, self.seed

    @property
    def joint_length(self) -> float | None:
        """Length of the returned path [rad]."""
        return self.measures.get("joint_length")

    @property
    def solved(self) -> bool:
        return self.status == SOLVED

    @property
    def ended_by_itself(self) -> bool:
        """Whether the call ended clearly before its time limit, so that a longer limit would give the same
        result."""
        cut_off = self.status in (CRASHED, OVERRAN) or bool(self.restarts)
        return not cut_off and self.time < ENDED_EARLY * self.time_limit

    @property
    def restartable(self) -> bool:
        """Whether there was time left for a call with another seed, which could change the result."""
        return self.ended_by_itself and self.status in RESTARTABLE

    @property
    def in_collision(self) -> bool:
        """Whether the validator refused the planner's last path because it collides."""
        return not self.solved and self.refused.endswith("collision")

    @property
    def waypoints(self) -> Configurations:
        return np.array(self.positions, np.float64)

    def row(self) -> "Fields":
        """The record as JSON data, without fields that have their default values."""
        defaults = {f.name: f.default for f in fields(self)}
        values = asdict(self)
        measures = values.pop("measures")
        return {name: value for name, value in values.items() if value != defaults[name]} | measures


def record_of_row(row: "Fields") -> Record:
    """The record from JSON data. Unknown fields become `measures`. Raises TypeError if the value of such a
    field is not a number, or if a field without a default is missing."""
    measures = dict(row)
    values = {f.name: measures.pop(f.name) for f in fields(Record) if f.name in row}
    for name, value in measures.items():
        if not isinstance(value, int | float):
            raise TypeError(f"{name} is neither a field of a record nor a number")
    for name in ("progress", "positions"):
        values[name] = tuple(map(tuple, values.get(name, ())))
    return Record(**values, measures=measures)


class RecordFile:
    """The records of one method in the order in which they were made, in a file or in memory."""

    def __init__(self, file: FilePath | None) -> None:
        """Read the file; an incomplete last line is ignored. Raises InputError with file and line for any
        other line that is not a record."""
        self._lines = JsonLines(file)
        self.records = list[Record]()
        for number, row in enumerate(self._lines.rows, start=1):
            try:
                self.records.append(record_of_row(row))
            except TypeError as error:
                raise InputError(f"{file}, line {number} is no record: {error}") from None
        self._keys = {record.key for record in self.records}

    def append(self, record: Record) -> None:
        """Append a record, unless a record with the same key exists. When the call returns, the record is on
        disk."""
        if record.key not in self._keys:
            self._lines.append(record.row())
            self.records.append(record)
            self._keys.add(record.key)


def record_path(folder: FilePath, method: str) -> FilePath:
    """The file of a method's records."""
    return folder / "records" / f"{quote(method, safe='@:=,+ ')}.jsonl"


def recorded(folder: FilePath) -> dict[str, FilePath]:
    """The record files of a folder, by method."""
    return {unquote(file.stem): file for file in sorted((folder / "records").glob("*.jsonl"))}


def read_records(folder: FilePath, methods: Sequence[str] | None = None) -> dict[str, list[Record]]:
    """Read the records of all methods, or of the given methods, by name.

    Raises InputError for a folder without records, for a method without records, and for damaged files.
    """
    files = recorded(folder)
    if not files:
        raise InputError(f"{folder} holds no records of a bench; `robotdiffuse bench run` makes them")
    for name in methods or ():
        if name not in files:
            raise InputError(f"{folder} has no records of {name}; it has {', '.join(files)}")
    return {name: RecordFile(files[name]).records for name in methods or files}


@frozen_dataclass
class Run:
    """One call that a benchmark makes: a method on a problem, with a seed and a time limit."""

    case: Case
    index: int
    """Index of the case among all cases."""
    method: str
    """Name of the planner or method in records."""
    seed: int
    limit: float = np.inf
    """Time limit [s]."""

    @property
    def problem(self) -> Problem:
        return self.case.problem

    @property
    def key(self) -> tuple[str, str, int, float]:
        """The key of the run's record."""
        return *self.case.key, self.seed, self.limit

    def rng(self) -> np.random.Generator:
        """A random number generator that gives the same numbers for all methods."""
        return np.random.default_rng([SEED, self.seed, self.index])

    def record(self, values: "Fields") -> Record:
        """The record of this run with the fields `values`, which take precedence over those of the run."""
        about = {
            "planner": self.method,
            "problem_set": self.case.problem_set,
            "name": self.case.name,
            "family": self.case.family,
            "trivial": self.case.trivial,
            "reference": self.case.reference,
            "seed": self.seed,
            "time_limit": self.limit,
            "reason": "",
        }
        return record_of_row(about | values)


Fields = dict[str, Any]
"""Fields of a record that a method computes; the run provides the other fields."""
Method = Callable[[Run], Iterable[Fields]]
"""Makes a run and yields the fields of its record, or of several records."""
Results = Generator[tuple[Run, list[Record]], None, None]
"""Runs with their records, in the order in which the runs end."""


@contextmanager
def clocked() -> Iterator[Fields]:
    """Yields fields to which the wall time and the CPU time of this process in the `with` block are added at
    its end [s]."""
    seconds = Fields()
    wall = time.perf_counter()
    cpu = time.process_time()
    yield seconds
    seconds |= {"time": round(time.perf_counter() - wall, 6), "cpu": round(time.process_time() - cpu, 6)}


def runs_of(cases: Sequence[Case], methods: Iterable[str], seeds: Iterable[int], limit: float) -> list[Run]:
    """All runs in the order in which they are made: methods take turns on each case, so that other work on
    the machine affects all methods alike."""
    names = list(methods)
    return [
        Run(case, i, name, seed, limit) for seed in seeds for i, case in enumerate(cases) for name in names
    ]


def load_average() -> float:
    """Load average of the machine over the last minute."""
    return round(os.getloadavg()[0], 2)


def keep_records(
    runs: Sequence[Run],
    results: Results,
    files: Mapping[str, RecordFile],
    on_progress: Callable[[int], None],
) -> int:
    """Store the records of runs as the runs end; returns the number of runs that were made.

    `on_progress` is called with the number of remaining runs.
    """
    remaining = len(runs)
    with closing(results):  # Ctrl-C ends the processes of runs too
        for _, records in results:
            for record in records:
                files[record.planner].append(record)
            remaining -= 1
            on_progress(remaining)
    return len(runs) - remaining


def in_this_process(methods: Mapping[str, Method], runs: Sequence[Run]) -> Results:
    """Make runs in this process, one after the other."""
    for run in runs:
        results = list(methods[run.method](run))
        load = {"workers": 1, "load": load_average()}
        yield run, [run.record(load | fields) for fields in results]


def run_all(
    cases: Sequence[Case],
    methods: Mapping[str, Method],
    seeds: Iterable[int] = (0,),
    limit: float = np.inf,
    folder: FilePath | None = None,
    title: str = "runs",
    bar: bool = True,
) -> dict[str, list[Record]]:
    """Make all runs in this process.

    Args:
        cases: The cases.
        methods: Methods by name.
        seeds: Seeds of the runs.
        limit: Time limit of a run [s].
        folder: Folder that stores the records. The name of a method must then identify everything that its
            records depend on, since existing records are used again.
        title: Title of the progress bar.
        bar: Whether a progress bar is shown.

    Returns:
        The records of each method, in the order of the seeds; for each seed, in the order of the cases.
    """
    files = {name: RecordFile(None if folder is None else record_path(folder, name)) for name in methods}
    existing = {(name, record.key) for name, file in files.items() for record in file.records}
    runs = runs_of(cases, methods, seeds, limit)
    todo = [run for run in runs if (run.method, run.key) not in existing]
    with ProgressBar(transient=True, console=Console(stderr=True), disable=not bar) as progress:
        task = progress.add_task(title, total=len(runs), completed=len(runs) - len(todo))
        keep_records(todo, in_this_process(methods, todo), files, lambda _: progress.advance(task))
    order = {run.key: i for i, run in enumerate(runs)}
    return {
        name: sorted((r for r in file.records if r.key in order), key=lambda record: order[record.key])
        for name, file in files.items()
    }


NETWORK_ALONE = DiffusionSettings(sampling_steps=6, guidance_steps=4)
"""Planner settings for measuring single samples of networks, without search."""
UNSOLVED = Status.NO_PATH.value


# Planners


def planned(planner: Planner, **request: Any) -> Method:
    """A method that calls a planner in this process; `request` are further arguments of `Planner.plan`."""
    return lambda run: planner_calls(planner, run.problem, run.seed, run.limit, False, request)


def planner_calls(
    planner: Planner,
    problem: Problem,
    seed: int,
    limit: float,
    restarts: bool,
    request: Mapping[str, Any],
) -> Iterator[Fields]:
    """Yields the fields of a call's record. With `restarts`, if the call ended early, it also yields the
    fields of the record of all calls together (`restarted`). An exception gives a record too."""
    began = time.perf_counter()
    try:
        with clocked() as seconds:
            result = planner.plan(problem, time_limit=limit, seed=seed, **request)
        yield {"cpu": seconds["cpu"], **fields_of(result, problem.robot)}
        if restarts and result.status.value in RESTARTABLE and result.planning_time < ENDED_EARLY * limit:
            count, result = restarted(planner, problem, seed, limit, result, request)
            yield {"restarts": count, **fields_of(result, problem.robot)}
    except (Exception, SystemExit) as error:
        traceback.print_exc()
        reason = f"{type(error).__name__}: {' '.join(str(error).split())[:300]}"
        yield {"status": RAISED, "reason": reason, "time": time.perf_counter() - began}


def restarted(
    planner: Planner,
    problem: Problem,
    seed: int,
    limit: float,
    first: PlanResult,
    request: Mapping[str, Any],
) -> tuple[int, PlanResult]:
    """Call a planner again with new seeds until less time is left than its shortest call took.

    Returns the number of further calls and the result with the shortest path. Its `progress` has the times at
    which shorter paths were found, over all calls. Stops early if no shorter path can exist.
    Time-parametrizing each call's path is not counted.
    """
    straight = 0.0
    if isinstance(problem.goal, JointGoal):
        differences = problem.goal.positions - problem.start
        differences -= problem.robot.whole_turns(differences)
        straight = float(np.linalg.norm(differences, axis=1).min())
    best = first
    spent = first.planning_time
    shortest_call = spent
    count = 0
    progress = list(first.progress)
    while limit - spent > shortest_call and _length(best) > SHORTEST_FACTOR * straight:
        count += 1
        call_seed = int(np.random.SeedSequence([seed, count]).generate_state(1)[0])
        result = planner.plan(problem, time_limit=limit - spent, seed=call_seed, **request)
        for at, length in result.progress:
            if not progress or length < progress[-1][1]:
                progress.append((spent + at, length))
        spent += result.planning_time
        shortest_call = min(shortest_call, result.planning_time)
        best = min(best, result, key=_length)
    return count, replace(best, planning_time=spent, progress=tuple(progress))


def _length(result: PlanResult) -> float:
    """Length of the path [rad]; infinite if there is no path."""
    return np.inf if result.path_length is None else result.path_length


def fields_of(result: PlanResult, robot: Robot) -> Fields:
    """The fields of the record of a planner's result."""
    record: Fields = {
        "status": result.status.value,
        "reason": result.reason,
        "time": round(result.planning_time, 6),
        "refused": result.refused,
        "stage": result.stage,
        "progress": [[round(at, 6), round(length, 6)] for at, length in result.progress],
    }
    if result.trajectory is not None:
        record |= measured(robot, result.path, result.trajectory, result)
        record["positions"] = np.round(result.path.positions, 9).tolist()
    return record


# Sampled trajectories


Draw = Callable[[Run, CollisionChecker], ndarray]
"""A function that returns a batch of trajectories [count, waypoints, dof] for a run."""


class Validated(NamedTuple):
    """The validator's verdict on a batch."""

    passed: Mask
    hit: Mask
    """Which trajectories are in collision."""
    reports: list[Report]
    waypoints: Trajectories
    """The trajectories, with exact start and goal as first and last waypoint."""


def validated(problem: Problem, q: Trajectories) -> Validated:
    """Validate trajectories without repairing them; only first and last waypoint are set to the exact start
    and goal."""
    validator = verifier(problem, VerifySettings())
    exact = q.astype(np.float64)
    exact[:, 0], exact[:, -1] = problem.start, goal_of(problem)
    reports = [validator.path(Path(problem.robot.joint_names, waypoints)) for waypoints in exact]
    kinds = ["" if report.violation is None else report.violation.kind for report in reports]
    passed = [not kind for kind in kinds]
    hit = [kind.endswith("collision") for kind in kinds]
    return Validated(np.array(passed), np.array(hit), reports, exact)


def path_lengths(q: Trajectories) -> Values:
    """Joint-space length of each trajectory [rad]."""
    return np.linalg.norm(np.diff(q, axis=1), axis=2).sum(axis=1)


def sampled(draw: Draw, lengths: Callable[[ndarray], ndarray] = path_lengths) -> Method:
    """A method that validates a batch of sampled trajectories, and measures the valid one for which `lengths`
    is smallest."""

    def call(run: Run) -> Iterator[Fields]:
        problem = run.problem
        checker = CollisionChecker(problem.robot, problem.scene)
        with clocked() as seconds:
            q = draw(run, checker)
        verdict = validated(problem, q)
        measures = {}
        if verdict.passed.any():
            best = int(np.where(verdict.passed, lengths(verdict.waypoints), np.inf).argmin())
            path = Path(problem.robot.joint_names, verdict.waypoints[best])
            measures = measured(problem.robot, path, None, verdict.reports[best])
        yield {
            "status": SOLVED if measures else UNSOLVED,
            "passed": float(verdict.passed.mean()),
            "collided": float(verdict.hit.mean()),
            **seconds,
            **measures,
        }

    return call


def sampling_digest(settings: DiffusionSettings | ControlSettings, folder: FilePath | None) -> str:
    """A hash of everything that samples depend on: the settings, and the weights in the folder of a network,
    if there is a network. It is part of the names of methods."""
    weights = None if folder is None else json.loads((folder / "model.json").read_text())["weights_sha256"]
    about = json.dumps(asdict(settings) | {"weights": weights}, sort_keys=True)
    return hashlib.sha256(about.encode()).hexdigest()[:12]


def from_network(
    sampler: Diffusion,
    encoded: Callable[[Run], Problem] | None = None,
    clearances: "ClearanceFn | None" = None,
) -> Draw:
    """Draws samples of the network, without refinement, search or shortcuts.

    Args:
        sampler: The planner with the network.
        encoded: Returns a problem for a run; the scene of this problem is encoded in place of the scene of
            the run.
        clearances: Computes the clearances that are inputs of the denoiser, in place of the usual function.
    """

    def draw(run: Run, checker: CollisionChecker) -> ndarray:
        problem = run.problem
        rng = run.rng()
        model = sampler.network(problem.robot)
        scene_checker = checker if encoded is None else CollisionChecker(problem.robot, encoded(run).scene)
        embedding = encode(model, scene_checker, sampler.settings.points, rng)
        return sampler.draw(model, checker, embedding, problem.start, goal_of(problem)[None], rng, clearances)

    return draw


def from_control(settings: ControlSettings) -> Draw:
    """Draws the candidates of a control."""
    control = Control(settings)
    return lambda run, checker: control.candidates(
        run.problem.start, goal_of(run.problem)[None], checker, run.rng()
    )
