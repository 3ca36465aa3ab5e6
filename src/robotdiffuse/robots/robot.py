"""Robot: an arm, or several on one body, as plain data, in the form that kinematics and collision checking
share."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property, lru_cache, wraps
from numbers import Real
from typing import Any, NamedTuple, TypeVar

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from robotdiffuse.core.bounds import MAX_COORDINATE, Value, read_only
from robotdiffuse.core.errors import InputError, shown, unknown_name
from robotdiffuse.core.transforms import inverse, rotation_about, rotation_z_to, transform
from robotdiffuse.robots.bodies import TOOL, Attached, ConvexMesh, Rigid
from robotdiffuse.robots.inertias import Inertia
from robotdiffuse.robots.joint_tables import TURN, JointTable

MOVING_KINDS = ("revolute", "continuous", "prismatic")
TURNS = 3 * np.pi
"""Planners turn continuous joints this far either way [rad]: they begin within half a turn, and end at most a
turn from there. The joints themselves have no limits."""
MIMIC_SLACK = 1e-6
"""How far a value given for a joint that follows another one may be from where that one puts it."""
VARIANTS = 256
"""Robots with joints locked at values that are kept, the last ones used: about 0.1 MB each."""

T = TypeVar("T")


class Mimic(NamedTuple):
    """How a joint follows another one: its value is multiplier * the other's + offset."""

    joint: str
    multiplier: float = 1.0
    offset: float = 0.0


@dataclass(frozen=True, eq=False)
class Joint(Value):
    """One joint of the URDF tree. Limits are meaningless for a fixed joint."""

    name: str
    kind: str
    """revolute, continuous, prismatic or fixed."""
    parent: str
    child: str
    T_parent_joint: Float[ndarray, "4 4"]
    axis: Float[ndarray, "3"]
    """Unit axis in the joint frame."""
    lower: float = 0.0
    """[rad] or [m]; for a continuous joint what planners work within, minus `TURNS`."""
    upper: float = 0.0
    velocity: float = 0.0
    """[rad/s] or [m/s]"""
    acceleration: float = 0.0
    jerk: float = 0.0
    mimic: Mimic | None = None
    """The joint that this one follows, held as that one is."""
    effort: float = 0.0
    """Greatest torque [N m] or force [N]; 0: none is given."""

    def motion(self, q: float) -> Float[ndarray, "4 4"]:
        """T_joint_child for the joint value q."""
        if self.kind == "prismatic":
            return transform(self.axis * q)
        if self.kind == "fixed":
            return np.eye(4)
        return transform(np.zeros(3), rotation_about(self.axis, q))


