"""robotdiffuse plan, robotdiffuse demo"""

import argparse
from dataclasses import replace
from importlib.resources import as_file, files
from pathlib import Path
from typing import TYPE_CHECKING, Any

from robotdiffuse.cli.arguments import natural, not_negative, positive, share
from robotdiffuse.cli.console import Waiting, print_next_view, print_result
from robotdiffuse.cli.drawing import ENDINGS, draw, show
from robotdiffuse.core.types import CONVERGED, UNTIL
from robotdiffuse.interop import WRITERS

if TYPE_CHECKING:
    from robotdiffuse.core.results import PlanResult
    from robotdiffuse.core.settings import Settings
    from robotdiffuse.problems.problem import Problem

RESULT_ENDINGS = (".json", ".csv", *ENDINGS, *WRITERS)
DEMO, DEMO_FAMILY = "shelf.yaml", "shelf"
DEMO_TIME_LIMIT = 10.0
"""[s]"""
DEMO_CAMERA, DEMO_TARGET = (-0.5, 1.1, 1.2), (0.6, 0.0, 0.5)
"""Where `demo --camera` looks from, and at [m]."""


def add_plan(commands: argparse._SubParsersAction) -> None:
    parser = commands.add_parser(
        "plan",
        help="plan the motion that a problem file asks for",
        description="Plan a verified motion. Exit status: 0 solved, 1 no plan, 2 bad input.",
    )
    parser.add_argument("problem", metavar="PROBLEM", help="problem file (.yaml, .json or .jsonl)")
    parser.add_argument(
        "--index", type=natural, default=0, help="which problem of a .jsonl file (default: 0)"
    )
    parser.add_argument(
        "--planner", metavar="NAME", help="see `robotdiffuse planners` (default: robotdiffuse)"
    )
    parser.add_argument(
        "--weights",
        metavar="FOLDER",
        help="of `train`, for a learned planner (default: bundled)",
    )
    parser.add_argument(
        "--set",
        dest="settings",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="a setting of the planner, see `robotdiffuse planners NAME`; repeatable",
    )
    parser.add_argument(
        "--time-limit", type=positive, default=1.0, metavar="S", help="wall time for planning (default: 1 s)"
    )
    parser.add_argument(
        "--until",
        choices=UNTIL,
        default=CONVERGED,
        help="end with the first motion, when more time stops paying (default), or with the time limit",
    )
    parser.add_argument(
        "--clearance",
        type=not_negative,
        metavar="M",
        help="distance to keep to obstacles where it can be kept (default: the problem's, or 0.01 m)",
    )
    parser.add_argument(
        "--unknown",
        metavar="POLICY",
        help="what space that the problem's views do not show is taken for: optimistic (free), padded, "
        "predicted or occupied (default: what the problem says, or optimistic)",
    )
    parser.add_argument(
        "--next-view",
        action="store_true",
        help="say where a camera sees most of the unknown space that the motion crosses",
    )
    for what in ("velocity", "acceleration"):
        parser.add_argument(
            f"--{what}-scaling",
            type=share,
            default=1.0,
            metavar="X",
            help=f"share of the robot's {what} limits that is used, above 0 and at most 1 (default: 1)",
        )
    parser.add_argument(
        "--jerk", type=positive, metavar="J", help="most jerk of any joint, in rad/s³ (default: no limit)"
    )
    parser.add_argument(
        "--blend",
        type=positive,
        metavar="R",
        help="pass the problem's waypoints within this without stopping, in rad from configurations, in m "
        "from poses (default: what the problem says, or stop)",
    )
    parser.add_argument("--seed", type=natural, default=0, metavar="N", help="random seed (default: 0)")
    parser.add_argument(
        "--out",
        action="append",
        default=[],
        metavar="FILE",
        help="result (.json), trajectory (.csv), replay (.html), picture (.png), or for other programs .mcap "
        "(Foxglove, ROS 2), .rosbag2, .rrd (Rerun) and .yaml (JointTrajectory); repeatable",
    )
    parser.add_argument("--view", action="store_true", help="write a replay (.html) and open it")
    parser.set_defaults(run=run_plan)


def add_demo(commands: argparse._SubParsersAction) -> None:
    parser = commands.add_parser(
        "demo",
        help="plan a bundled problem and draw the motion",
        description="Plan a bundled problem with obstacles; write demo.png and demo.html to this folder.",
    )
    parser.add_argument(
        "--camera",
        action="store_true",
        help="plan on what one depth camera sees of it; demo_true.png shows the motion in the true scene",
    )
    parser.add_argument(
        "--robot",
        metavar="NAME",
        help="plan with another arm between shelves that are drawn for it, see `robotdiffuse robot list`",
    )
    parser.set_defaults(run=run_demo)


