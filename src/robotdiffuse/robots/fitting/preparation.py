"""Prepares a robot for planning: convex parts, covering spheres and allowed collisions from its collision
meshes.

If parts or spheres collide in a configuration although the true meshes do not, searches cannot use this
configuration. Preparation measures these false collisions. If a pair of links has many of them, its parts and
spheres are computed again, finer at the places where they touch. If spheres cannot be fine enough, a table
over the joints between the links tells at which joint values the links are apart.

`add_robot` reads a URDF, prepares the robot and writes its folder.
"""

import resource
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy import ndarray

from robotdiffuse.core.errors import InputError, check_name, joined, shown
from robotdiffuse.core.files import lock_folder
from robotdiffuse.core.transforms import box_around, seen_from
from robotdiffuse.core.types import NO_SPHERES, Mask, Points, Poses, Spheres
from robotdiffuse.robots.bodies import Surface
from robotdiffuse.robots.fitting.convex_parts import PartSettings, convex_parts
from robotdiffuse.robots.fitting.self_collisions import (
    FalseCollisions,
    Links,
    PairFalseCollisions,
    PairReport,
    SamplingSettings,
    find_allowed_collisions,
    joint_table,
    measure_false_collisions,
)
from robotdiffuse.robots.fitting.sphere_fitting import (
    FLOOR_TOLERANCE,
    Bounds,
    Solid,
    SphereSettings,
    covered,
    fit_spheres,
    is_inside,
    stacked_planes,
    stick_out,
)
from robotdiffuse.robots.parsing.srdf import read_srdf
from robotdiffuse.robots.parsing.urdf import UrdfTree, read_limits
from robotdiffuse.robots.robot import Robot
from robotdiffuse.robots.robot_folder import (
    FILE_ENDINGS,
    ROBOTS,
    read_robot_folder,
    user_robots,
    write_robot_folder,
)

JOINT_SAMPLES = 9
"""Number of values of the joint between two links at which points are tested."""
GAP = 0.004
"""Points closer than this to a neighboring link count as inside it [m]: gaps between links are about this
thin."""
BOX_PADDING = 10 * GAP
"""Points farther than this from a neighboring link's bounding box count as outside this link [m]. It is a
multiple of GAP: near a sharp edge, a point may be closer than GAP to the face planes, but farther from the
link."""


class Neighbor(NamedTuple):
    """A link that a joint connects to a given link."""

    link: str
    """Name of the neighbor."""
    T_link_neighbor: Poses
    """Poses of the neighbor in the frame of the given link, at values over the range of the joint between the
    two links; one pose if the joint is fixed."""


def neighbors(robot: Robot, link: str) -> tuple[Neighbor, ...]:
    """Links with geometry that a joint connects to the given link. If a parent has no geometry, its own
    parent takes its place, and so on, as long as fixed joints connect them."""
    adjacent = []
    for joint in robot.joints:
        above = joint.parent
        T_above_parent = np.eye(4)
        while above not in robot.meshes and above != robot.base:
            through = robot.joints_above(above)[-1]
            if through.movable:
                break
            above = through.parent
            T_above_parent = through.T_parent_joint @ T_above_parent
        if link not in (above, joint.child) or not {above, joint.child} <= set(robot.meshes):
            continue
        ends = (-np.pi, np.pi) if joint.kind == "continuous" else (joint.lower, joint.upper)
        values = np.linspace(*ends, JOINT_SAMPLES) if joint.movable else [0.0]
        T = T_above_parent @ joint.T_parent_joint @ joint.motion(values)
        adjacent.append(Neighbor(joint.child, T) if link == above else Neighbor(above, np.linalg.inv(T)))
    return tuple(adjacent)


