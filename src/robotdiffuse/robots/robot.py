"""Robot: the description of one or several arms, used by kinematics, collision checking and planning."""

import hashlib
import json
from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import lru_cache, reduce
from itertools import combinations
from numbers import Real
from typing import Any, cast

import numpy as np
from jaxtyping import Bool
from numpy import ndarray
from numpy.typing import ArrayLike

from robotdiffuse.core.errors import (
    MAX_COORDINATE,
    InputError,
    check_list,
    check_name,
    check_type,
    counted,
    joined,
    numbers,
    rigid_transform,
    shown,
    unknown_name,
    vector,
    within,
)
from robotdiffuse.core.settings import Natural, converted
from robotdiffuse.core.types import Mask, Pose, Spheres, Value, Values, frozen_dataclass
from robotdiffuse.robots.bodies import (
    TOOL,
    AttachedBody,
    ConvexMesh,
    Inertia,
    RigidShape,
    Surface,
)
from robotdiffuse.robots.kinematic_tree import (
    LIMITS,
    MIMIC_SLACK,
    TURN,
    Joint,
    KinematicTree,
    Mimic,
    with_mimics,
)

ROUNDING = 1e-5
"""Upper bound on the rounding error of a joint value [rad] or [m]."""


@frozen_dataclass
class LinkPairTable(Value):
    """Where the convex parts of two links are apart, as a function of the one or two joints between them."""

    links: tuple[str, str]
    joints: tuple[str, ...]
    """Joints between the two links, in order from the base."""
    lower: tuple[float, ...]
    """Joint values at which the table begins [rad] or [m]."""
    upper: tuple[float, ...]
    """Joint values at which the table ends. If the range of a joint is one whole turn, the table is periodic
    in this joint."""
    apart: Bool[ndarray, "*cells"]
    """Whether the links are apart for all joint values in a cell."""

    def at(self, *values: Values) -> Mask:
        """Whether the links are known to be apart at joint values; `values` are one array [n] per joint."""
        inside = np.ones(len(values[0]), bool)
        index = []
        for axis, value in enumerate(values):
            cell = self._cell(axis, value)
            count = self.apart.shape[axis]
            if not self._whole(axis):
                inside &= (cell >= 0) & (cell < count)
            index.append(cell % count)
        return inside & self.apart[tuple(index)]

    def throughout(self, *intervals: tuple[Values, Values]) -> Bool[ndarray, "*intervals"]:
        """Whether the links are known to be apart at all joint values in intervals, given as (low, high) per
        joint.

        With two joints, the result has a row per interval of the first joint and a column per interval of the
        second.
        """
        touch = ~self.apart
        for axis, (low, high) in enumerate(intervals):
            touch = np.moveaxis(np.tensordot(self._reached(axis, low, high), touch, (1, axis)), 0, axis)
            if not self._whole(axis):
                beyond = (low < self.lower[axis] - ROUNDING) | (high > self.upper[axis] + ROUNDING)
                touch |= np.expand_dims(beyond, tuple(i for i in range(len(intervals)) if i != axis))
        return ~touch.astype(bool)

    def _cell(self, axis: int, value: Values) -> ndarray:
        edge = (self.upper[axis] - self.lower[axis]) / self.apart.shape[axis]
        return np.floor((value - self.lower[axis]) / edge).astype(int)

    def _whole(self, axis: int) -> bool:
        return abs(self.upper[axis] - self.lower[axis] - TURN) < ROUNDING

    def _reached(self, axis: int, low: Values, high: Values) -> Bool[ndarray, "n cells"]:
        """Which cells along a joint each interval overlaps."""
        count = self.apart.shape[axis]
        first = self._cell(axis, low - ROUNDING)
        last = self._cell(axis, high + ROUNDING)
        steps = np.arange((last - first).max(initial=0) + 1)
        cell = np.minimum(first[:, None] + steps, last[:, None])
        cell = cell % count if self._whole(axis) else np.clip(cell, 0, count - 1)
        overlaps = np.zeros((len(low), count), bool)
        np.put_along_axis(overlaps, cell, True, axis=1)
        return overlaps


