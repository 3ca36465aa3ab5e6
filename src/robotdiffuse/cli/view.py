"""The commands `robotdiffuse view` and `simulate`; results as replays (.html) and pictures (.png)."""

import os
import sys
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from robotdiffuse.cli.arguments import (
    NO_PLAN,
    SOLVED,
    Commands,
    Namespace,
    command,
    not_negative,
)
from robotdiffuse.core.errors import InputError

if TYPE_CHECKING:
    from robotdiffuse.core.results import PlanResult
    from robotdiffuse.core.types import Path as PathOfJoints
    from robotdiffuse.core.types import Trajectory
    from robotdiffuse.problems.problem import Problem
    from robotdiffuse.robots.robot import Robot
    from robotdiffuse.scenes.scene import Scene
    from robotdiffuse.simulation.replay import Replay

ENDINGS = (".html", ".png")


def draw(problem: "Problem", result: "PlanResult | None", file: Path) -> None:
    """Draw the motion of a result in its scene, as the ending of the file says; without a motion, the start,
    the goal and the links that collide.

    For a problem with views and the policy `predicted`, the predicted obstacles are drawn too.
    """
    if result is None or result.path is None:
        from robotdiffuse.visualization.replay_page import write_problem

        return write_problem(problem, file, result)
    if file.suffix.lower() == ".html":
        from robotdiffuse.visualization.replay_page import write_replay as write
    else:
        from robotdiffuse.visualization.picture import write_picture as write
    robot, scene = _shown(problem)
    write(robot, scene, _motion(result), file, result=result, moving=problem.moving_in_world)


def draw_several(problem: "Problem", results: "Mapping[str, PlanResult]", file: Path, shell: float) -> None:
    """Draw the motions of several solved results, by name, in the scene of one problem: in one picture, or as
    replays side by side.

    shell: thickness of the safety shell about the arm in pictures [m].
    """
    robot, scene = _shown(problem)
    motions = {name: _motion(result) for name, result in results.items()}
    if file.suffix.lower() == ".html":
        from robotdiffuse.visualization.replay_page import GalleryEntry, write_gallery

        entries = [
            GalleryEntry(name, results[name].planner, scene, motion, problem.moving_in_world)
            for name, motion in motions.items()
        ]
        write_gallery(robot, entries, file, robot.name)
    else:
        from robotdiffuse.visualization.picture import PictureSettings, write_comparison

        settings = PictureSettings(shell=shell)
        write_comparison(robot, scene, motions, file, settings=settings, moving=problem.moving_in_world)


def _motion(result: "PlanResult") -> "PathOfJoints | Trajectory":
    motion = result.trajectory or result.path
    assert motion is not None, "only a solved result has a motion"
    return motion


def _shown(problem: "Problem") -> "tuple[Robot, Scene]":
    """The robot and the scene of a problem, with predicted obstacles if there are any."""
    if problem.views and _predicted(problem):
        from robotdiffuse.planning.pipeline.unknown_space import predicted_obstacles
        from robotdiffuse.scenes.scene import Scene

        seen = Scene([*problem.scene.shapes, predicted_obstacles(problem)])
        problem = replace(problem, scene=seen, views=())
    return problem.standing()


def _predicted(problem: "Problem") -> bool:
    """Whether the policy for unknown space is `predicted`."""
    from robotdiffuse.planning.pipeline.unknown_space import policy_for

    return policy_for(problem)[0] == "predicted"


def show(file: Path) -> None:
    """Open a file in the browser, if there is a display."""
    import webbrowser

    if sys.platform in ("darwin", "win32") or os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"):
        webbrowser.open(file.resolve().as_uri())


def add_view(commands: Commands) -> None:
    command(
        commands,
        "view",
        "draw results and problems as a replay (.html) or a picture (.png)",
        "Draw the motions of result files, of several in one picture; of a problem, or a "
        "result without a motion, the start, the goal and the links that collide. Without --out, write a "
        "page and open it in the browser.",
        run_view,
        (
            "results RESULT",
            "result file (.json) of `robotdiffuse plan --out`, or a problem file; several results must be "
            "of one problem",
            {"nargs": "+"},
        ),
        (
            "--out FILE *",
            "replay (.html) or picture (.png); repeatable (default: the name of RESULT with .html)",
        ),
        (
            "--shell M",
            "with several results: thickness of the safety shell that pictures show about the arm [m] "
            "(default: 0, none)",
            not_negative,
            0.0,
        ),
    )


def read_result(file: str) -> "tuple[PlanResult, Problem]":
    """The result in a file, and its problem. Raises InputError if the file holds no problem."""
    from robotdiffuse.core.results import NO_PROBLEM, load_result
    from robotdiffuse.problems.files import problem_from_record

    saved = load_result(file)
    if saved.problem is None:
        why = [f" ({note})" for note in saved.result.notes if note.startswith(NO_PROBLEM)]
        raise InputError(
            f"{file} holds no problem{''.join(why)}; write it with `robotdiffuse plan PROBLEM --out "
            "FILE.json`, or with `save` of a result of rd.plan"
        )
    return saved.result, problem_from_record(saved.problem)


def read_solved(file: str) -> "tuple[PlanResult, Problem]":
    """The solved result in a file, and its problem. Raises InputError if the file holds no motion or
    problem."""
    result, problem = read_result(file)
    if not result.solved:
        raise InputError(f"{file} holds no motion: its status is {result.status.value} ({result.reason})")
    return result, problem


