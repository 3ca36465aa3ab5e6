"""Collision of motions: the space that searches check them in, and the judge's certificate.

The certificate says that a motion is free between its waypoints too, or where it first is not. While the
joints move by dq, no point of link l moves further than sum_j rho[l, j] |dq_j| (`motion_radii`). So a piece
of the motion is free for link l if its clearance at some configuration exceeds that bound from there to both
ends; otherwise the piece is split. Of two links, the further one is seen from the nearer one, so only the
joints between them count. Clearances come from the covering spheres, many configurations at once, and from
the exact meshes where the spheres are too coarse.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from robotdiffuse.collision.checker import CollisionChecker
from robotdiffuse.collision.exact import Check, ExactCollision
from robotdiffuse.collision.kernels.motions import Space
from robotdiffuse.robots.reach import motion_radii
from robotdiffuse.robots.robot import Robot, once_per_robot
from robotdiffuse.scenes.scene import Scene

FINEST = 0.002
"""Least distance between two checks of a motion that is searched with [m]."""
CAP = 1.0
"""Clearances are not looked for beyond this [m]."""
FLOAT32_SLACK = 1e-5
"""What rounding may add to the clearances of the compiled kernel [m]."""
FIRST_TRAVEL = 0.16
"""Motion bound of the pieces that a motion is cut into at first [m]; half and twice are about as fast."""
MESH_BELOW = 0.002
"""Sphere clearance [m] below which the meshes are asked rather than the piece split further: one distance of
meshes costs about as much as ten configurations of spheres, and the spheres stick out by about 1 cm."""
MOST_PIECES = 4
"""A piece is split into at most this many at a time."""
FIRST_CONTACT_TRAVEL = 1e-3
"""The first contact is located to within this motion bound [m]."""
EPISODE_TRAVEL, EPISODE_SAMPLES = 0.01, 64
"""Step [m] and number of the configurations at which the depth of a contact is looked for."""


def search_space(
    checker: CollisionChecker,
    resolution: float,
    padding: float = 0.0,
    near_ends: Float[ndarray, "m columns"] | None = None,
) -> Space:
    """What the compiled search needs; `resolution`, `padding` [m] and `near_ends` as in its docstring."""
    robot = checker.robot
    ends = np.zeros((0, robot.dof + 1)) if near_ends is None else near_ends.copy()
    ends[:, -1] += checker.padding
    return Space(
        checker.robot_arrays,
        checker.scene_arrays,
        robot.lower.astype(np.float32),
        robot.upper.astype(np.float32),
        levers(robot),
        np.float32(resolution),
        checker.padding + np.float32(padding),
        ends.astype(np.float32),
    )


def finer(resolution: float) -> float:
    """For after a path that the judge refused: it found contact between two checks, so look twice as closely
    [m]."""
    return max(resolution / 2, FINEST)


def levers(robot: Robot) -> Float[ndarray, "dof"]:
    """Largest distance of any point of the arm from each joint's axis [m]."""
    return motion_radii(robot).max(axis=0, initial=0.0).astype(np.float32)


class Contact(NamedTuple):
    """The first contact of a motion."""

    check: Check
    other: str
    """The obstacle or the other link."""
    at: float
    """Waypoint index plus fraction."""
    depth: float
    """The greatest penetration found until the contact ends [m]; 0 for a touch."""


class Sweep(NamedTuple):
    """What is known of a motion."""

    contact: Contact | None
    scene_clearance: float
    """A lower bound on all clearances to the scene along the motion [m], at most 1 m; 0 with a contact."""
    self_clearance: float
    """The same between links."""
    sphere_checks: int
    """Configurations checked by covering spheres."""
    mesh_checks: int
    """Distances of one link to the scene or to another link by exact meshes."""


@dataclass
class _Pieces:
    """Pieces of the motion in order, in waypoint index plus fraction."""

    start: Float[ndarray, "n"]
    stop: Float[ndarray, "n"]
    undecided: Bool[ndarray, "n checks"]

    def split(self, into: Int[ndarray, "n"]) -> "_Pieces":
        """Every piece in so many equal parts; 0 drops it."""
        parent = np.repeat(np.arange(len(into)), into)
        index = np.arange(len(parent)) - np.repeat(np.cumsum(into) - into, into)
        start, width, parts = self.start[parent], (self.stop - self.start)[parent], into[parent]
        return _Pieces(
            start + width * (index / parts), start + width * ((index + 1) / parts), self.undecided[parent]
        )


