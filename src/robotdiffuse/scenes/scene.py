"""Scene: the static obstacles around a robot; and moving obstacles, with a known trajectory, or with an
unknown motion of limited speed.

As with shapes, the constructors check their arguments themselves; scenes/shapes.py explains `no_type_check`.
"""

from collections.abc import Iterable, Mapping, Sequence
from copy import copy
from dataclasses import replace
from functools import cached_property
from types import NoneType
from typing import Any

import numpy as np

from robotdiffuse.core.errors import (
    InputError,
    bounded,
    check_name,
    check_type,
    counted,
    distinct,
    form,
    joined,
    located,
    numbers,
    rigid_motion,
    rigid_transform,
    shown,
    vector,
    within,
)
from robotdiffuse.core.transforms import (
    inverse,
    quaternion_from_rotation,
    rotation_angle,
    rotation_from_quaternion,
    transform,
)
from robotdiffuse.core.types import (
    ArrayOrNone,
    Configuration,
    Pose,
    Poses,
    Quaternion,
    Value,
    Values,
    VectorOrNone,
    check_increasing,
    frozen_dataclass,
    no_type_check,
    read_only,
    step_lengths,
)
from robotdiffuse.robots.robot import Robot, check_robot
from robotdiffuse.scenes.shapes import Box, Capsule, Cylinder, Mesh, Shape, Sphere

SHOWN_NAMES = 5
"""Largest number of names of shapes in the text of a scene (`repr`)."""
ALL_LINKS = "all"
"""Stands for all links of a robot in `Scene.allowed_contacts`."""
MAX_CONTACT_LINKS = 1000
"""Largest number of links that `Scene.allowed_contacts` may name for one obstacle."""

PLANE_SIZE = 10.0
"""Smallest length and width of the box that stands for a plane [m]."""
PLANE_DEPTH = 0.1
"""Thickness of the boxes that stand for planes [m]."""
MOVED = 1e-4
"""A larger change [m or rad] of a joint that places a MuJoCo robot counts as a motion of the robot."""


