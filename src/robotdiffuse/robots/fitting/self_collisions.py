"""Finds pairs of links that need no collision check against each other, and measures false collisions:
configurations in which covering spheres or convex parts of two links collide although the true meshes do not.
Makes tables for pairs of links that pass so close to each other that covering spheres overlap, such as a
flange in a fork.

The relative pose of two links depends only on the joints between them. For one or two such joints, a table
over their values tells where the convex parts of the links are apart. A cell of the table counts as free if
the links' distance at its center exceeds their largest relative motion from the center to a point of the
cell. Other cells are split, down to a fraction of a millimeter of motion.
"""

# Coal's Python module has no type information.
# pyright: reportAttributeAccessIssue=false
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import coal
import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from robotdiffuse.core.transforms import ball_around, placed_each, seen_from
from robotdiffuse.core.types import Configurations, Mask, Points, Poses, Spheres, Values, Vector, for_kernels
from robotdiffuse.robots.coal_geometry import coal_convex, coal_pose, coal_surface
from robotdiffuse.robots.fitting.convex_parts import Surface, one_per_cube
from robotdiffuse.robots.fitting.sphere_fitting_kernel import ball_distances, deepest_touches
from robotdiffuse.robots.kinematic_tree import TURN, Joint, with_mimics
from robotdiffuse.robots.motion_bounds import radii_of
from robotdiffuse.robots.robot import LinkPairTable, Robot, moving_pairs

BINS = 24
"""Number of bins of a joint's range, to test whether the joint alone determines when two links collide."""
MAX_STOPPED_RANGE = 5.2
"""A joint with a range of at most this is taken to have mechanical stops at its limits [rad] or [m]; limits
of wider ranges may be arbitrary."""
MAX_UNEXPLAINED = 0.25
"""Largest fraction of the variance of "the links collide" (0 or 1) that the value of one joint may leave
unexplained. Below it, the joint is taken to decide whether they collide. If they do at one of its stops, the
stop is taken to be where they meet, and the pair is not checked (the reason `limits` in
`find_allowed_collisions`)."""
BALL_MARGIN = 1e-9
"""Margin of the balls around convex parts [m], larger than rounding errors."""
NEAR_DISTANCE = 0.1
"""For pairs of links that are farther apart than this in all samples, fewer searches for a collision are made
[m]."""

LinkPoses = dict[str, Poses]
"""T_base_link in n configurations, by link."""


