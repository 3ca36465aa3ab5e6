"""The commands `robotdiffuse plan` and `demo`."""

from dataclasses import fields, replace
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

from robotdiffuse.cli.arguments import (
    IGNORE_JOINTS,
    NO_PLAN,
    SOLVED,
    Commands,
    Namespace,
    add_import_option,
    command,
    jerk_limit,
    natural,
    not_negative,
    option,
    options,
    positive,
    share,
)
from robotdiffuse.cli.console import Spinner, print_next_view, print_result
from robotdiffuse.cli.view import ENDINGS, draw, show
from robotdiffuse.core.types import CONVERGED, FIRST, OBJECTIVES, TIME, UNTIL
from robotdiffuse.interop import WRITERS

if TYPE_CHECKING:
    from robotdiffuse.core.results import PlanResult
    from robotdiffuse.core.settings import Settings
    from robotdiffuse.problems.problem import Problem

RESULT_ENDINGS = (".json", ".csv", *ENDINGS, *WRITERS)


def add_plan(commands: Commands) -> None:
    parser = command(
        commands,
        "plan",
        "plan a motion for a problem file",
        "Plan a motion for a problem file; every motion found is verified. Exit status: 0 "
        "solved, 1 no plan, 2 bad input.",
        run_plan,
        ("problem PROBLEM", "problem file (.yaml, .json or .jsonl)"),
        ("--index INDEX", "which problem of a .jsonl file (default: 0)", natural, 0),
        ("--planner NAME", "see `robotdiffuse planner list` (default: robotdiffuse)"),
        (
            "--weights FOLDER",
            "weights of `robotdiffuse train`, for a learned planner, or panda_points, those of the package "
            "without clearances as inputs (default: the bundled ones)",
        ),
        (
            "--set NAME=VALUE *",
            "a setting of the planner; see `robotdiffuse planner info NAME`; repeatable",
            {"dest": "settings"},
        ),
        ("--time-limit S", "time limit for planning (default: 1 s)", positive, 1.0),
        (
            "--until",
            "stop at the first motion, when more time hardly improves it (default), or at the time limit",
            None,
            CONVERGED,
            {"choices": UNTIL},
        ),
        (
            "--clearance M",
            "distance to obstacles to keep where possible, up to 0.5 m (default: the problem's, or 0.01 m)",
            not_negative,
        ),
        (
            "--unknown POLICY",
            "policy for space that the problem's views do not show: optimistic (free), padded, predicted or "
            "occupied (default: the problem's; else predicted where the network covers the arm's reach, or "
            "padded)",
        ),
        ("--ignore-joints", IGNORE_JOINTS),
        ("--next-view", "propose a camera pose that shows most of the unknown space that the motion crosses"),
    )
    for rate in ("velocity", "acceleration"):
        parser.add_argument(
            f"--{rate}-scaling",
            type=share,
            default=1.0,
            metavar="X",
            help=f"fraction of the robot's {rate} limits to use, from 0.001 to 1 (default: 1)",
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
    options(
        parser,
        (
            "--blend R",
            "pass the problem's waypoints without stopping, within this distance: in rad for "
            "configurations, in m for poses (default: the problem's, or stop)",
            positive,
        ),
        ("--seed N", "random seed (default: 0)", natural, 0),
        (
            "--out FILE *",
            "file to write: result (.json), trajectory (.csv), replay (.html), picture (.png), or for other "
            "programs .mcap (Foxglove, ROS 2), .rosbag2, .rrd (Rerun) or .yaml (JointTrajectory); repeatable",
        ),
        ("--view", "write a replay (.html) and open it"),
    )
    add_import_option(parser)


def run_plan(arguments: Namespace) -> int:
    from robotdiffuse.planning import DEFAULT_PLANNER, PLANNERS, planner_settings
    from robotdiffuse.planning.context import PlanRequest

    name = arguments.planner or DEFAULT_PLANNER
    PLANNERS.entry(name)
    settings = planner_settings(name, arguments.settings) if arguments.settings else None
    outputs = _outputs(arguments)
    problem = _problem(arguments)
    request = {field.name: getattr(arguments, field.name) for field in fields(PlanRequest)}
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


def _outputs(arguments: Namespace) -> list[Path]:
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


def _problem(arguments: Namespace) -> "Problem":
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

    picture: whether a picture follows. `request` holds arguments of `rd.plan`.
    """
    from robotdiffuse.cli.compile_ahead import compiling_ahead
    from robotdiffuse.core.interrupts import exit_on_interrupt
    from robotdiffuse.planning import load_planner

    spinner = Spinner(f"planning with {planner}")
    with exit_on_interrupt(spinner.stop), spinner, compiling_ahead(picture):
        return load_planner(planner, settings, weights).plan(problem, **request)


PROBLEM_FILE = "shelf.yaml"
FAMILY = "shelf"
TIME_LIMIT = 10.0
"""Time limit for planning [s]."""
READY = "ready"
"""Where the arm of `demo --explore` starts, if it has such a pose."""
EXPLORE_TIME_LIMIT = 2.0
"""Time limit of each of its searches [s]."""
# Problems that are drawn for another arm, and the time limit of the search that tries each [s].
MAX_DRAWS = 50
DRAW_TIME_LIMIT = 1.0
# Position and target of the camera of `demo --camera` [m].
CAMERA_POSITION = (-0.5, 1.1, 1.2)
CAMERA_TARGET = (0.6, 0.0, 0.5)
# Width, height and focal length of its images [pixels].
IMAGE_SIZE = (640, 480)
FOCAL_LENGTH = 460.0


def add_demo(commands: Commands) -> None:
    parser = command(
        commands,
        "demo",
        "plan a bundled problem and draw the motion",
        "Plan a bundled problem with obstacles, and write demo.png and demo.html to the current "
        "folder; with --explore, see the obstacles by cameras on the way.",
        run_demo,
    )
    seen = parser.add_mutually_exclusive_group()
    options(
        seen,
        (
            "--camera",
            "plan with the view of one depth camera instead of the scene; demo_true.png shows the motion in "
            "the true scene",
        ),
        (
            "--explore",
            "simulate an arm that sees the shelf by a camera at its tip and looks before it moves; writes "
            "explore.png and explore.html",
        ),
    )
    option(
        parser,
        "--robot NAME",
        "plan with another arm, between shelves of its size; see `robotdiffuse robot list`",
    )


def run_demo(arguments: Namespace) -> int:
    from robotdiffuse.core.output_files import check_output
    from robotdiffuse.planning import DEFAULT_PLANNER
    from robotdiffuse.problems.files import load_problem

    names = ("explore.png", "explore.html") if arguments.explore else ("demo.png", "demo.html")
    outputs = [check_output(file, ENDINGS) for file in names]
    if arguments.robot is None:
        with resources.as_file(resources.files("robotdiffuse") / "examples" / PROBLEM_FILE) as file:
            problem = load_problem(file)
    else:
        problem = shelf_problem(arguments.robot)
    if arguments.explore:
        return explore_shelf(problem, outputs)
    true = problem
    if arguments.camera:
        outputs.append(check_output("demo_true.png", ENDINGS))
        problem = seen_by_camera(true)
    result = load_and_plan(problem, DEFAULT_PLANNER, picture=True, time_limit=TIME_LIMIT)
    print_result(result, asked_clearance(problem, DEFAULT_PLANNER))
    if result.trajectory is None or result.path is None:
        return NO_PLAN
    if arguments.camera:
        from robotdiffuse.validation.validator import verify

        violation = verify(true, result.path).violation
        print("in the true scene:", "free" if violation is None else violation.message)
    for file in outputs:
        draw(true if file.name == "demo_true.png" else problem, result, file)
        print(f"wrote {file.resolve()}")
    return 0


def explore_shelf(problem: "Problem", outputs: list[Path]) -> int:
    """Take the arm from where it is ready to the problem's goal through space that its cameras see on the
    way, and draw that."""
    from robotdiffuse.cli.explore import draw_exploration, simulate
    from robotdiffuse.planning.exploration.steps import LOOK, ExplorerSettings
    from robotdiffuse.problems.families.furniture import FLOOR
    from robotdiffuse.problems.problem import Problem
    from robotdiffuse.scenes.scene import Scene

    obstacles = [shape for shape in problem.scene.shapes if shape.name != FLOOR.name]
    start = READY if READY in problem.robot.poses else problem.start
    problem = Problem(problem.robot, Scene([FLOOR, *obstacles]), start, problem.goal)
    print("The arm knows the floor, and sees the rest by a camera at its tip and one beside it.")
    explorer, arrived = simulate(problem, ExplorerSettings(time_limit=EXPLORE_TIME_LIMIT), None, 0)
    looks = sum(act.step.kind == LOOK for act in explorer.acts)
    end = "is at the goal" if arrived else "is not at the goal"
    print(f"The arm {end}: {looks} looks, {len(explorer.views)} images, {explorer.duration:.1f} s in motion.")
    for file in outputs:
        draw_exploration(explorer, problem, file)
        print(f"wrote {file.resolve()}")
    return SOLVED if arrived else NO_PLAN


def shelf_problem(robot: str) -> "Problem":
    """A problem of the family shelf for another arm that the straight line does not solve and a search does.

    Raises InputError if none can be drawn for it.
    """
    import numpy as np

    from robotdiffuse.planning import load_planner
    from robotdiffuse.problems.families.scaled import family_for
    from robotdiffuse.robots import load_robot

    arm = load_robot(robot)
    rng = np.random.default_rng(0)
    search = load_planner("aorrtc")
    family = family_for(FAMILY, arm)
    with Spinner(f"drawing a problem for {arm.name}"):
        for _ in range(MAX_DRAWS):
            problem = family.draw(arm, rng).problem(arm)
            result = search.plan(problem, DRAW_TIME_LIMIT, until=FIRST)
            if result.solved and result.stage != "straight_line":
                return problem
    return problem


def seen_by_camera(problem: "Problem") -> "Problem":
    """The problem with one depth view, from behind the arm's shoulder, in place of its scene; the floor stays
    known."""
    import numpy as np

    from robotdiffuse.perception.ray_caster import looking_at, ray_cast
    from robotdiffuse.problems.families.furniture import FLOOR
    from robotdiffuse.problems.problem import PREDICTED
    from robotdiffuse.scenes.scene import Scene

    T_base_camera = looking_at(np.array(CAMERA_POSITION), np.array(CAMERA_TARGET))
    width, height = IMAGE_SIZE
    intrinsics = (FOCAL_LENGTH, FOCAL_LENGTH, (width - 1) / 2, (height - 1) / 2)
    true_scene = Scene([FLOOR, *problem.scene.shapes])
    view = ray_cast(true_scene, T_base_camera, intrinsics, IMAGE_SIZE, problem.robot, problem.start)
    return replace(problem, scene=Scene([FLOOR]), views=(view,), unknown=PREDICTED)
