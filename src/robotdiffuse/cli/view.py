"""The commands `robotdiffuse view` and `simulate`; results as replays (.html) and pictures (.png)."""

import os
import sys
import webbrowser
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from robotdiffuse.cli.arguments import NO_PLAN, SOLVED, VIEW_ENDINGS, Namespace
from robotdiffuse.cli.verify import read_result, read_solved
from robotdiffuse.core.errors import InputError
from robotdiffuse.core.files import check_output, read_json
from robotdiffuse.core.tables import Column, Table, show
from robotdiffuse.core.types import PROBLEM_ENDINGS, PlanResult, Trajectory
from robotdiffuse.planning.pipeline.unknown_space import policy_for, predicted_obstacles
from robotdiffuse.problems.files import load_problem, problem_record
from robotdiffuse.problems.problem import PREDICTED, Problem
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.visualization.picture import PictureSettings, write_comparison, write_picture
from robotdiffuse.visualization.replay_page import GalleryEntry, write_gallery, write_problem, write_replay


def draw(problem: Problem, result: PlanResult | None, file: Path) -> None:
    """Draw the motion of a result in its scene, as a replay or a picture by the ending of the file; without a
    motion, draw the start, the goal and the links that collide.

    With a motion, the predicted obstacles of a problem with the policy `predicted` are drawn too.
    """
    if result is None or result.path is None:
        return write_problem(problem, file, result)
    robot, scene = _shown(problem)
    write = write_replay if file.suffix.lower() == ".html" else write_picture
    write(robot, scene, result.trajectory or result.path, file, result=result, moving=problem.moving_in_world)


def draw_several(problem: Problem, results: Mapping[str, PlanResult], file: Path, shell: float) -> None:
    """Draw the motions of several solved results, by name, in the scene of one problem: in one picture, or as
    replays side by side.

    shell: thickness of the layer that pictures show around the arm as a safety distance [m]; 0: none.
    """
    robot, scene = _shown(problem)
    motions = {name: result.trajectory or result.path for name, result in results.items()}
    if file.suffix.lower() == ".html":
        entries = [
            GalleryEntry(name, results[name].planner, scene, motion, problem.moving_in_world)
            for name, motion in motions.items()
        ]
        write_gallery(robot, entries, file, robot.name)
    else:
        settings = PictureSettings(shell=shell)
        write_comparison(robot, scene, motions, file, settings=settings, moving=problem.moving_in_world)


def _shown(problem: Problem) -> tuple[Robot, Scene]:
    """The robot and the scene of a problem, with predicted obstacles if there are any."""
    if problem.views and policy_for(problem)[0] == PREDICTED:
        known_and_predicted = Scene([*problem.scene.shapes, predicted_obstacles(problem)])
        problem = replace(problem, scene=known_and_predicted, views=())
    return problem.robot_and_scene_in_world()


def open_in_browser(file: Path) -> None:
    """Open a file in the browser, if there is a display."""
    if sys.platform in ("darwin", "win32") or os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"):
        webbrowser.open(file.resolve().as_uri())


def _read(file: str) -> tuple[PlanResult | None, Problem]:
    """The result in a file, and its problem; for a problem file, None and the problem."""
    ending = Path(file).suffix.lower()
    record = read_json(file) if ending == ".json" else {}
    is_problem = isinstance(record, dict) and {"scene", "start"} & record.keys() and "status" not in record
    if ending in PROBLEM_ENDINGS or is_problem:
        return None, load_problem(file)
    return read_result(file)


def run_view(arguments: Namespace) -> None:
    files = arguments.out or [f"{Path(arguments.results[0]).stem}.html"]
    outputs = [check_output(file, VIEW_ENDINGS) for file in files]
    pictures = any(file.suffix.lower() == ".png" for file in outputs)
    if arguments.shell and not (pictures and len(arguments.results) > 1):
        raise InputError("--shell is for pictures (.png) of several results; leave it out")
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
        open_in_browser(outputs[0])


def _read_several(files: list[str]) -> tuple[Problem, dict[str, PlanResult]]:
    """The problem of the first of several result files, and the solved results by the names of the files.
    Raises InputError as `read_solved` does, and if two names are equal or the results are for different
    robots, bases, scenes or moving obstacles."""

    names = [Path(file).stem for file in files]
    (result, problem), *further_results = map(read_solved, files)
    if len(set(names)) < len(names):
        raise InputError(f"results are {', '.join(files)}; two have the same name")
    record = problem_record(problem)
    for name, (_, other_problem) in zip(names[1:], further_results, strict=True):
        other_record = problem_record(other_problem)
        if other_problem.robot != problem.robot or any(
            other_record.get(key) != record.get(key) for key in ("base", "scene", "moving")
        ):
            raise InputError(
                f"{name} has another robot, base, scene or moving obstacles than {names[0]}; results must "
                "share them"
            )
    return problem, dict(zip(names, (result, *(solution for solution, _ in further_results)), strict=True))


def run_simulate(arguments: Namespace) -> int:
    from robotdiffuse.simulation import replay

    outputs = [check_output(file, VIEW_ENDINGS) for file in arguments.out]
    result, problem = read_solved(arguments.result)
    if result.trajectory is None:
        raise InputError(f"{arguments.result} holds a path without times; a replay needs a trajectory")
    robot, scene = problem.robot_and_scene_in_world()
    executed = replay(robot, scene, result.trajectory, moving=problem.moving_in_world)
    for name in (entry.name for entry in problem.moving if not entry.known):
        print(f"note: the motion of {name} is not known; it stands still here")
    rms = float((executed.tip_errors**2).mean() ** 0.5)
    joints = zip(robot.planned_joints, executed.max_errors, executed.rms_errors, strict=True)
    rows = [
        (
            f"error of {joint.name}",
            f"{1e3 * maximum:.3f} m{joint.unit}",
            f"{1e3 * rms_error:.3f} m{joint.unit}",
        )
        for joint, maximum, rms_error in joints
    ]
    rows.append(("error of the tip", f"{1e3 * executed.tip_errors.max():.3f} mm", f"{1e3 * rms:.3f} mm"))
    verdict = "free" if executed.free else "contact"
    title = f"{problem.robot.name}: {verdict}, {result.trajectory.duration:.2f} s"
    show(Table.of(title, ("", "maximum", "RMS"), rows))
    if not executed.free:
        contacts = [
            (
                entry.link,
                entry.other,
                f"{entry.time:.2f} s",
                f"{1e3 * entry.depth:.1f} mm" if entry.depth > 0 else "0 (gap below 2 mm)",
            )
            for entry in executed.contacts
        ]
        show(Table.of("", ("link", Column("touches", left=True), "at", "depth"), contacts))
    rates = np.gradient(executed.positions, executed.times, axis=0)
    motion = Trajectory(executed.joint_names, executed.times, executed.positions, rates, 0 * rates)
    for file in outputs:
        # the clearance was certified for the planned motion
        draw(problem, replace(result, trajectory=motion, min_clearance=None), file)
        print(f"wrote {file}")
    return SOLVED if executed.free else NO_PLAN