LOCKED_CACHE = 256
"""Largest number of robots with locked joints in the cache, about 0.1 MB each. The least recently used robot
is dropped first."""
ATTACHED_CACHE = 64
"""Largest number of robots with attached bodies in the cache."""


@dataclass(frozen=True, eq=False, repr=False)
class Robot(KinematicTree):
    """A serial arm, or several arms on one body, such as two arms on a torso.

    Planned joints are the movable, unlocked joints between the base and the tips.

    Frame 0 is the base link, and frame j + 1 moves with planned joint j: T_base_frame[j + 1] =
    T_base_frame[parents[j]] @ frame_offsets[j] @ M(q_j), where M rotates about z, or translates along z for a
    prismatic joint. For a serial arm, parents[j] is j. Every link is rigidly fixed to one frame.
    """

    name: str
    """Name of the robot, by which problem files refer to a bundled one."""
    base: str
    """Base link, in whose frame poses are given."""
    tip: str
    """Default link for goals and pictures; the first of `tips`."""
    joints: tuple[Joint, ...]
    """All joints below the base, parents before children."""
    spheres: dict[str, Spheres] = field(default_factory=dict)
    """Collision spheres by link: rows of x, y, z, radius in the link's frame [m]. They cover `meshes`."""
    meshes: dict[str, tuple[ConvexMesh, ...]] = field(default_factory=dict)
    """Convex collision meshes by link: the geometry that the validator checks."""
    allowed_collisions: frozenset[frozenset[str]] = frozenset()
    """Pairs of links that are not checked against each other."""
    locked: dict[str, float] = field(default_factory=dict)
    """Values of the movable joints that are held while planning, by name [rad] or [m]."""
    notes: tuple[str, ...] = ()
    """Notes on what was changed or ignored when the URDF was read."""
    root: str = ""
    """Root link of the URDF, or the link after its mobile base (see `UrdfTree.pose_link`); if empty, the
    base."""
    above: dict[str, Pose] = field(default_factory=dict)
    """T_base_link of the links between the root of the URDF and the base that are rigidly connected to the
    base. The root is one of them unless a movable joint lies between the root and the base."""
    poses: dict[str, dict[str, float]] = field(default_factory=dict)
    """Named poses of the SRDF: joint values by name [rad] or [m]."""
    source: str | None = None
    """The file or name given to `load_robot`, by which problem files refer to the robot; None if bundled."""
    attached: tuple[AttachedBody, ...] = ()
    """Tool and held objects; each is a link too."""
    bare: "Robot | None" = None
    """The robot without attached bodies; None if no body is attached. See `arm`."""
    inertias: dict[str, Inertia] = field(default_factory=dict)
    """Inertias of the links for which the URDF gives them."""
    other_tips: tuple[str, ...] = ()
    """Tips of further arms whose joints are planned too."""
    tables: tuple[LinkPairTable, ...] = ()
    """For pairs of links that pass closer than spheres can resolve: the joint values at which they do not
    collide."""
    surfaces: dict[str, Surface] = field(default_factory=dict)
    """Original collision meshes of the URDF, for the links in `grazing`. The convex `meshes` enclose them."""
    grazing: frozenset[frozenset[str]] = frozenset()
    """Pairs of links that pass so close that their convex `meshes` may overlap although their `surfaces` do
    not touch; see `collision.exact_meshes`."""

    def fk(self, q: ArrayLike, link: str | None = None) -> ndarray:
        """Forward kinematics: the pose of a link in the frame of the base.

        Args:
            q: A configuration [dof], or several [n, dof], of the planned joints [rad] or [m].
            link: Name of the link; None: the tip of the robot.

        Returns:
            T_base_link [4, 4], or [n, 4, 4].

        Raises:
            InputError: For an unknown link, or q of the wrong shape.

        Examples:
            >>> rd.load_robot("panda").fk([0, -0.785, 0, -2.356, 0, 1.571, 0.785])[:3, 3].round(2).tolist()
            [0.31, 0.0, 0.59]
        """
        rows = configurations(self, q)
        name = self.tip if link is None else link
        T = self.frames_at(np.atleast_2d(rows))[self.link_frame(name)] @ self.T_frame_link(name)
        return T[0] if rows.ndim == 1 else T

    def jacobian(self, q: ArrayLike, link: str | None = None) -> ndarray:
        """Geometric Jacobian of a link.

        The first three rows are the linear velocity of the link's origin, the last three the angular
        velocity, both in the axes of the base and per unit of joint velocity.

        Args:
            q: A configuration [dof], or several [n, dof], of the planned joints [rad] or [m].
            link: Name of the link; None: the tip of the robot.

        Returns:
            A matrix [6, dof], or [n, 6, dof].

        Raises:
            InputError: For an unknown link, or q of the wrong shape.
        """
        rows = configurations(self, q)
        name = self.tip if link is None else link
        frames = self.frames_at(np.atleast_2d(rows))
        origins = (frames[self.link_frame(name)] @ self.T_frame_link(name))[:, :3, 3]
        chain = list(self.chain(name))
        slides = self.prismatic[chain, None, None]
        T = np.array(frames)[1:][chain]
        axes = T[..., :3, 2]
        J = np.zeros((len(origins), 6, self.dof))
        J[:, :3, chain] = np.where(slides, axes, np.cross(axes, origins - T[..., :3, 3])).transpose(1, 2, 0)
        J[:, 3:, chain] = np.where(slides, 0.0, axes).transpose(1, 2, 0)
        return J[0] if rows.ndim == 1 else J

    def ik(
        self,
        pose: ArrayLike,
        link: str | None = None,
        *,
        count: int = 10,
        near: ArrayLike | None = None,
        seed: int = 0,
    ) -> ndarray:
        """Inverse kinematics: configurations within the joint limits that bring a link to a pose.

        The configurations may collide; `Problem.is_free` checks this.

        Args:
            pose: T_base_link [4, 4].
            link: Name of the link; None: the tip of the robot.
            count: Largest number of configurations.
            near: A configuration [dof]; results are sorted by their distance from `near`.
            seed: Seed of the random starts.

        Returns:
            Distinct configurations [k, dof]; no rows if the pose was not reached.

        Raises:
            InputError: For an unknown link, a link that no planned joint moves, a pose that is not rigid, a
                count below 1, a negative seed, or a wrong `near`.

        Examples:
            >>> robot = rd.load_robot("panda")
            >>> robot.ik(rd.pose([0.5, 0.1, 0.4], rpy=[3.1416, 0, 0]), count=3).shape
            (3, 7)
        """
        from robotdiffuse.robots.inverse_kinematics import inverse_kinematics  # compiled code

        rng = np.random.default_rng(converted("seed", Natural, seed))
        near_configuration = None if near is None else vector("ik", "near", near, self.dof)
        name = self.tip if link is None else link
        return inverse_kinematics(self, name, cast(ndarray, pose), count, rng=rng, near=near_configuration)

    def checked_pairs(self) -> tuple[tuple[str, str], ...]:
        """List the pairs of links that are checked against each other.

        Returns:
            Pairs in which both links have spheres and are fixed to different frames, without those in
            `allowed_collisions`.
        """
        return tuple(pairs_to_check(self, self.spheres))

    def with_locked(self, locked: dict[str, float]) -> "Robot":
        """Lock joints at values. Joints that mimic them follow.

        Values may exceed the URDF's limits by up to the joint's range, since some published problems open
        grippers that far; pairs of links that never collide within the limits stay unchecked there. If the
        limits are equal, as for a revolute wheel without limits in the URDF (both are then 0), the joint may
        be locked at any value. Calls with equal values return the same object.

        Args:
            locked: Values [rad] or [m] by joint name. Planned joints may be locked as well.

        Returns:
            The robot with these joints locked, in addition to those that are locked already.

        Raises:
            InputError: For an unknown or fixed joint, a value beyond ±1e4, or farther beyond a limit than the
                joint's range, or a value of a mimic joint that contradicts the joint that it mimics.
        """
        check_type("locked", locked, Mapping, "a mapping of joints to values")
        movable = {joint.name: joint for joint in self.joints if joint.movable}
        for name, value in locked.items():
            check_name("joint in locked", name, movable)
            number = isinstance(value, Real) and not isinstance(value, bool)
            if not number or not abs(value) <= MAX_COORDINATE:
                raise InputError(
                    f"locked: {name} is {shown(value)}; it must be a number within ±{MAX_COORDINATE:g}"
                )
            lower = movable[name].lower
            upper = movable[name].upper
            mimic = movable[name].mimic
            if mimic is not None and mimic.joint in {*self.locked, *locked}:
                continue  # its value is checked below
            if lower < upper and not 2 * lower - upper <= value <= 2 * upper - lower:
                raise InputError(
                    f"locked: {name} is {value:g}; it is far beyond its limits, {lower:g} to {upper:g}"
                )
        values_locked = with_mimics(
            self.joints, self.locked | {name: float(value) for name, value in locked.items()}
        )
        for name, value in locked.items():
            mimic = movable[name].mimic
            if mimic is not None and abs(values_locked[name] - value) > MIMIC_SLACK:
                raise InputError(
                    f"locked: {name} is {value:g}; it follows {mimic.joint}, which puts it at "
                    f"{values_locked[name]:g}; lock {mimic.joint}"
                )
        if values_locked == self.locked:
            return self
        if self.attached:
            return reduce(Robot.with_body, self.attached, self.arm.with_locked(locked))
        return _variant(self.unlocked, tuple(sorted(values_locked.items())))

    @property
    def arm(self) -> "Robot":
        """The robot without tool and held objects; the robot itself if there are none."""
        return self.bare or self

    def attach(self, shape: RigidShape, link: str, touch_links: Sequence[str] = ()) -> "Robot":
        """Let the robot hold an object.

        The object becomes a link with its own name, which goals may use. It is checked for collision with
        obstacles and with all links that do not move with it.

        Args:
            shape: The object, at its pose in the frame of `link`. A curved shape is replaced by a polyhedron
                around it, which extends beyond the shape by at most 2.5 % of the radius.
            link: The link that holds the object.
            touch_links: Further links that the object may touch.

        Returns:
            The robot with the object.

        Raises:
            InputError: For unknown links, a link that no planned joint moves, a name that a link already has,
                a point cloud, and a height map.

        Examples:
            >>> cup = rd.Cylinder([0, 0, 0.125], radius=0.03, height=0.1, name="cup")
            >>> rd.load_robot("panda").attach(cup, "panda_hand").attached[0].name
            'cup'
        """
        check_type("attached", shape, RigidShape, "a shape, e.g. rd.Box")
        check_list("attached.touch_links", touch_links, str, "names of links")
        return self.with_body(AttachedBody(shape.name, link, shape.solid()[0], (shape,), tuple(touch_links)))

    def with_tool(
        self,
        link: str,
        T_link_tool: Pose,
        shapes: Sequence[RigidShape] = (),
        touch_links: Sequence[str] = (),
        name: str = TOOL,
    ) -> "Robot":
        """Add a tool: a frame that goals may name, and shapes that are part of the arm.

        The tool becomes the tip of its arm if no planned joint comes after `link`.

        Args:
            link: The link that carries the tool.
            T_link_tool: Pose of the tool's frame [4, 4].
            shapes: Shapes of the tool, in the frame of `link`.
            touch_links: Links that the shapes may touch.
            name: Name of the tool's frame.

        Returns:
            The robot with the tool.

        Raises:
            InputError: In the cases in which `attach` raises it, for a pose that is not rigid, and if the
                robot already has a tool.
        """
        tools = [body.name for body in self.attached if body.tool]
        if tools:
            raise InputError(f"tool: the robot has the tool {tools[0]!r} already; detach it first")
        T = rigid_transform("tool.T_link_tool", T_link_tool)
        check_list("tool.shapes", shapes, RigidShape, "shapes")
        check_list("tool.touch_links", touch_links, str, "names of links")
        return self.with_body(AttachedBody(name, link, T, tuple(shapes), tuple(touch_links), tool=True))

    def with_body(self, body: AttachedBody) -> "Robot":
        """Attach a body. Calls with bodies of equal content return the same object.

        Args:
            body: The held object or tool.

        Returns:
            The robot with the body.

        Raises:
            InputError: For unknown links, a link that no planned joint moves, a name that a link already has,
                and shapes that cannot be attached.
        """
        field = TOOL if body.tool else "attached"
        self.check_moved(f"{field}.link", body.link)
        if not isinstance(body.name, str) or body.name in ("", *self.link_names):
            raise InputError(
                f"{field}.name is {shown(body.name)}; it must be a name that no link or held object of "
                f"{self.name} has"
            )
        for link in body.touch_links:
            check_name(f"link in {field}.touch_links:", link, self.link_names)
        return _with_body(self, body)

    def detach(self, name: str) -> "Robot":
        """Detach a held object or tool.

        Args:
            name: Name of the object or tool.

        Returns:
            The robot without it.

        Raises:
            InputError: For an unknown name, and for a body to which another body is attached.
        """
        check_name("body to detach:", name, [body.name for body in self.attached])
        held_bodies = [body.name for body in self.attached if body.link == name]
        if held_bodies:
            raise InputError(
                f"{name} cannot be detached: it holds {', '.join(held_bodies)}; detach that first"
            )
        remaining = [
            replace(body, touch_links=tuple(link for link in body.touch_links if link != name))
            for body in self.attached
            if body.name != name
        ]
        return reduce(Robot.with_body, remaining, self.arm)

    def placed_in_world(self, T_world_base: Pose) -> "Robot":
        """Fix the base to a new base link, the world; for pictures and simulators.

        Args:
            T_world_base: Pose of the old base in the world [4, 4].

        Returns:
            The robot with the world as its base.

        Raises:
            InputError: For a pose that is not rigid.
        """
        T_world_base = rigid_transform("T_world_base", T_world_base)
        name = "world"
        while name in self.link_names:
            name += "_"
        ground = Joint(f"{name}_to_{self.base}", "fixed", name, self.base, T_world_base)
        bare = None if self.bare is None else self.bare.placed_in_world(T_world_base)
        return replace(self, base=name, joints=(ground, *self.joints), root="", above={}, bare=bare)

    @property
    def unlocked(self) -> "Robot":
        """The robot from which `with_locked` made this robot; the robot itself if it was made otherwise."""
        return self.__dict__.get("_unlocked", self)

    def __repr__(self) -> str:
        return (
            f"Robot({self.name!r}, {counted(self.dof, 'planned joint')}, {self.base} to "
            f"{' and '.join(self.tips)})"
        )

    def __str__(self) -> str:
        def row(values: ndarray) -> str:
            return ", ".join(f"{value:.4g}" for value in values)

        joints = ", ".join(self.joint_names)
        spheres = sum(map(len, self.spheres.values()))
        locked_text = joined((f"{name} = {value:g}" for name, value in self.locked.items()), 6)
        lines = [
            f"Robot {self.name!r}: {counted(self.dof, 'planned joint')} from {self.base} to "
            f"{' and '.join(self.tips)}",
            f"  joints  {joints}",
            f"  lower   {row(self.lower)}",
            f"  upper   {row(self.upper)}",
            f"  locked  {locked_text}" if locked_text else "",
            f"  {counted(spheres, 'sphere')} on {len(self.spheres)} of {len(self.link_names)} links, "
            f"{counted(len(self.checked_pairs()), 'checked pair')} of links",
            f"  holds   {', '.join(body.name for body in self.attached)}" if self.attached else "",
            f"  {counted(len(self.notes), 'note')}: robot.notes" if self.notes else "",
        ]
        return "\n".join(line for line in lines if line)

    def __getstate__(self) -> dict[str, Any]:
        """The dataclass fields. Data that was compiled or cached for the robot is not pickled."""
        return {f.name: getattr(self, f.name) for f in fields(self)}


