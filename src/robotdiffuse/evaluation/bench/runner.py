"""The bench: planners on problems, each call a record that is kept; what is done is not done again."""

import json
import os
import platform
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path as FilePath

from robotdiffuse import __version__
from robotdiffuse.errors import InputError
from robotdiffuse.evaluation.bench.planner_process import Contestant
from robotdiffuse.evaluation.bench.records import Record, RecordFile
from robotdiffuse.evaluation.bench.workers import Task, on_ray, on_this_machine
from robotdiffuse.evaluation.problem_sets import gather_cases, problem_set_name
from robotdiffuse.files import alone_in
from robotdiffuse.planners import PLANNERS
from robotdiffuse.problems.held_out import Case

PACKAGES = ("numpy", "numba", "torch", "ompl")
"""Whose versions are kept with the results, beside our own."""


@dataclass(frozen=True)
class BenchSettings:
    planners: tuple[str, ...]
    """Names, each maybe with weights of its own as NAME@FOLDER; or `all` alone."""
    problems: tuple[str, ...]
    """Families (rop, rop_dense, ..., each also with _nontrivial), files or folders."""
    out: FilePath
    """Folder for problems and results."""
    time_limit: float = 1.0
    """Of a call [s]."""
    seeds: int = 1
    """Calls on each problem, with seeds 0, 1, ..."""
    count: int | None = None
    """Problems of each set; None: 100 of a family, all of a file or folder."""
    workers: int = 1
    """Planners that run at once, each in a process of its own."""
    cluster: str | None = None
    """ray: on the cluster that RAY_ADDRESS names; None: this machine."""

    def __post_init__(self) -> None:
        if self.planners == ("all",):
            object.__setattr__(self, "planners", tuple(PLANNERS))
        _ = self.contestants
        for field in ("planners", "problems"):
            names = getattr(self, field)
            if not names or len(set(names)) < len(names):
                raise InputError(
                    f"{field} is {', '.join(names)!r}; it must name at least one, and none twice"
                )
        if not 0 < self.time_limit < float("inf"):
            raise InputError(f"time_limit is {self.time_limit}; it must be a positive number of seconds")
        for field in ("seeds", "count", "workers"):
            if getattr(self, field) is not None and getattr(self, field) < 1:
                raise InputError(f"{field} is {getattr(self, field)}; it must be at least 1")
        if self.cluster not in (None, "ray"):
            raise InputError(f"cluster is {self.cluster!r}; known: ray")

    @property
    def contestants(self) -> dict[str, Contestant]:
        """By their names in results. Raises InputError for an unknown planner, or two of one name."""
        found = [Contestant.of(text) for text in self.planners]
        labels = [contestant.label for contestant in found]
        if len(set(labels)) < len(labels):
            raise InputError(f"planners is {', '.join(self.planners)!r}; two are called the same")
        return dict(zip(labels, found, strict=True))


Report = Callable[[str], None]
Done = Callable[[str, int, int], None]
"""Told a planner, its calls that are done and all its calls."""


def run_bench(settings: BenchSettings, report: Report, done: Done) -> int:
    """Make the calls that are not in the folder yet; returns how many were made.

    A call need not be made if a shorter time limit did: where the planner ended by itself then, more time
    gives the same. Raises InputError for bad settings or a planner that cannot be loaded, before any call,
    and KeyboardInterrupt on Ctrl-C; the same settings go on.
    """
    with alone_in(settings.out):
        contestants = settings.contestants
        for contestant in contestants.values():
            contestant.load()
        cases = gather_cases(list(settings.problems), settings.count, settings.out, report)
        _note_run(settings)
        local, logs = settings.cluster is None, settings.out / "logs"
        files = {name: RecordFile(settings.out / "records" / f"{name}.jsonl") for name in contestants}
        try:
            tasks = {name: open_tasks(file.records, cases, settings) for name, file in files.items()}
            wanted = len(cases) * settings.seeds
            left = {name: len(found) for name, found in tasks.items()}
            for name in tasks:
                done(name, wanted - left[name], wanted)
            calls = 0
            wanting = {contestants[name]: found for name, found in tasks.items() if found}
            made = on_this_machine(wanting, settings.workers, logs) if local else on_ray(wanting, logs)
            with closing(made):  # a Ctrl-C here ends the planners too
                for record in made:
                    files[record.planner].append(record)
                    calls += 1
                    left[record.planner] -= 1
                    done(record.planner, wanted - left[record.planner], wanted)
            return calls
        finally:
            for file in files.values():
                file.close()


def open_tasks(records: Sequence[Record], cases: Sequence[Case], settings: BenchSettings) -> list[Task]:
    """The calls that the records do not answer."""
    answered: set[tuple[str, str, int]] = set()
    for record in records:
        enough = record.time_limit <= settings.time_limit and record.ended_by_itself
        if record.time_limit == settings.time_limit or enough:
            answered.add((record.problem_set, record.name, record.seed))
    return [
        Task(case, seed, settings.time_limit)
        for seed in range(settings.seeds)
        for case in cases
        if (*case.key, seed) not in answered
    ]


def _note_run(settings: BenchSettings) -> None:
    """Append where and with what this run is made, for the report."""
    note = {
        "date": datetime.now(UTC).strftime("%Y-%m-%d %H:%M"),
        "processor": _processor(),
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        "versions": _versions(),
        "planners": list(settings.contestants),
        "problems": [problem_set_name(text) for text in settings.problems],
        "time_limit": settings.time_limit,
        "seeds": settings.seeds,
        "count": settings.count,
        "workers": settings.cluster or settings.workers,
    }
    with (settings.out / "runs.jsonl").open("a") as stream:
        stream.write(json.dumps(note) + "\n")


def _processor() -> str:
    info = FilePath("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    names = (line.split(": ")[1] for line in lines if line.startswith("model name"))
    return next(names, platform.processor())


def _versions() -> dict[str, str]:
    found = {"robotdiffuse": __version__}
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "none"
    return found
