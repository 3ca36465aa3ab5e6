"""The command `robotdiffuse explore`."""

from pathlib import Path

from robotdiffuse.cli.arguments import NO_PLAN, SOLVED, VIEW_ENDINGS, Namespace, chosen
from robotdiffuse.cli.command import LOOPBACK, PORT
from robotdiffuse.cli.view import open_in_browser
from robotdiffuse.core.errors import InputError
from robotdiffuse.core.output_files import check_output
from robotdiffuse.interop import WRITERS
from robotdiffuse.perception.depth_view import DepthNoise
from robotdiffuse.planning.exploration.simulated import RecordedExplorer, explore, simulated_explorer
from robotdiffuse.planning.exploration.steps import DONE, ExplorerSettings
from robotdiffuse.problems.files import load_problem
from robotdiffuse.problems.problem import Problem
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

        show_live(arguments, settings)
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

    views: dict[str, list[StampedView]] = {}
    for taken_view in explorer.views:
        views.setdefault("beside" if taken_view.camera is None else "wrist", []).append(
            StampedView(taken_view.time, taken_view.view)
        )
    write_depth_views(explorer.robot, views, file)
