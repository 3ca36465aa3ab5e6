"""Collision objects and octomaps of MoveIt messages, as shapes."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy import ndarray

from robotdiffuse.core.bounds import vector
from robotdiffuse.core.errors import InputError, unknown_name
from robotdiffuse.core.mesh_files import read_triangles
from robotdiffuse.core.transforms import quaternion_from_rotation
from robotdiffuse.problems.files.moveit.frames import MoveItFrames
from robotdiffuse.problems.files.moveit.shapes import cone, plane
from robotdiffuse.problems.files.moveit.values import list_of, mapping_of, pose_of, xyz_of
from robotdiffuse.scenes.mesh import Mesh
from robotdiffuse.scenes.octomap import cover_radius, occupied_voxels
from robotdiffuse.scenes.shapes import Box, Cylinder, PointCloud, Shape, Sphere

PRIMITIVES: dict[str, tuple[int, Callable[[ndarray, ndarray, ndarray, str], Shape]]] = {
    "box": (3, lambda size, xyz, wxyz, name: Box(xyz, size, wxyz, name)),
    "sphere": (1, lambda size, xyz, wxyz, name: Sphere(xyz, size[0], name)),
    "cylinder": (2, lambda size, xyz, wxyz, name: Cylinder(xyz, size[1], size[0], wxyz, name)),
    "cone": (2, cone),
}
"""For each type, the number of its dimensions and the shape (of cylinders and cones height and radius)."""
TYPE_NUMBERS = {1: "box", 2: "sphere", 3: "cylinder", 4: "cone", 5: "prism"}
"""Numbers of the types in messages (shape_msgs/SolidPrimitive)."""
MAX_PLANES = 1000
"""Most planes of a collision object; each is a box of its own."""
NO_POSE = {"position": [0, 0, 0], "orientation": [0, 0, 0, 1]}


def octomap(entry: dict[str, Any], frames: MoveItFrames) -> list[Shape]:
    """The occupied voxels of an OctomapWithPose as a cloud of spheres around them; none without data."""
    message = mapping_of("world.octomap.octomap", entry.get("octomap"))
    data = list_of("world.octomap.octomap.data", message.get("data"))
    if not data:
        return []
    if not message.get("binary"):
        raise InputError("world.octomap is not binary; publish it as a binary octomap (octomap_binary)")
    where = "world.octomap.octomap.data"
    bytes_ = (vector(where, "data", data, len(data)).astype(np.int64) % 256).astype(np.uint8).tobytes()
    edge = float(vector("world.octomap.octomap", "resolution", [message.get("resolution")], 1)[0])
    T = frames.of("world.octomap", entry) @ pose_of("world.octomap.origin", entry.get("origin") or NO_POSE)
    try:
        cloud = PointCloud(occupied_voxels(bytes_, edge), cover_radius(edge), name="octomap")
    except InputError as error:
        raise InputError(f"world.octomap: {error}") from None
    return [cloud.moved(T)]


def object_shapes(entry: dict[str, Any], frames: MoveItFrames, folder: Path) -> list[Shape]:
    """The shapes of a CollisionObject, all with its name, in the frame of the robot's base.

    folder: where names of mesh files begin.
    """
    T_base_object = frames.of("header", entry) @ pose_of("pose", entry.get("pose") or NO_POSE)
    name = str(entry.get("id") or "object")
    planes = list_of("planes", entry.get("planes"))
    poses = list_of("plane_poses", entry.get("plane_poses")) or [NO_POSE] * len(planes)
    if len(planes) > MAX_PLANES:
        raise InputError(f"has {len(planes):,} planes; at most {MAX_PLANES:,} are read")
    if len(poses) != len(planes):
        raise InputError(f"has {len(planes)} planes and {len(poses)} plane_poses; it must be one for each")
    shapes: list[Shape] = []
    for i, (part, pose) in enumerate(zip(planes, poses, strict=True)):
        coefficients = vector(f"planes[{i}]", "coef", mapping_of(f"planes[{i}]", part).get("coef"), 4)
        shapes.append(plane(coefficients, name).moved(T_base_object @ pose_of(f"plane_poses[{i}]", pose)))
    for key, build in (("primitive", _primitive), ("mesh", _mesh)):
        plural = "meshes" if key == "mesh" else "primitives"
        parts = list_of(plural, entry.get(plural))
        poses = list_of(f"{key}_poses", entry.get(f"{key}_poses"))
        if not poses and entry.get("pose"):
            poses = [NO_POSE] * len(parts)
        if len(poses) != len(parts):
            raise InputError(
                f"has {len(parts)} {plural} and {len(poses)} {key}_poses; it must be one for each"
            )
        for i, (part, pose) in enumerate(zip(parts, poses, strict=True)):
            T = T_base_object @ pose_of(f"{key}_poses[{i}]", pose)
            where = f"{plural}[{i}]"
            wxyz = quaternion_from_rotation(T[:3, :3])
            shapes.append(build(where, mapping_of(where, part), T[:3, 3], wxyz, name, folder))
    return shapes


def _primitive(
    where: str, part: dict[str, Any], xyz: ndarray, wxyz: ndarray, name: str, _folder: Path
) -> Shape:
    kind = part.get("type")
    kind = TYPE_NUMBERS.get(kind, kind) if isinstance(kind, int) else kind
    if not isinstance(kind, str) or kind not in PRIMITIVES:
        raise unknown_name(f"type of {where}:", kind, PRIMITIVES)
    count, build = PRIMITIVES[kind]
    return build(vector(where, "dimensions", part.get("dimensions"), count), xyz, wxyz, name)


def _mesh(where: str, part: dict[str, Any], xyz: ndarray, wxyz: ndarray, name: str, folder: Path) -> Shape:
    if "resource" in part:
        file = str(part["resource"]).removeprefix("file://")
        if "://" in file:
            raise InputError(f"{where}.resource is {file}; it must be a file, or the mesh must have vertices")
        vertices, faces = read_triangles(folder / file)
        vertices = vertices * vector(where, "dimensions", part.get("dimensions", [1, 1, 1]), 3)
    else:
        rows = list_of(f"{where}.vertices", part.get("vertices"))
        vertices = np.array([xyz_of(f"{where}.vertices", row) for row in rows]).reshape(-1, 3)
        triangles = list_of(f"{where}.triangles", part.get("triangles"))
        indices = [t.get("vertex_indices") if isinstance(t, dict) else t for t in triangles]
        faces = np.array([vector(where, "triangles", triangle, 3) for triangle in indices])
    return Mesh(vertices, faces, xyz, wxyz, name=name)
