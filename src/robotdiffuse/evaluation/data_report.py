"""The report of a data set: its figures as tables and plots."""

from collections import Counter
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path as FilePath
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool
from numpy import ndarray

from robotdiffuse.core.errors import InputError
from robotdiffuse.core.output_files import check_output, write_atomically
from robotdiffuse.core.tables import Column, Table, plain
from robotdiffuse.datasets.rows import scenes_of
from robotdiffuse.datasets.shards import (
    SPLITS,
    Manifest,
    existing_shards,
    read_manifest,
    read_shard,
    shard_path,
    split_of,
)
from robotdiffuse.evaluation import plots
from robotdiffuse.evaluation.report import Report
from robotdiffuse.robots import load_robot
from robotdiffuse.robots.robot import Robot

if TYPE_CHECKING:
    from matplotlib.figure import Figure

QUANTITIES = {
    "cost": Column("length", "[rad]", ".3f"),
    "detour": Column("detour", "", ".3f"),
    "clearance": Column("clearance", "[cm]", ".3f", scale=100.0),
}
"""Arrays that are shown of every motion, and their columns."""
SPREAD = {"least": 0.0, "5 %": 0.05, "median": 0.5, "95 %": 0.95, "most": 1.0}
"""Quantiles of each quantity over the motions."""
SAMPLED_MOTIONS = 20_000
"""Motions, spread evenly over the set, whose larger arrays are kept for the plots."""
SAMPLED_WAYPOINTS = 24
"""Of each of these motions, spread evenly."""
ARRAYS_OF_ALL = ("cost", "clearance", "end_clearance", "safety_distance", "line_free", "detour", "family")
"""Arrays that are kept of all motions."""
ARRAYS_OF_SAMPLE = ("goal_costs", "trajectories")
"""Arrays that are kept of the sample."""
ARRAYS_OF_SCENES = ("obstacle_kinds", "obstacle_params")
"""Arrays that tell the split of a row."""
OUTCOMES = ("solved", "unsolved", "refused", "thinned")
"""Outcomes of problems."""
SAFETY_TOLERANCE = 0.002
"""A motion keeps the safety distance if it comes closer by at most this, as waypoints cut corners [m]."""


@dataclass(frozen=True, eq=False)
class DataFigures:
    """Arrays of a data set, in the order of the shards, and figures of them."""

    manifest: Manifest
    shards: int
    bytes: int
    """Size on disk."""
    counts: Counter[str]
    """Numbers of problems `tried` and by OUTCOMES, over all shards."""
    splits: dict[str, int]
    """Trajectories by split."""
    all: dict[str, ndarray] = field(repr=False)
    """ARRAYS_OF_ALL, of all motions."""
    sample: dict[str, ndarray] = field(repr=False)
    """ARRAYS_OF_SAMPLE, of the sample; `trajectories` with SAMPLED_WAYPOINTS waypoints."""

    @property
    def trajectories(self) -> int:
        return len(self.all["cost"])

    @property
    def success(self) -> float:
        """Share of solved problems, without thinned ones; NaN without any."""
        tried = self.counts["tried"] - self.counts["thinned"]
        return self.counts["solved"] / tried if tried else float("nan")

    @cached_property
    def families(self) -> dict[str, Bool[ndarray, "n"]]:
        """The motions of each family that occurs."""
        of = {name: self.all["family"] == i for i, name in enumerate(self.manifest.families)}
        return {name: chosen for name, chosen in of.items() if chosen.any()}

    @property
    def safety_distance(self) -> float:
        """The safety distance that searches begin with [m]: the largest that any of them kept."""
        return float(self.all["safety_distance"].max())

    @property
    def kept(self) -> float:
        """Share of motions that come no closer than the safety distance or than their closer end."""
        least = np.minimum(self.safety_distance, self.all["end_clearance"].min(axis=1))
        return float((self.all["clearance"] >= least - SAFETY_TOLERANCE).mean())

    @property
    def kept_throughout(self) -> float:
        """Share of motions that keep the safety distance throughout, of those whose ends keep it; NaN without
        any."""
        apart = self.all["clearance"][self.all["end_clearance"].min(axis=1) >= self.safety_distance]
        return (
            float((apart >= self.safety_distance - SAFETY_TOLERANCE).mean()) if len(apart) else float("nan")
        )

    @property
    def trivial(self) -> float:
        """Share of motions whose straight line is free."""
        return float(self.all["line_free"].mean())

    @property
    def goals_reached(self) -> float:
        """Mean number of goals that the search reached."""
        return float(np.isfinite(self.sample["goal_costs"]).sum(axis=1).mean())


