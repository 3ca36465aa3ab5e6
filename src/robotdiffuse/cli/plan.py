"""The command `robotdiffuse plan`."""

from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from robotdiffuse.cli.arguments import NO_PLAN, SOLVED, VIEW_ENDINGS, Namespace, chosen
from robotdiffuse.cli.compile_ahead import compiling_ahead
from robotdiffuse.cli.console import Spinner, print_next_view, print_result
from robotdiffuse.core.errors import InputError
from robotdiffuse.core.files import check_output
from robotdiffuse.core.interrupts import exit_on_interrupt
from robotdiffuse.core.settings import Settings
from robotdiffuse.core.types import PlanResult
from robotdiffuse.interop import WRITERS, check_export, write_motion
from robotdiffuse.planning import CLEARANCE, DEFAULT_PLANNER, PLANNERS, load_planner, planner_settings
from robotdiffuse.planning.context import PlanRequest, requested_clearance
from robotdiffuse.problems.files import load_problem
from robotdiffuse.problems.problem import Problem, check_unknown

RESULT_ENDINGS = (".json", ".csv", *VIEW_ENDINGS, *WRITERS)


def run_plan(arguments: Namespace) -> int:
    name = arguments.planner or DEFAULT_PLANNER
    PLANNERS.entry(name)
    settings = planner_settings(name, arguments.settings) if arguments.settings else None
    outputs = _outputs(arguments)
    request = _request(arguments)
    problem = _problem(arguments)
    picture = any(file.suffix.lower() == ".png" for file in outputs)
    result = load_and_plan(problem, name, settings, arguments.weights, picture, **asdict(request))
    # files first: printing into `| head` can end the process
    try:
        written = [file for file in outputs if _write(problem, result, file)]
    finally:  # also if a file cannot be written, for example because the disk is full
        print_result(result, asked_clearance(problem, name, request.clearance))
    if arguments.next_view and result.path is not None:
        print_next_view(problem, result)
    for file in outputs:
        print(f"wrote {file}" if file in written else f"not written: {file}: there is no motion")
    if arguments.view:
        from robotdiffuse.cli.view import open_in_browser

        open_in_browser(outputs[-1])
    return SOLVED if result.solved else NO_PLAN


def _request(arguments: Namespace) -> PlanRequest:
    """The request of the options; `--jerk none` removes the limits."""
    options = chosen(arguments, PlanRequest.__dataclass_fields__)
    if options.get("jerk") == "none":
        options["jerk"] = "inf"
    return PlanRequest().changed(f"{name}={value}" for name, value in options.items())


def _outputs(arguments: Namespace) -> list[Path]:
    """All files to write. Raises InputError for one that cannot be written."""
    problem = arguments.problem
    files = [
        check_export(file, problem)
        if Path(file).suffix.lower() in WRITERS
        else check_output(file, RESULT_ENDINGS, problem)
        for file in arguments.out
    ]
    if arguments.view:
        files.append(check_output(f"{Path(problem).stem}.html", VIEW_ENDINGS))
    return files


def _problem(arguments: Namespace) -> Problem:
    """The problem of the file, changed by --unknown and --blend."""
    problem = load_problem(arguments.problem, arguments.index, arguments.ignore_joints)
    unknown = arguments.unknown
    if unknown:
        check_unknown("--unknown", unknown)
    view_option = "--next-view" if arguments.next_view else unknown and f"--unknown {unknown}"
    if view_option and not problem.views:
        raise InputError(f"{view_option} needs a problem with views; this one has none")
    if unknown:
        problem = replace(problem, unknown=unknown)
    return problem if arguments.blend is None else replace(problem, blend=arguments.blend)


def _write(problem: Problem, result: PlanResult, file: Path) -> bool:
    """Write a file by its ending; returns False for one that needs a motion if there is none."""
    ending = file.suffix.lower()
    if ending == ".json":
        result.save(file)
    elif ending in VIEW_ENDINGS:
        from robotdiffuse.cli.view import draw

        draw(problem, result, file)
    elif result.trajectory is None:
        return False
    else:
        write_motion(problem, result.trajectory, file)
    return True


def asked_clearance(problem: Problem, planner: str, clearance: float | None = None) -> float | None:
    """The clearance [m]: that of the call, else the problem's, else the default. None for a planner that
    keeps none."""

    if CLEARANCE not in PLANNERS.entry(planner).supports:
        return None
    return requested_clearance(problem, clearance)


def load_and_plan(
    problem: Problem,
    planner: str,
    settings: Settings | None = None,
    weights: str | None = None,
    picture: bool = False,
    **request: Any,
) -> PlanResult:
    """Load a planner and plan, with a spinner that names what is compiled.

    picture: whether a picture follows. `request` holds arguments of `rd.plan`.
    """

    spinner = Spinner(f"planning with {planner}")
    with exit_on_interrupt(spinner.stop), spinner, compiling_ahead(picture):
        return load_planner(planner, settings, weights).plan(problem, **request)