@lru_cache(maxsize=LOCKED_CACHE)
def _variant(robot: Robot, locked: tuple[tuple[str, float], ...]) -> Robot:
    """The robot with these locked joints; the same object for equal values, so that data derived from it is
    computed once."""
    if dict(locked) == robot.locked:
        return robot
    variant = replace(robot, locked=dict(locked))
    variant.__dict__["_unlocked"] = robot
    return variant


@lru_cache(maxsize=ATTACHED_CACHE)
def _with_body(robot: Robot, body: AttachedBody) -> Robot:
    from robotdiffuse.robots.fitting.covering_spheres import (
        body_geometry,  # compiled code; few robots need it
    )

    joint = Joint(f"{body.link}_to_{body.name}", "fixed", body.link, body.name, body.T_link_body)
    meshes = dict(robot.meshes)
    spheres = dict(robot.spheres)
    if body.shapes:
        meshes[body.name], spheres[body.name] = body_geometry(body)
    # a tool replaces the tip of its own chain only; goals and pictures refer to the tip
    frame = robot.link_frame(body.link) if body.tool and robot.at_end(body.link) else -1
    tip, *remaining_tips = [body.name if robot.link_frame(tip) == frame else tip for tip in robot.tips]
    return replace(
        robot,
        joints=(*robot.joints, joint),
        spheres=spheres,
        meshes=meshes,
        allowed_collisions=robot.allowed_collisions
        | {frozenset((body.name, link)) for link in body.touch_links},
        tip=tip,
        other_tips=tuple(remaining_tips),
        attached=(*robot.attached, body),
        bare=robot.arm,
    )