class Links:
    """Poses of all links for batches of values of all movable joints, and collision tests of pairs of
    links."""

    def __init__(self, robot: Robot) -> None:
        self.robot = robot
        names = {joint.name for joint in robot.joints}
        movable = [joint for joint in robot.joints if joint.movable]
        # a joint that mimics one outside of the robot moves by itself
        self.joints = [j for j in movable if j.mimic is None or j.mimic.joint not in names]
        self.lower = np.array([joint.lower for joint in self.joints])
        self.upper = np.array([joint.upper for joint in self.joints])
        self.request, self.result = coal.CollisionRequest(), coal.CollisionResult()

    @cached_property
    def hulls(self) -> dict[str, list["coal.Convex"]]:
        return {
            link: [coal_convex(mesh.vertices, mesh.faces) for mesh in parts]
            for link, parts in self.robot.meshes.items()
        }

    @cached_property
    def balls(self) -> dict[str, Spheres]:
        """Balls [x y z radius] around each part, by link [m]."""
        around = {link: [ball_around(m.vertices) for m in parts] for link, parts in self.robot.meshes.items()}
        return {link: np.array([[*c, r + BALL_MARGIN] for c, r in balls]) for link, balls in around.items()}

    def random(self, count: int, rng: np.random.Generator) -> Configurations:
        """Uniform values of all joints within their limits."""
        return rng.uniform(self.lower, self.upper, (count, len(self.joints)))

    def named(self, pose: dict[str, float]) -> Values:
        """Values of all joints in a pose given by joint names. Joints that `pose` omits have their locked
        value, else zero clipped to their limits."""
        rest = self.robot.locked | pose
        return np.array([rest.get(j.name, min(max(0.0, j.lower), j.upper)) for j in self.joints])

    def stop_explains(self, joint: Joint, q: Configurations, colliding: Mask) -> bool:
        """Whether the value of one joint alone determines if two links collide, and the links collide at one
        of the joint's stops. `colliding` tells for each row of q whether they collide."""
        if joint not in self.joints or not 0 < joint.upper - joint.lower <= MAX_STOPPED_RANGE:
            return False
        fraction = (q[:, self.joints.index(joint)] - joint.lower) / (joint.upper - joint.lower)
        bin_index = np.minimum((fraction * BINS).astype(int), BINS - 1)
        count = np.maximum(np.bincount(bin_index, minlength=BINS), 1)
        colliding_fraction = np.bincount(bin_index, colliding, minlength=BINS) / count
        unexplained = (colliding_fraction * (1 - colliding_fraction) * count).sum() / len(q)
        variance = colliding.mean() * (1 - colliding.mean())
        return bool(
            max(colliding_fraction[0], colliding_fraction[-1]) > 0.99
            and unexplained < MAX_UNEXPLAINED * variance
        )

    def poses(self, q: Configurations, wanted: Iterable[str] = ()) -> LinkPoses:
        """T_base_link [n, 4, 4] by link. With `wanted` links, only the poses of these links and of the links
        on the way to them."""
        chains = [self.robot.joints_above(link) for link in wanted or self.robot.link_names]
        joints = dict.fromkeys(joint for chain in chains for joint in chain)
        poses = {self.robot.base: np.tile(np.eye(4), (len(q), 1, 1))}
        values = with_mimics(self.robot.joints, {joint.name: q[:, i] for i, joint in enumerate(self.joints)})
        for joint in joints:
            T_parent_child = joint.T_parent_joint
            if joint.movable:
                T_parent_child = T_parent_child @ joint.motion(values[joint.name])
            poses[joint.child] = poses[joint.parent] @ T_parent_child
        return poses

    def touches(self, poses: LinkPoses, a: str, b: str, apart: float, least: float) -> tuple[Values, Points]:
        """`deepest_touches` of the covering spheres of two links. The depths are upper bounds on how deep the
        links' meshes overlap."""
        first, second = (for_kernels(self.robot.spheres[link]) for link in (a, b))
        return deepest_touches(poses[a], poses[b], first, second, apart, least)

    def _placed(self, poses: LinkPoses, a: str, b: str, i: int) -> tuple[Any, Any, ndarray]:
        """Coal poses of two links in configuration i, and the distances [a, b] between the balls around their
        parts [m]."""
        ball_gaps = ball_distances(poses[a][i], poses[b][i], self.balls[a], self.balls[b])
        return coal_pose(poses[a][i]), coal_pose(poses[b][i]), ball_gaps

    def collide(self, poses: LinkPoses, a: str, b: str, i: int) -> bool:
        """Whether convex parts of two links collide in configuration i."""
        return any(True for _ in self.contacts(poses, a, b, i))

    def contacts(self, poses: LinkPoses, a: str, b: str, i: int) -> Iterator[Vector]:
        """Points where convex parts of two links overlap in configuration i, one for each overlapping pair of
        parts [m], in the base frame."""
        T_a, T_b, ball_gaps = self._placed(poses, a, b, i)
        for m, n in zip(*np.nonzero(ball_gaps <= 0), strict=True):
            self.result.clear()
            if coal.collide(self.hulls[a][m], T_a, self.hulls[b][n], T_b, self.request, self.result):
                yield np.array(self.result.getContact(0).pos)

    def mesh_distance(self, poses: LinkPoses, a: str, b: str, i: int = 0) -> float:
        """Distance between the convex parts of two links in configuration i [m]; zero or less if they
        collide."""
        T_a, T_b, ball_gaps = self._placed(poses, a, b, i)
        min_distance = np.inf
        for k in ball_gaps.argsort(axis=None):
            m, n = divmod(int(k), ball_gaps.shape[1])
            if ball_gaps[m, n] >= min_distance:
                break
            min_distance = min(min_distance, _distance(self.hulls[a][m], T_a, self.hulls[b][n], T_b))
        return float(min_distance)

    def part_distances(
        self,
        poses: LinkPoses,
        a: str,
        b: str,
        rows: Int[ndarray, "n"],
        parts: Int[ndarray, "2 n"],
        limit: float,
    ) -> Values:
        """Distances [n] between convex parts of two links [m]: entry k is for part parts[0, k] of link a and
        part parts[1, k] of link b in configuration rows[k]. A distance above `limit` may be replaced by a
        lower bound that is also above `limit`."""
        balls = [self.balls[link][parts[k]] for k, link in enumerate((a, b))]
        middles = [
            placed_each(poses[link][rows], ball[:, :3]) for link, ball in zip((a, b), balls, strict=True)
        ]
        part_gaps = np.linalg.norm(middles[0] - middles[1], axis=1) - balls[0][:, 3] - balls[1][:, 3]
        for k in np.flatnonzero(part_gaps <= limit):
            T_a, T_b = (coal_pose(poses[link][rows[k]]) for link in (a, b))
            part_gaps[k] = _distance(self.hulls[a][parts[0, k]], T_a, self.hulls[b][parts[1, k]], T_b)
        return part_gaps