@no_type_check
@frozen_dataclass
class Scene(Value):
    """Obstacles in the frame of the robot's base.

    Allowed contacts are not collisions for searches, validators and certificates, and are left out of
    clearances.
    """

    shapes: tuple[Shape, ...] = ()
    """The obstacles, with different names."""
    allowed_contacts: tuple[tuple[str, tuple[str, ...] | str], ...] = ()
    """Names of obstacles, each with the names of links that may touch it, or ALL_LINKS."""

    def __init__(
        self,
        shapes: Iterable[Shape] = (),
        allowed_contacts: Mapping[str, Sequence[str] | str] | Iterable[tuple[str, Sequence[str] | str]] = (),
    ) -> None:
        """Check the shapes, and append a number to names that are not unique.

        Args:
            shapes: The obstacles.
            allowed_contacts: For obstacles by name, the links that may touch the obstacle, or "all", such as
                {"mug": ["panda_hand", "panda_leftfinger"], "table": "all"}. Held objects and tools are links
                too. If several shapes were given the same name, the name stands for all of them.

        Raises:
            InputError: For values that are not shapes; and for allowed contacts with unknown obstacles, with
                values other than lists of names or "all", and with more than 1000 links of one obstacle.
        """
        named = list[Shape]()
        names_in_use = set[str]()
        last = dict[str, int]()
        names_of = dict[str, list[str]]()
        if not np.iterable(shapes):
            raise InputError(f"scene is {shown(shapes)}; it must be a list of shapes, e.g. [rd.Sphere(...)]")
        for i, shape in enumerate(shapes):
            check_type(f"scene[{i}]", shape, Shape, "a shape, e.g. rd.Sphere")
            name = shape.name
            number = last.get(shape.name, 1)
            while name in names_in_use:
                number += 1
                name = f"{shape.name}_{number}"
            names_in_use.add(name)
            last[shape.name] = number
            names_of.setdefault(shape.name, []).append(name)
            named.append(shape if name == shape.name else replace(shape, name=name))  # type: ignore[type-var]
        object.__setattr__(self, "shapes", tuple(named))
        object.__setattr__(self, "allowed_contacts", _contacts(allowed_contacts, names_of, names_in_use))

    def __repr__(self) -> str:
        count = counted(len(self.shapes), "shape")
        names = joined((shape.name for shape in self.shapes), SHOWN_NAMES)
        return f"Scene({count}: {names})" if names else f"Scene({count})"

    @classmethod
    def from_mujoco(cls, model: Any, data: Any = None, base: str = "world") -> "Scene":
        """The obstacles of a MuJoCo model: all colliding geoms that are not part of the robot.

        Args:
            model: A compiled model, such as `mujoco.MjModel.from_xml_path` returns.
            data: State of the model, which gives the poses of free bodies; None: their poses in the model.
            base: The body that is the base of the robot; the scene is in its frame. A robot that `load_robot`
                reads from a model has the base "world".

        Returns:
            The scene. A plane, which is infinite in MuJoCo, becomes a box around the base, 0.1 m thick and at
            least 10 m long and wide. Meshes are replaced by their convex hulls, as MuJoCo does.

        Raises:
            InputError: For an unknown body, for soft bodies, height fields and signed distance fields, and if
                `base` is "world" and a free joint, or a slide without a range, has moved the robot.
        """
        return cls(_mujoco_shapes(model, data, base))

    def moved(self, T: Pose) -> "Scene":
        """Move all obstacles.

        Args:
            T: The rigid motion, a homogeneous transform [4, 4].

        Returns:
            The scene after the motion.

        Raises:
            InputError: For shapes that cannot be moved, and unless T is rigid.
        """
        return self.with_shapes([shape.moved(T) for shape in self.shapes])

    def with_shapes(self, shapes: Iterable[Shape]) -> "Scene":
        """Replace the shapes.

        Args:
            shapes: The obstacles of the new scene.

        Returns:
            A scene with these shapes. Allowed contacts of this scene are kept for shapes of the same name.

        Raises:
            InputError: For values that are not shapes.
        """
        scene = Scene(shapes)
        if self.allowed_contacts:
            names = {shape.name for shape in scene.shapes}
            contacts = tuple(contact for contact in self.allowed_contacts if contact[0] in names)
            object.__setattr__(scene, "allowed_contacts", contacts)
        return scene

    def may_touch(self, link: str, obstacle: str) -> bool:
        """Look up whether contact is allowed.

        Args:
            link: Name of a link or held object.
            obstacle: Name of an obstacle.

        Returns:
            Whether the link may touch the obstacle.

        Raises:
            InputError: For names that are not texts.
        """
        for what, name in (("link", link), ("obstacle", obstacle)):
            check_type(what, name, str, "a name")
        links = self._links_that_touch.get(obstacle, ())
        return links == ALL_LINKS or link in links

    @cached_property
    def _links_that_touch(self) -> dict[str, tuple[str, ...] | str]:
        return dict(self.allowed_contacts)

    def attach(
        self,
        name: str,
        robot: Robot,
        q: Configuration,
        link: str | None = None,
        touch_links: Sequence[str] = (),
    ) -> tuple["Scene", Robot]:
        """Let the robot grasp an obstacle of the scene.

        Args:
            name: Name of the obstacle.
            robot: The robot.
            q: Configuration at which the robot grasps the obstacle [dof].
            link: The link that holds the obstacle; None: the tip of the robot.
            touch_links: Further links that the obstacle may touch.

        Returns:
            The scene without the obstacle, and the robot holding the obstacle.

        Raises:
            InputError: For an unknown obstacle, and in the cases in which `Robot.attach` raises it.
        """
        check_robot(robot)
        obstacles = {shape.name: shape for shape in self.shapes}
        check_name("obstacle to attach:", name, obstacles)
        link = robot.tip if link is None else link
        taken_shape = obstacles.pop(name).moved(inverse(robot.fk(q, link)))
        return self.with_shapes(obstacles.values()), robot.attach(taken_shape, link, touch_links)

    def detach(self, name: str, robot: Robot, q: Configuration) -> tuple["Scene", Robot]:
        """Let the robot release a held object.

        Args:
            name: Name of the held object.
            robot: The robot that holds the object.
            q: Configuration at which the robot releases the object [dof].

        Returns:
            The scene with the object, and the robot without the object.

        Raises:
            InputError: For an unknown name, an object to which a body is attached, and one that is no shape.
        """
        check_robot(robot)
        robot_without = robot.detach(name)
        [body] = [body for body in robot.attached if body.name == name]
        T_base_link = robot.fk(q, body.link)
        # with_shapes refuses objects of other classes, which a robot can hold too
        released = [shape.moved(T_base_link) if isinstance(shape, Shape) else shape for shape in body.shapes]
        scene = self.with_shapes([*self.shapes, *released])  # type: ignore[list-item]
        return without_link(scene, name), robot_without


