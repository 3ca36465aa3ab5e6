"""Checks the motions of a bench by a second validator: PyBullet, on meshes, with its own kinematics."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path as FilePath
from typing import NamedTuple

from robotdiffuse.core.errors import InputError
from robotdiffuse.core.types import Path
from robotdiffuse.evaluation.problem_sets import read_cases
from robotdiffuse.evaluation.records import Record, read_records
from robotdiffuse.problems.held_out import Case
from robotdiffuse.simulation.validator import OracleContact, PyBulletOracle

STEP = 0.02
"""Between checked configurations [rad, joint-space L2]."""


class Refuted(NamedTuple):
    """A motion that was returned as solved and collides by PyBullet."""

    record: Record
    contact: OracleContact


@dataclass(frozen=True)
class Confirmation:
    checked: int
    """Number of checked motions."""
    refuted: tuple[Refuted, ...]


def confirm(
    out: FilePath, count: int | None, progress: Callable[[int, int], None]
) -> dict[str, Confirmation]:
    """Check the returned motions in a folder of `bench run`; results by planner.

    count: first problems of each set; None: all. progress: called with the numbers of problems done and in
    all.

    Raises InputError if the folder holds no records or is damaged.
    """
    records = [record for of in read_records(out).values() for record in of]
    by_case: dict[tuple[str, str], list[Record]] = {}
    for record in records:
        if record.solved:
            by_case.setdefault((record.problem_set, record.name), []).append(record)
    sets = sorted({record.problem_set for record in records})
    kept = {name: read_cases(out, name) for name in sets}
    known = {case.key for of in kept.values() for case in of}
    lost = [key for key in by_case if key not in known]
    if lost:
        raise InputError(f"{out}/problems lacks {lost[0][1]} of {lost[0][0]}, which has results")
    cases = {case.key: case for of in kept.values() for case in of[:count]}
    by_case = {key: by_case[key] for key in cases if key in by_case}
    checked = {record.planner: 0 for record in records}
    refuted: dict[str, list[Refuted]] = {planner: [] for planner in checked}
    for done, (key, found) in enumerate(by_case.items(), start=1):
        for record, contact in _checked(cases[key], found):
            checked[record.planner] += 1
            if contact is not None:
                refuted[record.planner].append(Refuted(record, contact))
        progress(done, len(by_case))
    return {planner: Confirmation(count, tuple(refuted[planner])) for planner, count in checked.items()}


def _checked(case: Case, records: list[Record]) -> list[tuple[Record, OracleContact | None]]:
    """Each record of a problem with the first contact by PyBullet, None without one."""
    problem = case.problem
    with PyBulletOracle(problem.robot, problem.scene) as oracle:
        names = problem.robot.joint_names
        return [(record, oracle.check_path(Path(names, record.waypoints), STEP)) for record in records]
