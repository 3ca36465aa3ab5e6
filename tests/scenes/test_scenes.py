"""Shapes, points on their surfaces, point clouds and the files that hold them."""

import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from hypothesis import given, strategies as st
from hypothesis.extra.numpy import arrays
from numpy import ndarray
from trimesh.triangles import closest_point

import robotdiffuse as rd
from helpers.point_files import FORMS, PCD, lzf_packed, npy, ply, text, write_points
from helpers.refusals import refuses
from helpers.sphere_oracles import distance
from robotdiffuse.core.mesh_files import read_triangles
from robotdiffuse.scenes.files import SHAPES as KINDS, read_scene, scene_entries
from robotdiffuse.scenes.point_cloud import crop, distinct, lzf_unpacked, read_points, voxel_thin
from robotdiffuse.scenes.shapes import Shape
from robotdiffuse.scenes.surface_points import VisibleRegion, draw, sample_surface

TURN = (0.8, 0.2, -0.5, 0.3)
"""Not of length 1, on purpose."""
TETRAHEDRON = ([[0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3]], [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
SHAPES: dict[str, Shape] = {
    "sphere": rd.Sphere([0.1, 0.2, 0.9], 0.3),
    "box": rd.Box([0.1, 0.2, 0.9], [0.2, 0.5, 0.9], TURN),
    "cylinder": rd.Cylinder([0.1, 0.2, 0.9], 0.1, 0.7, TURN),
    "capsule": rd.Capsule([0.1, 0.2, 0.9], 0.1, 0.7, TURN),
    "mesh": rd.Mesh(*TETRAHEDRON, xyz=[0.1, 0.2, 0.3], wxyz=TURN),
    "point_cloud": rd.PointCloud(np.random.default_rng(0).uniform(0.2, 0.6, (500, 3))),
}


def surface_distance(shape: Shape, points: ndarray) -> ndarray:
    """Distance of points from the surface of a shape, by other formulas than those that sample the surface."""
    if isinstance(shape, rd.PointCloud):
        return np.abs(points[:, None] - shape.points).max(axis=2).min(axis=1)
    if isinstance(shape, rd.Mesh):
        gaps = [points - closest_point(np.repeat(t[None], len(points), 0), points) for t in shape.world_vertices[shape.faces]]
        return np.linalg.norm(gaps, axis=2).min(axis=0)
    return np.abs(distance(shape, points))


def test_points_are_drawn_on_every_shape() -> None:
    assert {*KINDS.values()} - {rd.HeightMap} == {type(shape) for shape in SHAPES.values()}, "that is drawn by triangles"


@pytest.mark.parametrize("name", SHAPES)
def test_samples_lie_on_the_surface_and_in_the_bounds(name: str) -> None:
    shape = SHAPES[name]
    points = draw(shape, 2000, np.random.default_rng(1))
    assert points.shape == (2000, 3) and surface_distance(shape, points).max() < 1e-9
    low, high = shape.bounds
    assert (points > low - 1e-9).all() and (points < high + 1e-9).all()
    # Tight: some point comes near each side (3 % of the extent; a tetrahedron's corners are rarely hit).
    slack = (0.2 if name == "mesh" else 0.05) * (high - low)
    assert (points.min(axis=0) < low + slack).all() and (points.max(axis=0) > high - slack).all()


@pytest.mark.parametrize(
    ("name", "part", "share"),
    [
        ("sphere", lambda local: local[:, 2] > 0.15, 1 / 4),
        ("box", lambda local: np.abs(local[:, 0]) > 0.1 - 1e-9, 2 * 0.45 / 1.46),
        ("box", lambda local: np.abs(local[:, 2]) > 0.45 - 1e-9, 2 * 0.1 / 1.46),
        ("cylinder", lambda local: np.abs(local[:, 2]) > 0.35 - 1e-9, 0.1 / 0.8),
        ("cylinder", lambda local: np.hypot(local[:, 0], local[:, 1]) < 0.05, 0.1 / 0.8 / 4),
        ("capsule", lambda local: np.abs(local[:, 2]) > 0.35, 0.2 / 0.9),
        ("capsule", lambda local: local[:, 2] > 0.4, 0.05 / 0.9),
    ],
)
def test_samples_are_uniform_by_area(name: str, part: Callable[[ndarray], ndarray], share: float) -> None:
    shape = SHAPES[name]
    points = draw(shape, 40000, np.random.default_rng(2)) - shape.center  # type: ignore[attr-defined]
    found = part(points if name == "sphere" else points @ shape.rotation).mean()  # type: ignore[attr-defined]
    # Five standard deviations of a share among 40,000 draws.
    assert abs(found - share) < 5 * np.sqrt(share * (1 - share) / 40000)


def test_areas() -> None:
    for shape, made in {
        "mesh": trimesh.Trimesh(*TETRAHEDRON),
        "cylinder": trimesh.creation.cylinder(0.1, 0.7, sections=400),
        "capsule": trimesh.creation.capsule(0.7, 0.1, count=[100, 100]),
        "box": trimesh.creation.box([0.2, 0.5, 0.9]),
        "sphere": trimesh.creation.icosphere(5, 0.3),
    }.items():
        assert SHAPES[shape].area == pytest.approx(made.area, rel=2e-3)


def test_surface_is_shared_by_area_and_seeded() -> None:
    scene = rd.Scene([rd.Sphere([0.3, 0, 0.5], 0.1), rd.Sphere([-0.3, 0, 0.5], 0.2)])
    points = sample_surface(scene, 5000, np.random.default_rng(3))
    assert points.shape == (5000, 3) and abs((points[:, 0] > 0).mean() - 1 / 5) < 0.03
    # In random order: any part of the points is of the whole scene.
    assert abs((points[:1000, 0] > 0).mean() - 1 / 5) < 0.07
    assert (points == sample_surface(scene, 5000, np.random.default_rng(3))).all()


def test_surface_keeps_to_the_region_and_is_empty_where_nothing_is_visible() -> None:
    """An empty scene, a shape out of reach, the floor alone, and an empty cloud have none."""
    region = VisibleRegion()
    floor = rd.Box([0, 0, -0.05], [2, 2, 0.1])
    points = sample_surface(rd.Scene([floor, rd.Box([1.5, 0, 0.4], [4.0, 4.0, 0.02])]), 512, np.random.default_rng(4))
    assert len(points) == 512 and (points[:, 2] > region.floor).all()
    assert (np.linalg.norm(points - region.center, axis=1) < region.reach).all()
    for shapes in ([], [rd.Sphere([5, 0, 0.5], 0.2)], [floor], [rd.PointCloud([])]):
        assert sample_surface(rd.Scene(shapes), 64, np.random.default_rng(5)).shape == (0, 3)


def test_wrong_shapes() -> None:
    refuses(r"sphere.center is \[0, 0\]; it must be 3 finite numbers", rd.Sphere, [0, 0], 1)
    refuses("sphere.center", rd.Sphere, [0, 0, np.nan], 1)
    refuses("sphere.center", rd.Sphere, ["a", 0, 0], 1)
    refuses("sphere.radius is -1; it must be a number from", rd.Sphere, [0, 0, 0], -1)
    refuses("sphere.name", rd.Sphere, [0, 0, 0], 1, name="")
    refuses("box.size", rd.Box, [0, 0, 0], [1, 0, 1])
    refuses("must not be zero", rd.Box, [0, 0, 0], [1, 1, 1], [0, 0, 0, 0])
    refuses("cylinder.height is inf", rd.Cylinder, [0, 0, 0], 1, np.inf)
    refuses("capsule.radius is None", rd.Capsule, [0, 0, 0], None, 1)
    refuses("integer indices of the 1 vertices", rd.Mesh, [[0, 0, 0]], [[0, 0, 1]])
    refuses("mesh.faces", rd.Mesh, [[0, 0, 0]], [])
    refuses("an array of 1 x 2; it must be n x 3", rd.PointCloud, [[0, 0]])
    refuses(r"points\[0\] is \[0.0, 0.0, inf\]; its numbers must be finite", rd.PointCloud, [[0, 0, np.inf]])
    refuses("it must be n x 3", rd.PointCloud, [[0, 0, 0], [1]])
    refuses(r"scene\[0\] is 'ball'; it must be a shape", rd.Scene, ["ball"])
    refuses("scene is None; it must be a list of shapes", rd.Scene, None)
    refuses("scene is 5; it must be a list of shapes", rd.Scene, 5)
    refuses("floor is 2", VisibleRegion, floor=2.0)


@given(arrays(np.float64, st.tuples(st.integers(0, 30), st.just(3)), elements=st.sampled_from([-0.0, 0.0, 1.5])))
def test_distinct_points_are_the_first_of_each_in_the_old_order(points: np.ndarray) -> None:
    first = [row for i, row in enumerate(points) if not (points[:i] == row).all(axis=1).any()]
    assert np.array_equal(distinct(points), np.array(first).reshape(-1, 3))


@given(st.lists(st.tuples(*[st.floats(-3, 3, width=32)] * 3), max_size=60), st.sampled_from([1e-6, 0.01, 0.5, 10.0]))
def test_thinning_keeps_one_point_of_each_cell(rows: list[tuple[float, float, float]], voxel: float) -> None:
    points = np.array(rows, np.float64).reshape(-1, 3)
    kept = voxel_thin(points, voxel)
    assert len(kept) == len(np.unique(np.floor(points * (1 / voxel)), axis=0))
    assert len(np.unique(np.floor(kept * (1 / voxel)), axis=0)) == len(kept)
    if len(points):
        gap = np.linalg.norm(points[:, None] - kept, axis=2).min(axis=1)
        assert (gap <= np.sqrt(3) * voxel * (1 + 1e-9)).all()
        assert (gap[(points[:, None] == kept).all(axis=2).any(axis=1)] == 0).all()


def test_thinning_of_points_far_apart_and_crop() -> None:
    refuses("voxel_thin.voxel is 0.0", voxel_thin, np.zeros((2, 3)), 0.0)
    assert len(voxel_thin(np.array([[-1e9, 0, 0], [1e9, 5e8, 1e9], [1e9, 5e8, 1e9], [0, 0, 0]]), 1e-3)) == 3
    row = np.array([[0.0, 0, 0], [1, 0, 0], [3, 0, 0]])
    assert (crop(row, np.array([1.0, 0, 0]), 1.0) == row[:2]).all()


POINTS = np.random.default_rng(7).uniform(-1, 1, (50, 3)).astype(np.float32).astype(np.float64)


@given(st.lists(st.sampled_from([b"a", b"bc", b"abcd", b"x" * 300, bytes(range(200))]), max_size=60))
def test_lzf(parts: list[bytes]) -> None:
    content = b"".join(parts)
    packed = lzf_packed(content)
    assert lzf_unpacked(packed, len(content)) == content
    assert lzf_unpacked(bytes([2]) + b"abc" + bytes([0x20 + 0x40, 2]), 8) == b"abcabcab"  # by hand
    with pytest.raises(ValueError, match="do not unpack to"):
        lzf_unpacked(packed, len(content) + 1)


def test_packed_data_of_hostile_sizes() -> None:
    bomb = bytes([0, 7]) + bytes([0xE0, 255, 0]) * 10**6  # 264 MB
    with pytest.raises(ValueError, match="do not unpack to 100 bytes"):
        lzf_unpacked(bomb, 100)
    with pytest.raises(ValueError, match="before the beginning"):
        lzf_unpacked(bytes([0, 7, 0x20, 200]), 100)


@pytest.mark.parametrize("form", FORMS)
def test_point_files_without_points_that_are_not_finite(form: str, tmp_path: Path) -> None:
    points, notes = read_points(write_points(tmp_path, form, POINTS))
    assert notes == () and (points == POINTS).all()
    spoilt = POINTS.copy()
    spoilt[3] = spoilt[9, 1] = np.nan
    points, notes = read_points(write_points(tmp_path, form, spoilt))
    assert (points == np.delete(POINTS, [3, 9], axis=0)).all()
    assert len(notes) == 1 and "2 of 50 points are not finite" in notes[0]


@pytest.mark.parametrize("form", [f for f in FORMS if f != "xyz"])
def test_files_of_no_points(form: str, tmp_path: Path) -> None:
    file = write_points(tmp_path, form, POINTS[:0])
    if file.stat().st_size == 0:
        refuses("is empty", read_points, file)
    else:
        points, notes = read_points(file)
        assert points.shape == (0, 3) and "holds no points" in notes[0]


CUT = ply(POINTS, False).rpartition(b"\n" + text(POINTS[-1:], " "))[0]
PACKED = PCD.format(n=10**9, data="binary_compressed").encode() + struct.pack("<II", 2, 40) + b"ab"


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("cloud.las", b"x", "known: .bt, .csv, .npy, .npz, .pcd, .ply, .xyz"),
        ("cloud.ply", None, "does not exist"),
        ("cloud.ply", b"", "is empty"),
        ("cloud.csv", b"1,2\n3,4\n", "holds float64 of 2 x 2; it must be numbers, n x 3"),
        ("cloud.xyz", b"1 2 3\n4 five 6\n", "is damaged"),
        ("cloud.pcd", PCD.format(n=1, data="zipped").encode(), "stored as 'zipped'"),
        ("cloud.pcd", PACKED, "unpacks to 40 bytes; its 1,000,000,000 points take"),
        ("cloud.pcd", PCD.replace("x y z", "i j k").format(n=1, data="ascii").encode(), "must have x, y and z"),
        ("cloud.pcd", PCD.format(n=3, data="ascii").encode() + b"1 2 3\n1 2 3\n", "holds 2 of its 3 points"),
        ("cloud.pcd", PCD.replace("S {n}", "S -1").format(n=1, data="binary").encode(), "has -1 POINTS; it must be"),
        ("cloud.pcd", PCD.replace("TH {n}", "TH 9").format(n=1, data="binary").encode(), "must be WIDTH x HEIGHT, 9 x 1"),
        ("cloud.pcd", b"FIELDS x y z\nDATA ascii\n1 2 3\n", "is damaged: KeyError: 'POINTS'"),
        ("cloud.ply", CUT, "states 50 vertices, faces and other elements, but it holds 49"),
        ("cloud.csv", b"t,x,y\n0,1,2\n", "has the columns .'t', 'x', 'y'.; it must have x, y and z"),
        ("cloud.csv", b"time,Points:0,Points:1,Points:2\n5,1,2,3\n", "it must have x, y and z"),
        ("cloud.npy", npy(POINTS + 1j), "holds complex128 of 50 x 3; it must be numbers"),
        ("cloud.npy", npy(POINTS > 0), "holds bool of 50 x 3; it must be numbers"),
        ("cloud.npy", npy(np.ones((3, 5000))), "holds float64 of 3 x 5000; it must be numbers, n x 3"),
    ],
)
def test_wrong_point_files(name: str, content: bytes | None, message: str, tmp_path: Path) -> None:
    if content is not None:
        (tmp_path / name).write_bytes(content)
    refuses(message, read_points, tmp_path / name)


