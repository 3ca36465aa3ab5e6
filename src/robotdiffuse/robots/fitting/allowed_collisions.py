"""Finds pairs of links that need no collision check against each other, by sampling configurations."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.core.errors import InputError
from robotdiffuse.robots.fitting.sampled_links import NEAR_DISTANCE, Links
from robotdiffuse.robots.joints import MOVING_KINDS, Joint
from robotdiffuse.robots.robot import Robot

ADJACENT = "adjacent"
ALWAYS = "always"
NEVER = "never"
CHECKED = "checked"
DEFAULT = "default"
POSE = "pose"
LIMITS = "limits"
# Reasons given by the user: the pair was named when the robot was added, or an SRDF allows it.
NAMED = "named"
BY_SRDF = "srdf"
ADJACENT_STRIDE = 10
"""One in this many samples is tested for adjacent links, which are allowed in any case."""
MIN_LIMITS_COLLIDING = 0.2
"""Smallest fraction of colliding configurations for the reason `limits`."""
MAX_HELD_JOINTS = 1
"""Largest number of held joints between an arm's link and another link that belongs to the arm, such as the
bellows of a lift. Links after more held joints belong to a head or another arm."""
MAX_POSE_OVERLAP = 0.03
"""If links overlap in a named pose by less than this, their meshes count as coarse there [m]."""


@dataclass(frozen=True)
class SamplingSettings:
    """Settings of `find_allowed_collisions`."""

    samples: int = 20_000
    """Number of configurations, uniform within the limits of all joints, including gripper joints."""
    always: float = 0.95
    """A pair that collides in at least this fraction of the samples counts as always colliding (0.95 in
    MoveIt's Setup Assistant)."""
    descents: int = 20
    """For a pair without collisions: number of closest samples from which a descent searches for one."""
    assumptions: bool = True
    """Whether links that are adjacent, or that collide at rest, in a named pose or up to a stop of a joint,
    are assumed safe; False for MuJoCo models, which say themselves what may touch."""

    def __post_init__(self) -> None:
        if self.samples < 100:
            raise InputError(f"samples is {self.samples}; it must be at least 100")
        if not 0.5 < self.always <= 1:
            raise InputError(f"always is {self.always}; it must be above 0.5 and at most 1")


@dataclass(frozen=True)
class PairReport:
    """How sampling classifies a pair of links."""

    links: tuple[str, str]
    reason: str
    """checked, or why the pair is allowed: adjacent, always, never, default, pose, limits, named or srdf."""
    colliding: float
    """Fraction of the configurations in which the meshes collide."""


def find_allowed_collisions(
    robot: Robot, settings: SamplingSettings, rng: np.random.Generator
) -> tuple[PairReport, ...]:
    """Classify each pair of links with meshes on different frames; the robot needs covering spheres.

    These pairs are allowed, the first four as in MoveIt's Setup Assistant:

    - adjacent: a joint connects the links; links without geometry between them are skipped. - always: the
    links collide in nearly all samples. - never: the links collide in no sample, and no descent finds a
    collision. - default: the links collide in the default pose, with the joints between them at zero. If the
    limits include that
      pose, the manufacturer considers it safe, so the meshes are too coarse there. Both links must belong to
      the arm, since the limits do not account for a tool on the last link or for another arm. A link after
      one held joint belongs to the arm too, if the pair also collides at that joint's held value: planning
      cannot move it away.
    - limits: the links collide in at least a fifth of the samples, up to a stop of one joint between them,
    which alone
      determines where. Joints have stops where the links on both sides meet.
    - pose: the links overlap slightly in a named pose of the SRDF, such as a tucked one.

    Coal tests the meshes unless the covering spheres show that they are apart. For pairs without collisions,
    random descents from the closest samples search for one; if they find one, the pair is checked.
    """
    links = Links(robot)
    default = np.clip(np.zeros((1, len(links.joints))), links.lower, links.upper)
    q = links.random(settings.samples, rng)
    poses = links.poses(q)
    default_poses = links.poses(default)
    held_poses = links.poses(links.named({})[None])
    named = [links.poses(links.named(pose)[None]) for pose in robot.poses.values()]
    adjacent = _adjacent(robot) if settings.assumptions else frozenset[frozenset[str]]()

    def reason(a: str, b: str, near: ndarray, colliding: ndarray) -> str:
        if frozenset((a, b)) in adjacent:
            return ADJACENT
        if colliding.mean() >= settings.always:
            return ALWAYS
        if not settings.assumptions:
            return by_search(a, b, near, colliding)
        by_default = _own_between(robot, a, b, MAX_HELD_JOINTS)
        zero = by_default is not None and all(joint.lower <= 0 <= joint.upper for joint in by_default)
        if zero and links.collide(default_poses, a, b, 0) and links.collide(held_poses, a, b, 0):
            return DEFAULT
        if any(-MAX_POSE_OVERLAP < links.mesh_distance(pose, a, b) <= 0 for pose in named):
            return POSE
        between = _own_between(robot, a, b) or ()
        if colliding.mean() >= MIN_LIMITS_COLLIDING and any(
            links.stop_explains(joint, q, colliding) for joint in between
        ):
            return LIMITS
        return by_search(a, b, near, colliding)

    def by_search(a: str, b: str, near: ndarray, colliding: ndarray) -> str:
        descents = settings.descents if near.min() < NEAR_DISTANCE else settings.descents // 5
        if not colliding.any() and not _descend(links, a, b, q[np.argsort(near)[:descents]], rng):
            return NEVER
        return CHECKED

    reports = []
    few = {link: T[: max(len(q) // ADJACENT_STRIDE, 1)] for link, T in poses.items()}
    for a, b in _moving_pairs(robot):
        near = links.sphere_distance(few if frozenset((a, b)) in adjacent else poses, a, b)
        colliding = np.zeros(len(near), dtype=bool)
        for i in np.flatnonzero(near <= 0):
            colliding[i] = links.collide(poses, a, b, int(i))
        reports.append(PairReport((a, b), reason(a, b, near, colliding), float(colliding.mean())))
    return tuple(reports)


def allowed_pairs(reports: tuple[PairReport, ...]) -> frozenset[frozenset[str]]:
    """The pairs of links that are not checked."""
    return frozenset(frozenset(report.links) for report in reports if report.reason != CHECKED)


def _descend(links: "Links", a: str, b: str, starts: Float[ndarray, "n d"], rng: np.random.Generator) -> bool:
    """Whether random descents on the distance between the meshes find a collision of two links."""

    wanted = frozenset((a, b))
    for start in starts:
        q = start
        step = 0.1 * (links.upper - links.lower)
        least = links.mesh_distance(links.poses(q[None], wanted), a, b)
        for _ in range(15):
            around = np.clip(q + step * rng.normal(size=(8, len(q))), links.lower, links.upper)
            at = links.poses(around, wanted)
            distances = [links.mesh_distance(at, a, b, i) for i in range(len(around))]
            i = int(np.argmin(distances))
            if distances[i] <= 0:
                return True
            if distances[i] < least:
                q = around[i]
                least = distances[i]
            else:
                step = step / 2
    return False


def _own_between(robot: Robot, a: str, b: str, max_held: int = 0) -> list[Joint] | None:
    """The movable joints between two links that belong to the arm; None if one of them does not.

    A link belongs to the arm if at most `max_held` held joints connect it to a moving link, and if it is not
    a tool.
    """
    by_child = {joint.child: joint for joint in robot.joints}

    def joints_above(link: str) -> list[Joint]:
        return [by_child[link], *joints_above(by_child[link].parent)] if link in by_child else []

    def own(link: str) -> bool:
        """Whether a link belongs to the arm; true for what its links carry, except for the last one."""
        planned = [joint for joint in above[link] if joint in robot.planned_joints][:1]
        carried = above[link][: above[link].index(planned[0])] if planned else above[link]
        held = [joint for joint in carried if joint.kind in MOVING_KINDS]
        tool = robot.at_end(link) and above[link][:1] != planned
        return not tool and len(held) <= max_held

    above = {link: joints_above(link) for link in (a, b)}
    if not own(a) or not own(b):
        return None
    either = {joint.name: joint for joint in (*above[a], *above[b])}.values()
    return [j for j in either if (j in above[a]) != (j in above[b]) and j.kind in MOVING_KINDS]


def _moving_pairs(robot: Robot) -> list[tuple[str, str]]:
    """Pairs of links with meshes that move relative to each other."""
    links = [link for link in robot.link_names if link in robot.meshes]
    return [
        (a, b)
        for i, a in enumerate(links)
        for b in links[i + 1 :]
        if robot.link_frame(a) != robot.link_frame(b)
    ]


def _adjacent(robot: Robot) -> set[frozenset[str]]:
    """Pairs of links that a joint connects; skips links without geometry."""
    solid: dict[str, str] = {robot.base: robot.base}
    pairs = set()
    for joint in robot.joints:
        above = solid[joint.parent]
        solid[joint.child] = joint.child if joint.child in robot.meshes else above
        pairs.add(frozenset((above, joint.child)))
    return pairs