def _distance(a: "coal.CollisionGeometry", T_a: Any, b: "coal.CollisionGeometry", T_b: Any) -> float:
    """Signed distance of two solids or surfaces at their poses [m]."""
    return coal.distance(a, T_a, b, T_b, coal.DistanceRequest(), coal.DistanceResult())


CELLS = 128
"""Number of cells of a table along each joint; a power of two."""
ROUNDING = 1e-5
"""Upper bound on the rounding error of a distance [m]."""


def joint_table(robot: Robot, links: Links, pair: tuple[str, str], finest: float) -> LinkPairTable:
    """Table over the one or two joints between two links that tells where their convex parts are apart.

    Boxes of joint values are not split further if the links move by less than `finest` [m] relative to each
    other from the center of the box to any of its points. The cells of such a box count as colliding unless
    they are proven free.
    """
    joints = list(robot.joints_between(*pair))
    names = tuple(robot.joint_names[joint] for joint in joints)
    far = max(pair, key=robot.link_frame)
    lever = radii_of(robot, [far])[0, joints]
    slides = robot.prismatic[joints]
    lower = robot.lower[joints]
    upper = robot.upper[joints]
    upper = np.where(slides, upper, np.minimum(upper, lower + TURN))
    columns = [[j.name for j in links.joints].index(name) for name in names]
    nominal = links.named({})
    edge = (upper - lower) / CELLS
    # Boxes of joint values, in units of the table's cells. All boxes have the same `size`, which is halved
    # along one joint per iteration. Each row of `low` is the lower corner of a box, and the column of `parts`
    # with the same index is a pair of parts that may touch in the box.
    separated = np.ones((CELLS,) * len(joints), bool)
    size = np.full(len(joints), float(CELLS))
    parts = np.indices([len(robot.meshes[link]) for link in pair]).reshape(2, -1)
    low = np.zeros((parts.shape[1], len(joints)))
    while len(low):
        boxes, box_of_row = np.unique(low, axis=0, return_inverse=True)
        q = np.tile(nominal, (len(boxes), 1))
        q[:, columns] = lower + edge * (boxes + size / 2)
        travel = float(lever @ (edge * size) / 2) + ROUNDING
        distance = links.part_distances(links.poses(q, pair), *pair, box_of_row.ravel(), parts, travel)
        touch = distance <= travel
        # boxes that count as colliding: a cell, or a part of one, with a collision at its center; a box with
        # a collision deeper than its motion; and a box with very little motion
        given_up = touch & ((size <= 1).all() & (distance <= 0) | (distance < -travel) | (travel < finest))
        for first, last in zip(*_cells(np.unique(low[given_up], axis=0), size), strict=True):
            separated[tuple(slice(*ends) for ends in zip(first, last, strict=True))] = False
        axis = int((lever * edge * size).argmax())
        size = size.copy()
        size[axis] /= 2
        low = low[touch & ~given_up]
        parts = parts[:, touch & ~given_up]
        low = np.concatenate([low, low + size * (np.arange(len(size)) == axis)])
        parts = np.tile(parts, 2)
        if (size <= 1).all():  # a cell with one contact is decided: drop its other pairs
            is_open = separated[tuple(_cells(low, size)[0].T)]
            low = low[is_open]
            parts = parts[:, is_open]
    return LinkPairTable(pair, names, tuple(lower.tolist()), tuple(upper.tolist()), separated)


