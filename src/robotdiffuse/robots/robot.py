"""Robot: one or several arms as plain data, used by kinematics and collision checking alike."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property, lru_cache, reduce, wraps
from numbers import Real
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from numpy.typing import ArrayLike

from robotdiffuse.core.bounds import MAX_COORDINATE, Value, read_only
from robotdiffuse.core.errors import InputError, shown, unknown_name
from robotdiffuse.core.loading import loading
from robotdiffuse.core.transforms import inverse, rotation_z_to, transform
from robotdiffuse.robots.bodies import TOOL, AttachedBody, BodyContent, ConvexMesh, RigidShape, Surface
from robotdiffuse.robots.inertias import Inertia
from robotdiffuse.robots.joints import MIMIC_SLACK, MOVING_KINDS, Joint, with_mimics
from robotdiffuse.robots.link_pair_tables import TURN, LinkPairTable

LOCKED_CACHE = 256
"""Number of robots with locked joints in the cache, least recently used out first: about 0.1 MB each."""
ATTACHED_CACHE = 64
"""Number of robots with attached bodies in the cache."""

T = TypeVar("T")


@dataclass(frozen=True, eq=False, repr=False)
class Robot(Value):
    """A serial arm, or several arms on one body, such as two arms on a torso.

    Planned joints are the movable, unlocked joints between the base and the tips.

    Frames: frame 0 is the base link; frame j + 1 moves with planned joint j, and T_base_frame[j + 1] =
    T_base_frame[parents[j]] @ frame_offsets[j] @ M(q_j), where M rotates about z, or translates along z for a
    prismatic joint. For a serial arm, parents[j] is j. Every link is fixed to one frame.
    """

    name: str
    base: str
    tip: str
    """Default link for goals and pictures; the first of `tips`."""
    joints: tuple[Joint, ...]
    """All joints below the base, parents before children."""
    spheres: dict[str, Float[ndarray, "n 4"]] = field(default_factory=dict)
    """Collision spheres by link, x y z radius in the link frame [m]. They cover `meshes`."""
    meshes: dict[str, tuple[ConvexMesh, ...]] = field(default_factory=dict)
    """Convex collision meshes by link: the geometry that the validator checks."""
    allowed_collisions: frozenset[frozenset[str]] = frozenset()
    """Pairs of links that are not checked against each other."""
    locked: dict[str, float] = field(default_factory=dict)
    """Values of the movable joints that are held while planning, by name [rad] or [m]."""
    notes: tuple[str, ...] = ()
    """What was changed or ignored when the URDF was read."""
    root: str = ""
    """Root link of the URDF; if empty, the base is the root."""
    above: dict[str, Float[ndarray, "4 4"]] = field(default_factory=dict)
    """T_base_link of the links above the base that only fixed joints connect to it. The root is among them
    unless a movable joint lies between."""
    poses: dict[str, dict[str, float]] = field(default_factory=dict)
    """Named poses of the SRDF: joint values by name [rad] or [m]."""
    source: str | None = None
    """The file or name given to `load_robot`, by which problem files refer to the robot; None if bundled."""
    attached: tuple[AttachedBody, ...] = ()
    """Tool and held objects; each is a link too."""
    bare: "Robot | None" = None
    """The robot without attached bodies; None if there are none. See `arm`."""
    inertias: dict[str, Inertia] = field(default_factory=dict)
    """Inertias of the links for which the URDF gives them."""
    other_tips: tuple[str, ...] = ()
    """Tips of further arms whose joints are planned too."""
    tables: tuple[LinkPairTable, ...] = ()
    """For pairs of links that pass closer than spheres can resolve: the joint values at which they do not
    collide."""
    surfaces: dict[str, Surface] = field(default_factory=dict)
    """Collision meshes as the URDF gives them, of the links in `grazing`. `meshes` contain them."""
    grazing: frozenset[frozenset[str]] = frozenset()
    """Pairs of links whose `meshes` can overlap where their `surfaces` are apart; see
    `collision.surface_pairs`."""

    if TYPE_CHECKING:  # assigned by the package: kinematics imports robots, not the reverse

        def fk(self, q: ArrayLike, link: str | None = None) -> ndarray: ...

        def jacobian(self, q: ArrayLike, link: str | None = None) -> ndarray: ...

        def ik(
            self,
            pose: ArrayLike,
            link: str | None = None,
            *,
            count: int = 10,
            near: ArrayLike | None = None,
            seed: int = 0,
        ) -> ndarray: ...

    @cached_property
    def link_names(self) -> tuple[str, ...]:
        return (self.base, *(joint.child for joint in self.joints))

    @property
    def T_base_root(self) -> Float[ndarray, "4 4"] | None:
        """Pose of the URDF's root in the base frame; None if a movable joint lies between them."""
        return np.eye(4) if self.root in ("", self.base) else self.above.get(self.root)

    @cached_property
    def links_fixed_to_base(self) -> dict[str, Float[ndarray, "4 4"]]:
        """T_base_link of the base and of the links that only fixed joints connect to it."""
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
        """Movable, unlocked joints between the base and the tips, in depth-first order."""
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
        """Largest torques [N m] or forces [N]; 0 where the URDF gives none."""
        return self._limit("effort")

    @cached_property
    def prismatic(self) -> tuple[bool, ...]:
        return tuple(joint.kind == "prismatic" for joint in self.planned_joints)

    @cached_property
    def continuous(self) -> Bool[ndarray, "dof"]:
        """Which planned joints rotate without limits, so that values one turn apart are equivalent."""
        return read_only(np.array([joint.kind == "continuous" for joint in self.planned_joints], dtype=bool))

    def whole_turns(self, q: Float[ndarray, "*n dof"]) -> Float[ndarray, "*n dof"]:
        """The multiples of 2 pi to subtract so that continuous joints are within [-pi, pi]; 0 for others."""
        if not self._any_continuous:
            return np.zeros_like(q)
        return np.where(self.continuous, TURN * np.round(q / TURN), 0.0)

    @cached_property
    def _any_continuous(self) -> bool:
        return bool(self.continuous.any())

    def unwound(self, q: Float[ndarray, "*n dof"]) -> Float[ndarray, "*n dof"]:
        """Equivalent configurations in which joints with a range above one turn are within half a turn of the
        middle of their limits."""
        middle = 0.5 * (self.lower + self.upper)
        return np.where(self._turns_twice, q - TURN * np.round((q - middle) / TURN), q)

    def equivalent_configurations(
        self, q: Float[ndarray, "dof"], start: Float[ndarray, "dof"]
    ) -> Float[ndarray, "k dof"]:
        """Configurations within the limits that differ from `q` by whole turns of joints that have limits and
        a range above one turn.

        In the first one, all of these joints are as close to `start` as possible. In each further one, one
        joint turns the other way, since obstacles may block the short way.
        """
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
        """Index of the frame that each planned joint is mounted on: j for joint j of a serial arm."""
        return self._frames[2]

    @cached_property
    def kernel_parents(self) -> Int[ndarray, "dof"] | None:
        """`parents` for compiled code, as a writable array; None for a serial arm.

        Kernels are compiled for writable arrays, and skip the look-up for serial arms.
        """
        return None if (self.parents == np.arange(self.dof)).all() else self.parents.copy()

    @cached_property
    def moved_by(self) -> Bool[ndarray, "frames dof"]:
        """Which planned joints move which frames."""
        rows = np.zeros((self.dof + 1, self.dof), dtype=bool)
        for j, parent in enumerate(self.parents):
            rows[j + 1] = rows[parent]
            rows[j + 1, j] = True
        return read_only(rows)

    def at_end(self, link: str) -> bool:
        """Whether planned joints move a link, and none comes after it."""
        frame = self.link_frame(link)
        return frame > 0 and not self.moved_by[frame + 1 :, frame - 1].any()

    def chain(self, link: str) -> tuple[int, ...]:
        """Indices of the planned joints that move a link, from the base on."""
        return tuple(np.flatnonzero(self.moved_by[self.link_frame(link)]).tolist())

    def joints_between(self, a: str, b: str) -> tuple[int, ...]:
        """Indices of the planned joints between two links of which one carries the other.

        Empty if neither carries the other, or if a movable joint between them is not planned.
        """
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
        """Index of the frame that the link is fixed to: 0 for the base, j + 1 after planned joint j."""
        return self._link(link)[0]

    def T_frame_link(self, link: str) -> Float[ndarray, "4 4"]:
        """Constant pose of the link in its frame (see `link_frame`); InputError for an unknown link."""
        return self._link(link)[1]

    def _link(self, link: str) -> tuple[int, ndarray]:
        if link not in self._frames[0]:
            raise unknown_name("link", link, self.link_names)
        return self._frames[0][link]

    def checked_pairs(self) -> tuple[tuple[str, str], ...]:
        """Pairs of links that are checked against each other: with geometry, on different frames, not
        allowed."""
        links = [link for link in self.link_names if link in self.spheres]
        return tuple(
            (a, b)
            for i, a in enumerate(links)
            for b in links[i + 1 :]
            if frozenset((a, b)) not in self.allowed_collisions and self.link_frame(a) != self.link_frame(b)
        )

    def with_locked(self, locked: dict[str, float]) -> "Robot":
        """The robot with joints locked at values [rad] or [m], by name; planned joints can be locked too.

        Mimic joints follow. Values beyond the URDF's limits are accepted, since gripper openings in published
        problems exceed them. Equal values give the same object. Raises InputError for an unknown or fixed
        joint, a value that is not finite, or a value of a mimic joint that contradicts its leader.
        """
        movable = {joint.name: joint for joint in self.joints if joint.kind in MOVING_KINDS}
        for name, value in locked.items():
            if name not in movable:
                raise unknown_name("joint in locked", name, movable)
            if not isinstance(value, Real) or not abs(value) <= MAX_COORDINATE:
                raise InputError(
                    f"locked: {name} is {shown(value)}; it must be a number within ±{MAX_COORDINATE:g}"
                )
        held = with_mimics(self.joints, self.locked | {name: float(value) for name, value in locked.items()})
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
            return reduce(Robot.with_body, self.attached, self.arm.with_locked(locked))
        return _variant(self.unlocked, tuple(sorted(held.items())))

    @property
    def arm(self) -> "Robot":
        """The robot without tool and held objects; the robot itself if there are none."""
        return self.bare or self

    def attach(self, shape: RigidShape, link: str, touch_links: Sequence[str] = ()) -> "Robot":
        """The robot holding a shape, whose pose is given in the frame of the link.

        The shape becomes a link with the shape's name, so goals may name it. Collision checks keep it clear
        of obstacles and of all links, except links that move with it and `touch_links`. A curved shape is
        replaced by a polyhedron around it that exceeds it by at most 2 % of its radius.

        Raises InputError for unknown links, a link that no planned joint moves, a name that is taken, and a
        point cloud.
        """
        if not hasattr(shape, "solid"):
            raise InputError(f"attached is a {type(shape).__name__}; it must be a shape, e.g. rd.Box")
        T_link_body = shape.solid()[0]
        return self.with_body(AttachedBody(shape.name, link, T_link_body, (shape,), tuple(touch_links)))

    def with_tool(
        self,
        link: str,
        T_link_tool: Float[ndarray, "4 4"],
        shapes: Sequence[RigidShape] = (),
        touch_links: Sequence[str] = (),
        name: str = TOOL,
    ) -> "Robot":
        """The robot with a tool on a link: a frame that goals may name, and shapes in the frame of the link.

        The tool becomes the tip if no planned joint comes after its link. Shapes, `touch_links` and errors
        are as in `attach`; InputError too if the robot has a tool already.
        """
        tools = [body.name for body in self.attached if body.tool]
        if tools:
            raise InputError(f"tool: the robot has the tool {tools[0]!r} already; detach it first")
        T = np.asarray(T_link_tool, np.float64)
        return self.with_body(AttachedBody(name, link, T, tuple(shapes), tuple(touch_links), tool=True))

    def with_body(self, body: AttachedBody) -> "Robot":
        """The robot with a body attached; the same object for bodies of equal content.

        Raises InputError for unknown links, a link that no planned joint moves, a name that a link has, and
        shapes that cannot be held.
        """
        what = TOOL if body.tool else "attached"
        moved = [link for link in self.link_names if self.link_frame(link) > 0]
        if body.link not in self.link_names:
            raise unknown_name(f"link in {what}.link:", str(body.link), moved)
        if body.link not in moved:
            raise InputError(
                f"{what}.link is {body.link}, which no planned joint moves; these are moved: "
                f"{', '.join(moved)}"
            )
        if body.name in self.link_names:
            raise InputError(
                f"{what}.name is {body.name!r}, which is a link of {self.name}; give it another name"
            )
        for link in body.touch_links:
            if link not in self.link_names:
                raise unknown_name(f"link in {what}.touch_links:", str(link), self.link_names)
        return _with_body(self, BodyContent(body))

    def detach(self, name: str) -> "Robot":
        """The robot without the held object or tool of that name.

        Raises InputError for an unknown name, and for a body that holds another one.
        """
        names = [body.name for body in self.attached]
        if name not in names:
            raise unknown_name("body to detach:", name, names)
        holds = [body.name for body in self.attached if body.link == name]
        if holds:
            raise InputError(f"{name} cannot be detached: it holds {', '.join(holds)}; detach that first")
        left = [
            replace(body, touch_links=tuple(link for link in body.touch_links if link != name))
            for body in self.attached
            if body.name != name
        ]
        return reduce(Robot.with_body, left, self.arm)

    def placed_in_world(self, T_world_base: Float[ndarray, "4 4"]) -> "Robot":
        """The robot with a new base link, the world, that carries the old one: for pictures and
        simulators."""
        name = "world"
        while name in self.link_names:
            name += "_"
        axis = np.array([0.0, 0.0, 1.0])
        ground = Joint(f"{name}_to_{self.base}", "fixed", name, self.base, T_world_base, axis)
        bare = None if self.bare is None else self.bare.placed_in_world(T_world_base)
        return replace(self, base=name, joints=(ground, *self.joints), root="", above={}, bare=bare)

    @property
    def unlocked(self) -> "Robot":
        """The robot from which `with_locked` made this one; else the robot itself."""
        return self.__dict__.get("_unlocked", self)

    def __repr__(self) -> str:
        return f"Robot({self.name!r}, {self.dof} planned joints, {self.base} to {' and '.join(self.tips)})"

    def __str__(self) -> str:
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
        """Fields only: what was compiled or cached for the robot is not pickled."""
        return {f.name: getattr(self, f.name) for f in fields(self)}