def scaled(robot: Robot, scale: float) -> Robot:
    """The arm without attached bodies, scaled by a factor: joint offsets, spheres, convex meshes, `above`,
    and all positions of prismatic joints (limits, locked values, tables). All else is unchanged, including
    inertias, named poses and surfaces."""
    arm = robot.arm
    factors = {joint.name: scale if joint.kind == "prismatic" else 1.0 for joint in arm.joints}

    def sized(joint: Joint) -> Joint:
        by = factors[joint.name]
        mimic = joint.mimic
        if mimic is not None:
            multiplier = by / factors.get(mimic.joint, 1.0) * mimic.multiplier
            mimic = Mimic(mimic.joint, multiplier, by * mimic.offset)
        T = _with_scaled_position(joint.T_parent_joint, scale)
        return replace(joint, T_parent_joint=T, lower=by * joint.lower, upper=by * joint.upper, mimic=mimic)

    def sized_table(table: LinkPairTable) -> LinkPairTable:
        by = np.array([factors[name] for name in table.joints])
        lower = tuple((by * table.lower).tolist())
        upper = tuple((by * table.upper).tolist())
        return replace(table, lower=lower, upper=upper)

    return replace(
        arm,
        joints=tuple(map(sized, arm.joints)),
        spheres={link: scale * rows for link, rows in arm.spheres.items()},
        meshes={
            link: tuple(replace(mesh, vertices=scale * mesh.vertices) for mesh in meshes)
            for link, meshes in arm.meshes.items()
        },
        locked={name: factors[name] * value for name, value in arm.locked.items()},
        tables=tuple(map(sized_table, arm.tables)),
        above={link: _with_scaled_position(T, scale) for link, T in arm.above.items()},
    )


