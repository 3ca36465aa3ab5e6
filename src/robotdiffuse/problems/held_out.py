"""Held-out problems for evaluation: numbered random problems of each family, none of which is in a data set.

A problem is trivial if the straight line from the start to a goal configuration passes the validator. It is
hard if it is not trivial and a search solves it. JSON lines files store each problem with whether it is
trivial and the length of the shortest known path; benchmarks read these files.
"""

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path as FilePath
from typing import Any

import numpy as np

from robotdiffuse.core.errors import InputError, repeated
from robotdiffuse.core.output_files import JsonLines
from robotdiffuse.core.types import Configuration, Path
from robotdiffuse.problems.families import FAMILIES, load_family
from robotdiffuse.problems.files import problem_from_record, problem_record
from robotdiffuse.problems.problem import JointGoal, Problem
from robotdiffuse.robots import load_robot

SEED = 20261121
"""Seed of the held-out problems; data sets use other seed sequences."""

Validator = Callable[[Problem, Path], bool]
"""A function that says whether a path solves a problem."""
Search = Callable[[Problem], float | None]
"""A function that searches for paths of a problem and returns the length of the shortest path [rad], or None
if it finds no path."""
Progress = Callable[[str], None]
"""A function that receives progress messages."""
REPORT_EVERY = 20
"""Number of problems between two progress messages."""


def goal_of(problem: Problem) -> Configuration:
    """The first goal configuration of a problem whose goal is a JointGoal."""
    assert isinstance(problem.goal, JointGoal)
    return problem.goal.positions[0]


@dataclass(frozen=True, eq=False)
class Case:
    """A problem of an evaluation, with what is known about its solutions."""

    name: str
    """Unique name in the problem set; rop/17 is number 17 of the family rop."""
    family: str
    """Group in plots and tables: the random family, or the folder or file of the problem."""
    problem: Problem
    trivial: bool
    """Whether the straight line to a goal configuration passes the validator."""
    reference: float | None = None
    """Length of the shortest known path [rad]: of the straight line if trivial, else of a search's path; None
    if no search ran, or if it found no path."""
    problem_set: str = ""
    """Name of the problem set: the name of a family, or of a file or folder without its ending."""

    @property
    def key(self) -> tuple[str, str]:
        """Unique among several problem sets."""
        return self.problem_set, self.name

    @property
    def hard(self) -> bool:
        """Whether the problem is not trivial and a search solves it."""
        return not self.trivial and self.reference is not None


def held_out_problem(family: str, number: int) -> Problem:
    """Problem `number` of a family, for the Panda. Some problems are trivial, others unsolvable."""
    FAMILIES.entry(family)
    index = list(FAMILIES).index(family)
    rng = np.random.default_rng([SEED, number] if index == 0 else [SEED, 10 + index, number])
    if index > 1:
        rng.random()  # the generator of the published problems drew one number more
    robot = load_robot("panda")
    return load_family(family).draw(robot, rng).problem(robot)


def line_length(problem: Problem, validator: Validator) -> float | None:
    """Length of the shortest straight line, from the start to a goal configuration, that passes the validator
    [rad]; None if no such line does."""
    goals = problem.goal.positions if isinstance(problem.goal, JointGoal) else ()
    lines = [Path(problem.robot.joint_names, np.stack([problem.start, goal])) for goal in goals]
    return min((line.length for line in lines if validator(problem, line)), default=None)


ROW_FIELDS = {"name", "family", "trivial", "searched", "reference", "problem"}
"""Fields of a line of a file: the fields of a case, whether a search for the reference length has run, and
the record of the problem."""


class CaseFile:
    """Cases by name, in the order of their addition, stored in a file or, if no file is given, in memory."""

    def __init__(self, file: FilePath | None) -> None:
        """Reads the file. Raises InputError, which names file and line, if it is damaged."""
        self._lines = JsonLines(file)
        self._rows: dict[str, dict[str, Any]] = {}
        for number, row in enumerate(self._lines.rows, start=1):
            if row.keys() != ROW_FIELDS:
                raise InputError(
                    f"{file}, line {number} has {', '.join(row)} instead of {', '.join(sorted(ROW_FIELDS))}; "
                    "remove the file to generate its problems again"
                )
            self._rows[row["name"]] = row  # a later line on the same problem adds the search's result

    def __len__(self) -> int:
        return len(self._rows)

    def cases(self, hard: bool = False) -> list[Case]:
        """All cases, or only the cases that are known to be hard."""
        return [_case(row) for row in self._rows.values() if not hard or _is_hard(row)]

    def fill(self, cases: list[Case]) -> None:
        """Replaces all cases atomically. Raises InputError if two have the same name."""
        twice = repeated(case.name for case in cases)
        if twice:
            raise InputError(f"two problems are called {twice[0]}; rename one of their files")
        self._lines.replace([_row(case) for case in cases])
        self._rows = {row["name"]: row for row in self._lines.rows}

    def held_out(
        self,
        family: str,
        count: int,
        validator: Validator,
        search: Search | None = None,
        report: Progress = lambda text: None,
    ) -> list[Case]:
        """The first `count` held-out problems of a family; with a search, the first `count` hard problems.

        Problems that are not in the file yet are generated and added; with a search, problems that are
        neither trivial nor searched yet are searched.
        """
        case_rows: list[dict[str, Any]] = []
        numbers = itertools.count()
        while len(case_rows) < count:
            number = next(numbers)
            row = self._rows.get(f"{family}/{number}")
            if row is None:
                problem = held_out_problem(family, number)
                line = line_length(problem, validator)
                row = self._add(_row(Case(f"{family}/{number}", family, problem, line is not None, line)))
            if search is not None and not (row["trivial"] or row["searched"]):
                row = self._add(row | {"searched": True, "reference": search(_case(row).problem)})
            if search is None or _is_hard(row):
                case_rows.append(row)
                if len(case_rows) % REPORT_EVERY == 0 or len(case_rows) == count:
                    report(f"problems: {len(case_rows)} of {count} of {family}")
        return [_case(row) for row in case_rows]

    def _add(self, row: dict[str, Any]) -> dict[str, Any]:
        self._lines.append(row)
        self._rows[row["name"]] = row
        return row


def _is_hard(row: dict[str, Any]) -> bool:
    return not row["trivial"] and row["reference"] is not None


def _case(row: dict[str, Any]) -> Case:
    problem = problem_from_record(row["problem"])
    return Case(row["name"], row["family"], problem, row["trivial"], row["reference"])


def _row(case: Case) -> dict[str, Any]:
    return {
        "name": case.name,
        "family": case.family,
        "trivial": case.trivial,
        "searched": False,
        "reference": case.reference,
        "problem": problem_record(case.problem),
    }
