"""Prepares a robot for planning: convex parts, covering spheres and allowed collisions from its collision
meshes.

Configurations in which the true meshes are free, but parts or spheres collide, are lost to planning.
Preparation measures these false collisions. If a pair of links has too many, its parts and spheres are made
again, finer at the places where they touch. If no spheres are fine enough, a table over the joints between
the links tells where they are apart.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.core.errors import InputError
from robotdiffuse.robots.fitting.allowed_collisions import (
    CHECKED,
    PairReport,
    SamplingSettings,
    allowed_pairs,
    find_allowed_collisions,
)
from robotdiffuse.robots.fitting.convex_pair_tables import joint_table
from robotdiffuse.robots.fitting.convex_parts import PartSettings, Surface, convex_parts
from robotdiffuse.robots.fitting.false_collisions import (
    FalseCollisions,
    PairFalseCollisions,
    measure_false_collisions,
)
from robotdiffuse.robots.fitting.grazing_links import with_grazing_links
from robotdiffuse.robots.fitting.link_overlaps import hidden_by_neighbours
from robotdiffuse.robots.fitting.sampled_links import Links
from robotdiffuse.robots.fitting.sphere_fitting import SphereSettings, covered, fit_spheres, stick_out
from robotdiffuse.robots.fitting.sphere_size_grid import FLOOR_TOLERANCE, Bounds, Solid
from robotdiffuse.robots.robot import Robot
from robotdiffuse.robots.scaling import reach

LARGE_REACH = 1.4
"""Reach beyond which the lengths in the settings grow with the reach [m]: a larger arm works in more space,
and needs no more parts and spheres."""
GRAZING_ROUNDS = 10
"""Measurements of false collisions that look for grazing links: few configurations graze."""
Progress = Callable[[str, int, int], None]
"""Called with the current activity, the index of the step and the number of steps."""
CONCAVITY_SHRINKAGE = 0.5
"""Factor per round on the concavity of convex parts with many false collisions."""
UNREFINED_FRACTION = 0.6
"""Fraction of the allowed false collisions that pairs left as they are may have together."""
GAP_SHRINKAGE = 0.6
"""Factor per round on `GAP_FRACTION`."""
GAP_FRACTION = 1.2
"""Average distance that spheres of each link may stick out into a gap that they bridge, as a fraction of the
gap."""


@dataclass(frozen=True)
class PreparationSettings:
    """Settings of `prepare`."""

    parts: PartSettings = field(default_factory=PartSettings)
    spheres: SphereSettings = field(default_factory=SphereSettings)
    sampling: SamplingSettings = field(default_factory=SamplingSettings)
    max_false_collisions: float = 0.075
    """Fraction of the free configurations with false collisions of spheres above which links are refined."""
    samples: int = 4000
    """Random configurations for measuring false collisions."""
    rounds: int = 2
    """Largest number of refinements."""
    finest: float = 0.002
    """Smallest tolerance of spheres [m]."""

    def __post_init__(self) -> None:
        if not 0 < self.max_false_collisions < 1 or self.samples < 100 or self.rounds < 0:
            raise InputError(
                f"preparation: max_false_collisions is {self.max_false_collisions} (must be between 0 "
                f"and 1), samples {self.samples} "
                f"(at least 100), rounds {self.rounds} (at least 0)"
            )

    def for_reach(self, reach: float) -> "PreparationSettings":
        """The settings with their lengths scaled for an arm with a reach [m]."""
        size = max(reach / LARGE_REACH, 1.0)
        return replace(
            self, parts=self.parts.scaled(size), spheres=self.spheres.scaled(size), finest=size * self.finest
        )


@dataclass(frozen=True)
class LinkReport:
    """Parts and spheres of one link."""

    link: str
    parts: int
    spheres: int
    stick_out: float
    """Largest distance that a sphere sticks out of the parts [m]; includes space inside neighbours."""
    covered: bool
    """Whether the spheres provably cover the surface of the parts."""


@dataclass(frozen=True)
class Prepared:
    """Result of `prepare`."""

    robot: Robot
    links: tuple[LinkReport, ...]
    pairs: tuple[PairReport, ...]
    sampled: tuple[PairReport, ...]
    """The pairs as sampling alone classifies them."""
    false_collisions: FalseCollisions


@dataclass(eq=False)
class _Link:
    """A link during preparation."""

    name: str
    surfaces: tuple[Surface, ...]
    parts: PartSettings
    tight: Float[ndarray, "n 3"] | None = None
    """Places where parts should stick out as little as possible."""
    bounds: Bounds = field(default_factory=lambda: Bounds(0.0))
    solid: Solid | None = None

    def decompose(self, robot: Robot) -> Robot:
        """The robot with this link's convex parts."""
        meshes = convex_parts(self.surfaces, self.parts, self.tight)
        self.solid = None
        return replace(robot, meshes=robot.meshes | {self.name: meshes})

    def fit(self, robot: Robot, settings: SphereSettings, seed: int) -> Robot:
        """The robot with this link's spheres; keeps `bounds.tight`."""
        if self.solid is None:
            meshes = robot.meshes[self.name]
            frame = robot.link_frame(self.name)
            self.solid = Solid.of(meshes, settings.tolerance(frame, robot.dof, np.inf))
            tolerance = settings.tolerance(frame, robot.dof, self.solid.depth)
            hidden = hidden_by_neighbours(robot, self.name)
            self.bounds = Bounds(tolerance, hidden, self.bounds.tight, _floor(robot, self.name))
        fit = fit_spheres(self.solid, self.bounds, np.random.default_rng(seed), settings)
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
    """The robot with parts, spheres and allowed pairs for the collision meshes of its links.

    Args:
        robot: The robot; its meshes, spheres and allowed collisions are replaced.
        surfaces: Collision meshes by link, in the links' frames.
        settings: Tolerances and numbers of samples.
        seed: The same input and seed give the same robot.
        progress: Called at each step.
        allowed: Pairs of links, with reasons, that are not checked even if sampling finds collisions.
    """
    settings = settings.for_reach(_turning_reach(robot))
    links = {name: _Link(name, meshes, settings.parts) for name, meshes in surfaces.items()}
    steps = 2 * len(links) + 1 + settings.rounds
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
        replace(pair, reason=named[frozenset(pair.links)])
        if pair.reason == CHECKED and frozenset(pair.links) in named
        else pair
        for pair in sampled
    )
    robot = replace(robot, allowed_collisions=allowed_pairs(pairs))
    tried = []
    for k in range(settings.rounds + 1):
        progress("false collisions", 2 * len(links) + 1 + k, steps)
        false_collisions = measure_false_collisions(
            robot, surfaces, settings.samples, np.random.default_rng(seed)
        )
        tried.append((false_collisions.by_spheres, k, robot, false_collisions))
        if false_collisions.by_spheres <= settings.max_false_collisions or k == settings.rounds:
            break
        robot = _refined(robot, links, false_collisions, k, settings, seed)
    _, _, robot, false_collisions = min(tried, key=lambda one: one[:2])  # refinement can add false collisions
    closer = with_finer_parts(robot, links, false_collisions, settings, seed)
    if closer is not None:
        again = measure_false_collisions(closer, surfaces, settings.samples, np.random.default_rng(seed))
        worst = max(false_collisions.by_spheres, settings.max_false_collisions)
        if again.by_parts < false_collisions.by_parts and again.by_spheres <= worst:
            robot = closer
            false_collisions = again
    measured = (
        measure_false_collisions(robot, surfaces, settings.samples, np.random.default_rng((seed, k)))
        for k in range(GRAZING_ROUNDS)
    )
    robot = with_grazing_links(robot, surfaces, measured)
    progress("done", steps, steps)
    return Prepared(robot, tuple(_report(robot, name) for name in links), pairs, sampled, false_collisions)


