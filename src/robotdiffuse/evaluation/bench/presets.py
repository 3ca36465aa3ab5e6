"""Comparisons of planners by name, for `robotdiffuse bench run --preset NAME`: the tables of
docs/results.md."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path as FilePath

from robotdiffuse.core.errors import unknown_name
from robotdiffuse.evaluation.bench.runner import BenchSettings

BY_LENGTH = ":objective=length"
"""Suffix of planners that compete in the length of paths."""
NONTRIVIAL_ROP = ("rop_nontrivial", "rop_dense_nontrivial")


@dataclass(frozen=True)
class Stage:
    """One pass of a preset: planners on the first problems of each set, with one time limit."""

    planners: tuple[str, ...]
    time_limit: float
    """Of a call [s]."""
    count: int
    """Problems of each set."""
    equal_time: bool = False
    """See `BenchSettings`."""


@dataclass(frozen=True)
class Preset:
    description: str
    problems: tuple[str, ...]
    """Problem sets of every stage."""
    stages: tuple[Stage, ...]


PRESETS: dict[str, Preset] = {
    "equal_time": Preset(
        "path lengths at one second: search, the hybrid, diffusion, learned baselines",
        (*NONTRIVIAL_ROP, "shelf_nontrivial"),
        (
            Stage(
                (
                    *(name + BY_LENGTH for name in ("robotdiffuse", "aorrtc", "rrt_connect")),
                    *("shared_tree_rrt_star", "diffusion", "mpd", "edmp", "mpnet", "mpinets"),
                ),
                1.0,
                30,
                equal_time=True,
            ),
        ),
    ),
    "learning": Preset(
        "what the network adds: diffusion and the hybrid beside search, with 0.1 and 0.3 s",
        (*NONTRIVIAL_ROP, "shelf_nontrivial"),
        tuple(
            Stage(
                ("robotdiffuse" + BY_LENGTH, "diffusion", "aorrtc" + BY_LENGTH, "shared_tree_rrt_star"),
                limit,
                150,
                equal_time=True,
            )
            for limit in (0.1, 0.3)
        ),
    ),
    "durations": Preset(
        "durations of motions with 0.1 and 1 s: by time, by length, and the timed paths of OMPL",
        ("shelf_nontrivial", "crate_nontrivial", "table_nontrivial", "kitchen_nontrivial", "rop_nontrivial"),
        tuple(
            Stage(
                (
                    *("aorrtc", "robotdiffuse", "diffusion"),
                    *(name + BY_LENGTH for name in ("aorrtc", "robotdiffuse")),
                    *("ompl_rrt_connect", "ompl_aorrtc"),
                ),
                limit,
                100,
            )
            for limit in (0.1, 1.0)
        ),
    ),
    "anytime": Preset(
        "anytime search beside OMPL's: Shared-Tree Informed RRT*, AORRTC, Informed RRT*",
        NONTRIVIAL_ROP,
        (
            Stage(
                ("shared_tree_rrt_star", "aorrtc" + BY_LENGTH, "ompl_aorrtc", "ompl_informed_rrt_star"),
                1.0,
                100,
                equal_time=True,
            ),
        ),
    ),
    "restarts": Preset(
        "the hybrid beside restarts of RRT-Connect until the same limit",
        (*NONTRIVIAL_ROP, "shelf_nontrivial"),
        (Stage(("robotdiffuse" + BY_LENGTH, "rrt_connect" + BY_LENGTH), 1.0, 100, equal_time=True),),
    ),
}


def preset_settings(
    name: str,
    out: FilePath,
    problems: Sequence[str] = (),
    count: int | None = None,
    workers: int = 1,
    cluster: str | None = None,
) -> list[BenchSettings]:
    """The settings of each stage of a preset.

    problems: sets beside those of the preset.
    count: most problems of each set; None: as the preset says.

    Raises InputError for an unknown preset, listing the known.
    """
    if name not in PRESETS:
        raise unknown_name("preset", name, PRESETS)
    preset = PRESETS[name]
    found = []
    for stage in preset.stages:
        settings = BenchSettings(
            stage.planners,
            (*preset.problems, *problems),
            out,
            time_limit=stage.time_limit,
            count=stage.count,
            workers=workers,
            cluster=cluster,
            equal_time=stage.equal_time,
        )
        found.append(settings if count is None else replace(settings, count=min(count, stage.count)))
    return found
