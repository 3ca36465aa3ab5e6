"""Runs: every case by every method with every seed, each validated and kept as a record.

A method takes a run and yields the fields of its records, with the validator's verdict; `methods` has those
of planners and networks. An executor calls methods: in this process, one after the other (`in_this_process`),
or in the processes of a bench. Runs whose records are kept are not made again.
"""

import os
import time
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path as FilePath
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import Progress

from robotdiffuse.evaluation.records import Record, RecordFile, record_of_row, record_path
from robotdiffuse.problems.held_out import SEED, Case
from robotdiffuse.problems.problem import Problem


@dataclass(frozen=True, eq=False)
class Run:
    """One call that a benchmark makes: a method on a problem, with a seed and a time limit."""

    case: Case
    index: int
    """Place of the case among all cases."""
    method: str
    """Its name in records."""
    seed: int
    limit: float = np.inf
    """Time limit [s]."""

    @property
    def problem(self) -> Problem:
        return self.case.problem

    @property
    def key(self) -> tuple[str, str, int, float]:
        """That of its record."""
        return self.case.problem_set, self.case.name, self.seed, self.limit

    def rng(self) -> np.random.Generator:
        """Random numbers, the same ones for all methods."""
        return np.random.default_rng([SEED, self.seed, self.index])

    def record(self, found: "Fields") -> Record:
        """The record of this run with these fields."""
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
        return record_of_row(about | found)


Fields = dict[str, Any]
"""Fields of a record; the run provides the others."""
Method = Callable[[Run], Iterable[Fields]]
"""Yields the fields of one record, or of several if one call answers for several time limits."""
Results = Generator[tuple[Run, list[Record]], None, None]
Executor = Callable[[Sequence[Run]], Results]
OnProgress = Callable[[str, int], None]
"""Called with a method and the number of its runs that are left."""


class Clock:
    """Measures wall time and CPU time of this process in a `with` block [s]."""

    wall = cpu = 0.0

    def __enter__(self) -> "Clock":
        self._began = time.perf_counter(), time.process_time()
        return self

    def __exit__(self, *_: object) -> None:
        self.wall, self.cpu = time.perf_counter() - self._began[0], time.process_time() - self._began[1]

    @property
    def fields(self) -> Fields:
        return {"time": round(self.wall, 6), "cpu": round(self.cpu, 6)}


def runs_of(
    cases: Sequence[Case], methods: Iterable[str], seeds: Iterable[int] = (0,), limit: float = np.inf
) -> list[Run]:
    """All runs in their order: methods take turns on each case, so that other work on the machine affects
    them alike."""
    names, numbered = list(methods), list(enumerate(cases))
    return [Run(case, i, name, seed, limit) for seed in seeds for i, case in numbered for name in names]


def execute_runs(
    runs: Sequence[Run],
    execute: Executor,
    files: Mapping[str, RecordFile],
    on_progress: OnProgress = lambda method, left: None,
) -> int:
    """Make the runs, keeping each record at once; returns how many were made."""
    left = {run.method: 0 for run in runs}
    for run in runs:
        left[run.method] += 1
    made = 0
    with closing(execute(runs)) as found:  # Ctrl-C ends the executor's processes too
        for run, records in found:
            for record in records:
                files[record.planner].append(record)
            made += 1
            left[run.method] -= 1
            on_progress(run.method, left[run.method])
    return made


def in_this_process(methods: Mapping[str, Method]) -> Executor:
    """An executor that calls methods in this process, one after the other."""

    def execute(runs: Sequence[Run]) -> Results:
        for run in runs:
            found = list(methods[run.method](run))
            load = {"workers": 1, "load": round(os.getloadavg()[0], 2)}
            yield run, [run.record(load | fields) for fields in found]

    return execute


def run_all(
    cases: Sequence[Case],
    methods: Mapping[str, Method],
    seeds: Iterable[int] = (0,),
    limit: float = np.inf,
    folder: FilePath | None = None,
    title: str = "runs",
    bar: bool = True,
) -> dict[str, list[Record]]:
    """Make all runs in this process; the records of each method in the order of the cases.

    folder: keeps the records; the names of methods must then say all that these depend on.
    title: of the progress bar, which `bar` switches off.
    """
    files = {name: RecordFile(None if folder is None else record_path(folder, name)) for name in methods}
    there = {(name, record.key) for name, file in files.items() for record in file.records}
    runs = runs_of(cases, methods, seeds, limit)
    todo = [t for t in runs if (t.method, t.key) not in there]
    with Progress(transient=True, console=Console(stderr=True), disable=not bar) as shown:
        task = shown.add_task(title, total=len(runs), completed=len(runs) - len(todo))
        execute_runs(todo, in_this_process(methods), files, lambda *_: shown.advance(task))
    order = {t.key: i for i, t in enumerate(runs)}
    return {
        name: sorted((r for r in file.records if r.key in order), key=lambda record: order[record.key])
        for name, file in files.items()
    }