def without_link(scene: Scene, link: str) -> Scene:
    """The scene without the allowed contacts of a link, such as a held object that was released."""
    contacts = [
        (obstacle, links if links == ALL_LINKS else [other for other in links if other != link])
        for obstacle, links in scene.allowed_contacts
    ]
    return Scene(scene.shapes, contacts)


def added(scene: Scene, shapes: Iterable[Shape]) -> Scene:
    """The scene with further obstacles."""
    return scene.with_shapes([*scene.shapes, *shapes])


def contact_notes(scene: Scene) -> tuple[str, ...]:
    """One note per obstacle that links may touch."""
    return tuple(
        f"contact of {name} with {'all links' if links == ALL_LINKS else joined(links)} is allowed"
        for name, links in scene.allowed_contacts
    )


def _contacts(
    allowed: object, names_of: dict[str, list[str]], names: set[str]
) -> tuple[tuple[str, tuple[str, ...] | str], ...]:
    """Checks allowed contacts and returns `Scene.allowed_contacts`. `names_of`: for each name that shapes
    were given, the unique names of these shapes. `names`: all unique names."""
    try:
        entries = allowed.items() if isinstance(allowed, Mapping) else [(a, b) for a, b in allowed]  # type: ignore
    except (TypeError, ValueError):
        raise InputError(
            f"allowed_contacts is {shown(allowed)}; it must map obstacles to lists of links or {ALL_LINKS!r}"
        ) from None
    by_name = dict[str, dict[str | None, None]]()  # dictionaries as ordered sets; None: all links
    for obstacle, links in entries:
        check_name("obstacle in allowed_contacts:", obstacle, names)
        every = isinstance(links, str) and links == ALL_LINKS
        listed = isinstance(links, list | tuple) and all(isinstance(link, str) for link in links)
        if not every and not listed:
            raise InputError(
                f"allowed_contacts: {obstacle} has {shown(links)}; "
                f"it must be a list of links or {ALL_LINKS!r}"
            )
        for name in names_of.get(obstacle, [obstacle]):
            touching = by_name.setdefault(name, {})
            touching.update(dict.fromkeys([None] if every else links))
            if len(touching) > MAX_CONTACT_LINKS:
                raise InputError(
                    f"allowed_contacts: {shown(name)} has over {MAX_CONTACT_LINKS} links; write {ALL_LINKS!r}"
                )
    return tuple(
        (name, ALL_LINKS if None in touching else tuple(touching))  # type: ignore[arg-type]
        for name, touching in by_name.items()
        if touching
    )