def _cells(low: Float[ndarray, "n joints"], size: Float[ndarray, "joints"]) -> tuple[ndarray, ndarray]:
    """Along each joint, the index of the first cell that boxes overlap, and one past the last."""
    return np.floor(low).astype(int), np.ceil(low + size).astype(int)


ADJACENT_SHARE = 0.1
"""Adjacent links, which may touch in any case, are tested in only this fraction of the samples."""
MIN_LIMITS_COLLIDING = 0.2
"""Smallest fraction of colliding samples for the reason `limits`."""
MAX_LOCKED_JOINTS = 1
"""A link, such as the bellows of a lift, belongs to the arm if at most this many locked joints connect it to
the arm. Links after more locked joints belong to a head or another arm."""
MAX_DEFAULT_JOINTS = 3
"""Pairs of links with more joints between them are not allowed for the reason `default`: limits of single
joints keep neighbors apart, but not a hand from its own shoulder."""
MAX_POSE_OVERLAP = 0.03
"""If links overlap in a named pose by less than this [m], the pair is allowed for the reason `pose`."""


ALWAYS_FRACTION = 0.95
"""A pair that collides in at least this fraction of the samples counts as always colliding, as in MoveIt's
Setup Assistant."""


@dataclass(frozen=True)
class SamplingSettings:
    """Settings of `find_allowed_collisions`."""

    samples: int = 20_000
    """Number of configurations, uniform within the limits of all joints, including gripper joints."""
    descents: int = 20
    """For a pair without collisions in the samples: number of closest samples from which a descent searches
    for a collision; a fifth of it if no sample is close."""
    assumptions: bool = True
    """Whether pairs may be allowed for the reasons `adjacent`, `default`, `pose` and `limits`. False for
    MuJoCo models, which state which links may touch."""


class PairReport(NamedTuple):
    """How sampling classifies a pair of links."""

    links: tuple[str, str]
    reason: str
    """checked, or why the pair is allowed: adjacent, always, never, default, pose or limits, as explained in
    `find_allowed_collisions`; named, if it was named when the robot was added; srdf, if an SRDF or a MuJoCo
    model allows it."""
    colliding: float
    """Fraction of the tested configurations in which convex parts of the two links collide."""


