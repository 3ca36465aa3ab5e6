"""The motions of a bench before a second validator: PyBullet, on the meshes, with its own kinematics."""

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
"""Between the configurations that are looked at [rad, joint-space L2]."""


class Refuted(NamedTuple):
    """A motion that was returned as solved and that PyBullet finds in collision."""

    record: Record
    contact: OracleContact


@dataclass(frozen=True)
class Confirmation:
    checked: int
    """Motions that were looked at."""
    refuted: tuple[Refuted, ...]


def confirm(
    out: FilePath, count: int | None, progress: Callable[[int, int], None]
) -> dict[str, Confirmation]:
    """Look at the returned motions in a folder of `bench run`, by planner.

    Those of the first `count` problems of each set; None: of all. `progress` is told how many problems are
    done, of how many. Raises InputError if the folder holds no records, or is damaged.
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
        for record, contact in _looked_at(cases[key], found):
            checked[record.planner] += 1
            if contact is not None:
                refuted[record.planner].append(Refuted(record, contact))
        progress(done, len(by_case))
    return {planner: Confirmation(count, tuple(refuted[planner])) for planner, count in checked.items()}


def _looked_at(case: Case, records: list[Record]) -> list[tuple[Record, OracleContact | None]]:
    """Each motion of a problem, and what PyBullet finds wrong with it."""
    problem = case.problem
    with PyBulletOracle(problem.robot, problem.scene) as oracle:
        names = problem.robot.joint_names
        return [(record, oracle.check_path(Path(names, record.waypoints), STEP)) for record in records]
