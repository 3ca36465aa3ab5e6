"""Learning curves: success of networks in training, without refinement or search, against samples seen.

    python benchmarks/curves.py NAME=FOLDER [NAME=FOLDER ...] [--plot FILE]

FOLDER is that of a training run; its log.csv holds the success on held-out problems that are not trivial at
every checkpoint. Draws benchmarks/results/curves.png and prints where every curve ends.
"""

import argparse
import csv
from pathlib import Path

from matplotlib.figure import Figure
from report import print_table

from robotdiffuse.errors import InputError

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


def draw(runs: dict[str, dict[str, Curve]], file: Path) -> None:
    figure = Figure(figsize=(8, 4.5), layout="constrained")
    axes = figure.subplots()
    several = any(len(curves) > 1 for curves in runs.values())
    for i, (name, curves) in enumerate(runs.items()):
        for j, (column, (samples, success)) in enumerate(curves.items()):
            label = f"{name}, {column.replace('_', ' ')}" if several else name
            x, y = [value / 1e6 for value in samples], [100 * value for value in success]
            color, style = COLORS[i % len(COLORS)], STYLES[j % len(STYLES)]
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
    arguments = parser.parse_args()
    runs = {}
    for text in arguments.runs:
        name, given, folder = text.partition("=")
        if not (name and given and folder):
            raise InputError(f"run is {text!r}; it must be NAME=FOLDER")
        runs[name] = read_curves(Path(folder))
    rows = []
    for name, curves in runs.items():
        for column, (samples, success) in curves.items():
            best = max(success)
            rows.append(
                [f"{name}, {column}", f"{samples[-1] / 1e6:.2f}", f"{success[-1]:.3f}", f"{best:.3f}"]
            )
    print_table("Success of the network alone", ["", "million samples", "last", "best"], rows)
    draw(runs, arguments.plot)


if __name__ == "__main__":
    main()
