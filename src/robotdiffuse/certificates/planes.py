"""Separating planes between convex bodies, from Coal's nearest points: the search part of writing a proof."""

# Coal's Python module has no type information.
# pyright: reportAttributeAccessIssue=false

from collections.abc import Iterator
from typing import NamedTuple

import coal
import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.certificates.bounds import SCENE, Claim, Part, Plane, Prover, Stretches, gaps, placed
from robotdiffuse.certificates.obstacles import Rounded, Surface
from robotdiffuse.core.transforms import transform
from robotdiffuse.robots.coal_geometry import coal_convex, coal_pose

MAX_PLANES = 64
"""Planes between a part and a surface at most; concave surfaces need several."""
DECIMALS = 10
"""Decimals of normals in files, whose length must be 1 within 1e-9."""

Normal = tuple[float, float, float]


class _Body(NamedTuple):
    geometry: coal.CollisionGeometry
    T: Float[ndarray, "4 4"]
    """Its pose in the frame of its link, or in the base frame."""


class PlaneFinder:
    """Finds separating planes for the stretches of a prover."""

    def __init__(self, prover: Prover) -> None:
        self.prover = prover
        self._parts = {link: tuple(map(_hull, parts)) for link, parts in prover.parts.items()}
        self._obstacles = tuple(
            _rounded(body) if isinstance(body, Rounded) else None for body in prover.obstacles.bodies
        )

    def planes(self, todo: Stretches, rows: ndarray, needed: Float[ndarray, "rows"]) -> list[Plane]:
        """Planes for the stretches of these rows; pairs of bodies with balls further apart than `needed` [m]
        need none, and bodies that touch have none."""
        prover = self.prover
        middle = (todo.start[rows] + todo.stop[rows]) / 2
        postures = prover.linkage.place(prover.at(middle))
        return [
            Plane(row, *plane)
            for k, row in enumerate(rows.tolist())
            for plane in self._of(prover.claims[todo.claim[row]], postures.T[k], float(needed[k]))
        ]

    def _of(self, claim: Claim, T: ndarray, needed: float) -> Iterator[tuple[int, int, Normal]]:
        prover, links = self.prover, self.prover.linkage.links
        T_base_link = T[links.index(claim.link)]
        for p, part in enumerate(placed(prover.parts[claim.link], T_base_link)):
            bodies = prover.others(claim, T, part)
            apart = prover.balls_apart(part, bodies)
            first = self._parts[claim.link][p]
            first = first._replace(T=T_base_link @ first.T)
            if claim.against == SCENE:
                apart[prover.may_touch[links.index(claim.link)]] = np.inf
            for o, body in enumerate(bodies):
                if apart[o] >= needed:
                    continue
                if isinstance(body, Surface):
                    yield from ((p, o, normal) for normal in _around(first, part, body, needed))
                    continue
                if claim.against == SCENE:
                    second = self._obstacles[o]
                else:
                    second = self._parts[claim.against][o]
                    second = second._replace(T=T[links.index(claim.against)] @ second.T)
                assert second is not None
                normal = _normal(first, second)
                if normal is not None:
                    yield p, o, normal


def _around(first: _Body, part: Part, surface: Surface, needed: float) -> Iterator[Normal]:
    """Planes that together separate all near elements of a surface by `needed`, starting with the nearest
    one."""
    shown = np.full(len(surface.corners), -np.inf)
    order = np.argsort(np.sqrt(((surface.corners - part.center) ** 2).sum(axis=-1)).min(axis=1))
    asked = np.zeros(len(order), bool)
    for _ in range(MAX_PLANES):
        left = order[(shown[order] < needed) & ~asked[order]]
        if not len(left):
            return
        element = int(left[0])
        asked[element] = True
        corners = surface.corners[element]
        if len(corners) == 3:
            second = _Body(coal_convex(corners, np.array([[0, 1, 2], [0, 2, 1]])), np.eye(4))
        else:
            second = _Body(coal.Sphere(surface.radius), transform(corners[0]))
        normal = _normal(first, second)
        if normal is None:
            return
        shown = np.maximum(shown, gaps(part, surface, np.array([normal]))[:, 0])
        yield normal


def _normal(first: _Body, second: _Body) -> Normal | None:
    """Unit vector from the nearest point of the second body to that of the first; None if they touch."""
    request, result = coal.DistanceRequest(), coal.DistanceResult()
    coal.distance(first.geometry, coal_pose(first.T), second.geometry, coal_pose(second.T), request, result)
    between = np.asarray(result.getNearestPoint1()) - np.asarray(result.getNearestPoint2())
    distance = float(np.linalg.norm(between))
    if not result.min_distance > 0 or distance < 1e-9:
        return None
    x, y, z = np.round(between / distance, DECIMALS).tolist()
    return x, y, z


def _hull(part: Part) -> _Body:
    if len(part.vertices) == 1:
        return _Body(coal.Sphere(part.rounding), transform(part.vertices[0]))
    return _Body(coal_convex(part.vertices, part.faces), np.eye(4))


def _rounded(body: Rounded) -> _Body:
    x, y, z = (2 * body.half).tolist()
    if body.disc > 0:
        geometry = coal.Cylinder(body.disc, z)
    elif body.rounding > 0:
        geometry = coal.Capsule(body.rounding, z) if z > 0 else coal.Sphere(body.rounding)
    else:
        geometry = coal.Box(x, y, z)
    return _Body(geometry, transform(body.center, body.R))
