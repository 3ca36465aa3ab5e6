"""Making a robot from a URDF: spheres, allowed collisions and limits, written as a robot folder."""

import resource
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from robotdiffuse.core.errors import InputError, unknown_name
from robotdiffuse.robots.fitting.allowed_collisions import BY_SRDF, CHECKED, LIMITS, NAMED, POSE, PairReport
from robotdiffuse.robots.fitting.false_collisions import FalseCollisions, PairFalseCollisions
from robotdiffuse.robots.fitting.preparation import LinkReport, PreparationSettings, Progress, prepare
from robotdiffuse.robots.parsing.joint_limits import read_limits, with_limits
from robotdiffuse.robots.parsing.srdf import read_srdf, srdf_beside
from robotdiffuse.robots.parsing.urdf import UrdfTree
from robotdiffuse.robots.robot import Robot
from robotdiffuse.robots.robot_folder import read_robot_folder, write_robot_folder
from robotdiffuse.robots.user_data_dir import user_robots

LITTLE, REFUSED = 0.2, 0.08
"""Shares of free configurations, and of those that spheres refuse, from which on there is a warning."""
MOST_PROPOSED = 3
"""Pairs that the error for a robot that is never free proposes, where none collides always."""
TAKEN_FOR_SAFE = {
    LIMITS: "up to a stop of one joint, which its limits allow",
    POSE: "as in a pose that the SRDF names",
}
"""Reasons that somebody should look at, with what speaks for the pair."""
KILO = 1 if sys.platform == "darwin" else 1024
"""Bytes per unit of what the system says of a process's memory."""


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
    refusals: FalseCollisions
    seconds: float
    """Processor time."""
    memory: int
    """The most that this process has used so far [bytes]."""
    srdf: Path | None = None
    """The SRDF that was given, or found beside the URDF."""
    differences: tuple[PairDifference, ...] = ()
    """Where sampling and the SRDF differ."""

    @property
    def sphere_count(self) -> int:
        return sum(link.spheres for link in self.links)

    @property
    def warnings(self) -> tuple[str, ...]:
        """What will keep this robot from moving, and pairs that are taken for safe though they meet."""
        found, of = [], self.false_collisions
        worst = "; ".join(f"{' against '.join(p.links)} {p.by_spheres:.1%}" for p in of.pairs[:3])
        if of.free < LITTLE:
            often = sorted(of.pairs, key=lambda pair: -pair.colliding)[:3]
            names = "; ".join(f"{' against '.join(pair.links)} {pair.colliding:.1%}" for pair in often)
            found.append(
                f"only {of.free:.1%} of the configurations are free of self-collision by the URDF's meshes "
                f"({names}); a pair that may touch can be allowed"
            )
        if of.by_spheres > REFUSED:
            found.append(
                f"covering spheres refuse {of.by_spheres:.1%} of the free configurations, more than "
                f"{REFUSED:.0%} ({worst}); plans there will not be found"
            )
        found += [
            f"{' against '.join(pair.links)} is not checked, though the URDF's meshes collide in "
            f"{pair.colliding:.1%} of the configurations, {TAKEN_FOR_SAFE[pair.reason]}; see that the arm "
            f"cannot hit itself there"
            for pair in self.pairs
            if pair.reason in TAKEN_FOR_SAFE and pair.colliding
        ]
        return (*found, *(f"spheres do not cover {link.link}" for link in self.links if not link.covered))


def never_free(refusals: FalseCollisions) -> bool:
    """Whether every configuration that was looked at collides with itself, so that nothing can be planned."""
    return refusals.free == 0 or refusals.by_parts == 1


def never_free_error(urdf: str | Path, refusals: FalseCollisions) -> InputError:
    """The error for a robot that is never free; it proposes the pairs of links that always collide, or else
    those that collide most often."""

    def colliding(pair: PairFalseCollisions) -> float:
        return max(pair.colliding, pair.by_parts)

    often = sorted(refusals.pairs, key=lambda pair: -colliding(pair))
    worst = [pair for pair in often if colliding(pair) == 1] or often[:MOST_PROPOSED]
    names = "; ".join(f"{' and '.join(pair.links)} collide in {colliding(pair):.1%}" for pair in worst)
    options = " ".join(f"--allow {' '.join(pair.links)}" for pair in worst)
    return InputError(
        f"{urdf}: every configuration collides with itself: {names}; if the links may touch, allow it by "
        f"{options}, or give the SRDF, which knows such pairs, by --srdf FILE"
    )


def add_robot(
    urdf: str | Path,
    name: str | None = None,
    base: str | None = None,
    tip: str | None = None,
    locked: dict[str, float] | None = None,
    limits: str | Path | None = None,
    out: str | Path | None = None,
    licence: str = "see the URDF",
    settings: PreparationSettings | None = None,
    seed: int = 0,
    progress: Progress = lambda what, step, steps: None,
    group: str | None = None,
    srdf: str | Path | None = None,
    allow: Sequence[tuple[str, str]] = (),
    packages: dict[str, str | Path] | None = None,
) -> AddReport:
    """Read a URDF (see read_urdf), prepare it (see preparation.py), write the robot folder.

    `name` defaults to the URDF's; `out`, the folder, to `user_robots() / name`; `limits` is a file in the
    form of MoveIt's joint_limits.yaml. The same input and seed give the same robot. Raises InputError for
    bad input, and for a robot that always collides with itself.

    Groups, poses and passive joints are those of `srdf`, or of the SRDF found beside the URDF. Pairs of links
    that need no check are found by sampling and compared with the SRDF's; a given `srdf` allows its pairs
    too, one that was found does not. `allow` are further pairs.
    """
    begin = time.process_time()
    tree = UrdfTree(Path(urdf), packages or {})
    found = srdf_beside(urdf, tree.name) if srdf is None else Path(srdf)
    semantics = None if found is None else read_srdf(found)
    robot = tree.robot(base, tip, locked, group, semantics)
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
    known = {} if semantics is None else semantics.allowed
    allowed = {pair: BY_SRDF for pair in known} if srdf is not None else {}
    allowed |= {frozenset(pair): NAMED for pair in allow}
    surfaces = {link: tree.surfaces(link) for link in robot.meshes}
    made = prepare(robot, surfaces, settings or PreparationSettings(), seed, progress, allowed)
    if never_free(made.false_collisions):
        raise never_free_error(urdf, made.false_collisions)
    differences = tuple(
        PairDifference(pair.links, pair.reason, pair.colliding, known.get(frozenset(pair.links), CHECKED))
        for pair in made.sampled
        if semantics is not None and (pair.reason == CHECKED) == (frozenset(pair.links) in known)
    )
    folder = user_robots() / name if out is None else Path(out)
    source = {"urdf": Path(urdf).name, "sha256": tree.digest, "licence": licence}
    shares = {
        "free": round(made.false_collisions.free, 4),
        "refused": round(made.false_collisions.by_spheres, 4),
    }
    note = (
        f"{made.false_collisions.free:.1%} of the configurations are free of self-collision; convex parts refuse "
        f"{made.false_collisions.by_parts:.1%} of these, spheres {made.false_collisions.by_spheres:.1%}"
    )
    write_robot_folder(replace(made.robot, notes=(*robot.notes, note)), folder, source | shares)
    seconds, memory = time.process_time() - begin, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * KILO
    shown = (made.links, made.pairs, made.false_collisions, seconds, memory, found, differences)
    return AddReport(read_robot_folder(folder), folder, *shown)
