"""From a robot's collision meshes to what planning needs: convex parts, covering spheres, allowed pairs.

It measures itself: configurations in which the true meshes are free, but parts or spheres are not, are what
the planner will never see. Where a pair of links refuses too many of them, parts and spheres are made again,
finer in the places where the two touch in vain; where no spheres are fine enough, a table over the joints
between the two says where they are apart.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.core.errors import InputError
from robotdiffuse.robots.fitting.allowed_collisions import (
    CHECKED,
    Links,
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
from robotdiffuse.robots.fitting.link_overlaps import hidden_by_neighbours
from robotdiffuse.robots.fitting.sphere_fitting import SphereSettings, covered, fit_spheres, stick_out
from robotdiffuse.robots.fitting.sphere_size_grid import FLOOR, Bounds, Solid
from robotdiffuse.robots.robot import Robot
from robotdiffuse.robots.scaling import reach

LARGE = 1.4
"""Reach [m] from which on the lengths of settings grow with the reach: a larger arm works in more room, and
needs no more parts and spheres."""
Progress = Callable[[str, int, int], None]
"""Called with what is being done, the number of the step and the number of steps."""
FINER = 0.5
"""From round to round, how far convex parts may stick out where they refuse much, as a share."""
LEFT = 0.6
"""What pairs that stay as they are may refuse together, as a share of what all may."""
FASTER = 0.6
"""From round to round, a factor of that share."""
GAP_SHARE = 1.2
"""Of the gap between two links that spheres bridge in vain, what those of each may stick out into it, on
average."""


@dataclass(frozen=True)
class PreparationSettings:
    """How a robot is prepared."""

    parts: PartSettings = field(default_factory=PartSettings)
    spheres: SphereSettings = field(default_factory=SphereSettings)
    sampling: SamplingSettings = field(default_factory=SamplingSettings)
    refused: float = 0.075
    """Share of the free configurations that spheres may refuse before they are made finer."""
    samples: int = 4000
    """Configurations on which that is measured."""
    rounds: int = 2
    """Times that links are made finer, at most."""
    finest: float = 0.002
    """Spheres need not stick out by less anywhere [m]."""

    def __post_init__(self) -> None:
        if not 0 < self.refused < 1 or self.samples < 100 or self.rounds < 0:
            raise InputError(
                f"preparation: refused is {self.refused} (must be between 0 and 1), samples {self.samples} "
                f"(at least 100), rounds {self.rounds} (at least 0)"
            )

    def for_reach(self, reach: float) -> "PreparationSettings":
        """The settings with their lengths in the size of an arm that reaches so far [m]."""
        size = max(reach / LARGE, 1.0)
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
    """How far a sphere reaches out of the parts, at most [m]; also to where a neighbour is at any angle."""
    covered: bool
    """Whether the spheres provably cover the surface of the parts."""


@dataclass(frozen=True)
class Prepared:
    """What `prepare` made."""

    robot: Robot
    links: tuple[LinkReport, ...]
    pairs: tuple[PairReport, ...]
    sampled: tuple[PairReport, ...]
    """The pairs by sampling alone."""
    refusals: FalseCollisions


@dataclass(eq=False)
class _Link:
    """One link while it is made."""

    name: str
    surfaces: tuple[Surface, ...]
    parts: PartSettings
    tight: Float[ndarray, "n 3"] | None = None
    """Where parts may hardly stick out."""
    bounds: Bounds = field(default_factory=lambda: Bounds(0.0))
    solid: Solid | None = None

    def decompose(self, robot: Robot) -> Robot:
        """The robot with this link's convex parts."""
        meshes = convex_parts(self.surfaces, self.parts, self.tight)
        self.solid = None
        return replace(robot, meshes=robot.meshes | {self.name: meshes})

    def fit(self, robot: Robot, settings: SphereSettings, seed: int) -> Robot:
        """The robot with this link's spheres; `tight` places that were found stay."""
        if self.solid is None:
            meshes = robot.meshes[self.name]
            frame = robot.link_frame(self.name)
            self.solid = Solid.of(meshes, settings.tolerance(frame, robot.dof, np.inf))
            tolerance = settings.tolerance(frame, robot.dof, self.solid.depth)
            hidden = hidden_by_neighbours(robot, self.name)
            self.bounds = Bounds(tolerance, hidden, self.bounds.tight, _floor(robot, self.name))
        fit = fit_spheres(self.solid, self.bounds, np.random.default_rng(seed), settings)
        fit = np.round(fit, 6)  # as the file holds them: these are validated
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

    `surfaces` are the meshes by link, in the links' frames; `allowed` pairs, with reasons, that need no check
    whatever sampling says. The same input and seed give the same robot.
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
        progress("configurations refused", 2 * len(links) + 1 + k, steps)
        refusals = measure_false_collisions(robot, surfaces, settings.samples, np.random.default_rng(seed))
        tried.append((refusals.by_spheres, k, robot, refusals))
        if refusals.by_spheres <= settings.refused or k == settings.rounds:
            break
        robot = _refined(robot, links, refusals, k, settings, seed)
    _, _, robot, refusals = min(tried, key=lambda one: one[:2])  # finer is not always better
    closer = _closer(robot, links, refusals, settings, seed)
    if closer is not None:
        again = measure_false_collisions(closer, surfaces, settings.samples, np.random.default_rng(seed))
        worst = max(refusals.by_spheres, settings.refused)
        if again.by_parts < refusals.by_parts and again.by_spheres <= worst:
            robot, refusals = closer, again
    progress("done", steps, steps)
    return Prepared(robot, tuple(_report(robot, name) for name in links), pairs, sampled, refusals)