@dataclass(frozen=True, eq=False, repr=False)
class Robot(Value):
    """A serial arm: the joints between base and tip that are not locked are planned. Or a tree of them: those
    between the base and any of several tips, as of two arms on one torso.

    Frames: frame 0 is the base link; frame j + 1 moves with planned joint j, and
    T_base_frame[j + 1] = T_base_frame[parents[j]] @ frame_offsets[j] @ M(q_j), where M turns about z, or
    slides along z for a prismatic joint. Of a chain, parents[j] is j. Every link is rigidly fixed to one
    frame.
    """

    name: str
    base: str
    tip: str
    """What goals and pictures are about where they name no link; the first of `tips`."""
    joints: tuple[Joint, ...]
    """All joints of the tree below the base, parents before children."""
    spheres: dict[str, Float[ndarray, "n 4"]] = field(default_factory=dict)
    """Collision spheres by link, x y z radius in the link frame [m]; they cover `meshes`."""
    meshes: dict[str, tuple[ConvexMesh, ...]] = field(default_factory=dict)
    """Convex collision meshes by link: the exact geometry of the validator."""
    allowed_collisions: frozenset[frozenset[str]] = frozenset()
    """Pairs of links that are not checked against each other."""
    locked: dict[str, float] = field(default_factory=dict)
    """Values of the movable joints that planning holds [rad] or [m]."""
    notes: tuple[str, ...] = ()
    """What the reader of the URDF changed or ignored."""
    root: str = ""
    """Root link of the URDF; the base if it is empty."""
    above: dict[str, Float[ndarray, "4 4"]] = field(default_factory=dict)
    """T_base_link of the links above the base that fixed joints connect with it, the root among them unless a
    joint moves the base about."""
    poses: dict[str, dict[str, float]] = field(default_factory=dict)
    """Named poses of an SRDF, values by joint [rad] or [m]."""
    source: str | None = None
    """The file or the name that `load_robot` got, unless bundled: how problem files name the robot."""
    attached: tuple[Attached, ...] = ()
    """A tool and objects that are held; each is a link too."""
    bare: "Robot | None" = None
    """The robot without these; None if there are none. See `arm`."""
    inertias: dict[str, Inertia] = field(default_factory=dict)
    """Of the links whose URDF gives them."""
    other_tips: tuple[str, ...] = ()
    """Where further arms end whose joints are planned too."""
    tables: tuple[JointTable, ...] = ()
    """Where pairs of links are apart that come closer to each other than spheres tell."""

    @cached_property
    def link_names(self) -> tuple[str, ...]:
        return (self.base, *(joint.child for joint in self.joints))

    @property
    def T_base_root(self) -> Float[ndarray, "4 4"] | None:
        """Where the URDF's root is seen from the base; None if a movable joint lies between them."""
        return np.eye(4) if self.root in ("", self.base) else self.above.get(self.root)

    @cached_property
    def fixed_below(self) -> dict[str, Float[ndarray, "4 4"]]:
        """T_base_link of the base and of the links that fixed joints alone connect with it."""
        found = {self.base: np.eye(4)}
        for joint in self.joints:
            if joint.kind == "fixed" and joint.parent in found:
                found[joint.child] = found[joint.parent] @ joint.T_parent_joint
        return read_only(found)

    @property
    def tips(self) -> tuple[str, ...]:
        return (self.tip, *self.other_tips)

    @cached_property
    def planned_joints(self) -> tuple[Joint, ...]:
        """Movable, unlocked joints between the base and the tips: depth first, parents before children."""
        by_child = {joint.child: joint for joint in self.joints}
        chains: list[list[Joint]] = []
        for link in self.tips:
            chain: list[Joint] = []
            while link != self.base:
                chain.append(by_child[link])
                link = by_child[link].parent
            chains.append(chain[::-1])
        first: dict[str, int] = {}
        for i, chain in enumerate(chains):
            for joint in chain:
                first.setdefault(joint.name, i)
        chains.sort(key=lambda chain: [first[joint.name] for joint in chain])
        ordered = {joint.name: joint for chain in chains for joint in chain}.values()
        return tuple(j for j in ordered if j.kind in MOVING_KINDS and j.name not in self.locked)

    @cached_property
    def joint_names(self) -> tuple[str, ...]:
        return tuple(joint.name for joint in self.planned_joints)

    @property
    def dof(self) -> int:
        return len(self.planned_joints)

    def _limit(self, what: str) -> Float[ndarray, "dof"]:
        return read_only(np.array([getattr(joint, what) for joint in self.planned_joints]))

    @cached_property
    def lower(self) -> Float[ndarray, "dof"]:
        return self._limit("lower")

    @cached_property
    def upper(self) -> Float[ndarray, "dof"]:
        return self._limit("upper")

    @cached_property
    def velocity(self) -> Float[ndarray, "dof"]:
        return self._limit("velocity")

    @cached_property
    def acceleration(self) -> Float[ndarray, "dof"]:
        return self._limit("acceleration")

    @cached_property
    def jerk(self) -> Float[ndarray, "dof"]:
        return self._limit("jerk")

    @cached_property
    def effort(self) -> Float[ndarray, "dof"]:
        """Greatest torques [N m] or forces [N]; 0 where none is given."""
        return self._limit("effort")

    @cached_property
    def prismatic(self) -> tuple[bool, ...]:
        return tuple(joint.kind == "prismatic" for joint in self.planned_joints)

    @cached_property
    def continuous(self) -> Bool[ndarray, "dof"]:
        """Which joints turn without limits, so that values a turn apart are the same."""
        return read_only(np.array([joint.kind == "continuous" for joint in self.planned_joints], dtype=bool))

    def turns(self, q: Float[ndarray, "*n dof"]) -> Float[ndarray, "*n dof"]:
        """The whole turns of continuous joints in configurations [rad]: less these, they are within half a
        turn."""
        if not self._turning:
            return np.zeros_like(q)
        return np.where(self.continuous, TURN * np.round(q / TURN), 0.0)

    @cached_property
    def _turning(self) -> bool:
        return bool(self.continuous.any())

    def least_turns(self, q: Float[ndarray, "*n dof"]) -> Float[ndarray, "*n dof"]:
        """Configurations with the joints that can turn more than once within half a turn of the middle of
        their limits: they stand as before, but do not differ by turns that something may block."""
        middle = 0.5 * (self.lower + self.upper)
        return np.where(self._turns_twice, q - TURN * np.round((q - middle) / TURN), q)

    def same_stance(self, q: Float[ndarray, "dof"], start: Float[ndarray, "dof"]) -> Float[ndarray, "k dof"]:
        """Configurations within the limits that stand as one does but for whole turns of joints that have
        limits and can turn more than once: first with all of these as near to `start` as can be, then with
        one after the other turned the other way, for something may block the short way."""
        many = self._turns_twice & ~self.continuous
        nearest = np.where(many, q - TURN * np.round((q - start) / TURN), q)
        nearest = np.where(many & (nearest > self.upper), nearest - TURN, nearest)
        nearest = np.where(many & (nearest < self.lower), nearest + TURN, nearest)
        rows = [nearest]
        for j in np.flatnonzero(many):
            other = nearest.copy()
            other[j] -= np.copysign(TURN, nearest[j] - start[j])
            if self.lower[j] <= other[j] <= self.upper[j]:
                rows.append(other)
        return np.stack(rows)

    @cached_property
    def _turns_twice(self) -> Bool[ndarray, "dof"]:
        return read_only((self.upper - self.lower > TURN) & ~np.array(self.prismatic, dtype=bool))

    @cached_property
    def _frames(self) -> tuple[dict[str, tuple[int, ndarray]], ndarray, ndarray]:
        links: dict[str, tuple[int, ndarray]] = {self.base: (0, np.eye(4))}
        offsets, parents = np.zeros((self.dof, 4, 4)), np.zeros(self.dof, np.int64)
        planned = {joint.name: j for j, joint in enumerate(self.planned_joints)}
        for joint in self.joints:
            frame, T_frame_parent = links[joint.parent]
            if joint.name in planned:
                j = planned[joint.name]
                T_joint_frame = transform(np.zeros(3), rotation_z_to(joint.axis))
                offsets[j] = T_frame_parent @ joint.T_parent_joint @ T_joint_frame
                parents[j] = frame
                links[joint.child] = (j + 1, inverse(T_joint_frame))
            else:
                T_joint_child = joint.motion(self.locked.get(joint.name, 0.0))
                links[joint.child] = (frame, T_frame_parent @ joint.T_parent_joint @ T_joint_child)
        return read_only((links, offsets, parents))

    @cached_property
    def frame_offsets(self) -> Float[ndarray, "dof 4 4"]:
        return self._frames[1]

    @cached_property
    def parents(self) -> Int[ndarray, "dof"]:
        """The frame that each planned joint hangs from: that of the joint before it, in a chain."""
        return self._frames[2]

    @cached_property
    def branching(self) -> Int[ndarray, "dof"] | None:
        """The same for compiled code, which is compiled for arrays that can be written to: None of a chain,
        where each planned joint moves all that come after."""
        return None if (self.parents == np.arange(self.dof)).all() else self.parents.copy()

    @cached_property
    def moved_by(self) -> Bool[ndarray, "frames dof"]:
        """Which planned joints move each frame."""
        rows = np.zeros((self.dof + 1, self.dof), dtype=bool)
        for j, parent in enumerate(self.parents):
            rows[j + 1] = rows[parent]
            rows[j + 1, j] = True
        return read_only(rows)

    def at_end(self, link: str) -> bool:
        """Whether planned joints move a link and none comes behind it."""
        frame = self.link_frame(link)
        return frame > 0 and not self.moved_by[frame + 1 :, frame - 1].any()

    def chain(self, link: str) -> tuple[int, ...]:
        """The planned joints that move a link, from the base on."""
        return tuple(np.flatnonzero(self.moved_by[self.link_frame(link)]).tolist())

    def joints_between(self, a: str, b: str) -> tuple[int, ...]:
        """The planned joints between two links on a chain; none if another one moves there, or a joint on
        each side."""
        by_child = {joint.child: joint for joint in self.joints}

        def above(link: str) -> tuple[str, ...]:
            if link not in by_child:
                return ()
            joint = by_child[link]
            return (*above(joint.parent), *((joint.name,) if joint.kind in MOVING_KINDS else ()))

        near, far = sorted((above(a), above(b)), key=len)
        between = far[len(near) :] if far[: len(near)] == near else ()
        return tuple(map(self.joint_names.index, between)) if {*between} <= {*self.joint_names} else ()

    def link_frame(self, link: str) -> int:
        """Index of the frame that the link is fixed to: 0 for the base, j + 1 behind planned joint j."""
        return self._link(link)[0]

    def T_frame_link(self, link: str) -> Float[ndarray, "4 4"]:
        return self._link(link)[1]

    def _link(self, link: str) -> tuple[int, ndarray]:
        if link not in self._frames[0]:
            raise unknown_name("link", link, self.link_names)
        return self._frames[0][link]

    def checked_pairs(self) -> tuple[tuple[str, str], ...]:
        """Pairs of links with geometry, on different frames, that are checked against each other."""
        links = [link for link in self.link_names if link in self.spheres]
        return tuple(
            (a, b)
            for i, a in enumerate(links)
            for b in links[i + 1 :]
            if frozenset((a, b)) not in self.allowed_collisions and self.link_frame(a) != self.link_frame(b)
        )

    def with_locked(self, locked: dict[str, float]) -> "Robot":
        """The same robot with some joints held at values (a planned joint may be named too).

        Joints that mimic others follow them. Raises InputError for an unknown or fixed joint, a value that is
        not finite, or one of a mimic joint that its master does not say. Values beyond the URDF's limits are
        accepted: gripper openings in published problems exceed them.
        """
        movable = {joint.name: joint for joint in self.joints if joint.kind in MOVING_KINDS}
        for name, value in locked.items():
            if name not in movable:
                raise unknown_name("joint in locked", name, movable)
            if not isinstance(value, Real) or not abs(value) <= MAX_COORDINATE:
                raise InputError(f"locked: {name} is {shown(value)}; it must be a number within ±{MAX_COORDINATE:g}")
        held = following(self.joints, self.locked | {name: float(value) for name, value in locked.items()})
        for name, value in locked.items():
            mimic = movable[name].mimic
            if mimic is not None and abs(held[name] - value) > MIMIC_SLACK:
                raise InputError(
                    f"locked: {name} is {value:g}; it follows {mimic.joint}, which puts it at "
                    f"{held[name]:g}; lock {mimic.joint}"
                )
        if held == self.locked:
            return self
        if self.attached:
            from robotdiffuse.robots.attached_bodies import attached_again

            return attached_again(self.arm.with_locked(locked), self.attached)
        return _variant(self.unlocked, tuple(sorted(held.items())))

    @property
    def arm(self) -> "Robot":
        """The robot without tool and held objects."""
        return self.bare or self

    def attach(self, shape: Rigid, link: str, touch_links: Sequence[str] = ()) -> "Robot":
        """The robot holding a shape, whose pose is given in the frame of the link.

        It becomes a link of the shape's name, so that goals may name it: with the arm it is kept clear of
        obstacles and of all links, but for those that move with it and `touch_links`. A curved shape is taken
        as a polyhedron around it, at most 2 % of its radius larger. Raises InputError for unknown links, a
        link that no planned joint moves, a name that is taken, and a cloud of points.
        """
        from robotdiffuse.robots.attached_bodies import holding

        return holding(self, shape, link, touch_links)

    def detach(self, name: str) -> "Robot":
        """The robot without a held object or tool; InputError if it has none of that name."""
        from robotdiffuse.robots.attached_bodies import detach

        return detach(self, name)

    def with_tool(
        self,
        link: str,
        T_link_tool: Float[ndarray, "4 4"],
        shapes: Sequence[Rigid] = (),
        touch_links: Sequence[str] = (),
        name: str = TOOL,
    ) -> "Robot":
        """The robot with a tool on a link: a frame that goals may name, and shapes in the frame of the link.

        The tool is the new tip if it is behind all planned joints. Shapes are as in `attach`.
        """
        from robotdiffuse.robots.attached_bodies import with_tool

        return with_tool(self, link, T_link_tool, shapes, touch_links, name)

    def standing(self, T_world_base: Float[ndarray, "4 4"]) -> "Robot":
        """The robot as it stands in the world, which is its base then: for pictures and simulators."""
        name = "world"
        while name in self.link_names:
            name += "_"
        axis = np.array([0.0, 0.0, 1.0])
        ground = Joint(f"{name}_to_{self.base}", "fixed", name, self.base, T_world_base, axis)
        bare = None if self.bare is None else self.bare.standing(T_world_base)
        return replace(self, base=name, joints=(ground, *self.joints), root="", above={}, bare=bare)

    @property
    def unlocked(self) -> "Robot":
        """The robot that `with_locked` made this one of; itself if it was not made so."""
        return self.__dict__.get("_unlocked", self)

    def __repr__(self) -> str:
        def row(values: ndarray) -> str:
            return ", ".join(f"{value:.4g}" for value in values)

        joints = ", ".join(self.joint_names)
        spheres = sum(len(rows) for rows in self.spheres.values())
        held = ", ".join(f"{name} = {value:g}" for name, value in list(self.locked.items())[:6])
        more = f" and {len(self.locked) - 6} more" if len(self.locked) > 6 else ""
        lines = [
            f"Robot {self.name!r}: {self.dof} planned joints from {self.base} to {' and '.join(self.tips)}",
            f"  joints  {joints}",
            f"  lower   {row(self.lower)}",
            f"  upper   {row(self.upper)}",
            f"  locked  {held}{more}" if held else "",
            f"  {spheres} spheres on {len(self.spheres)} of {len(self.link_names)} links, "
            f"{len(self.checked_pairs())} checked pairs of links",
            f"  holds   {', '.join(body.name for body in self.attached)}" if self.attached else "",
            f"  {len(self.notes)} notes: robot.notes" if self.notes else "",
        ]
        return "\n".join(line for line in lines if line)

    def __getstate__(self) -> dict[str, Any]:
        """What is pickled: the robot, and nothing that was compiled for it."""
        return {f.name: getattr(self, f.name) for f in fields(self)}


