"""Tools, and objects that a robot holds: bodies fixed to its links, as links of a robot of their own.

A robot that holds something is another robot: it has one more link, with convex meshes for the validator, spheres
that cover them for the search, and pairs that are checked. Its joints are the same, so weights for the bare
arm are weights for it. The same content gives the same object, whose arrays are made once.
"""

from collections.abc import Sequence
from dataclasses import fields, replace
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.core.errors import InputError, unknown_name
from robotdiffuse.core.transforms import inverse
from robotdiffuse.robots.bodies import TOOL, Attached, ConvexMesh, Rigid
from robotdiffuse.robots.fitting.covering_spheres import cover
from robotdiffuse.robots.robot import Joint, Robot

VARIANTS = 64
"""Robots with attached bodies that are kept, the last ones used."""


def attach(robot: Robot, body: Attached) -> Robot:
    """The robot with a body. Raises InputError for unknown links, a link that no planned joint moves, a name
    that a link has, and for shapes that cannot be held."""
    what = TOOL if body.tool else "attached"
    moved = [link for link in robot.link_names if robot.link_frame(link) > 0]
    if body.link not in robot.link_names:
        raise unknown_name(f"link in {what}.link:", str(body.link), moved)
    if body.link not in moved:
        raise InputError(
            f"{what}.link is {body.link}, which no planned joint moves; these are moved: {', '.join(moved)}"
        )
    if body.name in robot.link_names:
        raise InputError(
            f"{what}.name is {body.name!r}, which is a link of {robot.name}; give it another name"
        )
    for link in body.touch_links:
        if link not in robot.link_names:
            raise unknown_name(f"link in {what}.touch_links:", str(link), robot.link_names)
    return _attached(robot, _Key(body))


def attached_again(robot: Robot, bodies: Sequence[Attached]) -> Robot:
    """The robot with all of the bodies, in their order."""
    for body in bodies:
        robot = attach(robot, body)
    return robot


def detach(robot: Robot, name: str) -> Robot:
    """The robot without the body of that name. Raises InputError for an unknown one, and for one that holds
    another."""
    names = [body.name for body in robot.attached]
    if name not in names:
        raise unknown_name("body to detach:", name, names)
    holds = [body.name for body in robot.attached if body.link == name]
    if holds:
        raise InputError(f"{name} cannot be detached: it holds {', '.join(holds)}; detach that first")
    left = [
        replace(body, touch_links=tuple(link for link in body.touch_links if link != name))
        for body in robot.attached
        if body.name != name
    ]
    return attached_again(robot.arm, left)


def _content(value: Any) -> object:
    """What tells two values apart that are not the same object."""
    if isinstance(value, ndarray):
        return value.shape, value.tobytes()
    if hasattr(value, "__dataclass_fields__"):
        return type(value), *(_content(getattr(value, f.name)) for f in fields(value))
    return tuple(map(_content, value)) if isinstance(value, tuple) else value


class _Key:
    """A body that equals others of the same content."""

    def __init__(self, body: Attached) -> None:
        self.body, self._content = body, _content(body)

    def __hash__(self) -> int:
        return hash(self._content)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Key) and self._content == other._content


class _Geometry(NamedTuple):
    meshes: tuple[ConvexMesh, ...]
    spheres: Float[ndarray, "n 4"]


def _geometry(body: Attached) -> _Geometry:
    """Meshes and the spheres that cover them, in the body's frame."""
    T_body_link = inverse(body.T_link_body)
    meshes: list[ConvexMesh] = []
    spheres: list[ndarray] = [np.zeros((0, 4))]
    for shape in body.shapes:
        T_link_shape, parts = shape.solid()
        T = T_body_link @ T_link_shape
        for part in parts:
            meshes.append(ConvexMesh(part.vertices @ T[:3, :3].T + T[:3, 3], part.faces))
            around = cover(part)
            spheres.append(np.column_stack([around[:, :3] @ T[:3, :3].T + T[:3, 3], around[:, 3]]))
    return _Geometry(tuple(meshes), np.concatenate(spheres))


@lru_cache(maxsize=VARIANTS)
def _attached(robot: Robot, key: _Key) -> Robot:
    body = key.body
    geometry = _geometry(body)
    joint = Joint(
        f"{body.link}_to_{body.name}",
        "fixed",
        body.link,
        body.name,
        body.T_link_body,
        np.array([0.0, 0.0, 1.0]),
    )
    has = {body.name: geometry} if body.shapes else {}
    # the tip is what goals and pictures are about; a tool on another branch than the tip's is not it
    frame = robot.link_frame(body.link) if body.tool and robot.at_end(body.link) else -1
    tip, *others = [body.name if robot.link_frame(tip) == frame else tip for tip in robot.tips]
    return replace(
        robot,
        joints=(*robot.joints, joint),
        spheres=robot.spheres | {name: of.spheres for name, of in has.items()},
        meshes=robot.meshes | {name: of.meshes for name, of in has.items()},
        allowed_collisions=robot.allowed_collisions
        | {frozenset((body.name, link)) for link in body.touch_links},
        tip=tip,
        other_tips=tuple(others),
        attached=(*robot.attached, body),
        bare=robot.arm,
    )


def holding(robot: Robot, shape: Rigid, link: str, touch_links: Sequence[str] = ()) -> Robot:
    """See `Robot.attach`."""
    if not hasattr(shape, "solid"):
        raise InputError(f"attached is a {type(shape).__name__}; it must be a shape, e.g. rd.Box")
    body = Attached(shape.name, link, shape.solid()[0], (shape,), tuple(touch_links))
    return attach(robot, body)


def with_tool(
    robot: Robot,
    link: str,
    T_link_tool: Float[ndarray, "4 4"],
    shapes: Sequence[Rigid],
    touch_links: Sequence[str],
    name: str,
) -> Robot:
    """See `Robot.with_tool`."""
    has = [body.name for body in robot.attached if body.tool]
    if has:
        raise InputError(f"tool: the robot has the tool {has[0]!r} already; detach it first")
    T = np.asarray(T_link_tool, np.float64)
    return attach(robot, Attached(name, link, T, tuple(shapes), tuple(touch_links), tool=True))
