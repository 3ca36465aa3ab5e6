"""From settings to a folder of shards: what is there is kept, what is missing is made, here or on Ray."""

import json
import platform
from collections.abc import Callable
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path

from robotdiffuse import __version__
from robotdiffuse.errors import InputError, unknown_name
from robotdiffuse.generation.settings import FAMILIES, SLOTS, GenerationSettings
from robotdiffuse.generation.workers import CLUSTERS, on_this_machine
from robotdiffuse.learning.shards import (
    MANIFEST,
    Manifest,
    read_manifest,
    remove_leftovers,
    shard_indices,
    write_manifest,
    write_shard,
)
from robotdiffuse.robots import load_robot
from robotdiffuse.robots.fingerprint import robot_fingerprint


def generate(
    settings: GenerationSettings,
    out: Path,
    workers: int = 1,
    cluster: str | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> int:
    """Make the shards that the folder lacks; returns the number of trajectories in all.

    Killed at any moment, a second call goes on, and the finished folder is the same, bit for bit, as that of
    a call that nothing disturbed, whatever the number of workers. With `cluster` "ray" shards are made by the
    Ray cluster that RAY_ADDRESS names, or by one started here. `progress` is called with the numbers of
    trajectories that are there and of all.

    Raises InputError for a folder of other settings, of another version or robot, or one that cannot be
    written.
    """
    if workers < 1:
        raise InputError(f"workers is {workers}; it must be at least 1")
    if cluster is not None and cluster not in CLUSTERS:
        raise unknown_name("cluster", cluster, CLUSTERS)
    _claim(settings, out)
    remove_leftovers(out)
    there = set(shard_indices(out))
    missing = [index for index in range(settings.shards) if index not in there]
    done = settings.trajectories - sum(settings.rows(index) for index in missing)
    if progress:
        progress(done, settings.trajectories)
    if missing:
        if cluster is None:
            made = on_this_machine(settings, missing, workers)
        else:
            made = CLUSTERS[cluster](settings, missing)
        for index, (arrays, counts) in made:
            write_shard(out, index, arrays, counts)
            done += settings.rows(index)
            if progress:
                progress(done, settings.trajectories)
    return settings.trajectories


def manifest_of(settings: GenerationSettings) -> Manifest:
    """The manifest of the data that the settings make."""
    robot = load_robot(settings.robot)
    packages = ("numpy", "numba", "zarr")
    return Manifest(
        robot=settings.robot,
        robot_fingerprint=robot_fingerprint(robot),
        joint_names=robot.joint_names,
        lower=tuple(robot.lower.tolist()),
        upper=tuple(robot.upper.tolist()),
        frames=settings.frames,
        timing=settings.timing,
        families={name: asdict(family) for name, family in FAMILIES.items()},
        slots=SLOTS,
        goals=settings.goals,
        trajectories=settings.trajectories,
        shard=settings.shard,
        settings=asdict(settings),
        versions={"robotdiffuse": __version__, "python": platform.python_version()}
        | {name: version(name) for name in packages},
    )


def _claim(settings: GenerationSettings, out: Path) -> None:
    """Write the manifest, or see to it that the one that is there is of the same data."""
    wanted = manifest_of(settings)
    if not (out / MANIFEST).exists():
        if shard_indices(out):
            raise InputError(f"{out} holds shards but no {MANIFEST}; use another folder")
        write_manifest(out, wanted)
        return
    found = read_manifest(out)
    found.check_robot(load_robot(settings.robot))
    for name, value in wanted.settings.items():
        if _plain(found.settings.get(name)) != _plain(value):
            raise InputError(
                f"{out} was begun with {name} {found.settings.get(name)}, not {value}; use the same "
                "settings, or another folder"
            )
    for name, value in wanted.versions.items():
        if found.versions.get(name) != value:
            raise InputError(
                f"{out} was begun with {name} {found.versions.get(name)}; this is {value}, whose data may "
                "differ: use that version, or another folder"
            )


def _plain(value: object) -> object:
    """As it comes back from JSON."""
    return json.loads(json.dumps(value))
