"""Collision of motions: the arguments of compiled searches, and the motion certificate of the validator.

The motion certificate proves that a whole motion is free of collision, not only its waypoints, or finds its
first contact; `contacts` finds the later ones too. A piece of the motion is free for a link if a lower bound
of the link's clearance along the piece is positive; otherwise the piece is split. The bound is computed from
the clearance in the middle of the piece, the link's velocity there towards the nearest bodies, and a bound on
the curvature of the motion (`kernels/motion_certificate.py`). For two links, motion is measured relative to
the link nearer to the base (on two arms: to the frame where the arms part), so only the joints between the
links contribute. Clearances are first computed from the covering spheres, for many configurations at once
(`kernels/lane_clearance.py`). Where the spheres are too coarse, separating planes between the convex meshes
give the bound (`kernels/convex_bounds.py`). Coal computes distances to surfaces and point clouds, and decides
whether bodies touch."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.collision.checker import CollisionChecker
from robotdiffuse.collision.convex_geometry import (
    SURFACES_BELOW,
    Check,
    checks_of,
    hulls_of,
    solid_arrays,
)
from robotdiffuse.collision.kernel_arrays import compile_robot, compile_scene_for, robot_groups
from robotdiffuse.collision.kernels import motion_certificate as kernel
from robotdiffuse.collision.kernels import motion_pieces
from robotdiffuse.collision.kernels.motion_certificate import (
    CLEARANCE_CAP,
    PAIR,
    SCENE,
    Arm,
    Checks,
    Round,
)
from robotdiffuse.collision.kernels.motion_pieces import Motion, Pieces
from robotdiffuse.collision.kernels.motions import Space
from robotdiffuse.core.loading import loading
from robotdiffuse.core.transforms import ball_around
from robotdiffuse.core.types import Configurations, JointValues, for_kernels
from robotdiffuse.robots.kinematic_tree import once_per_robot
from robotdiffuse.robots.motion_bounds import motion_radii, radii_of
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene import Scene

if TYPE_CHECKING:
    from robotdiffuse.collision.exact_meshes import ExactCollision

FINEST_RESOLUTION = 0.002
"""Smallest resolution of motion checks in a search [m]."""
INITIAL_TRAVEL = 0.16
"""Motion bound of the pieces into which a motion is first split [m]. Half or twice this value is about as
fast."""
CONTACT_TRAVEL_TOLERANCE = 1e-3
"""The first contact is located to within this motion bound [m]."""
DEPTH_SAMPLE_TRAVEL = 0.01
"""Motion bound between the configurations at which the depth of a contact is computed [m]."""
DEPTH_SAMPLES = 64
"""Largest number of configurations at which the depth of one contact is computed."""


def search_space(
    checker: CollisionChecker,
    resolution: float,
    padding: float = 0.0,
    near_ends: Float[ndarray, "m columns"] | None = None,
) -> Space:
    """The arguments of a compiled search; `resolution`, `padding` and `near_ends` as in `Space`."""
    robot = checker.robot
    ends = np.zeros((0, robot.dof + 1)) if near_ends is None else near_ends
    return Space(
        checker.robot_arrays,
        checker.scene_arrays,
        robot.lower.astype(np.float32),
        robot.upper.astype(np.float32),
        largest_motion_radii(robot),
        np.float32(resolution),
        np.float32(padding),
        ends.astype(np.float32),
    )


def finer_resolution(resolution: float) -> float:
    """Half the resolution, at least FINEST_RESOLUTION [m]: for the next search, after the validator found a
    contact that the last search had missed between two configurations."""
    return max(resolution / 2, FINEST_RESOLUTION)


def largest_motion_radii(robot: Robot) -> JointValues:
    """Largest distance of any point of the arm from each joint's axis [m]; 1 for a prismatic joint."""
    return motion_radii(robot).max(axis=0, initial=0.0).astype(np.float32)