def hidden_by_neighbors(robot: Robot, link: str) -> Callable[[Points], Mask]:
    """A function that tells which points, in the link's frame [m], are inside a neighbor at all values of the
    joint between the link and this neighbor."""
    neighbor_planes = []
    for name, poses in neighbors(robot, link):
        meshes = robot.meshes[name]
        corners = np.concatenate([mesh.vertices for mesh in meshes])
        low, high = box_around(corners)
        neighbor_planes.append((poses, low - BOX_PADDING, high + BOX_PADDING, stacked_planes(meshes)))

    def hidden(points: Points) -> Mask:
        hidden_points = np.zeros(len(points), bool)
        for T_link_neighbor, low, high, planes in neighbor_planes:
            candidates = np.flatnonzero(~hidden_points)
            for T in T_link_neighbor:
                local = seen_from(T, points[candidates])
                in_box = ((local >= low) & (local <= high)).all(axis=1)
                candidates = candidates[in_box]
                local = local[in_box]
                candidates = candidates[is_inside(local, planes, -GAP)]
            hidden_points[candidates] = True
        return hidden_points

    return hidden


def with_grazing_links(
    robot: Robot, surfaces: Mapping[str, tuple[Surface, ...]], measured: Iterable[FalseCollisions]
) -> Robot:
    """The robot with its `grazing` pairs: all pairs of links with a false collision of convex parts in any of
    the measurements. The robot also gets the surfaces of these links."""
    grazing = frozenset(
        frozenset(pair.links) for measurement in measured for pair in measurement.pairs if pair.by_parts > 0
    )
    links = sorted({link for pair in grazing for link in pair})
    return replace(robot, surfaces={link: _joined(surfaces[link]) for link in links}, grazing=grazing)


def _joined(surfaces: Iterable[Surface]) -> Surface:
    """One surface with equal vertices merged, so that its connected components can be found. Coordinates are
    rounded to float32, as they are stored."""
    corners = np.concatenate([surface.triangles.reshape(-1, 3) for surface in surfaces])
    vertices, index = np.unique(corners.astype(np.float32), axis=0, return_inverse=True)
    faces = index.reshape(-1, 3)
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    return Surface(vertices.astype(np.float64), faces)


LARGE_REACH = 1.4
"""For an arm with a larger reach [m], lengths in the settings are scaled with the reach, so that it does not
need more parts and spheres."""
GRAZING_ROUNDS = 10
"""Number of measurements of false collisions that look for grazing links. Links graze in few configurations,
so one measurement does not find all of them."""
Progress = Callable[[str, int, int], None]
"""Called with the current activity, the index of the step and the number of steps."""
CONCAVITY_SHRINKAGE = 0.5
"""Factor per round on `PartSettings.concavity` for links whose convex parts have many false collisions."""
UNREFINED_FRACTION = 0.6
"""Pairs of links with few false collisions are not refined. Together, these pairs have at most this fraction
of `max_false_collisions`."""
GAP_SHRINKAGE = 0.6
"""GAP_FRACTION is multiplied by this after each round."""
GAP_FRACTION = 1.0
"""Refinement limits how far the spheres of two links stick out into the gap between them: on average over the
two links, to this fraction of the gap. At 1, spheres on both sides may still overlap; later rounds lower the
fraction. With 1.2, a UR5 needed a second round and got six more spheres, with as many false collisions."""


@dataclass(frozen=True)
class PreparationSettings:
    """Settings of `prepare`."""

    parts: PartSettings = PartSettings()  # noqa: RUF009  (frozen)
    spheres: SphereSettings = SphereSettings()  # noqa: RUF009
    sampling: SamplingSettings = SamplingSettings()  # noqa: RUF009
    max_false_collisions: float = 0.075
    """Links are refined while spheres collide falsely in more than this fraction of the free
    configurations."""
    samples: int = 4000
    """Number of random configurations at which false collisions are measured."""
    rounds: int = 2
    """Largest number of rounds of refinement."""
    finest: float = 0.002
    """Smallest tolerance of spheres at the places that refinement makes tight [m]."""

    def for_reach(self, reach: float) -> "PreparationSettings":
        """The settings with their lengths scaled for an arm with a reach [m]."""
        size = max(reach / LARGE_REACH, 1.0)

        def scaled(settings: Any, *lengths: str) -> Any:
            return replace(settings, **{name: size * getattr(settings, name) for name in lengths})

        parts = scaled(self.parts, "concavity", "finest", "rounding")
        spheres = scaled(self.spheres, "first_half", "second_half", "fixed", "finest")
        return replace(scaled(self, "finest"), parts=parts, spheres=spheres)


