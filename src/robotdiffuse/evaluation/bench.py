"""The bench: calls planners on problems and keeps a record of each call; kept calls are not repeated.

Presets are comparisons of planners by name, the tables of docs/results.md.
"""

import os
import platform
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path as FilePath
from typing import Annotated, Any

from robotdiffuse import __version__
from robotdiffuse.core.errors import InputError, unknown_name
from robotdiffuse.core.output_files import JsonLines, lock_folder
from robotdiffuse.core.settings import Count, Filled, OneOf, Positive, Settings
from robotdiffuse.evaluation.planner_processes import PlannerSpec, on_cluster, on_this_machine
from robotdiffuse.evaluation.problem_sets import gather_cases, problem_set_name
from robotdiffuse.evaluation.report import processor, versions
from robotdiffuse.evaluation.runs import (
    RESTARTED,
    Record,
    RecordFile,
    Run,
    keep_records,
    load_average,
    record_path,
    runs_of,
)
from robotdiffuse.planning import PLANNERS
from robotdiffuse.problems.held_out import Case
from robotdiffuse.processes.ray_cluster import CLUSTERS

PACKAGES = ("numpy", "numba", "onnxruntime", "ompl")
"""Packages whose versions are kept with the results."""


@dataclass(frozen=True)
class BenchSettings(Settings):
    """What `bench run` runs."""

    planners: Annotated[tuple[str, ...], Filled()]
    """Texts of planners, see `PlannerSpec.parse`; or `all` alone."""
    problems: Annotated[tuple[str, ...], Filled()]
    """Families (rop, rop_dense, ..., each also with _nontrivial), files or folders."""
    out: FilePath
    """Folder for problems and results."""
    time_limit: Positive = 1.0
    """Time limit of a call [s]."""
    seeds: Count = 1
    """Calls on each problem, with seeds 0, 1, ..."""
    count: Count | None = None
    """Problems of each set; None: 100 of a family, all of a file or folder."""
    workers: Count = 1
    """Planners that run at once, each in a process of its own."""
    cluster: Annotated[str, OneOf(CLUSTERS)] | None = None
    """ray: on the cluster that RAY_ADDRESS names; None: this machine."""
    equal_time: bool = False
    """Whether planners that end early are called again with other seeds until the limit, in rows of their
    own, so that lengths can be compared at equal time."""

    def __post_init__(self) -> None:
        if self.planners == ("all",):
            object.__setattr__(self, "planners", tuple(PLANNERS))
        super().__post_init__()
        _ = self.specs
        if len(set(self.problems)) < len(self.problems):
            raise InputError(f"problems are {', '.join(self.problems)!r}; they must name none twice")

    @property
    def specs(self) -> dict[str, PlannerSpec]:
        """The planners by their names in results. Raises InputError for an unknown planner or two of one
        name."""
        specs = {spec.label: spec for spec in map(PlannerSpec.parse, self.planners)}
        if len(specs) < len(self.planners):
            raise InputError(f"planners is {', '.join(self.planners)!r}; two are called the same")
        return specs


Report = Callable[[str], None]
Done = Callable[[str, int, int], None]
"""Called with a planner, the number of its calls that are done, and that of all its calls."""


def run_bench(settings: BenchSettings, report: Report, done: Done) -> int:
    """Make the calls that are missing in the folder; returns how many were made.

    A call that ended by itself with a shorter time limit is not repeated: more time gives the same. Raises
    InputError, before any call, for bad settings or a planner that cannot be loaded, and KeyboardInterrupt on
    Ctrl-C; another call with the same settings continues.
    """
    with lock_folder(settings.out):
        specs = settings.specs
        for spec in specs.values():
            spec.load()
        sessions = JsonLines(settings.out / "runs.jsonl")
        _check_weights(settings, sessions.rows)
        cases = gather_cases(list(settings.problems), settings.count, settings.out, report)
        session = _note_session(settings, sessions)
        labels = [label + of for label in specs for of in ("", RESTARTED)[: 1 + settings.equal_time]]
        files = {label: RecordFile(record_path(settings.out, label)) for label in labels}
        todo = open_runs({label: file.records for label, file in files.items()}, cases, settings)
        total = len(cases) * settings.seeds
        for label in specs:
            done(label, total - sum(run.method == label for run in todo), total)
        about = (settings.equal_time, session, settings.out / "logs")
        if settings.cluster is None:
            results = on_this_machine(specs, todo, settings.workers, *about)
        else:
            results = on_cluster(specs, todo, settings.cluster, *about)
        return keep_records(todo, results, files, lambda label, left: done(label, total - left, total))


