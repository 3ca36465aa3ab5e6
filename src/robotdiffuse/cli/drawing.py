"""Draws results as replays (.html) or pictures (.png)."""

import os
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from robotdiffuse.core.results import PlanResult
    from robotdiffuse.problems.problem import Problem

ENDINGS = (".html", ".png")


def draw(problem: "Problem", result: "PlanResult", file: Path) -> None:
    """Draw the motion of a solved result in its scene, as the ending of the file says.

    For a problem with views and the policy `predicted`, the predicted obstacles are drawn too.
    """
    motion = result.trajectory or result.path
    assert motion is not None, "only a solved result has a motion"
    if file.suffix.lower() == ".html":
        from robotdiffuse.visualization.replay_page import write_replay as write
    else:
        from robotdiffuse.visualization.picture import write_picture as write
    if problem.views and _predicted(problem):
        from robotdiffuse.planning.pipeline.unknown_space import predicted_obstacles
        from robotdiffuse.scenes.scene import Scene

        seen = Scene([*problem.scene.shapes, predicted_obstacles(problem)])
        problem = replace(problem, scene=seen, views=())
    robot, scene = problem.standing()
    write(robot, scene, motion, file, result=result)


def _predicted(problem: "Problem") -> bool:
    """Whether the policy for unknown space is `predicted`."""
    from robotdiffuse.planning.pipeline.unknown_space import policy_for

    return policy_for(problem)[0] == "predicted"


def show(file: Path) -> None:
    """Open a file in the browser, if there is a display."""
    import webbrowser

    if sys.platform in ("darwin", "win32") or os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"):
        webbrowser.open(file.resolve().as_uri())