def _with_scaled_position(T: Pose, scale: float) -> Pose:
    moved = T.copy()
    moved[:3, 3] *= scale
    return moved


def moving_pairs(robot: Robot, names: Container[str]) -> list[tuple[str, str]]:
    """Pairs of links with these names that are fixed to different frames."""
    links = [link for link in robot.link_names if link in names]
    return [(a, b) for a, b in combinations(links, 2) if robot.link_frame(a) != robot.link_frame(b)]


def pairs_to_check(robot: Robot, names: Container[str]) -> list[tuple[str, str]]:
    """The `moving_pairs` that are not in `robot.allowed_collisions`."""
    return [pair for pair in moving_pairs(robot, names) if frozenset(pair) not in robot.allowed_collisions]


def check_robot(robot: object) -> None:
    """Raises InputError for anything but a Robot."""
    check_type("robot", robot, Robot, "a Robot, e.g. rd.load_robot('panda')")


def check_joints(what: str, joint_names: Sequence[str], robot: Robot) -> None:
    """Raises InputError unless the joints of a motion, named `what`, are the planned joints of the robot."""
    if tuple(joint_names) != robot.joint_names:
        names = joined(joint_names)
        right = joined(robot.joint_names)
        raise InputError(f"{what}.joint_names is {names}; the robot's planned joints are {right}")


