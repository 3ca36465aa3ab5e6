"""Distances and contacts between the links of a robot at sampled joint values, and tables for pairs of links
that pass so close to each other that covering spheres overlap, such as a flange in a fork.

The relative pose of two links depends only on the joints between them. For one or two such joints, a table
over their values tells where the convex parts of the links are apart. A cell of the table counts as free if
the links' distance at its center exceeds their largest relative motion from the center to a point of the
cell. Other cells are split, down to a fraction of a millimeter of motion.
"""

# Coal's Python module has no type information.
# pyright: reportAttributeAccessIssue=false

from collections.abc import Iterable, Iterator
from functools import cached_property
from typing import Any

import coal
import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from robotdiffuse.core.transforms import ball_around
from robotdiffuse.core.types import Configurations, Mask, Poses, Spheres, Values, Vector, for_kernels
from robotdiffuse.robots.coal_geometry import coal_convex, coal_pose
from robotdiffuse.robots.fitting.sphere_fitting_kernel import ball_distances, deepest_touches
from robotdiffuse.robots.kinematic_tree import MOVING_KINDS, TURN, Joint, with_mimics
from robotdiffuse.robots.motion_bounds import radii_of
from robotdiffuse.robots.robot import LinkPairTable, Robot

BINS = 24
"""Number of bins of a joint's range, to test whether the joint alone determines when two links collide."""
MAX_STOPPED_RANGE = 5.2
"""A joint with a range of at most this is taken to have mechanical stops at its limits [rad]; limits of wider
ranges may be arbitrary."""
MAX_UNEXPLAINED = 0.25
"""Largest fraction of the variance of "the links collide" (0 or 1) that the value of one joint may leave
unexplained. Below it, the joint is taken to decide whether they collide. If they do at one of its stops, the
stop is taken to be where they meet, and the pair is not checked (the reason `limits` in
`self_collisions`)."""
BALL_MARGIN = 1e-9
"""Margin of bounding and inscribed balls of meshes [m], larger than rounding errors."""
NEAR_DISTANCE = 0.1
"""For pairs of links that are farther apart than this in all samples, fewer searches for a collision are made
[m]."""


class Links:
    """Poses of all links for batches of values of all movable joints, and collision tests of pairs of
    links."""

    def __init__(self, robot: Robot) -> None:
        self.robot = robot
        self.joints = [j for j in robot.joints if j.kind in MOVING_KINDS and j.mimic is None]
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
        if joint not in self.joints or joint.upper - joint.lower > MAX_STOPPED_RANGE:
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

    def poses(self, q: Configurations, wanted: Iterable[str] = ()) -> dict[str, Poses]:
        """T_base_link [n, 4, 4] by link. With `wanted` links, only the poses of these links and of the links
        on the way to them."""
        chains = [self.robot.joints_above(link) for link in wanted or self.robot.link_names]
        joints = dict.fromkeys(joint for chain in chains for joint in chain)
        poses = {self.robot.base: np.tile(np.eye(4), (len(q), 1, 1))}
        values = with_mimics(self.robot.joints, {joint.name: q[:, i] for i, joint in enumerate(self.joints)})
        for joint in joints:
            T_parent_child = joint.T_parent_joint
            if joint.kind in MOVING_KINDS:
                T_parent_child = T_parent_child @ joint.motion(values[joint.name])
            poses[joint.child] = poses[joint.parent] @ T_parent_child
        return poses

    def sphere_distance(self, poses: dict[str, ndarray], a: str, b: str) -> Values:
        """Signed distances [n] between the covering spheres of two links [m]: lower bounds of the distances
        of the links' meshes. Where the bounding balls of the links' spheres are more than NEAR_DISTANCE
        apart, the distance of these two balls is given."""
        first, second = (for_kernels(self.robot.spheres[link]) for link in (a, b))
        return -deepest_touches(poses[a], poses[b], first, second, NEAR_DISTANCE, -np.inf)[0]

    def _placed(self, poses: dict[str, ndarray], a: str, b: str, i: int) -> tuple[Any, Any, ndarray]:
        """Coal poses of two links in configuration i, and the distances [a, b] between the balls around their
        parts [m]."""
        ball_gaps = ball_distances(poses[a][i], poses[b][i], self.balls[a], self.balls[b])
        return coal_pose(poses[a][i]), coal_pose(poses[b][i]), ball_gaps

    def collide(self, poses: dict[str, ndarray], a: str, b: str, i: int) -> bool:
        """Whether convex parts of two links collide in configuration i."""
        return any(True for _ in self.contacts(poses, a, b, i))

    def contacts(self, poses: dict[str, ndarray], a: str, b: str, i: int) -> Iterator[Vector]:
        """Points where convex parts of two links overlap in configuration i, one for each overlapping pair of
        parts [m], in the frame of `poses`."""
        T_a, T_b, ball_gaps = self._placed(poses, a, b, i)
        for m, n in zip(*np.nonzero(ball_gaps <= 0), strict=True):
            self.result.clear()
            if coal.collide(self.hulls[a][m], T_a, self.hulls[b][n], T_b, self.request, self.result):
                yield np.array(self.result.getContact(0).pos)

    def mesh_distance(self, poses: dict[str, ndarray], a: str, b: str, i: int = 0) -> float:
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
        poses: dict[str, ndarray],
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
            np.einsum("nij,nj->ni", poses[link][rows, :3, :3], ball[:, :3]) + poses[link][rows, :3, 3]
            for link, ball in zip((a, b), balls, strict=True)
        ]
        part_gaps = np.linalg.norm(middles[0] - middles[1], axis=1) - balls[0][:, 3] - balls[1][:, 3]
        for k in np.flatnonzero(part_gaps <= limit):
            T_a, T_b = (coal_pose(poses[link][rows[k]]) for link in (a, b))
            part_gaps[k] = _distance(self.hulls[a][parts[0, k]], T_a, self.hulls[b][parts[1, k]], T_b)
        return part_gaps


