"""Adds a robot from a URDF: fits spheres, finds allowed collisions, and writes a robot folder."""

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

# A warning is given below this fraction of free configurations, and above this fraction of false
# collisions.
MIN_FREE = 0.2
MAX_FALSE_COLLISIONS = 0.08
MAX_PROPOSED = 3
"""Pairs proposed by the error for a robot that always collides with itself, if no single pair always
collides."""
ASSUMED_SAFE = {
    LIMITS: "up to a limit of one joint, and the URDF's limits allow that",
    POSE: "also in a pose that the SRDF names",
}
"""Reasons for allowing a pair that a person should check, with the evidence."""
BYTES_PER_UNIT = 1 if sys.platform == "darwin" else 1024
"""Bytes per unit of `ru_maxrss`."""


@dataclass(frozen=True)
class PairDifference:
    """Two links that sampling and an SRDF classify differently."""

    links: tuple[str, str]
    sampled: str
    """The reason found by sampling, or `checked`."""
    colliding: float
    """Fraction of the configurations in which the meshes collide."""
    srdf: str
    """The SRDF's reason, or `checked`."""


@dataclass(frozen=True)
class AddReport:
    """Result of `add_robot`."""

    robot: Robot
    folder: Path
    links: tuple[LinkReport, ...]
    pairs: tuple[PairReport, ...]
    false_collisions: FalseCollisions
    seconds: float
    """Processor time [s]."""
    memory: int
    """Peak memory of this process so far [bytes]."""
    srdf: Path | None = None
    """The SRDF given, or found beside the URDF."""
    differences: tuple[PairDifference, ...] = ()
    """Pairs of links that sampling and the SRDF classify differently."""

    @property
    def sphere_count(self) -> int:
        return sum(link.spheres for link in self.links)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Problems that will limit planning, and allowed pairs of links whose meshes collide."""
        found = []
        of = self.false_collisions
        worst = "; ".join(f"{' against '.join(p.links)} {p.by_spheres:.1%}" for p in of.pairs[:3])
        if of.free < MIN_FREE:
            often = sorted(of.pairs, key=lambda pair: -pair.colliding)[:3]
            names = "; ".join(f"{' against '.join(pair.links)} {pair.colliding:.1%}" for pair in often)
            found.append(
                f"only {of.free:.1%} of the configurations are free of self-collision by the URDF's meshes "
                f"({names}); allow pairs that may touch with --allow"
            )
        if of.by_spheres > MAX_FALSE_COLLISIONS:
            found.append(
                f"covering spheres collide falsely in {of.by_spheres:.1%} of the free configurations, more "
                f"than {MAX_FALSE_COLLISIONS:.0%} ({worst}); planning cannot use these"
            )
        found += [
            f"{' against '.join(pair.links)} is not checked, though the URDF's meshes collide in "
            f"{pair.colliding:.1%} of the configurations, {ASSUMED_SAFE[pair.reason]}; make "
            f"sure that the arm cannot hit itself there"
            for pair in self.pairs
            if pair.reason in ASSUMED_SAFE and pair.colliding
        ]
        return (*found, *(f"spheres do not cover {link.link}" for link in self.links if not link.covered))


def never_free(false_collisions: FalseCollisions) -> bool:
    """Whether all sampled configurations are in self-collision, so that nothing can be planned."""
    return false_collisions.free == 0 or false_collisions.by_parts == 1


def never_free_error(urdf: str | Path, false_collisions: FalseCollisions) -> InputError:
    """The error for a robot that always collides with itself.

    It proposes to allow the pairs of links that always collide, or else those that collide most often.
    """

    def colliding(pair: PairFalseCollisions) -> float:
        return max(pair.colliding, pair.by_parts)

    often = sorted(false_collisions.pairs, key=lambda pair: -colliding(pair))
    worst = [pair for pair in often if colliding(pair) == 1] or often[:MAX_PROPOSED]
    names = "; ".join(f"{' and '.join(pair.links)} collide in {colliding(pair):.1%}" for pair in worst)
    options = " ".join(f"--allow {' '.join(pair.links)}" for pair in worst)
    return InputError(
        f"{urdf}: every configuration collides with itself: {names}; if these links may touch, add "
        f"{options}, or give an SRDF that allows such pairs with --srdf FILE"
    )


def add_robot(
    urdf: str | Path,
    name: str | None = None,
    base: str | None = None,
    tip: str | None = None,
    locked: dict[str, float] | None = None,
    limits: str | Path | None = None,
    out: str | Path | None = None,
    license: str = "see the URDF",
    settings: PreparationSettings | None = None,
    seed: int = 0,
    progress: Progress = lambda what, step, steps: None,
    group: str | None = None,
    srdf: str | Path | None = None,
    allow: Sequence[tuple[str, str]] = (),
    packages: dict[str, str | Path] | None = None,
) -> AddReport:
    """Read a URDF, prepare the robot (see `prepare`) and write the robot folder.

    Args:
        urdf: URDF or xacro file, or MuJoCo model. Compiling xacro runs the code in its expressions.
        name: Name of the robot; by default the URDF's.
        base: See `UrdfTree.robot`, also for `tip`, `locked` and `group`.
        limits: Joint limits, a file in the form of MoveIt's joint_limits.yaml.
        out: Folder to write; by default `user_robots() / name`.
        license: License of the geometry, kept in the folder.
        settings: Settings of the preparation.
        seed: The same input and seed give the same robot.
        progress: Called at each step.
        srdf: Source of groups, poses and passive joints; by default the SRDF found beside the URDF. Pairs of
            links that it allows are not checked, but only if it is given here. All pairs found by sampling
            are compared with the SRDF's.
        allow: Further pairs of links that are not checked.
        packages: Folders of ROS packages by name.

    Raises:
        InputError: For bad input, and for a robot that always collides with itself.
    """
    begin = time.process_time()
    tree = UrdfTree(Path(urdf), packages or {}, compile_xacro=True)
    found = Path(srdf) if srdf is not None else None if tree.semantics else srdf_beside(urdf, tree.name)
    semantics = tree.semantics if found is None else read_srdf(found)
    robot = tree.robot(base, tip, locked, group, semantics)
    for link in {link for pair in allow for link in pair} - {*robot.link_names}:
        raise unknown_name("link in allow", link, robot.link_names)
    name = name or robot.name
    if not name or Path(name).name != name or name.startswith("."):
        raise InputError(f"robot name is {name!r}; it must be a valid folder name: give --name NAME")
    robot = replace(robot, name=name)
    if limits is not None:
        changed, notes = read_limits(limits)
        robot = replace(with_limits(robot, changed), notes=(*robot.notes, *notes))
    if not robot.meshes:
        raise InputError(
            f"{urdf}: no link has collision or visual geometry, so collisions cannot be checked; add "
            f"<collision> elements to its links"
        )
    known = {} if semantics is None else semantics.allowed
    allowed = {pair: BY_SRDF for pair in known} if srdf is not None or found is None else {}
    allowed |= {frozenset(pair): NAMED for pair in allow}
    surfaces = {link: tree.surfaces(link) for link in robot.meshes}
    settings = settings or PreparationSettings()
    if semantics is not None and semantics is tree.semantics:
        settings = replace(settings, sampling=replace(settings.sampling, assumptions=False))
    made = prepare(robot, surfaces, settings, seed, progress, allowed)
    if never_free(made.false_collisions):
        raise never_free_error(urdf, made.false_collisions)
    differences = tuple(
        PairDifference(pair.links, pair.reason, pair.colliding, known.get(frozenset(pair.links), CHECKED))
        for pair in made.sampled
        if semantics is not None and (pair.reason == CHECKED) == (frozenset(pair.links) in known)
    )
    folder = user_robots() / name if out is None else Path(out)
    source = {"urdf": Path(urdf).name, "sha256": tree.digest, "licence": license}
    measured = made.false_collisions
    shares = {"free": round(measured.free, 4), "refused": round(measured.by_spheres, 4)}
    note = (
        f"{measured.free:.1%} of the configurations are free of self-collision; convex parts "
        f"collide falsely in {measured.by_parts:.1%} of these, spheres in "
        f"{measured.by_spheres:.1%}"
    )
    write_robot_folder(replace(made.robot, notes=(*robot.notes, note)), folder, source | shares)
    seconds = time.process_time() - begin
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * BYTES_PER_UNIT
    shown = (made.links, made.pairs, made.false_collisions, seconds, memory, found, differences)
    return AddReport(read_robot_folder(folder), folder, *shown)
