"""What a bench keeps of each call of a planner: a line of JSON."""

import json
import os
from contextlib import suppress
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path as FilePath
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.errors import InputError
from robotdiffuse.files import write_atomically

SOLVED, CRASHED, OVERRAN, RAISED = "solved", "crashed", "overran", "exception"
"""Statuses of records beside those of `types.Status`: the process died, hung, or the planner raised."""
ENDED = 0.9
"""A call that took less than this share of its time limit ended by itself: more time changes nothing."""


@dataclass(frozen=True)
class Record:
    """One call of a planner on one problem."""

    planner: str
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
    """Planning time, with the judge and without timing the trajectory [s]."""
    refused: str = ""
    """What was wrong with the last path that the judge refused, see PlanResult."""
    stage: str = ""
    progress: tuple[tuple[float, float], ...] = ()
    """When each shorter path was found [s], and its joint-space length [rad]."""
    measures: dict[str, float] = field(default_factory=dict)
    """Of the returned motion, by the names of `metrics.METRICS`; in files they stand beside the fields."""
    memory: float | None = None
    """Most memory that the planner's process had so far [MB]."""
    positions: tuple[tuple[float, ...], ...] = ()
    """Waypoints of the returned path [rad]."""

    @property
    def key(self) -> tuple[str, str, int, float]:
        """What of a planner's calls this is."""
        return self.problem_set, self.name, self.seed, self.time_limit

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
        return self.status not in (CRASHED, OVERRAN) and self.time < ENDED * self.time_limit

    @property
    def in_collision(self) -> bool:
        """Whether the planner's last answer was one that collides: the judge refused it."""
        return not self.solved and self.refused.endswith("collision")

    @property
    def waypoints(self) -> Float[ndarray, "n dof"]:
        return np.array(self.positions, np.float64)

    def line(self) -> str:
        """As JSON without the fields that have their defaults, which are most of a failure's."""
        defaults = {f.name: f.default for f in fields(self)}
        values = asdict(self)
        kept = {name: x for name, x in values.items() if name != "measures" and x != defaults[name]}
        return json.dumps({**kept, **values["measures"]}) + "\n"


def record_from_json(values: dict[str, Any]) -> Record:
    """The record of a line. Numbers that are no fields are measures. Raises TypeError for other fields."""
    of = {f.name for f in fields(Record)}
    found: dict[str, Any] = {name: value for name, value in values.items() if name in of}
    measures = {name: value for name, value in values.items() if name not in of}
    for name, value in measures.items():
        if not isinstance(value, int | float):
            raise TypeError(f"{name} is no field of a record and no number")
    for name in ("progress", "positions"):
        if name in found:
            found[name] = tuple(tuple(row) for row in found[name])
    return Record(**found, measures=measures)


def read_records(file: FilePath) -> list[Record]:
    """The records of a file; none if there is no file. A last line that was cut off is left out.

    Raises InputError, naming file and line, for any other line that is no record.
    """
    if not file.is_file():
        return []
    *lines, rest = file.read_text().split("\n")
    records = []
    for number, line in enumerate(lines, start=1):
        try:
            records.append(record_from_json(json.loads(line)))
        except (ValueError, TypeError) as error:
            raise InputError(f"{file}, line {number} is no record of a bench: {error}") from None
    if rest:
        with suppress(ValueError, TypeError):  # killed between a line and its end
            records.append(record_from_json(json.loads(rest)))
    return records


class RecordFile:
    """Appends records; each is on the disk when `append` returns."""

    def __init__(self, file: FilePath) -> None:
        """Mends the end of a file whose last line was cut off. Raises InputError as `read_records`."""
        self.records = read_records(file)
        """All that is in the file."""
        if not file.is_file() or not file.read_bytes().endswith(b"\n"):
            whole = "".join(record.line() for record in self.records)
            write_atomically(file, whole, make_folder=True)
        self._stream = file.open("a")

    def append(self, record: Record) -> None:
        self._stream.write(record.line())
        self._stream.flush()
        os.fsync(self._stream.fileno())
        self.records.append(record)

    def close(self) -> None:
        self._stream.close()
