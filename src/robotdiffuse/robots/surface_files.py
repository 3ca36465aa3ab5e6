"""Reads and writes surfaces.npz of a robot folder: the surfaces of grazing links (`Robot.grazing`).

The file is optional and no part of a robot's identity: data, weights and proofs that were made without it
stay valid, because surfaces only free configurations in which convex parts overlap.
"""

import hashlib
import io
from pathlib import Path

import numpy as np
from numpy import ndarray

from robotdiffuse.core.bounds import within
from robotdiffuse.core.errors import InputError, shortened
from robotdiffuse.core.input_files import read_arrays
from robotdiffuse.robots.bodies import ConvexMesh, Surface

SURFACE_FILE = "surfaces.npz"
Surfaces = dict[str, Surface]
Grazing = frozenset[frozenset[str]]
Meshes = dict[str, tuple[ConvexMesh, ...]]


def pack_surfaces(surfaces: Surfaces, grazing: Grazing, meshes: Meshes) -> bytes:
    """The content of surfaces.npz. Coordinates are rounded to float32, by 6e-8 of their size at most."""
    content = io.BytesIO()
    arrays = {
        "links": np.array(list(surfaces), np.str_),
        "sizes": np.array([(len(s.vertices), len(s.faces)) for s in surfaces.values()], np.int64),
        "vertices": np.concatenate([s.vertices for s in surfaces.values()]).astype(np.float32),
        "faces": np.concatenate([s.faces for s in surfaces.values()]).astype(np.int32),
        "grazing": np.array(sorted(sorted(pair) for pair in grazing), np.str_),
        "of": np.array(_digest(meshes)),
    }
    np.savez_compressed(content, allow_pickle=False, **arrays)
    return content.getvalue()


def read_surfaces(file: Path, meshes: Meshes) -> tuple[Surfaces, Grazing]:
    """The surfaces and grazing pairs of a file; InputError if it is damaged or made for other `meshes`."""
    arrays = read_arrays(file)
    try:
        links, sizes, vertices, faces, grazing, of = (
            arrays[key] for key in ("links", "sizes", "vertices", "faces", "grazing", "of")
        )
        ends = np.cumsum(sizes, axis=0)
        if (ends[-1] != (len(vertices), len(faces))).any() or vertices.shape[1:] != (3,):
            raise ValueError("sizes do not add up")
        if str(of) != _digest(meshes):
            raise ValueError("it belongs to other convex meshes; create the robot again")
        surfaces = {
            str(link): _surface(vertices[end[0] - size[0] : end[0]], faces[end[1] - size[1] : end[1]])
            for link, size, end in zip(links, sizes, ends, strict=True)
        }
        pairs = frozenset(frozenset(map(str, pair)) for pair in grazing)
        if {link for pair in pairs for link in pair} != {*surfaces} or not {*surfaces} <= {*meshes}:
            raise ValueError("grazing pairs and surfaces must name the same links of the robot")
    except (KeyError, IndexError, ValueError, TypeError) as error:
        raise InputError(f"{file} is damaged: {type(error).__name__}: {shortened(str(error))}") from None
    return surfaces, pairs


def _surface(vertices: ndarray, faces: ndarray) -> Surface:
    vertices = vertices.astype(np.float64)
    faces = faces.astype(np.int64)
    if faces.shape[1:] != (3,) or not ((faces >= 0) & (faces < len(vertices))).all() or not within(vertices):
        raise ValueError("triangles of finite vertices expected")
    return Surface(vertices, faces)


def _digest(meshes: Meshes) -> str:
    digest = hashlib.sha256()
    for link in sorted(meshes):
        for mesh in meshes[link]:
            digest.update(link.encode() + np.ascontiguousarray(mesh.vertices, np.float64).tobytes())
    return digest.hexdigest()
