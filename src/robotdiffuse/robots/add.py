"""Making a robot from a URDF: spheres, allowed collisions and limits, written as a robot folder."""

import os
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from robotdiffuse.errors import InputError
from robotdiffuse.robots.allowed_collisions import (
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
from robotdiffuse.robots.urdf import content_hash, read_urdf

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
class AddReport:
    """What `add_robot` made."""

    robot: Robot
    folder: Path
    links: tuple[LinkReport, ...]
    pairs: tuple[PairReport, ...]
    seconds: float

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
) -> AddReport:
    """Read a URDF (see read_urdf), fit spheres, find allowed collisions, write the robot folder.

    `name` defaults to the URDF's; `out`, the folder, to `user_robots() / name`; `limits` is a file in the
    form of MoveIt's joint_limits.yaml. The same input and seed give the same robot. Raises InputError for
    bad input.
    """
    begin = time.perf_counter()
    report = progress or (lambda what, step, steps: None)
    robot = read_urdf(urdf, base, tip, locked)
    name = name or robot.name
    if not name or Path(name).name != name or name.startswith("."):
        raise InputError(f"robot name is {name!r}; it must be usable as the name of a folder")
    robot = replace(robot, name=name)
    if limits is not None:
        robot = with_limits(robot, read_limits(limits))
    if not robot.meshes:
        raise InputError(f"{urdf}: no link has collision geometry; nothing could be checked")
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
    robot = replace(robot, allowed_collisions=allowed_pairs(pairs))
    folder = user_robots() / name if out is None else Path(out)
    source = {"urdf": Path(urdf).name, "sha256": content_hash(urdf), "licence": licence}
    write_bundle(robot, folder, source)
    report("done", steps, steps)
    return AddReport(read_bundle(folder), folder, tuple(links), pairs, time.perf_counter() - begin)