def _mujoco_shapes(model: Any, data: Any, base: str) -> list[Shape]:
    from robotdiffuse.robots.parsing import mjcf

    mujoco = mjcf.imported_mujoco()
    check_type("model", model, mujoco.MjModel, "a model, e.g. of mujoco.MjModel.from_xml_path(file)")
    check_type("data", data, (mujoco.MjData, NoneType), "a mujoco.MjData or None")
    if model.nflex:
        flex = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_FLEX, 0)
        raise InputError(f"flex {flex} is soft; obstacles must be rigid: use geoms in its place")
    if data is not None and data.signature != model.signature:
        raise InputError("data is of another model; make it anew: mujoco.MjData(model)")
    placed = mujoco.MjData(model) if data is None else copy(data)
    mujoco.mj_kinematics(model, placed)
    bodies = [model.body(k).name for k in range(model.nbody)]
    check_name("body", base, bodies)
    base_body = bodies.index(base)
    robot_bodies = mjcf.robot_bodies(model)
    if base == "world":
        placing = np.isin(model.dof_jntid, [*mjcf.placing_joints(model, robot_bodies)])
        change = np.zeros(model.nv)
        mujoco.mj_differentiatePos(model, change, 1.0, model.qpos0, placed.qpos)
        if (np.abs(change[placing]) > MOVED).any():
            raise InputError(
                "data moves the robot, but a robot is loaded where the model places it; take a body that "
                "moves with the robot as the base, here by base=BODY and in `robot add` by --base BODY"
            )
    T_base_world = inverse(transform(placed.xpos[base_body], placed.xmat[base_body].reshape(3, 3)))
    colliding = mjcf.colliding_geoms(model)
    shapes = list[Shape]()
    for geom in range(model.ngeom):
        body = int(model.geom_bodyid[geom])
        if body in robot_bodies or not colliding[geom]:
            continue
        name = model.geom(geom).name or bodies[body] or f"geom{geom}"
        T = T_base_world @ transform(placed.geom_xpos[geom], placed.geom_xmat[geom].reshape(3, 3))
        center = T[:3, 3]
        wxyz = quaternion_from_rotation(T)
        size = model.geom_size[geom]
        match mjcf.kind_of("Geom", model.geom_type[geom]):
            case "plane":
                normal = T[:3, 2]
                below = normal * (normal @ center - PLANE_DEPTH / 2)  # centered under the base
                shapes.append(Box(below, [*np.maximum(2 * size[:2], PLANE_SIZE), PLANE_DEPTH], wxyz, name))
            case "sphere":
                shapes.append(Sphere(center, float(size[0]), name))
            case "box":
                shapes.append(Box(center, 2 * size, wxyz, name))
            case "capsule" | "cylinder" as kind:
                shape = Capsule if kind == "capsule" else Cylinder
                shapes.append(shape(center, float(size[0]), float(2 * size[1]), wxyz, name))
            case "ellipsoid" | "mesh" as kind:  # MuJoCo collides with the hull
                solid = (
                    mjcf.ellipsoid(size)
                    if kind == "ellipsoid"
                    else mjcf.mesh_of(model, int(model.geom_dataid[geom])).convex_hull
                )
                shapes.append(Mesh(solid.vertices, solid.faces, center, wxyz, name=name))
            case kind:
                raise InputError(
                    f"geom {name} is of type {kind}; obstacles may be planes, spheres, capsules, ellipsoids, "
                    "cylinders, boxes and meshes"
                )
    return shapes


MAX_POINT_SPEED = 100.0
"""Largest allowed speed of a point of an obstacle [m/s]; a faster motion between two poses counts as a
jump."""
MAX_DURATION = 1e5
"""Duration for which a constant velocity lasts, and largest absolute value of `times` [s]: about a day. The
validator refuses longer motions."""
RIGID_SLACK = 1e-6
"""Largest deviation of a pose from a rigid transform."""
POSE_TOLERANCE = 1e-6
"""Largest difference between the first pose and the pose of the shape [m], [rad]."""