class LinkReport(NamedTuple):
    """Parts and spheres of one link."""

    link: str
    parts: int
    spheres: int
    stick_out: float
    """Largest distance that a sphere sticks out of the parts [m], also where it sticks out into a neighboring
    link."""
    covered: bool
    """Whether the spheres provably cover the surface of the parts."""


class Prepared(NamedTuple):
    """Result of `prepare`."""

    robot: Robot
    links: tuple[LinkReport, ...]
    pairs: tuple[PairReport, ...]
    sampled: tuple[PairReport, ...]
    """Pairs of links as sampling alone classifies them; allowed collisions of the caller are ignored."""
    false_collisions: FalseCollisions


@dataclass(eq=False)
class _Link:
    """A link during preparation."""

    name: str
    surfaces: tuple[Surface, ...]
    parts: PartSettings
    tight: Points = field(default_factory=lambda: np.zeros((0, 3)))
    """Places in the link's frame where parts should stick out less [m]."""
    narrow: Spheres = field(default_factory=lambda: NO_SPHERES)
    """Places in the link's frame where spheres should stick out less (see `Bounds.tight`)."""

    def decompose(self, robot: Robot) -> Robot:
        """The robot with this link's convex parts."""
        meshes = convex_parts(self.surfaces, self.parts, self.tight if len(self.tight) else None)
        return replace(robot, meshes=robot.meshes | {self.name: meshes})

    def fit(self, robot: Robot, settings: SphereSettings, seed: int) -> Robot:
        """The robot with this link's spheres."""
        frame = robot.link_frame(self.name)
        solid = Solid.of(robot.meshes[self.name], settings.tolerance(frame, robot.dof, np.inf))
        tolerance = settings.tolerance(frame, robot.dof, solid.depth)
        hidden = hidden_by_neighbors(robot, self.name)
        bounds = Bounds(tolerance, hidden, self.narrow, _floor(robot, self.name))
        fit = fit_spheres(solid, bounds, np.random.default_rng(seed), settings)
        fit = np.round(fit, 6)  # as stored in the file, so that these values are checked
        return replace(robot, spheres=robot.spheres | {self.name: fit})


def prepare(
    robot: Robot,
    surfaces: Mapping[str, tuple[Surface, ...]],
    settings: PreparationSettings,
    seed: int = 0,
    progress: Progress = lambda what, step, steps: None,
    allowed: Mapping[frozenset[str], str] | None = None,
) -> Prepared:
    """Computes convex parts, covering spheres and allowed pairs from the collision meshes of a robot's links.

    Args:
        robot: The robot; its meshes, spheres, tables and allowed collisions are replaced.
        surfaces: Collision meshes by link, in the links' frames.
        settings: Tolerances and numbers of samples.
        seed: The same input and seed give the same robot.
        progress: Called at each step.
        allowed: Pairs of links, with reasons, that are not checked even if sampling finds collisions.
    """
    # the reach is measured with prismatic joints locked, since a long rail does not make an arm larger
    slides = {j.name: (j.lower + j.upper) / 2 for j in robot.planned_joints if j.kind == "prismatic"}
    settings = settings.for_reach(0.0 if len(slides) == robot.dof else robot.with_locked(slides).reach)
    links = {name: _Link(name, meshes, settings.parts) for name, meshes in surfaces.items()}
    steps = 2 * len(links) + 2 + settings.rounds
    for step, link in enumerate(links.values()):
        progress(f"convex parts of {link.name}", step, steps)
        robot = link.decompose(robot)
    for step, link in enumerate(links.values(), len(links)):
        progress(f"spheres of {link.name}", step, steps)
        robot = link.fit(robot, settings.spheres, seed)
    progress("pairs of links", 2 * len(links), steps)
    sampled = find_allowed_collisions(robot, settings.sampling, np.random.default_rng(seed))
    named = allowed or {}
    pairs = tuple(
        pair._replace(reason=named.get(frozenset(pair.links), "checked"))
        if pair.reason == "checked"
        else pair
        for pair in sampled
    )
    allowed_pairs = frozenset(frozenset(pair.links) for pair in pairs if pair.reason != "checked")
    robot = replace(robot, allowed_collisions=allowed_pairs, tables=())
    attempts = []
    for k in range(settings.rounds + 1):
        progress("false collisions", 2 * len(links) + 1 + k, steps)
        false_collisions = measure_false_collisions(
            robot, surfaces, settings.samples, np.random.default_rng(seed)
        )
        attempts.append((false_collisions, robot))
        if false_collisions.by_spheres <= settings.max_false_collisions or k == settings.rounds:
            break
        robot = _refined(robot, links, false_collisions, k, settings, seed)
    # the best attempt: refinement can also add false collisions
    false_collisions, robot = min(attempts, key=lambda attempt: attempt[0].by_spheres)
    finer = with_finer_parts(robot, links, false_collisions, settings, seed)
    if finer is not None:
        remeasured = measure_false_collisions(finer, surfaces, settings.samples, np.random.default_rng(seed))
        max_by_spheres = max(false_collisions.by_spheres, settings.max_false_collisions)
        if remeasured.by_parts < false_collisions.by_parts and remeasured.by_spheres <= max_by_spheres:
            robot = finer
            false_collisions = remeasured
    measured = (
        measure_false_collisions(robot, surfaces, settings.samples, np.random.default_rng((seed, k)))
        for k in range(GRAZING_ROUNDS)
    )
    robot = with_grazing_links(robot, surfaces, measured)
    progress("done", steps, steps)
    reports = []
    for name in links:
        meshes = robot.meshes[name]
        spheres = robot.spheres[name]
        out = float(stick_out(Solid.of(meshes, 0.0), spheres).max())
        reports.append(LinkReport(name, len(meshes), len(spheres), out, covered(meshes, spheres)))
    return Prepared(robot, tuple(reports), pairs, sampled, false_collisions)


