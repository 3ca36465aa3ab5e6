"""The report of a data set: its statistics as tables and plots."""

from collections import Counter
from dataclasses import field
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy import ndarray

from robotdiffuse.core.errors import InputError, counted
from robotdiffuse.core.files import check_output, write_atomically
from robotdiffuse.core.tables import NO_VALUE, Column, Table, plain
from robotdiffuse.core.types import Mask, frozen_dataclass
from robotdiffuse.datasets.shards import (
    SPLITS,
    Manifest,
    existing_shards,
    read_manifest,
    read_shard,
    scenes_of,
    shard_path,
    split_of,
)
from robotdiffuse.evaluation.report import Histograms, Report, histograms
from robotdiffuse.robots.robot import Robot

QUANTITIES = {
    "cost": Column("length", "[rad]", ".3f"),
    "detour": Column("detour", "", ".3f"),
    "clearance": Column("clearance", "[cm]", ".3f", scale=100.0),
}
"""Arrays shown in tables and plots, with their columns."""
SPREAD = {"least": 0.0, "5 %": 0.05, "median": 0.5, "95 %": 0.95, "most": 1.0}
"""Quantiles of each quantity over the motions."""
SAMPLED_MOTIONS = 20_000
"""ARRAYS_OF_SAMPLE are read for every k-th motion only, with the largest k that gives at least this many
motions of a complete data set. If fewer motions are planned than this, k is 1."""
SAMPLED_WAYPOINTS = 24
"""Number of waypoints that are read of each of these motions, spread evenly."""
ARRAYS_OF_ALL = ("cost", "clearance", "end_clearance", "safety_distance", "line_free", "detour", "family")
"""Arrays that are read for all motions."""
ARRAYS_OF_SAMPLE = ("goal_costs", "trajectories")
"""Arrays that are read for the sampled motions only."""
ARRAYS_OF_SCENES = ("obstacle_kinds", "obstacle_params")
"""Arrays from which the split of a row is computed."""
OUTCOMES = ("solved", "unsolved", "refused", "thinned")
"""Outcomes of problems that the generation of data tried; thinned problems were left out because they are
trivial."""
DETOURS = {
    "trivial": (0.0, 0.5),
    "up to 5 % longer": (0.5, 1.05),
    "up to 25 %": (1.05, 1.25),
    "more": (1.25, np.inf),
}
CLEARANCES = {
    "closer than 1 cm": (-np.inf, 0.01),
    "1 to 2": (0.01, 0.02),
    "2 to 5": (0.02, 0.05),
    "over 5": (0.05, np.inf),
}
"""Classes of motions by detour (path length over straight-line length; 0 if the straight line is free), and
by clearance [m]: lower bound, and exclusive upper bound."""
SAFETY_TOLERANCE = 0.002
"""A motion may come closer to obstacles than the safety distance by this much [m], since straight lines
between waypoints cut corners."""


@frozen_dataclass
class DataFigures:
    """Arrays of a data set, in the order of its shards, and statistics computed from them."""

    manifest: Manifest
    shards: int
    bytes: int
    """Size of the data set on disk [bytes]."""
    counts: Counter[str]
    """Numbers of problems over all shards: "tried" for all problems, and one number for each of OUTCOMES."""
    splits: dict[str, int]
    """Number of trajectories, by split."""
    all: dict[str, ndarray] = field(repr=False)
    """The arrays of ARRAYS_OF_ALL, over all motions."""
    sample: dict[str, ndarray] = field(repr=False)
    """The arrays of ARRAYS_OF_SAMPLE, over the sampled motions; `trajectories` have SAMPLED_WAYPOINTS
    waypoints."""

    @property
    def trajectories(self) -> int:
        return len(self.all["cost"])

    @cached_property
    def families(self) -> dict[str, Mask]:
        """Mask of the motions of each family that occurs in the data."""
        masks = {name: self.all["family"] == i for i, name in enumerate(self.manifest.families)}
        return {name: chosen for name, chosen in masks.items() if chosen.any()}

    @property
    def safety_distance(self) -> float:
        """The safety distance that data generation tries first [m]. After a failed search, a smaller one is
        tried, so the first one is the largest in the data."""
        return float(self.all["safety_distance"].max())