def find_allowed_collisions(
    robot: Robot, settings: SamplingSettings, rng: np.random.Generator
) -> tuple[PairReport, ...]:
    """Classify each pair of links that have meshes and are on different frames; the robot needs covering
    spheres.

    Pairs are allowed for these reasons, the first four as in MoveIt's Setup Assistant:

    - adjacent: a joint connects the links; links without geometry between them are skipped.
    - always: the links collide in nearly all samples.
    - never: the links collide in no sample, and no descent finds a collision.
    - default: the links collide in the default pose, with the joints between them at zero. If the limits
      include this pose, the manufacturer considers it safe, so the meshes are taken to be too coarse there.
      Both links must belong to the arm, since the limits do not account for a tool on the last link or for
      another arm, and have at most MAX_DEFAULT_JOINTS joints between them. A link behind one locked joint
      also counts as part of the arm if the pair also collides at the joint's locked value, which planning
      does not change.
    - limits: the links collide in at least a fifth of the samples. The value of one joint between the links
      determines whether they collide, and they collide at a stop of this joint: joints often have their stops
      where the links on both sides meet. Both links must belong to the arm, not behind a locked joint.
    - pose: the links overlap slightly in a named pose of the SRDF, such as a tucked one.

    Coal tests the convex parts unless the covering spheres show that they are apart. For pairs without
    collisions in the samples, random descents from the closest samples search for a collision; if they find
    one, the pair is checked.
    """
    links = Links(robot)
    default = np.clip(0.0, links.lower, links.upper)[None]
    q = links.random(settings.samples, rng)
    poses = links.poses(q)
    default_poses = links.poses(default)
    locked_poses, *named_poses = (
        links.poses(links.named(pose)[None]) for pose in ({}, *robot.poses.values())
    )
    adjacent = _adjacent(robot) if settings.assumptions else set[frozenset[str]]()

    def reason(a: str, b: str, distances: ndarray, colliding: ndarray) -> str:
        if frozenset((a, b)) in adjacent:
            return "adjacent"
        if colliding.mean() >= ALWAYS_FRACTION:
            return "always"
        if settings.assumptions:
            between = _own_between(robot, a, b, MAX_LOCKED_JOINTS)
            if (
                between is not None
                and len(between) <= MAX_DEFAULT_JOINTS
                and all(joint.lower <= 0 <= joint.upper for joint in between)
                and links.collide(default_poses, a, b, 0)
                and links.collide(locked_poses, a, b, 0)
            ):
                return "default"
            if any(-MAX_POSE_OVERLAP < links.mesh_distance(pose, a, b) <= 0 for pose in named_poses):
                return "pose"
            if colliding.mean() >= MIN_LIMITS_COLLIDING and any(
                links.stop_explains(joint, q, colliding) for joint in _own_between(robot, a, b, 0) or ()
            ):
                return "limits"
        descents = settings.descents if distances.min() < NEAR_DISTANCE else settings.descents // 5
        if not colliding.any() and not _descend(links, a, b, q[np.argsort(distances)[:descents]], rng):
            return "never"
        return "checked"

    reports = []
    first = {link: T[: max(int(len(q) * ADJACENT_SHARE), 1)] for link, T in poses.items()}
    for a, b in moving_pairs(robot, robot.meshes):
        tested = first if frozenset((a, b)) in adjacent else poses
        sphere_distances = -links.touches(tested, a, b, NEAR_DISTANCE, -np.inf)[0]
        colliding = np.zeros(len(sphere_distances), bool)
        for i in np.flatnonzero(sphere_distances <= 0):
            colliding[i] = links.collide(poses, a, b, int(i))
        reports.append(PairReport((a, b), reason(a, b, sphere_distances, colliding), float(colliding.mean())))
    return tuple(reports)


def _descend(links: "Links", a: str, b: str, starts: Float[ndarray, "n d"], rng: np.random.Generator) -> bool:
    """Whether random descents on the distance of the convex parts find a collision of two links."""
    for start in starts:
        q = start
        step = 0.1 * (links.upper - links.lower)
        min_distance = links.mesh_distance(links.poses(q[None], (a, b)), a, b)
        for _ in range(15):
            around = np.clip(q + step * rng.normal(size=(8, len(q))), links.lower, links.upper)
            poses_around = links.poses(around, (a, b))
            distances = [links.mesh_distance(poses_around, a, b, i) for i in range(len(around))]
            i = int(np.argmin(distances))
            if distances[i] <= 0:
                return True
            if distances[i] < min_distance:
                q = around[i]
                min_distance = distances[i]
            else:
                step = step / 2
    return False


def _own_between(robot: Robot, a: str, b: str, max_locked: int) -> list[Joint] | None:
    """The movable joints between two links of the arm; None if one of the links does not belong to the arm.

    A link belongs to the arm if at most `max_locked` locked joints connect it to the base or to a link that
    planned joints move, and if it is not a tool.
    """

    def own(link: str) -> bool:
        """Whether a link belongs to the arm. All links after the child link of an arm's last planned joint
        count as tools."""
        planned = [joint for joint in above[link] if joint in robot.planned_joints][:1]
        carried = above[link][: above[link].index(planned[0])] if planned else above[link]
        tool = robot.at_end(link) and above[link][:1] != planned
        return not tool and sum(joint.movable for joint in carried) <= max_locked

    above = {link: robot.joints_above(link)[::-1] for link in (a, b)}
    if not own(a) or not own(b):
        return None
    chain_joints = dict.fromkeys((*above[a], *above[b]))
    return [j for j in chain_joints if (j in above[a]) != (j in above[b]) and j.movable]


