"""The command `robotdiffuse plan`."""

import argparse
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from robotdiffuse.cli.arguments import (
    IGNORE_JOINTS,
    add_import_option,
    command,
    jerk_limit,
    natural,
    not_negative,
    option,
    positive,
    share,
)
from robotdiffuse.cli.console import Spinner, print_next_view, print_result
from robotdiffuse.cli.drawing import ENDINGS, draw, show
from robotdiffuse.cli.exit_status import NO_PLAN, SOLVED
from robotdiffuse.core.types import CONVERGED, OBJECTIVES, TIME, UNTIL
from robotdiffuse.interop import WRITERS

if TYPE_CHECKING:
    from robotdiffuse.core.results import PlanResult
    from robotdiffuse.core.settings import Settings
    from robotdiffuse.problems.problem import Problem

RESULT_ENDINGS = (".json", ".csv", *ENDINGS, *WRITERS)
REQUEST = (
    *(
        "time_limit",
        "seed",
        "until",
        "clearance",
        "velocity_scaling",
        "acceleration_scaling",
        "jerk",
        "objective",
    ),
)
"""Options that are arguments of `Planner.plan`."""


def add(commands: argparse._SubParsersAction) -> None:
    parser = command(
        commands,
        "plan",
        "plan a motion for a problem file",
        "Plan a motion for a problem file; every motion found is verified. Exit status: 0 "
        "solved, 1 no plan, 2 bad input.",
        run,
    )
    option(parser, "problem PROBLEM", "problem file (.yaml, .json or .jsonl)")
    option(parser, "--index INDEX", "which problem of a .jsonl file (default: 0)", natural, 0)
    option(parser, "--planner NAME", "see `robotdiffuse planners` (default: robotdiffuse)")
    option(
        parser,
        "--weights FOLDER",
        "weights of `robotdiffuse train`, for a learned planner, or panda_points, those of the package "
        "without clearances as inputs (default: the bundled ones)",
    )
    option(
        parser,
        "--set NAME=VALUE *",
        "a setting of the planner; see `robotdiffuse planners NAME`; repeatable",
        dest="settings",
    )
    option(parser, "--time-limit S", "time limit for planning (default: 1 s)", positive, 1.0)
    option(
        parser,
        "--until",
        "stop at the first motion, when more time hardly improves it (default), or at the time limit",
        default=CONVERGED,
        choices=UNTIL,
    )
    option(
        parser,
        "--clearance M",
        "distance to obstacles to keep where possible, up to 0.5 m (default: the problem's, or 0.01 m)",
        not_negative,
    )
    option(
        parser,
        "--unknown POLICY",
        "policy for space that the problem's views do not show: optimistic (free), padded, predicted or "
        "occupied (default: the problem's; else predicted where the network covers the arm's reach, or "
        "padded)",
    )
    option(parser, "--ignore-joints", IGNORE_JOINTS)
    option(
        parser,
        "--next-view",
        "propose a camera pose that shows most of the unknown space that the motion crosses",
    )
    for what in ("velocity", "acceleration"):
        parser.add_argument(
            f"--{what}-scaling",
            type=share,
            default=1.0,
            metavar="X",
            help=f"fraction of the robot's {what} limits to use, from 0.001 to 1 (default: 1)",
        )
    option(
        parser,
        "--jerk J",
        "jerk limit of each joint, at least 0.01 rad/s³, or none (default: the robot's limits)",
        jerk_limit,
    )
    option(
        parser,
        "--objective",
        "what searches minimize: the path's length or the motion's duration (default: time)",
        default=TIME,
        choices=OBJECTIVES,
    )
    option(
        parser,
        "--blend R",
        "pass the problem's waypoints without stopping, within this distance: in rad for "
        "configurations, in m for poses (default: the problem's, or stop)",
        positive,
    )
    option(parser, "--seed N", "random seed (default: 0)", natural, 0)
    option(
        parser,
        "--out FILE *",
        "file to write: result (.json), trajectory (.csv), replay (.html), picture (.png), or for other "
        "programs .mcap (Foxglove, ROS 2), .rosbag2, .rrd (Rerun) or .yaml (JointTrajectory); repeatable",
    )
    option(parser, "--view", "write a replay (.html) and open it")
    add_import_option(parser)


