"""Runs: every case (a problem of a problem set) with every method and seed. The result of each run is
validated and stored as a record, a line of JSON.

A method takes a run and yields the fields of its records, including the validator's verdict.
`evaluation.methods` has methods for planners and networks. Methods are called one after the other in this
process (`in_this_process`), or in the processes of a bench. Runs that already have a record are not made
again.
"""

import os
import time
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path as FilePath
from typing import Any
from urllib.parse import quote, unquote

import numpy as np
from rich.console import Console
from rich.progress import Progress

from robotdiffuse.core.errors import InputError
from robotdiffuse.core.output_files import JsonLines
from robotdiffuse.core.types import Configurations, Status
from robotdiffuse.problems.held_out import SEED, Case
from robotdiffuse.problems.problem import Problem

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
    """Planning time [s], including validation, but not computing the trajectory."""
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
    """Length of the shortest known path [rad], see `held_out.Case`."""
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

    def row(self) -> dict[str, Any]:
        """The record as JSON data, without fields that have their default values."""
        defaults = {f.name: f.default for f in fields(self)}
        values = asdict(self)
        measures = values.pop("measures")
        return {name: value for name, value in values.items() if value != defaults[name]} | measures


def record_of_row(row: dict[str, Any]) -> Record:
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
        self.records: list[Record] = []
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


@dataclass(frozen=True, eq=False)
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
        return self.case.problem_set, self.case.name, self.seed, self.limit

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


class Clock:
    """Measures wall time and CPU time of this process in a `with` block [s]."""

    wall = cpu = 0.0

    def __enter__(self) -> "Clock":
        self._wall = time.perf_counter()
        self._cpu = time.process_time()
        return self

    def __exit__(self, *_: object) -> None:
        self.wall = time.perf_counter() - self._wall
        self.cpu = time.process_time() - self._cpu

    @property
    def fields(self) -> Fields:
        return {"time": round(self.wall, 6), "cpu": round(self.cpu, 6)}


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
    with Progress(transient=True, console=Console(stderr=True), disable=not bar) as progress:
        task = progress.add_task(title, total=len(runs), completed=len(runs) - len(todo))
        keep_records(todo, in_this_process(methods, todo), files, lambda _: progress.advance(task))
    order = {run.key: i for i, run in enumerate(runs)}
    return {
        name: sorted((r for r in file.records if r.key in order), key=lambda record: order[record.key])
        for name, file in files.items()
    }
