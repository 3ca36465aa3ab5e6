"""Reads triangle meshes from files, with z up and, where the format has a unit, in meters."""

import io
import logging
import os
import re
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy import ndarray

from robotdiffuse.core.errors import InputError, reading, shown
from robotdiffuse.core.files import (
    MAX_DEPTH,
    MAX_FILE_SIZE,
    input_file,
    known_ending,
    parse_json,
    parse_xml,
    read_bytes,
)

MESH_FORMATS = (".dae", ".glb", ".gltf", ".obj", ".off", ".ply", ".stl")
R_UP = {
    "X_UP": np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]),
    "Y_UP": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]),
    "Z_UP": np.eye(3),
}
"""Rotations to z up, by the <up_axis> of Collada. glTF has y up."""
LFS_POINTER = b"version https://git-lfs"
NO_GEOMETRY = (
    *("library_animations", "library_cameras", "library_effects"),
    *("library_images", "library_lights", "library_materials"),
    *("instance_camera", "instance_light", "bind_material"),
)
"""Elements of Collada that contain no geometry. They are removed before reading, since trimesh also drops
geometry if one of them is damaged."""
BYTES_PER_USE = 30_000
"""Estimated memory for each use of a list of polygons (<p>) in a Collada scene, without the list's indices
[bytes]."""
MAX_ACCESSED = 20_000_000
"""Maximum number of elements of all accessors of a glTF file. The file's size does not bound this number,
since an accessor without a buffer takes no bytes."""

# trimesh logs a traceback of each error that it raises; without a handler, logging prints it on standard
# error
logging.getLogger("trimesh").addHandler(logging.NullHandler())


def read_triangles(
    file: str | Path, merge: bool = False, notes: list[str] | None = None, turn: bool = True
) -> tuple[ndarray, ndarray]:
    """Vertices [v, 3] and faces [f, 3] of a mesh file.

    Collada is converted to meters by its <unit>; vertices of other formats keep the units of the file.

    Args:
        file: A file with an ending in MESH_FORMATS. Materials and images are not read.
        merge: Whether vertices with equal coordinates are merged.
        notes: Receives a note on an up axis other than z, and if the mesh is scaled.
        turn: Whether glTF, which has y up, and Collada files with another <up_axis> than z are rotated so
            that z is up. MoveIt, RViz for ROS 1 and Pinocchio do not rotate them, and URDFs rely on that.

    Raises:
        InputError: For files that `input_file` refuses, other formats, pointers of Git LFS, and files that
            are empty or damaged, hold no triangles or are too large in memory.
    """
    path = input_file(file, "mesh file")
    ending = known_ending(path, "mesh", MESH_FORMATS)
    content = read_bytes(path, "mesh file")
    if not content:
        raise InputError(f"mesh file {file} is empty")
    if content.startswith(LFS_POINTER):
        raise InputError(f"mesh file {file} is a pointer of Git LFS; get the file itself: git lfs pull")
    import trimesh  # takes seconds; files refused above are refused at once

    resolver = None
    up = "Z_UP"
    meters = 1.0
    with reading(f"mesh file {file}"):
        if ending == ".dae":
            content, up, meters = _collada(content)
        elif ending in (".glb", ".gltf"):
            up = "Y_UP"
            _check_accessors(content)
            resolver = _buffer_resolver(path)
        if ending == ".ply":
            check_ply(content)
        if ending == ".stl" and b"facet" not in content[:1000].lower():
            end = 84 + 50 * int.from_bytes(content[80:84], "little")  # after the last triangle
            if len(content) < end:
                raise InputError(f"it has {len(content):,} of the {end:,} bytes that its header states")
            content = content[:end]
        with np.errstate(all="ignore"):
            mesh = trimesh.load_mesh(
                io.BytesIO(content),
                ending[1:],
                resolver,
                process=merge,
                skip_materials=True,
                ignore_broken=False,
            )
    if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0:
        raise InputError(f"mesh file {file} holds no triangles")
    if mesh.vertices.shape[1:] != (3,):
        raise InputError(f"mesh file {file} cannot be read: its vertices do not have three coordinates")
    if notes is not None and up != "Z_UP":
        notes.append(
            f"{path.name} has {up[0].lower()} up; it is turned to z up"
            if turn
            else "meshes whose files state another up axis than z are not turned, as in MoveIt"
        )
    if notes is not None and meters != 1:
        notes.append(f"{path.name} is in units of {meters:g} m; it is read in meters")
    vertices = meters * np.asarray(mesh.vertices, np.float64)
    return vertices @ R_UP[up if turn else "Z_UP"].T, np.asarray(mesh.faces, np.int64)


