"""Scene: the static obstacles around a robot."""

from collections.abc import Iterable, Mapping, Sequence
from copy import copy
from dataclasses import replace as dataclass_replace
from functools import cached_property
from types import NoneType
from typing import Any

import numpy as np

from robotdiffuse.core.errors import InputError, check_name, check_type, counted, joined, shown, unknown_name
from robotdiffuse.core.transforms import inverse, quaternion_from_rotation, transform
from robotdiffuse.core.types import Configuration, Pose, Value, frozen_dataclass, no_type_check
from robotdiffuse.robots.robot import Robot, check_robot
from robotdiffuse.scenes.shapes import Box, Capsule, Cylinder, Mesh, Shape, Sphere

SHOWN_NAMES = 5
"""Largest number of names of shapes in the text of a scene (`repr`)."""
ALL_LINKS = "all"
"""Stands for all links of a robot in `Scene.allowed_contacts`."""
MAX_CONTACT_LINKS = 1000
"""Largest number of links that `Scene.allowed_contacts` may name for one obstacle."""

PLANE_SIZE = 10.0
"""Smallest edge of the box that stands for a plane [m]."""
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
            InputError: For values that are not shapes, and for allowed contacts with unknown obstacles.
        """
        named: list[Shape] = []
        names_in_use = set[str]()
        last = dict[str, int]()
        names_of = dict[str, list[str]]()
        if not isinstance(shapes, Iterable):
            raise InputError(f"scene is {shown(shapes)}; it must be a list of shapes, e.g. [rd.Sphere(...)]")
        for i, shape in enumerate(shapes):
            if not isinstance(shape, Shape):
                raise InputError(f"scene[{i}] is {shown(shape)}; it must be a shape, e.g. rd.Sphere")
            name = shape.name
            number = last.get(shape.name, 1)
            while name in names_in_use:
                number += 1
                name = f"{shape.name}_{number}"
            names_in_use.add(name)
            last[shape.name] = number
            names_of.setdefault(shape.name, []).append(name)
            named.append(shape if name == shape.name else dataclass_replace(shape, name=name))  # type: ignore[type-var]
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
            The scene. A plane, which collides without end in MuJoCo, becomes a box with edges of at least
            10 m around the base. Meshes are replaced by their convex hulls, as MuJoCo does.

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
        """
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
        return self.with_shapes([*self.shapes, *released]), robot_without  # type: ignore[list-item]


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
    by_name: dict[str, dict[str | None, None]] = {}  # dictionaries as ordered sets; None: all links
    for obstacle, links in entries:
        if not isinstance(obstacle, str) or (obstacle not in names_of and obstacle not in names):
            raise unknown_name("obstacle in allowed_contacts:", obstacle, names)
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
                "data moves the robot, which is held where the model places it; take a body that moves with "
                "it as the base, here by base=BODY and in `robot add` by --base BODY"
            )
    T_base_world = inverse(transform(placed.xpos[base_body], placed.xmat[base_body].reshape(3, 3)))
    colliding = mjcf.colliding_geoms(model)
    shapes: list[Shape] = []
    for geom in range(model.ngeom):
        body = int(model.geom_bodyid[geom])
        if body in robot_bodies or not colliding[geom]:
            continue
        name = model.geom(geom).name or bodies[body] or f"geom{geom}"
        T = T_base_world @ transform(placed.geom_xpos[geom], placed.geom_xmat[geom].reshape(3, 3))
        center = T[:3, 3]
        wxyz = quaternion_from_rotation(T[:3, :3])
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