def _turning_reach(robot: Robot) -> float:
    """What the arm reaches without its rails [m]: an arm on a long one is no larger."""
    slides = {j.name: (j.lower + j.upper) / 2 for j in robot.planned_joints if j.kind == "prismatic"}
    return 0.0 if len(slides) == robot.dof else reach(robot.with_locked(slides))


def _report(robot: Robot, link: str) -> LinkReport:
    meshes, spheres = robot.meshes[link], robot.spheres[link]
    out = float(stick_out(Solid.of(meshes, 0.0), spheres).max())
    return LinkReport(link, len(meshes), len(spheres), out, covered(meshes, spheres))


def _refined(
    robot: Robot,
    links: dict[str, _Link],
    refusals: FalseCollisions,
    k: int,
    settings: PreparationSettings,
    seed: int,
) -> Robot:
    """The robot with finer parts and spheres where pairs of links refuse much."""
    worst = _worst(refusals, settings.refused)
    close = {pair.links for pair in worst if _beyond_spheres(robot, pair, settings)}
    coarse = {
        name
        for pair in worst
        if pair.by_parts > settings.refused / 5
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
            link.parts = replace(link.parts, concavity=link.parts.concavity * FINER, most=2 * link.parts.most)
        robot = link.decompose(robot)
    again = coarse | {name for pair in worst if pair.links not in close for name in pair.links}
    for name in sorted(again):
        link = links[name]
        tight = [_shared(pair, name) for pair in worst if name in pair.links and pair.links not in close]
        if tight:
            places = np.concatenate(tight)
            gaps = GAP_SHARE * FASTER**k * places[:, 3]
            places[:, 3] = np.clip(gaps, settings.finest, link.bounds.tolerance)
            known = [] if link.bounds.tight is None else [link.bounds.tight]
            link.bounds = replace(link.bounds, tight=np.concatenate([*known, places]))
        robot = link.fit(robot, settings.spheres, seed)
    stale = {table.links for table in robot.tables if coarse & {*table.links}}
    return _with_tables(robot, close | stale, settings)


def _closer(
    robot: Robot, links: dict[str, _Link], refusals: FalseCollisions, settings: PreparationSettings, seed: int
) -> Robot | None:
    """The robot with finer parts where pairs of links overlap by parts alone; None if none were found to.

    Start and goal are often such contacts, of an arm at rest beside its own body.
    """
    places: dict[str, list[ndarray]] = {}
    for pair in refusals.pairs:
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
    """The robot with tables over the joints between some pairs of links made, or made again."""
    of_parts, tables = Links(robot), {table.links: table for table in robot.tables}
    for pair in sorted(pairs):
        tables[pair] = joint_table(robot, of_parts, pair, settings.finest / 4)
    return replace(robot, tables=tuple(tables.values()))


def _beyond_spheres(robot: Robot, pair: PairFalseCollisions, settings: PreparationSettings) -> bool:
    """Whether the finest spheres refuse a pair too much, and a table over one or two joints can tell more."""
    narrow = (pair.gaps < 2 * settings.finest).mean() if len(pair.gaps) else 0.0
    hopeless = narrow * (pair.by_spheres - pair.by_parts) > settings.refused / 3
    return bool(hopeless) and len(robot.joints_between(*pair.links)) in (1, 2)


def _shared(pair: PairFalseCollisions, link: str) -> Float[ndarray, "n 4"]:
    """Places on one of two links, and what of the gap its spheres may fill [m].

    Spheres that stick out by t over an area A are about A / t in number: of both links together they are
    fewest if the link with the larger area has more of the gap, as the roots of the areas are.
    """
    areas = np.sqrt([len(pair.places[link]), *(len(places) for places in pair.places.values())])
    return pair.places[link] * (1, 1, 1, 2 * areas[0] / max(areas[1:].sum(), 1))


def _worst(refusals: FalseCollisions, refused: float) -> list[PairFalseCollisions]:
    """As few pairs as leave the others well within what may be refused."""
    left = sum(pair.by_spheres for pair in refusals.pairs)
    worst = []
    for pair in refusals.pairs:
        if left <= LEFT * refused:
            break
        worst.append(pair)
        left -= pair.by_spheres
    return worst


def _floor(robot: Robot, link: str) -> tuple[ndarray, float] | None:
    """The plane z = 0 of the base in the link's frame, for a link that moves but never tilts or rises: a
    robot may stand on a table there. If the link's own meshes reach lower, the plane is below them."""
    if robot.link_frame(link) == 0:
        return None  # never checked against the scene
    links = Links(robot)
    T_base_link = links.poses(links.random(20, np.random.default_rng(0)))[link]
    if np.ptp(T_base_link[:, 2], axis=0).max() > 1e-6:
        return None
    up, height = T_base_link[0, 2, :3], T_base_link[0, 2, 3]
    lowest = min(float((mesh.vertices @ up).min()) for mesh in robot.meshes[link])
    return up, min(-height, lowest - FLOOR)