def run(arguments: argparse.Namespace) -> int:
    from robotdiffuse.planning import DEFAULT_PLANNER, PLANNERS, planner_settings

    name = arguments.planner or DEFAULT_PLANNER
    PLANNERS.entry(name)
    settings = planner_settings(name, arguments.settings) if arguments.settings else None
    outputs = _outputs(arguments)
    problem = _problem(arguments)
    request = {option: getattr(arguments, option) for option in REQUEST}
    picture = any(file.suffix.lower() == ".png" for file in outputs)
    result = load_and_plan(problem, name, settings, arguments.weights, picture, **request)
    written = [file for file in outputs if _write(problem, result, file)]  # first: `| head` ends what prints
    print_result(result, asked_clearance(problem, name, arguments.clearance))
    if arguments.next_view and result.path is not None:
        print_next_view(problem, result)
    for file in outputs:
        print(f"wrote {file}" if file in written else f"not written: {file}: there is no motion")
    if arguments.view:
        show(outputs[-1])
    return SOLVED if result.solved else NO_PLAN


def _outputs(arguments: argparse.Namespace) -> list[Path]:
    """All files to write. Raises InputError for one that cannot be written."""
    from robotdiffuse.core.output_files import check_output
    from robotdiffuse.interop import check_export

    files = [
        check_export(file) if Path(file).suffix.lower() in WRITERS else check_output(file, RESULT_ENDINGS)
        for file in arguments.out
    ]
    if arguments.view:
        files.append(check_output(f"{Path(arguments.problem).stem}.html", ENDINGS))
    return files


def _problem(arguments: argparse.Namespace) -> "Problem":
    """The problem of the file, changed by --unknown and --blend."""
    from robotdiffuse.problems.files import load_problem

    problem = load_problem(arguments.problem, arguments.index, arguments.ignore_joints)
    if arguments.unknown is not None:
        problem = with_policy(problem, arguments.unknown)
    if arguments.next_view:
        check_views("--next-view", problem)
    return problem if arguments.blend is None else replace(problem, blend=arguments.blend)


def _write(problem: "Problem", result: "PlanResult", file: Path) -> bool:
    """Write a file by its ending; returns False for one that needs a motion if there is none."""
    from robotdiffuse.interop import write_motion

    ending = file.suffix.lower()
    if ending == ".json":
        result.save(file)
    elif ending in ENDINGS:
        draw(problem, result, file)
    elif result.trajectory is None:
        return False
    else:
        write_motion(problem, result.trajectory, file)
    return True


def asked_clearance(problem: "Problem", planner: str, clearance: float | None = None) -> float | None:
    """The clearance that a call asks for, the problem's or the default one [m]; None for a planner that keeps
    none."""
    from robotdiffuse.planning import CLEARANCE, PLANNERS
    from robotdiffuse.planning.context import requested_clearance

    if CLEARANCE not in PLANNERS.entry(planner).supports:
        return None
    return requested_clearance(problem, clearance)


def with_policy(problem: "Problem", unknown: str) -> "Problem":
    """The problem with this policy for unknown space.

    Raises InputError for an unknown policy, and for a problem without views.
    """
    from robotdiffuse.problems.problem import check_unknown

    check_unknown("--unknown", unknown)
    check_views(f"--unknown {unknown}", problem)
    return replace(problem, unknown=unknown)


def check_views(option: str, problem: "Problem") -> None:
    """Raises InputError for a problem without views."""
    from robotdiffuse.core.errors import InputError

    if not problem.views:
        raise InputError(f"{option} needs a problem with views; this one has none")


def load_and_plan(
    problem: "Problem",
    planner: str,
    settings: "Settings | None" = None,
    weights: str | None = None,
    picture: bool = False,
    **request: Any,
) -> "PlanResult":
    """Load a planner and plan, with a spinner that names what is compiled.

    picture: whether a picture follows. `request` holds arguments of `Planner.plan`.
    """
    from robotdiffuse.cli.compile_ahead import compiling_ahead
    from robotdiffuse.core.processes import exit_on_interrupt
    from robotdiffuse.planning import load_planner

    spinner = Spinner(f"planning with {planner}")
    with exit_on_interrupt(spinner.stop), spinner, compiling_ahead(picture):
        return load_planner(planner, settings, weights).plan(problem, **request)
