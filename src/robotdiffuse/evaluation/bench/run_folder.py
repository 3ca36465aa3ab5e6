"""A folder of `bench run`: its sessions, and the records of every planner."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path as FilePath
from typing import Any

from robotdiffuse.core.errors import InputError
from robotdiffuse.core.output_files import JsonLines
from robotdiffuse.evaluation.records import RESTARTED, Record, read_records, recorded
from robotdiffuse.planning import DEFAULT_PLANNER, PLANNERS


@dataclass(frozen=True, eq=False)
class Bench:
    """The content of a folder of `bench run`."""

    folder: FilePath
    sessions: tuple[dict[str, Any], ...]
    """A note on each call of `bench run`: machine, versions, settings."""
    records: dict[str, list[Record]]
    """By planner, in the order of PLANNERS; rows with restarts follow those without."""

    @property
    def reference(self) -> str:
        """The planner that the others are compared with; its restarts if it has any."""
        plain = DEFAULT_PLANNER if DEFAULT_PLANNER in self.records else next(iter(self.records))
        return plain + RESTARTED if plain + RESTARTED in self.records else plain

    def sessions_of(self, record: Record) -> frozenset[str]:
        """The numbers of the sessions, from 1, that may have made the record: one, if the record names it."""
        return frozenset(
            str(i)
            for i, run in enumerate(self.sessions, start=1)
            if (
                run.get("run") == record.run
                if record.run
                else plain_name(record.planner) in run["planners"]
                and record.problem_set in run["problems"]
                and record.time_limit == run["time_limit"]
            )
        )

    @property
    def problem_sets(self) -> list[str]:
        return list(dict.fromkeys(r.problem_set for records in self.records.values() for r in records))


def plain_name(planner: str) -> str:
    """The name without the suffix of restarts."""
    return planner.removesuffix(RESTARTED)


def base_name(planner: str) -> str:
    """The name in PLANNERS: without weights, settings and restarts."""
    return re.split("[@:+]", planner, maxsplit=1)[0]


def read_bench(folder: FilePath, planners: Sequence[str] | None = None) -> Bench:
    """Read the records of all planners, or of some, with their restarts.

    Raises InputError for a folder without a bench, damaged files and planners without records.
    """
    if planners is not None:
        again = [name + RESTARTED for name in planners]
        planners = [*planners, *(name for name in again if name in recorded(folder))]
    found = read_records(folder, planners)
    order = {name: i for i, name in enumerate(PLANNERS)}
    names = sorted(
        found, key=lambda n: (order.get(base_name(n), len(order)), plain_name(n), n.endswith(RESTARTED))
    )
    records = {name: found[name] for name in names}
    for name in names:
        if name.endswith(RESTARTED):
            # calls that used up the limit were not repeated: those of the plain planner count
            known = {record.key for record in records[name]}
            there = [record for record in records.get(plain_name(name), ()) if record.key not in known]
            records[name] = records[name] + [replace(record, planner=name) for record in there]
    if not any(records.values()):
        raise InputError(f"{folder} holds no records yet; continue with `robotdiffuse bench run`")
    return Bench(folder, _read_sessions(folder / "runs.jsonl"), records)


def _read_sessions(file: FilePath) -> tuple[dict[str, Any], ...]:
    runs = JsonLines(file).rows
    for name in ("date", "versions", "planners", "problems", "time_limit", "seeds", "count"):
        if not all(name in run for run in runs):
            raise InputError(f"{file} is damaged: a run has no {name}; results cannot be read without it")
    return tuple(runs)