def _read(file: str) -> "tuple[PlanResult | None, Problem]":
    """The result in a file, and its problem; of a problem file, the problem alone."""
    from robotdiffuse.core.input_files import read_json
    from robotdiffuse.core.results import PROBLEM_ENDINGS
    from robotdiffuse.problems.files import load_problem

    ending = Path(file).suffix.lower()
    record = read_json(file) if ending == ".json" else {}
    is_problem = isinstance(record, dict) and "scene" in record and "status" not in record
    if ending in PROBLEM_ENDINGS or is_problem:
        return None, load_problem(file)
    return read_result(file)


def run_view(arguments: Namespace) -> None:
    from robotdiffuse.core.output_files import check_output

    files = arguments.out or [f"{Path(arguments.results[0]).stem}.html"]
    outputs = [check_output(file, ENDINGS) for file in files]
    if len(arguments.results) == 1:
        result, problem = _read(arguments.results[0])
        write = partial(draw, problem, result)
    else:
        problem, results = _read_several(arguments.results)
        write = partial(draw_several, problem, results, shell=arguments.shell)
    for file in outputs:
        write(file)
        print(f"wrote {file}")
    if not arguments.out:
        show(outputs[0])


def _read_several(files: list[str]) -> "tuple[Problem, dict[str, PlanResult]]":
    """The solved results in several files, by name, and the problem of the first. Raises InputError for other
    scenes and for equal names."""
    from robotdiffuse.problems.files import problem_record

    names = [Path(file).stem for file in files]
    (result, problem), *further_results = map(read_solved, files)
    if len(set(names)) < len(names):
        raise InputError(f"results are {', '.join(files)}; two have the same name")
    for name, (_, other_problem) in zip(names[1:], further_results, strict=True):
        if (
            problem_record(other_problem)["scene"] != problem_record(problem)["scene"]
            or other_problem.robot != problem.robot
        ):
            raise InputError(f"{name} is of another robot or scene than {names[0]}; results must share both")
    return problem, dict(zip(names, (result, *(one for one, _ in further_results)), strict=True))


def add_simulate(commands: Commands) -> None:
    command(
        commands,
        "simulate",
        "replay a result in the PyBullet simulator",
        "Replay the motion of a result file in PyBullet with position control, and print "
        "tracking errors and contacts. Exit status: 0 no contacts, 1 contacts, 2 bad input.",
        run_simulate,
        ("result RESULT", "result file (.json) of `robotdiffuse plan --out`"),
        ("--out FILE *", "replay (.html) or picture (.png) of the simulated motion; repeatable"),
    )


def run_simulate(arguments: Namespace) -> int:
    import numpy as np

    from robotdiffuse.core.output_files import check_output
    from robotdiffuse.core.types import Trajectory

    try:
        from robotdiffuse.simulation import replay
    except ModuleNotFoundError as error:
        if error.name != "pybullet":
            raise
        raise InputError(
            "simulate needs PyBullet, which has no wheels above Python 3.11: pip install 'robotdiffuse[sim]'"
        ) from None
    outputs = [check_output(file, ENDINGS) for file in arguments.out]
    result, problem = read_solved(arguments.result)
    if result.trajectory is None:
        raise InputError(f"{arguments.result} holds a path without times; a replay needs a trajectory")
    robot, scene = problem.standing()
    executed = replay(robot, scene, result.trajectory, moving=problem.moving_in_world)
    for name in (one.name for one in problem.moving if not one.known):
        print(f"note: the motion of {name} is not known; it stands still here")
    print_replay(problem.robot.name, result.trajectory.duration, executed)
    rates = np.gradient(executed.positions, executed.times, axis=0)
    motion = Trajectory(executed.joint_names, executed.times, executed.positions, rates, 0 * rates)
    for file in outputs:
        draw(problem, replace(result, trajectory=motion), file)
        print(f"wrote {file}")
    return SOLVED if executed.free else NO_PLAN


def print_replay(robot: str, duration: float, done: "Replay") -> None:
    """Print tracking errors and contacts."""
    from robotdiffuse.core.tables import Column, Table, show

    title = f"{robot}: {'free' if done.free else 'contact'}, {duration:.2f} s"
    rms = float((done.tip_errors**2).mean() ** 0.5)
    show(
        Table.of(
            title,
            ("", "maximum", "RMS"),
            [
                *(
                    (f"error of {name}", f"{1e3 * max_error:.3f} mrad", f"{1e3 * rms:.3f} mrad")
                    for name, max_error, rms in zip(
                        done.joint_names, done.max_errors, done.rms_errors, strict=True
                    )
                ),
                ("error of the tip", f"{1e3 * done.tip_errors.max():.3f} mm", f"{1e3 * rms:.3f} mm"),
            ],
        )
    )
    if not done.free:
        columns = ("link", Column("touches", left=True), "at", "depth")
        show(
            Table.of(
                "",
                columns,
                [
                    (
                        contact.link,
                        contact.other,
                        f"{contact.time:.2f} s",
                        f"{1e3 * contact.depth:.1f} mm" if contact.depth > 0 else "none: closer than 2 mm",
                    )
                    for contact in done.contacts
                ],
            )
        )
