"""Making a robot from a URDF: spheres, allowed collisions and limits, written as a robot folder."""

import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from robotdiffuse.errors import InputError, unknown_name
from robotdiffuse.robots.allowed_collisions import (
    BY_SRDF,
    CHECKED,
    NAMED,
    PairReport,
    SamplingSettings,
    allowed_pairs,
    find_allowed_collisions,
)
from robotdiffuse.robots.bundle import read_bundle, write_bundle
from robotdiffuse.robots.interfaces import face_allowances, stick_out_of_arm
from robotdiffuse.robots.limits import read_limits, with_limits
from robotdiffuse.robots.robot import Robot
from robotdiffuse.robots.sphere_fitting import SphereSettings, covered, fit_spheres, stick_out
from robotdiffuse.robots.srdf import Srdf, read_srdf, srdf_beside
from robotdiffuse.robots.urdf import content_hash, read_urdf, robot_name

Progress = Callable[[str, int, int], None]
"""Called with what is being done, the number of the step and the number of steps."""


@dataclass(frozen=True)
class LinkReport:
    """The spheres of one link."""

    link: str
    spheres: int
    stick_out: float
    """How far a sphere reaches out of the arm, at most [m]: of the meshes of the link and, where it meets its
    neighbours, of theirs, at any value of the joints between them."""
    covered: bool
    """Whether the spheres provably cover the surface of the meshes."""


@dataclass(frozen=True)
class PairDifference:
    """Two links that sampling and an SRDF see differently."""

    links: tuple[str, str]
    sampled: str
    """The reason by sampling, or checked."""
    colliding: float
    """Share of the configurations in which the meshes collide."""
    srdf: str
    """The SRDF's reason, or checked."""


@dataclass(frozen=True)
class AddReport:
    """What `add_robot` made."""

    robot: Robot
    folder: Path
    links: tuple[LinkReport, ...]
    pairs: tuple[PairReport, ...]
    seconds: float
    srdf: Path | None = None
    """The SRDF that was given, or found beside the URDF."""
    differences: tuple[PairDifference, ...] = ()
    """Where sampling and the SRDF differ."""

    @property
    def sphere_count(self) -> int:
        return sum(link.spheres for link in self.links)


def user_robots() -> Path:
    """Where robots that were added are kept: $ROBOTDIFFUSE_ROBOTS or the user's data directory."""
    chosen = os.environ.get("ROBOTDIFFUSE_ROBOTS")
    if chosen:
        return Path(chosen)
    data = os.environ.get("XDG_DATA_HOME") or Path.home() / ".local" / "share"
    return Path(data) / "robotdiffuse" / "robots"


def add_robot(
    urdf: str | Path,
    name: str | None = None,
    base: str | None = None,
    tip: str | None = None,
    locked: dict[str, float] | None = None,
    limits: str | Path | None = None,
    out: str | Path | None = None,
    licence: str = "see the URDF",
    spheres: SphereSettings | None = None,
    sampling: SamplingSettings | None = None,
    seed: int = 0,
    progress: Progress | None = None,
    group: str | None = None,
    srdf: str | Path | None = None,
    allow: Sequence[tuple[str, str]] = (),
    packages: dict[str, str | Path] | None = None,
) -> AddReport:
    """Read a URDF (see read_urdf), fit spheres, find allowed collisions, write the robot folder.

    `name` defaults to the URDF's; `out`, the folder, to `user_robots() / name`; `limits` is a file in the
    form of MoveIt's joint_limits.yaml. The same input and seed give the same robot. Raises InputError for
    bad input.

    Groups, poses and passive joints are those of `srdf`, or of the SRDF found beside the URDF. Pairs of links
    that need no check are found by sampling and compared with the SRDF's; a given `srdf` allows its pairs
    too, one that was found does not. `allow` are further pairs.
    """
    begin = time.perf_counter()
    report = progress or (lambda what, step, steps: None)
    semantics, found = _semantics(urdf, srdf, packages)
    robot = read_urdf(urdf, base, tip, locked, group, semantics, packages)
    for link in {link for pair in allow for link in pair} - {*robot.link_names}:
        raise unknown_name("link in allow", link, robot.link_names)
    name = name or robot.name
    if not name or Path(name).name != name or name.startswith("."):
        raise InputError(f"robot name is {name!r}; it must be usable as a folder's name: give --name NAME")
    robot = replace(robot, name=name)
    if limits is not None:
        robot = with_limits(robot, read_limits(limits))
    if not robot.meshes:
        raise InputError(
            f"{urdf}: no link has collision geometry, nor a visual one that could stand for it; nothing "
            f"could be checked: give its links <collision> elements"
        )
    settings = spheres or SphereSettings()
    steps = len(robot.meshes) + 1
    fitted, links = {}, []
    for step, (link, meshes) in enumerate(robot.meshes.items()):
        report(f"spheres of {link}", step, steps)
        tolerance = settings.tolerance(robot, link)
        hidden = face_allowances(robot, link, tolerance)
        fit = fit_spheres(meshes, tolerance, np.random.default_rng(seed), hidden, settings)
        fitted[link] = np.round(fit, 6)  # as the file holds them: these are judged
        own, arm = float(stick_out(meshes, fitted[link]).max()), stick_out_of_arm(robot, link, fitted[link])
        links.append(LinkReport(link, len(fit), min(own, arm), covered(meshes, fitted[link])))
    report("pairs of links", steps - 1, steps)
    robot = replace(robot, spheres=fitted)
    pairs = find_allowed_collisions(robot, sampling or SamplingSettings(), np.random.default_rng(seed))
    known = {} if semantics is None else semantics.allowed
    differences = tuple(
        PairDifference(pair.links, pair.reason, pair.colliding, known.get(frozenset(pair.links), CHECKED))
        for pair in pairs
        if semantics is not None and (pair.reason == CHECKED) == (frozenset(pair.links) in known)
    )
    pairs = _also_allowed(pairs, {frozenset(pair) for pair in allow}, NAMED)
    pairs = _also_allowed(pairs, set(known) if srdf is not None else set(), BY_SRDF)
    robot = replace(robot, allowed_collisions=allowed_pairs(pairs))
    folder = user_robots() / name if out is None else Path(out)
    source = {"urdf": Path(urdf).name, "sha256": content_hash(urdf, packages), "licence": licence}
    write_bundle(robot, folder, source)
    report("done", steps, steps)
    seconds = time.perf_counter() - begin
    return AddReport(read_bundle(folder), folder, tuple(links), pairs, seconds, found, differences)


def _semantics(
    urdf: str | Path, srdf: str | Path | None, packages: dict[str, str | Path] | None
) -> tuple[Srdf | None, Path | None]:
    """What the given SRDF says, or the one beside the URDF, and which one it is."""
    if srdf is not None:
        return read_srdf(srdf), Path(srdf)
    found = srdf_beside(urdf, robot_name(urdf, packages))
    return (None, None) if found is None else (read_srdf(found), found)


def _also_allowed(
    pairs: tuple[PairReport, ...], allowed: set[frozenset[str]], reason: str
) -> tuple[PairReport, ...]:
    return tuple(
        replace(pair, reason=reason) if pair.reason == CHECKED and frozenset(pair.links) in allowed else pair
        for pair in pairs
    )