def test_a_cut_ply_mesh_is_refused(tmp_path: Path) -> None:
    mesh: Any = trimesh.creation.box().export(file_type="ply", encoding="ascii")
    (tmp_path / "cut.ply").write_bytes(b"\n".join(mesh.splitlines()[:-3]))
    refuses("states 20 vertices, faces and other elements, but it holds 17", read_triangles, tmp_path / "cut.ply")
    stl: Any = trimesh.creation.box().export(file_type="stl")
    (tmp_path / "cut.stl").write_bytes(stl[:-30])
    refuses("it has 654 of the 684 bytes that its header states", read_triangles, tmp_path / "cut.stl")
    capitals: Any = trimesh.creation.box().export(file_type="stl_ascii")
    (tmp_path / "capitals.stl").write_text(capitals.upper())
    (tmp_path / "long.stl").write_bytes(stl + b"xx")
    assert all(len(read_triangles(tmp_path / f"{name}.stl")[1]) == 12 for name in ("capitals", "long"))


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (b"\xef\xbb\xbf1,2,3\n4,5,6\n", [[1, 2, 3], [4, 5, 6]]),
        (b"#r,x,y,z\n9,1,2,3\n", [[1, 2, 3]]),
        (b"# scan 7\n# r,x,y,z\n9,1,2,3\n", [[1, 2, 3]]),
        (b"x,y,z\n,,\n1,2,3\n", [[1, 2, 3]]),
        (b'"x","y","z"\n"1","2","3"\n', [[1, 2, 3]]),
        (b"1,2,3,\n", [[1, 2, 3]]),
    ],
    ids=["a byte order mark", "names in a comment", "names in another", "empty cells", "quoted", "a comma at the end"],
)
def test_what_is_before_the_numbers_is_read(content: bytes, expected: list[list[int]], tmp_path: Path) -> None:
    (tmp_path / "points.csv").write_bytes(content)
    assert read_points(tmp_path / "points.csv")[0].tolist() == expected


