"""Figures of a data set, and tables of them; `page` draws them as plots."""

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path as FilePath

import numpy as np
from jaxtyping import Bool
from numpy import ndarray

from robotdiffuse.core.errors import InputError
from robotdiffuse.datasets.manifest import Manifest, read_manifest
from robotdiffuse.datasets.motion_rows import scenes_of
from robotdiffuse.datasets.shards import SPLITS, existing_shards, read_shard, shard_path, split_of
from robotdiffuse.evaluation.tables import Column, Table

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
ARRAYS_OF_ALL = (
    "cost",
    "clearance",
    "end_clearance",
    "safety_distance",
    "line_free",
    "detour",
    "family",
    "goal_index",
)
"""Arrays that are kept of all motions."""
ARRAYS_OF_SAMPLE = (
    "start",
    "goals",
    "goal_costs",
    "target_pose",
    "obstacle_kinds",
    "obstacle_params",
    "trajectories",
)
"""Arrays that are kept of the sample."""
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
    counts: dict[str, int]
    """Numbers of problems `tried` and by OUTCOMES, over all shards."""
    splits: dict[str, int]
    """Trajectories by split."""
    all: dict[str, ndarray] = field(repr=False)
    """ARRAYS_OF_ALL, of all motions."""
    sample: dict[str, ndarray] = field(repr=False)
    """Both kinds of arrays of the sample; `trajectories` with SAMPLED_WAYPOINTS waypoints."""

    @property
    def trajectories(self) -> int:
        return len(self.all["cost"])

    @property
    def success(self) -> float:
        """Share of solved problems, without thinned ones; NaN without any."""
        tried = self.counts.get("tried", 0) - self.counts.get("thinned", 0)
        return self.counts.get("solved", 0) / tried if tried else float("nan")

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
    every = max(1, manifest.trajectories // SAMPLED_MOTIONS)
    waypoints = np.unique(np.linspace(0, manifest.waypoints - 1, SAMPLED_WAYPOINTS).round().astype(int))
    small: list[dict[str, ndarray]] = []
    sample: list[dict[str, ndarray]] = []
    counts: dict[str, int] = {}
    splits = np.zeros(len(SPLITS), np.int64)
    size = first = 0
    for index in indices:
        shard = read_shard(folder, index, tuple({*ARRAYS_OF_ALL, *ARRAYS_OF_SAMPLE}))
        rows = np.arange(-first % every, len(shard), every)
        first += len(shard)
        small.append({name: shard[name] for name in ARRAYS_OF_ALL})
        picked = {
            name: np.array(shard[name][rows])
            for name in {*ARRAYS_OF_ALL, *ARRAYS_OF_SAMPLE} - {"trajectories"}
        }
        sample.append(picked | {"trajectories": np.array(shard["trajectories"][np.ix_(rows, waypoints)])})
        splits += np.bincount(split_of(scenes_of(manifest, shard)), minlength=len(SPLITS))
        for name, value in shard.counts.items():
            counts[name] = counts.get(name, 0) + value
        size += sum(file.stat().st_size for file in shard_path(folder, index).rglob("*") if file.is_file())
    if not first:
        raise InputError(f"{folder} holds no trajectories")
    return DataFigures(
        manifest=manifest,
        shards=len(indices),
        bytes=size,
        counts=counts,
        splits=dict(zip(SPLITS, splits.tolist(), strict=True)),
        all={name: np.concatenate([part[name] for part in small]) for name in ARRAYS_OF_ALL},
        sample={name: np.concatenate([part[name] for part in sample]) for name in sample[0]},
    )


def facts(data: DataFigures) -> list[tuple[str, str]]:
    """Figures and their captions, for the head of a report."""
    planned, waypoints = data.manifest.trajectories, data.trajectories * data.manifest.waypoints
    train, *held_out = ((name, f"{count:,}") for name, count in data.splits.items())
    spacing = "length" if data.manifest.timing == "arc" else "time"
    return [
        (f"{data.trajectories:,}", f"of {planned:,} motions" if data.trajectories < planned else "motions"),
        (
            f"{waypoints:,}" if waypoints < 1e6 else f"{waypoints / 1e6:.1f} M",
            f"waypoints, evenly spaced in {spacing}",
        ),
        (size_in_words(data.bytes), f"in {data.shards:,} shards"),
        (f"{100 * data.success:.1f} %", "of problems solved"),
        (
            f"{100 * data.kept:.1f} %",
            f"come no closer than {100 * data.safety_distance:.3g}\u00a0cm or than their ends",
        ),
        (f"{100 * data.trivial:.1f} %", "trivial: the line is free"),
        (f"{np.median(data.all['cost']):.2f} rad", "median length"),
        (train[1], f"to {train[0]} on, " + ", ".join(f"{count} {name}" for name, count in held_out)),
    ]


def tables(data: DataFigures) -> list[Table]:
    """The tables of a data set."""
    lost = ", ".join(f"{data.counts.get(name, 0):,} {name}" for name in OUTCOMES[1:])
    about = [
        *((what, value) for value, what in facts(data)),
        (f"of {data.counts.get('tried', 0):,} problems", lost),
        ("keep that distance all along, where both ends have it", f"{100 * data.kept_throughout:.1f} %"),
        ("goals reached per problem", f"{data.goals_reached:.1f}"),
    ]
    trivial = Column("trivial", "%", ".1f", scale=100.0)
    families = [
        (
            name,
            int(rows.sum()),
            float(data.all["line_free"][rows].mean()),
            *(float(np.median(data.all[of][rows])) for of in QUANTITIES),
        )
        for name, rows in data.families.items()
    ]
    spreads = [
        (column.title, *(f"{column.scale * x + 0.0:.3f}" for x in (values.mean(dtype=float), *quantiles)))
        for of, column in QUANTITIES.items()
        for values in (data.all[of],)
        for quantiles in (np.quantile(values, list(SPREAD.values())).tolist(),)
    ]
    return [
        Table.pairs(f"{data.manifest.robot}: {data.trajectories:,} motions", about),
        Table.of("", ("medians of", "motions", trivial, *QUANTITIES.values()), families),
        Table.of("", ("", "mean", *SPREAD), spreads),
    ]


def size_in_words(size: int) -> str:
    """A size on disk with its unit."""
    return f"{size / 1e9:.2f} GB" if size >= 1e9 else f"{size / 1e6:.1f} MB"
