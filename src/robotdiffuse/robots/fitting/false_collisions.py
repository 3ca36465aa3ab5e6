"""How many free configurations covering spheres and convex parts refuse, pair by pair of links, and where."""

# Coal's Python module has no type information.
# pyright: reportAttributeAccessIssue=false

from collections.abc import Mapping
from dataclasses import dataclass

import coal
import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from robotdiffuse.core.bounds import for_kernels
from robotdiffuse.robots.coal_geometry import coal_pose, coal_surface
from robotdiffuse.robots.fitting.allowed_collisions import Links
from robotdiffuse.robots.fitting.convex_parts import Surface
from robotdiffuse.robots.fitting.sphere_fitting_kernel import deepest_touches
from robotdiffuse.robots.robot import Robot

CUBE = 0.01
"""Of the places where spheres touch one is kept of each cube with this edge [m]."""

MOST_PLACES = 2000
"""Configurations from which places are taken, of each pair."""
FEW_PLACES = 60
"""The same where convex parts are too coarse."""
FORGIVEN = 0.003
"""Share of the configurations with the narrowest gaps that a pair may go on to refuse."""


@dataclass(frozen=True)
class PairFalseCollisions:
    """A pair of links that is checked."""

    links: tuple[str, str]
    colliding: float
    """Share of the configurations in which the true meshes collide."""
    by_parts: float
    """Share of the free configurations in which convex parts of the two collide."""
    by_spheres: float
    """The same of spheres; those that parts refuse too are among them."""
    gaps: Float[ndarray, "configurations"]
    """Distances of the parts where spheres alone refuse, of some of these configurations [m]."""
    places: dict[str, Float[ndarray, "n 4"]]
    """In the frame of each of the two links: where spheres touch though the parts are apart, and how far the
    parts are from each other then, at least [m]."""
    coarse: dict[str, Float[ndarray, "m 3"]]
    """In the frame of each of the two links: where parts overlap though the true meshes are apart, of the one
    whose parts stick out further there."""


@dataclass(frozen=True)
class FalseCollisions:
    """What of the free configurations is refused, for touching itself where its true meshes do not."""

    free: float
    """Share of the configurations in which the true meshes are free."""
    by_parts: float
    """Share of those that convex parts refuse."""
    by_spheres: float
    """Share of those that covering spheres refuse."""
    pairs: tuple[PairFalseCollisions, ...]
    """Those that refuse most first."""


