"""Problem sets by name: held-out problems of the families (kinds of random problems), and problems from files
and folders. Problems are checked once and then stored."""

import hashlib
import itertools
import json
from dataclasses import replace
from pathlib import Path as FilePath

from robotdiffuse.core.errors import InputError, repeated
from robotdiffuse.core.input_files import read_bytes, read_json
from robotdiffuse.core.output_files import check_not_input, write_atomically
from robotdiffuse.core.types import LENGTH, Path
from robotdiffuse.planning.search.rrt import AORRTC, AORRTCSettings
from robotdiffuse.problems.families import FAMILIES
from robotdiffuse.problems.files import load_problems
from robotdiffuse.problems.held_out import Case, CaseFile, Progress, line_length
from robotdiffuse.problems.problem import Problem
from robotdiffuse.validation.validator import VerifySettings, verifier

NONTRIVIAL_SUFFIX = "_nontrivial"
"""Suffix of a family's name for the set of its non-trivial problems: a search solves them, the straight line
does not."""
SEARCH_TIME = 10.0
"""A problem is left out of such a set if the search does not solve it in this time [s]."""
REFERENCE_ITERATIONS = 20_000
"""Minimum number of iterations of the search for the reference length."""


def validator(problem: Problem, path: Path) -> bool:
    """Whether a path passes the validator."""
    return verifier(problem, VerifySettings()).path(path).valid


def search(problem: Problem) -> float | None:
    """The reference length of a problem: the length of a short path that a search finds [rad]; None if the
    search does not solve the problem in time."""
    planner = AORRTC(AORRTCSettings(gain=0.001, patience=REFERENCE_ITERATIONS))
    return planner.plan(problem, SEARCH_TIME, seed=1, clearance=0.0, objective=LENGTH).path_length


def case_file(folder: FilePath | None, name: str) -> CaseFile:
    """The file that stores the cases of a problem set in a folder. Without a folder, cases are kept in
    memory."""
    return CaseFile(None if folder is None else folder / f"{name}.jsonl")


def hard_cases(
    family: str, count: int, folder: FilePath | None = None, report: Progress = lambda text: None
) -> list[Case]:
    """The first `count` held-out problems of a family that are not trivial and that the search solves. The
    folder stores the problems with the results of validator and search."""
    return case_file(folder, family).held_out(family, count, validator, search, report)


def problem_set_name(text: str) -> str:
    """The name of a problem set in results. Raises InputError for a text that is neither a family nor a file
    or folder."""
    family = text.removesuffix(NONTRIVIAL_SUFFIX)
    if family in FAMILIES:
        return text
    place = FilePath(text)
    if not place.exists():
        raise InputError(
            f"problems {text!r} are neither a file or folder nor a family; known families: "
            f"{', '.join(FAMILIES)}, each also with {NONTRIVIAL_SUFFIX}"
        )
    name = place.resolve().stem
    if name.removesuffix(NONTRIVIAL_SUFFIX) in FAMILIES:
        raise InputError(f"problems {text!r} have the name of the family {name}; rename the file or folder")
    return name


def gather_cases(names: list[str], count: int | None, out: FilePath, report: Progress) -> list[Case]:
    """The first `count` problems of each set (None: all of a file or folder, 100 of a family).

    Problems are stored in `out`/problems, one file for each set, and read from there next time. If `count` is
    then larger, problems of families are added. `report` is called with lines of text about the progress.
    Raises InputError for unknown and repeated names, for empty sets, for `out` as a set, and if a file or
    folder has another content than the problems that are stored under its name.
    """
    repeated_names = repeated(problem_set_name(text) for text in names)
    if repeated_names:
        twice = ", ".join(sorted(repeated_names))
        raise InputError(f"problems has {twice} twice; leave one out, or rename its file or folder")
    return [case for text in names for case in _set(text, count, out / "problems", report)]


def read_cases(out: FilePath, problem_set: str) -> list[Case]:
    """All cases of a problem set that are stored in a folder. Raises InputError if their file is damaged."""
    family = problem_set.removesuffix(NONTRIVIAL_SUFFIX)
    name = family if family in FAMILIES else problem_set
    return _of_set(case_file(out / "problems", name).cases(hard=name != problem_set), problem_set)


def _set(text: str, count: int | None, folder: FilePath, report: Progress) -> list[Case]:
    name = problem_set_name(text)
    family = text.removesuffix(NONTRIVIAL_SUFFIX)
    case_store = case_file(folder, family if family in FAMILIES else name)
    if family in FAMILIES:
        finder = search if family != text else None
        return _of_set(case_store.held_out(family, count or 100, validator, finder, report), name)
    place = FilePath(text)
    check_not_input(folder.parent, text)
    source = folder / f"{name}.source.json"
    about = {"source": str(place.resolve()), "sha256": _content_hash(place)}
    if not len(case_store):
        cases = _read_place(place, name, report)
        write_atomically(source, json.dumps(about), make_folder=True)
        case_store.fill(cases)
    elif source.is_file() and (stored := read_json(source))["sha256"] != about["sha256"]:
        raise InputError(
            f"{folder} has problems called {name} that were read from {stored['source']}; those in {text} "
            "have another content: rename them, or use another output folder"
        )
    return _of_set(case_store.cases()[:count], name)


def _content_hash(place: FilePath) -> str:
    """SHA-256 of the problem files of a set. Mesh files are not included."""
    digest = hashlib.sha256()
    for part in _parts(place):
        for file in [part] if part.is_file() else sorted(part.glob("*.yaml")):
            digest.update(f"{file.relative_to(place)} {file.stat().st_size}\n".encode())
            digest.update(read_bytes(file))
    return digest.hexdigest()


def _of_set(cases: list[Case], problem_set: str) -> list[Case]:
    return [replace(case, problem_set=problem_set) for case in cases]


def _read_place(place: FilePath, name: str, report: Progress) -> list[Case]:
    """The cases of a problem file, of a MotionBenchMaker folder, or of all problem files and MotionBenchMaker
    folders in a folder."""
    cases = []
    for part in _parts(place):
        family = part.resolve().stem
        for entry in load_problems(part):
            if entry.problem is None:
                report(f"left out: {entry.error}")
                continue
            line = line_length(entry.problem, validator)
            cases.append(Case(entry.name, family, entry.problem, line is not None, line))
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
    """The cases, ordered by taking one of each family in turn, so that the first cases are of all
    families."""
    families: dict[str, list[Case]] = {}
    for case in cases:
        families.setdefault(case.family, []).append(case)
    rows = itertools.zip_longest(*families.values())
    return [case for row in rows for case in row if case is not None]
