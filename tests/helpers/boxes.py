"""Meshes of boxes, and surfaces of meshes."""

import numpy as np
import trimesh

from robotdiffuse.robots.bodies import Surface


def surface(mesh: trimesh.Trimesh) -> Surface:
    return Surface(np.array(mesh.vertices), np.array(mesh.faces))


def boxes(*ends: tuple[tuple[float, ...], tuple[float, ...]]) -> trimesh.Trimesh:
    """Closed boxes from their lowest to their highest corners; where they meet, there are inner walls."""
    made = trimesh.util.concatenate([trimesh.creation.box(bounds=np.array(each)) for each in ends])
    assert isinstance(made, trimesh.Trimesh)
    return made
