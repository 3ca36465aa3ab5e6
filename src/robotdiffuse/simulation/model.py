"""Writes the files that PyBullet loads: robots with masses, point clouds, and coloured surfaces."""

from pathlib import Path
from xml.etree import ElementTree as Xml

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from robotdiffuse.core.transforms import rpy_from_rotation
from robotdiffuse.robots.robot import MOVING_KINDS, ConvexMesh, Joint, Robot
from robotdiffuse.robots.visual_meshes import VisualMesh, load_visual

MIN_MASS, MIN_INERTIA = 0.01, 1e-4
"""Smallest mass and inertia of a link [kg], [kg m^2]; PyBullet cannot move a link without mass."""
CREASE_ANGLE = np.radians(38)
"""Edges with a larger angle between their faces are drawn sharp [rad]."""


def write_urdf(robot: Robot, folder: Path, density: float, visuals: bool) -> Path:
    """Write the robot as a URDF with its convex meshes and uniform density [kg/m^3]; returns the file in
    `folder`.

    With `visuals`, links also get the surfaces that the viewer draws. Joints that planning does not move keep
    their kind but lose their limits, because published problems open grippers wider than their URDF allows.
    """
    root = Xml.Element("robot", name="robot")
    visual_meshes = load_visual(robot) if visuals else {}
    for link in robot.link_names:
        element = Xml.SubElement(root, "link", name=link)
        meshes = robot.meshes.get(link, ())
        _add_inertia(element, meshes, density)
        for i, mesh in enumerate(meshes):
            file = folder / f"{link}_{i}.obj"
            write_obj(file, mesh.vertices, mesh.faces)
            _add_mesh(element, "collision", file)
        _add_visuals(element, visual_meshes.get(link, ()), folder / link)
    for joint in robot.joints:
        _add_joint(root, joint, joint.name in robot.joint_names)
    return _write_tree(root, folder / "robot.urdf")


def write_points_urdf(
    points: Float[ndarray, "n 3"], radius: float, color: tuple[int, int, int] | None, folder: Path
) -> Path:
    """Write one link with a sphere for each point; with a colour, also octahedra for cameras. Returns the
    file."""
    root = Xml.Element("robot", name="points")
    element = Xml.SubElement(root, "link", name="points")
    _add_inertia(element, (), 0.0)
    for point in points:
        collision = Xml.SubElement(element, "collision")
        Xml.SubElement(collision, "origin", xyz=_numbers(point))
        Xml.SubElement(Xml.SubElement(collision, "geometry"), "sphere", radius=_numbers([radius]))
    if color is not None and len(points):
        axes = np.concatenate([np.eye(3), -np.eye(3)])
        faces = [[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2], [1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5]]
        many = np.array(faces) + 6 * np.arange(len(points))[:, None, None]
        vertices = (points[:, None] + radius * axes).reshape(-1, 3)
        write_obj(folder / "points.obj", vertices, many.reshape(-1, 3), np.tile(axes, (len(points), 1)))
        _add_color(_add_mesh(element, "visual", folder / "points.obj"), np.array(color))
    return _write_tree(root, folder / "points.urdf")


def write_obj(
    file: Path,
    vertices: Float[ndarray, "v 3"],
    faces: Int[ndarray, "f 3"],
    normals: Float[ndarray, "v 3"] | None = None,
) -> None:
    """Write a triangle mesh as a Wavefront file; with normals, renderers shade it smoothly."""
    lines = [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in vertices.tolist()]
    if normals is None:
        lines += [f"f {a} {b} {c}" for a, b, c in (faces + 1).tolist()]
    else:
        lines += [f"vn {x:.4f} {y:.4f} {z:.4f}" for x, y, z in normals.tolist()]
        lines += [f"f {a}//{a} {b}//{b} {c}//{c}" for a, b, c in (faces + 1).tolist()]
    file.write_text("\n".join(lines) + "\n")


def write_shaded(file: Path, vertices: Float[ndarray, "v 3"], faces: Int[ndarray, "f 3"]) -> None:
    """Write a triangle mesh as a Wavefront file with normals, smooth except at sharp edges."""
    import trimesh

    solid = trimesh.Trimesh(vertices, faces, process=False)
    smooth = trimesh.graph.smooth_shade(solid, angle=CREASE_ANGLE)
    write_obj(
        file, np.array(smooth.vertices), np.array(smooth.faces, np.int64), np.array(smooth.vertex_normals)
    )


