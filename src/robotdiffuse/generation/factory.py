"""Data generation into a folder of shards: makes the missing ones on this machine or on Ray."""

import json
import platform
from collections.abc import Callable
from contextlib import closing
from dataclasses import asdict, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

from robotdiffuse import __version__
from robotdiffuse.core.errors import InputError, unknown_name
from robotdiffuse.core.output_files import lock_folder
from robotdiffuse.core.processes import delay_interrupts, on_this_machine
from robotdiffuse.core.ray_cluster import CLUSTERS
from robotdiffuse.datasets.manifest import MANIFEST, Manifest, floor_record, read_manifest, write_manifest
from robotdiffuse.datasets.shards import remove_leftovers, shard_indices, write_shard
from robotdiffuse.generation.settings import GenerationSettings
from robotdiffuse.generation.shard_maker import Arrays, Counts, make_shard
from robotdiffuse.robots import load_robot, names_a_file
from robotdiffuse.robots.fingerprint import robot_fingerprint

PACKAGES = ("numpy", "numba", "zarr")


def generate(
    settings: GenerationSettings,
    out: Path,
    workers: int = 1,
    cluster: str | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> int:
    """Make the shards that the folder lacks; returns the number of trajectories in all.

    After an interruption at any moment, another call continues, and the finished folder is the same, bit for
    bit, as that of an uninterrupted call with any number of workers. With `cluster` "ray" the Ray cluster
    that RAY_ADDRESS names, or one started here, makes the shards. `progress` is called with the numbers of
    trajectories done and in all.

    Raises InputError for a folder of other settings, of another version or robot, for one that cannot be
    written, and for one that another process is filling.
    """
    if workers < 1:
        raise InputError(f"workers is {workers}; it must be at least 1")
    if cluster is not None and cluster not in CLUSTERS:
        raise unknown_name("cluster", cluster, CLUSTERS)
    wanted = manifest_of(settings)
    with lock_folder(out):
        try:
            remove_leftovers(out)
            _claim(wanted, out)
            return _fill(settings, out, workers, cluster, progress or _silent)
        finally:
            remove_leftovers(out)


def _silent(_done: int, _total: int) -> None:
    """Ignore progress."""


def _fill(
    settings: GenerationSettings,
    out: Path,
    workers: int,
    cluster: str | None,
    progress: Callable[[int, int], None],
) -> int:
    there = set(shard_indices(out))
    missing = [index for index in range(settings.shards) if index not in there]
    done = settings.trajectories - sum(settings.rows(index) for index in missing)
    progress(done, settings.trajectories)
    if not missing:
        return settings.trajectories
    if cluster is None:
        made = on_this_machine(make_shard, [(settings, index) for index in missing], workers)
    else:
        absolute = _as_absolute(settings)
        here = _reproducibility_record(absolute)
        made = CLUSTERS[cluster](_make_on_node, [(absolute, index, here) for index in missing])
    # close it at once, so that workers stop when this is interrupted
    with closing(made):
        for number, (arrays, counts) in made:
            index = missing[number]
            # else zarr's threads would write files after the clean-up
            with delay_interrupts():
                write_shard(out, index, arrays, counts)
            done += settings.rows(index)
            progress(done, settings.trajectories)
    return settings.trajectories


def _as_absolute(settings: GenerationSettings) -> GenerationSettings:
    """The settings with an absolute path of the robot, for nodes with other working folders."""
    file = Path(settings.robot)
    return replace(settings, robot=str(file.resolve())) if names_a_file(settings.robot) else settings


def _make_on_node(settings: GenerationSettings, index: int, wanted: dict[str, str]) -> tuple[Arrays, Counts]:
    for name, found in _reproducibility_record(settings).items():
        if found != wanted[name]:
            raise InputError(
                f"a node of the Ray cluster has {name} {found}, this machine {wanted[name]}; their data may "
                "differ: install the same on all"
            )
    return make_shard(settings, index)


def _reproducibility_record(settings: GenerationSettings) -> dict[str, str]:
    """Versions and robot that two machines must share to make the same data."""
    return versions() | {f"robot {settings.robot}": robot_fingerprint(load_robot(settings.robot))}


def versions() -> dict[str, str]:
    """Versions of the software that the data depend on."""
    return {"robotdiffuse": __version__, "python": platform.python_version()} | {
        name: version(name) for name in PACKAGES
    }


def manifest_of(settings: GenerationSettings) -> Manifest:
    """The manifest of a data set with these settings."""
    robot = load_robot(settings.robot)
    return Manifest(
        robot=settings.robot,
        robot_fingerprint=robot_fingerprint(robot),
        joint_names=robot.joint_names,
        lower=tuple(robot.lower.tolist()),
        upper=tuple(robot.upper.tolist()),
        waypoints=settings.waypoints,
        timing=settings.timing,
        families={name: asdict(family) for name, family in settings.families.items()},
        floors={name: floor_record(family.floor) for name, family in settings.families.items()},
        slots=settings.slots,
        goals=settings.goals,
        trajectories=settings.trajectories,
        shard=settings.shard,
        settings=asdict(settings),
        versions=versions(),
    )


def _claim(wanted: Manifest, out: Path) -> None:
    """Write the manifest, or raise InputError if the folder's manifest is of other data."""
    if not (out / MANIFEST).exists():
        if shard_indices(out):
            raise InputError(f"{out} holds shards but no {MANIFEST}; use another folder")
        write_manifest(out, wanted)
        return
    found = read_manifest(out)
    found.check_robot(load_robot(wanted.robot))
    begun = _by_name(found.settings)
    for name, value in _by_name(wanted.settings).items():
        if begun.get(name) != value:
            raise InputError(
                f"{out} was begun with {name} {begun.get(name)}, not {value}; use the same settings, or "
                "another folder"
            )
    for name, value in wanted.versions.items():
        if found.versions.get(name) != value:
            raise InputError(
                f"{out} was begun with {name} {found.versions.get(name)}; this is {value}, whose data may "
                "differ: use that version, or another folder"
            )


def _by_name(settings: dict[str, Any]) -> dict[str, str]:
    """Settings as JSON texts, in which the order of a mix counts; those of the search as search.NAME."""
    search = settings.get("search")
    inner = search if isinstance(search, dict) else {}
    named = settings | {f"search.{name}": value for name, value in inner.items()}
    return {name: json.dumps(value) for name, value in named.items() if name != "search"}
