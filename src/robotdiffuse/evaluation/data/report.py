"""What is in a data set, in figures. `page` draws the same as a page of plots."""

from dataclasses import dataclass, field
from pathlib import Path as FilePath

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.data.manifest import Manifest, read_manifest
from robotdiffuse.data.shards import SPLITS, existing_shards, read_shard, scenes_of, shard_path, split_of
from robotdiffuse.errors import InputError

QUANTILES = (0.0, 0.05, 0.5, 0.95, 1.0)
SAMPLE = 20_000
"""Motions, spread evenly over the set, whose larger arrays are kept for the plots."""
FRAMES_KEPT = 24
"""Frames of each of these, spread evenly."""
SMALL = (
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
LARGE = ("start", "goals", "goal_costs", "target_pose", "obstacle_kinds", "obstacle_params", "trajectories")
"""Arrays that are kept of the sample."""
REASONS = ("solved", "unsolved", "refused", "thinned")
"""What becomes of a problem that was tried."""
KEPT_SLACK = 0.002
"""By this a motion may come closer than the safety distance and still count as keeping it: frames cut corners
[m]."""


@dataclass(frozen=True)
class Spread:
    """How a quantity is spread over the motions: its mean, and the quantiles of QUANTILES."""

    mean: float
    quantiles: tuple[float, ...]


@dataclass(frozen=True, eq=False)
class DataColumns:
    """Arrays of a data set, in the order of the shards."""

    manifest: Manifest
    shards: int
    bytes: int
    """Size on disk."""
    counts: dict[str, int]
    """Sums of the shards' counts."""
    splits: dict[str, int]
    all: dict[str, ndarray] = field(repr=False)
    """SMALL, of all motions."""
    sample: dict[str, ndarray] = field(repr=False)
    """SMALL and LARGE of the sample; `trajectories` with FRAMES_KEPT frames."""


@dataclass(frozen=True)
class Family:
    """Figures of one family of scenes."""

    trajectories: int
    trivial: float
    """Share of motions that the straight line would have done."""
    length: Spread
    """[rad, joint-space L2]"""
    detour: Spread
    clearance: Spread
    """[m]"""


@dataclass(frozen=True)
class DataSummary:
    """Figures of a data set."""

    robot: str
    timing: str
    trajectories: int
    planned: int
    frames: int
    """Of all trajectories together."""
    shards: int
    bytes: int
    """Size on disk."""
    splits: dict[str, int]
    """Trajectories by split."""
    counts: dict[str, int]
    """What became of the problems that were tried, by REASONS and `tried`."""
    families: dict[str, Family]
    """The families that occur, by name."""
    length: Spread
    """Of the paths [rad, joint-space L2]."""
    detour: Spread
    """Length in units of the straight line's."""
    clearance: Spread
    """Least distance between arm and obstacles, of each motion [m]."""
    safety_distance: float
    """That the search set out with [m]."""
    kept: float
    """Share of motions that come no closer than the safety distance, or than the closer of start and goal."""
    kept_throughout: float
    """Share that keeps the safety distance all along, of motions whose ends have it; nan if none have."""
    trivial: float
    """Share of motions that the straight line would have done."""
    goals_reached: float
    """Mean number of goals that a search reached."""

    @property
    def success(self) -> float:
        """Share of the problems that were solved, thinned ones left out; nan if there are none."""
        tried = self.counts.get("tried", 0) - self.counts.get("thinned", 0)
        return self.counts.get("solved", 0) / tried if tried else float("nan")


def describe(folder: str | FilePath) -> DataSummary:
    """The figures of a data set. Raises InputError if there is none, or it is damaged or empty."""
    return summarize(read_columns(folder))


def read_columns(folder: str | FilePath) -> DataColumns:
    """Read what figures and plots need, one shard at a time. Raises InputError as `describe`."""
    manifest = read_manifest(folder)
    indices = existing_shards(folder)
    every = max(1, manifest.trajectories // SAMPLE)
    frames = np.unique(np.linspace(0, manifest.frames - 1, FRAMES_KEPT).round().astype(int))
    small: list[dict[str, ndarray]] = []
    sample: list[dict[str, ndarray]] = []
    counts: dict[str, int] = {}
    splits = np.zeros(len(SPLITS), np.int64)
    size = first = 0
    for index in indices:
        shard = read_shard(folder, index, tuple({*SMALL, *LARGE}))
        rows = np.arange(-first % every, len(shard), every)
        first += len(shard)
        small.append({name: shard[name] for name in SMALL})
        picked = {name: np.array(shard[name][rows]) for name in {*SMALL, *LARGE} - {"trajectories"}}
        sample.append(picked | {"trajectories": np.array(shard["trajectories"][np.ix_(rows, frames)])})
        splits += np.bincount(split_of(scenes_of(manifest, shard)), minlength=len(SPLITS))
        for name, value in shard.counts.items():
            counts[name] = counts.get(name, 0) + value
        size += sum(file.stat().st_size for file in shard_path(folder, index).rglob("*") if file.is_file())
    if not first:
        raise InputError(f"{folder} holds no trajectories")
    return DataColumns(
        manifest=manifest,
        shards=len(indices),
        bytes=size,
        counts=counts,
        splits=dict(zip(SPLITS, splits.tolist(), strict=True)),
        all={name: np.concatenate([part[name] for part in small]) for name in SMALL},
        sample={name: np.concatenate([part[name] for part in sample]) for name in sample[0]},
    )


def summarize(columns: DataColumns) -> DataSummary:
    """The figures of what was read."""
    rows, manifest = columns.all, columns.manifest
    families = {
        name: _family(columns, rows["family"] == i)
        for i, name in enumerate(manifest.families)
        if (rows["family"] == i).any()
    }
    whole, ends = safety_distance(columns), rows["end_clearance"].min(axis=1)
    apart = rows["clearance"][ends >= whole]
    return DataSummary(
        robot=manifest.robot,
        timing=manifest.timing,
        trajectories=len(rows["cost"]),
        planned=manifest.trajectories,
        frames=len(rows["cost"]) * manifest.frames,
        shards=columns.shards,
        bytes=columns.bytes,
        splits=columns.splits,
        counts=columns.counts,
        families=families,
        length=_spread(rows["cost"]),
        detour=_spread(rows["detour"]),
        clearance=_spread(rows["clearance"]),
        safety_distance=whole,
        kept=float((rows["clearance"] >= np.minimum(whole, ends) - KEPT_SLACK).mean()),
        kept_throughout=float((apart >= whole - KEPT_SLACK).mean()) if len(apart) else float("nan"),
        trivial=float(rows["line_free"].mean()),
        goals_reached=float(np.isfinite(columns.sample["goal_costs"]).sum(axis=1).mean()),
    )


def safety_distance(columns: DataColumns) -> float:
    """The distance that searches set out with [m]: the greatest that any of them kept."""
    return float(columns.all["safety_distance"].max())


def _family(columns: DataColumns, chosen: ndarray) -> Family:
    rows = {name: values[chosen] for name, values in columns.all.items()}
    spreads = (_spread(rows[name]) for name in ("cost", "detour", "clearance"))
    return Family(int(chosen.sum()), float(rows["line_free"].mean()), *spreads)


def _spread(values: Float[ndarray, "n"]) -> Spread:
    return Spread(float(values.mean(dtype=np.float64)), tuple(np.quantile(values, QUANTILES).tolist()))