class ContinuousCollision:
    """Judges whole motions of a robot in a scene. Not safe for use by several threads at once."""

    def __init__(self, robot: Robot, scene: Scene, contact: float, tightness: float) -> None:
        """Meshes nearer than `contact` [m] touch. Pieces are split until each certified clearance is at least
        the share `tightness`, in (0, 1), of the least one measured of its kind: to the scene, or between
        links."""
        self.contact, self.tightness = contact, tightness
        self.exact = ExactCollision(robot, scene)
        self._checker = CollisionChecker(robot, scene)
        known = [*(Check(a, None) for a in self._checker.links), *(Check(*p) for p in self._checker.pairs)]
        column = {frozenset(check): i for i, check in enumerate(known)}
        shared = [(i, column.get(frozenset(check), -1)) for i, check in enumerate(self.exact.checks)]
        ours = np.array([pair for pair in shared if pair[1] >= 0], dtype=np.int64).reshape(-1, 2)
        self._ours, self._theirs = ours[:, 0], ours[:, 1]
        self._levers = _check_levers(robot, self.exact.checks)

    def sweep(self, q: Float[ndarray, "n dof"]) -> Sweep:
        """Judge the motion along straight joint-space lines through the waypoints (at least one)."""
        motion = _Motion(q, self._levers)
        todo = self._first_pieces(motion)
        best = certified = np.full(len(self.exact.checks), CAP)
        hit: tuple[float, int] | None = None
        spheres = meshes = 0
        while len(todo.start):
            middle = (todo.start + todo.stop) / 2
            at, travel = motion.configurations(middle), motion.travel(middle)
            bound = np.maximum(travel - motion.travel(todo.start), motion.travel(todo.stop) - travel)
            clearance = np.where(todo.undecided, self._sphere_clearances(at), np.inf)
            best = self._least(best, np.where(clearance > MESH_BELOW, clearance, CAP))

            rows, checks = np.nonzero((clearance <= MESH_BELOW) & (clearance - bound < self.tightness * best))
            cutoffs = np.minimum(bound[rows, checks] + best[checks], CAP)
            distances, _ = self.exact.nearest(at[rows], checks, cutoffs, stop=self.contact)
            asked = int(np.isfinite(distances).sum())
            spheres, meshes = spheres + len(at), meshes + asked
            hit_row = None
            if asked and distances[asked - 1] <= self.contact:
                asked -= 1
                hit_row = int(rows[asked])
                hit = (float(middle[hit_row]), int(checks[asked]))
            clearance[rows[:asked], checks[:asked]] = distances[:asked]
            measured = np.full(clearance.shape, CAP)
            measured[rows[:asked], checks[:asked]] = distances[:asked]
            best = self._least(best, measured)

            lower = clearance - bound
            certain = lower >= self.tightness * best
            if hit_row is not None:
                certain[hit_row:] = False
            certified = self._least(certified, np.where(certain & todo.undecided, lower, CAP))
            todo.undecided &= ~certain
            need = bound / np.maximum(clearance - self.tightness * best, 1e-9)
            need = np.where(todo.undecided, need, 0).max(axis=1, initial=0)
            into = np.where(todo.undecided.any(axis=1), np.clip(np.ceil(need), 2, MOST_PIECES), 0).astype(int)
            if hit_row is not None:  # what follows the contact matters no more; what precedes it does
                todo.stop[hit_row] = middle[hit_row]
                into[hit_row + (bound[hit_row].max() > FIRST_CONTACT_TRAVEL) :] = 0
            todo = todo.split(into)
        contact = None if hit is None else self._contact(motion, *hit)
        scene, itself = (0.0, 0.0) if hit is not None else self._by_kind(certified)
        return Sweep(contact, scene, itself, spheres, meshes)

    def _by_kind(self, values: Float[ndarray, "checks"]) -> tuple[float, float]:
        """The least of the checks against the scene, and of those between links."""
        links = len(self.exact.links)
        return float(values[:links].min(initial=CAP)), float(values[links:].min(initial=CAP))

    def _least(
        self, before: Float[ndarray, "checks"], values: Float[ndarray, "n checks"]
    ) -> Float[ndarray, "checks"]:
        """For each check the least value of its kind, or that before."""
        scene, itself = self._by_kind(values.min(axis=0, initial=CAP))
        links = len(self.exact.links)
        return np.minimum(before, np.repeat([scene, itself], [links, len(before) - links]))

    def _first_pieces(self, motion: "_Motion") -> _Pieces:
        """Pieces of about equal motion bound, after one of no length at the start."""
        last = len(motion.q) - 1
        worst = motion.travelled.max(axis=1, initial=0)
        count = max(1, int(np.ceil(worst[-1] / FIRST_TRAVEL)))
        knots = np.interp(np.linspace(0, worst[-1], count + 1), worst, np.arange(last + 1))
        knots[0], knots[-1] = 0, last
        knots = np.concatenate([[0], knots])
        return _Pieces(knots[:-1], knots[1:], np.ones((count + 1, len(self.exact.checks)), bool))

    def _sphere_clearances(self, q: Float[ndarray, "n dof"]) -> Float[ndarray, "n checks"]:
        """Lower bounds of the clearances; minus infinity for checks that the spheres do not know."""
        clearances = np.full((len(q), len(self.exact.checks)), -np.inf)
        found = (self._checker.link_clearances(q), self._checker.pair_clearances(q))
        clearances[:, self._ours] = np.concatenate(found, axis=1)[:, self._theirs] - FLOAT32_SLACK
        return clearances

    def _contact(self, motion: "_Motion", at: float, check: int) -> Contact:
        """The contact of a check at a place, with its depth until the check comes free of that obstacle."""
        travelled = motion.travelled[:, check]
        begin = float(motion.travel(np.array([at]))[0, check])
        steps = begin + EPISODE_TRAVEL * np.arange(EPISODE_SAMPLES)
        steps = steps[steps <= travelled[-1]]
        samples = np.maximum(np.interp(steps, travelled, np.arange(len(travelled))), at)
        samples = np.concatenate([[at], samples])
        checks, cutoffs = np.full(len(samples), check), np.full(len(samples), 2 * self.contact)
        distances, names = self.exact.nearest(motion.configurations(samples), checks, cutoffs)
        other = names[0]
        left = [i for i, name in enumerate(names) if name != other or distances[i] > self.contact]
        episode = distances[: left[0] if left else len(samples)]
        return Contact(self.exact.checks[check], str(other), at, max(0.0, -float(episode.min(initial=0))))