def open_runs(
    records: Mapping[str, Sequence[Record]], cases: Sequence[Case], settings: BenchSettings
) -> list[Run]:
    """The runs that the records, by planner, do not answer."""
    answered: set[tuple[str, str, str, int]] = set()
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
    return [t for t in runs if (t.method, t.case.problem_set, t.case.name, t.seed) not in answered]


def _check_weights(settings: BenchSettings, sessions: Sequence[Mapping[str, Any]]) -> None:
    """Raise InputError if a planner of this name was run here with other weights: its records would mix."""
    for label, spec in settings.specs.items():
        recorded_hashes = [
            session["weights"][label] for session in sessions if label in session.get("weights", {})
        ]
        if any(hashes != spec.weights_hashes for hashes in recorded_hashes):
            raise InputError(
                f"{settings.out} has records of {label} with other weights than those in {spec.weights}; "
                "rename the folder of the weights, or use another folder for the results"
            )


def _note_session(settings: BenchSettings, sessions: JsonLines) -> str:
    """Append machine, versions and settings of this session to runs.jsonl; its name in records."""
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
    }
    sessions.append(note)
    return session


# Presets

BY_LENGTH = ":objective=length"
"""Suffix of planners that compete in the length of paths."""
ROP = ("rop_nontrivial", "rop_dense_nontrivial")


@dataclass(frozen=True)
class Preset:
    """Planners on the first problems of each set, once with each time limit."""

    description: str
    planners: tuple[str, ...]
    problems: tuple[str, ...]
    limits: tuple[float, ...]
    """Time limit of a call [s]."""
    count: int
    """Problems of each set."""
    equal_time: bool = True
    """See `BenchSettings`."""


def by_length(*planners: str) -> tuple[str, ...]:
    """The planners, for the shortest paths."""
    return tuple(name + BY_LENGTH for name in planners)


PRESETS: dict[str, Preset] = {
    "equal_time": Preset(
        "path lengths at one second: search, the hybrid, diffusion, learned baselines",
        (
            *by_length("robotdiffuse", "aorrtc", "rrt_connect"),
            *("shared_tree_rrt_star", "diffusion", "mpd", "edmp", "mpnet", "mpinets"),
        ),
        (*ROP, "shelf_nontrivial"),
        (1.0,),
        30,
    ),
    "learning": Preset(
        "what the network adds: diffusion and the hybrid beside search, with 0.1 and 0.3 s",
        (*by_length("robotdiffuse"), "diffusion", *by_length("aorrtc"), "shared_tree_rrt_star"),
        (*ROP, "shelf_nontrivial"),
        (0.1, 0.3),
        150,
    ),
    "durations": Preset(
        "durations of motions with 0.1 and 1 s: by time, by length, and the timed paths of OMPL",
        (
            *("aorrtc", "robotdiffuse", "diffusion"),
            *by_length("aorrtc", "robotdiffuse"),
            *("ompl_rrt_connect", "ompl_aorrtc"),
        ),
        ("shelf_nontrivial", "crate_nontrivial", "table_nontrivial", "kitchen_nontrivial", "rop_nontrivial"),
        (0.1, 1.0),
        100,
        equal_time=False,
    ),
    "anytime": Preset(
        "anytime search beside OMPL's: Shared-Tree Informed RRT*, AORRTC, Informed RRT*",
        ("shared_tree_rrt_star", *by_length("aorrtc"), "ompl_aorrtc", "ompl_informed_rrt_star"),
        ROP,
        (1.0,),
        100,
    ),
    "restarts": Preset(
        "the hybrid beside restarts of RRT-Connect until the same limit",
        by_length("robotdiffuse", "rrt_connect"),
        (*ROP, "shelf_nontrivial"),
        (1.0,),
        100,
    ),
}


def preset_settings(
    name: str,
    out: FilePath,
    problems: Sequence[str] = (),
    count: int | None = None,
    workers: int = 1,
    cluster: str | None = None,
) -> list[BenchSettings]:
    """The settings of a preset for each of its time limits.

    problems: sets beside those of the preset.
    count: most problems of each set; None: as the preset says.

    Raises InputError for an unknown preset, listing the known.
    """
    if name not in PRESETS:
        raise unknown_name("preset", name, PRESETS)
    preset = PRESETS[name]
    return [
        BenchSettings(
            preset.planners,
            (*preset.problems, *problems),
            out,
            time_limit=limit,
            count=min(count or preset.count, preset.count),
            workers=workers,
            cluster=cluster,
            equal_time=preset.equal_time,
        )
        for limit in preset.limits
    ]
