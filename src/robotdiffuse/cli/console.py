"""Terminal output of commands: result tables, and a bar or a spinner for long waits."""

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from threading import Event, Thread
from typing import TYPE_CHECKING

from robotdiffuse.collision.kernels.collision_cost import CLEARANCE_CAP
from robotdiffuse.core.loading import compiled
from robotdiffuse.core.tables import Table, show
from robotdiffuse.core.types import Done

if TYPE_CHECKING:
    from robotdiffuse.certificates.certificate import Certificate
    from robotdiffuse.core.types import PlanResult
    from robotdiffuse.problems.problem import Problem
    from robotdiffuse.validation.report import Report

SPINNER_DELAY = 2.0
"""Time until the spinner appears [s]."""
# Time between two updates of the spinner, and between two lines where there is no terminal [s].
STATUS_INTERVAL = 0.2
LOG_INTERVAL = 5.0
CAP_TOLERANCE = 1e-4
"""Clearances nearer than this to CLEARANCE_CAP, the largest that is measured, are printed as "> 1 m" [m]."""
COUNT_INTERVAL = 60.0
"""Time between two lines of `progress` where there is no terminal [s]."""
ASSUMPTION_TEXTS = {"as seen": "what was seen", "unknown is occupied": "all that was not seen free"}
"""How `print_result` words some assumptions about unknown space."""


class Spinner:
    """A context manager that shows a text, and which functions are compiled, on standard error while its
    block runs.

    It appears after SPINNER_DELAY, so that short commands need not import rich. If standard error is not a
    terminal, it prints a line every LOG_INTERVAL once code is compiled.
    """

    def __init__(self, text: str) -> None:
        self.text = text
        self._ended = Event()
        self._thread = Thread(target=self._show, daemon=True)
        self._compiled = len(compiled)

    def __enter__(self) -> "Spinner":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def stop(self) -> None:
        """Remove the spinner, if it has appeared."""
        self._ended.set()
        self._thread.join()

    def _show(self) -> None:
        if self._ended.wait(SPINNER_DELAY):
            return
        from rich.console import Console

        console = Console(stderr=True, highlight=False)
        if console.is_terminal:
            with console.status(self._line()) as status:
                while not self._ended.wait(STATUS_INTERVAL):
                    status.update(self._line())
            return
        while not self._ended.wait(LOG_INTERVAL):
            if len(compiled) > self._compiled:
                console.print(self._line(), soft_wrap=True)

    def _line(self) -> str:
        count = len(compiled) - self._compiled
        if count == 0:
            return self.text
        return f"{self.text}: compiling, once on this machine; {count} so far ({compiled[-1]})"


def say(text: str) -> None:
    """Print a line on standard error at once."""
    print(text, file=sys.stderr, flush=True)


@contextmanager
def progress(what: str) -> Iterator[Done]:
    """Yields a function `update(done, total)` that moves a progress bar on standard error. If standard error
    is not a terminal, the function prints a line at its first call and then every COUNT_INTERVAL."""
    from rich.console import Console
    from rich.progress import MofNCompleteColumn, Progress, TimeElapsedColumn, TimeRemainingColumn

    console = Console(stderr=True)
    columns = (*Progress.get_default_columns()[:2], MofNCompleteColumn(), TimeElapsedColumn())
    due = 0.0

    def update(done: int, total: int) -> None:
        nonlocal due
        bar.update(task, completed=done, total=total)
        if not console.is_terminal and time.monotonic() >= due:
            due = time.monotonic() + COUNT_INTERVAL
            say(f"{what}: {done:,} of {total:,}")

    with Progress(
        *columns, TimeRemainingColumn(), console=console, transient=True, disable=not console.is_terminal
    ) as bar:
        task = bar.add_task(what, total=None)
        yield update


def clearances(motion: "PlanResult | Report | Certificate", target: float | None = None) -> str:
    """A text with the certified clearances to the scene and between links, or with the smallest clearance if
    the motion has only this one. target: the requested clearance to the scene [m], shown beside the certified
    one; None: it is not shown."""
    if motion.scene_clearance is None or motion.self_clearance is None:
        return _certified(getattr(motion, "min_clearance", None) or 0.0)
    requested = "" if target is None else f" (asked: {1e3 * target:g} mm)"
    between = f", {_certified(motion.self_clearance)} between links"
    return f"{_certified(motion.scene_clearance)} to the scene{requested}{between}"


def _certified(clearance: float) -> str:
    """The text for a certified lower bound [m]; the validator measures no distance beyond CLEARANCE_CAP."""
    capped = clearance > CLEARANCE_CAP - CAP_TOLERANCE
    # + 0.0 turns -0.0 into 0.0
    return f"> {CLEARANCE_CAP:g} m" if capped else f"at least {1e3 * clearance + 0.0:.1f} mm"


def print_result(result: "PlanResult", requested: float | None = None) -> None:
    """Print the result of plan() as a table; without a plan, its status and reason.

    requested: the clearance that was requested, or the default one [m]; None: the planner keeps none.
    """

    rows = [
        ("reason", result.reason),
        *(("note", note) for note in result.notes),
        ("planner", f"{result.planner} ({result.stage})" if result.stage else result.planner),
        ("planning time", f"{1e3 * result.planning_time:.1f} ms"),
    ]
    if result.path is not None:
        size = f"{len(result.path.positions)} waypoints, length {result.path.length:.3f} rad"
        rows += [("path", size), ("verified", "yes")]
    if result.assumption:
        text = ASSUMPTION_TEXTS.get(result.assumption, f"what was seen, and {result.assumption}")
        rows.append(("keeps clear of", text))
    if result.confidence is not None:
        text = f"{100 * result.confidence:.0f} % that unknown space on the way is free"
        rows.append(("confidence", text))
    if result.unknown_region is not None:
        low, high = (", ".join(f"{at:.2f}" for at in corner) for corner in result.unknown_region)
        rows.append(("crosses unknown", f"from ({low}) to ({high}) m"))
    if result.min_clearance is not None:
        rows.append(("clearance", f"certified {clearances(result, requested)}"))
    if result.trajectory is not None:
        rows.append(
            ("motion", f"{result.trajectory.duration:.2f} s, {len(result.trajectory.times)} time steps")
        )
    rows.append(("seed", str(result.seed)))
    show(Table.pairs(f"{result.robot}: {result.status.value}", rows))


def print_next_view(problem: "Problem", result: "PlanResult") -> None:
    """Print the proposed next camera pose in the form of problem files."""
    from robotdiffuse.core.transforms import pose_entry
    from robotdiffuse.planning.exploration.viewpoints import next_view

    proposed = next_view(problem, result)
    T = proposed.T_base_camera
    if problem.T_world_base is not None:  # files then give cameras in the world's frame
        T = problem.T_world_base @ T
    camera = ", ".join(
        f"{name}: [{', '.join(f'{number:.4g}' for number in numbers)}]"
        for name, numbers in pose_entry(T).items()
    )
    print(f"next view, which shows {100 * proposed.seen:.0f} % of the unknown space that the motion crosses:")
    print(f"  camera: {{{camera}}}")