@no_type_check
@frozen_dataclass
class MovingObstacle(Value):
    """A shape in the frame of the robot's base, and one of three motions.

    Args:
        shape: The shape at time 0, or at the first of the times; not a point cloud, which has no frame of its
            own.
        velocity: From time 0 on, the shape moves at this constant velocity for 1e5 s, and keeps its
            orientation [m/s].
        times: Times of the poses [n], increasing [s].
        poses: T_base_shape at each time [n, 4, 4]; the first is the pose of the shape. Between the times, the
            shape moves on straight lines at constant speed and turns at a constant rate. Before the first and
            after the last time it stands still.
        max_speed: The motion is unknown, but no point of the shape is faster than this [m/s].

    Raises:
        InputError: Unless exactly one motion is given: velocity, times and poses, or max_speed; for wrong
            values; and for poses that jump, so that a point may be faster than 100 m/s.
    """

    shape: Shape
    velocity: VectorOrNone = None  # pyright: ignore[reportAssignmentType]
    times: ArrayOrNone = None  # pyright: ignore[reportAssignmentType]
    poses: ArrayOrNone = None  # pyright: ignore[reportAssignmentType]
    max_speed: float | None = None

    def __post_init__(self) -> None:
        check_type("moving: shape", self.shape, Shape, "a shape, e.g. rd.Sphere")
        _ = self.shape.T_base_shape  # raises InputError for shapes that have no frame
        motions = {
            "velocity": self.velocity is not None,
            "times and poses": self.times is not None or self.poses is not None,
            "max_speed": self.max_speed is not None,
        }
        motions_set = [name for name, has in motions.items() if has]
        if len(motions_set) != 1:
            raise InputError(
                f"moving obstacle {self.name!r} has {' and '.join(motions_set) or 'no motion'}; it must have "
                "exactly one of velocity, times and poses, max_speed"
            )
        if self.velocity is not None:
            object.__setattr__(
                self, "velocity", vector(self.name, "velocity", self.velocity, 3, MAX_POINT_SPEED)
            )
        elif self.max_speed is not None:
            wanted = f"a speed from 0 to {MAX_POINT_SPEED:g} m/s"
            speed = bounded(f"{self.name}.max_speed", self.max_speed, (), 0.0, MAX_POINT_SPEED, wanted)
            object.__setattr__(self, "max_speed", float(speed))
        else:
            self._check_track()
        super().__post_init__()

    def _check_track(self) -> None:
        """Sets `times` and `poses` to arrays. Raises InputError unless times increase, all poses are rigid
        transforms, the first is the pose of the shape, and there are no jumps."""
        times = numbers(self.times)
        poses = numbers(self.poses)
        if times is None or times.ndim != 1 or len(times) < 2 or not within(times, MAX_DURATION):
            raise InputError(
                f"{self.name}.times is {shown(self.times)}; it must be two or more times within "
                f"±{MAX_DURATION:g} s, one for each of the poses"
            )
        with located(self.name):
            check_increasing(times)
        if poses is None or poses.shape != (len(times), 4, 4):
            raise InputError(
                f"{self.name}.poses is {form(poses)}; it must be {len(times)} transforms of 4 x 4, one for "
                f"each time"
            )
        for i, T in enumerate(poses):
            rigid_transform(f"{self.name}.poses[{i}]", T, RIGID_SLACK)
        object.__setattr__(self, "times", times)
        object.__setattr__(self, "poses", poses)
        T_shape_first = inverse(self.shape.T_base_shape) @ poses[0]
        if (
            np.linalg.norm(T_shape_first[:3, 3]) > POSE_TOLERANCE
            or rotation_angle(T_shape_first[:3, :3]) > POSE_TOLERANCE
        ):
            raise InputError(
                f"{self.name}.poses[0] is at {shown(poses[0, :3, 3])}; it must be the pose of the shape, "
                f"whose position is {shown(self.shape.T_base_shape[:3, 3])}"
            )
        speeds = track_speeds(times, poses, self.radius)
        jumps = np.flatnonzero(speeds > MAX_POINT_SPEED)
        if len(jumps):
            i = int(jumps[0])
            begins, ends = distinct(times[i], times[i + 1])
            speed, limit = distinct(speeds[i], MAX_POINT_SPEED, digits=3)
            raise InputError(
                f"{self.name}.poses[{i + 1}] is a jump: from {begins} s to {ends} s a point moves at {speed} "
                f"m/s; the limit is {limit} m/s"
            )

    @property
    def name(self) -> str:
        return self.shape.name

    @property
    def known(self) -> bool:
        """Whether the obstacle's motion is known."""
        return self.max_speed is None

    @cached_property
    def radius(self) -> float:
        """Upper bound on the distance of the shape's points from the origin of its frame [m]."""
        low, high = self.shape.moved(inverse(self.shape.T_base_shape)).bounds
        return float(np.linalg.norm(np.maximum(np.abs(low), np.abs(high))))

    @cached_property
    def track(self) -> tuple[Values, Poses]:
        """Times [s], and the poses T_base_shape at these times. Between them, the obstacle moves at constant
        rates; before the first and after the last it stands still.

        If the motion is unknown, the track is the pose at time 0 only.
        """
        T = self.shape.T_base_shape
        if self.velocity is not None:
            poses = np.stack([T, transform(self.velocity * MAX_DURATION) @ T])
            return read_only((np.array([0.0, MAX_DURATION]), poses))
        if self.times is not None and self.poses is not None:
            return self.times, self.poses
        return read_only((np.zeros(1), T[None]))

    @property
    def top_speed(self) -> float:
        """Speed that no point of the obstacle exceeds at any time [m/s]."""
        if self.max_speed is not None:
            return self.max_speed
        return float(track_speeds(*self.track, self.radius).max(initial=0.0))

    def pose(self, time: float) -> Pose:
        """T_base_shape at a time.

        Args:
            time: Time since the motion begins [s].

        Returns:
            The pose [4, 4]; if the motion is unknown, the pose at time 0.

        Raises:
            InputError: For a time that is not a finite number.
        """
        at = numbers(time)
        if at is None or at.ndim or not np.isfinite(at):
            raise InputError(f"time is {shown(time)}; it must be a finite number [s]")
        times, poses = self.track
        if len(times) == 1:
            return poses[0]
        i = int(np.clip(np.searchsorted(times, at, side="right") - 1, 0, len(times) - 2))
        fraction = float(np.clip((at - times[i]) / (times[i + 1] - times[i]), 0.0, 1.0))
        xyz = poses[i, :3, 3] + fraction * (poses[i + 1, :3, 3] - poses[i, :3, 3])
        if np.array_equal(poses[i, :3, :3], poses[i + 1, :3, :3]):
            return transform(xyz, poses[i, :3, :3])
        a, b = (quaternion_from_rotation(poses[k]) for k in (i, i + 1))
        return transform(xyz, rotation_from_quaternion(_slerp(a, b, fraction)))

    def at(self, time: float) -> Shape:
        """Place the shape at its pose at a time.

        Args:
            time: Time since the motion begins [s].

        Returns:
            The shape; if the motion is unknown, at its pose at time 0.

        Raises:
            InputError: For a time that is not a finite number.
        """
        return self.shape.moved(self.pose(time) @ inverse(self.shape.T_base_shape))

    def moved(self, T: Pose) -> "MovingObstacle":
        """Move the obstacle together with its own motion.

        Args:
            T: The rigid motion, a homogeneous transform [4, 4].

        Returns:
            The obstacle after the rigid motion.

        Raises:
            InputError: Unless T is rigid.
        """
        T = rigid_motion(T)
        velocity = None if self.velocity is None else T[:3, :3] @ self.velocity
        shape = self.shape.moved(T)
        # a sphere's frame does not turn with it
        between = inverse(T @ self.shape.T_base_shape) @ shape.T_base_shape
        poses = None if self.poses is None else T @ self.poses @ between
        return replace(self, shape=shape, velocity=velocity, poses=poses)


def track_speeds(times: Values, poses: Poses, radius: float) -> Values:
    """Upper bounds on the speed between successive times [m/s], for points within `radius` [m] of the origin
    of the moving frame."""
    distances_between = step_lengths(poses[:, :3, 3])
    turns = [rotation_angle(a.T @ b) for a, b in zip(poses[:-1, :3, :3], poses[1:, :3, :3], strict=True)]
    return (distances_between + radius * np.array(turns)) / np.diff(times)


def _slerp(a: Quaternion, b: Quaternion, fraction: float) -> Quaternion:
    """The unit quaternion at a fraction of the shorter rotation from a to b."""
    b = b if a @ b >= 0 else -b
    angle = 2 * np.arctan2(np.linalg.norm(a - b), np.linalg.norm(a + b))
    if angle < 1e-9:
        return b
    return (np.sin((1 - fraction) * angle) * a + np.sin(fraction * angle) * b) / np.sin(angle)