def configurations(robot: Robot, q: ArrayLike) -> ndarray:
    """q as an array: a configuration [dof], or several [n, dof]. Raises InputError for other shapes, and for
    numbers that are not finite or not within ±MAX_COORDINATE."""
    rows = numbers(q)
    if rows is None or rows.ndim not in (1, 2) or rows.shape[-1] != robot.dof or not within(rows):
        names = ", ".join(robot.joint_names)
        raise InputError(
            f"q is {shown(q)}; it must be {counted(robot.dof, 'number')}, or rows of them: {names}; "
            f"each finite and within ±{MAX_COORDINATE:g}"
        )
    return rows


def named_pose(robot: Robot, field: str, name: str) -> list[float]:
    """The planned joints' values in a named pose of the robot [rad] or [m].

    Raises InputError for an unknown name, and for a pose that lacks a value for a planned joint. The message
    names the field and lists the poses that have values for all planned joints.
    """
    complete = [pose for pose, values in robot.poses.items() if {*robot.joint_names} <= values.keys()]
    if not complete:
        expected = f"a list of {counted(robot.dof, 'number')}: {', '.join(robot.joint_names)}"
        raise InputError(
            f"{field} is {shown(name)}; it must be {expected} ({robot.name} has no named pose with values "
            "for all planned joints)"
        )
    if name not in robot.poses:
        raise unknown_name(f"pose in {field}:", name, complete)
    advice = f"; poses with all planned joints: {', '.join(complete)}"
    return robot.planned_values(f"{field}: the pose {name!r}", robot.poses[name], advice)


