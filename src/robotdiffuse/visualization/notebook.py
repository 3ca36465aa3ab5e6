"""Replays in notebook cells."""

import html
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

from robotdiffuse.core.errors import InputError, check_type
from robotdiffuse.core.results import PlanResult, ResultFile
from robotdiffuse.problems.files import problem_from_record
from robotdiffuse.problems.problem import Problem, check_problem
from robotdiffuse.visualization.problem_drawing import write_problem
from robotdiffuse.visualization.replay_page import write_replay


class Replay:
    """The output of a notebook cell: a replay in an iframe."""

    def __init__(self, page: str, height: int) -> None:
        self._page = page
        self._height = height

    def _repr_html_(self) -> str:
        style = "width: 100%; border: 0; border-radius: 8px"
        page = html.escape(self._page)
        return f'<iframe srcdoc="{page}" height="{self._height}" style="{style}"></iframe>'


def show(result: PlanResult | ResultFile, problem: Problem | None = None, height: int = 560) -> Replay:
    """The replay of a result, for the last line of a notebook cell.

    Elsewhere in a cell, use `display(rd.show(result))`. Without a motion it shows the start, the goal and the
    links
    that collide.

    Args:
        result: A result of `plan`, or a result file.
        problem: Needed only if the result does not contain it; results of `plan`, and files saved with their
            problem, do.
        height: Height of the cell [pixels].

    Raises:
        InputError: Outside a notebook, and if the problem is unknown.
    """
    check_type("result", result, (PlanResult, ResultFile), "a result, as of rd.plan or rd.load_result")
    if problem is not None:
        check_problem(problem)
    if isinstance(result, ResultFile):
        if problem is None and result.problem is not None:
            problem = problem_from_record(result.problem)
        result = result.result
    problem = problem or result.problem
    if problem is None:
        raise InputError("the result does not contain its problem; use rd.show(result, problem)")
    if not _in_notebook():
        raise InputError(
            "rd.show is for notebooks; elsewhere save the result and use `robotdiffuse view`, or "
            "robotdiffuse.visualization.write_replay"
        )
    motion = result.trajectory or result.path
    with TemporaryDirectory() as folder:
        file = Path(folder) / "replay.html"
        if motion is None:
            write_problem(problem, file, result)
        else:
            write_replay(*problem.standing(), motion, file, result=result, moving=problem.moving_in_world)
        return Replay(file.read_text("utf-8"), height)


def _in_notebook() -> bool:
    """Whether this runs in a Jupyter kernel; does not import IPython."""
    shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    return hasattr(shell, "kernel")
