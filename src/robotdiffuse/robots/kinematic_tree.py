"""Joints and links of a robot, and what follows from them: limits, frames, their poses, chains of joints."""

from collections.abc import Callable, Mapping
from dataclasses import field
from functools import cached_property, wraps
from typing import Any, NamedTuple, TypeVar

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from robotdiffuse.core.errors import InputError, check_name, unknown_name
from robotdiffuse.core.loading import loading
from robotdiffuse.core.transforms import inverse, moved_spheres, rotation_about, rotation_z_to, transform
from robotdiffuse.core.types import (
    NO_SPHERES,
    Configuration,
    Configurations,
    JointValues,
    Pose,
    Poses,
    Spheres,
    Value,
    Vector,
    for_kernels,
    frozen_dataclass,
    read_only,
)

MOVING_KINDS = ("revolute", "continuous", "prismatic")
LIMITS = ("lower", "upper", "velocity", "acceleration", "jerk")
CONTINUOUS_LIMIT = 3 * np.pi
"""Continuous joints have no limits, but in planning their values stay within plus and minus this [rad]: a
start is within pi of 0, and a goal within 2 pi of the start."""
MIMIC_SLACK = 1e-6
"""Largest difference between a given value of a mimic joint and the value that follows from the joint that it
mimics [rad] or [m]."""
REACH_SAMPLES = 4096
"""Number of random configurations at which the reach is measured."""
REACH_QUANTILE = 0.99
"""The reach is this quantile of the tip's distances from the shoulder, since the very largest distances are
rare and vary with the sample."""


class Mimic(NamedTuple):
    """A mimic joint's rule: its value is multiplier * (value of `joint`) + offset."""

    joint: str
    multiplier: float = 1.0
    offset: float = 0.0


@frozen_dataclass
class Joint(Value):
    """A joint of the URDF tree. Fixed joints have no meaningful limits."""

    name: str
    kind: str
    """revolute, continuous, prismatic or fixed."""
    parent: str
    child: str
    T_parent_joint: Pose
    axis: Vector = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))
    """Unit axis in the joint frame."""
    lower: float = 0.0
    """Lower position limit [rad] or [m]; -`CONTINUOUS_LIMIT` for a continuous joint."""
    upper: float = 0.0
    velocity: float = 0.0
    """Velocity limit [rad/s] or [m/s]."""
    acceleration: float = 0.0
    jerk: float = 0.0
    mimic: Mimic | None = None
    """The rule by which this joint follows another joint, if any. If the other joint is locked, this joint is
    locked too."""
    effort: float = 0.0
    """Largest torque [N m] or force [N]; 0 if the URDF gives none."""

    @property
    def unit(self) -> str:
        """The unit of the joint's values."""
        return "m" if self.kind == "prismatic" else "rad"

    @property
    def movable(self) -> bool:
        """Whether the joint can move."""
        return self.kind in MOVING_KINDS

    def motion(self, q: Any) -> Float[ndarray, "*n 4 4"]:
        """T_joint_child at joint values q [*n] [rad] or [m]."""
        values = np.asarray(q)[..., None, None]
        T = np.zeros((*values.shape[:-2], 4, 4)) + np.eye(4)
        if self.kind == "prismatic":
            T[..., :3, 3] = self.axis * values[..., 0]
        elif self.kind != "fixed":
            T[..., :3, :3] = rotation_about(self.axis, values)
        return T


def with_mimics(joints: tuple[Joint, ...], locked: dict[str, Any]) -> dict[str, Any]:
    """The values of locked joints, including the joints that mimic them, by name [rad] or [m]."""
    mimics = {joint.name: joint.mimic for joint in joints if joint.mimic}

    def value(name: str) -> Any:
        mimic = mimics.get(name)
        followed = None if mimic is None else value(mimic.joint)
        return (
            locked.get(name)
            if mimic is None or followed is None
            else mimic.multiplier * followed + mimic.offset
        )

    values = {name: value(name) for name in (*locked, *mimics)}
    return {name: number for name, number in values.items() if number is not None}


MAX_WRAPPED_STEP = 0.5
"""If a step between two values of a continuous joint differs from a whole turn by less than this [rad], the
values count as wrapped to [-pi, pi]."""