def read_figures(folder: str | Path) -> DataFigures:
    """Read the arrays for tables and plots, one shard at a time. Raises InputError if there is no data set,
    or if it is damaged or empty."""
    manifest = read_manifest(folder)
    indices = existing_shards(folder)
    step = max(1, manifest.trajectories // SAMPLED_MOTIONS)
    waypoints = np.unique(np.linspace(0, manifest.waypoints - 1, SAMPLED_WAYPOINTS).round().astype(int))
    parts = dict[str, list[ndarray]]()
    counts = Counter[str]()
    splits: dict[str, int] = dict.fromkeys(SPLITS, 0)
    size = 0
    motions = 0
    for index in indices:
        shard = read_shard(folder, index, (*ARRAYS_OF_ALL, *ARRAYS_OF_SAMPLE, *ARRAYS_OF_SCENES))
        rows = slice(-motions % step, None, step)
        motions += len(shard)
        shard_arrays = {name: shard[name] for name in ARRAYS_OF_ALL}
        shard_arrays["goal_costs"] = shard["goal_costs"][rows]
        shard_arrays["trajectories"] = shard["trajectories"][rows, waypoints]
        for name, array in shard_arrays.items():
            parts.setdefault(name, []).append(array)
        for i in split_of(scenes_of(manifest, shard)):
            splits[SPLITS[i]] += 1
        counts.update(shard.counts)
        size += sum(file.stat().st_size for file in shard_path(folder, index).rglob("*") if file.is_file())
    if not motions:
        raise InputError(f"{folder} holds no trajectories")
    joined = {name: np.concatenate(arrays) for name, arrays in parts.items()}
    sample = {name: joined.pop(name) for name in ARRAYS_OF_SAMPLE}
    return DataFigures(manifest, len(indices), size, counts, splits, joined, sample)


def facts(data: DataFigures) -> list[tuple[str, str]]:
    """The main statistics of a data set, as pairs of caption and text."""
    manifest = data.manifest
    counts = data.counts
    planned = f" of {manifest.trajectories:,}" if data.trajectories < manifest.trajectories else ""
    lost = ", ".join(f"{counts[name]:,} {name}" for name in OUTCOMES[1:])
    solved = np.divide(counts["solved"], counts["tried"] - counts["thinned"])
    distance = f"{100 * data.safety_distance:.3g} cm"
    clearance = data.all["clearance"] + SAFETY_TOLERANCE
    ends = data.all["end_clearance"].min(axis=1)
    keeps_distance = clearance >= np.minimum(data.safety_distance, ends)
    clearance_between = clearance[ends >= data.safety_distance]
    return [
        ("motions", f"{data.trajectories:,}{planned}"),
        (
            f"waypoints, evenly spaced in {'length' if manifest.timing == 'arc' else 'time'}",
            f"{data.trajectories * manifest.waypoints:,}",
        ),
        (f"in {counted(data.shards, 'shard')}", f"{data.bytes / 1e6:,.1f} MB"),
        ("splits", ", ".join(f"{count:,} {name}" for name, count in data.splits.items())),
        ("problems solved", f"{_share(solved)}; tried: {counts['tried']:,}, of these {lost}"),
        (f"keep {distance}, or the clearance of start or goal if smaller", _share(keeps_distance)),
        (
            f"keep {distance} all along, if start and goal do",
            _share(clearance_between >= data.safety_distance) if len(clearance_between) else NO_VALUE,
        ),
        (
            "goals reached per problem",
            f"{np.isfinite(data.sample['goal_costs']).sum(axis=1).mean():.1f}",
        ),
        ("trivial: the straight line is free", _share(data.all["line_free"])),
    ]


def _share(values: ndarray | float) -> str:
    return f"{100 * np.mean(values):.1f} %"


def tables(data: DataFigures) -> list[Table]:
    """The tables of a data set."""
    detours = np.where(data.all["line_free"], 0.0, data.all["detour"])
    shares = {name: (detours, *ends) for name, ends in DETOURS.items()}
    shares |= {name: (data.all["clearance"], *ends) for name, ends in CLEARANCES.items()}
    families = [
        (
            name,
            int(rows.sum()),
            *(float(np.median(data.all[quantity][rows])) for quantity in QUANTITIES),
            *(
                float(((low <= values[rows]) & (values[rows] < high)).mean())
                for values, low, high in shares.values()
            ),
        )
        for name, rows in data.families.items()
    ]
    columns = ("family", "motions", *QUANTITIES.values())
    of_shares = (Column(name, "%", ".1f", scale=100.0) for name in shares)
    spreads = []
    for name, column in QUANTITIES.items():
        values = data.all[name]
        figures = [values.mean(dtype=float), *np.quantile(values, list(SPREAD.values()))]
        spreads.append((column.title, *(f"{column.scale * x + 0.0:.3f}" for x in figures)))
    return [
        Table.pairs(f"{data.manifest.robot}: {counted(data.trajectories, 'motion')}", facts(data)),
        Table.of("", (*columns, *of_shares), families),
        Table.of("", ("", "mean", *SPREAD), spreads),
    ]


# The page

BIN_EDGES = 50
LAST_QUANTILE = 0.995
"""Histograms end at this quantile of the values; the last bar includes all larger values."""


def write_page(folder: str | Path, file: str | Path, robot: Robot | None = None) -> DataFigures:
    """Write tables and plots of a data set to an .html file, and return the statistics.

    `robot` is the robot of the data; None: the robot with the name in the manifest. Raises InputError if
    matplotlib is not installed, for a file that cannot be written, for another robot than that of the data,
    and as `read_figures` does.
    """
    read_manifest(folder)  # first: the error should name the missing data set, not the page's folder
    target = check_output(file, (".html", ".htm"))
    data = read_figures(folder)
    data.manifest.check_robot(robot)
    write_atomically(target, data_report(data, Path(folder).resolve().name).page)
    return data


def data_report(data: DataFigures, name: str) -> Report:
    """The report of a data set."""
    manifest = data.manifest
    report = Report(name)
    for table in tables(data):
        report.table(table)
    distance = f"{100 * data.safety_distance:.3g} cm"
    report.plot(
        "motions.svg",
        f"Motions by family; except near start and goal, the search tries to keep {distance} from obstacles. "
        "Detours: without trivial motions",
        histograms(_motions(data), 3),
    )
    caption = "Goals per problem, and the excess cost of all other goals over the best goal"
    report.plot("goals.svg", caption, histograms(_goals(data), 2))
    q = data.sample["trajectories"]
    joints: Histograms = {
        f"{name} [rad] or [m]": (
            np.linspace(manifest.lower[j], manifest.upper[j], 41),
            {"all waypoints": q[..., j].reshape(-1), "start": q[:, 0, j], "goal": q[:, -1, j]},
        )
        for j, name in enumerate(manifest.joint_names)
    }
    caption = "Joint values between their limits"
    report.plot("joints.svg", caption, histograms(joints, min(4, manifest.dof)))
    versions = ", ".join(f"{name} {version}" for name, version in manifest.versions.items())
    note = "The last bar of a histogram holds all larger values."
    report.add(plain(f"Made with {versions}; robot {manifest.robot_fingerprint}. {note}"))
    return report


def _motions(data: DataFigures) -> Histograms:
    """Histograms of the quantities by family; detours without trivial motions."""
    panels: Histograms = {}
    for name, column in QUANTITIES.items():
        low = float(name == "detour")
        chosen = ~(data.all["line_free"] & (name == "detour"))
        values = column.scale * data.all[name]
        high = max(np.quantile(values[chosen], LAST_QUANTILE) if chosen.any() else 0.0, low + 1e-3)
        parts = {family: values[rows & chosen] for family, rows in data.families.items()}
        panels[column.title] = np.linspace(low, high, BIN_EDGES), parts
    return panels


def _goals(data: DataFigures) -> Histograms:
    """Histograms of the numbers of given and reached goals, and of the excess cost of all reached goals
    except the best."""
    costs = data.sample["goal_costs"].astype(np.float64)
    numbers = {"given": (~np.isnan(costs)).sum(axis=1), "reached": np.isfinite(costs).sum(axis=1)}
    best = np.nanmin(np.where(np.isinf(costs), np.nan, costs), axis=1, keepdims=True)
    with np.errstate(divide="ignore", invalid="ignore"):  # the best cost is 0 if a motion stands still
        excess = 100 * (costs / best - 1)
    excess = excess[np.isfinite(excess) & (excess > 0)]
    end = np.quantile(excess, LAST_QUANTILE) if len(excess) else 1.0
    return {
        "goals": (np.arange(costs.shape[1] + 1) + 0.5, numbers),
        "excess cost of the others [%]": (np.linspace(0, end, BIN_EDGES), {"others": excess}),
    }
