"""The problems of a bench: random ones by family name, files and folders; drawn once and kept in a file."""

import itertools
import json
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path as FilePath
from typing import Any

import numpy as np

from robotdiffuse.errors import InputError
from robotdiffuse.evaluation.trials import SEARCH_TIME, SEED, problem_number
from robotdiffuse.files import write_atomically
from robotdiffuse.generation.problems import draw_problem
from robotdiffuse.generation.settings import GenerationSettings
from robotdiffuse.planners.rrt_connect.planner import RRTConnect
from robotdiffuse.problems.families import FAMILIES
from robotdiffuse.problems.families.rop import RopSettings
from robotdiffuse.problems.files import Robots, load_problems, problem_from_record, problem_record
from robotdiffuse.problems.problem import JointGoal, Problem
from robotdiffuse.problems.rop_problems import sample_problem
from robotdiffuse.robots import load_robot
from robotdiffuse.types import Path
from robotdiffuse.verify import Verifier, VerifySettings

NONTRIVIAL = "_nontrivial"
"""Suffix of a family's name: only problems that the straight line does not solve and search does."""
REPORT_EVERY = 20


@dataclass(frozen=True)
class Case:
    """A problem of a bench."""

    problem_set: str
    """As asked for: the name of a family, or the stem of a file or folder."""
    name: str
    """Its own in the set."""
    family: str
    """What bars and tables group by: the random family, or the folder or file it comes from."""
    trivial: bool
    """The straight line to a goal configuration passes the judge."""
    problem: dict[str, Any]
    """As in a problem file."""

    @property
    def key(self) -> tuple[str, str]:
        return self.problem_set, self.name

    def load(self, robots: Robots | None = None) -> Problem:
        """The problem; `robots`: those that are read already, for all cases that share them."""
        return problem_from_record(self.problem, robots)


def family_problem(family: str, index: int) -> Problem:
    """Held-out problem number so and so of a family, for the Panda; trivial and unsolvable ones among them.

    ROP: start and goal are uniform among the free configurations with the tip in the paper's region.
    Furniture: both are poses with the fingers in two regions of it; the first solution of inverse kinematics.
    """
    settings = FAMILIES[family]
    if family == "rop":
        return problem_number(index)
    robot = load_robot("panda")
    rng = np.random.default_rng([SEED, 10 + list(FAMILIES).index(family), index])
    if isinstance(settings, RopSettings):
        return sample_problem(robot, settings, rng)
    drawn = draw_problem(GenerationSettings(mix={family: 1.0}, target="pose", goals=1), robot, rng)
    return Problem(robot, drawn.scene, drawn.start, JointGoal(drawn.goals[:1]))


def line_solves(problem: Problem) -> bool:
    """Whether a straight line from the start to a goal configuration passes the judge."""
    if not isinstance(problem.goal, JointGoal):
        return False
    judge = Verifier(problem, VerifySettings())
    names = problem.robot.joint_names
    return any(
        judge.path(Path(names, np.stack([problem.start, goal]))).valid for goal in problem.goal.positions
    )


def problem_set_name(text: str) -> str:
    """The name of a set as it stands in results. Raises InputError for what is no family, file or folder."""
    family = text.removesuffix(NONTRIVIAL)
    if family in FAMILIES:
        return text
    place = FilePath(text)
    if not place.exists():
        raise InputError(
            f"problems {text!r} are neither a file or folder nor a family; known families: "
            f"{', '.join(FAMILIES)}, each also with {NONTRIVIAL}"
        )
    return place.resolve().stem


def gather_cases(
    names: list[str], count: int | None, out: FilePath, report: Callable[[str], None]
) -> list[Case]:
    """The first `count` problems of each set (None: all of a file or folder, 100 of a family).

    They are kept in `out`/problems, one file per set, and read from there the next time; a larger count adds
    to them. `report` is told how far it is. Raises InputError for unknown names and empty sets.
    """
    sets = [problem_set_name(text) for text in names]
    twice = {name for name in sets if sets.count(name) > 1}
    if twice:
        raise InputError(f"problems name {', '.join(sorted(twice))} twice; rename a file or folder")
    return [case for text in names for case in _set(text, count, out, report)]


