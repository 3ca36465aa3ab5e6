"""A page of plots of a data set: one HTML file that needs no network."""

import html
from functools import partial
from pathlib import Path as FilePath

from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.core.output_files import check_output, write_atomically
from robotdiffuse.evaluation import style
from robotdiffuse.evaluation.datasets import plots
from robotdiffuse.evaluation.datasets.plots import PLOTS, Plot
from robotdiffuse.evaluation.datasets.report import DataFigures, facts, read_figures
from robotdiffuse.robots import load_robot
from robotdiffuse.robots.kinematics import link_origins
from robotdiffuse.robots.robot import Robot


def write_page(folder: str | FilePath, file: str | FilePath, robot: Robot | None = None) -> DataFigures:
    """Write the page as .html and return its figures.

    robot: that of the data, for the positions of the tip; None: found by the name in the manifest.

    Raises InputError without matplotlib, for a file that cannot be written, and as `read_figures` does.
    """
    target = check_output(file, (".html", ".htm"))
    data = read_figures(folder)
    robot = load_robot(data.manifest.robot) if robot is None else robot
    data.manifest.check_robot(robot)
    with style.style():
        cards = "\n".join(_cards(data, robot))
    content = f'<div class="cards">{cards}</div>\n<footer>{html.escape(_footer(data))}</footer>'
    name = FilePath(folder).resolve().name
    write_atomically(target, style.page(name, [_about(data)], facts(data), content))
    return data


def _cards(data: DataFigures, robot: Robot) -> list[str]:
    sampled = len(data.sample["cost"])
    fields = {
        "tried": data.counts.get("tried", 0),
        "cm": f"{100 * data.safety_distance:.3g} cm",
        "drawn": "" if sampled == data.trajectories else f", of {sampled:,} of the motions",
        "tip": html.escape(robot.tip),
    }
    ends = {name: _tips(robot, data.sample["trajectories"][:, i]) for name, i in (("start", 0), ("goal", -1))}
    tips = Plot(
        "Tip",
        partial(plots.tips, ends),
        "Start and end positions of the robot's {tip} in some of the motions",
        6,
        3.0,
    )
    return [
        style.card(plot.title, plot.width, plot.text.format(**fields), plot.svg(data))
        for plot in (*PLOTS, tips)
    ]


def _about(data: DataFigures) -> str:
    manifest = data.manifest
    timing = "evenly spaced in joint-space length" if manifest.timing == "arc" else "evenly spaced in time"
    scenes = ", ".join(f"{rows.sum():,} {name}" for name, rows in data.families.items())
    motions = f"Motions of {manifest.robot} in random scenes ({scenes})"
    return f"{motions}, each of {manifest.waypoints} waypoints {timing}"


def _footer(data: DataFigures) -> str:
    versions = ", ".join(f"{name} {version}" for name, version in data.manifest.versions.items())
    robot = data.manifest.robot_fingerprint
    return f"Made with {versions}; robot {robot}. The last bar of a histogram holds all larger values."


def _tips(robot: Robot, q: Float[ndarray, "n dof"]) -> Float[ndarray, "n 3"]:
    """Positions of the tip link's origin [m]."""
    return link_origins(robot, q, robot.tip)