T = TypeVar("T")
R = TypeVar("R", bound="KinematicTree")
JointArray = Float[ndarray, "*batch dof"]
"""Values of the joints of a configuration, or of several."""
JointMask = Bool[ndarray, "dof"]
TURN = 2 * np.pi


def chain(above: dict[str, Joint], link: str) -> list[Joint]:
    """The joints from the base to a link; `above` maps links to their parent joints."""
    joints = list[Joint]()
    while link in above:
        joints.append(above[link])
        link = above[link].parent
    return joints[::-1]


def _limit(name: str) -> "cached_property[JointValues]":
    return cached_property(
        lambda tree: read_only(np.array([getattr(joint, name) for joint in tree.planned_joints]))
    )


def _of_kind(kind: str) -> "cached_property[JointMask]":
    return cached_property(
        lambda tree: read_only(np.array([joint.kind == kind for joint in tree.planned_joints], dtype=bool))
    )


class KinematicTree(Value):
    """Base class of `Robot`: joints, limits and frames. `Robot` declares the fields and describes the
    frames."""

    base: str
    tip: str
    joints: tuple[Joint, ...]
    locked: dict[str, float]
    root: str
    above: dict[str, Pose]
    other_tips: tuple[str, ...]
    spheres: dict[str, Spheres]

    @cached_property
    def link_names(self) -> tuple[str, ...]:
        return (self.base, *(joint.child for joint in self.joints))

    @property
    def T_base_root(self) -> Pose | None:
        """Pose of the link `root` in the base frame; None if a movable joint lies between base and root."""
        return np.eye(4) if self.root in ("", self.base) else self.above.get(self.root)

    @cached_property
    def links_fixed_to_base(self) -> dict[str, Pose]:
        """T_base_link of the base and of all links that fixed joints alone connect to the base."""
        fixed_links = {self.base: np.eye(4)}
        for joint in self.joints:
            if joint.kind == "fixed" and joint.parent in fixed_links:
                fixed_links[joint.child] = fixed_links[joint.parent] @ joint.T_parent_joint
        return read_only(fixed_links)

    @property
    def tips(self) -> tuple[str, ...]:
        return (self.tip, *self.other_tips)

    @cached_property
    def _parent_joints(self) -> dict[str, Joint]:
        return {joint.child: joint for joint in self.joints}

    def joints_above(self, link: str) -> list[Joint]:
        """The joints from the base to a link."""
        return chain(self._parent_joints, link)

    @cached_property
    def planned_joints(self) -> tuple[Joint, ...]:
        """Movable, unlocked joints between the base and the tips, in depth-first order."""
        chains = [self.joints_above(link) for link in self.tips]
        first = dict[str, int]()
        for i, chain in enumerate(chains):
            for joint in chain:
                first.setdefault(joint.name, i)
        # chains that share their first joints follow each other
        chains.sort(key=lambda chain: [first[joint.name] for joint in chain])
        ordered = dict.fromkeys(joint for chain in chains for joint in chain)
        return tuple(j for j in ordered if j.movable and j.name not in self.locked)

    @cached_property
    def joint_names(self) -> tuple[str, ...]:
        return tuple(joint.name for joint in self.planned_joints)

    @property
    def dof(self) -> int:
        return len(self.planned_joints)

    lower = _limit("lower")
    upper = _limit("upper")
    velocity = _limit("velocity")
    acceleration = _limit("acceleration")
    jerk = _limit("jerk")
    effort = _limit("effort")
    """Largest torques [N m] or forces [N]; 0 where the URDF gives none."""

    @property
    def middle(self) -> Configuration:
        """The configuration in the middle of the joint limits."""
        return 0.5 * (self.lower + self.upper)

    def narrowed_limits(self, margin: float) -> tuple[JointValues, JointValues]:
        """Lower and upper limits narrowed by a margin [rad] or [m], at most to the middle of the range."""
        margins = np.minimum(margin, (self.upper - self.lower) / 2)
        return self.lower + margins, self.upper - margins

    def limit_excess(self, q: JointArray) -> JointArray:
        """How far joint values exceed the limits [rad] or [m]; negative within the limits, 0 for continuous
        joints."""
        excess = np.maximum(self.lower - q, q - self.upper)
        excess[..., self.continuous] = 0.0
        return excess

    prismatic = _of_kind("prismatic")
    """Which planned joints slide."""
    continuous = _of_kind("continuous")
    """Which planned joints rotate without limits, so that values one turn apart are equivalent."""

    def whole_turns(self, q: JointArray) -> JointArray:
        """The multiples of 2 pi to subtract so that continuous joints are within [-pi, pi]; 0 for other
        joints."""
        return np.where(self.continuous, TURN * np.round(q / TURN), 0.0)

    def wraps(self, q: Configurations) -> Configurations:
        """For each step of a continuous joint from row to row, the nearest multiple of 2 pi if the step
        differs from this multiple by less than MAX_WRAPPED_STEP, else 0 [rad]. Steps near a whole turn occur
        where values are wrapped to [-pi, pi]."""
        steps = np.diff(q, axis=0)
        turns = self.whole_turns(steps)
        return np.where(np.abs(steps - turns) < MAX_WRAPPED_STEP, turns, 0.0)

    def unwound(self, q: JointArray) -> JointArray:
        """Equivalent configurations: joints with a range above one turn are turned by whole turns to within
        half a turn of the middle of their limits."""
        return self._turned(q, self.middle, self._more_than_a_turn)

    def equivalent_configurations(self, q: Configuration, start: Configuration) -> Configurations:
        """`turned_both_ways` for the joints that have limits and a range above one turn."""
        return self.turned_both_ways(q, start, self._more_than_a_turn & ~self.continuous)

    def turned_both_ways(self, q: Configuration, start: Configuration, joints: JointMask) -> Configurations:
        """Configurations within the limits that differ from `q` by whole turns of the masked joints.

        In the first row, each such joint is as close to `start` as possible. In each further row, one such
        joint reaches `q` by turning in the other direction, since obstacles may block the short way. If
        several continuous joints of the first row are more than half a turn from 0, a last row has all of
        them within half a turn of 0, since elbows cannot turn past half a turn.
        """
        nearest = self._turned(q, start, joints)
        rows = [nearest]
        for j in np.flatnonzero(joints):
            other_way = nearest.copy()
            other_way[j] -= np.copysign(TURN, nearest[j] - start[j])
            if self.continuous[j] or self.lower[j] <= other_way[j] <= self.upper[j]:
                rows.append(other_way)
        turns = joints * self.whole_turns(nearest)
        if np.count_nonzero(turns) > 1:
            rows.append(nearest - turns)
        return np.stack(rows)

    def nearest_turns(self, q: Configurations, start: Configuration) -> Configurations:
        """Equivalent configurations as close to `start` as the limits allow: continuous joints and joints
        with a range above one turn are turned by whole turns."""
        return self._turned(q, start, self._more_than_a_turn | self.continuous)

    def _turned(self, q: ndarray, start: ndarray, joints: JointMask) -> ndarray:
        """The configurations with whole turns added to the masked joints, to be as close to `start` as the
        limits allow."""
        if not joints.any():
            return q
        limited = joints & ~self.continuous
        start = np.where(limited, np.clip(start, self.lower, self.upper), start)
        nearest = np.where(joints, q - TURN * np.round((q - start) / TURN), q)
        nearest = np.where(limited & (nearest > self.upper), nearest - TURN, nearest)
        return np.where(limited & (nearest < self.lower), nearest + TURN, nearest)

    @cached_property
    def _more_than_a_turn(self) -> JointMask:
        """Whether the range of a joint is more than one turn."""
        return read_only((self.upper - self.lower > TURN) & ~self.prismatic)

    @cached_property
    def _frames(self) -> tuple[dict[str, tuple[int, ndarray]], ndarray, ndarray]:
        """The frame index and T_frame_link of each link, `frame_offsets`, and `parents`."""
        links: dict[str, tuple[int, ndarray]] = {self.base: (0, np.eye(4))}
        offsets = np.zeros((self.dof, 4, 4))
        parents = np.zeros(self.dof, np.int64)
        for joint in self.joints:
            frame, T_frame_parent = links[joint.parent]
            if joint in self.planned_joints:
                j = self.planned_joints.index(joint)
                T_joint_frame = transform(np.zeros(3), rotation_z_to(joint.axis))
                offsets[j] = T_frame_parent @ joint.T_parent_joint @ T_joint_frame
                parents[j] = frame
                links[joint.child] = (j + 1, inverse(T_joint_frame))
            else:
                T_joint_child = joint.motion(self.locked.get(joint.name, 0.0))
                links[joint.child] = (frame, T_frame_parent @ joint.T_parent_joint @ T_joint_child)
        return read_only((links, offsets, parents))

    @cached_property
    def frame_offsets(self) -> Poses:
        """Pose of the frame of each planned joint in its parent frame, at joint value 0."""
        return self._frames[1]

    @cached_property
    def parents(self) -> Int[ndarray, "dof"]:
        """Index of the frame that each planned joint is mounted on: j for joint j of a serial arm."""
        return self._frames[2]

    @cached_property
    def kernel_parents(self) -> Int[ndarray, "dof"] | None:
        """`parents` for compiled code, as a writable array; None for a serial arm.

        Kernels are compiled for writable arrays, and skip the look-up for serial arms.
        """
        return None if (self.parents == np.arange(self.dof)).all() else self.parents.copy()

    @property
    def kernel_joints(self) -> tuple[ndarray, ndarray | None, ndarray]:
        """`frame_offsets`, `kernel_parents` and `prismatic` for compiled code, as writable arrays."""
        return for_kernels(self.frame_offsets), self.kernel_parents, np.array(self.prismatic, np.bool_)

    @cached_property
    def moved_by(self) -> Bool[ndarray, "frames dof"]:
        """Which planned joints move which frames."""
        rows = np.zeros((self.dof + 1, self.dof), bool)
        for j, parent in enumerate(self.parents):
            rows[j + 1] = rows[parent]
            rows[j + 1, j] = True
        return read_only(rows)

    def at_end(self, link: str) -> bool:
        """Whether a planned joint moves a link, and no planned joint comes after the link."""
        frame = self.link_frame(link)
        return frame > 0 and not self.moved_by[frame + 1 :, frame - 1].any()

    def chain(self, link: str) -> tuple[int, ...]:
        """Indices of the planned joints that move a link, from the base on."""
        return tuple(np.flatnonzero(self.moved_by[self.link_frame(link)]).tolist())

    def joints_between(self, a: str, b: str) -> tuple[int, ...]:
        """Indices of the planned joints between two links on one chain, from the base on.

        Empty if the links are not on one chain from the base, or if a movable joint between them is not
        planned.
        """
        near, far = sorted(
            ([joint.name for joint in self.joints_above(link) if joint.movable] for link in (a, b)),
            key=len,
        )
        between = far[len(near) :] if far[: len(near)] == near else ()
        return tuple(map(self.joint_names.index, between)) if {*between} <= {*self.joint_names} else ()

    def link_frame(self, link: str) -> int:
        """Index of the frame that the link is fixed to: 0 for the base, j + 1 after planned joint j."""
        return self._link(link)[0]

    def T_frame_link(self, link: str) -> Pose:
        """Constant pose of the link in its frame (see `link_frame`); InputError for an unknown link."""
        return self._link(link)[1]

    def frame_spheres(self, link: str) -> Spheres:
        """The collision spheres of a link in its frame (see `link_frame`), x y z radius [m]."""
        return moved_spheres(self.T_frame_link(link), self.spheres[link])

    def frames_at(self, q: Configurations) -> list[Poses]:
        """Poses T_base_frame [n, 4, 4] of all frames at configurations."""
        frames = [np.tile(np.eye(4), (len(q), 1, 1))]
        for j, parent in enumerate(self.parents):
            motion = np.tile(np.eye(4), (len(q), 1, 1))
            if self.prismatic[j]:
                motion[:, 2, 3] = q[:, j]
            else:
                motion[:, 0, 0] = motion[:, 1, 1] = np.cos(q[:, j])
                motion[:, 1, 0] = np.sin(q[:, j])
                motion[:, 0, 1] = -motion[:, 1, 0]
            frames.append(frames[parent] @ self.frame_offsets[j] @ motion)
        return frames

    def placed_spheres(self, q: Configuration) -> Spheres:
        """All collision spheres at one configuration, x y z radius in the base frame [m]."""
        frames = self.frames_at(q[None])
        parts = [NO_SPHERES]
        for link, spheres in self.spheres.items():
            parts.append(moved_spheres(frames[self.link_frame(link)][0] @ self.T_frame_link(link), spheres))
        return np.concatenate(parts)

    @cached_property
    def reach(self) -> float:
        """Distance between tip and shoulder that 99 % of the configurations do not exceed [m].

        The shoulder is the point on the first joint's axis that is nearest to the second joint, or to the
        first if it is the only one. With several arms, the largest reach of an arm is returned.
        """
        if not self.dof:
            return 0.0
        rng = np.random.default_rng(0)
        frames = self.frames_at(rng.uniform(self.lower, self.upper, (REACH_SAMPLES, self.dof)))
        reached = []
        chains = [*map(self.chain, self.tips)]
        for tip, chain in zip(self.tips, chains, strict=True):
            # the joints that only this arm has are all locked
            if any({*chain} < {*longer_chain} for longer_chain in chains):
                continue
            offsets = self.frame_offsets[list(chain[:2])]
            axis, origin = offsets[0, :3, 2:].T
            to_second = offsets[0, :3, :3] @ offsets[1, :3, 3] if len(chain) > 1 else 0 * axis
            shoulder = origin + axis * (axis @ to_second)
            origins = (frames[self.link_frame(tip)] @ self.T_frame_link(tip))[:, :3, 3]
            reached.append(np.linalg.norm(origins - shoulder, axis=1))
        return float(np.quantile(reached, REACH_QUANTILE, axis=1).max())

    def check_moved(self, field: str, link: str) -> None:
        """Raises InputError, with `field` in its message, unless a planned joint moves the link."""
        moved = [name for name in self.link_names if self.link_frame(name) > 0]
        if not isinstance(link, str) or link not in self.link_names:
            raise unknown_name(f"link in {field}:", link, moved)
        if link not in moved:
            raise InputError(f"{field}: no planned joint moves {link!r}; moved links: {', '.join(moved)}")

    def planned_values(self, where: str, values: Mapping[str, Any], advice: str = "") -> list[Any]:
        """The values of the planned joints in order. Raises InputError if some are missing; its message
        begins with `where` and ends with `advice`."""
        missing = [name for name in self.joint_names if name not in values]
        if missing:
            raise InputError(f"{where} has no {', '.join(missing)}{advice}")
        return [values[name] for name in self.joint_names]

    def _link(self, link: str) -> tuple[int, ndarray]:
        check_name("link", link, self._frames[0])
        return self._frames[0][link]


