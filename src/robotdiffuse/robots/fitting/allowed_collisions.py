"""Pairs of links that need no check against each other, found by sampling configurations."""

# Coal's Python module has no type information.
# pyright: reportAttributeAccessIssue=false

from dataclasses import dataclass
from functools import cached_property, lru_cache

import coal
import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from scipy.optimize import linprog

from robotdiffuse.core.bounds import for_kernels
from robotdiffuse.core.errors import InputError
from robotdiffuse.robots.bodies import ConvexMesh
from robotdiffuse.robots.coal_geometry import coal_convex, coal_pose
from robotdiffuse.robots.fitting.convex_parts import planes_of
from robotdiffuse.robots.fitting.sphere_fitting_kernel import ball_distances, deepest_touches
from robotdiffuse.robots.joints import MOVING_KINDS, Joint
from robotdiffuse.robots.robot import Robot

ADJACENT, ALWAYS, NEVER, CHECKED = "adjacent", "always", "never", "checked"
DEFAULT, POSE, LIMITS = "default", "pose", "limits"
NAMED, BY_SRDF = "named", "srdf"
"""Reasons from outside: the pair was named by who adds the robot, or an SRDF allows it."""
BINS = 24
"""Of a joint's range, to see whether it alone says where two links collide."""
STOPPED = 5.2
"""A joint whose range is narrower has a stop [rad]; that of wider ones may be chosen."""
FEWER = 10
"""Of so many samples one is looked at for adjacent links, which are allowed whatever it says."""
OFTEN, UNCERTAIN = 0.2, 0.25
"""Share of the configurations in which links collide that a joint's stops keep apart, at least, and of the
variance of colliding that the other joints may explain, at most."""
MOST_HELD = 1
"""Held joints through which a link of the arm carries another one of its own, as a lift its bellows: behind
more of them is a head, or another arm."""
COARSE = 0.03
"""Meshes of links that overlap in a named pose by no more are taken for coarse there [m]."""
ROUNDING = 1e-9
"""What balls around meshes are larger by, and those within smaller [m]: more than rounding takes away."""
NEAR = 0.1
"""Links whose balls never come so near [m] are driven towards each other from few samples."""


@dataclass(frozen=True)
class SamplingSettings:
    """How the pairs are found."""

    samples: int = 20_000
    """Configurations, uniform within the limits of all joints, gripper joints included."""
    always: float = 0.95
    """Share of collisions from which on a pair counts as always colliding (0.95 in MoveIt's assistant)."""
    descents: int = 20
    """Closest samples from which a pair that never collided is driven towards collision, to be sure."""

    def __post_init__(self) -> None:
        if self.samples < 100:
            raise InputError(f"samples is {self.samples}; fewer than 100 find no pairs")
        if not 0.5 < self.always <= 1:
            raise InputError(f"always is {self.always}; it must be above 0.5 and at most 1")


@dataclass(frozen=True)
class PairReport:
    """What sampling says about two links."""

    links: tuple[str, str]
    reason: str
    """adjacent, always, never, default, pose, limits, named or srdf (allowed), or checked."""
    colliding: float
    """Share of the configurations in which the meshes collide."""


