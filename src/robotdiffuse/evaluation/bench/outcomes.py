"""What a call had found by a time limit, from the record of a call with that limit or a longer one."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from robotdiffuse.core.types import Status
from robotdiffuse.evaluation.records import CRASHED, ENDED_EARLY, OVERRAN, RAISED, SHORTEST_FACTOR, Record

LATE_SHARE, LATE_SECONDS = 0.1, 0.05
"""A returned motion counts if it is at most this share of the limit, or this time [s], late: planners stop in
time, and validation follows."""
RAN_OUT, GAVE_UP, LATER = "time ran out", "gave up before", "found one later"
FAILURES = {
    RAN_OUT: "no path by the end of the limit",
    GAVE_UP: "ended without a path, long before the limit",
    LATER: "found a path, but after the limit",
    "scene collision": "the last path hit an obstacle",
    "self-collision": "the last path hit the arm itself",
    "other refusal": "the last path broke limits, missed the goal or twitched",
    "ends refused": "start or goal were refused",
    CRASHED: "the process died",
    OVERRAN: "the process did not answer and was killed",
    RAISED: "an exception",
}
"""Reasons of failures, for tables and plots."""
REFUSED = {"scene_collision": "scene collision", "self_collision": "self-collision"}

Key = tuple[str, int]
"""A problem of a set by name, and a seed."""
Calls = dict[Key, list[Record]]
"""The records of one planner on one problem set, shorter limits first."""


@dataclass(frozen=True)
class Outcome:
    """What a call had found by a time limit."""

    record: Record
    found: float
    """Time of the first path [s]; infinite if there was none by the limit."""
    returned: float
    """Time at which the planner returns [s]; the limit for anytime planners and without a path."""
    joint_length: float
    """Of the best path by then [rad]; NaN without one."""
    link_length: float
    """The paper's path length [m], scaled by the joint lengths if the path by then is not the returned one;
    NaN without a path."""

    @property
    def solved(self) -> bool:
        return self.found < np.inf

    def full(self, limit: float, shortest: float) -> bool:
        """Whether the planner used up the limit, or no shorter path exists."""
        nothing_shorter = self.record.trivial and self.joint_length <= SHORTEST_FACTOR * shortest
        return self.record.restarts is not None or self.returned >= ENDED_EARLY * limit or nothing_shorter

    @property
    def failure(self) -> str:
        """One of FAILURES."""
        record = self.record
        if record.solved:
            return LATER
        if record.status in FAILURES:
            return record.status
        if record.status not in (Status.TIMEOUT.value, Status.NO_PATH.value):
            return "ends refused"
        if record.refused:
            return REFUSED.get(record.refused, "other refusal")
        return GAVE_UP if record.ended_by_itself and record.time < self.returned else RAN_OUT


def deciding_record(records: Sequence[Record], limit: float) -> Record | None:
    """The record that says what a planner finds within a limit [s]: that of the shortest limit as long, else
    the last that ended by itself. `records` are those of one problem and seed, shorter limits first."""
    for record in records:
        if record.time_limit >= limit:
            return record
    return next((record for record in reversed(records) if record.ended_by_itself), None)


def outcome(record: Record, limit: float) -> Outcome:
    """Returns what a recorded call had found by a time limit [s]."""
    late = max(LATE_SHARE * limit, LATE_SECONDS) if record.time_limit == limit else 0.0
    by_then = [(at, length) for at, length in record.progress if record.solved and at <= limit + late]
    if not by_then:
        return Outcome(record, np.inf, limit, np.nan, np.nan)
    length, final = by_then[-1][1], record.joint_length
    link = record.measures.get("link_length", np.nan)
    factor = length / final if final else 1.0
    return Outcome(record, min(by_then[0][0], limit), min(record.time, limit), length, link * factor)


def calls_on(records: Iterable[Record], problem_set: str) -> Calls:
    """Those of a planner's records that are on a problem set, by problem and seed."""
    calls: Calls = {}
    for record in records:
        if record.problem_set == problem_set:
            calls.setdefault((record.name, record.seed), []).append(record)
    for of in calls.values():
        of.sort(key=lambda record: record.time_limit)
    return calls