def _turning_reach(robot: Robot) -> float:
    """Reach of the arm with its prismatic joints fixed [m], since an arm on a long rail is not larger."""
    slides = {j.name: (j.lower + j.upper) / 2 for j in robot.planned_joints if j.kind == "prismatic"}
    return 0.0 if len(slides) == robot.dof else reach(robot.with_locked(slides))


def _report(robot: Robot, link: str) -> LinkReport:
    meshes = robot.meshes[link]
    spheres = robot.spheres[link]
    out = float(stick_out(Solid.of(meshes, 0.0), spheres).max())
    return LinkReport(link, len(meshes), len(spheres), out, covered(meshes, spheres))


def _refined(
    robot: Robot,
    links: dict[str, _Link],
    false_collisions: FalseCollisions,
    k: int,
    settings: PreparationSettings,
    seed: int,
) -> Robot:
    """The robot with finer parts and spheres for pairs of links with many false collisions."""
    worst = _worst(false_collisions, settings.max_false_collisions)
    close = {pair.links for pair in worst if _beyond_spheres(robot, pair, settings)}
    coarse = {
        name
        for pair in worst
        if pair.by_parts > settings.max_false_collisions / 5
        for name in pair.links
        if pair.links not in close or len(pair.coarse[name])
    }
    for name in sorted(coarse):
        link = links[name]
        places = [pair.coarse[name] for pair in worst if pair.links in close and name in pair.links]
        tight = np.concatenate([*places, np.zeros((0, 3))])
        if len(tight):
            link.tight = tight if link.tight is None else np.concatenate([link.tight, tight])
        else:
            link.parts = replace(
                link.parts, concavity=link.parts.concavity * CONCAVITY_SHRINKAGE, most=2 * link.parts.most
            )
        robot = link.decompose(robot)
    again = coarse | {name for pair in worst if pair.links not in close for name in pair.links}
    for name in sorted(again):
        link = links[name]
        tight = [_shared(pair, name) for pair in worst if name in pair.links and pair.links not in close]
        if tight:
            places = np.concatenate(tight)
            gaps = GAP_FRACTION * GAP_SHRINKAGE**k * places[:, 3]
            places[:, 3] = np.clip(gaps, settings.finest, link.bounds.tolerance)
            known = [] if link.bounds.tight is None else [link.bounds.tight]
            link.bounds = replace(link.bounds, tight=np.concatenate([*known, places]))
        robot = link.fit(robot, settings.spheres, seed)
    stale = {table.links for table in robot.tables if coarse & {*table.links}}
    return _with_tables(robot, close | stale, settings)