def _distance(a: "coal.Convex", T_a: Any, b: "coal.Convex", T_b: Any) -> float:
    """Signed distance of two convex parts at their poses [m]."""
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
    joints = robot.joints_between(*pair)
    far = max(pair, key=robot.link_frame)
    lever = radii_of(robot, [far])[0, list(joints)]
    slides = np.array(robot.prismatic)[list(joints)]
    lower = robot.lower[list(joints)]
    upper = robot.upper[list(joints)]
    upper = np.where(slides, upper, np.minimum(upper, lower + TURN))
    columns = [[j.name for j in links.joints].index(robot.joint_names[joint]) for joint in joints]
    nominal = links.named({})
    edge = (upper - lower) / CELLS
    # Boxes of joint values, in units of the table's cells. All boxes have the same `size`, which is halved
    # along one joint per iteration. Each row of `low` is the lower corner of a box, and the column of `parts`
    # with the same index is a pair of parts that may touch in the box.
    separated = np.ones((CELLS,) * len(joints), dtype=bool)
    size = np.full(len(joints), float(CELLS))
    parts = np.indices([len(robot.meshes[link]) for link in pair]).reshape(2, -1)
    low = np.zeros((parts.shape[1], len(joints)))
    while len(low):
        boxes, box_of_row = np.unique(low, axis=0, return_inverse=True)
        q = np.tile(nominal, (len(boxes), 1))
        q[:, columns] = lower + edge * (boxes + size / 2)
        travel = float(lever @ (edge * size) / 2) + ROUNDING
        poses = links.poses(q, pair)
        distance = links.part_distances(poses, *pair, box_of_row.ravel(), parts, travel)
        touch = distance <= travel
        # boxes that count as colliding: a single cell with a collision at its center, a box with a collision
        # deeper than its motion, and a box with very little motion
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
    names = tuple(robot.joint_names[joint] for joint in joints)
    return LinkPairTable(pair, names, tuple(lower.tolist()), tuple(upper.tolist()), separated)


def _cells(low: Float[ndarray, "n joints"], size: Float[ndarray, "joints"]) -> tuple[ndarray, ndarray]:
    """Along each joint, the index of the first cell that boxes overlap, and one past the last."""
    return np.floor(low).astype(int), np.ceil(low + size).astype(int)
