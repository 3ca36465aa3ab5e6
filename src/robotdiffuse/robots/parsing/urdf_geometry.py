"""Collision elements of a URDF's links as triangle meshes."""

import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import trimesh
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.core.bounds import MIN_SIZE, points
from robotdiffuse.core.errors import InputError, shown
from robotdiffuse.core.mesh_files import read_triangles
from robotdiffuse.robots.fitting.convex_hulls import convex_hull
from robotdiffuse.robots.fitting.convex_parts import Surface
from robotdiffuse.robots.parsing.packages import Packages
from robotdiffuse.robots.parsing.urdf_values import numbers_of, origin_of

PRIMITIVES = ("box", "capsule", "cylinder", "sphere")


def link_surfaces(
    path: Path, link: ET.Element, kind: str, packages: Packages, notes: list[str]
) -> tuple[Surface, ...]:
    """The elements `kind` (collision or visual) of a link as triangle meshes, in the link's frame.

    `notes` receives a note on each mesh file that is turned or scaled. Raises InputError for elements without
    geometry, unknown shapes and damaged meshes.
    """
    parts = []
    name = link.get("name", "")
    for element in link.findall(kind):
        geometry = element.find("geometry")
        shape = next(iter(geometry), None) if geometry is not None else None
        if shape is None:
            raise InputError(f"{path}: link {name}: a <{kind}> has no geometry")
        if shape.tag == "mesh":
            surface = _mesh(path, shape, name, packages, notes)
        elif shape.tag in PRIMITIVES:
            hull = convex_hull(_primitive(path, shape, name))
            surface = Surface(hull.vertices, hull.faces)
        else:
            raise InputError(
                f"{path}: link {name}: {kind} shape <{shape.tag}> is not supported; "
                f"known: {', '.join(sorted((*PRIMITIVES, 'mesh')))}"
            )
        T = origin_of(path, element, f"link {name}: {kind}")
        parts.append(Surface(surface.vertices @ T[:3, :3].T + T[:3, 3], surface.faces))
    return tuple(parts)


def _primitive(path: Path, shape: ET.Element, link: str) -> Float[ndarray, "n 3"]:
    """Corners of a polyhedron around a primitive."""

    def positive(name: str, count: int) -> Float[ndarray, "n"]:
        what = f"link {link}: {shape.tag} {name}"
        values = numbers_of(path, shape.get(name, ""), count, what)
        if (values < MIN_SIZE).any():
            raise InputError(f"{path}: {what} is {shown(shape.get(name))}; it must be positive")
        return values

    if shape.tag == "box":
        return np.array(trimesh.creation.box(positive("size", 3)).vertices)
    radius = positive("radius", 1)
    if shape.tag == "sphere":
        return _ball() * radius
    if shape.tag == "capsule":
        end = _ball() * radius
    else:
        angle = np.arange(32) * np.pi / 16
        ring = np.stack([np.cos(angle), np.sin(angle), np.zeros(32)], axis=1)
        end = ring * radius / np.cos(np.pi / 32)
    half = float(positive("length", 1)[0]) / 2
    return np.concatenate([end + np.array([0, 0, z]) for z in (-half, half)])


def _mesh(path: Path, shape: ET.Element, link: str, packages: Packages, notes: list[str]) -> Surface:
    file = packages.file(shape.get("filename", ""))
    where = f"link {link}: mesh"
    scale = numbers_of(path, shape.get("scale", "1 1 1"), 3, f"{where} scale")
    if (np.abs(scale) < MIN_SIZE).any():
        raise InputError(f"{path}: {where} scale is {shown(shape.get('scale'))}; its numbers must not be 0")
    try:
        vertices, faces = read_triangles(file, merge=True, notes=notes)
        vertices = points(where, "vertices", vertices * scale)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    if len(vertices) < 4:
        raise InputError(
            f"{path}: link {link}: {file} has no triangle mesh with at least four vertices; "
            f"repair it or remove its element"
        )
    return Surface(vertices, faces)


def _ball() -> Float[ndarray, "n 3"]:
    """Vertices of a polyhedron around the unit ball."""
    ball = trimesh.creation.icosphere(subdivisions=2, radius=1.0)
    inner = np.einsum("fd,fd->f", ball.face_normals, ball.triangles[:, 0]).min()
    return np.array(ball.vertices) / inner