@pytest.mark.parametrize("ending", ["stl", "obj", "ply", "off", "glb"])
def test_mesh_files(ending: str, tmp_path: Path) -> None:
    trimesh.creation.box([1, 2, 3]).export(tmp_path / f"box.{ending}")
    vertices, faces = read_triangles(tmp_path / f"box.{ending}")
    assert len(faces) == 12
    extents = [0.5, 1.5, 1] if ending == "glb" else [0.5, 1, 1.5]  # glTF has y up
    assert np.abs(vertices).max(axis=0) == pytest.approx(extents)


def assert_equal(a: rd.Scene, b: rd.Scene) -> None:
    assert [type(shape) for shape in a.shapes] == [type(shape) for shape in b.shapes]
    for one, other in zip(a.shapes, b.shapes, strict=True):
        for name in one.__dataclass_fields__:  # type: ignore[attr-defined]
            assert np.array_equal(getattr(one, name), getattr(other, name)), f"{one.name}.{name}"


def test_scene_entries_are_read_back_exactly(tmp_path: Path) -> None:
    scene = rd.Scene([*SHAPES.values(), *SHAPES.values(), rd.Box([0, 0, 0], [1, 1, 1], name="lid")])
    back, notes = read_scene(scene_entries(scene, tmp_path), tmp_path)
    assert notes == ()
    assert_equal(scene, back)


