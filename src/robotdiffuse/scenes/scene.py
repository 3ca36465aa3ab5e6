"""Scene: the static obstacles around a robot."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from dataclasses import replace as dataclass_replace
from typing import no_type_check

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.core.bounds import Value
from robotdiffuse.core.errors import InputError, joined, unknown_name
from robotdiffuse.core.transforms import inverse
from robotdiffuse.robots.kinematics import link_pose
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.shapes import Shape

SHOWN_NAMES = 5
"""Names of shapes in the text of a scene."""


@no_type_check
@dataclass(frozen=True, eq=False)
class Scene(Value):
    """Obstacles in the frame of the robot's base. A number is appended to names that are not unique."""

    shapes: tuple[Shape, ...] = ()

    def __init__(self, shapes: Iterable[Shape] = ()) -> None:
        named: list[Shape] = []
        taken, last = set[str](), dict[str, int]()
        for i, shape in enumerate(shapes):
            if not isinstance(shape, Shape):
                raise InputError(
                    f"scene[{i}] is a {type(shape).__name__}; it must be a shape, e.g. rd.Sphere"
                )
            name, number = shape.name, last.get(shape.name, 1)
            while name in taken:
                number += 1
                name = f"{shape.name}_{number}"
            taken.add(name)
            last[shape.name] = number
            named.append(shape if name == shape.name else dataclass_replace(shape, name=name))  # type: ignore[type-var]
        object.__setattr__(self, "shapes", tuple(named))

    def __repr__(self) -> str:
        count = f"{len(self.shapes)} shape" + ("" if len(self.shapes) == 1 else "s")
        names = joined((shape.name for shape in self.shapes), SHOWN_NAMES)
        return f"Scene({count}: {names})" if names else f"Scene({count})"

    def moved(self, T: Float[ndarray, "4 4"]) -> "Scene":
        """The scene after the rigid motion T."""
        return Scene([shape.moved(T) for shape in self.shapes])

    def attach(
        self,
        name: str,
        robot: Robot,
        q: Float[ndarray, "dof"],
        link: str | None = None,
        touch_links: Sequence[str] = (),
    ) -> tuple["Scene", Robot]:
        """The scene without an obstacle that the robot grasps at configuration q, and the robot holding it.

        link: the link that it is attached to, by default the robot's tip; touch_links: as in `Robot.attach`.
        Raises InputError for an unknown obstacle, and where `Robot.attach` does.
        """
        names = [shape.name for shape in self.shapes]
        if name not in names:
            raise unknown_name("obstacle to attach:", name, names)
        link = robot.tip if link is None else link
        robot.link_frame(link)  # raises InputError, with the known links, for an unknown one
        held = self.shapes[names.index(name)].moved(inverse(link_pose(robot, np.asarray(q, float), link)))
        return Scene([s for s in self.shapes if s.name != name]), robot.attach(held, link, touch_links)

    def detach(self, name: str, robot: Robot, q: Float[ndarray, "dof"]) -> tuple["Scene", Robot]:
        """The scene with an object that the robot releases at configuration q, and the robot without it."""
        freed = robot.detach(name)
        [body] = [body for body in robot.attached if body.name == name]
        T_base_link = link_pose(robot, np.asarray(q, float), body.link)
        left = [shape.moved(T_base_link) for shape in body.shapes if isinstance(shape, Shape)]
        return Scene([*self.shapes, *left]), freed
