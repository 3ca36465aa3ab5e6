"""Makes the visual meshes of a bundled robot, `visual.npz`, of its URDF."""

from pathlib import Path

import numpy as np
from numpy import ndarray

from robotdiffuse.core.errors import InputError
from robotdiffuse.robots.visual_meshes import LINK_COLOR, UNIT, VisualMesh


def write_visual(visual: dict[str, VisualMesh], file: Path) -> None:
    """Write visual meshes to an .npz: vertices in units of UNIT, faces, a palette and its index by face."""
    arrays = {}
    for link, mesh in visual.items():
        palette, color = np.unique(mesh.colors, axis=0, return_inverse=True)
        index = np.uint16 if len(mesh.vertices) < 2**16 else np.uint32
        arrays[f"{link}/vertices"] = np.round(mesh.vertices / UNIT).astype(np.int32)
        arrays[f"{link}/faces"] = mesh.faces.astype(index)
        arrays[f"{link}/palette"] = palette
        arrays[f"{link}/color"] = color.reshape(-1).astype(np.uint8)
    np.savez_compressed(file, **arrays)


def visual_meshes(urdf: Path, faces: int = 40_000) -> dict[str, VisualMesh]:
    """The visual meshes of a URDF by link, decimated to about `faces` triangles in all.

    Needs pycollada (for .dae files) and fast-simplification, which only the making of a bundle needs.
    Materials of the mesh files are kept. Visuals that are not meshes are left out: of their links the
    collision geometry is drawn. Raises InputError for a mesh file that cannot be found.
    """
    from yourdfpy import URDF

    tree = URDF.load(str(urdf), build_scene_graph=False, load_meshes=False)
    pieces: dict[str, list[tuple[ndarray, ndarray, ndarray]]] = {}
    for link in tree.robot.links:
        for visual in link.visuals:
            mesh = None if visual.geometry is None else visual.geometry.mesh
            if mesh is not None:
                T_link_mesh = np.eye(4) if visual.origin is None else visual.origin
                scale = np.ones(3) if mesh.scale is None else np.broadcast_to(mesh.scale, 3)
                file = _mesh_file(Path(urdf), mesh.filename)
                pieces.setdefault(link.name, []).extend(
                    _read_mesh(file, T_link_mesh @ np.diag([*scale, 1.0]))
                )
    total = sum(len(f) for parts in pieces.values() for _, f, _ in parts)
    return {link: _joined(parts, min(1.0, faces / total)) for link, parts in pieces.items()}


def _mesh_file(urdf: Path, filename: str) -> Path:
    relative = filename.removeprefix("file://")
    if relative.startswith("package://"):
        relative = relative.removeprefix("package://")
        tails = [relative, relative.partition("/")[2]]
        found = [
            folder / tail for folder in urdf.resolve().parents for tail in tails if (folder / tail).is_file()
        ]
        if found:
            return found[0]
    elif (urdf.parent / relative).is_file():
        return urdf.parent / relative
    raise InputError(f"{urdf}: visual mesh {filename} was not found in any folder above the URDF")


def _read_mesh(file: Path, T_link_mesh: ndarray) -> list[tuple[ndarray, ndarray, ndarray]]:
    """Vertices in the link waypoint, faces and colour of each piece, vertices merged by position."""
    import trimesh

    loaded = trimesh.load_scene(file)
    parts = []
    for node in loaded.graph.nodes_geometry:
        T_mesh_piece, name = loaded.graph[node]
        piece = loaded.geometry[name]
        if not isinstance(piece, trimesh.Trimesh):
            continue
        material = getattr(piece.visual, "material", None)
        color = np.array(LINK_COLOR, np.uint8) if material is None else np.asarray(material.main_color)[:3]
        vertices, index = np.unique(np.round(piece.vertices, 5), axis=0, return_inverse=True)
        faces = index.reshape(-1)[piece.faces]
        faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
        T = T_link_mesh @ T_mesh_piece
        parts.append((vertices @ T[:3, :3].T + T[:3, 3], faces, color))
    return parts


def _joined(parts: list[tuple[ndarray, ndarray, ndarray]], share: float) -> VisualMesh:
    vertices = []
    faces = []
    colors = []
    count = 0
    for points, triangles, color in parts:
        # Small pieces (covers, lamps, labels) lose their shape first, so they keep more of their faces.
        target = min(len(triangles), max(int(share * len(triangles)), 500))
        if target < len(triangles):
            import fast_simplification

            reduction = 1 - target / len(triangles)
            points, triangles = fast_simplification.simplify(points, triangles, target_reduction=reduction)[
                :2
            ]
        vertices.append(points)
        faces.append(triangles + count)
        colors.append(np.tile(color.astype(np.uint8), (len(triangles), 1)))
        count += len(points)
    joined = np.concatenate(vertices).astype(np.float64), np.concatenate(faces).astype(np.int64)
    return VisualMesh(*joined, np.concatenate(colors))
