"""A page of plots on a data set: one HTML file that needs no network."""

import html
from collections.abc import Callable
from pathlib import Path as FilePath

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.evaluation import look
from robotdiffuse.evaluation.data import plots
from robotdiffuse.evaluation.data.report import DataColumns, DataSummary, read_columns, summarize
from robotdiffuse.evaluation.look import STYLE
from robotdiffuse.files import check_output, write_atomically
from robotdiffuse.robots import load_robot
from robotdiffuse.robots.kinematics import ForwardKinematics
from robotdiffuse.robots.robot import Robot


def write_page(folder: str | FilePath, file: str | FilePath, robot: Robot | None = None) -> DataSummary:
    """Write the page as .html and return the figures that it shows.

    `robot`: that of the data, by default found by the name in the manifest; it says where the tips are.
    Raises InputError without matplotlib, for a file that cannot be written, and as `describe`.
    """
    target = check_output(file, (".html", ".htm"))
    columns = read_columns(folder)
    robot = load_robot(columns.manifest.robot) if robot is None else robot
    columns.manifest.check_robot(robot)
    summary = summarize(columns)
    write_atomically(target, _page(FilePath(folder).resolve().name, columns, summary, robot))
    return summary


def _page(name: str, columns: DataColumns, summary: DataSummary, robot: Robot) -> str:
    tips = {
        "start": _tips(robot, columns.sample["trajectories"][:, 0]),
        "goal": _tips(robot, columns.sample["trajectories"][:, -1]),
    }
    sampled = len(columns.sample["cost"])
    drawn = "" if sampled == summary.trajectories else f", of {sampled:,} of the motions"
    cm = f"{100 * summary.safety_distance:.3g} cm"
    shown: tuple[tuple[str, int, str, Callable[[], str]], ...] = (
        (
            "Problems",
            4,
            f"What became of the {summary.counts.get('tried', 0):,} problems that were drawn",
            lambda: plots.outcomes(summary),
        ),
        (
            "Path length",
            4,
            "Joint-space length of the motions, by family of scenes",
            lambda: plots.lengths(columns),
        ),
        (
            "Clearance",
            4,
            f"Least distance between arm and obstacles; the search keeps {cm} away from the ends",
            lambda: plots.clearances(columns, summary.safety_distance),
        ),
        (
            "Detour",
            4,
            "Path length over that of the straight line, where the line is not free",
            lambda: plots.detours(columns),
        ),
        (
            "Difficulty",
            4,
            "How far round the motion has to go, and how narrow it gets",
            lambda: plots.difficulty(columns),
        ),
        (
            "Goals",
            4,
            "Goal configurations per problem, and what the others cost over the best one",
            lambda: plots.goals(columns),
        ),
        (
            "Joints",
            12,
            f"Where the joints are between their limits: all frames, starts and goals{drawn}",
            lambda: plots.joints(columns),
        ),
        (
            "Obstacles",
            6,
            f"Density of obstacles, without the floor{drawn}; the cross is the robot's base",
            lambda: plots.obstacles(columns),
        ),
        (
            "Tip",
            6,
            f"Where the robot's {html.escape(robot.tip)} starts and ends, of some of the motions",
            lambda: plots.tips(tips),
        ),
    )
    with look.style():
        cards = "\n".join(
            f'<section class="card w{width}"><h2>{title}</h2><p>{text}</p>{plot()}</section>'
            for title, width, text, plot in shown
        )
    return "\n".join(
        (
            '<!doctype html>\n<html lang="en">\n<head><meta charset="utf-8">',
            f"<title>{html.escape(name)}</title>",
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            f"<style>{STYLE}</style></head>\n<body><main>",
            f"<h1>{html.escape(name)}</h1>",
            f'<div class="about">{html.escape(_about(columns))}</div>',
            f'<div class="tiles">{_tiles(summary)}</div>',
            f'<div class="cards">{cards}</div>',
            f"<footer>{html.escape(_footer(columns))}</footer>",
            "</main></body></html>\n",
        )
    )


def _about(columns: DataColumns) -> str:
    manifest, rows = columns.manifest, columns.all
    timing = "evenly spaced in joint-space length" if manifest.timing == "arc" else "evenly spaced in time"
    counts = np.bincount(rows["family"], minlength=len(manifest.families))
    families = [f"{count:,} {name}" for name, count in zip(manifest.families, counts, strict=True) if count]
    scenes = ", ".join(families)
    return (
        f"Motions of {manifest.robot} in random scenes ({scenes}), each of {manifest.frames} frames {timing}"
    )


def _tiles(summary: DataSummary) -> str:
    made = f"of {summary.planned:,} motions" if summary.trajectories < summary.planned else "motions"
    frames = f"{summary.frames:,}" if summary.frames < 1e6 else f"{summary.frames / 1e6:.1f} M"
    train, *held_out = ((name, f"{count:,}") for name, count in summary.splits.items())
    tiles = (
        (f"{summary.trajectories:,}", made),
        (frames, "frames"),
        (size_in_words(summary.bytes), f"in {summary.shards:,} shards"),
        (f"{100 * summary.success:.1f} %", "of problems solved"),
        (
            f"{100 * summary.kept:.1f} %",
            f"come no closer than {100 * summary.safety_distance:.3g}\u00a0cm or than their ends",
        ),
        (f"{100 * summary.trivial:.1f} %", "trivial: the line is free"),
        (f"{summary.length.quantiles[2]:.2f} rad", "median length"),
        (train[1], f"to {train[0]} on, " + ", ".join(f"{count} {name}" for name, count in held_out)),
    )
    return "".join(
        f'<div class="tile"><b>{html.escape(value)}</b><span>{html.escape(what)}</span></div>'
        for value, what in tiles
    )


def _footer(columns: DataColumns) -> str:
    versions = ", ".join(f"{name} {version}" for name, version in columns.manifest.versions.items())
    robot = columns.manifest.robot_fingerprint
    return f"Made with {versions}; robot {robot}. The last bar of a histogram holds all that lies beyond."


def size_in_words(size: int) -> str:
    """A size on disk in words."""
    return f"{size / 1e9:.2f} GB" if size >= 1e9 else f"{size / 1e6:.1f} MB"


def _tips(robot: Robot, q: Float[ndarray, "n dof"]) -> Float[ndarray, "n 3"]:
    """Positions of the tip link's origin [m]."""
    with torch.inference_mode():
        kinematics = ForwardKinematics(robot, torch.float32)
        return kinematics.link(torch.from_numpy(np.asarray(q, np.float32)), robot.tip)[:, :3, 3].numpy()
