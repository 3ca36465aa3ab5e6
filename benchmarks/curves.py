"""Learning curves: success of networks in training, without refinement or search, against samples seen.

    python benchmarks/curves.py NAME=FOLDER [NAME=FOLDER ...] [--plot FILE]
    python benchmarks/curves.py NAME=FOLDER --snapshots [--family rop] [--problems 60] [--cases FOLDER]

FOLDER is that of a training run; its log.csv holds the success of single samples without guidance on held-out
problems that are not trivial, by covering spheres, at every checkpoint. With --snapshots it holds folders of
models, copies of the run's while it went on, and each is tried here: single samples and best of 16, with and
without collision guidance, by the judge. Draws benchmarks/results/curves.png and prints where curves end.
"""

import argparse
import csv
import json
from dataclasses import replace
from pathlib import Path

from guidance import success
from matplotlib.figure import Figure
from problems import Case, draw_cases
from report import print_table

from robotdiffuse.errors import InputError
from robotdiffuse.planners.robotdiffuse import RobotDiffuse, RobotDiffuseSettings
from robotdiffuse.scenes.families import FAMILIES

COLORS = ("#14487f", "#d1495b", "#e09a5f", "#5aa7a7", "#8d76c4", "#8a94a3")
STYLES = ("-", "--", ":", "-.")
"""Of the columns of a run whose names begin with success."""

Curve = tuple[list[float], list[float]]
"""Samples seen, and success."""


def read_curves(folder: Path) -> dict[str, Curve]:
    """By column. Raises InputError if the folder is not that of a run that measured success."""
    file = folder / "log.csv"
    if not file.is_file():
        raise InputError(f"{file} does not exist; {folder} must be the folder of a training run")
    with file.open(encoding="utf-8", newline="") as stream:
        rows = list(csv.DictReader(stream))
    curves: dict[str, Curve] = {}
    for column in (name for name in (rows[0] if rows else {}) if name.startswith("success")):
        pairs = [
            (float(row["samples"]), float(row[column])) for row in rows if row[column] not in ("", "nan")
        ]
        if pairs:
            curves[column] = [pair[0] for pair in pairs], [pair[1] for pair in pairs]
    if not curves:
        raise InputError(f"{file} has no success in it; it must be the log of a planner's training")
    return curves


def measure(folder: Path, cases: list[Case]) -> dict[str, Curve]:
    """Success of the models in a folder's folders. Raises InputError if there are none."""
    files = list(folder.glob("*/model.json"))
    if not files:
        raise InputError(f"{folder} holds no folders with models; it must hold copies of a run's")
    by_samples = sorted((json.loads(file.read_text())["training"]["samples"], file.parent) for file in files)
    samples = [float(count) for count, _ in by_samples]
    curves: dict[str, Curve] = {}
    for _, weights in by_samples:
        loaded = RobotDiffuse(RobotDiffuseSettings(weights=str(weights)))
        for guided in (True, False):
            steps = loaded.settings.guidance_steps if guided else 0
            share = success(replace(loaded.settings, guidance_steps=steps), loaded, cases, weights.name)
            how = "guided" if guided else "unguided"
            for what, value in (("best of 16", share.best), ("single", share.single)):
                curves.setdefault(f"{what}, {how}", (samples, []))[1].append(value)
    return curves


def draw(runs: dict[str, dict[str, Curve]], file: Path) -> None:
    figure = Figure(figsize=(8, 4.5), layout="constrained")
    axes = figure.subplots()
    several = any(len(curves) > 1 for curves in runs.values())
    for i, (name, curves) in enumerate(runs.items()):
        for j, (column, (samples, shares)) in enumerate(curves.items()):
            label = f"{name}, {column.replace('_', ' ')}" if several else name
            x, y = [value / 1e6 for value in samples], [100 * value for value in shares]
            # one run: a color for each curve; several: a color for each run
            color = COLORS[(i if len(runs) > 1 else j) % len(COLORS)]
            style = STYLES[j % len(STYLES)]
            axes.plot(x, y, style, color=color, label=label, lw=1.6, marker="." if len(x) < 60 else "")
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(axis="y", color="#e3e6ea", lw=0.8)
    axes.set(xlabel="training samples seen, millions", ylabel="motions free of collision, %", ylim=(0, 102))
    axes.set_xlim(left=0)
    axes.set_title("Success of the network alone while it learns")
    figure.legend(frameon=False, loc="outside right upper")
    file.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(file, dpi=130)


def main() -> None:
    parser = argparse.ArgumentParser(description="Learning curves of training runs.")
    parser.add_argument("runs", nargs="+", metavar="NAME=FOLDER", help="label and folder of a training run")
    results = Path(__file__).parent / "results"
    parser.add_argument("--plot", type=Path, default=results / "curves.png", help="where the plot goes")
    parser.add_argument("--snapshots", action="store_true", help="the folders hold copies of models")
    parser.add_argument("--family", default="rop", choices=list(FAMILIES), help="of scenes (rop)")
    parser.add_argument("--problems", type=int, default=60, help="that snapshots are tried on (60)")
    parser.add_argument("--cases", type=Path, help="folder that keeps what is known of the problems")
    arguments = parser.parse_args()
    cases = []
    if arguments.snapshots:
        cases = draw_cases(arguments.family, arguments.problems, arguments.cases).hard
    runs = {}
    for text in arguments.runs:
        name, given, folder = text.partition("=")
        if not (name and given and folder):
            raise InputError(f"run is {text!r}; it must be NAME=FOLDER")
        runs[name] = measure(Path(folder), cases) if arguments.snapshots else read_curves(Path(folder))
    rows = []
    for name, curves in runs.items():
        for column, (samples, shares) in curves.items():
            best = max(shares)
            rows.append([f"{name}, {column}", f"{samples[-1] / 1e6:.2f}", f"{shares[-1]:.3f}", f"{best:.3f}"])
    print_table("Success of the network alone", ["", "million samples", "last", "best"], rows)
    draw(runs, arguments.plot)


if __name__ == "__main__":
    main()