def _refined(
    robot: Robot,
    links: dict[str, _Link],
    false_collisions: FalseCollisions,
    k: int,
    settings: PreparationSettings,
    seed: int,
) -> Robot:
    """The robot with finer parts and spheres, or with tables, for pairs of links with many false collisions;
    `k` is the number of refinements before."""
    worst_pairs = _worst(false_collisions, settings.max_false_collisions)
    # A table replaces the spheres of its pair. It is computed from the pair's parts, so these need to be
    # finer only where they collide falsely: at the places in `coarse`.
    table_pairs = {pair.links for pair in worst_pairs if _beyond_spheres(robot, pair, settings, k)}
    coarse_links = {
        name
        for pair in worst_pairs
        if pair.by_parts > settings.max_false_collisions / 5
        for name in pair.links
        if pair.links not in table_pairs or len(pair.coarse[name])
    }
    for name in sorted(coarse_links):
        link = links[name]
        places = [
            pair.coarse[name] for pair in worst_pairs if pair.links in table_pairs and name in pair.links
        ]
        if any(map(len, places)):
            link.tight = np.concatenate([link.tight, *places])
        else:
            link.parts = replace(
                link.parts, concavity=link.parts.concavity * CONCAVITY_SHRINKAGE, most=2 * link.parts.most
            )
        robot = link.decompose(robot)
    affected = coarse_links | {
        name for pair in worst_pairs if pair.links not in table_pairs for name in pair.links
    }
    for name in sorted(affected):
        link = links[name]
        for pair in worst_pairs:
            if name in pair.links and pair.links not in table_pairs:
                places = _shared(pair, name)
                places[:, 3] = np.maximum(GAP_FRACTION * GAP_SHRINKAGE**k * places[:, 3], settings.finest)
                link.narrow = np.concatenate([link.narrow, places])
        robot = link.fit(robot, settings.spheres, seed)
    return _with_tables(robot, table_pairs, coarse_links, settings)