def run_plan(arguments: argparse.Namespace) -> int:
    from robotdiffuse.core.output_files import check_output
    from robotdiffuse.interop import check_export, write_motion
    from robotdiffuse.planning import DEFAULT_PLANNER, PLANNERS, planner_settings
    from robotdiffuse.problems.files import load_problem, problem_record

    name = arguments.planner or DEFAULT_PLANNER
    PLANNERS.entry(name)
    settings = planner_settings(name, arguments.settings) if arguments.settings else None
    outputs = [
        check_export(file) if Path(file).suffix.lower() in WRITERS else check_output(file, RESULT_ENDINGS)
        for file in arguments.out
    ]
    if arguments.view:
        outputs.append(check_output(f"{Path(arguments.problem).stem}.html", ENDINGS))
    problem = load_problem(arguments.problem, arguments.index)
    if arguments.unknown is not None:
        problem = with_policy(problem, arguments.unknown)
    if arguments.blend is not None:
        problem = replace(problem, blend=arguments.blend)
    if arguments.next_view:
        check_seen("--next-view", problem)
    result = solve(
        problem,
        name,
        settings,
        arguments.weights,
        time_limit=arguments.time_limit,
        seed=arguments.seed,
        until=arguments.until,
        clearance=arguments.clearance,
        velocity_scaling=arguments.velocity_scaling,
        acceleration_scaling=arguments.acceleration_scaling,
        jerk=arguments.jerk,
    )
    print_result(result)
    if arguments.next_view and result.path is not None:
        print_next_view(problem, result)
    for file in outputs:
        if file.suffix.lower() == ".json":
            result.save(file, problem_record(problem))
        elif result.trajectory is None:
            continue
        elif file.suffix.lower() == ".csv":
            result.trajectory.save(file)
        elif file.suffix.lower() in WRITERS:
            write_motion(problem, result.trajectory, file)
        else:
            draw(problem, result, file)
        print(f"wrote {file}")
    if arguments.view and result.trajectory is not None:
        show(outputs[-1])
    return 0 if result.solved else 1


def with_policy(problem: "Problem", unknown: str) -> "Problem":
    """The problem with this policy for unknown space; InputError for an unknown one, and without views."""
    from robotdiffuse.problems.problem import check_unknown

    check_unknown("--unknown", unknown)
    check_seen(f"--unknown {unknown}", problem)
    return replace(problem, unknown=unknown)


def check_seen(option: str, problem: "Problem") -> None:
    """InputError for a problem without views."""
    from robotdiffuse.core.errors import InputError

    if not problem.views:
        raise InputError(f"{option} is for problems that cameras saw; this one has no views")


def run_demo(arguments: argparse.Namespace) -> int:
    from robotdiffuse.core.output_files import check_output
    from robotdiffuse.planning import DEFAULT_PLANNER
    from robotdiffuse.problems.files import load_problem

    outputs = [check_output(file, ENDINGS) for file in ("demo.png", "demo.html")]
    if arguments.robot is None:
        with as_file(files("robotdiffuse") / "examples" / DEMO) as file:
            problem = load_problem(file)
    else:
        problem = among_shelves(arguments.robot)
    true = problem
    if arguments.camera:
        outputs.append(check_output("demo_true.png", ENDINGS))
        problem = through_camera(true)
    result = solve(problem, DEFAULT_PLANNER, time_limit=DEMO_TIME_LIMIT)
    print_result(result)
    if result.trajectory is None or result.path is None:
        return 1
    if arguments.camera:
        from robotdiffuse.validation.validator import verify

        violation = verify(true, result.path).violation
        print("in the true scene:", "free" if violation is None else violation.message)
    for file in outputs:
        draw(true if file.name == "demo_true.png" else problem, result, file)
        print(f"wrote {file.resolve()}")
    return 0


def among_shelves(robot: str) -> "Problem":
    """A problem of the family shelf for another arm; InputError if none of them suits it."""
    import numpy as np

    from robotdiffuse.problems.families import load_family
    from robotdiffuse.robots import load_robot

    arm = load_robot(robot)
    return load_family(DEMO_FAMILY).draw(arm, np.random.default_rng(0)).problem(arm)


def through_camera(problem: "Problem") -> "Problem":
    """The problem with what a depth camera behind the arm's shoulder sees of the scene in place of it, and
    the floor, which is known."""
    import numpy as np

    from robotdiffuse.perception.ray_caster import looking_at, ray_cast
    from robotdiffuse.problems.families.furniture import FLOOR
    from robotdiffuse.problems.problem import PREDICTED
    from robotdiffuse.scenes.scene import Scene

    T_base_camera = looking_at(np.array(DEMO_CAMERA), np.array(DEMO_TARGET))
    width, height = 640, 480
    intrinsics = (460.0, 460.0, (width - 1) / 2, (height - 1) / 2)
    stands = Scene([FLOOR, *problem.scene.shapes])
    view = ray_cast(stands, T_base_camera, intrinsics, (width, height), problem.robot, problem.start)
    return replace(problem, scene=Scene([FLOOR]), views=(view,), unknown=PREDICTED)


def solve(
    problem: "Problem",
    planner: str,
    settings: "Settings | None" = None,
    weights: str | None = None,
    **request: Any,
) -> "PlanResult":
    """Load the planner, with settings or weights of its own, and plan as the request says (the arguments of
    `Planner.plan`), behind a spinner.

    The compiled code is loaded before, or compiled on a new machine, which would otherwise use up the limit.
    """
    from robotdiffuse.core.processes import exit_on_interrupt
    from robotdiffuse.planning import load_planner
    from robotdiffuse.planning.planner import compiles_first

    loading = Waiting(f"loading compiled code ({compiles_first(problem.robot)})")
    with exit_on_interrupt(loading.stop), loading:
        loaded = load_planner(planner, settings, weights)
        loaded.warm_up(problem)
    with Waiting(f"planning with {planner}"):
        return loaded.plan(problem, **request)
