"""Robot: one or several arms as plain data, used by kinematics and collision checking alike."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import lru_cache, reduce, wraps
from numbers import Real
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from numpy.typing import ArrayLike

from robotdiffuse.core.bounds import MAX_COORDINATE
from robotdiffuse.core.errors import InputError, shown, unknown_name
from robotdiffuse.core.loading import loading
from robotdiffuse.robots.bodies import TOOL, AttachedBody, BodyContent, ConvexMesh, RigidShape, Surface
from robotdiffuse.robots.inertias import Inertia
from robotdiffuse.robots.joints import MIMIC_SLACK, MOVING_KINDS, Joint, with_mimics
from robotdiffuse.robots.kinematic_tree import KinematicTree
from robotdiffuse.robots.link_pair_tables import LinkPairTable

LOCKED_CACHE = 256
"""Number of robots with locked joints in the cache, least recently used out first: about 0.1 MB each."""
ATTACHED_CACHE = 64
"""Number of robots with attached bodies in the cache."""

T = TypeVar("T")


@dataclass(frozen=True, eq=False, repr=False)
class Robot(KinematicTree):
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
        """The robot with joints held at values. Mimic joints follow.

        Values beyond the URDF's limits are accepted, since gripper openings in published problems exceed
        them. Equal
        values give the same object.

        Args:
            locked: Values [rad] or [m] by the names of joints, which may be planned joints.

        Raises:
            InputError: For an unknown or fixed joint, a value that is not finite, or a value of a mimic joint
                that
                contradicts its leader.
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
        """The robot holding an object.

        The object becomes a link of its name, so goals may name it. Collision checks keep it clear of
        obstacles and of
        all links but those that move with it.

        Args:
            shape: The object, at its pose in the frame of the link. A curved shape is replaced by a
                polyhedron around
                it that exceeds it by at most 2 % of its radius.
            link: The link that holds it.
            touch_links: Further links that it may touch.

        Raises:
            InputError: For unknown links, a link that no planned joint moves, a name that is taken, and a
                point cloud.

        Examples:
            >>> cup = rd.Cylinder([0, 0, 0.125], radius=0.03, height=0.1, name="cup")
            >>> rd.load_robot("panda").attach(cup, "panda_hand").attached[0].name
            'cup'
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
        """The robot with a tool: a frame that goals may name, and shapes that are part of the arm.

        The tool becomes the tip if no planned joint comes after its link.

        Args:
            link: The link that carries it.
            T_link_tool: Pose of the tool's frame [4, 4].
            shapes: Its shapes, in the frame of the link.
            touch_links: Links that the shapes may touch.
            name: Name of the frame.

        Raises:
            InputError: As `attach` does, and if the robot has a tool already.
        """
        tools = [body.name for body in self.attached if body.tool]
        if tools:
            raise InputError(f"tool: the robot has the tool {tools[0]!r} already; detach it first")
        T = np.asarray(T_link_tool, np.float64)
        return self.with_body(AttachedBody(name, link, T, tuple(shapes), tuple(touch_links), tool=True))

    def with_body(self, body: AttachedBody) -> "Robot":
        """The robot with a body attached; the same object for bodies of equal content.

        Args:
            body: The held object or tool.

        Raises:
            InputError: For unknown links, a link that no planned joint moves, a name that a link has, and
                shapes that
                cannot be held.
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
        """The robot without a held object or tool.

        Args:
            name: Its name.

        Raises:
            InputError: For an unknown name, and for a body that holds another one.
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
        """The robot with a new base link, the world, that carries the old one: for pictures and simulators.

        Args:
            T_world_base: Pose of the old base [4, 4].
        """
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