class _Motion:
    """Waypoints, and how far the links can have moved up to each of them."""

    def __init__(self, q: Float[ndarray, "n dof"], levers: Float[ndarray, "dof checks"]) -> None:
        self.q = q
        moves = np.abs(np.diff(q, axis=0, prepend=q[:1]))
        self.travelled: Float[ndarray, "n checks"] = np.cumsum(moves, axis=0) @ levers

    def configurations(self, at: Float[ndarray, "m"]) -> Float[ndarray, "m dof"]:
        """Configurations at waypoint indices plus fractions."""
        return _interpolated(self.q, at)

    def travel(self, at: Float[ndarray, "m"]) -> Float[ndarray, "m checks"]:
        """Motion bound [m] of every check from the first waypoint to here."""
        return _interpolated(self.travelled, at)


def _interpolated(rows: Float[ndarray, "n k"], at: Float[ndarray, "m"]) -> Float[ndarray, "m k"]:
    low = at.astype(int)
    high = np.minimum(low + 1, len(rows) - 1)
    return rows[low] + (at - low)[:, None] * (rows[high] - rows[low])


def _check_levers(robot: Robot, checks: tuple[Check, ...]) -> Float[ndarray, "dof checks"]:
    """Motion bound of each check's link, seen from what it is checked against, per unit of joint motion."""
    covered = _covered(robot)
    links = [link for link in covered.link_names if link in covered.spheres]
    radii = motion_radii(covered)
    levers = np.zeros((robot.dof, len(checks)))
    for k, (link, other) in enumerate(checks):
        near, far, further = 0, robot.link_frame(link), link
        if other is not None and robot.link_frame(other) > far:
            near, far, further = far, robot.link_frame(other), other
        elif other is not None:
            near = robot.link_frame(other)
        levers[near:far, k] = radii[links.index(further), near:far]
    return levers


@once_per_robot
def _covered(robot: Robot) -> Robot:
    """The robot, with one sphere about the meshes of each link that has meshes but no spheres."""
    added = {}
    for link, meshes in robot.meshes.items():
        if len(meshes) and not len(robot.spheres.get(link, ())):
            vertices = np.concatenate([mesh.vertices for mesh in meshes])
            center = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
            radius = np.linalg.norm(vertices - center, axis=1).max()
            added[link] = np.array([[*center, radius]])
    return replace(robot, spheres=robot.spheres | added) if added else robot
