"""A page of plots on a data set: one HTML file that needs no network."""

import html
from collections.abc import Callable
from pathlib import Path as FilePath

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.evaluation import data_plots
from robotdiffuse.evaluation.data_report import DataColumns, DataSummary, read_columns, summarize
from robotdiffuse.files import write_atomically
from robotdiffuse.paths.export import check_output
from robotdiffuse.robots import load_robot
from robotdiffuse.robots.kinematics import ForwardKinematics
from robotdiffuse.robots.robot import Robot

STYLE = """
:root { --ink: #222b38; --soft: #6b7684; --line: rgba(34, 43, 56, .09); }
* { box-sizing: border-box; }
body { margin: 0; background: #f2f4f6; color: var(--ink);
  font: 14px/1.45 system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", Arial, sans-serif; }
main { max-width: 1320px; margin: 0 auto; padding: 34px 26px 40px; }
h1 { margin: 0; font-size: 27px; font-weight: 680; letter-spacing: -.018em; }
.about { margin: 5px 0 22px; color: var(--soft); }
.tiles { display: grid; grid-template-columns: repeat(auto-fit, minmax(136px, 1fr)); gap: 12px;
  margin-bottom: 14px; }
.tile, .card { background: white; border: 1px solid var(--line); border-radius: 14px;
  box-shadow: 0 2px 12px rgba(30, 40, 60, .045); }
.tile { padding: 12px 16px 11px; }
.tile b { display: block; font-size: 23px; font-weight: 640; letter-spacing: -.02em;
  font-variant-numeric: tabular-nums; }
.tile span { color: var(--soft); font-size: 12.5px; }
.cards { display: grid; grid-template-columns: repeat(12, 1fr); gap: 14px; }
.card { padding: 17px 20px 12px; min-width: 0; display: flex; flex-direction: column; }
.card h2 { margin: 0; font-size: 15.5px; font-weight: 640; letter-spacing: -.005em; }
.card p { margin: 2px 0 10px; color: var(--soft); font-size: 12.5px; }
.card svg { display: block; width: 100%; height: auto; margin-top: auto; }
.card svg text { font-family: system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", Arial,
  sans-serif !important; }
.w4 { grid-column: span 4; } .w6 { grid-column: span 6; } .w12 { grid-column: span 12; }
footer { margin-top: 20px; color: var(--soft); font-size: 12px; }
@media (max-width: 900px) { .w4, .w6 { grid-column: span 12; } }
"""


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
    plots: tuple[tuple[str, int, str, Callable[[], str]], ...] = (
        (
            "Problems",
            4,
            f"What became of the {summary.counts.get('tried', 0):,} problems that were drawn",
            lambda: data_plots.outcomes(summary),
        ),
        (
            "Path length",
            4,
            "Joint-space length of the motions, by family of scenes",
            lambda: data_plots.lengths(columns),
        ),
        (
            "Clearance",
            4,
            f"Least distance between arm and obstacles; the search keeps {cm} away from the ends",
            lambda: data_plots.clearances(columns, summary.safety_distance),
        ),
        (
            "Detour",
            4,
            "Path length over that of the straight line, where the line is not free",
            lambda: data_plots.detours(columns),
        ),
        (
            "Difficulty",
            4,
            "How far round the motion has to go, and how narrow it gets",
            lambda: data_plots.difficulty(columns),
        ),
        (
            "Goals",
            4,
            "Goal configurations per problem, and what the others cost over the best one",
            lambda: data_plots.goals(columns),
        ),
        (
            "Joints",
            12,
            f"Where the joints are between their limits: all frames, starts and goals{drawn}",
            lambda: data_plots.joints(columns),
        ),
        (
            "Obstacles",
            6,
            f"Density of obstacles, without the floor{drawn}; the cross is the robot's base",
            lambda: data_plots.obstacles(columns),
        ),
        (
            "Tip",
            6,
            f"Where the robot's {html.escape(robot.tip)} starts and ends, of some of the motions",
            lambda: data_plots.tips(tips),
        ),
    )
    with data_plots.style():
        cards = "\n".join(
            f'<section class="card w{width}"><h2>{title}</h2><p>{text}</p>{plot()}</section>'
            for title, width, text, plot in plots
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