def following(joints: tuple[Joint, ...], locked: dict[str, float]) -> dict[str, float]:
    """The values of locked joints, with those that follow a locked one where it puts them."""
    by_name = {joint.name: joint for joint in joints}

    def value(name: str) -> float | None:
        mimic = by_name[name].mimic if name in by_name else None
        led = None if mimic is None else value(mimic.joint)
        return locked.get(name) if mimic is None or led is None else mimic.multiplier * led + mimic.offset

    values = {name: value(name) for name in (*locked, *(joint.name for joint in joints if joint.mimic))}
    return {name: number for name, number in values.items() if number is not None}


@lru_cache(maxsize=VARIANTS)
def _variant(robot: Robot, locked: tuple[tuple[str, float], ...]) -> Robot:
    """One object for equal values, so that what is compiled for it is compiled once."""
    if dict(locked) == robot.locked:
        return robot
    variant = replace(robot, locked=dict(locked))
    variant.__dict__["_unlocked"] = robot
    return variant


def once_per_robot(build: Callable[[Robot], T]) -> Callable[[Robot], T]:
    """A function of a robot alone that works once for each: results live as long as their robot."""
    name = f"{build.__module__}.{build.__qualname__}"

    @wraps(build)
    def known(robot: Robot) -> T:
        if name not in robot.__dict__:
            robot.__dict__[name] = build(robot)
        return robot.__dict__[name]

    return known
