"""Scene: the obstacles around a robot."""

from collections.abc import Iterable
from dataclasses import dataclass
from dataclasses import replace as dataclass_replace
from typing import no_type_check

from robotdiffuse.errors import InputError
from robotdiffuse.scenes.shapes import Shape


@no_type_check
@dataclass(frozen=True, eq=False)
class Scene:
    """Obstacles in the frame of the robot's base. Names are made unique by a number at the end."""

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
