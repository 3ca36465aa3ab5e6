"""The commands `robotdiffuse explore` and `demo`."""

from dataclasses import replace
from importlib import resources
from pathlib import Path

import numpy as np

from robotdiffuse.cli.arguments import LOOPBACK, NO_PLAN, PORT, SOLVED, VIEW_ENDINGS, Namespace, chosen
from robotdiffuse.cli.console import Spinner, print_result
from robotdiffuse.cli.plan import asked_clearance, load_and_plan
from robotdiffuse.cli.view import draw, open_in_browser
from robotdiffuse.core.errors import InputError
from robotdiffuse.core.files import check_output
from robotdiffuse.core.types import FIRST
from robotdiffuse.interop import WRITERS
from robotdiffuse.perception.depth_view import DepthNoise
from robotdiffuse.planning import DEFAULT_PLANNER, load_planner
from robotdiffuse.planning.exploration.simulated import (
    RecordedExplorer,
    explore,
    seen_from_beside,
    simulated_explorer,
)
from robotdiffuse.planning.exploration.steps import DONE, LOOK, ExplorerSettings
from robotdiffuse.problems.families.furniture import FLOOR
from robotdiffuse.problems.families.scaled import family_for
from robotdiffuse.problems.files import load_problem
from robotdiffuse.problems.problem import PREDICTED, Problem
from robotdiffuse.robots import load_robot
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.validation.validator import verify
from robotdiffuse.visualization.exploration import write_exploration, write_exploration_picture

RECORDING = ".mcap"


def run_explore(arguments: Namespace) -> int:
    outputs = [check_output(file, VIEW_ENDINGS) for file in arguments.out]
    if arguments.view:
        outputs.append(check_output(f"{Path(arguments.problem).stem}.html", VIEW_ENDINGS))
    recording = None
    if arguments.record:
        recording = check_output(arguments.record, (RECORDING,))
        WRITERS.load(RECORDING)  # checks for its packages
    settings = ExplorerSettings(**chosen(arguments, ExplorerSettings.__dataclass_fields__))
    if arguments.live:
        if outputs or recording is not None:
            raise InputError("--live writes no files; leave out --out, --view and --record")
        from robotdiffuse.cli.live import show_live

        show_live(arguments, settings)  # does not return
    elif (arguments.speed, arguments.host, arguments.port) != (1.0, LOOPBACK, PORT):
        raise InputError("--speed, --host and --port say how --live is served; add --live")
    problem = load_problem(arguments.problem)
    noise = DepthNoise() if arguments.noise else None
    explorer, arrived = simulate(problem, settings, noise, arguments.seed)
    for file in outputs:
        draw_exploration(explorer, problem, file)
        print(f"wrote {file}")
    if recording is not None:
        record(explorer, recording)
        print(f"wrote {recording}")
    if arguments.view:
        open_in_browser(outputs[-1])
    return SOLVED if arrived else NO_PLAN


def simulate(
    problem: Problem, settings: ExplorerSettings, noise: DepthNoise | None, seed: int
) -> tuple[RecordedExplorer, bool]:
    """Simulate the loop and print its steps; returns the explorer, and whether the arm got to the goal
    without a collision."""

    explorer = simulated_explorer(problem, settings, noise, seed)
    reached = False
    free = True
    for number, event in enumerate(explore(problem, explorer, noise, seed), 1):
        print(f"{number}. {event.step.kind}: {event.step.reason}")
        if event.step.motion is not None:
            print(
                f"   {event.step.motion.duration or 0:.2f} s; in the true scene: {event.violation or 'free'}"
            )
        shares = (100 * part.mean() for part in (explorer.map.free, explorer.map.unknown))
        print("   of the map {:.0f} % seen free, {:.0f} % unknown".format(*shares))
        reached = event.step.kind == DONE
        free = free and event.free
    return explorer, reached and free


def draw_exploration(explorer: RecordedExplorer, problem: Problem, file: Path) -> None:
    """Draw an exploration as a replay or a strip of pictures, as the ending of the file says."""
    write = write_exploration if file.suffix.lower() == ".html" else write_exploration_picture
    write(explorer, problem.scene, file)


