"""robotdiffuse view"""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from robotdiffuse.cli.drawing import ENDINGS, draw, show
from robotdiffuse.core.errors import InputError

if TYPE_CHECKING:
    from robotdiffuse.core.results import PlanResult
    from robotdiffuse.problems.problem import Problem


def add_view(commands: argparse._SubParsersAction) -> None:
    parser = commands.add_parser(
        "view",
        help="draw a result as a replay (.html) or a picture (.png)",
        description="Draw the motion of a result file. Without --out, a replay opens in the browser.",
    )
    parser.add_argument("result", metavar="RESULT", help="result file (.json) of `robotdiffuse plan --out`")
    parser.add_argument(
        "--out",
        action="append",
        metavar="FILE",
        help="FILE.html or FILE.png; repeatable (default: RESULT's name with .html)",
    )
    parser.set_defaults(run=run_view)


def read(file: str) -> "tuple[PlanResult, Problem]":
    """A solved result and its problem. Raises InputError where the file holds no motion or no problem."""
    from robotdiffuse.core.results import load_result
    from robotdiffuse.problems.files import problem_from_record

    saved = load_result(file)
    if not saved.result.solved:
        raise InputError(
            f"{file} holds no motion: its status is {saved.result.status.value} ({saved.result.reason})"
        )
    if saved.problem is None:
        raise InputError(f"{file} holds no problem; write it by `robotdiffuse plan PROBLEM --out FILE.json`")
    return saved.result, problem_from_record(saved.problem)


def run_view(arguments: argparse.Namespace) -> int:
    from robotdiffuse.core.output_files import check_output

    files = arguments.out or [f"{Path(arguments.result).stem}.html"]
    outputs = [check_output(file, ENDINGS) for file in files]
    result, problem = read(arguments.result)
    for file in outputs:
        draw(problem, result, file)
        print(f"wrote {file}")
    if not arguments.out:
        show(outputs[0])
    return 0
