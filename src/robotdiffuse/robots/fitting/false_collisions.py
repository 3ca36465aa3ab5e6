"""Measures false collisions: free configurations in which covering spheres or convex parts of two links
collide."""

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
from robotdiffuse.robots.fitting.convex_parts import Surface
from robotdiffuse.robots.fitting.sampled_links import Links
from robotdiffuse.robots.fitting.sphere_fitting_kernel import deepest_touches
from robotdiffuse.robots.robot import Robot

PLACE_SPACING = 0.01
"""Edge of the cubes of which each keeps one place where spheres touch [m]."""
MAX_SPHERE_CASES = 2000
"""Largest number of false collisions of spheres per pair of links that are examined."""
MAX_PART_CASES = 60
"""Largest number of false collisions of convex parts per pair of links that are examined."""
NARROWEST_FRACTION = 0.003
"""Fraction of the configurations, those with the narrowest gaps, that a pair may keep as false collisions."""


@dataclass(frozen=True)
class PairFalseCollisions:
    """False collisions of a pair of links that is checked."""

    links: tuple[str, str]
    colliding: float
    """Fraction of the configurations in which the true meshes collide."""
    by_parts: float
    """Fraction of the free configurations in which convex parts of the two collide."""
    by_spheres: float
    """The same for spheres; includes configurations in which the parts collide too."""
    gaps: Float[ndarray, "configurations"]
    """Distances between the parts in some of the configurations in which only the spheres collide [m]."""
    places: dict[str, Float[ndarray, "n 4"]]
    """By link and in its frame: rows x y z where spheres touch although the parts are apart, and the smallest
    distance of the parts there [m]."""
    coarse: dict[str, Float[ndarray, "m 3"]]
    """By link and in its frame: places where parts overlap although the true meshes are apart [m]. Each place
    is listed for the link whose parts stick out further there."""


@dataclass(frozen=True)
class FalseCollisions:
    """False self-collisions of a robot."""

    free: float
    """Fraction of the configurations in which the true meshes do not collide."""
    by_parts: float
    """Fraction of the free configurations in which convex parts collide."""
    by_spheres: float
    """Fraction of the free configurations in which covering spheres collide."""
    pairs: tuple[PairFalseCollisions, ...]
    """Pairs of links, most false collisions of spheres first."""


def measure_false_collisions(
    robot: Robot, surfaces: Mapping[str, tuple[Surface, ...]], samples: int, rng: np.random.Generator
) -> FalseCollisions:
    """Measure false collisions over `samples` random configurations.

    Planned joints are uniform within their limits; locked joints keep their values. `surfaces` are the true
    meshes by link. They are tested only where convex parts collide, and the parts only where spheres do.
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
        parts = np.zeros(samples, dtype=bool)
        meshes = np.zeros(samples, dtype=bool)
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
        false_spheres = np.flatnonzero(spheres & ~parts & free)[:MAX_SPHERE_CASES]
        gaps = np.array([links.mesh_distance(poses, a, b, int(i)) for i in false_spheres])
        every = gaps
        # tolerate the narrowest few
        wide = gaps >= np.sort(gaps)[
            : int(samples * NARROWEST_FRACTION * len(false_spheres) / max(spheres.sum(), 1)) + 1
        ].max(initial=0.0)
        false_spheres = false_spheres[wide]
        gaps = gaps[wide]
        T_base_a = poses[a][false_spheres]
        T_base_b = poses[b][false_spheres]
        at = np.einsum("nij,nj->ni", T_base_a[:, :3, :3], middle[false_spheres]) + T_base_a[:, :3, 3]
        on_b = np.einsum("nji,nj->ni", T_base_b[:, :3, :3], at - T_base_b[:, :3, 3])
        places = {a: _one_per_cube(middle[false_spheres], gaps), b: _one_per_cube(on_b, gaps)}
        false_parts = np.flatnonzero(parts & ~meshes & free)[:MAX_PART_CASES]
        coarse = _sticking_out(links, trees, poses, (a, b), false_parts)
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
    """Places where parts of two links overlap in configurations `rows`, each listed for the link whose true
    meshes are further from it, in that link's frame."""
    found: dict[str, list[ndarray]] = {link: [] for link in pair}
    request = coal.DistanceRequest()
    point = coal.Sphere(1e-6)
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
    """The place with the narrowest gap of each cube."""
    order = np.argsort(gaps)
    rows = np.column_stack([points, gaps])[order]
    return rows[np.unique(np.floor(rows[:, :3] / PLACE_SPACING), axis=0, return_index=True)[1]]


def _collide(
    first: tuple["coal.BVHModelOBBRSS", ...],
    second: tuple["coal.BVHModelOBBRSS", ...],
    T_a: ndarray,
    T_b: ndarray,
) -> bool:
    """Whether surfaces of two links intersect; one inside the other is not detected."""
    request = coal.CollisionRequest()
    result = coal.CollisionResult()
    place_a = coal_pose(T_a)
    place_b = coal_pose(T_b)
    return any(
        coal.collide(one, place_a, other, place_b, request, result) for one in first for other in second
    )