def record(explorer: RecordedExplorer, file: Path) -> None:
    """Write all views that an explorer observed; the camera on the arm is `wrist`, others are `beside`."""
    from robotdiffuse.interop.depth_recording import StampedView, write_depth_views

    views = dict[str, list[StampedView]]()
    for taken_view in explorer.views:
        views.setdefault("beside" if taken_view.camera is None else "wrist", []).append(
            StampedView(taken_view.time, taken_view.view)
        )
    write_depth_views(explorer.robot, views, file)


PROBLEM_FILE = "shelf.yaml"
FAMILY = "shelf"
TIME_LIMIT = 10.0
"""Time limit for planning [s]."""
READY = "ready"
"""Named pose at which `demo --explore` starts, if the robot has it."""
EXPLORE_TIME_LIMIT = 2.0
"""Time limit of each search of `demo --explore` [s]."""
# Largest number of random problems tried for another arm, and the time limit of the search for each [s].
MAX_DRAWS = 50
DRAW_TIME_LIMIT = 1.0


def run_demo(arguments: Namespace) -> int:
    names = ("explore.png", "explore.html") if arguments.explore else ("demo.png", "demo.html")
    outputs = [check_output(file, VIEW_ENDINGS) for file in names]
    if arguments.robot is None:
        with resources.as_file(resources.files("robotdiffuse") / "examples" / PROBLEM_FILE) as file:
            problem = load_problem(file)
    else:
        problem = shelf_problem(arguments.robot)
    if arguments.explore:
        return explore_shelf(problem, outputs)
    true_problem = problem
    if arguments.camera:
        outputs.append(check_output("demo_true.png", VIEW_ENDINGS))
        # one depth view from beside the arm in place of the scene; the floor stays known
        view = seen_from_beside(replace(problem, scene=Scene([FLOOR, *problem.scene.shapes])))
        problem = replace(problem, scene=Scene([FLOOR]), views=(view,), unknown=PREDICTED)
    result = load_and_plan(problem, DEFAULT_PLANNER, picture=True, time_limit=TIME_LIMIT)
    print_result(result, asked_clearance(problem, DEFAULT_PLANNER))
    if result.trajectory is None:
        return NO_PLAN
    if arguments.camera:
        violation = verify(true_problem, result.path).violation
        print("in the true scene:", "free" if violation is None else violation.message)
    for file in outputs:
        draw(true_problem if file.name == "demo_true.png" else problem, result, file)
        print(f"wrote {file.resolve()}")
    return 0


def explore_shelf(problem: Problem, outputs: list[Path]) -> int:
    """Move the arm from its ready pose to the problem's goal, through space that its cameras observe on the
    way, and draw the exploration."""
    obstacles = [shape for shape in problem.scene.shapes if shape.name != FLOOR.name]
    start = READY if READY in problem.robot.poses else problem.start
    problem = Problem(problem.robot, Scene([FLOOR, *obstacles]), start, problem.goal)
    print("The arm knows the floor. A camera at its tip and one beside the arm observe the rest.")
    explorer, arrived = simulate(problem, ExplorerSettings(time_limit=EXPLORE_TIME_LIMIT), None, 0)
    views = sum(record.step.kind == LOOK for record in explorer.steps)
    end = "is at the goal" if arrived else "is not at the goal"
    print(
        f"The arm {end} after {explorer.duration:.1f} s; viewpoints: {views}, images: {len(explorer.views)}."
    )
    for file in outputs:
        draw_exploration(explorer, problem, file)
        print(f"wrote {file.resolve()}")
    return SOLVED if arrived else NO_PLAN


def shelf_problem(robot: str) -> Problem:
    """A problem of the family shelf for another arm. A search solves it, and the straight line does not.

    After MAX_DRAWS without such a problem, returns the last one. Raises InputError if the family has no
    problems for the arm.
    """
    arm = load_robot(robot)
    rng = np.random.default_rng(0)
    search = load_planner("aorrtc")
    family = family_for(FAMILY, arm)
    with Spinner(f"choosing a random problem for {arm.name}"):
        for _ in range(MAX_DRAWS):
            problem = family.draw(arm, rng).problem(arm)
            result = search.plan(problem, DRAW_TIME_LIMIT, until=FIRST)
            if result.solved and result.stage != "straight_line":
                return problem
    return problem
