"""The command `robotdiffuse view`."""

import argparse
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from robotdiffuse.cli.arguments import command, not_negative, option
from robotdiffuse.cli.drawing import ENDINGS, draw, draw_several, show
from robotdiffuse.core.errors import InputError

if TYPE_CHECKING:
    from robotdiffuse.core.results import PlanResult
    from robotdiffuse.problems.problem import Problem


def add(commands: argparse._SubParsersAction) -> None:
    parser = command(
        commands,
        "view",
        "draw results and problems as a replay (.html) or a picture (.png)",
        "Draw the motions of result files, of several in one picture; of a problem, or a "
        "result without a motion, the start, the goal and the links that collide. Without --out, write a "
        "page and open it in the browser.",
        run,
    )
    option(
        parser,
        "results RESULT",
        "result file (.json) of `robotdiffuse plan --out`, or a problem file; several results must be "
        "of one problem",
        nargs="+",
    )
    option(
        parser,
        "--out FILE *",
        "replay (.html) or picture (.png); repeatable (default: the name of RESULT with .html)",
    )
    option(
        parser,
        "--shell M",
        "with several results: thickness of the safety shell that pictures show about the arm [m] "
        "(default: 0, none)",
        not_negative,
        0.0,
    )


def read_result(file: str) -> "tuple[PlanResult, Problem]":
    """The result in a file, and its problem. Raises InputError if the file holds no problem."""
    from robotdiffuse.core.results import NO_PROBLEM, load_result
    from robotdiffuse.problems.files import problem_from_record

    saved = load_result(file)
    if saved.problem is None:
        why = [f" ({note})" for note in saved.result.notes if note.startswith(NO_PROBLEM)]
        raise InputError(
            f"{file} holds no problem{''.join(why)}; write it with `robotdiffuse plan PROBLEM --out "
            "FILE.json`, or with `save` of a result of rd.plan"
        )
    return saved.result, problem_from_record(saved.problem)


def read_solved(file: str) -> "tuple[PlanResult, Problem]":
    """The solved result in a file, and its problem. Raises InputError if the file holds no motion or
    problem."""
    result, problem = read_result(file)
    if not result.solved:
        raise InputError(f"{file} holds no motion: its status is {result.status.value} ({result.reason})")
    return result, problem


def _read(file: str) -> "tuple[PlanResult | None, Problem]":
    """The result in a file, and its problem; of a problem file, the problem alone."""
    from robotdiffuse.core.input_files import read_json
    from robotdiffuse.core.results import PROBLEM_ENDINGS
    from robotdiffuse.problems.files import load_problem

    ending = Path(file).suffix.lower()
    record = read_json(file) if ending == ".json" else {}
    is_problem = isinstance(record, dict) and "scene" in record and "status" not in record
    if ending in PROBLEM_ENDINGS or is_problem:
        return None, load_problem(file)
    return read_result(file)


def run(arguments: argparse.Namespace) -> int:
    from robotdiffuse.core.output_files import check_output

    files = arguments.out or [f"{Path(arguments.results[0]).stem}.html"]
    outputs = [check_output(file, ENDINGS) for file in files]
    if len(arguments.results) == 1:
        result, problem = _read(arguments.results[0])
        write = partial(draw, problem, result)
    else:
        problem, results = _read_several(arguments.results)
        write = partial(draw_several, problem, results, shell=arguments.shell)
    for file in outputs:
        write(file)
        print(f"wrote {file}")
    if not arguments.out:
        show(outputs[0])
    return 0


def _read_several(files: list[str]) -> "tuple[Problem, dict[str, PlanResult]]":
    """The solved results in several files, by name, and the problem of the first. Raises InputError for other
    scenes and for equal names."""
    from robotdiffuse.problems.files import problem_record

    names = [Path(file).stem for file in files]
    (result, problem), *others = map(read_solved, files)
    if len(set(names)) < len(names):
        raise InputError(f"results are {', '.join(files)}; two have the same name")
    for name, (_, other) in zip(names[1:], others, strict=True):
        if problem_record(other)["scene"] != problem_record(problem)["scene"] or other.robot != problem.robot:
            raise InputError(f"{name} is of another robot or scene than {names[0]}; results must share both")
    return problem, dict(zip(names, (result, *(one for one, _ in others)), strict=True))