DIGITS = 9
"""Number of decimals to which numbers are rounded before hashing, since the last bits of rotations computed
from quaternions differ between machines."""


def hashed_content(names: object, *numbers: object) -> bytes:
    """Names and rounded arrays as bytes, the input of the hashes of robots, scenes and requests."""
    content = json.dumps(names).encode()
    for values in numbers:
        rounded = np.round(np.asarray(values, np.float64), DIGITS) + 0.0  # no negative zeros
        content += str(rounded.shape).encode() + rounded.tobytes()
    return content


def robot_fingerprint(robot: Robot) -> str:
    """A hash of the robot: the first 16 hexadecimal digits of a SHA-256, equal in every process.

    The hash covers base, tips, joints, limits, spheres, meshes, locked joints and allowed collisions. The
    robot's name is not part of it.
    """
    digest = hashlib.sha256()

    def add(names: object, *numbers: object) -> None:
        digest.update(hashed_content(names, *numbers))

    add([robot.base, *robot.tips])
    for joint in robot.joints:
        limits = [getattr(joint, name) for name in LIMITS]
        add([joint.name, joint.kind, joint.parent, joint.child], joint.T_parent_joint, joint.axis, limits)
        if joint.mimic is not None:
            add(joint.mimic.joint, joint.mimic[1:])
    for link in sorted(robot.spheres):
        add(link, robot.spheres[link])
    for link in sorted(robot.meshes):
        for mesh in robot.meshes[link]:
            add(link, mesh.vertices, mesh.faces)
    for name in sorted(robot.locked):
        add(name, robot.locked[name])
    add(sorted(sorted(pair) for pair in robot.allowed_collisions))
    return digest.hexdigest()[:16]
