"""Mesh files: units and up axes, what is not geometry, and small files that would fill the memory."""

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh
from numpy import ndarray

from robotdiffuse import InputError
from robotdiffuse.core.mesh_files import read_triangles

TRIANGLES = '<triangles count="1"{}><input semantic="VERTEX" source="#v" offset="0"/><p>0 1 2</p></triangles>'
USE = '<node><instance_geometry url="#g"/></node>'


def collada(
    folder: Path,
    unit: str = "1",
    up: str = "Z_UP",
    mesh: str = TRIANGLES.format(""),
    more: str = "",
    scene: str = USE,
) -> Path:
    """A triangle with the corners (1, 0, 0), (0, 2, 0) and (0, 0, 3) in a Collada file."""
    (folder / "part.dae").write_text(
        f"""<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
        <asset><unit meter="{unit}"/><up_axis>{up}</up_axis></asset>
        <library_geometries><geometry id="g"><mesh>
        <source id="p"><float_array id="a" count="9">1 0 0 0 2 0 0 0 3</float_array>
        <technique_common><accessor source="#a" count="3" stride="3"><param name="X" type="float"/>
        <param name="Y" type="float"/><param name="Z" type="float"/></accessor></technique_common></source>
        <vertices id="v"><input semantic="POSITION" source="#p"/></vertices>{mesh}</mesh></geometry>
        </library_geometries>{more}<library_visual_scenes><visual_scene id="s">{scene}</visual_scene>
        </library_visual_scenes><scene><instance_visual_scene url="#s"/></scene></COLLADA>"""
    )
    return folder / "part.dae"


def corners(file: Path, notes: list[str] | None = None) -> ndarray:
    """The corners by their distance from the origin."""
    vertices, _ = read_triangles(file, notes=notes)
    return vertices[np.argsort(np.linalg.norm(vertices, axis=1))]


def test_collada_is_read_in_meters(tmp_path: Path) -> None:
    """100 mm were read as 100 m."""
    notes: list[str] = []
    np.testing.assert_allclose(corners(collada(tmp_path, "0.001"), notes), 1e-3 * np.diag([1, 2, 3]))
    assert notes == ["part.dae is in units of 0.001 m; it is read in meters"]
    with pytest.raises(InputError, match="its unit is '0' m"):
        read_triangles(collada(tmp_path, "0"))


@pytest.mark.parametrize(
    ("up", "expected"),
    [
        ("Z_UP", [[1, 0, 0], [0, 2, 0], [0, 0, 3]]),
        ("Y_UP", [[1, 0, 0], [0, 0, 2], [0, -3, 0]]),
        ("X_UP", [[0, 0, 1], [-2, 0, 0], [0, -3, 0]]),
    ],
)
def test_the_up_axis_of_collada_becomes_z(up: str, expected: list[list[int]], tmp_path: Path) -> None:
    notes: list[str] = []
    np.testing.assert_allclose(corners(collada(tmp_path, up=up), notes), expected, atol=1e-12)
    assert len(notes) == (up != "Z_UP")


def test_gltf_stands_upright(tmp_path: Path) -> None:
    """A wall of 1 x 2 x 0.1 m, which glTF gives with y up, lay flat."""
    trimesh.creation.box([1, 2, 0.1]).export(tmp_path / "wall.glb")
    notes: list[str] = []
    vertices, _ = read_triangles(tmp_path / "wall.glb", notes=notes)
    np.testing.assert_allclose(np.ptp(vertices, axis=0), [1, 0.1, 2])
    assert "y up" in notes[0]


def test_a_missing_material_loses_no_geometry(tmp_path: Path) -> None:
    bound = '<bind_material><technique_common><instance_material symbol="m" target="#no"/></technique_common>'
    scene = USE + f'<node><instance_geometry url="#g">{bound}</bind_material></instance_geometry></node>'
    _, faces = read_triangles(collada(tmp_path, mesh=TRIANGLES.format(' material="m"'), scene=scene))
    assert len(faces) == 2


def test_a_pointer_of_git_lfs_says_so(tmp_path: Path) -> None:
    (tmp_path / "a.stl").write_text("version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 1\n")
    with pytest.raises(InputError, match="git lfs pull"):
        read_triangles(tmp_path / "a.stl")


def test_small_collada_files_cannot_fill_the_memory(tmp_path: Path) -> None:
    """2^40 uses of a triangle, in 6 kB, took more than a minute; a polygon of a billion corners 8 GB."""
    twice = '<node id="n{0}"><instance_node url="#n{1}"/><instance_node url="#n{1}"/></node>'
    nodes = (
        "".join(twice.format(i, i + 1) for i in range(40))
        + '<node id="n40"><instance_geometry url="#g"/></node>'
    )
    scene = '<node><instance_node url="#n0"/></node>'
    with pytest.raises(InputError, match="too often"):
        read_triangles(collada(tmp_path, more=f"<library_nodes>{nodes}</library_nodes>", scene=scene))
    itself = '<library_nodes><node id="n0"><instance_node url="#n0"/></node></library_nodes>'
    with pytest.raises(InputError, match="contains itself"):
        read_triangles(collada(tmp_path, more=itself, scene=scene))
    polygon = (
        TRIANGLES.format("").replace("triangles", "polylist").replace("<p>", "<vcount>1000000000</vcount><p>")
    )
    with pytest.raises(InputError, match="more corners than the file has bytes"):
        read_triangles(collada(tmp_path, mesh=polygon))


def test_gltf_cannot_ask_for_memory_without_bytes(tmp_path: Path) -> None:
    accessor = {"componentType": 5126, "count": 10**9, "type": "VEC3"}
    (tmp_path / "a.gltf").write_text(json.dumps({"asset": {"version": "2.0"}, "accessors": [accessor]}))
    with pytest.raises(InputError, match="20,000,000 elements"):
        read_triangles(tmp_path / "a.gltf")
