"""The bench: planners on problems, each call a record that is kept; what is done is not done again."""

import json
import os
import platform
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path as FilePath

from robotdiffuse import __version__
from robotdiffuse.core.errors import InputError
from robotdiffuse.core.output_files import lock_folder
from robotdiffuse.evaluation.bench.entries import Contestant
from robotdiffuse.evaluation.bench.workers import on_ray, on_this_machine
from robotdiffuse.evaluation.machine import processor, versions
from robotdiffuse.evaluation.problem_sets import gather_cases, problem_set_name
from robotdiffuse.evaluation.records import RESTARTED, Record, RecordFile, record_path
from robotdiffuse.evaluation.runs import Trial, run_trials, trials_of
from robotdiffuse.planning import PLANNERS
from robotdiffuse.problems.held_out import Case

PACKAGES = ("numpy", "numba", "torch", "ompl")
"""Whose versions are kept with the results, beside our own."""


@dataclass(frozen=True)
class BenchSettings:
    planners: tuple[str, ...]
    """Names, each maybe with weights and settings of its own, see `Contestant.of`; or `all` alone."""
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
    equal_time: bool = False
    """Whether a planner that ends early is called again with other seeds until the limit, in rows of its own,
    so that lengths can be compared at equal time."""

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
    with lock_folder(settings.out):
        contestants = settings.contestants
        for contestant in contestants.values():
            contestant.load()
        cases = gather_cases(list(settings.problems), settings.count, settings.out, report)
        run = _note_run(settings)
        labels = [label + of for label in contestants for of in ("", RESTARTED)[: 1 + settings.equal_time]]
        files = {label: RecordFile(record_path(settings.out, label)) for label in labels}
        todo = open_trials({label: file.records for label, file in files.items()}, cases, settings)
        wanted = len(cases) * settings.seeds
        for label in contestants:
            done(label, wanted - sum(trial.method == label for trial in todo), wanted)
        about = {"restarts": settings.equal_time, "run": run, "logs": settings.out / "logs"}
        if settings.cluster is None:
            execute = on_this_machine(contestants, workers=settings.workers, **about)
        else:
            execute = on_ray(contestants, **about)
        return run_trials(todo, execute, files, lambda label, left: done(label, wanted - left, wanted))


def open_trials(
    records: Mapping[str, Sequence[Record]], cases: Sequence[Case], settings: BenchSettings
) -> list[Trial]:
    """The calls that the records, by planner, do not answer."""
    answered: set[tuple[str, str, str, int]] = set()
    for label in settings.contestants:
        again = {record.key for record in records.get(label + RESTARTED, ())}
        for record in records.get(label, ()):
            same = record.time_limit == settings.time_limit
            enough = same or (record.time_limit < settings.time_limit and record.ended_by_itself)
            if settings.equal_time and record.restartable:
                enough = same and record.key in again
            if enough:
                answered.add((label, *record.case))
    trials = trials_of(cases, settings.contestants, range(settings.seeds), settings.time_limit)
    return [t for t in trials if (t.method, t.case.problem_set, t.case.name, t.seed) not in answered]


def _note_run(settings: BenchSettings) -> str:
    """Append where and with what this run is made, for the report; returns what records call it."""
    now = datetime.now(UTC)
    run = now.strftime("%Y-%m-%d %H:%M:%S")
    note = {
        "run": run,
        "date": now.strftime("%Y-%m-%d %H:%M"),
        "processor": processor(),
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        "versions": {"robotdiffuse": __version__, **versions(PACKAGES)},
        "planners": list(settings.contestants),
        "problems": [problem_set_name(text) for text in settings.problems],
        "time_limit": settings.time_limit,
        "seeds": settings.seeds,
        "count": settings.count,
        "workers": settings.cluster or settings.workers,
        "load": round(os.getloadavg()[0], 2),
        "equal_time": settings.equal_time,
    }
    with (settings.out / "runs.jsonl").open("a") as stream:
        stream.write(json.dumps(note) + "\n")
    return run