def read_figures(folder: str | FilePath) -> DataFigures:
    """Read the arrays of figures and plots, one shard at a time. Raises InputError if there is no data set,
    or it is damaged or empty."""
    manifest = read_manifest(folder)
    indices = existing_shards(folder)
    step = max(1, manifest.trajectories // SAMPLED_MOTIONS)
    waypoints = np.unique(np.linspace(0, manifest.waypoints - 1, SAMPLED_WAYPOINTS).round().astype(int))
    parts: dict[str, list[ndarray]] = {name: [] for name in ARRAYS_OF_ALL}
    samples: dict[str, list[ndarray]] = {name: [] for name in ARRAYS_OF_SAMPLE}
    counts = Counter[str]()
    splits = np.zeros(len(SPLITS), np.int64)
    size = 0
    motions = 0
    for index in indices:
        shard = read_shard(
            folder, index, (*ARRAYS_OF_ALL, *ARRAYS_OF_SAMPLE, "obstacle_kinds", "obstacle_params")
        )
        rows = np.arange(-motions % step, len(shard), step)
        motions += len(shard)
        for name, arrays in parts.items():
            arrays.append(shard[name])
        for name, arrays in samples.items():
            chosen = np.ix_(rows, waypoints) if name == "trajectories" else rows
            arrays.append(np.array(shard[name][chosen]))
        splits += np.bincount(split_of(scenes_of(manifest, shard)), minlength=len(SPLITS))
        counts.update(shard.counts)
        size += sum(file.stat().st_size for file in shard_path(folder, index).rglob("*") if file.is_file())
    if not motions:
        raise InputError(f"{folder} holds no trajectories")
    return DataFigures(
        manifest=manifest,
        shards=len(indices),
        bytes=size,
        counts=counts,
        splits=dict(zip(SPLITS, splits.tolist(), strict=True)),
        all={name: np.concatenate(arrays) for name, arrays in parts.items()},
        sample={name: np.concatenate(arrays) for name, arrays in samples.items()},
    )


def facts(data: DataFigures) -> list[tuple[str, str]]:
    """Captions and figures."""
    manifest = data.manifest
    planned = f" of {manifest.trajectories:,}" if data.trajectories < manifest.trajectories else ""
    distance = f"{100 * data.safety_distance:.3g} cm"
    lost = ", ".join(f"{data.counts[name]:,} {name}" for name in OUTCOMES[1:])
    return [
        ("motions", f"{data.trajectories:,}{planned}"),
        (
            f"waypoints, evenly spaced in {'length' if manifest.timing == 'arc' else 'time'}",
            f"{data.trajectories * manifest.waypoints:,}",
        ),
        (f"in {data.shards:,} shards", size_in_words(data.bytes)),
        ("splits", ", ".join(f"{count:,} {name}" for name, count in data.splits.items())),
        ("problems solved", f"{100 * data.success:.1f} %; of {data.counts['tried']:,} tried {lost}"),
        (f"come no closer than {distance} or than their ends", f"{100 * data.kept:.1f} %"),
        (f"keep {distance} all along, where both ends have it", f"{100 * data.kept_throughout:.1f} %"),
        ("goals reached per problem", f"{data.goals_reached:.1f}"),
        ("trivial: the line is free", f"{100 * data.trivial:.1f} %"),
    ]


def tables(data: DataFigures) -> list[Table]:
    """The tables of a data set."""
    columns = ("medians of", "motions", Column("trivial", "%", ".1f", scale=100.0), *QUANTITIES.values())
    families = [
        (
            name,
            int(rows.sum()),
            float(data.all["line_free"][rows].mean()),
            *(float(np.median(data.all[of][rows])) for of in QUANTITIES),
        )
        for name, rows in data.families.items()
    ]
    spreads = []
    for name, column in QUANTITIES.items():
        values = data.all[name]
        figures = [values.mean(dtype=float), *np.quantile(values, list(SPREAD.values()))]
        spreads.append((column.title, *(f"{column.scale * x + 0.0:.3f}" for x in figures)))
    return [
        Table.pairs(f"{data.manifest.robot}: {data.trajectories:,} motions", facts(data)),
        Table.of("", columns, families),
        Table.of("", ("", "mean", *SPREAD), spreads),
    ]


def size_in_words(size: int) -> str:
    """A size on disk with its unit."""
    return f"{size / 1e9:.2f} GB" if size >= 1e9 else f"{size / 1e6:.1f} MB"


# The page

BINS = 50
LAST_QUANTILE = 0.995
"""Histograms end at this quantile; the last bar holds all larger values."""
DETOURS = {"line free": 0.5, "up to 5 % longer": 1.05, "up to 25 %": 1.25, "more": np.inf}
CLEARANCES = {"below 1 cm": 0.01, "1 to 2": 0.02, "2 to 5": 0.05, "over 5": np.inf}
"""Classes of motions by their upper ends."""


def write_page(folder: str | FilePath, file: str | FilePath, robot: Robot | None = None) -> DataFigures:
    """Write tables and plots as .html and return the figures.

    robot: that of the data; None: found by the name in the manifest.

    Raises InputError without matplotlib, for a file that cannot be written, and as `read_figures` does.
    """
    target = check_output(file, (".html", ".htm"))
    data = read_figures(folder)
    robot = load_robot(data.manifest.robot) if robot is None else robot
    data.manifest.check_robot(robot)
    write_atomically(target, data_report(data, FilePath(folder).resolve().name).page)
    return data


def data_report(data: DataFigures, name: str) -> Report:
    """The report of a data set."""
    manifest = data.manifest
    report = Report(name)
    for table in tables(data):
        report.table(table)
    distance = f"{100 * data.safety_distance:.3g} cm"
    caption = (
        f"Path length, clearance (the search keeps {distance} away from the ends) and detour of the motions"
    )
    report.plot("motions.svg", caption, plots.draw(partial(_motions, data), plots.FULL, 2.6))
    report.plot("difficulty.svg", "Difficulty", plots.draw(partial(_difficulty, data), plots.FULL, 2.6))
    caption = "Goals per problem, and what the others cost over the best one"
    report.plot("goals.svg", caption, plots.draw(partial(_goals, data), plots.FULL, 2.6))
    across = min(7, manifest.dof)
    height = 1.95 * -(-manifest.dof // across)
    joints = plots.draw(partial(_joints, data, across), plots.FULL, height)
    report.plot("joints.svg", "Joint values between their limits", joints)
    versions = ", ".join(f"{name} {version}" for name, version in manifest.versions.items())
    note = "The last bar of a histogram holds all larger values."
    report.add(plain(f"Made with {versions}; robot {manifest.robot_fingerprint}. {note}"))
    return report


def _motions(data: DataFigures, figure: "Figure") -> None:
    """Draw histograms of the quantities by family; detours of motions whose straight line is not free."""
    for axes, (name, column) in zip(figure.subplots(1, 3), QUANTITIES.items(), strict=True):
        of_detours = name == "detour"
        chosen = ~data.all["line_free"] if of_detours else np.ones(data.trajectories, bool)
        values = column.scale * data.all[name]
        parts = {family: values[rows & chosen] for family, rows in data.families.items()}
        low = 1.0 if of_detours else 0.0
        high = max(np.quantile(values[chosen], LAST_QUANTILE) if chosen.any() else 0.0, low + 1e-3)
        plots.histogram(axes, parts, np.linspace(low, high, BINS), column.title)


def _difficulty(data: DataFigures, figure: "Figure") -> None:
    """Draw shares by detour and by clearance, a bar for each family."""
    detours = np.where(data.all["line_free"], 0.0, data.all["detour"])
    kinds = ((DETOURS, detours), (CLEARANCES, data.all["clearance"]))
    for axes, (ends, values) in zip(figure.subplots(1, 2), kinds, strict=True):
        classes = np.searchsorted(list(ends.values()), values, side="right")
        shares = {
            label: [100 * float((classes[rows] == i).mean()) for rows in data.families.values()]
            for i, label in enumerate(ends)
        }
        plots.stacked_bars(axes, list(data.families), shares)


def _goals(data: DataFigures, figure: "Figure") -> None:
    """Draw the numbers of given and reached goals, and the excess cost of those that are not the best."""
    costs = data.sample["goal_costs"].astype(np.float64)
    left, right = figure.subplots(1, 2)
    numbers = [(~np.isnan(costs)).sum(axis=1), np.isfinite(costs).sum(axis=1)]
    weights = [np.full(len(costs), 100 / len(costs))] * 2
    left.hist(numbers, np.arange(costs.shape[1] + 1) + 0.5, weights=weights, label=["given", "reached"])
    left.set_xlabel("goals")
    left.legend(**plots.LEGEND_ABOVE)
    plots.percent_axis(left)
    best = np.nanmin(np.where(np.isinf(costs), np.nan, costs), axis=1, keepdims=True)
    excess = 100 * (costs / best - 1)
    excess = excess[np.isfinite(excess) & (excess > 0)]
    end = np.quantile(excess, 0.98) if len(excess) else 1.0
    plots.histogram(right, {"others": excess}, np.linspace(0, end, 30), "excess cost of the others [%]")


def _joints(data: DataFigures, across: int, figure: "Figure") -> None:
    """Draw a histogram for each joint between its limits: all waypoints, starts and goals."""
    manifest = data.manifest
    q = data.sample["trajectories"]
    for j, axes in enumerate(plots.panels(figure, manifest.joint_names, across)):
        bins = np.linspace(manifest.lower[j], manifest.upper[j], 41)
        parts = {"all waypoints": q[..., j].reshape(-1), "start": q[:, 0, j], "goal": q[:, -1, j]}
        for label, values in parts.items():
            axes.hist(values, bins.tolist(), density=True, histtype="step", label=label)
        axes.set_xticks(bins[[0, -1]].tolist())
        axes.xaxis.set_major_formatter("{x:.2f}")
        axes.set_yticks([])
        axes.set_xlabel("[rad]")
        if j == 0:
            figure.legend(loc="outside upper right", ncols=3)
