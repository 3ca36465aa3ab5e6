"""The command `robotdiffuse explore`."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from robotdiffuse.cli.exit_status import NO_PLAN, SOLVED

if TYPE_CHECKING:
    from robotdiffuse.planning.exploration.explorer import Explorer
    from robotdiffuse.planning.exploration.simulated import Event
    from robotdiffuse.problems.problem import Problem

FLOOR = "floor"
"""Shapes of this name are known without being seen."""
TITLE_LENGTH = 60
"""Of pictures [characters]."""
FREE_ZONE = ((-0.36, -0.36, 0.0), (0.36, 0.36, 0.7))
"""The space around the base that is declared free [m]."""


def add(commands: argparse._SubParsersAction) -> None:
    parser = commands.add_parser(
        "explore",
        help="simulate an arm that sees its scene by a camera at its tip",
        description="Simulate an arm that goes from a problem's start to its goal and knows of the scene "
        "only what depth cameras have seen: one at its tip, and one beside it that takes one image. Shapes "
        "named floor are known. Each motion is validated in the true scene. Exit status: 0 at the goal, 1 "
        "not, 2 bad input.",
    )
    parser.add_argument("problem", metavar="PROBLEM", help="problem file")
    parser.add_argument(
        "--policy",
        default="strict",
        help="strict: only through space seen free; chance: where the stated confidence is high; "
        "strict_then_chance (default: strict)",
    )
    parser.add_argument("--confidence", type=float, default=0.98, metavar="P", help="least, of chance (0.98)")
    parser.add_argument("--time-limit", type=float, default=1.0, metavar="S", help="of each search (1)")
    parser.add_argument("--noise", action="store_true", help="simulate the noise of depth cameras")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="random seed")
    parser.add_argument(
        "--out", metavar="FOLDER", help="draw each motion among what was seen then: step_1.png and so on"
    )
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    from robotdiffuse.perception.depth_noise import DepthNoise
    from robotdiffuse.planning.exploration.explorer import DONE, Explorer, ExplorerSettings
    from robotdiffuse.planning.exploration.simulated import camera_beside, explore, wrist_camera
    from robotdiffuse.problems.files import load_problem
    from robotdiffuse.scenes.scene import Scene

    problem = load_problem(arguments.problem)
    settings = ExplorerSettings(arguments.policy, arguments.confidence, arguments.time_limit)
    known = Scene([shape for shape in problem.scene.shapes if shape.name == FLOOR])
    cameras = [wrist_camera(problem.robot)]
    explorer = Explorer(problem.robot, cameras, known, FREE_ZONE, settings, arguments.seed)
    noise = DepthNoise() if arguments.noise else None
    explorer.observe(camera_beside(problem, noise, arguments.seed))
    folder = None if arguments.out is None else Path(arguments.out)
    reached, free = False, True
    for number, event in enumerate(explore(problem, explorer, noise, arguments.seed), 1):
        print_event(number, event, explorer)
        if folder is not None and event.step.motion is not None:
            draw_event(problem, event, folder / f"step_{number}.png")
        reached, free = event.step.kind == DONE, free and event.free
    return SOLVED if reached and free else NO_PLAN


def print_event(number: int, event: "Event", explorer: "Explorer") -> None:
    """Print a step, and what is known after it."""
    seen = explorer.map
    print(f"{number}. {event.step.kind}: {event.step.reason}")
    if event.step.motion is not None:
        print(f"   {event.step.motion.duration or 0.0:.2f} s; in the true scene: {event.violation or 'free'}")
    shares = (100 * part.mean() for part in (seen.free, seen.unknown))
    print("   of the map {:.0f} % seen free, {:.0f} % unknown".format(*shares))


def draw_event(problem: "Problem", event: "Event", file: Path) -> None:
    """Draw a step's motion among what was seen when it was planned."""
    from robotdiffuse.core.output_files import check_output
    from robotdiffuse.visualization.picture import write_picture

    motion = event.step.motion
    assert motion is not None and motion.path is not None
    assert event.step.seen is not None
    file.parent.mkdir(parents=True, exist_ok=True)
    write_picture(
        problem.robot,
        event.step.seen,
        motion.trajectory or motion.path,
        check_output(file, (".png",)),
        title=f"{event.step.kind}: {event.step.reason}"[:TITLE_LENGTH],
    )
    print(f"   wrote {file}")
