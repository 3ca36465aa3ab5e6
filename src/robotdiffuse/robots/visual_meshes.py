"""Visual meshes for drawing robots. Planning and validation never use them."""

from importlib.resources import as_file, files

import numpy as np
from jaxtyping import UInt8
from numpy import ndarray

from robotdiffuse.core.types import frozen_dataclass
from robotdiffuse.robots.bodies import Surface
from robotdiffuse.robots.robot import Robot

UNIT = 5e-5
"""Resolution of stored vertices [m]."""
MAX_BOX_DIFFERENCE = 0.03
"""A visual mesh of a moving link is used only if its bounding box and that of collision geometry differ by
less than this [m]."""
LINK_COLOR = (236, 238, 240)
# sRGB colors of held objects and of tools
HELD_COLOR = (0xE3, 0xB2, 0x3C)
TOOL_COLOR = (0xB0, 0xB6, 0xBE)


@frozen_dataclass
class VisualMesh(Surface):
    """A triangle mesh in the frame of its link [m], with one sRGB color per face."""

    colors: UInt8[ndarray, "f 3"]


def load_visual(robot: Robot) -> dict[str, tuple[VisualMesh, ...]]:
    """Meshes to draw, by link: the bundled visual mesh, else the convex collision meshes, else the spheres.

    A bundled mesh is not used if its size differs from that of the link's collision geometry, so that
    pictures show the robot that was planned for. On links that no planned joint moves, the mesh may be
    smaller.
    """
    bundled = _read_bundled(robot.name)
    meshes = dict[str, tuple[VisualMesh, ...]]()
    colors = {body.name: TOOL_COLOR if body.tool else HELD_COLOR for body in robot.attached}
    for link in robot.link_names:
        collision = _collision_geometry(robot, link, colors.get(link, LINK_COLOR))
        visual = bundled.get(link)
        if visual is not None and (not collision or _agree(visual, collision, robot.link_frame(link) > 0)):
            meshes[link] = (visual,)
        elif collision:
            meshes[link] = collision
    return meshes


def _collision_geometry(robot: Robot, link: str, color: tuple[int, int, int]) -> tuple[VisualMesh, ...]:
    if robot.meshes.get(link):
        return tuple(_plain(mesh.vertices, mesh.faces, color) for mesh in robot.meshes[link])
    if len(robot.spheres.get(link, ())) == 0:
        return ()
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=3)
    return tuple(_plain(s[:3] + s[3] * ball.vertices, ball.faces, color) for s in robot.spheres[link])


def _plain(vertices: ndarray, faces: ndarray, color: tuple[int, int, int]) -> VisualMesh:
    colors = np.tile(np.array(color, np.uint8), (len(faces), 1))
    return VisualMesh(vertices, faces, colors)


def _agree(visual: VisualMesh, collision: tuple[VisualMesh, ...], both_ways: bool) -> bool:
    """Whether the bounding boxes agree. Unless `both_ways`, the visual mesh may be smaller."""
    points = np.concatenate([mesh.vertices for mesh in collision])
    beyond = np.array([points.min(0) - visual.vertices.min(0), visual.vertices.max(0) - points.max(0)])
    return bool((np.abs(beyond) if both_ways else beyond).max() < MAX_BOX_DIFFERENCE)


def has_visual(robot: Robot) -> bool:
    """Whether visual meshes of the robot are bundled; else `load_visual` returns its collision geometry."""
    return bool(_read_bundled(robot.name))


def _read_bundled(name: str) -> dict[str, VisualMesh]:
    resource = files("robotdiffuse.robots") / "data" / name / "visual.npz"
    if not name.isidentifier() or not resource.is_file():
        return {}
    with as_file(resource) as file, np.load(file) as arrays:
        links = sorted({key.split("/")[0] for key in arrays})
        return {
            link: VisualMesh(
                arrays[f"{link}/vertices"] * UNIT,
                arrays[f"{link}/faces"].astype(np.int64),
                arrays[f"{link}/palette"][arrays[f"{link}/color"]],
            )
            for link in links
        }