def read_cases(out: FilePath, problem_set: str) -> list[Case]:
    """All problems of a set that a folder keeps. Raises InputError if their file is damaged."""
    return _read(out / "problems" / f"{problem_set}.json")["cases"]


def _set(text: str, count: int | None, out: FilePath, report: Callable[[str], None]) -> list[Case]:
    name = problem_set_name(text)
    file = out / "problems" / f"{name}.json"
    known = _read(file)
    if text.removesuffix(NONTRIVIAL) in FAMILIES:
        wanted = 100 if count is None else count
        source: Iterator[tuple[int, Case]] = _drawn(text, known["drawn"])
        while len(known["cases"]) < wanted:
            index, case = next(source)
            known["cases"].append(case)
            known["drawn"] = index + 1
            if len(known["cases"]) % REPORT_EVERY == 0 or len(known["cases"]) == wanted:
                report(f"problems: {len(known['cases'])} of {wanted} of {name}")
                _write(file, known)
        return known["cases"][:wanted]
    if not known["cases"]:
        known["cases"] = _from_place(FilePath(text), name, report)
        _write(file, known)
    return known["cases"][:count]


def _read(file: FilePath) -> dict[str, Any]:
    if not file.is_file():
        return {"drawn": 0, "cases": []}
    try:
        data = json.loads(file.read_text())
        return {"drawn": data["drawn"], "cases": [Case(**case) for case in data["cases"]]}
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(
            f"{file} is damaged ({error}); remove it, and its problems are drawn again"
        ) from None


def _write(file: FilePath, known: dict[str, Any]) -> None:
    lines = ",\n".join(json.dumps(asdict(case)) for case in known["cases"])
    write_atomically(file, f'{{"drawn": {known["drawn"]}, "cases": [\n{lines}\n]}}\n', make_folder=True)


def _drawn(text: str, first: int) -> Iterator[tuple[int, Case]]:
    """Problems of a family from a number on, each with its number."""
    family, only_hard = text.removesuffix(NONTRIVIAL), text.endswith(NONTRIVIAL)
    for index in itertools.count(first):
        problem = family_problem(family, index)
        trivial = line_solves(problem)
        if only_hard and (trivial or not RRTConnect().plan(problem, SEARCH_TIME, seed=1).solved):
            continue
        yield index, Case(text, f"{family}/{index}", family, trivial, problem_record(problem))


def _from_place(place: FilePath, name: str, report: Callable[[str], None]) -> list[Case]:
    """Those of a file, of a MotionBenchMaker folder, or of the files and such folders in a folder."""
    cases = []
    for part in _parts(place):
        family = part.resolve().stem
        for entry in load_problems(part):
            if entry.problem is None:
                report(f"left out: {entry.error}")
                continue
            trivial = line_solves(entry.problem)
            cases.append(Case(name, entry.name, family, trivial, problem_record(entry.problem)))
        report(f"problems: {len(cases)} of {name}")
    if not cases:
        raise InputError(f"{place} holds no usable problem")
    return _interleaved(cases)


def _parts(place: FilePath) -> list[FilePath]:
    if place.is_file() or any(place.glob("scene*.yaml")):
        return [place]
    endings = (".jsonl", ".json", ".yaml", ".yml")
    return [
        part
        for part in sorted(place.iterdir())
        if (part.is_dir() and any(part.glob("scene*.yaml"))) or part.suffix.lower() in endings
    ]


def _interleaved(cases: list[Case]) -> list[Case]:
    """One of each family in turn, so that the first so many are of all."""
    families: dict[str, list[Case]] = {}
    for case in cases:
        families.setdefault(case.family, []).append(case)
    rows = itertools.zip_longest(*families.values())
    return [case for row in rows for case in row if case is not None]