def measure_false_collisions(
    robot: Robot, surfaces: Mapping[str, tuple[Surface, ...]], samples: int, rng: np.random.Generator
) -> FalseCollisions:
    """Of configurations uniform within the limits of the planned joints, others held as they are.

    `surfaces` are the true meshes of the links; they are asked only where convex parts collide, and those
    only where spheres do.
    """
    links = Links(robot)
    q = links.random(samples, rng)
    for i, joint in enumerate(links.joints):
        if joint.name in robot.locked:
            q[:, i] = robot.locked[joint.name]
    poses = links.poses(q)
    trees = {
        link: tuple(coal_surface(part.vertices, part.faces) for part in parts)
        for link, parts in surfaces.items()
    }
    tables = {frozenset(table.links): (table,) for table in robot.tables}
    column = {joint.name: i for i, joint in enumerate(links.joints)}
    found = []
    for a, b in robot.checked_pairs():
        first, second = (for_kernels(robot.spheres[link]) for link in (a, b))
        depth, middle = deepest_touches(poses[a], poses[b], first, second, 0.0, 0.0)
        spheres = depth > 0
        for table in tables.get(frozenset((a, b)), ()):
            spheres &= ~table.at(*(q[:, column[name]] for name in table.joints))
        parts, meshes = np.zeros(samples, dtype=bool), np.zeros(samples, dtype=bool)
        for i in np.flatnonzero(spheres):
            parts[i] = links.collide(poses, a, b, int(i))
            if parts[i]:
                meshes[i] = _collide(trees[a], trees[b], poses[a][i], poses[b][i])
        found.append((spheres, parts, meshes, middle))
    if not found:
        return FalseCollisions(1.0, 0.0, 0.0, ())
    free = ~np.any([meshes for _, _, meshes, _ in found], axis=0)
    count = max(int(free.sum()), 1)
    pairs = []
    for (a, b), (spheres, parts, meshes, middle) in zip(robot.checked_pairs(), found, strict=True):
        idle = np.flatnonzero(spheres & ~parts & free)[:MOST_PLACES]
        gaps = np.array([links.mesh_distance(poses, a, b, int(i)) for i in idle])
        every = gaps
        # the narrowest few stay refused
        wide = gaps >= np.sort(gaps)[: int(samples * FORGIVEN * len(idle) / max(spheres.sum(), 1)) + 1].max(
            initial=0.0
        )
        idle, gaps = idle[wide], gaps[wide]
        T_base_a, T_base_b = poses[a][idle], poses[b][idle]
        at = np.einsum("nij,nj->ni", T_base_a[:, :3, :3], middle[idle]) + T_base_a[:, :3, 3]
        on_b = np.einsum("nji,nj->ni", T_base_b[:, :3, :3], at - T_base_b[:, :3, 3])
        places = {a: _one_per_cube(middle[idle], gaps), b: _one_per_cube(on_b, gaps)}
        vain = np.flatnonzero(parts & ~meshes & free)[:FEW_PLACES]
        coarse = _sticking_out(links, trees, poses, (a, b), vain)
        shares = (float((parts & free).sum() / count), float((spheres & free).sum() / count))
        pairs.append(PairFalseCollisions((a, b), float(meshes.mean()), *shares, every, places, coarse))
    by_parts = np.any([parts for _, parts, _, _ in found], axis=0)
    by_spheres = np.any([spheres for spheres, _, _, _ in found], axis=0)
    return FalseCollisions(
        float(free.mean()),
        float((by_parts & free).sum() / count),
        float((by_spheres & free).sum() / count),
        tuple(sorted(pairs, key=lambda pair: -pair.by_spheres)),
    )


def _sticking_out(
    links: Links,
    trees: Mapping[str, tuple["coal.BVHModelOBBRSS", ...]],
    poses: dict[str, ndarray],
    pair: tuple[str, str],
    rows: Int[ndarray, "n"],
) -> dict[str, Float[ndarray, "places 3"]]:
    """Places where parts of two links overlap in some configurations, for the link whose true meshes are
    further from there."""
    found: dict[str, list[ndarray]] = {link: [] for link in pair}
    request, point = coal.DistanceRequest(), coal.Sphere(1e-6)
    for i in rows:
        for at in links.contacts(poses, *pair, int(i)):
            far = [
                min(
                    coal.distance(
                        point, coal.Transform3s(np.eye(3), at), tree, place, request, coal.DistanceResult()
                    )
                    for tree in trees[link]
                )
                for link, place in ((link, coal_pose(poses[link][i])) for link in pair)
            ]
            link = pair[int(np.argmax(far))]
            T = poses[link][i]
            found[link].append((at - T[:3, 3]) @ T[:3, :3])
    return {link: np.reshape(places, (-1, 3)) for link, places in found.items()}


def _one_per_cube(points: Float[ndarray, "n 3"], gaps: Float[ndarray, "n"]) -> Float[ndarray, "m 4"]:
    """Of each cube the place with the narrowest gap."""
    order = np.argsort(gaps)
    rows = np.column_stack([points, gaps])[order]
    return rows[np.unique(np.floor(rows[:, :3] / CUBE), axis=0, return_index=True)[1]]


def _collide(
    first: tuple["coal.BVHModelOBBRSS", ...],
    second: tuple["coal.BVHModelOBBRSS", ...],
    T_a: ndarray,
    T_b: ndarray,
) -> bool:
    """Whether surfaces of two links cross (one within the other is not found)."""
    request, result = coal.CollisionRequest(), coal.CollisionResult()
    place_a, place_b = coal_pose(T_a), coal_pose(T_b)
    return any(
        coal.collide(one, place_a, other, place_b, request, result) for one in first for other in second
    )