def with_finer_parts(
    robot: Robot,
    links: dict[str, _Link],
    false_collisions: FalseCollisions,
    settings: PreparationSettings,
    seed: int,
) -> Robot | None:
    """The robot with finer parts for pairs of links whose parts collide falsely; None if there are none.

    Starts and goals often are such contacts, of an arm at rest beside its own body.
    """
    places: dict[str, list[ndarray]] = {}
    for pair in false_collisions.pairs:
        for name in pair.links:
            if len(pair.coarse[name]):
                places.setdefault(name, []).append(pair.coarse[name])
    if not places:
        return None
    coarse = set(places)
    for name in sorted(coarse):
        link = links[name]
        known = [] if link.tight is None else [link.tight]
        link.tight = np.concatenate([*known, *places[name]])
        robot = link.fit(link.decompose(robot), settings.spheres, seed)
    return _with_tables(robot, {table.links for table in robot.tables if coarse & {*table.links}}, settings)


def _with_tables(robot: Robot, pairs: set[tuple[str, str]], settings: PreparationSettings) -> Robot:
    """The robot with new tables over the joints between the given pairs of links."""
    of_parts = Links(robot)
    tables = {table.links: table for table in robot.tables}
    for pair in sorted(pairs):
        tables[pair] = joint_table(robot, of_parts, pair, settings.finest / 4)
    return replace(robot, tables=tuple(tables.values()))


def _beyond_spheres(robot: Robot, pair: PairFalseCollisions, settings: PreparationSettings) -> bool:
    """Whether even the finest spheres of a pair collide falsely too often, and a table over one or two joints
    can help."""
    narrow = (pair.gaps < 2 * settings.finest).mean() if len(pair.gaps) else 0.0
    hopeless = narrow * (pair.by_spheres - pair.by_parts) > settings.max_false_collisions / 3
    return bool(hopeless) and len(robot.joints_between(*pair.links)) in (1, 2)


def _shared(pair: PairFalseCollisions, link: str) -> Float[ndarray, "n 4"]:
    """Places on one of two links, and the part of the gap that its spheres may fill [m].

    About A / t spheres that stick out by t cover an area A. The two links need the fewest spheres together if
    they share the gap in proportion to the square roots of their areas.
    """
    areas = np.sqrt([len(pair.places[link]), *(len(places) for places in pair.places.values())])
    return pair.places[link] * (1, 1, 1, 2 * areas[0] / max(areas[1:].sum(), 1))


def _worst(false_collisions: FalseCollisions, allowed: float) -> list[PairFalseCollisions]:
    """The fewest pairs without which the others are well below the allowed fraction of false collisions."""
    left = sum(pair.by_spheres for pair in false_collisions.pairs)
    worst = []
    for pair in false_collisions.pairs:
        if left <= UNREFINED_FRACTION * allowed:
            break
        worst.append(pair)
        left -= pair.by_spheres
    return worst


def _floor(robot: Robot, link: str) -> tuple[ndarray, float] | None:
    """Upward normal and offset of the floor in the link's frame, for a link that moves but never tilts or
    rises.

    The floor is the plane z = 0 of the base, where the robot may stand on a table, or lower if the link's own
    meshes reach lower. None for other links.
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