def test_shapes_from_files_are_written_as_names_of_files(tmp_path: Path) -> None:
    trimesh.creation.box([1, 2, 3]).export(tmp_path / "box.stl")
    np.save(tmp_path / "cloud.npy", [[0.1, 0.2, np.nan], [1, 2, 3]])
    entries = [{"mesh": {"file": "box.stl", "xyz": [0, 0, 1]}}, {"point_cloud": {"file": "cloud.npy", "point_radius": 0.02}}]
    (tmp_path / "box.stl").rename(tmp_path / "blob")
    (tmp_path / "box.stl").symlink_to("blob")  # regression: the target's name, which has no ending, was written
    scene, notes = read_scene(entries, tmp_path)
    assert len(notes) == 1 and "1 of 2 points" in notes[0]
    written = scene_entries(scene, tmp_path)
    assert written == [{"mesh": {"file": "box.stl", "xyz": [0.0, 0.0, 1.0]}}, entries[1]]
    assert scene_entries(scene, None)[0]["mesh"]["file"] == str(tmp_path.resolve() / "box.stl")
    assert_equal(scene, read_scene(written, tmp_path)[0])
    # regression: points that were replaced since were lost, since their old file was named
    changed = rd.Scene([replace(scene.shapes[1], points=[[3.0, 2, 1]])])  # type: ignore[type-var]
    assert read_scene(scene_entries(changed, tmp_path), tmp_path)[0].shapes[0].points.tolist() == [[3, 2, 1]]  # type: ignore