class Contact(NamedTuple):
    """A contact of a motion."""

    check: Check
    other: str
    """The obstacle or the other link."""
    at: float
    """Index of a waypoint plus a fraction of the segment after it."""
    depth: float
    """The greatest penetration found until the contact ends [m]; 0 for a touch."""


class Sweep(NamedTuple):
    """The result of certifying a motion."""

    contact: Contact | None
    scene_clearance: float
    """Lower bound on the clearance to the scene along the motion [m], at most 1 m; 0 if there is a
    contact."""
    self_clearance: float
    """Lower bound on the clearance between links along the motion [m], at most 1 m; 0 if there is a
    contact."""


@dataclass(eq=False)
class ContinuousCollision:
    """Certifies whole motions of a robot in a scene. Threads may share an object of this class, since calls
    do not change it."""

    robot: Robot
    scene: Scene
    contact: float
    """Meshes nearer than this [m] count as touching."""
    tightness: float
    """Pieces are split until the certified clearance to the scene is at least this fraction, in (0, 1), of
    the smallest measured clearance to the scene. The same is done for the clearance between links."""

    def __post_init__(self) -> None:
        self.arm, self.checks = _arm(self.robot), _checks(self.robot)
        self.scene_arrays = compile_scene_for(self.robot, self.scene)
        self.solids = solid_arrays(self.robot, self.scene)

    def sweep(self, q: Configurations) -> Sweep:
        """Certify the motion along straight lines in joint space through the waypoints (at least one)."""
        q = for_kernels(q)
        motion = Motion(q, motion_pieces.travel_along(q, self.checks.motion_radii))
        todo = motion_pieces.first_pieces(motion, self.checks, INITIAL_TRAVEL)
        best = np.full(2, CLEARANCE_CAP)  # smallest measured clearance of SCENE and of PAIR
        certified = np.full(2, CLEARANCE_CAP)  # smallest lower bound along the motion, of each of the two
        hit: tuple[float, int] | None = None  # place and check of the first contact
        while len(todo.start):
            bounds = kernel.rounds(
                self.arm,
                self.scene_arrays,
                self.solids,
                motion,
                self.checks,
                todo,
                best,
                certified,
                self.tightness,
                self.contact,
            )
            rows, columns = np.nonzero(bounds.travel >= 0)
            if not len(rows):
                break
            touched = self._ask(motion, bounds, rows, columns, best)
            if touched is not None:
                hit, bounds = touched
            todo = kernel.settle(self.checks, bounds, best, certified, self.tightness)
        if hit is not None:
            return Sweep(self._contact(motion, *hit), 0.0, 0.0)
        return Sweep(None, *certified.tolist())

    def _ask(
        self, motion: Motion, bounds: Round, rows: ndarray, columns: ndarray, best: ndarray
    ) -> tuple[tuple[float, int], Round] | None:
        """Let Coal compute the distances of checks that the bounds did not decide.

        If there is a contact, returns its place and check, and the pieces before the contact with their
        bounds: only there may an earlier contact be found. Else returns None.
        """
        todo = bounds.pieces
        clearance = bounds.clearance
        lower = bounds.lower
        kinds = self.checks.kind[columns]
        travel = bounds.travel[rows, columns]
        middle = (todo.start + todo.stop) / 2
        at = motion_pieces.configurations(motion, middle[rows])
        cutoffs = np.clip(travel + best[kinds], 2 * self.contact, CLEARANCE_CAP)
        distances, _ = self._exact.nearest(at, columns, cutoffs, stop=self.contact)
        computed = int(np.isfinite(distances).sum())
        touched = distances[computed - 1] <= self.contact
        computed -= int(touched)
        cells = rows[:computed], columns[:computed]
        clearance[cells] = distances[:computed]
        lower[cells] = np.maximum(lower[cells], distances[:computed] - travel[:computed])
        np.minimum.at(best, kinds[:computed], distances[:computed])
        if not touched:
            return None
        row = int(rows[computed])
        row_count = row + int(todo.stop[row] - todo.start[row] > 2 * CONTACT_TRAVEL_TOLERANCE)
        todo.stop[row] = middle[row]
        clearance[row:] = lower[row:] = -np.inf
        pieces = Pieces(*(part[:row_count] for part in todo))
        earlier = Round(pieces, *(part[:row_count] for part in bounds[1:]))
        return (float(middle[row]), int(columns[computed])), earlier

    @cached_property
    def _exact(self) -> "ExactCollision":
        with loading():
            from robotdiffuse.collision.exact_meshes import (
                ExactCollision,  # imports Coal, which most motions do not need
            )

        return ExactCollision(self.robot, self.scene)

    def _contact(self, motion: Motion, at: float, check: int) -> Contact:
        """The contact of a check at travel `at`, with its greatest depth until the two bodies separate."""
        steps = at + DEPTH_SAMPLE_TRAVEL * np.arange(DEPTH_SAMPLES)
        steps = steps[steps <= max(motion.travel[-1], at)]
        checks = np.full(len(steps), check)
        cutoffs = np.full(len(steps), 2 * self.contact)
        distances, names = self._exact.nearest(motion_pieces.configurations(motion, steps), checks, cutoffs)
        partner = names[0]
        separated = [i for i, name in enumerate(names) if name != partner or distances[i] > self.contact]
        episode = distances[: separated[0] if separated else len(steps)]
        depth = max(0.0, -float(episode.min(initial=0)))
        return Contact(checks_of(self.robot)[check], str(partner), _place(motion, at), depth)


