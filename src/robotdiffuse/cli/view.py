"""The command `robotdiffuse view`."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from robotdiffuse.cli.arguments import not_negative
from robotdiffuse.cli.drawing import ENDINGS, draw, draw_several, show
from robotdiffuse.core.errors import InputError

if TYPE_CHECKING:
    from robotdiffuse.core.results import PlanResult
    from robotdiffuse.problems.problem import Problem


def add(commands: argparse._SubParsersAction) -> None:
    parser = commands.add_parser(
        "view",
        help="draw results as a replay (.html) or a picture (.png)",
        description="Draw the motions of result files, of several in one picture. Without --out, write a "
        "replay and open it in the browser.",
    )
    parser.add_argument(
        "results",
        nargs="+",
        metavar="RESULT",
        help="result file (.json) of `robotdiffuse plan --out`; several must be of one problem",
    )
    parser.add_argument(
        "--out",
        action="append",
        metavar="FILE",
        help="replay (.html) or picture (.png); repeatable (default: the name of RESULT with .html)",
    )
    parser.add_argument(
        "--shell",
        type=not_negative,
        default=0.0,
        metavar="M",
        help="with several results: thickness of the safety shell that pictures show about the arm [m] "
        "(default: 0, none)",
    )
    parser.set_defaults(run=run)


def read_solved(file: str) -> "tuple[PlanResult, Problem]":
    """The solved result in a file, and its problem. Raises InputError if the file holds no motion or
    problem."""
    from robotdiffuse.core.results import load_result
    from robotdiffuse.problems.files import problem_from_record

    saved = load_result(file)
    if not saved.result.solved:
        raise InputError(
            f"{file} holds no motion: its status is {saved.result.status.value} ({saved.result.reason})"
        )
    if saved.problem is None:
        raise InputError(
            f"{file} holds no problem; write it with `robotdiffuse plan PROBLEM --out FILE.json`"
        )
    return saved.result, problem_from_record(saved.problem)


def run(arguments: argparse.Namespace) -> int:
    from robotdiffuse.core.output_files import check_output
    from robotdiffuse.problems.files import problem_record

    names = [Path(file).stem for file in arguments.results]
    files = arguments.out or [f"{names[0]}.html"]
    outputs = [check_output(file, ENDINGS) for file in files]
    (result, problem), *others = map(read_solved, arguments.results)
    if len(set(names)) < len(names):
        raise InputError(f"results are {', '.join(arguments.results)}; two have the same name")
    for name, (_, other) in zip(names[1:], others, strict=True):
        if problem_record(other)["scene"] != problem_record(problem)["scene"] or other.robot != problem.robot:
            raise InputError(f"{name} is of another robot or scene than {names[0]}; results must share both")
    several = dict(zip(names, (result, *(one for one, _ in others)), strict=True))
    for file in outputs:
        if others:
            draw_several(problem, several, file, arguments.shell)
        else:
            draw(problem, result, file)
        print(f"wrote {file}")
    if not arguments.out:
        show(outputs[0])
    return 0