@lru_cache(maxsize=LOCKED_CACHE)
def _variant(robot: Robot, locked: tuple[tuple[str, float], ...]) -> Robot:
    """The same object for equal values, so that data derived from a robot is computed once."""
    if dict(locked) == robot.locked:
        return robot
    variant = replace(robot, locked=dict(locked))
    variant.__dict__["_unlocked"] = robot
    return variant


@lru_cache(maxsize=ATTACHED_CACHE)
def _with_body(robot: Robot, content: BodyContent) -> Robot:
    from robotdiffuse.robots.attached_bodies import body_geometry  # compiled code; few robots need it

    body = content.body
    axis = np.array([0.0, 0.0, 1.0])
    joint = Joint(f"{body.link}_to_{body.name}", "fixed", body.link, body.name, body.T_link_body, axis)
    geometry = {body.name: body_geometry(body)} if body.shapes else {}
    # goals and pictures refer to the tip; a tool on another branch than the tip's does not replace it
    frame = robot.link_frame(body.link) if body.tool and robot.at_end(body.link) else -1
    tip, *others = [body.name if robot.link_frame(tip) == frame else tip for tip in robot.tips]
    return replace(
        robot,
        joints=(*robot.joints, joint),
        spheres=robot.spheres | {name: spheres for name, (_, spheres) in geometry.items()},
        meshes=robot.meshes | {name: meshes for name, (meshes, _) in geometry.items()},
        allowed_collisions=robot.allowed_collisions
        | {frozenset((body.name, link)) for link in body.touch_links},
        tip=tip,
        other_tips=tuple(others),
        attached=(*robot.attached, body),
        bare=robot.arm,
    )


def once_per_robot(build: Callable[[Robot], T]) -> Callable[[Robot], T]:
    """Decorator: cache a function of a robot on the robot itself, for the robot's lifetime. The first call
    counts as loading."""
    name = f"{build.__module__}.{build.__qualname__}"

    @wraps(build)
    def known(robot: Robot) -> T:
        if name not in robot.__dict__:
            with loading():
                robot.__dict__[name] = build(robot)
        return robot.__dict__[name]

    return known