def _adjacent(robot: Robot) -> set[frozenset[str]]:
    """Pairs of links that a joint connects; skips links without geometry."""
    solid: dict[str, str] = {robot.base: robot.base}
    pairs = set()
    for joint in robot.joints:
        above = solid[joint.parent]
        solid[joint.child] = joint.child if joint.child in robot.meshes else above
        pairs.add(frozenset((above, joint.child)))
    return pairs


PLACE_SPACING = 0.01
"""Edge of cubes [m]: of all places where spheres touch, one per cube is kept."""
MAX_SPHERE_CASES = 2000
"""Largest number of false collisions of spheres per pair of links that are examined."""
MAX_PART_CASES = 60
"""Largest number of false collisions of convex parts per pair of links that are examined."""
NARROWEST_FRACTION = 0.003
"""`PairFalseCollisions.places` leaves out the false collisions of spheres with the narrowest gaps between the
convex parts: they are rare, and only much finer spheres would avoid them. For each pair, they are at most
this fraction of all configurations."""


class PairFalseCollisions(NamedTuple):
    """False collisions of a pair of links that is checked."""

    links: tuple[str, str]
    colliding: float
    """Fraction of the configurations in which the true meshes collide."""
    by_parts: float
    """Fraction of the free configurations in which convex parts of the two links collide."""
    by_spheres: float
    """Fraction of the free configurations in which spheres of the two links collide, including configurations
    in which the convex parts collide too."""
    gaps: Values
    """Distances between the convex parts in up to MAX_SPHERE_CASES configurations in which only the spheres
    collide [m]."""
    places: dict[str, Spheres]
    """By link and in the link's frame: rows of a point x, y, z where spheres touch although the parts are
    apart, and the smallest distance of the parts there [m]."""
    coarse: dict[str, Points]
    """By link and in the link's frame: places where parts overlap although the true meshes are apart [m].
    A place is listed only for the link with parts that stick out further there."""


class FalseCollisions(NamedTuple):
    """False self-collisions of a robot."""

    free: float
    """Fraction of the configurations in which the true meshes do not collide."""
    by_parts: float
    """Fraction of the free configurations in which convex parts collide."""
    by_spheres: float
    """Fraction of the free configurations in which covering spheres collide."""
    pairs: tuple[PairFalseCollisions, ...]
    """Pairs of links; those with the most false collisions of spheres come first."""