def test_meshes_and_clouds_from_files_with_a_scale(tmp_path: Path) -> None:
    trimesh.creation.box((200, 200, 200)).export(tmp_path / "cube.stl")
    np.save(tmp_path / "cloud.npy", np.array([[100.0, 0, 0], [np.nan, 0, 0]]))
    mesh = rd.Mesh.from_file(tmp_path / "cube.stl", xyz=[0.5, 0, 0], scale=0.001, name="cube")
    assert mesh.name == "cube" and mesh.file is None
    np.testing.assert_allclose(mesh.bounds, [[0.4, -0.1, -0.1], [0.6, 0.1, 0.1]])
    assert rd.Mesh.from_file(tmp_path / "cube.stl").file == str(tmp_path / "cube.stl")
    with pytest.warns(UserWarning, match="1 of 2 points are not finite"):
        cloud = rd.PointCloud.from_file(tmp_path / "cloud.npy", 0.02, scale=0.001)
    np.testing.assert_allclose(cloud.points, [[0.1, 0, 0]])
    assert cloud.point_radius == 0.02
    with pytest.warns(UserWarning, match="not finite"):
        assert rd.PointCloud.from_file(tmp_path / "cloud.npy", scale=0.001).point_radius == 0.01, "it was 10 µm"
    refuses(r"mesh\.scale is 0; it must be a number from", rd.Mesh.from_file, tmp_path / "cube.stl", scale=0)


@pytest.mark.parametrize("first", ["# shelf, scanned in May\n", "#\n", "# a, b\n# x,y,z\n", "\nx y z\n"])
@pytest.mark.parametrize("row", ["1 2 3\n", "1,2,3\n"])
def test_the_first_line_of_a_cloud_does_not_tell_the_separator(first: str, row: str, tmp_path: Path) -> None:
    (tmp_path / "points.xyz").write_text(first + row)
    assert read_points(tmp_path / "points.xyz")[0].tolist() == [[1, 2, 3]]
