"""Learning curves: success of networks in training, without guidance, refinement or search.

    python benchmarks/curves.py NAME=FOLDER [NAME=FOLDER ...] [--plot FILE]

FOLDER is that of a training run; its log.csv holds the share of single samples that are free of collision, by
covering spheres, on held-out problems that are not trivial, at every checkpoint. Draws
benchmarks/results/curves.png and prints where curves end.
"""

import argparse
import csv
from pathlib import Path

from matplotlib.figure import Figure
from report import print_table

from robotdiffuse.core.errors import InputError

COLORS = ("#14487f", "#d1495b", "#e09a5f", "#5aa7a7", "#8d76c4", "#8a94a3", "#4d8f4d", "#b05f9b", "#000000")

Curve = tuple[list[float], list[float]]
"""Samples seen, and success."""


def read_curve(folder: Path) -> Curve:
    """Raises InputError if the folder is not that of a run that measured success."""
    file = folder / "log.csv"
    if not file.is_file():
        raise InputError(f"{file} does not exist; {folder} must be the folder of a training run")
    with file.open(encoding="utf-8", newline="") as stream:
        rows = [row for row in csv.DictReader(stream) if row.get("success", "") not in ("", "nan")]
    if not rows:
        raise InputError(f"{file} has no success in it; it must be the log of a planner's training")
    return [float(row["samples"]) for row in rows], [float(row["success"]) for row in rows]


def draw(runs: dict[str, Curve], file: Path) -> None:
    figure = Figure(figsize=(8, 4.5), layout="constrained")
    axes = figure.subplots()
    for i, (name, (samples, shares)) in enumerate(runs.items()):
        x, y = [value / 1e6 for value in samples], [100 * value for value in shares]
        axes.plot(x, y, color=COLORS[i % len(COLORS)], label=name, lw=1.6, marker=".")
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
    runs: dict[str, Curve] = {}
    for text in arguments.runs:
        name, given, folder = text.partition("=")
        if not (name and given and folder):
            raise InputError(f"run is {text!r}; it must be NAME=FOLDER")
        runs[name] = read_curve(Path(folder))
    rows = [
        [name, f"{samples[-1] / 1e6:.2f}", f"{shares[-1]:.3f}", f"{max(shares):.3f}"]
        for name, (samples, shares) in runs.items()
    ]
    print_table("Success of the network alone", ["", "million samples", "last", "best"], rows)
    draw(runs, arguments.plot)


if __name__ == "__main__":
    main()