def measure_false_collisions(
    robot: Robot, surfaces: Mapping[str, tuple[Surface, ...]], samples: int, rng: np.random.Generator
) -> FalseCollisions:
    """Measure false collisions over `samples` random configurations.

    Planned joints are uniform within their limits; locked joints keep their values. `surfaces` are the true
    meshes by link. Convex parts are tested only where spheres collide, and the true meshes only where convex
    parts collide.
    """
    links = Links(robot)
    q = links.random(samples, rng)
    column = {joint.name: i for i, joint in enumerate(links.joints)}
    for name in column.keys() & robot.locked:
        q[:, column[name]] = robot.locked[name]
    poses = links.poses(q)
    trees = {
        link: tuple(coal_surface(part.vertices, part.faces) for part in parts)
        for link, parts in surfaces.items()
    }
    collisions = []
    for a, b in robot.checked_pairs():
        depth, middle = links.touches(poses, a, b, 0.0, 0.0)
        spheres = depth > 0
        for table in robot.tables:
            if {*table.links} == {a, b}:
                spheres &= ~table.at(*(q[:, column[name]] for name in table.joints))
        parts = np.zeros(samples, bool)
        meshes = np.zeros(samples, bool)
        for i in np.flatnonzero(spheres):
            parts[i] = links.collide(poses, a, b, int(i))
            if parts[i]:
                T_a, T_b = coal_pose(poses[a][i]), coal_pose(poses[b][i])
                links.result.clear()
                meshes[i] = any(  # surfaces: a mesh inside another one is not detected
                    coal.collide(first_mesh, T_a, second_mesh, T_b, links.request, links.result)
                    for first_mesh in trees[a]
                    for second_mesh in trees[b]
                )
        collisions.append((spheres, parts, meshes, middle))
    if not collisions:
        return FalseCollisions(1.0, 0.0, 0.0, ())
    any_spheres, any_parts, any_meshes = (
        np.any(rows, axis=0) for rows in list(zip(*collisions, strict=True))[:3]
    )
    free = ~any_meshes
    count = max(int(free.sum()), 1)

    def share(colliding: ndarray) -> float:
        return float((colliding & free).sum() / count)

    pairs = []
    for (a, b), (spheres, parts, meshes, middle) in zip(robot.checked_pairs(), collisions, strict=True):
        false_spheres = np.flatnonzero(spheres & ~parts & free)[:MAX_SPHERE_CASES]
        all_gaps = np.array([links.mesh_distance(poses, a, b, int(i)) for i in false_spheres])
        # leave out the cases with the narrowest gaps, see NARROWEST_FRACTION
        narrow = int(samples * NARROWEST_FRACTION * len(false_spheres) / max(spheres.sum(), 1))
        far_enough = all_gaps >= np.sort(all_gaps)[: narrow + 1].max(initial=0.0)
        false_spheres = false_spheres[far_enough]
        gaps = all_gaps[far_enough]
        T_base_a = poses[a][false_spheres]
        T_base_b = poses[b][false_spheres]
        at = placed_each(T_base_a, middle[false_spheres])
        on_b = np.einsum("nji,nj->ni", T_base_b[:, :3, :3], at - T_base_b[:, :3, 3])
        places = {a: _narrowest_per_cube(middle[false_spheres], gaps), b: _narrowest_per_cube(on_b, gaps)}
        false_parts = np.flatnonzero(parts & ~meshes & free)[:MAX_PART_CASES]
        sticking_out = _sticking_out(links, trees, poses, (a, b), false_parts)
        shares = share(parts), share(spheres)
        pairs.append(
            PairFalseCollisions((a, b), float(meshes.mean()), *shares, all_gaps, places, sticking_out)
        )
    worst_first = sorted(pairs, key=lambda pair: -pair.by_spheres)
    return FalseCollisions(float(free.mean()), share(any_parts), share(any_spheres), tuple(worst_first))


def _sticking_out(
    links: Links,
    trees: Mapping[str, tuple["coal.BVHModelOBBRSS", ...]],
    poses: LinkPoses,
    pair: tuple[str, str],
    rows: Int[ndarray, "n"],
) -> dict[str, Points]:
    """Places where convex parts of two links overlap in the configurations with the indices `rows`, by link
    and in the link's frame [m]. Each place is listed only for the link whose true surface is farther from the
    place."""
    places_by_link: dict[str, list[ndarray]] = {link: [] for link in pair}
    point = coal.Sphere(1e-6)
    for i in rows:
        for at in links.contacts(poses, *pair, int(i)):
            far = [
                min(_distance(point, coal.Transform3s(np.eye(3), at), tree, place) for tree in trees[link])
                for link, place in ((link, coal_pose(poses[link][i])) for link in pair)
            ]
            link = pair[int(np.argmax(far))]
            places_by_link[link].append(seen_from(poses[link][i], at))
    return {link: np.reshape(places, (-1, 3)) for link, places in places_by_link.items()}


def _narrowest_per_cube(points: Points, gaps: Values) -> Spheres:
    """The place with the narrowest gap in each cube of edge PLACE_SPACING, as rows of the point and its gap
    [m]."""
    rows = np.column_stack([points, gaps])[np.argsort(gaps)]
    return rows[one_per_cube(rows[:, :3], PLACE_SPACING)]
