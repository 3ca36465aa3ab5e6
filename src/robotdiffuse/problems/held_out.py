"""Problems to be validated by: those of the families by number, none of them in any data set; kept in files.

One rule says what a problem is worth: it is trivial if the straight line from the start to a goal
configuration passes the validator, and hard if it is not and a search finds a path. One form of file keeps
problems with what is known of them: JSON lines, which every benchmark reads.
"""

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path as FilePath
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.core.errors import InputError
from robotdiffuse.core.output_files import JsonLines
from robotdiffuse.core.types import Path
from robotdiffuse.problems.families import FAMILIES, load_family
from robotdiffuse.problems.files import problem_from_record, problem_record
from robotdiffuse.problems.problem import JointGoal, Problem
from robotdiffuse.robots import load_robot

SEED = 20261121
"""Of the held-out problems; data are drawn from other seed sequences."""

Validator = Callable[[Problem, Path], bool]
"""Whether a path solves a problem."""
Search = Callable[[Problem], float | None]
"""The length of the shortest path that a search finds [rad]; None if it finds none."""
Report = Callable[[str], None]
REPORT_EVERY = 20


def goal_of(problem: Problem) -> Float[ndarray, "dof"]:
    """The goal configuration."""
    assert isinstance(problem.goal, JointGoal)
    return problem.goal.positions[0]


@dataclass(frozen=True, eq=False)
class Case:
    """A problem to be validated by, and what is known of it."""

    name: str
    """Its own in the set: rop/17 is number 17 of a family."""
    family: str
    """What bars and tables group by: the random family, or the folder or file it comes from."""
    problem: Problem
    trivial: bool
    """The straight line to a goal configuration passes the validator."""
    reference: float | None = None
    """Length of the shortest path that is known [rad]; None if none was looked for, or none was found."""
    problem_set: str = ""
    """As asked for: the name of a family, or the stem of a file or folder."""

    @property
    def key(self) -> tuple[str, str]:
        return self.problem_set, self.name

    @property
    def hard(self) -> bool:
        """Not trivial, and a search solves it."""
        return not self.trivial and self.reference is not None


def held_out_problem(family: str, number: int) -> Problem:
    """Each number is a problem for the Panda, trivial and unsolvable ones among them."""
    place = list(FAMILIES).index(family)
    rng = np.random.default_rng([SEED, number] if place == 0 else [SEED, 10 + place, number])
    if place > 1:
        rng.random()  # as when the first figures were reported
    robot = load_robot("panda")
    return load_family(family).draw(robot, rng).problem(robot)


def line_length(problem: Problem, validator: Validator) -> float | None:
    """Of the shortest straight line from the start to a goal configuration that passes the validator [rad];
    None if none of them does."""
    goals = problem.goal.positions if isinstance(problem.goal, JointGoal) else ()
    lines = [Path(problem.robot.joint_names, np.stack([problem.start, goal])) for goal in goals]
    return min((line.length for line in lines if validator(problem, line)), default=None)


FIELDS = {"name", "family", "trivial", "searched", "reference", "problem"}
"""Of a line: what a case has, whether a search has looked for a reference, and the problem as in its file."""


class CaseFile:
    """Cases by name, in the order that they were added in; kept in a file or, without one, in memory."""

    def __init__(self, file: FilePath | None) -> None:
        """Raises InputError, naming file and line, for a damaged file."""
        self._lines = JsonLines(file)
        self._rows: dict[str, dict[str, Any]] = {}
        for number, row in enumerate(self._lines.rows, start=1):
            if row.keys() != FIELDS:
                raise InputError(
                    f"{file}, line {number} has {', '.join(row)} in place of {', '.join(FIELDS)}; remove the "
                    "file, and its problems are drawn again"
                )
            self._rows[row["name"]] = row  # a later line on the same problem knows more

    def __len__(self) -> int:
        return len(self._rows)

    def cases(self, hard: bool = False) -> list[Case]:
        """All that are known; `hard`: known to be that."""
        return [_case(row) for row in self._rows.values() if not hard or _is_hard(row)]

    def fill(self, cases: list[Case]) -> None:
        """Put these in place of what is there, all or none. Raises InputError if two have the same name."""
        names = [case.name for case in cases]
        twice = [name for name in names if names.count(name) > 1]
        if twice:
            raise InputError(f"two problems are called {twice[0]}; rename the file of one")
        self._lines.replace([_row(case) for case in cases])
        self._rows = {row["name"]: row for row in self._lines.rows}

    def held_out(
        self,
        family: str,
        count: int,
        validator: Validator,
        search: Search | None = None,
        report: Report = lambda text: None,
    ) -> list[Case]:
        """The first `count` held-out problems of a family; with a search, of those that are hard.

        What is not known yet is drawn, validated, searched and added.
        """
        found: list[dict[str, Any]] = []
        numbers = itertools.count()
        while len(found) < count:
            number = next(numbers)
            row = self._rows.get(f"{family}/{number}")
            if row is None:
                problem = held_out_problem(family, number)
                line = line_length(problem, validator)
                row = self._add(_row(Case(f"{family}/{number}", family, problem, line is not None, line)))
            if search is not None and not (row["trivial"] or row["searched"]):
                row = self._add(row | {"searched": True, "reference": search(_case(row).problem)})
            if search is None or _is_hard(row):
                found.append(row)
                if len(found) % REPORT_EVERY == 0 or len(found) == count:
                    report(f"problems: {len(found)} of {count} of {family}")
        return [_case(row) for row in found]

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