def mass_properties(
    meshes: tuple[ConvexMesh, ...], density: float
) -> tuple[float, Float[ndarray, "3"], Float[ndarray, "3 3"]]:
    """Mass [kg], centre of mass [m] and inertia about it [kg m^2] of solids in the link frame.

    Overlapping solids count twice where they overlap.
    """
    import trimesh

    parts = []
    for mesh in meshes:
        solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).mass_properties
        sign = np.sign(solid.volume)  # negative if the faces point inwards
        parts.append((sign * density * solid.volume, solid.center_mass, sign * density * solid.inertia))
    total = float(sum(mass for mass, _, _ in parts))
    if total < MIN_MASS:
        return MIN_MASS, np.zeros(3), MIN_INERTIA * np.eye(3)
    center = sum((mass * at for mass, at, _ in parts), np.zeros(3)) / total
    inertia = MIN_INERTIA * np.eye(3)
    for mass, at, own in parts:
        arm = at - center
        inertia = inertia + own + mass * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    return total, center, inertia


def _add_inertia(element: Xml.Element, meshes: tuple[ConvexMesh, ...], density: float) -> None:
    mass, center, I = mass_properties(meshes, density)  # noqa: E741 (the symbol of inertia)
    inertial = Xml.SubElement(element, "inertial")
    Xml.SubElement(inertial, "origin", xyz=_numbers(center))
    Xml.SubElement(inertial, "mass", value=_numbers([mass]))
    entries = {"ixx": I[0, 0], "ixy": I[0, 1], "ixz": I[0, 2], "iyy": I[1, 1], "iyz": I[1, 2], "izz": I[2, 2]}
    Xml.SubElement(inertial, "inertia", {key: _numbers([value]) for key, value in entries.items()})


def _add_mesh(element: Xml.Element, use: str, file: Path) -> Xml.Element:
    parent = Xml.SubElement(element, use)
    Xml.SubElement(Xml.SubElement(parent, "geometry"), "mesh", filename=str(file))
    return parent


def _add_visuals(element: Xml.Element, meshes: tuple[VisualMesh, ...], stem: Path) -> None:
    """Add one visual for each colour, because PyBullet's renderer has no face colours."""
    for i, mesh in enumerate(meshes):
        palette, color = np.unique(mesh.colors, axis=0, return_inverse=True)
        for k, rgb in enumerate(palette):
            file = stem.with_name(f"{stem.name}_visual_{i}_{k}.obj")
            write_shaded(file, mesh.vertices, mesh.faces[color.reshape(-1) == k])
            _add_color(_add_mesh(element, "visual", file), rgb)


def _add_color(visual: Xml.Element, rgb: ndarray) -> None:
    material = Xml.SubElement(visual, "material", name=f"color_{rgb[0]}_{rgb[1]}_{rgb[2]}")
    Xml.SubElement(material, "color", rgba=_numbers([*(rgb / 255.0), 1.0]))


def _write_tree(root: Xml.Element, file: Path) -> Path:
    Xml.indent(root)  # PyBullet misreads lines of more than 8 kB
    Xml.ElementTree(root).write(file)
    return file


def _add_joint(root: Xml.Element, joint: Joint, planned: bool) -> None:
    element = Xml.SubElement(root, "joint", name=joint.name, type=joint.kind)
    Xml.SubElement(element, "parent", link=joint.parent)
    Xml.SubElement(element, "child", link=joint.child)
    T = joint.T_parent_joint
    Xml.SubElement(element, "origin", xyz=_numbers(T[:3, 3]), rpy=_numbers(rpy_from_rotation(T[:3, :3])))
    if joint.kind in MOVING_KINDS:
        Xml.SubElement(element, "axis", xyz=_numbers(joint.axis))
        # in Bullet, a lower limit above the upper one means no limits
        lower, upper = (joint.lower, joint.upper) if planned else (1.0, -1.0)
        limits = {"lower": lower, "upper": upper, "velocity": 1.0, "effort": 1.0}
        Xml.SubElement(element, "limit", {key: _numbers([value]) for key, value in limits.items()})


def _numbers(values: object) -> str:
    return " ".join(f"{value:.17g}" for value in np.asarray(values, float))
