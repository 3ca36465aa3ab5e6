"""Collision of motions: the space that searches check them in, and the judge's certificate.

The certificate says that a motion is free between its waypoints too, or where it first is not. While the
joints move by dq, no point of link l moves further than sum_j rho[l, j] |dq_j| (`motion_radii`). So a piece
of the motion is free for link l if its clearance at some configuration exceeds that bound from there to both
ends; otherwise the piece is split. Of two links, the further one is seen from the nearer one, so only the
joints between them count. Clearances come from the covering spheres, many configurations at once, and from
the exact meshes where the spheres are too coarse.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.collision.arrays import compile_robot, compile_scene_for, robot_groups
from robotdiffuse.collision.checker import CollisionChecker
from robotdiffuse.collision.exact import Check, ExactCollision
from robotdiffuse.collision.kernels import sweep as kernel
from robotdiffuse.collision.kernels.motions import Space
from robotdiffuse.collision.kernels.sweep import CAP, PAIR, SCENE, Checks, Motion, Pieces
from robotdiffuse.robots.lever_arms import motion_radii
from robotdiffuse.robots.robot import Robot, once_per_robot
from robotdiffuse.scenes.scene import Scene

FINEST = 0.002
"""Least distance between two checks of a motion that is searched with [m]."""
FIRST_TRAVEL = 0.16
"""Motion bound of the pieces that a motion is cut into at first [m]; half and twice are about as fast."""
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


class ContinuousCollision:
    """Judges whole motions of a robot in a scene. Not safe for use by several threads at once."""

    def __init__(self, robot: Robot, scene: Scene, contact: float, tightness: float) -> None:
        """Meshes nearer than `contact` [m] touch. Pieces are split until each certified clearance is at least
        the share `tightness`, in (0, 1), of the least one measured of its kind: to the scene, or between
        links."""
        self.contact, self.tightness = contact, tightness
        self.exact = ExactCollision(robot, scene)
        self._robot_arrays, self._scene_arrays = compile_robot(robot), compile_scene_for(robot, scene)
        self._checks = _known_to_spheres(robot, self.exact.checks)
        self._levers = _check_levers(robot, self.exact.checks)

    def sweep(self, q: Float[ndarray, "n dof"]) -> Sweep:
        """Judge the motion along straight joint-space lines through the waypoints (at least one)."""
        motion = _motion(q, self._levers)
        todo = kernel.first_pieces(motion, FIRST_TRAVEL)
        best, certified = np.full(2, CAP), np.full(2, CAP)
        hit: tuple[float, int] | None = None
        while len(todo.start):
            found, rows, columns = kernel.rounds(
                self._robot_arrays,
                self._scene_arrays,
                motion,
                self._checks,
                todo,
                best,
                certified,
                self.tightness,
            )
            if not len(rows):
                break
            todo, clearance, bound = found
            kinds = self._checks.kind[columns]
            middle = (todo.start + todo.stop) / 2
            at = _interpolated(q, middle[rows])
            cutoffs = np.minimum(bound[rows, columns] + best[kinds], CAP)
            distances, _ = self.exact.nearest(at, columns, cutoffs, stop=self.contact)
            asked = int(np.isfinite(distances).sum())
            touched = distances[asked - 1] <= self.contact
            asked -= int(touched)
            clearance[rows[:asked], columns[:asked]] = distances[:asked]
            np.minimum.at(best, kinds[:asked], distances[:asked])
            if touched:
                row = int(rows[asked])
                hit = (float(middle[row]), int(columns[asked]))
                # what follows the contact matters no more; what precedes it does, closer and closer
                keep = row + int(bound[row].max() > FIRST_CONTACT_TRAVEL)
                todo.stop[row] = middle[row]
                todo = Pieces(*(part[:keep] for part in todo))
                clearance, bound = clearance[:keep], bound[:keep]
                clearance[row:] = -np.inf
            found = kernel.Round(todo, clearance, bound)
            todo = kernel.settle(self._checks, found, best, certified, self.tightness)
        if hit is not None:
            return Sweep(self._contact(motion, *hit), 0.0, 0.0)
        return Sweep(None, *certified.tolist())

    def _contact(self, motion: Motion, at: float, check: int) -> Contact:
        """The contact of a check at a place, with its depth until the check comes free of that obstacle."""
        travelled = motion.travelled[:, check]
        begin = float(_interpolated(travelled[:, None], np.array([at]))[0, 0])
        steps = begin + EPISODE_TRAVEL * np.arange(EPISODE_SAMPLES)
        steps = steps[steps <= travelled[-1]]
        samples = np.maximum(np.interp(steps, travelled, np.arange(len(travelled))), at)
        samples = np.concatenate([[at], samples])
        checks, cutoffs = np.full(len(samples), check), np.full(len(samples), 2 * self.contact)
        distances, names = self.exact.nearest(_interpolated(motion.q, samples), checks, cutoffs)
        other = names[0]
        left = [i for i, name in enumerate(names) if name != other or distances[i] > self.contact]
        episode = distances[: left[0] if left else len(samples)]
        return Contact(self.exact.checks[check], str(other), at, max(0.0, -float(episode.min(initial=0))))


def _motion(q: Float[ndarray, "n dof"], levers: Float[ndarray, "dof checks"]) -> Motion:
    q = np.ascontiguousarray(q, dtype=np.float64)
    moves = np.abs(np.diff(q, axis=0, prepend=q[:1]))
    return Motion(q, np.cumsum(moves, axis=0) @ levers)


def _interpolated(rows: Float[ndarray, "n k"], at: Float[ndarray, "m"]) -> Float[ndarray, "m k"]:
    low = at.astype(int)
    high = np.minimum(low + 1, len(rows) - 1)
    return rows[low] + (at - low)[:, None] * (rows[high] - rows[low])


@once_per_robot
def _groups(robot: Robot) -> tuple[dict[str, int], dict[frozenset[str | None], int]]:
    """Of the compiled arrays: the number of each link's group, and of each pair of links."""
    groups = robot_groups(robot)
    pairs = compile_robot(robot).pairs[:, :2].tolist()
    return (
        {link: i for i, link in enumerate(groups)},
        {frozenset((groups[a], groups[b])): i for i, (a, b) in enumerate(pairs)},
    )


def _known_to_spheres(robot: Robot, checks: tuple[Check, ...]) -> Checks:
    groups, pairs = _groups(robot)
    where = [
        groups.get(check.link, -1) if check.other is None else pairs.get(frozenset(check), -1)
        for check in checks
    ]
    kind = [SCENE if check.other is None else PAIR for check in checks]
    return Checks(np.array(where, np.int64), np.array(kind, np.int64))


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