@once_per_robot
def _arm(robot: Robot) -> Arm:
    return Arm(compile_robot(robot), hulls_of(robot)[0], *robot.kernel_joints)


@once_per_robot
def _checks(robot: Robot) -> Checks:
    """The checks as arrays for compiled code. Motion radii of a pair are relative to the frame of the last
    joint that moves both links: on one chain, the frame of the link nearer to the base."""
    covered = with_covering_spheres(robot)
    parts = hulls_of(robot)[1]
    groups = robot_groups(robot)
    # by link (with None) or pair of links, as in a Check: the index in RobotArrays
    sphere_indices = {frozenset((link, None)): i for i, link in enumerate(groups)}
    for i, (a, b) in enumerate(compile_robot(robot).pairs[:, :2].tolist()):
        sphere_indices[frozenset((groups[a], groups[b]))] = i
    checks = checks_of(robot)
    rows = []
    part_ranges = []
    check_radii = np.zeros((len(checks), robot.dof))
    for k, (link, partner) in enumerate(checks):
        nearer, farther = sorted((partner or robot.base, link), key=robot.link_frame)
        near_frame = robot.link_frame(nearer)
        moved_by = robot.moved_by[[near_frame, robot.link_frame(farther)]]
        shared = moved_by.all(axis=0)
        moved_alone = moved_by & ~shared
        for member, joints in zip((nearer, farther), moved_alone, strict=True):
            if joints.any():
                check_radii[k, joints] = radii_of(covered, [member])[0, joints]
        kind = SCENE if partner is None else PAIR
        common = int(np.flatnonzero(shared).max(initial=-1)) + 1
        second = int(moved_alone[1].argmax()) if common != near_frame else 0
        sphere_index = sphere_indices.get(frozenset((link, partner)), -1)
        rows.append((kind, sphere_index, near_frame, common, second))
        partner_parts = range(0) if partner is None else parts[nearer]
        part_ranges.append(
            (parts[farther].start, parts[farther].stop, partner_parts.start, partner_parts.stop)
        )
    kinds, indices, near, common, second = np.array(rows, np.int64).reshape(-1, 5).T.copy()
    return Checks(
        kinds,
        indices,
        np.array(part_ranges, np.int64).reshape(-1, 4),
        near,
        common,
        second,
        check_radii,
        np.array([SURFACES_BELOW if frozenset(check) in robot.grazing else 0.0 for check in checks]),
    )