def check_ply(content: bytes) -> None:
    """Raises InputError for an ASCII PLY file with another number of rows than its header states."""
    header, _, body = content.partition(b"end_header")
    if b"\nformat ascii" in header:
        stated = sum(map(int, re.findall(rb"^element \S+ (\S+)", header, re.MULTILINE)))
        rows = sum(map(bool, map(bytes.strip, io.BytesIO(body))))
        if rows != stated:
            raise InputError(
                f"its header states {stated} vertices, faces and other elements, but it holds {rows}"
            )


def _collada(content: bytes) -> tuple[bytes, str, float]:
    """A Collada file without materials and images, its up axis, and its unit [m].

    Raises InputError for unknown up axes and units, for a scene or a list of polygons that would not fit into
    memory, and for nodes that are nested too deeply or contain themselves.
    """
    root = parse_xml(content, "it")
    for element in root.iter():
        element.tag = str(element.tag).rpartition("}")[2]
    for parent in [*root.iter()]:
        for child in [child for child in parent if child.tag in NO_GEOMETRY]:
            parent.remove(child)
    up = (root.findtext("asset/up_axis") or "Y_UP").strip()
    unit = root.find("asset/unit")
    unit_text = "1" if unit is None else unit.get("meter", "1")
    try:
        meters = float(unit_text)
    except ValueError:
        meters = 0.0
    if up not in R_UP:
        raise InputError(f"its up_axis is {shown(up)}; it must be one of {', '.join(R_UP)}")
    if not 1e-9 < meters < 1e9:
        raise InputError(f"its unit is {shown(unit_text)} m; it must be a number between 1e-9 and 1e9")
    if any(sum(map(int, (count.text or "").split())) > len(content) for count in root.iter("vcount")):
        raise InputError("a list of polygons has more corners than the file has bytes")
    sizes = {
        f"#{geometry.get('id')}": sum(len(part.text or "") + BYTES_PER_USE for part in geometry.iter("p"))
        for geometry in root.iter("geometry")
    }
    nodes = {f"#{node.get('id')}": node for node in root.iter("node")}
    if sum(_size(scene, nodes, sizes, {}, 0) for scene in root.iter("visual_scene")) > MAX_FILE_SIZE:
        raise InputError("its scene uses geometries too often to fit into memory")
    root.set("xmlns", "http://www.collada.org/2005/11/COLLADASchema")
    return ET.tostring(root), up, meters


def _size(
    node: ET.Element,
    nodes: Mapping[str, ET.Element],
    sizes: Mapping[str, int],
    known: dict[str, int | None],
    depth: int,
) -> int:
    """Estimated memory [bytes] of the geometries that a Collada node and its descendants use: the sum of
    `sizes`, with each use of a geometry counted.

    Args:
        node: The node.
        nodes: All nodes of the file by URL, such as "#arm".
        sizes: Memory of one use of each geometry, by URL [bytes].
        known: Results by URL of a node; None while the result is being computed.
        depth: Nesting of the node below the scene.
    """
    if depth > MAX_DEPTH:
        raise InputError(f"its nodes are nested more than {MAX_DEPTH} levels deep")
    total = 0
    for child in node:
        url = child.get("url", "")
        if child.tag == "node":
            total += _size(child, nodes, sizes, known, depth + 1)
        elif child.tag == "instance_geometry":
            total += sizes.get(url, 0)
        elif child.tag == "instance_node" and url in nodes:
            if url not in known:
                known[url] = None
                known[url] = _size(nodes[url], nodes, sizes, known, depth + 1)
            size = known[url]
            if size is None:
                raise InputError(f"its node {shown(url)} contains itself")
            total += size
    return total


def _check_accessors(content: bytes) -> None:
    """Raises InputError if the accessors of a glTF file would not fit into memory."""
    binary = content.startswith(b"glTF")
    text = content[20 : 20 + int.from_bytes(content[12:16], "little")] if binary else content
    header = parse_json(text.decode("utf-8", "replace"), "its header")
    accessors = header.get("accessors", ()) if isinstance(header, dict) else ()
    if sum(int(accessor["count"]) for accessor in accessors) > MAX_ACCESSED:
        raise InputError(f"its accessors hold more than {MAX_ACCESSED:,} elements")


def _buffer_resolver(mesh: Path) -> Any:
    """A resolver with which trimesh opens the buffers that a glTF file names; they must be regular files."""
    from trimesh.resolvers import FilePathResolver

    class RegularFiles(FilePathResolver):
        size = 0

        def get(self, name: str) -> Any:
            for place in (name.strip(), name.strip().lstrip("/"), Path(name).name):  # as trimesh tries them
                file = Path(self.parent, place)
                if os.path.lexists(file):
                    input_file(file)
            data = super().get(name)
            self.size += len(data)
            if self.size > MAX_FILE_SIZE:
                raise InputError(f"its buffers are larger than {MAX_FILE_SIZE // 2**20} MB together")
            return data

    return RegularFiles(str(mesh))
