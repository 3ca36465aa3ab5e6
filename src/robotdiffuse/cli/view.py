"""The command `robotdiffuse view`."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from robotdiffuse.cli.drawing import ENDINGS, draw, show
from robotdiffuse.core.errors import InputError

if TYPE_CHECKING:
    from robotdiffuse.core.results import PlanResult
    from robotdiffuse.problems.problem import Problem


def add(commands: argparse._SubParsersAction) -> None:
    parser = commands.add_parser(
        "view",
        help="draw a result as a replay (.html) or a picture (.png)",
        description="Draw the motion of a result file. Without --out, write a replay and open it in the "
        "browser.",
    )
    parser.add_argument("result", metavar="RESULT", help="result file (.json) of `robotdiffuse plan --out`")
    parser.add_argument(
        "--out",
        action="append",
        metavar="FILE",
        help="replay (.html) or picture (.png); repeatable (default: the name of RESULT with .html)",
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

    files = arguments.out or [f"{Path(arguments.result).stem}.html"]
    outputs = [check_output(file, ENDINGS) for file in files]
    result, problem = read_solved(arguments.result)
    for file in outputs:
        draw(problem, result, file)
        print(f"wrote {file}")
    if not arguments.out:
        show(outputs[0])
    return 0