def with_finer_parts(
    robot: Robot,
    links: dict[str, _Link],
    false_collisions: FalseCollisions,
    settings: PreparationSettings,
    seed: int,
) -> Robot | None:
    """The robot with finer parts for pairs of links whose parts collide falsely; None if there are no such
    pairs.

    Starts and goals often have such false collisions, when an arm rests close to its own body.
    """
    changed = set[str]()
    for pair in false_collisions.pairs:
        for name, places in pair.coarse.items():
            if len(places):
                links[name].tight = np.concatenate([links[name].tight, places])
                changed.add(name)
    if not changed:
        return None
    for name in sorted(changed):
        robot = links[name].fit(links[name].decompose(robot), settings.spheres, seed)
    return _with_tables(robot, set(), changed, settings)


def _with_tables(
    robot: Robot, pairs: set[tuple[str, str]], changed: set[str], settings: PreparationSettings
) -> Robot:
    """The robot with new tables over the joints between the links of the given pairs. Existing tables of
    links in `changed`, whose parts have changed, are computed again."""
    links = Links(robot)
    pairs = pairs | {table.links for table in robot.tables if changed & {*table.links}}
    tables = {table.links: table for table in robot.tables}
    for pair in sorted(pairs):
        tables[pair] = joint_table(robot, links, pair, settings.finest / 4)
    return replace(robot, tables=tuple(tables.values()))


def _beyond_spheres(robot: Robot, pair: PairFalseCollisions, settings: PreparationSettings, k: int) -> bool:
    """Whether a table should replace the spheres of a pair: if one or two joints are between the links, and
    even the finest spheres would collide falsely too often or, after an earlier refinement (`k` > 0), the
    present spheres do."""
    narrow_fraction = (pair.gaps < 2 * settings.finest).mean() if len(pair.gaps) else 0.0
    if k:
        narrow_fraction = 1.0
    # false collisions, beyond those of the parts, in gaps that are too narrow for the finest spheres
    hopeless = narrow_fraction * (pair.by_spheres - pair.by_parts) > settings.max_false_collisions / 3
    return bool(hopeless) and len(robot.joints_between(*pair.links)) in (1, 2)


def _shared(pair: PairFalseCollisions, link: str) -> Spheres:
    """Rows x, y, z, w of places on one of two links; w is twice the link's share of the gap there [m], so the
    mean of w over the two links is the gap.

    Covering an area A takes about A / t spheres that stick out by t. Together the two links need the fewest
    spheres if they share the gap in proportion to the square roots of their areas.
    """
    roots = np.sqrt([len(pair.places[link]), *(len(places) for places in pair.places.values())])
    return pair.places[link] * (1, 1, 1, 2 * roots[0] / max(roots[1:].sum(), 1))


def _worst(false_collisions: FalseCollisions, allowed: float) -> list[PairFalseCollisions]:
    """The pairs with the most false collisions: the smallest number of them for which all other pairs
    together have at most UNREFINED_FRACTION of the `allowed` fraction of false collisions."""
    remaining = sum(pair.by_spheres for pair in false_collisions.pairs)
    worst_pairs = []
    for pair in false_collisions.pairs:
        if remaining <= UNREFINED_FRACTION * allowed:
            break
        worst_pairs.append(pair)
        remaining -= pair.by_spheres
    return worst_pairs


def _floor(robot: Robot, link: str) -> tuple[ndarray, float] | None:
    """Upward normal and offset [m] of the floor in the link's frame, for a link that moves but never tilts or
    changes its height; None for other links.

    The floor is the plane z = 0 of the base, since the robot may stand on a table. It is lower if the link's
    own meshes reach lower.
    """
    if robot.link_frame(link) == 0:
        return None  # base links are never checked against the scene
    links = Links(robot)
    T_base_link = links.poses(links.random(20, np.random.default_rng(0)))[link]
    if np.ptp(T_base_link[:, 2], axis=0).max() > 1e-6:
        return None
    up = T_base_link[0, 2, :3]
    height = T_base_link[0, 2, 3]
    lowest = min(float((mesh.vertices @ up).min()) for mesh in robot.meshes[link])
    return up, min(-height, lowest - FLOOR_TOLERANCE)


