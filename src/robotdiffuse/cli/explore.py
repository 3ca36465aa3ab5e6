"""The commands `robotdiffuse live` and `explore`."""

import os
import signal
import sys
import threading
from argparse import ArgumentTypeError
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from robotdiffuse.cli.arguments import (
    NO_PLAN,
    SOLVED,
    STOPPED,
    ActionsContainer,
    Commands,
    Namespace,
    command,
    option,
    options,
    positive,
)
from robotdiffuse.cli.view import ENDINGS, show
from robotdiffuse.core.errors import InputError
from robotdiffuse.interop import WRITERS

if TYPE_CHECKING:
    from robotdiffuse.perception.depth_view import DepthNoise
    from robotdiffuse.planning.exploration.simulated import Event, RecordedExplorer
    from robotdiffuse.planning.exploration.steps import ExplorerSettings
    from robotdiffuse.problems.problem import Problem
    from robotdiffuse.visualization.live.exploration import ExplorationPage
    from robotdiffuse.visualization.live.page import Page

LOOPBACK = "127.0.0.1"
PORT = 8080


def add_live(commands: Commands) -> None:
    parser = command(
        commands,
        "live",
        "plan interactively in the browser",
        "Serve an interactive page until Ctrl-C. Drag the target, the start and obstacles: the "
        "page plans again after each change and shows at once whether the current motion is still valid. "
        "Without PROBLEM, it shows the demo problem.",
        run_live,
        ("problem PROBLEM", "problem file (.yaml or .json) to open", {"nargs": "?"}),
        ("--robot NAME", "instead of PROBLEM: name or URDF file of an arm"),
        ("--planner NAME", "planner; see `robotdiffuse planner list` (default: robotdiffuse)"),
        ("--time-limit S", "time limit of each plan (default: 1 s)", positive, 1.0),
    )
    add_address(parser)


def add_address(parser: ActionsContainer) -> None:
    """Add the options that say where a page is served."""
    option(
        parser,
        "--host ADDRESS",
        "address to listen on (default: 127.0.0.1, this machine only); on other addresses the URL of "
        "the page ends with a secret token that every visitor needs",
        default=LOOPBACK,
    )
    option(parser, "--port N", f"port; 0 for any free one (default: {PORT})", port, PORT)


def port(text: str) -> int:
    """An integer from 0 to 65535."""
    if not (text.isascii() and text.isdecimal() and int(text) < 2**16):
        raise ArgumentTypeError(f"{text!r} is not a port, an integer from 0 to 65535")
    return int(text)


def run_live(arguments: Namespace) -> NoReturn:
    require_viser("live")
    from rich.console import Console

    from robotdiffuse.planning import DEFAULT_PLANNER, PLANNERS
    from robotdiffuse.visualization.live.page import Page
    from robotdiffuse.visualization.live.server import PageServer, free_port
    from robotdiffuse.visualization.live.session import PageOptions, Session, first_problem

    planner = arguments.planner or DEFAULT_PLANNER
    PLANNERS.entry(planner)
    options = PageOptions(planner, arguments.time_limit)
    number = free_port(arguments.host, arguments.port)
    with Console(stderr=True).status("loading the robot (preparing a new URDF takes a minute)"):
        problem = first_problem(arguments.problem, arguments.robot)
    serve_until_stopped(Page(Session(problem, options), PageServer(arguments.host, number)))


def require_viser(command: str) -> None:
    """Raises InputError if viser is not installed."""
    try:
        import robotdiffuse.visualization.live.server  # noqa: F401
    except ModuleNotFoundError as error:
        if error.name != "viser":
            raise
        raise InputError(f"{command} needs viser: pip install 'robotdiffuse[live]'") from None


def serve_until_stopped(page: "Page | ExplorationPage") -> NoReturn:
    """Print the address of a page, serve it until Ctrl-C, and end the process."""
    ended = threading.Event()
    for stop_signal in (signal.SIGINT, signal.SIGTERM):
        signal.signal(stop_signal, lambda *_: ended.set())
    print(f"the page is at {page.server.url} (stop with Ctrl-C)", flush=True)
    ended.wait()
    page.close()
    print("robotdiffuse: stopped", file=sys.stderr, flush=True)
    os._exit(STOPPED)  # a normal exit would wait for threads that plan or compile


RECORDING = ".mcap"