@once_per_robot
def with_covering_spheres(robot: Robot) -> Robot:
    """The robot, with one sphere around the meshes of each link that has meshes but no spheres."""
    added = {}
    for link, meshes in robot.meshes.items():
        if len(meshes) and not len(robot.spheres.get(link, ())):
            center, radius = ball_around(np.concatenate([mesh.vertices for mesh in meshes]))
            added[link] = np.array([[*center, radius]])
    return replace(robot, spheres=robot.spheres | added) if added else robot


MAX_SWEEPS = 5000
"""Largest number of times that `contacts` checks the remaining motion for the next contact."""


def contacts(robot: Robot, scene: Scene, q: Configurations, contact: float) -> list[Contact]:
    """All contacts along straight lines through waypoints, in order.

    A contact begins where two bodies come nearer than `contact` [m] and lasts until they separate. If a link
    touches several obstacles at once, only the deepest contact counts. The motion certificate stops at the
    first place that it cannot prove free: the next contact. From there, exact distances are computed every
    1 cm of motion until no bodies are in contact.
    """
    validator = ContinuousCollision(robot, scene, contact, 0.5)
    q = for_kernels(q)
    motion = Motion(q, motion_pieces.travel_along(q, validator.checks.motion_radii))
    end = float(motion.travel[-1])
    at = 0.0
    contacts_in_order = list[Contact]()
    for _ in range(MAX_SWEEPS):
        low = motion_pieces.segment_at(motion.travel, at)[0]
        contact_configuration = motion_pieces.configurations(motion, np.array([at]))
        remaining_q = np.concatenate([contact_configuration, q[low + 1 :]])
        first = validator.sweep(remaining_q).contact
        if first is None:
            break
        # converts the contact's place in `remaining_q`, a row plus a fraction, to the travel along the whole
        # motion
        travel = np.concatenate([[at], motion.travel[low + 1 :]])
        at = float(np.interp(first.at, np.arange(len(travel)), travel))
        at = _follow(validator._exact, motion, at, contact, first, contacts_in_order)
        if at >= end:
            break
    return contacts_in_order


def _follow(
    exact: "ExactCollision",
    motion: Motion,
    at: float,
    contact: float,
    first: Contact,
    contact_list: list[Contact],
) -> float:
    """Appends to `contact_list` the contact `first` at travel `at`, and the contacts that begin before the
    arm is free again. Returns the travel at which the arm is free, or the end of the motion."""
    open_contacts = {(first.check, first.other): len(contact_list)}
    contact_list.append(first._replace(at=_place(motion, at)))
    begin = at
    end = float(motion.travel[-1])
    while True:
        [q] = motion_pieces.configurations(motion, np.array([at]))
        depths = {
            (check, str(found.other)): max(0.0, -found.distance)
            for check, found in zip(exact.checks, exact.distances(q), strict=True)
            if found.distance <= contact
        }
        if at > begin:
            open_contacts = {key: k for key, k in open_contacts.items() if key in depths}
        for key, depth in depths.items():
            if key in open_contacts:
                k = open_contacts[key]
                contact_list[k] = contact_list[k]._replace(depth=max(contact_list[k].depth, depth))
            else:
                open_contacts[key] = len(contact_list)
                contact_list.append(Contact(*key, _place(motion, at), depth))
        if at >= end or (at > begin and not depths):
            return at
        at = min(at + DEPTH_SAMPLE_TRAVEL, end)


def _place(motion: Motion, at: float) -> float:
    """The waypoint index plus the fraction of the segment at travel `at`; the first of several equal
    waypoints."""
    low, share = motion_pieces.segment_at(motion.travel, at)
    return low + share if share > 0 else float(np.searchsorted(motion.travel, at))