def once_per_robot(build: Callable[[R], T]) -> Callable[[R], T]:
    """Decorator that caches the result of a function of a robot on the robot object. The first call counts as
    loading (see `core.loading`), not as planning time."""
    name = f"{build.__module__}.{build.__qualname__}"

    @wraps(build)
    def cached(robot: R) -> T:
        if name not in robot.__dict__:
            # underflow is harmless, but `np.seterr` of the caller may let it raise
            with loading(), np.errstate(under="ignore"):
                robot.__dict__[name] = build(robot)
        return robot.__dict__[name]

    return cached


class JointNormalizer:
    """Maps lower limits to -1 and upper limits to 1, joint by joint; computed in float64."""

    def __init__(self, lower: Configuration, upper: Configuration) -> None:
        """`lower` and `upper` are joint limits [rad], [m] for prismatic joints. Raises InputError for an
        empty or infinite range."""
        for i, (low, high) in enumerate(zip(lower, upper, strict=True)):
            if not (np.isfinite(low) and np.isfinite(high) and low < high):
                raise InputError(
                    f"limits of joint {i} are {low} and {high}; they must be finite, lower below upper"
                )
        self.middle = (upper + lower) / 2
        self.half_range = (upper - lower) / 2

    def to_unit(self, q: JointArray) -> JointArray:
        """Joint values [rad] or [m] mapped to [-1, 1], of the same dtype."""
        return ((q - self.middle) / self.half_range).astype(q.dtype)

    def from_unit(self, x: JointArray) -> JointArray:
        """Joint values [rad] or [m] from values in [-1, 1], of the same dtype."""
        return (x * self.half_range + self.middle).astype(x.dtype)
