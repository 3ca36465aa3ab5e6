"""Records: one line of JSON for each call of a planner, or of another method that is measured."""

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
"""Statuses of records. Beside those of `types.Status`: the process died, did not answer, or the planner
raised."""
ENDED_EARLY = 0.9
"""A call that took less than this share of its time limit ended by itself: a longer limit changes nothing."""
SHORTEST_FACTOR = 1 + 1e-6
"""A path counts as the shortest if it is at most so many times as long as the shortest known or possible
one."""
RESTARTABLE = {SOLVED, Status.TIMEOUT.value, Status.NO_PATH.value}
"""Statuses that another seed can change."""
RESTARTED = "+restarts"
"""Suffix of a planner's name whose calls were repeated until the time limit."""


@dataclass(frozen=True)
class Record:
    """One call on one problem."""

    planner: str
    """Name of the planner or other method."""
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
    """Planning time, with validation and without timing the trajectory [s]."""
    cpu: float | None = None
    """CPU time [s], where it was measured."""
    restarts: int | None = None
    """How often the planner was called again; None if it was not to be."""
    refused: str = ""
    """Why the validator refused the last path, see PlanResult."""
    stage: str = ""
    progress: tuple[tuple[float, float], ...] = ()
    """Time of each shorter path [s] and its joint-space length [rad]."""
    passed: float | None = None
    """Share of the samples of a batch that passed the validator."""
    collided: float | None = None
    """Share of the samples in collision."""
    reference: float | None = None
    """Length of the shortest known path [rad], see `held_out.Case`."""
    measures: dict[str, float] = field(default_factory=dict)
    """Of the returned motion, by the names of `metrics.METRICS`; in files they are fields of the line."""
    memory: float | None = None
    """Peak memory of the planner's process so far [MB]."""
    run: str = ""
    """Start of the session that made the call; empty if it was not noted."""
    workers: int | str = ""
    """Number of calls at a time, or the cluster."""
    load: float | None = None
    """Load average of the machine after the call."""
    positions: tuple[tuple[float, ...], ...] = ()
    """Waypoints of the returned path [rad]."""

    @property
    def key(self) -> tuple[str, str, int, float]:
        """Identifies the record among those of its planner."""
        return self.problem_set, self.name, self.seed, self.time_limit

    @property
    def case(self) -> tuple[str, str, int]:
        """Problem set, problem and seed."""
        return self.problem_set, self.name, self.seed

    @property
    def joint_length(self) -> float | None:
        """Of the returned path [rad]."""
        return self.measures.get("joint_length")

    @property
    def solved(self) -> bool:
        return self.status == SOLVED

    @property
    def ended_by_itself(self) -> bool:
        """Whether a longer time limit would give the same."""
        cut_off = self.status in (CRASHED, OVERRAN) or bool(self.restarts)
        return not cut_off and self.time < ENDED_EARLY * self.time_limit

    @property
    def restartable(self) -> bool:
        """Whether time was left for a call with another seed."""
        return self.ended_by_itself and self.status in RESTARTABLE

    @property
    def in_collision(self) -> bool:
        """Whether the validator refused the planner's last path because it collides."""
        return not self.solved and self.refused.endswith("collision")

    @property
    def waypoints(self) -> Float[ndarray, "n dof"]:
        return np.array(self.positions, np.float64)

    def row(self) -> dict[str, Any]:
        """The record as JSON data, without fields that have their defaults."""
        defaults = {f.name: f.default for f in fields(self)}
        values = asdict(self)
        kept = {name: x for name, x in values.items() if name != "measures" and x != defaults[name]}
        return {**kept, **values["measures"]}


def record_of_row(row: dict[str, Any]) -> Record:
    """The record of JSON data. Unknown numbers are measures; raises TypeError for other unknown fields."""
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
    """The records of one method in the order of their making, in a file or in memory."""

    def __init__(self, file: FilePath | None) -> None:
        """Read the file without a last line that was cut off. Raises InputError, naming file and line, for
        any other line that is no record."""
        self._lines = JsonLines(file)
        self.records: list[Record] = []
        for number, row in enumerate(self._lines.rows, start=1):
            try:
                self.records.append(record_of_row(row))
            except TypeError as error:
                raise InputError(f"{file}, line {number} is no record: {error}") from None
        self._keys = {record.key for record in self.records}

    def append(self, record: Record) -> None:
        """Write a record, which is on the disk when this returns, unless one with its key exists."""
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
    """Read the records of all methods, or of some, by name.

    Raises InputError for a folder without records, for methods without any, and for damaged files.
    """
    files = recorded(folder)
    if not files:
        raise InputError(f"{folder} holds no records of a bench; `robotdiffuse bench run` makes them")
    for name in methods or ():
        if name not in files:
            raise InputError(f"{folder} has no records of {name}; it has {', '.join(files)}")
    return {name: RecordFile(files[name]).records for name in methods or files}