MIN_FREE = 0.2
"""A warning is given if a smaller fraction of the configurations is free."""
MAX_FALSE_COLLISIONS = 0.08
"""A warning is given if spheres collide falsely in a larger fraction of the free configurations. It is a
little above the fraction at which refinement ends, `PreparationSettings.max_false_collisions`."""
MAX_PROPOSED = 3
"""Largest number of pairs that the error message proposes for a robot that always collides with itself
although no single pair always collides."""
ASSUMED_SAFE = {
    "default": "also with all joints between them at zero: the meshes are assumed to be too large",
    "limits": "in a range of one joint up to its limit: its stop is assumed to be where the links meet",
    "pose": "also in a pose that the SRDF names: the meshes are assumed to be too large",
}
"""Reasons for allowing a pair that a person should check, each with an explanation for the warning."""
BYTES_PER_UNIT = 1 if sys.platform == "darwin" else 1024
"""Bytes per unit of `ru_maxrss`."""


class PairDifference(NamedTuple):
    """Two links that sampling and an SRDF classify differently."""

    links: tuple[str, str]
    sampled: str
    """The reason found by sampling, or `checked`."""
    colliding: float
    """Fraction of the configurations in which convex parts of the two links collide."""
    srdf: str
    """The SRDF's reason, or `checked`."""


class AddReport(NamedTuple):
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
        """Problems that will limit planning, and allowed pairs of links with colliding convex parts that a
        person should check."""
        warnings = []
        rates = self.false_collisions
        worst_text = "; ".join(f"{' against '.join(p.links)} {p.by_spheres:.1%}" for p in rates.pairs[:3])
        if rates.free < MIN_FREE:
            often = sorted(rates.pairs, key=lambda pair: -pair.colliding)[:3]
            names = "; ".join(f"{' against '.join(pair.links)} {pair.colliding:.1%}" for pair in often)
            warnings.append(
                f"only {rates.free:.1%} of the configurations are free of self-collision by the meshes "
                f"of the URDF ({names}); allow pairs that may touch with --allow"
            )
        if rates.by_spheres > MAX_FALSE_COLLISIONS:
            warnings.append(
                f"covering spheres collide falsely in {rates.by_spheres:.1%} of the free configurations, "
                f"more than {MAX_FALSE_COLLISIONS:.0%} ({worst_text}); planning cannot use these "
                "configurations"
            )
        warnings += [
            f"{' against '.join(pair.links)} is not checked, though convex parts collide in "
            f"{pair.colliding:.1%} of the configurations, {ASSUMED_SAFE[pair.reason]}; make "
            f"sure that the arm cannot hit itself there"
            for pair in self.pairs
            if pair.reason in ASSUMED_SAFE and pair.colliding
        ]
        return (*warnings, *(f"spheres do not cover {link.link}" for link in self.links if not link.covered))