def find_allowed_collisions(
    robot: Robot, settings: SamplingSettings, rng: np.random.Generator
) -> tuple[PairReport, ...]:
    """One report for each pair of links with meshes on different frames; the robot needs covering spheres.

    Allowed are, as in MoveIt's setup assistant: adjacent links (joined by a joint, links without geometry
    between them skipped); pairs that always or never collide; and pairs that collide in the default pose,
    with the joints between them at zero. For such a pair the limits of the joints say that the manufacturer
    holds that pose to be safe, so the meshes are coarse there. Hence it must be within the limits, and both
    links must be the arm's own: the limits know nothing of a tool that is fixed to the last link, or of
    another arm. A link behind one held joint is the arm's own too, if the pair also collides with that joint
    where it is held: planning cannot move it away. Because of the limits a pair is allowed as well that
    collides in a fifth of the configurations or more, up to a stop of one joint between them, which alone
    says where: stops are where the links on both sides of a joint meet. And so is one that overlaps a little
    in a pose that an SRDF names, as the tucked one.

    Meshes are tested with Coal, where the covering spheres do not already show that they are apart. Pairs
    that never collided are driven together by random descent from their closest samples; those that can be
    made to collide are checked.
    """
    links = Links(robot)
    default = np.clip(np.zeros((1, len(links.joints))), links.lower, links.upper)
    q = links.random(settings.samples, rng)
    poses = links.poses(q)
    default_poses, held_poses = links.poses(default), links.poses(links.named({})[None])
    named = [links.poses(links.named(pose)[None]) for pose in robot.poses.values()]
    adjacent = _adjacent(robot)

    def reason(a: str, b: str, near: ndarray, colliding: ndarray) -> str:
        if frozenset((a, b)) in adjacent:
            return ADJACENT
        if colliding.mean() >= settings.always:
            return ALWAYS
        by_default = _own_between(robot, a, b, MOST_HELD)
        zero = by_default is not None and all(joint.lower <= 0 <= joint.upper for joint in by_default)
        if zero and links.collide(default_poses, a, b, 0) and links.collide(held_poses, a, b, 0):
            return DEFAULT
        if any(-COARSE < links.mesh_distance(pose, a, b) <= 0 for pose in named):
            return POSE
        between = _own_between(robot, a, b) or ()
        if colliding.mean() >= OFTEN and any(links.stops(joint, q, colliding) for joint in between):
            return LIMITS
        descents = settings.descents if near.min() < NEAR else settings.descents // 5
        if not colliding.any() and not _descend(links, a, b, q[np.argsort(near)[:descents]], rng):
            return NEVER
        return CHECKED

    reports = []
    few = {link: T[: max(len(q) // FEWER, 1)] for link, T in poses.items()}
    for a, b in _moving_pairs(robot):
        near = links.sphere_distance(few if frozenset((a, b)) in adjacent else poses, a, b)
        colliding = np.zeros(len(near), dtype=bool)
        for i in np.flatnonzero(near <= 0):
            colliding[i] = links.collide(poses, a, b, int(i))
        reports.append(PairReport((a, b), reason(a, b, near, colliding), float(colliding.mean())))
    return tuple(reports)


def allowed_pairs(reports: tuple[PairReport, ...]) -> frozenset[frozenset[str]]:
    """The pairs that need no check."""
    return frozenset(frozenset(report.links) for report in reports if report.reason != CHECKED)


def _descend(links: "Links", a: str, b: str, starts: Float[ndarray, "n d"], rng: np.random.Generator) -> bool:
    """Whether random descent on the distance between the meshes finds a collision of the links."""

    wanted = frozenset((a, b))
    for start in starts:
        q, step = start, 0.1 * (links.upper - links.lower)
        least = links.mesh_distance(links.poses(q[None], wanted), a, b)
        for _ in range(15):
            around = np.clip(q + step * rng.normal(size=(8, len(q))), links.lower, links.upper)
            at = links.poses(around, wanted)
            distances = [links.mesh_distance(at, a, b, i) for i in range(len(around))]
            i = int(np.argmin(distances))
            if distances[i] <= 0:
                return True
            if distances[i] < least:
                q, least = around[i], distances[i]
            else:
                step = step / 2
    return False


def _own_between(robot: Robot, a: str, b: str, most_held: int = 0) -> list[Joint] | None:
    """The movable joints between two links of the arm itself; None if one of them is not the arm's. Through
    so many held joints at most, `most_held`, a link of the arm may carry another one of its own."""
    by_child = {joint.child: joint for joint in robot.joints}

    def joints_above(link: str) -> list[Joint]:
        return [by_child[link], *joints_above(by_child[link].parent)] if link in by_child else []

    def own(link: str) -> bool:
        """What its links carry is the arm's own too, as the bellows of a lift; but for the last one's."""
        planned = [joint for joint in above[link] if joint in robot.planned_joints][:1]
        carried = above[link][: above[link].index(planned[0])] if planned else above[link]
        held = [joint for joint in carried if joint.kind in MOVING_KINDS]
        tool = robot.at_end(link) and above[link][:1] != planned
        return not tool and len(held) <= most_held

    above = {link: joints_above(link) for link in (a, b)}
    if not own(a) or not own(b):
        return None
    either = {joint.name: joint for joint in (*above[a], *above[b])}.values()
    return [j for j in either if (j in above[a]) != (j in above[b]) and j.kind in MOVING_KINDS]


def _moving_pairs(robot: Robot) -> list[tuple[str, str]]:
    links = [link for link in robot.link_names if link in robot.meshes]
    return [
        (a, b)
        for i, a in enumerate(links)
        for b in links[i + 1 :]
        if robot.link_frame(a) != robot.link_frame(b)
    ]


def _adjacent(robot: Robot) -> set[frozenset[str]]:
    """Links joined by a joint; links without geometry are passed through."""
    solid: dict[str, str] = {robot.base: robot.base}
    pairs = set()
    for joint in robot.joints:
        above = solid[joint.parent]
        solid[joint.child] = joint.child if joint.child in robot.meshes else above
        pairs.add(frozenset((above, joint.child)))
    return pairs


class Links:
    """Poses of all links for many values of all movable joints, and tests of pairs of links."""

    def __init__(self, robot: Robot) -> None:
        self.robot = robot
        self.joints = [j for j in robot.joints if j.kind in MOVING_KINDS and j.mimic is None]
        self.lower = np.array([joint.lower for joint in self.joints])
        self.upper = np.array([joint.upper for joint in self.joints])
        self._hit: dict[tuple[str, str], tuple[int, int]] = {}
        self.distance_request, self.distance_result = coal.DistanceRequest(), coal.DistanceResult()
        self._leading: dict[frozenset[str], tuple[str, list[Joint]]] = {}
        self.request, self.result = coal.CollisionRequest(), coal.CollisionResult()

    @cached_property
    def hulls(self) -> dict[str, list["coal.Convex"]]:
        meshes = self.robot.meshes.items()
        return {link: [coal_convex(mesh.vertices, mesh.faces) for mesh in parts] for link, parts in meshes}

    @cached_property
    def balls(self) -> dict[str, Float[ndarray, "parts 4"]]:
        """Around each part."""
        return {link: np.stack([_ball(mesh) for mesh in parts]) for link, parts in self.robot.meshes.items()}

    @cached_property
    def inner(self) -> dict[str, Float[ndarray, "parts 4"]]:
        """Within each part."""
        return {link: np.stack([_inner(mesh) for mesh in parts]) for link, parts in self.robot.meshes.items()}

    def random(self, count: int, rng: np.random.Generator) -> Float[ndarray, "n d"]:
        return rng.uniform(self.lower, self.upper, (count, len(self.joints)))

    def named(self, pose: dict[str, float]) -> Float[ndarray, "d"]:
        """The values of all joints in a pose of some of them; the others' as they are held, else zero."""
        rest = self.robot.locked | pose
        return np.array([rest.get(j.name, min(max(0.0, j.lower), j.upper)) for j in self.joints])

    def stops(self, joint: Joint, q: Float[ndarray, "n d"], colliding: Bool[ndarray, "n"]) -> bool:
        """Whether a joint alone says in which configurations two links collide, up to one of its stops."""
        if joint not in self.joints or joint.upper - joint.lower > STOPPED:
            return False
        share = (q[:, self.joints.index(joint)] - joint.lower) / (joint.upper - joint.lower)
        place = np.minimum((share * BINS).astype(int), BINS - 1)
        count = np.maximum(np.bincount(place, minlength=BINS), 1)
        often = np.bincount(place, colliding, minlength=BINS) / count
        left = (often * (1 - often) * count).sum() / len(q)
        whole = colliding.mean() * (1 - colliding.mean())
        return bool(max(often[0], often[-1]) > 0.99 and left < UNCERTAIN * whole)

    def poses(
        self, q: Float[ndarray, "n d"], wanted: frozenset[str] | None = None
    ) -> dict[str, Float[ndarray, "n 4 4"]]:
        """T_base_link by link; of `wanted` links, if given, how they stand to each other: seen from any one
        link."""
        start, joints = (self.robot.base, self.robot.joints) if wanted is None else self._between(wanted)
        poses = {start: np.broadcast_to(np.eye(4), (len(q), 4, 4))}
        for joint in joints:
            poses[joint.child] = poses[joint.parent] @ self._motion(joint, q)
        return poses

    def _motion(self, joint: Joint, q: Float[ndarray, "n d"]) -> Float[ndarray, "*n 4 4"]:
        """T_parent_child for many values of all joints."""
        if joint.kind not in MOVING_KINDS:
            return joint.T_parent_joint
        column, multiplier, offset, still, of_cosine, of_sine = self._moves[joint.name]
        value = multiplier * q[:, column, None, None] + offset
        if joint.kind == "prismatic":
            return still + value * of_sine
        return still + np.cos(value) * of_cosine + np.sin(value) * of_sine

    @cached_property
    def _moves(self) -> dict[str, tuple[int, float, float, ndarray, ndarray, ndarray]]:
        """By movable joint: the column of its value or of the one that it follows, what that is multiplied by
        and what is added; and T_parent_child at no value, and what its cosine and its sine, or a slide's
        length, are multiplied by in it."""
        by_name = {joint.name: joint for joint in self.robot.joints}
        columns = {joint.name: i for i, joint in enumerate(self.joints)}
        moves = {}
        for joint in self.robot.joints:
            if joint.kind not in MOVING_KINDS:
                continue
            leader, multiplier, offset = joint, 1.0, 0.0
            while leader.mimic is not None:
                offset += multiplier * leader.mimic.offset
                multiplier *= leader.mimic.multiplier
                leader = by_name[leader.mimic.joint]
            still, of_cosine, of_sine = np.eye(4), np.zeros((4, 4)), np.zeros((4, 4))
            if joint.kind == "prismatic":
                of_sine[:3, 3] = joint.axis
            else:
                still[:3, :3] = np.outer(joint.axis, joint.axis)
                of_cosine[:3, :3] = np.eye(3) - still[:3, :3]
                of_sine[:3, :3] = np.cross(np.eye(3), joint.axis)
            matrices = (joint.T_parent_joint @ matrix for matrix in (still, of_cosine, of_sine))
            moves[joint.name] = (columns[leader.name], multiplier, offset, *matrices)
        return moves

    def _between(self, links: frozenset[str]) -> tuple[str, list[Joint]]:
        """The last link that leads to all of some links, and the joints from there to them."""
        if links not in self._leading:
            by_child = {joint.child: joint for joint in self.robot.joints}
            chains = []
            for link in links:
                chain = [link]
                while chain[-1] in by_child:
                    chain.append(by_child[chain[-1]].parent)
                chains.append(chain[::-1])
            common = [link for link, *others in zip(*chains, strict=False) if {*others} <= {link}]
            needed = {link for chain in chains for link in chain[len(common) :]}
            joints = [joint for joint in self.robot.joints if joint.child in needed]
            self._leading[links] = common[-1], joints
        return self._leading[links]

    def sphere_distance(self, poses: dict[str, ndarray], a: str, b: str) -> Float[ndarray, "n"]:
        """Signed distance between the covering spheres of two links [m]: at most that of their meshes."""
        first, second = (for_kernels(self.robot.spheres[link]) for link in (a, b))
        return -deepest_touches(poses[a], poses[b], first, second, NEAR, -np.inf)[0]

    def collide(self, poses: dict[str, ndarray], a: str, b: str, i: int) -> bool:
        """Whether the meshes of two links collide in configuration i."""
        inside = ball_distances(poses[a][i], poses[b][i], self.inner[a], self.inner[b])
        if (inside < 0).any():
            return True
        T_a, T_b = coal_pose(poses[a][i]), coal_pose(poses[b][i])
        apart = ball_distances(poses[a][i], poses[b][i], self.balls[a], self.balls[b])
        near = list(zip(*np.nonzero(apart <= 0), strict=True))
        hit = self._hit.get((a, b))
        for m, n in [hit, *near] if hit in near else near:
            self.result.clear()
            if coal.collide(self.hulls[a][m], T_a, self.hulls[b][n], T_b, self.request, self.result):
                self._hit[a, b] = m, n
                return True
        return False

    def contacts(self, poses: dict[str, ndarray], a: str, b: str, i: int) -> Float[ndarray, "n 3"]:
        """Where convex parts of two links overlap in configuration i, a place for each two parts."""
        T_a, T_b = coal_pose(poses[a][i]), coal_pose(poses[b][i])
        apart = ball_distances(poses[a][i], poses[b][i], self.balls[a], self.balls[b])
        found = []
        for m, n in zip(*np.nonzero(apart <= 0), strict=True):
            result = coal.CollisionResult()
            request = coal.CollisionRequest(coal.CONTACT, 1)
            if coal.collide(self.hulls[a][m], T_a, self.hulls[b][n], T_b, request, result):
                found.append(result.getContact(0).pos)
        return np.reshape(found, (-1, 3))

    def mesh_distance(self, poses: dict[str, ndarray], a: str, b: str, i: int = 0) -> float:
        """Distance between the meshes of two links in configuration i [m]; zero or less if they collide."""
        T_a, T_b = coal_pose(poses[a][i]), coal_pose(poses[b][i])
        least = np.inf
        apart = ball_distances(poses[a][i], poses[b][i], self.balls[a], self.balls[b])
        for k in apart.argsort(axis=None):
            m, n = divmod(int(k), apart.shape[1])
            if apart[m, n] >= least:
                break
            self.distance_result.clear()
            distance = coal.distance(
                self.hulls[a][m], T_a, self.hulls[b][n], T_b, self.distance_request, self.distance_result
            )
            least = min(least, distance)
        return float(least)

    def part_distances(
        self,
        poses: dict[str, ndarray],
        a: str,
        b: str,
        rows: Int[ndarray, "n"],
        parts: Int[ndarray, "2 n"],
        limit: float,
    ) -> Float[ndarray, "n"]:
        """Distances between a part of one link and one of another, each in one of the configurations [m]; at
        least `limit` where it is more."""
        balls = [self.balls[link][parts[k]] for k, link in enumerate((a, b))]
        middles = [
            np.einsum("nij,nj->ni", poses[link][rows, :3, :3], ball[:, :3]) + poses[link][rows, :3, 3]
            for link, ball in zip((a, b), balls, strict=True)
        ]
        found = np.linalg.norm(middles[0] - middles[1], axis=1) - balls[0][:, 3] - balls[1][:, 3]
        near = np.flatnonzero(found <= limit)
        places = {int(row): (coal_pose(poses[a][row]), coal_pose(poses[b][row])) for row in set(rows[near])}
        for k in near:
            T_a, T_b = places[int(rows[k])]
            self.distance_result.clear()
            found[k] = coal.distance(
                self.hulls[a][parts[0, k]],
                T_a,
                self.hulls[b][parts[1, k]],
                T_b,
                self.distance_request,
                self.distance_result,
            )
        return found


def _ball(mesh: ConvexMesh) -> Float[ndarray, "4"]:
    """Centre and radius of a ball that holds a mesh."""
    center = (mesh.vertices.min(0) + mesh.vertices.max(0)) / 2
    return np.append(center, np.linalg.norm(mesh.vertices - center, axis=1).max() + ROUNDING)


@lru_cache(maxsize=1024)
def _inner(mesh: ConvexMesh) -> Float[ndarray, "4"]:
    """Centre and radius of a largest ball within a convex mesh."""
    normals, offsets = planes_of(mesh)
    planes = np.column_stack([normals, np.ones(len(normals))])
    found = linprog([0, 0, 0, -1], planes, offsets, bounds=[(None, None)] * 3 + [(0, None)])
    return np.append(found.x[:3], found.x[3] - ROUNDING) if found.success else np.array([0, 0, 0, -np.inf])