def add_explore(commands: Commands) -> None:
    parser = command(
        commands,
        "explore",
        "explore an unknown scene with a simulated wrist camera",
        "Simulate an arm that goes from a problem's start to its goal and knows of the scene "
        "only what depth cameras have seen: one at its tip, and one beside it that takes one image. Shapes "
        "named floor are known. Each motion is validated in the true scene. Exit status: 0 at the goal, 1 "
        "not, 2 bad input.",
        run_explore,
        ("problem PROBLEM", "problem file"),
        (
            "--policy POLICY",
            "strict: only through space that was seen free; probabilistic: where the stated confidence is "
            "high; strict_then_probabilistic (default: strict)",
            None,
            "strict",
        ),
        ("--confidence P", "minimum confidence for policy probabilistic (default: 0.98)", float, 0.98),
        (
            "--see-goal",
            "go only to goals at which all of the arm's surface was seen to be free (policy strict)",
        ),
        ("--time-limit S", "time limit of each search [s] (default: 1)", float, 1.0),
        ("--noise", "simulate the noise of depth cameras"),
        ("--seed N", "random seed", int, 0),
        (
            "--out FILE *",
            "replay with what was known at each time (.html), or a strip of pictures, one a step (.png); "
            "repeatable",
        ),
        ("--view", "write a replay (.html) and open it"),
        (
            "--record FILE",
            "write the depth images with camera parameters, poses and joint states to this .mcap file",
        ),
    )
    live = parser.add_argument_group("live page")
    options(
        live,
        (
            "--live",
            "serve a page that shows the exploration while it happens, until Ctrl-C; it begins when the "
            "page is first opened",
        ),
        ("--speed X", "speed of the motions on it (1: real time)", positive, 1.0),
    )
    add_address(live)


def run_explore(arguments: Namespace) -> int:
    from robotdiffuse.core.output_files import check_output
    from robotdiffuse.perception.depth_view import DepthNoise
    from robotdiffuse.planning.exploration.steps import ExplorerSettings
    from robotdiffuse.problems.files import load_problem

    outputs = [check_output(file, ENDINGS) for file in arguments.out]
    if arguments.view:
        outputs.append(check_output(f"{Path(arguments.problem).stem}.html", ENDINGS))
    recording = None
    if arguments.record is not None:
        recording = check_output(arguments.record, (RECORDING,))
        WRITERS.load(RECORDING)  # its packages are installed
    settings = ExplorerSettings(
        arguments.policy, arguments.confidence, arguments.time_limit, see_goal=arguments.see_goal
    )
    if arguments.live:
        if outputs or recording is not None:
            raise InputError("--live writes no files; leave out --out, --view and --record")
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
        show(outputs[-1])
    return SOLVED if arrived else NO_PLAN


def show_live(arguments: Namespace, settings: "ExplorerSettings") -> NoReturn:
    """Serve the page of an exploration until Ctrl-C."""
    require_viser("explore --live")
    from robotdiffuse.problems.files import load_problem
    from robotdiffuse.visualization.live.exploration import ExplorationPage, ExplorationSession
    from robotdiffuse.visualization.live.server import PageServer, free_port

    number = free_port(arguments.host, arguments.port)
    problem = load_problem(arguments.problem)
    session = ExplorationSession(problem, settings, arguments.noise, arguments.seed, arguments.speed)
    serve_until_stopped(ExplorationPage(session, PageServer(arguments.host, number)))


def simulate(
    problem: "Problem", settings: "ExplorerSettings", noise: "DepthNoise | None", seed: int
) -> "tuple[RecordedExplorer, bool]":
    """Simulate the loop and print its steps; returns the explorer, and whether the arm got to the goal
    without a collision."""
    from robotdiffuse.planning.exploration.simulated import explore, simulated_explorer
    from robotdiffuse.planning.exploration.steps import DONE

    explorer = simulated_explorer(problem, settings, noise, seed)
    reached = False
    free = True
    for number, event in enumerate(explore(problem, explorer, noise, seed), 1):
        print_event(number, event, explorer)
        reached = event.step.kind == DONE
        free = free and event.free
    return explorer, reached and free


def print_event(number: int, event: "Event", explorer: "RecordedExplorer") -> None:
    """Print a step, and what is known after it."""
    seen = explorer.map
    print(f"{number}. {event.step.kind}: {event.step.reason}")
    if event.step.motion is not None:
        print(f"   {event.step.motion.duration or 0.0:.2f} s; in the true scene: {event.violation or 'free'}")
    shares = (100 * part.mean() for part in (seen.free, seen.unknown))
    print("   of the map {:.0f} % seen free, {:.0f} % unknown".format(*shares))


def draw_exploration(explorer: "RecordedExplorer", problem: "Problem", file: Path) -> None:
    """Draw an exploration as a replay or a strip of pictures, as the ending of the file says."""
    if file.suffix.lower() == ".html":
        from robotdiffuse.visualization.exploration import write_exploration as write
    else:
        from robotdiffuse.visualization.exploration import write_exploration_picture as write
    write(explorer, problem.scene, file)


def record(explorer: "RecordedExplorer", file: Path) -> None:
    """Write all views that an explorer observed; the camera on the arm is `wrist`, others are `beside`."""
    from robotdiffuse.interop.depth_recording import StampedView, write_depth_views

    views: dict[str, list[StampedView]] = {}
    for one in explorer.views:
        views.setdefault("beside" if one.camera is None else "wrist", []).append(
            StampedView(one.time, one.view)
        )
    write_depth_views(explorer.robot, views, file)