def _touching_note(robot: Robot, allowed: Mapping[frozenset[str], str]) -> list[str]:
    """A note on links that touch in all motions, and so are not checked; `allowed` pairs do not count."""
    links = Links(robot)
    poses = links.poses(links.named({})[None])
    checked = robot.checked_pairs()
    touching = [
        f"{a} and {b}"
        for a, b in combinations(robot.meshes, 2)
        if (a, b) not in checked and frozenset((a, b)) not in allowed and links.collide(poses, a, b, 0)
    ]
    if not touching:
        return []
    return [
        f"links that touch in all motions are not checked: {joined(touching)}; if joints between them are "
        "held, --lock can hold them at other values"
    ]


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
        srdf: Source of groups, poses and passive joints; by default the SRDF found beside the URDF, or the
            keyframes and exclusions of a MuJoCo model. If it is given here or is a MuJoCo model, it also
            allows pairs of links, which are then not checked; an SRDF that was found does not. The report
            lists where sampling and this source differ.
        allow: Further pairs of links that are not checked.
        packages: Folders of ROS packages by name.

    Raises:
        InputError: For bad input, and for a robot that always collides with itself.
    """
    begin = time.process_time()
    tree = UrdfTree(Path(urdf), packages or {}, compile_xacro=True)
    srdf_file = tree.srdf if srdf is None else Path(srdf)
    semantics = tree.semantics if srdf_file is None else read_srdf(srdf_file)
    changed, limit_notes = ({}, ()) if limits is None else read_limits(limits)
    robot = tree.robot(base, tip, locked, group, semantics, changed)
    for pair in allow:
        for link in pair:
            check_name("link in allow", link, robot.link_names)
        if len(pair) != 2 or pair[0] == pair[1]:
            raise InputError(f"allow has the entry {shown(pair)}; it must name two links")
    name = name or robot.name
    ambiguous = out is None and (name in ROBOTS or name.lower().endswith(FILE_ENDINGS) or "\\" in name)
    if ambiguous or Path(name).name != name or name.startswith(".") or not name.isprintable():
        raise InputError(
            f"robot name is {name!r}; it must be a valid folder name without a file ending, and not that of "
            f"a bundled robot: give --name NAME"
        )
    folder = user_robots() / name if out is None else Path(out)
    with lock_folder(folder):  # fails early if the folder cannot be written
        pass
    robot = replace(robot, name=name)
    notes = [*robot.notes, *limit_notes]
    if not robot.meshes:
        raise InputError(
            f"{urdf}: no link has collision or visual geometry, so collisions cannot be checked; add "
            f"<collision> elements to its links"
        )
    srdf_allowed = {} if semantics is None else semantics.allowed_among(robot.link_names)
    named_links = frozenset[str]().union(*srdf_allowed)
    if srdf is not None and named_links and named_links.isdisjoint(tree.links):
        raise InputError(f"{srdf} is for another robot: it names no link of {urdf}; give its own SRDF")
    # an SRDF that was found beside the URDF allows no pairs; a MuJoCo model does
    allowed = {pair: "srdf" for pair in srdf_allowed} if srdf is not None or srdf_file is None else {}
    allowed |= {frozenset(pair): "named" for pair in allow}
    surfaces = {link: tree.surfaces(link) for link in robot.meshes}
    settings = settings or PreparationSettings()
    if semantics is not None and semantics is tree.semantics:
        settings = replace(settings, sampling=replace(settings.sampling, assumptions=False))
    prepared = prepare(robot, surfaces, settings, seed, progress, allowed)
    if not settings.sampling.assumptions:
        notes += _touching_note(prepared.robot, allowed)
    measured = prepared.false_collisions
    if measured.free == 0 or measured.by_spheres == 1:  # nothing can be planned
        shares = {pair.links: max(pair.colliding, pair.by_spheres) for pair in measured.pairs}
        often = sorted(shares, key=lambda pair: -shares[pair])
        colliding_pairs = [pair for pair in often if shares[pair] == 1] or often[:MAX_PROPOSED]
        options = " ".join(f"--allow {' '.join(pair)}" for pair in colliding_pairs)
        names = "; ".join(f"{' and '.join(pair)} collide in {shares[pair]:.1%}" for pair in colliding_pairs)
        raise InputError(
            f"{urdf}: the arm, enclosed by spheres, collides with itself in every configuration: {names}; if "
            f"these links may touch, add {options}, or give an SRDF that allows such pairs with --srdf FILE"
        )
    differences = tuple(
        PairDifference(
            pair.links, pair.reason, pair.colliding, srdf_allowed.get(frozenset(pair.links), "checked")
        )
        for pair in prepared.sampled
        # checked by one of the two, allowed by the other
        if semantics is not None and (pair.reason == "checked") == (frozenset(pair.links) in srdf_allowed)
    )
    source = {"urdf": Path(urdf).name, "sha256": tree.digest, "license": license}
    if srdf is None or (tree.srdf and tree.srdf.samefile(srdf)):
        source["srdf"] = tree.srdf_digest
    fractions = {"free": round(measured.free, 4), "refused": round(measured.by_spheres, 4)}
    note = (
        f"{measured.free:.1%} of the configurations are free of self-collision; convex parts "
        f"collide falsely in {measured.by_parts:.1%} of these, spheres in "
        f"{measured.by_spheres:.1%}"
    )
    write_robot_folder(replace(prepared.robot, notes=(*notes, note)), folder, source | fractions)
    seconds = time.process_time() - begin
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * BYTES_PER_UNIT
    return AddReport(
        read_robot_folder(folder),
        folder,
        prepared.links,
        prepared.pairs,
        measured,
        seconds,
        memory,
        srdf_file,
        differences,
    )
