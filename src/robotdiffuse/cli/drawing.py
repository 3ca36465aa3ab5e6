"""Draws results as replays (.html) or pictures (.png)."""

import os
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from robotdiffuse.core.results import PlanResult
    from robotdiffuse.core.types import Path as PathOfJoints
    from robotdiffuse.core.types import Trajectory
    from robotdiffuse.problems.problem import Problem
    from robotdiffuse.robots.robot import Robot
    from robotdiffuse.scenes.scene import Scene

ENDINGS = (".html", ".png")


def draw(problem: "Problem", result: "PlanResult | None", file: Path) -> None:
    """Draw the motion of a result in its scene, as the ending of the file says; without a motion, the start,
    the goal and the links that collide.

    For a problem with views and the policy `predicted`, the predicted obstacles are drawn too.
    """
    if result is None or result.path is None:
        from robotdiffuse.visualization.problem_drawing import write_problem

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
        from robotdiffuse.visualization.gallery import GalleryEntry, write_gallery

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
