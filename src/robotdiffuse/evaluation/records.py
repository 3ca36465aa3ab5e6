"""What is kept of each call of a planner, or of another method that is measured: a line of JSON."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path as FilePath
from typing import Any
from urllib.parse import quote, unquote

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.core.errors import InputError
from robotdiffuse.core.output_files import JsonLines
from robotdiffuse.core.types import Status

SOLVED, CRASHED, OVERRAN, RAISED = "solved", "crashed", "overran", "exception"
"""Statuses of records beside those of `types.Status`: the process died, hung, or the planner raised."""
ENDED = 0.9
"""A call that took less than this share of its time limit ended by itself: more time changes nothing."""
RESTARTABLE = {SOLVED, Status.TIMEOUT.value, Status.NO_PATH.value}
"""Statuses that another seed may change."""
RESTARTED = "+restarts"
"""What is added to a planner's name where it was called again and again until the time limit."""


@dataclass(frozen=True)
class Record:
    """One call on one problem."""

    planner: str
    """Or another method."""
    problem_set: str
    name: str
    """Of the problem, in its set."""
    family: str
    trivial: bool
    seed: int
    time_limit: float
    """[s]"""
    status: str
    """Of `types.Status`, or crashed, overran, exception."""
    reason: str
    time: float
    """Planning time, with the validator and without timing the trajectory [s]."""
    cpu: float | None = None
    """CPU time [s], where it was measured."""
    restarts: int | None = None
    """How often the planner was called again; None: it was not to be."""
    refused: str = ""
    """What was wrong with the last path that the validator refused, see PlanResult."""
    stage: str = ""
    progress: tuple[tuple[float, float], ...] = ()
    """When each shorter path was found [s], and its joint-space length [rad]."""
    passed: float | None = None
    """Share of the samples of a batch that passed the validator."""
    collided: float | None = None
    """Share of them in collision."""
    reference: float | None = None
    """Length of the shortest path that is known [rad], see `held_out.Case`."""
    measures: dict[str, float] = field(default_factory=dict)
    """Of the returned motion, by the names of `metrics.METRICS`; in files they stand beside the fields."""
    memory: float | None = None
    """Most memory that the planner's process had so far [MB]."""
    run: str = ""
    """When the run began that the call is of; empty where it was not noted."""
    workers: int | str = ""
    """Calls that were made at once, or the cluster."""
    load: float | None = None
    """Load average of the machine at the end of the call."""
    positions: tuple[tuple[float, ...], ...] = ()
    """Waypoints of the returned path [rad]."""

    @property
    def key(self) -> tuple[str, str, int, float]:
        """What of a planner's calls this is."""
        return self.problem_set, self.name, self.seed, self.time_limit

    @property
    def case(self) -> tuple[str, str, int]:
        """Problem set, problem and seed. What stands behind a # in the name says what part of the answer it
        is."""
        return self.problem_set, self.name.partition("#")[0], self.seed

    @property
    def joint_length(self) -> float | None:
        """Of the returned path [rad]."""
        return self.measures.get("joint_length")

    @property
    def solved(self) -> bool:
        return self.status == SOLVED

    @property
    def ended_by_itself(self) -> bool:
        """Whether a longer time limit would have given the same."""
        cut_off = self.status in (CRASHED, OVERRAN) or bool(self.restarts)
        return not cut_off and self.time < ENDED * self.time_limit

    @property
    def restartable(self) -> bool:
        """Whether there was time left for a call with another seed."""
        return self.ended_by_itself and self.status in RESTARTABLE

    @property
    def in_collision(self) -> bool:
        """Whether the planner's last answer was one that collides: the validator refused it."""
        return not self.solved and self.refused.endswith("collision")

    @property
    def waypoints(self) -> Float[ndarray, "n dof"]:
        return np.array(self.positions, np.float64)

    def row(self) -> dict[str, Any]:
        """For JSON, without the fields that have their defaults, which are most of a failure's."""
        defaults = {f.name: f.default for f in fields(self)}
        values = asdict(self)
        kept = {name: x for name, x in values.items() if name != "measures" and x != defaults[name]}
        return {**kept, **values["measures"]}


def record_of_row(row: dict[str, Any]) -> Record:
    """The record of a row. Numbers that are no fields are measures. Raises TypeError for other fields."""
    of = {f.name for f in fields(Record)}
    found: dict[str, Any] = {name: value for name, value in row.items() if name in of}
    measures = {name: value for name, value in row.items() if name not in of}
    for name, value in measures.items():
        if not isinstance(value, int | float):
            raise TypeError(f"{name} is no field of a record and no number")
    for name in ("progress", "positions"):
        if name in found:
            found[name] = tuple(tuple(row) for row in found[name])
    return Record(**found, measures=measures)


class RecordFile:
    """The records of one method in the order that they were made in; without a file, in memory."""

    def __init__(self, file: FilePath | None) -> None:
        """Reads what is there; a last line that was cut off is left out. Raises InputError, naming file and
        line, for any other line that is no record."""
        self._lines = JsonLines(file)
        self.records: list[Record] = []
        for number, row in enumerate(self._lines.rows, start=1):
            try:
                self.records.append(record_of_row(row))
            except TypeError as error:
                raise InputError(f"{file}, line {number} is no record: {error}") from None
        self._keys = {record.key for record in self.records}

    def append(self, record: Record) -> None:
        """It is on the disk when this returns. One that is there already stays as it is."""
        if record.key not in self._keys:
            self._lines.append(record.row())
            self.records.append(record)
            self._keys.add(record.key)


def record_path(folder: FilePath, method: str) -> FilePath:
    """Where the records of a method are."""
    return folder / "records" / f"{quote(method, safe='@:=,+ ')}.jsonl"


def recorded(folder: FilePath) -> dict[str, FilePath]:
    """The files of all methods that a folder has records of, by their names."""
    return {unquote(file.stem): file for file in sorted((folder / "records").glob("*.jsonl"))}


def read_records(folder: FilePath, methods: Sequence[str] | None = None) -> dict[str, list[Record]]:
    """The records of all methods, or of some, by name.

    Raises InputError for a folder without records, for methods of which it has none, and for damaged files.
    """
    files = recorded(folder)
    if not files:
        raise InputError(f"{folder} holds no records of a bench; `robotdiffuse bench run` makes them")
    for name in methods or ():
        if name not in files:
            raise InputError(f"planners names {name!r}, of which {folder} has no records; {', '.join(files)}")
    return {name: RecordFile(files[name]).records for name in methods or files}
